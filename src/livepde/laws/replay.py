"""Iterated smoothing: run the stored samples again, linear about a better reference trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.assimilation import UpdateOptions, assimilate, assimilate_at_once
from livepde.laws.base import Status
from livepde.laws.filter import Filter
from livepde.laws.filter_state import FilterState, along
from livepde.linalg import Array
from livepde.stepping import Interval

__all__ = [
    "CONVERGED",
    "Replay",
    "Window",
    "distance",
    "missed_most",
    "next_reference",
    "placed",
    "replayed",
]

CONVERGED = 0.5  # standard deviations between reference and estimate at which replays stop
STRIDE = 1.0  # prior deviations that a replay moves its reference at most: a trust region


@dataclass(frozen=True)
class Replay:
    """Keep one reference trajectory and replay the stored samples from a better one.

    Each plain update u += L K d leaves a second-order error that a state with long memory never
    forgets. With a replay the filter stays linear about one reference, and whenever the number of
    assimilated samples has doubled, the reference is moved to the estimate and the stored samples
    are run through again, until reference and estimate agree within half a standard deviation: a
    Gauss-Newton iteration, whose steps are at most one prior deviation long. One replay for each
    doubling makes less than four times the steps in all; more than one is needed mostly while the
    store is short.

    Parameters
    ----------
    window
        At most this many samples are stored. When it is full, the estimate of that moment becomes
        the new start and the store is emptied.
    first
        Number of assimilated samples before the first replay.
    iterations
        At most this many replays for each doubling.
    """

    window: int = 4096
    first: int = 8
    iterations: int = 4

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.window:
            raise LawError("Replay: needs 1 <= first <= window.")
        if self.iterations < 1:
            raise LawError(f"Replay: iterations must be at least 1; got {self.iterations}.")


@dataclass(frozen=True, eq=False)
class Window:
    """The stored samples of one member, and the filter before and after them.

    Attributes
    ----------
    start, now
        The filter where the window begins, and after the samples.
    first
        The sample at the start that `start` has not seen, as an interval without length, or None.
    intervals
        The samples after it.
    reference
        Latent parameter at the start from which the reference of `now` comes, shape (m,).
    initial
        True if the window begins with the initial state that the model says (`Model.initial`).
    moment
        Time and inputs at the start.
    """

    start: FilterState
    now: FilterState
    first: Interval | None
    intervals: list[Interval]
    reference: Array
    initial: bool
    moment: Moment

    @property
    def span(self) -> float:
        """Time since the start of the window."""
        return self.intervals[-1].t1 - self.intervals[0].t0 if self.intervals else 0.0


def _missed(filter_: Filter, window: Window) -> Array:
    """Return by how much the reference misses the estimate at the window's start, shape (k,)."""
    reduction, drift = filter_.reduction, float(filter_.drifts(window.now.member)[0])
    estimate = reduction.bounded(filter_.estimate(window.now)[0])
    start = reduction.traced(estimate, window.start.q[0], window.span, drift)
    return reduction.reduced(start - window.reference)


def next_reference(filter_: Filter, window: Window) -> Array:
    """Return the reference at the window's start that is next: towards the estimate, (m,)."""
    step = _missed(filter_, window)
    step = step * min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-300))
    q: Array = window.reference + filter_.reduction.Phi @ step
    return q


def missed_most(filter_: Filter, window: Window) -> float:
    """Return by how many prior deviations the reference misses the estimate."""
    return float(np.abs(_missed(filter_, window)).max(initial=0.0))


def distance(filter_: Filter, window: Window) -> float:
    """Return the distance between estimate and reference, in standard deviations."""
    now = window.now
    shift = filter_.reduction.transition(window.span) @ _missed(filter_, window)
    deviations = np.linalg.lstsq(now.C[0].T, shift, rcond=None)[0]
    return float(np.linalg.norm(deviations)) / float(now.innovations.inflation[0])


def placed(filter_: Filter, window: Window, q: Array) -> FilterState:
    """Return the filter at the start of the window, linear about q."""
    model, reduction = filter_.problem.model, filter_.reduction
    now, start = window.now, window.start
    start = replace(start, level=now.level, samples=now.samples, kept=now.kept)
    shift = reduction.reduced(q - start.q[0])
    if window.initial:
        initial = model.initial_directions(q, reduction.Phi, window.moment)
        u, du = model.initial_state(q, window.moment), -initial @ shift
        U = start.C @ initial.T
        return replace(start, q=q[None], u=u[None], du=du[None], da=-shift[None], U=U)
    moved = along(start, 0, shift)
    return replace(start, q=q[None], u=start.u + moved, du=start.du - moved, da=start.da - shift)


def replayed(filter_: Filter, window: Window, options: UpdateOptions) -> tuple[Window, Status]:
    """Run the samples again about a reference at the estimate, or on the way to it."""
    q = next_reference(filter_, window)
    x = placed(filter_, window, q)
    if window.first is not None and window.first.present.any():
        x = assimilate_at_once(filter_, x, filter_.span(window.first), options)
    for interval in window.intervals:
        x, told = assimilate(filter_, x, filter_.span(interval), options)
        if not told.status.ok:
            return window, told.status
        if not told.finite[0]:
            return window, Status("not_finite", "the replay is not finite")
    return replace(window, now=x, reference=q), Status()
