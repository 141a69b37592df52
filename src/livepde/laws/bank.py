"""A bank of filters: what each member assumes, and how far it is believed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve

from livepde.laws.filter import Filter
from livepde.laws.jumps import Watch
from livepde.laws.past import Past, Samples
from livepde.laws.sensitivity import SensitivityLaw, SensitivityState
from livepde.linalg import Array, IntArray

__all__ = [
    "CANDIDATES",
    "STAYS",
    "WIDE",
    "AutoState",
    "Bank",
    "Candidate",
    "asleep",
    "normalised",
    "say_the_same",
    "scaled",
]

STAYS, WIDE = 0, 1  # the first two candidates
SAME = 0.01  # divergence per coordinate, in nats, of members that say the same


@dataclass(frozen=True)
class Candidate:
    """What a member of the bank assumes.

    Attributes
    ----------
    drift
        Variance of a gained from one sample to the next, relative to the prior's.
    scale
        Factor on all prior deviations.
    chance
        Weight before the first sample, not normalised.
    """

    drift: float
    scale: float
    chance: float


CANDIDATES = (
    Candidate(0.0, 1.0, 0.8),
    Candidate(0.0, 3.0, 0.02),
    *(Candidate(drift, 1.0, 0.045) for drift in (3e-5, 3e-4, 3e-3, 3e-2)),
)


@dataclass(frozen=True, eq=False)
class Bank:
    """What is computed once: a filter for each candidate, each with factors of its own."""

    candidates: tuple[Candidate, ...]
    laws: tuple[SensitivityLaw, ...]
    filters: tuple[Filter, ...]
    stated: bool
    _made: dict[tuple[int, float, bytes], Filter] = field(default_factory=dict)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all input channels."""
        return self.filters[0].problem.channels

    @property
    def chances(self) -> Array:
        """Logarithms of the weights before the first sample."""
        return normalised(np.log([candidate.chance for candidate in self.candidates]))

    def filter(self, k: int, tick: float, noise: Array) -> Filter:
        """Return the filter of a candidate, for samples a time `tick` apart.

        Made once: it keeps what it has computed.
        """
        key = (k, tick, noise.tobytes())
        if key not in self._made:
            if len(self._made) > 3 * len(self.candidates):
                self._made.clear()
            self._made[key] = self._filter(k, tick, noise)
        return self._made[key]

    def _filter(self, k: int, tick: float, noise: Array) -> Filter:
        drift, filter_ = self.candidates[k].drift, self.filters[k]
        if drift and tick:
            motions = tuple(motion.drifting(drift / tick) for motion in filter_.motions)
            filter_ = replace(filter_, motions=motions)
        return replace(filter_, noise=noise)


@dataclass(frozen=True, eq=False)
class AutoState:
    """The members of the bank, and how far each is believed.

    Attributes
    ----------
    noise
        First guess of the deviation of each sensor, shape (sensors,); NaN while there is none.
    tick
        Usual time from one sample to the next, which drifts refer to; 0 before there is one.
    waiting
        Samples that wait for a first guess of the noise.
    start
        A filter before the first of them.
    members
        Filters; of one that sleeps nothing is kept.
    weights
        Logarithms of the weights, shape (members,); -inf for one that sleeps.
    until
        Number of samples before which a member does not sleep, shape (members,).
    count, due, pause
        Samples assimilated; at how many those that sleep wake; how many later the next time.
    watch
        Innovations of the leading member.
    """

    noise: Array
    tick: float
    waiting: Samples
    start: SensitivityState
    members: tuple[SensitivityState, ...]
    weights: Array
    until: IntArray
    count: int
    due: int
    pause: int
    watch: Watch

    @property
    def known(self) -> bool:
        """True if there is a guess of the noise."""
        return bool(np.isfinite(self.noise).all())

    @property
    def leader(self) -> int:
        """The member with the largest weight."""
        return int(np.argmax(self.weights))

    @property
    def awake(self) -> list[int]:
        """Members that run, the heaviest first."""
        order = np.argsort(-self.weights, kind="stable")
        return [int(k) for k in order if np.isfinite(self.weights[k])]


def normalised(weights: Array) -> Array:
    """Return logarithms of weights that add up to 1."""
    return np.asarray(weights - scipy.special.logsumexp(weights))


def scaled(state: SensitivityState, scale: float) -> SensitivityState:
    """Return a filter before the first sample with another prior deviation."""
    start = replace(state.start, U=scale * state.start.U, C=scale * state.start.C)
    return replace(state, start=start, now=start, past=Past.start(start, state.samples))


def asleep(state: SensitivityState) -> SensitivityState:
    """Return what is kept of a member that sleeps: nothing that takes room."""
    start = replace(state.start, U=state.start.U[:, :0], C=state.start.C[:, :0])
    return replace(state, start=start, now=start, past=Past.start(start, state.samples))


def say_the_same(work: Bank, state: AutoState, j: int, k: int) -> bool:
    """True if two members say the same of the unknowns: symmetric divergence of two Gaussians."""
    filter_ = work.filters[j]
    one, other = state.members[j].now, state.members[k].now
    shift = filter_.reduced(filter_.latent(one) - filter_.latent(other))
    covariances = [point.C @ point.C.T for point in (one, other)]
    try:
        factors = [cho_factor(covariance) for covariance in covariances]
    except np.linalg.LinAlgError:
        return False
    traces = sum(
        float(np.trace(cho_solve(factor, covariance)))
        for factor, covariance in zip(factors, reversed(covariances), strict=True)
    )
    distance = sum(float(shift @ cho_solve(factor, shift)) for factor in factors)
    size = len(shift)
    return 0.25 * (traces - 2 * size + distance) < SAME * size
