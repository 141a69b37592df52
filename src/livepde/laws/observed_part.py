"""The observed part u_alpha of the state over one interval: G^+ z, or G_alpha z (section 3.2).

For `GradientLaw(gain="auto")`, noisy samples are smoothed without a given noise level.

The law differentiates the readings: noise of w and noise of B(w) are correlated, and the part that
smoothing removes from B(w) moves with w. Neither averages out, and both look like a wrong q.
Therefore alpha does not minimise the error of u_alpha: it cancels the two biases. With data z,
noise n, and L = (|.|^2)^{1/2}, second derivatives for `Tikhonov("V")`,

    E (u_alpha, L (u_alpha - u)) = 0,    that is    E (u_alpha, L (z - u_alpha)) = E (u_alpha, L n).

The smoother is the iterated Tikhonov method: u_j minimises ||G v - z||_Z^2 + alpha |v - u_{j-1}|^2.
Its factors on the modes of G and |.| are 1 - f, f = (alpha k/(s + alpha k))^ORDER: the bias of
smooth functions decreases with ORDER, the bias of noise does not. Both sides of the balance are
means over the samples so far for each alpha of a grid; alpha is their first intersection.

The rougher half of the modes, in which a smooth state has almost no component, determines the noise
level by products of successive differences in time,

    E (z_k - z_{k-1}) (z_{k-1} - z_{k-2}) = -sigma^2:

differences of noise change sign, differences of a motion do not. The noise level of the observation
is an upper bound. Noise is independent between sensors with the standard deviations of the
observation, or white in Z if the observation has none.

Differences of exact data do not change sign. `NoiseDetector` tests this with second derivatives of
the data, before the modes of a dense matrix are computed. For exact data alpha is zero, and a
sample costs a few products with a sparse matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from livepde.errors import LawError
from livepde.laws.information import NoState
from livepde.laws.law import Problem
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Memo
from livepde.observation import Observed, Reconstructed, Split, Tikhonov
from livepde.observation.reconstruction import Spectral, penalty_matrix
from livepde.stepping import Interval

ORDER = 4  # of the iterated Tikhonov method
GRID = np.geomspace(1e-12, 1e8, 161)  # alpha in units of its scale
LARGEST = 3000  # maximum number of sensors, because the modes require a dense matrix
ROUNDING = 1e-14  # of second derivatives, relative to the sum of their terms
FEWEST = 8  # least number of modes for an estimate of the noise from the rougher half
LARGEST_MEMO = 8  # capacity of the caches of detectors and smoothers, by sets of sensors


@dataclass(frozen=True, eq=False)
class Balance:
    """Running means over the samples."""

    left: Array  # (u_alpha, L (z - u_alpha)) for each alpha, shape (alphas,)
    noise: Array  # E (u_alpha, L n) for the configured noise level, or level 1, shape (alphas,)
    power: float  # estimated noise variance, relative to the variance of `noise`
    # Number of samples, and number of samples that contributed to `power`.
    samples: int
    pairs: int
    # The last two samples and the boundary values at their times, shapes (2, sensors), (2, n).
    z: Array
    boundary: Array
    # Sum of negative cosines between successive changes: positive for noise, negative otherwise.
    turned: float

    @classmethod
    def none(cls, sensors: int, n: int) -> Balance:
        """Return the means before the first sample."""
        left, z = np.zeros(len(GRID)), np.full((2, sensors), np.nan)
        return cls(left, left, 0.0, 0, 0, z, np.zeros((2, n)), 0.0)

    def followed(self, z: Array, boundary: Array) -> Balance:
        """Store a sample and its boundary values; the means are unchanged."""
        samples, known = np.stack([self.z[1], z]), np.stack([self.boundary[1], boundary])
        return replace(self, z=samples, boundary=known)


def smooths(observed: Observed) -> bool:
    """Return True if samples are smoothed: observed coefficients without a `reconstruction`.

    The law does not differentiate averages, so their noise needs no smoothing in space. Raises
    `LawError` for noisy coefficients of a state that this smoother does not support.
    """
    observation = observed.observation
    if not observation.nodal or observation.reconstruction.regularises:
        return False
    if len(observed.state.fields) == 1 and observed.size <= LARGEST:
        return True
    if observed.noise is not None:
        raise LawError(
            f"GradientLaw: gain='auto' chooses how to smooth a state of one component with up to "
            f"{LARGEST} sensors: give the observation a reconstruction=, such as Tikhonov('X'), or "
            "leave out noise= if the data are exact."
        )
    return False


class NoiseDetector:
    """Distinguishes noisy from exact samples for one set of present sensors.

    Second derivatives of noise are large and change sign with the next sample.
    """

    def __init__(self, observed: Observed, split: Split) -> None:
        shown = split.R.diagonal()
        penalty = penalty_matrix("V", observed, shown[:, None])
        self.split = split
        self.rows = sp.csr_array(penalty[np.flatnonzero(shown)])
        diagonal = penalty.diagonal()[np.flatnonzero(shown)]
        self.scale = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0.0)
        self.small = int(shown.sum()) < FEWEST

    def add(self, balance: Balance, z: Array, boundary: Array) -> tuple[Balance, bool]:
        """Return the updated `turned` of a balance, and whether the samples are noisy."""
        samples = np.stack([*balance.z, z])
        if np.isfinite(samples[:, self.split.present]).all():
            known = [*balance.boundary, boundary]
            pairs = zip(samples, known, strict=True)
            u = np.stack([self.split.reconstruct(*pair) + pair[1] for pair in pairs])
            before, now = np.diff(self.rows @ u.T, axis=1).T
            size = math.sqrt(float((before**2 @ self.scale) * (now**2 @ self.scale)))
            rounding = abs(self.rows) @ np.abs(u).max(axis=0) * ROUNDING
            if size > float(rounding**2 @ self.scale):
                # Cosines weight all pairs of changes equally, even a large initial transient.
                turned = balance.turned - float(before @ (self.scale * now)) / size
                balance = replace(balance, turned=turned)
        return balance, self.small or balance.turned > 0.0


class SmoothingOperator:
    """G_alpha for one set of present sensors, and the terms of the balance for a sample."""

    def __init__(self, observed: Observed, present: Array) -> None:
        self.spectral = filter_ = Spectral(Tikhonov("V"), observed, present)
        self.stated = observed.noise is not None
        self.size = filter_.size
        if self.size == 0:
            return
        s, k = filter_.s, filter_.k
        # Boundary values are zero except at Dirichlet coefficients: only these rows are needed.
        self.fixed = observed.X.fixed
        self.pulled = np.ascontiguousarray(filter_.pulled[self.fixed].T)
        self.G = sp.csr_array(filter_.G[:, self.fixed])
        stiff = k > 0.0
        self.inverse = np.where(stiff, 1.0 / np.where(stiff, k, 1.0), 0.0)
        # s Var(n) of each mode, which is 1 for noise that is white in Z.
        if observed.noise is None:
            self.variance = np.ones(self.size)
        else:
            spread = filter_.fitted * observed.noise[present]
            self.variance = (spread**2).sum(axis=1) / s
        self.removed = self._removed(GRID[:, None] * filter_.rho)
        # On the modes, L is (k/s)^(1/2) and the inner product of Z has the weight s: the product is
        # (k s)^(1/2).
        self.products = self.removed * (1.0 - self.removed)
        self.weight = np.sqrt(k * s)
        self.noise = (1.0 - self.removed) @ (np.sqrt(k / s) * self.variance)

    def _removed(self, alpha: Array | float) -> Array:
        s, k = self.spectral.s, self.spectral.k
        return np.asarray((alpha * k / (s + alpha * k)) ** ORDER)

    def _rough(self, z: Array, boundary: Array) -> tuple[Array, Array]:
        """Return the modes of the data, and the modes minus the smooth extension of `boundary`.

        `z`: samples, shape (samples, sensors). `boundary`: boundary values, shape (samples, n).
        """
        filter_, held = self.spectral, boundary[:, self.fixed].T
        known = z[:, filter_.present].T - self.G @ held
        modes = (filter_.fitted @ known) / filter_.s[:, None]
        return modes, modes + (self.pulled @ held) * self.inverse[:, None]

    def add(self, balance: Balance, z: Array, boundary: Array) -> Balance:
        """Return the means after a sample z of shape (sensors,)."""
        if self.size == 0 or not np.isfinite(z[self.spectral.present]).all():
            return balance
        pair = self.size >= FEWEST and np.isfinite(balance.z[:, self.spectral.present]).all()
        samples = np.vstack([z, balance.z]) if pair else z[None]
        e = self._rough(samples, np.vstack([boundary, balance.boundary])[: len(samples)])[1].T
        left = self.products @ (self.weight * e[0] ** 2)
        share = 1.0 / (balance.samples + 1)
        power, pairs = balance.power, balance.pairs
        if pair:
            # The rows of e are samples k, k - 2 and k - 1, in this order.
            back = -self.spectral.s * (e[0] - e[2]) * (e[2] - e[1]) / self.variance
            half = slice(0, self.size // 2)  # s ascends, so the roughest modes come first
            pairs += 1
            power += (float(back[half].mean()) - power) / pairs
        return replace(
            balance.followed(z, boundary),
            left=balance.left + share * (left - balance.left),
            noise=balance.noise + share * (self.noise - balance.noise),
            power=power,
            samples=balance.samples + 1,
            pairs=pairs,
        )

    def alpha(self, balance: Balance) -> float:
        """Return the smallest alpha at which the biases by smoothing and by noise balance."""
        if self.size == 0:
            return 0.0
        power = max(balance.power, 0.0)
        if self.stated:
            power = min(power, 1.0) if self.size >= FEWEST else 1.0
        if power == 0.0:
            return 0.0
        excess = balance.left - power * balance.noise
        above = np.flatnonzero(excess > 0.0)
        if not len(above):
            return float(GRID[-1] * self.spectral.rho)
        first = int(above[0])
        if first == 0:
            return 0.0
        # The excess is interpolated linearly in log(alpha) between grid points.
        low, high = excess[first - 1], excess[first]
        part = low / (low - high)
        return float(GRID[first - 1] ** (1 - part) * GRID[first] ** part * self.spectral.rho)

    def __call__(self, alpha: float, z: Array, boundary: Array) -> Array:
        """Return u_alpha, shape (n,)."""
        if self.size == 0:
            return np.zeros(len(boundary))
        modes, rough = (part[:, 0] for part in self._rough(z[None], boundary[None]))
        return np.asarray(self.spectral.phi @ (modes - self._removed(alpha) * rough))


Find: TypeAlias = Callable[[Array, Array | None], Reconstructed]


@dataclass(frozen=True, eq=False)
class ObservedPath:
    """u_alpha at any time of an interval, with a cache."""

    problem: Problem
    interval: Interval
    find: Find  # function of the readings, and of Dirichlet values or None if all are zero
    _cache: dict[float, Reconstructed] = field(default_factory=dict)

    def at(self, t: float) -> Reconstructed:
        """Return u_alpha at a time."""
        if t not in self._cache:
            model, known = self.problem.model, None
            if not model.homogeneous:
                known = model.impose(np.zeros(model.X.dim), self.interval.at(t))
            self._cache[t] = self.find(self.interval.z(t), known)
        return self._cache[t]

    def diagnostics(self) -> Diagnostics[float]:
        """Return alpha and the misfit at the end of the interval; NaN if not computed."""
        end = self.at(self.interval.t1)
        return Diagnostics(alpha=end.alpha, misfit=end.misfit)


def exact(split: Split, z: Array, boundary: Array | None, alpha: float = np.nan) -> Reconstructed:
    """Return u_alpha = G^+ z."""
    return Reconstructed(split.reconstruct(z, boundary), alpha, np.nan, None)


@dataclass(frozen=True, eq=False)
class StatedReconstruction:
    """Rule u_alpha = G^+ z, or G_alpha z if the `reconstruction` of the observation regularises."""

    problem: Problem

    def init(self) -> NoState:
        """Return the state before the first sample."""
        return NoState()

    def over(
        self, state: NoState, split: Split, interval: Interval
    ) -> tuple[NoState, ObservedPath]:
        """Return the state after the sample at the end of an interval, and u_alpha over it."""
        observed = self.problem.observed
        if not observed.observation.reconstruction.regularises:
            return state, ObservedPath(self.problem, interval, partial(exact, split))

        def find(z: Array, boundary: Array | None) -> Reconstructed:
            return observed.reconstruct(z, boundary=boundary, present=interval.present)

        return state, ObservedPath(self.problem, interval, find)


class SelfChosenSmoothing:
    """Rule that smooths u_alpha according to the noise of the samples."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._detectors: Memo[bytes, NoiseDetector] = Memo(LARGEST_MEMO)
        self._smoothers: Memo[bytes, SmoothingOperator] = Memo(LARGEST_MEMO)

    def init(self) -> Balance:
        """Return the state before the first sample."""
        return Balance.none(self.problem.observed.size, self.problem.model.X.dim)

    def over(
        self, state: Balance, split: Split, interval: Interval
    ) -> tuple[Balance, ObservedPath]:
        """Return the state after the sample at the end of an interval, and u_alpha over it."""
        model, key = self.problem.model, split.present.tobytes()
        detector = self._detectors.get(key, lambda: NoiseDetector(self.problem.observed, split))
        find: Find = partial(exact, split)
        samples = [(interval.t1, interval.z1)]
        if np.isnan(state.z).all():  # the first interval
            samples.insert(0, (interval.t0, interval.z0))
        for t, z in samples:
            boundary = model.impose(np.zeros(model.X.dim), interval.at(t))
            state, noisy = detector.add(state, z, boundary)
            if noisy:
                make = partial(SmoothingOperator, self.problem.observed, split.present)
                smoother = self._smoothers.get(key, make)
                state = smoother.add(state, z, boundary)
                # The alpha of the last sample is used in the entire interval.
                find = _smoothed(smoother, smoother.alpha(state), split, model.X.dim)
            else:
                state = state.followed(z, boundary)
        return state, ObservedPath(self.problem, interval, find)


def _smoothed(smoother: SmoothingOperator, alpha: float, split: Split, n: int) -> Find:
    def find(z: Array, boundary: Array | None) -> Reconstructed:
        if alpha == 0.0:
            return exact(split, z, boundary, alpha)
        known = np.zeros(n) if boundary is None else boundary
        return Reconstructed(smoother(alpha, z, known), alpha, np.nan, None)

    return find


ObservedPart: TypeAlias = StatedReconstruction | SelfChosenSmoothing
