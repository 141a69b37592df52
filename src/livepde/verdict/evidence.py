"""Evidence in a ledger: e-values of causes, chi-square tests, and averages over hypotheses.

All functions take the ledger of one member: see `Ledger.of_member`.

The e-value of a direction is the Bayes factor of an amplitude with a standard normal prior against
an amplitude of zero, with the noise level integrated out. Under white errors of any level it is a
martingale that starts at one, and so is a mean of e-values. The probability that it ever exceeds
1/alpha is at most alpha, for any number of looks (Ville 1939; Robbins 1970; Vovk and Wang 2021).

Intervals that allow for unknown errors average over hypotheses. A hypothesis adds columns Z with
normal amplitudes b ~ N(0, L L^T) to the linearised model of the readings: z = J xi + Z b + noise,
with xi ~ N(0, I) and the noise level integrated out. With strong data, a single wrong hypothesis
would receive all the weight. Therefore the evidence e is tempered: weights use e^eta, with eta such
that no ratio to "nothing is wrong" exceeds e^TEMPER (Grünwald 2012; Miller and Dunson 2019).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from livepde.linalg import Array, IntArray
from livepde.verdict.ledger import BLOCKS, Ledger, chance

NU = 10.0  # degrees of freedom of the prior of the noise level
SAME = 1e-10  # tolerance of quantiles, in standard deviations
NEGLIGIBLE = 1e-15  # weight below which a hypothesis, one of thousands, affects no quantile
TEMPER = 8.0  # logarithm of the largest ratio of evidences; values from 3 to 8 act similarly
AMPLITUDES = (1.0 / 3.0, 4.0 / 3.0, 16.0 / 3.0, 64.0 / 3.0)  # prior sizes of a direction
NOTHING = 0.5  # prior mass of "nothing is wrong"; single causes and families share the rest equally
LEVEL = 0.95  # probability of the intervals
ALPHA = 0.01  # probability of a false alarm in a run, shared by the tests
CAUSES = 0.5 * ALPHA  # share of the e-value of all directions
RECORD = 0.05 * ALPHA  # share of each test for constancy, disagreement and autocorrelation
FOLLOWING = 0.2  # smallest autocorrelation that is reported
TRUSTED_LEVEL = 20.0  # samples as which the noise level of the whole run counts in a window
MOST_CORRELATED = 0.98  # upper bound of an estimated autocorrelation
LEAST = 0.05  # share of the information that each side of a change must have
LEAST_SHARE = 1e-6  # share of the largest eigenvalue below which information counts as zero


class Family(NamedTuple):
    """A random error with many amplitudes."""

    # Columns, and a square root L of the covariance of their amplitudes, (columns, k). Parts are
    # scaled to equal root mean square effects on the readings.
    parts: tuple[tuple[IntArray, Array], ...]
    # Candidate prior sizes: root mean square effect on a reading, in standard deviations of the
    # noise
    sizes: tuple[float, ...]
    # Candidate sizes in combination with a single cause of the same size
    beside: tuple[float, ...] = ()


class Causes(NamedTuple):
    """Single causes with one column each."""

    columns: IntArray  # index of the column of each cause, (causes,)
    # Largest plausible standard deviation of each amplitude, in its own unit, (causes,)
    most: Array
    sizes: tuple[float, ...]  # candidate prior sizes, see `Family`


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Linearised model of the readings, in units of the noise: z = J xi + Z b + noise."""

    # J, Z, z: derivatives with respect to the coordinates xi, (readings, p), effects of the errors,
    # (readings, columns), and readings minus the prior prediction, (readings,)
    J: Array
    Z: Array
    z: Array
    T: Array  # quantities of interest as linear functions of xi, (numbers, p)

    @cached_property
    def _eliminated(self) -> tuple[Array, Array]:
        """R^(-T) J^T [Z z] and R^(-T) T^T, with R^T R = 1 + J^T J."""
        R = scipy.linalg.cholesky(np.eye(self.J.shape[1]) + self.J.T @ self.J)
        products = self.J.T @ np.column_stack([self.Z, self.z])
        solved = scipy.linalg.solve_triangular(R, products, trans="T")
        numbers = scipy.linalg.solve_triangular(R, self.T.T, trans="T")
        return solved, numbers

    @cached_property
    def squares(self) -> Array:
        """Z^T Z."""
        return self.Z.T @ self.Z

    @cached_property
    def left(self) -> tuple[Array, Array, float]:
        """Products Z^T P Z, Z^T P z and z^T P z, with P = (1 + J J^T)^-1: unknowns eliminated."""
        products, _ = self._eliminated
        projected, projected_z = products[:, :-1], products[:, -1]
        S = self.squares - projected.T @ projected
        s = self.Z.T @ self.z - projected.T @ projected_z
        return S, s, float(self.z @ self.z - projected_z @ projected_z)

    @cached_property
    def asked(self) -> tuple[Array, Array, Array]:
        """Mean and variance of the numbers if nothing is wrong, and their shift per error."""
        products, numbers = self._eliminated
        shifts: Array = numbers.T @ products[:, :-1]
        mean: Array = numbers.T @ products[:, -1]
        return mean, (numbers**2).sum(axis=0), shifts

    def usual(self, columns: IntArray, root: Array) -> float:
        """Return the root mean square effect on a reading of amplitudes with a covariance."""
        squares = self.squares[np.ix_(columns, columns)]
        return math.sqrt(max(float(((squares @ root) * root).sum()), 0.0) / len(self.z))


