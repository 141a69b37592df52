"""Gauss-Newton steps of the reference about which a filter is linear, over a window of samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from livepde.fem import Moment
from livepde.laws.filter import Filter
from livepde.laws.filter_state import FilterState, along
from livepde.linalg import Array

CONVERGED = 0.5  # standard deviations between reference and estimate at which the steps stop
STRIDE = 1.0  # prior standard deviations that a step moves the reference at most: a trust region


@dataclass(frozen=True, eq=False, kw_only=True)
class Window:
    """Some samples of one member: the filter before and after them."""

    # The filter where the window begins, and after the samples.
    start: FilterState
    now: FilterState
    # Latent parameter at the start from which the reference of `now` comes, shape (m,).
    reference: Array
    # True if the window begins with the initial state that the model says (`Model.initial`).
    initial: bool
    # Time and inputs at the start, and the time since.
    moment: Moment
    length: float


def _missed(filter_: Filter, window: Window) -> Array:
    """Return by how much the reference misses the estimate at the window's start, shape (k,)."""
    reduction, drift = filter_.reduction, float(filter_.drifts(window.now.member)[0])
    estimate = reduction.bounded(filter_.estimate(window.now)[0])
    start = reduction.traced(estimate, window.start.q[0], window.length, drift)
    return reduction.reduced(start - window.reference)


def next_reference(filter_: Filter, window: Window) -> Array:
    """Return the reference at the window's start that is next: towards the estimate, (m,)."""
    step = _missed(filter_, window)
    step = step * min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-300))
    q: Array = window.reference + filter_.reduction.Phi @ step
    return q


def missed_most(filter_: Filter, window: Window) -> float:
    """Return by how many prior standard deviations the reference misses the estimate."""
    return float(np.abs(_missed(filter_, window)).max(initial=0.0))


def distance(filter_: Filter, window: Window) -> float:
    """Return the distance between estimate and reference, in standard deviations."""
    now = window.now
    shift = filter_.reduction.transition(window.length) @ _missed(filter_, window)
    weights = np.linalg.lstsq(now.C[0].T, shift, rcond=None)[0]
    # In standard deviations that are inflated as the reported ones are.
    return float(np.linalg.norm(weights)) / float(now.innovations.inflation[0])


def placed(filter_: Filter, window: Window, q: Array) -> FilterState:
    """Return the filter at the start of the window, linear about q."""
    model, reduction = filter_.problem.model, filter_.reduction
    now, start = window.now, window.start
    start = replace(start, level=now.level, samples=now.samples, kept=now.kept)
    shift = reduction.reduced(q - start.q[0])
    # Such an initial state moves with q along du_0/dq, and is uncertain by the unknowns alone.
    if window.initial:
        initial = model.initial_directions(q, reduction.Phi, window.moment)
        u, du = model.initial_state(q, window.moment), -initial @ shift
        U = start.C @ initial.T
        return replace(start, q=q[None], u=u[None], du=du[None], da=-shift[None], U=U)
    # The estimate does not move with the reference: du and da fall by as much.
    moved = along(start, 0, shift)
    return replace(start, q=q[None], u=start.u + moved, du=start.du - moved, da=start.da - shift)
