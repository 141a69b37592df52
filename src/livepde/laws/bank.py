"""A bank of filters: hypothesis and weight of each member, and the first guess of the noise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import comb

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from livepde.laws.jumps import Watch
from livepde.laws.replay import ReplayState
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.linalg import Array, IntArray, Mask, Memo

__all__ = [
    "CANDIDATES",
    "GUESSED",
    "PATIENCE",
    "STAYS",
    "WIDE",
    "AutoState",
    "Bank",
    "Candidate",
    "first_guess",
    "normalised",
    "numbered",
    "say_the_same",
    "scaled",
]

STAYS, WIDE = 0, 1  # the first two candidates
ORDERS = (1, 2, 3, 4, 5)  # of differences
MEDIAN = 0.6745  # of the absolute value of a normal variable of standard deviation 1
NOISELESS = 1e-12  # of the size of readings: no noise
SCATTER = 0.5  # of the logarithm of such a guess
GUESSED = 12  # samples from which the noise is guessed where nobody states it
PATIENCE = 48  # samples after which a sensor that shows nothing new is guessed by the others
MOST_FILTERS = 16  # times between samples for which the filters are kept: usually one
SAME = 0.01  # divergence per coordinate, in nats, of members that say the same


@dataclass(frozen=True)
class Candidate:
    """Hypothesis of a member of the bank on the unknowns.

    Attributes
    ----------
    drift
        Variance of a gained from one sample to the next, relative to the prior's.
    scale
        Factor on all prior standard deviations.
    chance
        Weight before the first sample, not normalised.
    """

    drift: float
    scale: float
    chance: float


# The first two stay. The others drift, each ten times as fast as the one before: they gain the
# variance of the prior within some 30 000, 3 000, 300 and 30 samples.
CANDIDATES = (
    Candidate(0.0, 1.0, 0.8),
    Candidate(0.0, 3.0, 0.02),
    *(Candidate(drift, 1.0, 0.045) for drift in (3e-5, 3e-4, 3e-3, 3e-2)),
)


@dataclass(frozen=True, eq=False)
class Bank:
    """Parts computed once: the filter of all members, and the hypotheses of the candidates.

    Attributes
    ----------
    candidates
        One for each member number.
    work
        The filter of all, without drift.
    replays
        Candidates that keep one reference and replay, shape (candidates,).
    stated
        True if law or sensors state the noise.
    """

    candidates: tuple[Candidate, ...]
    work: SensitivityWork
    replays: Mask
    stated: bool
    _filters: Memo[tuple[float, bytes], SensitivityWork] = field(
        default_factory=lambda: Memo(MOST_FILTERS)
    )

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all input channels."""
        return self.work.filter.problem.channels

    @cached_property
    def chances(self) -> Array:
        """Logarithms of the weights before the first sample."""
        return normalised(np.log([candidate.chance for candidate in self.candidates]))

    @cached_property
    def drifts(self) -> Array:
        """Variance that each candidate gains from one sample to the next, shape (candidates,)."""
        return np.array([candidate.drift for candidate in self.candidates])

    @cached_property
    def scales(self) -> Array:
        """Logarithms of the factors on prior standard deviations, shape (candidates,)."""
        return np.log([candidate.scale for candidate in self.candidates])

    def filters(self, tick: float, noise: Array) -> SensitivityWork:
        """Return the filter of all members, for samples a time `tick` apart."""

        def made() -> SensitivityWork:
            drift = self.drifts / tick if tick else 0.0 * self.drifts
            return replace(self.work, filter=replace(self.work.filter, drift=drift, noise=noise))

        return self._filters.get((tick, noise.tobytes()), made)