class Mixture(NamedTuple):
    """Mixture of normal distributions, for several numbers."""

    weights: Array  # (components,)
    means: Array  # (components, numbers)
    deviations: Array  # (components, numbers)

    def widened(self, shift: Array) -> Mixture:
        """Return the mixture with an additional error of standard deviation `shift`, (numbers,)."""
        return self._replace(deviations=np.hypot(self.deviations, shift))

    def quantile(self, share: float) -> Array:
        """Return a quantile of each number, shape (numbers,).

        Newton's method for x -> ndtri(F(x)), which is linear for a single component, with bisection
        if an iterate leaves the bracket.
        """
        target = scipy.special.ndtri(share)
        ends = self.means + target * self.deviations
        low, high = ends.min(axis=0), ends.max(axis=0)  # bracket of the quantile of the mixture
        x = self.weights @ ends
        for _ in range(60):
            scaled = (x - self.means) / self.deviations
            below = self.weights @ scipy.special.ndtr(scaled)
            low, high = np.where(below < share, x, low), np.where(below < share, high, x)
            score = scipy.special.ndtri(below)
            if not (np.abs(score - target) > SAME).any():
                break
            density = self.weights @ (np.exp(-0.5 * scaled**2) / self.deviations)
            newton = x - (score - target) * np.exp(-0.5 * score**2) / density
            x = np.where((low < newton) & (newton < high), newton, 0.5 * (low + high))
        return np.asarray(x)

    @property
    def interval(self) -> tuple[Array, Array]:
        """Lower and upper end of the central 95 % interval of each number."""
        return self.quantile(0.5 - 0.5 * LEVEL), self.quantile(0.5 + 0.5 * LEVEL)


class _Axes(NamedTuple):
    """A family of unit size in the principal axes of its effect on the readings."""

    # effect, along: squared effect of each axis on the readings, and its product with the
    # residuals, (k,)
    effect: Array
    along: Array
    moved: Array  # shift of each number per axis, (numbers, k)
    shared: Array  # products of each axis with each single cause, (k, causes)

    @classmethod
    def of(cls, model: LinearModel, family: Family, columns: IntArray) -> _Axes:
        S, s, _ = model.left
        shifts, blocks, indices = model.asked[2], [], []
        for columns_of_part, root in family.parts:
            size = model.usual(columns_of_part, root) * math.sqrt(len(family.parts))
            if size > 0.0:
                blocks.append(root / size)
                indices.append(columns_of_part)
        if not blocks:
            empty = np.zeros(0)
            return cls(empty, empty, shifts[:, :0], S[:0][:, columns])
        index, L = np.concatenate(indices), scipy.linalg.block_diag(*blocks)
        effect, axes = np.linalg.eigh(L.T @ S[np.ix_(index, index)] @ L)
        L = L @ axes
        shared = L.T @ S[np.ix_(index, columns)]
        return cls(np.maximum(effect, 0.0), L.T @ s[index], shifts[:, index] @ L, shared)


class _Hypotheses(NamedTuple):
    """Evidence of hypotheses, and their effects on the numbers."""

    # Residual sum of squares, and half of the log-determinant, (hypotheses,)
    squares: Array
    volume: Array
    # Indices of hypotheses -> shifts and added variances of the numbers, (indices, numbers). They
    # are evaluated only for hypotheses with weight, since a field has many numbers.
    moves: Callable[[IntArray], tuple[Array, Array]]


def _family_alone(model: LinearModel, axes: _Axes, size: float) -> _Hypotheses:
    D = 1.0 + size**2 * axes.effect
    fitted = size**2 * axes.along / D

    def moves(chosen: IntArray) -> tuple[Array, Array]:
        shift, variance = -(axes.moved @ fitted), axes.moved**2 @ (size**2 / D)
        return shift[None].repeat(len(chosen), axis=0), variance[None].repeat(len(chosen), axis=0)

    return _Hypotheses(
        np.array([model.left[2] - float(fitted @ axes.along)]),
        np.array([0.5 * float(np.log(D).sum())]),
        moves,
    )


def _beside(model: LinearModel, axes: _Axes, causes: Causes, family_size: float) -> _Hypotheses:
    """Return the hypotheses of a family of size `family_size` combined with each single cause."""
    S, s, _ = model.left
    effect = np.sqrt(np.diag(model.squares)[causes.columns] / len(model.z))
    active = np.flatnonzero(effect > 0.0)
    columns, effect = causes.columns[active], effect[active]
    size = np.minimum(family_size, causes.most[active] * effect) / effect
    # The cause borders the matrix of the family, which is diagonal, by one row and column.
    alone, D = _family_alone(model, axes, family_size), 1.0 + family_size**2 * axes.effect
    u = family_size**2 * axes.shared[:, active] / D[:, None]
    remaining = np.maximum(np.diag(S)[columns] - (u * axes.shared[:, active]).sum(axis=0), 0.0)
    kappa = 1.0 + size**2 * remaining
    beta = s[columns] - u.T @ axes.along

    def moves(chosen: IntArray) -> tuple[Array, Array]:
        ((shift,), (variance,)) = alone.moves(np.zeros(1, dtype=np.int64))
        moved = (model.asked[2][:, columns[chosen]] - axes.moved @ u[:, chosen]).T
        posterior = (size**2 / kappa)[chosen, None]
        return shift - moved * (posterior * beta[chosen, None]), variance + moved**2 * posterior

    return _Hypotheses(
        alone.squares - size**2 * beta**2 / kappa, alone.volume + 0.5 * np.log(kappa), moves
    )


NO_FAMILY = Family((), ())


def averaged(model: LinearModel, causes: Causes, families: Sequence[Family]) -> Mixture:
    """Return the tempered average over "nothing is wrong", single causes and families.

    Hypotheses with negligible weight are left out.
    """
    total, (mean, variance, _) = model.left[2], model.asked
    n, groups = len(model.z), _grouped_hypotheses(model, causes, families)
    hypotheses = [item for group in groups for sizes in group for item in sizes]
    squares = np.maximum(np.concatenate([item.squares for item in hypotheses]), 0.0)
    volume = np.concatenate([item.volume for item in hypotheses])
    log_evidence = -0.5 * (NU + n) * np.log((NU + squares) / (NU + total)) - volume
    kinds, counts = _kinds(groups)
    shares = (NOTHING, 0.5 * (1.0 - NOTHING), 0.5 * (1.0 - NOTHING))
    weights = _tempered(log_evidence, kinds, shares, counts)
    level = np.maximum(1.0, (NU + squares) / (NU + n))
    used = ~(weights < NEGLIGIBLE)
    masks = np.split(used, np.cumsum([len(item.squares) for item in hypotheses])[:-1])
    moves = [item.moves(np.flatnonzero(mask)) for item, mask in zip(hypotheses, masks, strict=True)]
    shift, added = (np.concatenate(part) for part in zip(*moves, strict=True))
    return Mixture(weights[used], mean + shift, np.sqrt((variance + added) * level[used, None]))