@dataclass(frozen=True, eq=False)
class AutoState:
    """State of the bank: its members and their weights.

    Attributes
    ----------
    noise
        First guess of the standard deviation of the noise of each sensor, shape (sensors,); NaN
        while there is none.
    tick
        Usual time from one sample to the next, which drifts refer to; 0 before there is one.
    waiting
        Log of the samples that wait for a first guess of the noise.
    start
        A filter before the first waiting sample.
    members
        Filters of the members that are awake; `members.now.member` are their numbers.
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
    waiting: Array = field(metadata={"grows": 1})
    start: SensitivityState
    members: SensitivityState
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
        return int(self.weights.argmax())

    @property
    def awake(self) -> list[int]:
        """Positions among `members`, the heaviest first."""
        order = np.argsort(-self.weights[self.members.now.member], kind="stable")
        return [int(k) for k in order]

    def at(self, number: int) -> int:
        """Return the position of a member that is awake among `members`."""
        return int((self.members.now.member == number).nonzero()[0][0])


def normalised(weights: Array) -> Array:
    """Return logarithms of weights that add up to 1."""
    # The largest is taken off first, so that no exponential overflows.
    largest = weights.max()
    normal: Array = weights - largest - np.log(np.exp(weights - largest).sum())
    return normal


def numbered(state: SensitivityState, number: int, due: int) -> SensitivityState:
    """Return one member with another number, whose next replay is due at so many samples."""
    member = np.array([number])
    parts = ("now", "start", "older", "newer")
    filters = {part: replace(getattr(state, part), member=member) for part in parts}
    replay = replace(state.replay, x=replace(state.replay.x, member=member))
    return replace(state, due=np.array([due]), replay=replay, **filters)


def scaled(state: SensitivityState, scale: float) -> SensitivityState:
    """Return a filter before the first sample, with the prior standard deviations scaled."""
    start = state.start
    unknown = start.C.any(axis=2, keepdims=True)  # other rows are the noise of readings at first
    x = replace(start, U=np.where(unknown, scale * start.U, start.U), C=scale * start.C)
    return replace(state, start=x, now=x, older=x, newer=x, replay=ReplayState.none(x))


def say_the_same(work: Bank, state: AutoState, j: int, k: int) -> bool:
    """True if members at two positions say the same: symmetric divergence of two Gaussians."""
    filter_, now = work.work.filter, state.members.now
    estimate = filter_.estimate(now)
    shift = filter_.reduction.reduced(estimate[j] - estimate[k])
    covariances = [now.C[i].T @ now.C[i] for i in (j, k)]
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
    # The mean of both Kullback-Leibler divergences: [tr(P_j^-1 P_k) + tr(P_k^-1 P_j) - 2 size +
    # shift^T (P_j^-1 + P_k^-1) shift]/4.
    return 0.25 * (traces - 2 * size + distance) < SAME * size


def first_guess(z: Array) -> Array | None:
    """Return a first guess of the noise of each sensor, or None as long as there is none.

    Differences of order p of white noise of size 1 have the size sqrt(binomial(2 p, p)), while
    those of a smooth signal fade with the order: the order with the smallest result counts. Medians
    are taken, because signals change most at the start. The remainder of the signal makes the guess
    too large, which the law corrects.

    Parameters
    ----------
    z
        Samples, shape (samples, sensors), NaN where missing.
    """
    if len(z) <= GUESSED:
        return None
    guesses = []
    rounding = NOISELESS * np.nanmax(np.abs(z), axis=0, initial=0.0)
    for order in ORDERS:
        bends = np.abs(np.diff(z, order, axis=0))
        seen = np.isfinite(bends).sum(axis=0) >= GUESSED // 2
        bends = np.where(seen, bends, 0.0)
        size = np.nanmedian(bends, axis=0) / MEDIAN
        if len(z) >= PATIENCE:  # readings of a coarse resolution repeat most of the time
            size = np.where(size > rounding, size, np.sqrt(np.nanmean(bends**2, axis=0)))
        guesses.append(np.where(size > rounding, size / np.sqrt(comb(2 * order, order)), np.inf))
    # Orders are compared by the sensors for which each of them has a result.
    known = np.isfinite(guesses).all(axis=0)
    sizes = [float(np.log(guess[known]).sum()) for guess in guesses]
    noise: Array = guesses[int(np.argmin(sizes))].copy()
    good = np.isfinite(noise)
    if not good.any() or not (good.all() or len(z) >= PATIENCE):
        return None
    # Sensors that differ by chance alone are alike.
    logs, usual = np.log(noise[good]), float(np.median(np.log(noise[good])))
    # Logarithms shrink to their median by the share of their scatter that chance explains.
    chance = min(1.0, SCATTER**2 / max(float(((logs - usual) ** 2).mean()), SCATTER**2))
    noise[good] = np.exp(usual + (1.0 - chance) * (logs - usual))
    noise[~good] = np.exp(usual)
    return noise