def _grouped_hypotheses(
    model: LinearModel, causes: Causes, families: Sequence[Family]
) -> list[list[list[_Hypotheses]]]:
    """Return blocks of hypotheses: group ("nothing", causes, families) -> variant -> size."""
    none = _Axes.of(model, NO_FAMILY, causes.columns)
    single = [_beside(model, none, causes, size) for size in causes.sizes]
    family_variants: list[list[_Hypotheses]] = []
    for family in families:
        axes = _Axes.of(model, family, causes.columns)
        family_variants.append([_family_alone(model, axes, size) for size in family.sizes])
        family_variants.append([_beside(model, axes, causes, size) for size in family.beside])
    return [[[_family_alone(model, none, 0.0)]], [single], family_variants]


def _kinds(groups: Sequence[Sequence[Sequence[_Hypotheses]]]) -> tuple[IntArray, list[int]]:
    """Return the kind of each hypothesis, and the number of kinds in each group."""
    kinds, counts = list[IntArray](), [0] * len(groups)
    for number, group in enumerate(groups):
        for sizes in filter(None, group):
            count = len(sizes[0].squares)
            kinds += [sum(counts) + np.arange(count)] * len(sizes)
            counts[number] += count
    return np.concatenate(kinds), counts


def _tempered(
    log_evidence: Array, kinds: IntArray, shares: Sequence[float], counts: Sequence[int]
) -> Array:
    """Return the weights of hypotheses with log-evidence `log_evidence`; the first is "nothing".

    The evidence of sizes within a kind is not tempered. The evidence of kinds is, because the right
    kind may be missing.

    `kinds`: kind of each hypothesis. `shares`, `counts`: prior mass and number of kinds of each
    group.
    """
    masses = zip(shares, counts, strict=True)
    prior = np.concatenate([np.full(n, math.log(share / max(n, 1))) for share, n in masses])
    total = np.full(len(prior), -np.inf)
    np.logaddexp.at(total, kinds, log_evidence)
    of_kind = total - np.log(np.bincount(kinds))
    excess = float((of_kind + prior).max() - of_kind[0] - prior[0])
    eta = 1.0 if excess <= TEMPER else TEMPER / excess
    weights = (prior + eta * of_kind - total)[kinds] + log_evidence
    return np.asarray(np.exp(weights - scipy.special.logsumexp(weights)))


def averaged_causes(ledger: Ledger, moved: Array, most: Array, std: Array) -> Mixture:
    """Return the tempered average over "nothing is wrong" and the directions of a ledger.

    The numbers are truth minus estimate. `moved`: their shift per direction and window, (numbers,
    windows * directions). `most`: largest plausible amplitude of each direction, (directions,).
    `std`: standard deviations of the numbers if nothing is wrong, (numbers,).
    """
    sums, noise, spread = ledger.sums, ledger.noise, levels(ledger)
    log_e, size, _ = _tested(sums, noise, spread, np.zeros_like(spread))
    # Causes are tested on innovations from which autocorrelation is removed.
    rho, variances_left = _autocorrelation(sums, noise, log_e, size)
    score, information = _regression(sums, variances_left, rho)
    zero = np.zeros((1, len(std)))
    log_evidence, means, variances = [np.zeros(1)], [zero], [zero]
    for amplitude in AMPLITUDES:
        prior = np.minimum(amplitude, most)
        variance = 1.0 / (information + prior**-2.0)
        log_evidence.append(_tested(sums, noise, variances_left, rho, prior)[0].ravel())
        means.append((moved * (score * variance).ravel()).T)
        variances.append((moved**2 * variance.ravel()).T)
    count = moved.shape[1]
    kinds = np.concatenate([[0], np.tile(1 + np.arange(count), len(AMPLITUDES))])
    shares = (NOTHING, 1.0 - NOTHING)
    weights = _tempered(np.concatenate(log_evidence), kinds, shares, (1, count))
    deviations = np.sqrt(std**2 + np.concatenate(variances))
    return Mixture(weights, np.concatenate(means), deviations)


@dataclass(frozen=True, eq=False)
class CauseEvidence:
    """Evidence of every direction in every window, shapes (windows, directions)."""

    # log_e, size: logarithm of the e-value, and best-fitting amplitude
    log_e: Array
    size: Array
    share: Array  # share of the misfit beyond the noise that the direction explains
    # total, whitened: logarithm of the mean e-value under white errors, and its minimum with the
    # value under autocorrelated errors
    total: float
    whitened: float
    # Autocorrelation of each sensor after the direction with most evidence is fitted, (sensors,)
    correlation: Array


def levels(ledger: Ledger) -> Array:
    """Return the variance of the noise over the assumed one, (windows, sensors).

    It is estimated from successive differences of the whitened innovations (von Neumann 1941),
    which slow misfit does not affect.
    """
    _, _, squares, products, pairs = ledger.noise
    # sum (r_k - r_(k-1))^2 / 2 = sum r r - sum r_k r_(k-1), up to the ends of the window.
    differences = np.maximum(squares - products, 0.0)
    # Short windows are shrunk towards the level of the run, and that towards the assumed level.
    whole = (differences[0] + NU) / (pairs[0] + NU)
    return np.asarray((differences + TRUSTED_LEVEL * whole) / (pairs + TRUSTED_LEVEL))


def weighted_median(values: Array, weights: Array) -> float:
    """Return the weighted median of values."""
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


def mean_squares(ledger: Ledger) -> Array:
    """Return mean squares of whitened innovations, expected to be 1, (windows, sensors)."""
    count, _, squares, *_ = ledger.noise
    return np.asarray(squares / np.maximum(count, 1.0))


def causes_of(ledger: Ledger) -> CauseEvidence:
    """Return the evidence of all directions."""
    sums, noise, spread = ledger.sums, ledger.noise, levels(ledger)
    log_e, size, share = _tested(sums, noise, spread, np.zeros_like(spread))
    weights = _weights(ledger, log_e.shape[1])
    total = float(scipy.special.logsumexp(log_e + weights)) if log_e.size else 0.0
    # Repeat the test with AR(1) errors, and use the smaller e-value: misfit that slow noise
    # explains as well is not evidence for a cause.
    rho, variance = _autocorrelation(sums, noise, log_e, size)
    white, _, _ = _tested(sums, noise, variance, rho)
    whitened = float(scipy.special.logsumexp(white + weights)) if white.size else 0.0
    return CauseEvidence(log_e, size, share, total, min(total, whitened), rho[0])


class Following(NamedTuple):
    """Sensor with autocorrelated innovations: its index, the correlation and its p-value."""

    sensor: int
    correlation: float
    p_value: float


def following(ledger: Ledger, window: int) -> Following | None:
    """Return the sensor with the most significant autocorrelation; None if not significant."""
    _, _, squares, products, pairs = ledger.noise[:, window]
    rho = products / np.maximum(squares, 1e-300)
    # Under white errors the correlation of n pairs is normal with the variance 1/n.
    z = rho * np.sqrt(np.maximum(pairs, 1.0))
    worst = int(np.argmax(z))
    p = min(1.0, 0.5 * math.erfc(float(z[worst]) / math.sqrt(2.0)) * len(z))
    if p > RECORD or rho[worst] < FOLLOWING:
        return None
    return Following(worst, float(rho[worst]), p)


def quiet(ledger: Ledger, log_e: Array) -> bool:
    """Return whether restarting windows are free of evidence; log_e: (windows, directions)."""
    return unsuspicious(log_e[1:]) and following(ledger, -1) is None


def unsuspicious(log_e: Array) -> bool:
    """Return whether no window has evidence against the model; log_e: (windows, directions)."""
    if not log_e.size:
        return True
    window_log_e = scipy.special.logsumexp(log_e, axis=1) - np.log(log_e.shape[1])
    return bool((window_log_e < -np.log(CAUSES)).all())


def _tested(
    sums: Array, noise: Array, spread: Array, rho: Array, prior: Array | float = 1.0
) -> tuple[Array, Array, Array]:
    """Return log e-values, amplitudes and shares of the misfit, each (windows, directions).

    `spread`, `rho`: variance and autocorrelation of the errors, (windows, sensors).
    `prior`: prior standard deviation of the amplitude of each direction, (directions,).
    """
    count, _, squares, products, _ = noise
    num, den = _regression(sums, spread, rho)
    rss = ((squares * (1.0 + rho**2) - 2.0 * rho * products) / spread).sum(axis=1)
    rss = np.maximum(rss, 0.0)[:, None]
    total = count.sum(axis=1)[:, None]
    # Bayes factor of theta ~ N(0, s^2) under Student's t: the noise level is integrated out.
    k = 1.0 / (1.0 + prior**2 * den)
    explained = np.minimum(prior**2 * num**2 * k / (NU + rss), 1.0 - 1e-12)
    log_e = 0.5 * np.log(k) - 0.5 * (NU + total) * np.log1p(-explained)
    log_e = np.where(np.isfinite(log_e), log_e, 0.0)
    size = num / np.where(den > 0.0, den, np.inf)
    # Misfit beyond the noise, bounded below so that no share exceeds one.
    excess = np.maximum(rss - total, num * size)
    share = num * size / np.where(excess > 0.0, excess, np.inf)
    return log_e, size, share


def _regression(sums: Array, spread: Array, rho: Array) -> tuple[Array, Array]:
    """Return score and information of the amplitude of each direction, (windows, directions).

    Generalised least squares with AR(1) errors, from sums of products at lags 0 and 1.
    """
    num, den, cross, lagged = sums
    diagonal, off_diagonal = ((1.0 + rho**2) / spread)[:, None], (rho / spread)[:, None]
    score = (num * diagonal - cross * off_diagonal).sum(axis=2)
    return score, np.maximum((den * diagonal - 2.0 * lagged * off_diagonal).sum(axis=2), 0.0)


def _autocorrelation(sums: Array, noise: Array, log_e: Array, size: Array) -> tuple[Array, Array]:
    """Return autocorrelation and variance after the fit of each window's best direction."""
    _, _, squares, products, pairs = noise
    count = noise[0]
    if log_e.size:
        rows, direction = np.arange(len(log_e)), log_e.argmax(axis=1)
        theta = size[rows, direction][:, None]
        num, den, cross, lagged = (part[rows, direction] for part in sums)
        # Sums of squares of r - theta g, and of its products at lag 1.
        squares = np.maximum(squares - 2.0 * theta * num + theta**2 * den, 0.0)
        products = products - theta * cross + theta**2 * lagged
    rho = (products / np.maximum(squares, 1e-300)) * pairs / (pairs + NU)
    rho = np.clip(rho, 0.0, MOST_CORRELATED)
    whitened = (1.0 + rho**2) * squares - 2.0 * rho * products
    return rho, (np.maximum(whitened, 0.0) + NU) / (count + NU)


def _weights(ledger: Ledger, directions: int) -> Array:
    """Return logarithms of the prior weights of all directions, (windows, directions).

    The window of all samples has half of the mass, and the other windows share the rest. After n
    restarts a window uses 1/((n + 1)(n + 2)) of its share, so that all weights sum to at most one.
    """
    epoch = ledger.epoch.astype(float)
    windows = len(epoch)
    share = np.full(windows, 0.5 / max(windows - 1, 1)) / ((epoch + 1.0) * (epoch + 2.0))
    share[0] = 0.5
    return np.asarray(
        np.log(share)[:, None] - np.log(max(directions, 1)) + np.zeros((1, directions))
    )


@dataclass(frozen=True, eq=False)
class Constancy:
    """Test of constant unknowns: sup-LM on the cumulative scores (Andrews 1993)."""

    p_value: float  # upper bound, from the union bound over the candidate changes
    after: float  # share of the samples before the most likely change
    change: Array  # change of the unknowns, in prior standard deviations, (k,)


def _whitened_record(ledger: Ledger, wider: float) -> tuple[Array, Array]:
    """Return score, (blocks, sensors, k), and information, in units of the estimated noise."""
    spread = levels(ledger)[0] * wider
    score = ledger.score / spread[:, None]
    return score, ledger.information / spread[:, None, None]


def _inverse(F: Array) -> tuple[Array, int]:
    """Return the pseudo-inverse of an information matrix, and its rank."""
    values, axes = np.linalg.eigh(F)
    determined = values > LEAST_SHARE * max(float(values[-1]), 1.0)
    inverse = (axes[:, determined] / values[determined]) @ axes[:, determined].T
    return inverse, int(determined.sum())


def constancy(ledger: Ledger, wider: float = 1.0) -> Constancy | None:
    """Return the test of constant unknowns; None if the record is too short or not kept.

    `wider`: variance of a mean of the errors over that of a mean of independent errors.
    """
    score, information = (part.sum(axis=1) for part in _whitened_record(ledger, wider))
    k = score.shape[1]
    # Candidate changes are between the blocks of the record, which have equal lengths.
    blocks = int(ledger.seen - 1) // int(ledger.length) + 1
    if not k or blocks < 4:
        return None
    F, B = information.cumsum(axis=0), score.cumsum(axis=0)
    inverse, rank = _inverse(F[-1])
    if not rank:
        return None
    best, place, change, candidates = -1.0, 0, np.zeros(k), 0
    for j in range(min(blocks, BLOCKS) - 1):
        # Near the ends of the record, one side has too little information to detect a change.
        share = float(np.trace(inverse @ F[j])) / rank
        if not LEAST < share < 1.0 - LEAST:
            continue
        candidates += 1
        # Score of the first part at the estimate from all blocks: zero mean without a change.
        shifted_score = B[j] - F[j] @ inverse @ B[-1]
        A, _ = _inverse(F[j] - F[j] @ inverse @ F[j])
        statistic = float(shifted_score @ A @ shifted_score)
        if statistic > best:
            # A step d after the change leaves the score c = -(F_j - F_j F^-1 F_j) d.
            best, place, change = statistic, j, -A @ shifted_score
    if not candidates:
        return None
    # Bonferroni bound over the candidate changes.
    p = min(1.0, candidates * chance(best, rank))
    after = (place + 1) * int(ledger.length) / int(ledger.seen)
    return Constancy(p, min(after, 1.0), change)


def disagreement(ledger: Ledger, wider: float = 1.0) -> tuple[float, Array] | None:
    """Return p-value and share of each sensor in the test for agreement of sensors.

    Q = sum_i Bp_i^T F_i^+ Bp_i, with Bp_i = B_i - F_i F^-1 sum B, measures the heterogeneity of the
    estimates from single sensors (Cochran 1954). It is chi-square under the model. None if there is
    no record, or if no unknown is determined by two sensors.
    """
    score, information = (part.sum(axis=0) for part in _whitened_record(ledger, wider))
    sensors, k = score.shape
    if sensors < 2 or not k:
        return None
    inverse, rank = _inverse(information.sum(axis=0))
    statistics, freedom = np.zeros(sensors), -rank
    for i in range(sensors):
        inverse_of_sensor, rank_of_sensor = _inverse(information[i])
        # Score of a sensor at the estimate from all sensors.
        shifted_score = score[i] - information[i] @ inverse @ score.sum(axis=0)
        statistics[i] = shifted_score @ inverse_of_sensor @ shifted_score
        freedom += rank_of_sensor
    if freedom < 1:
        return None
    total = float(statistics.sum())
    return chance(total, freedom), statistics / max(total, 1e-300)
