"""Average over what may be wrong with a model: intervals that allow for errors that are not known.

A hypothesis adds columns Z with normal amplitudes b ~ N(0, L L^T) to the linearised model of
the readings, z = J xi + Z b + noise, with xi ~ N(0, I) and the noise level integrated out. Evidence
and posterior are those of a normal linear model. With strong data one wrong hypothesis would take
all the weight. So the evidence e is tempered: weights are those of e^eta, with eta such that none
exceeds that of "nothing is wrong" by more than e^TEMPER (Grünwald 2012; Miller and Dunson 2019).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from livepde.linalg import Array, IntArray

NU = 10.0  # degrees of freedom of the prior of the noise level
TEMPER = 5.0  # logarithm of the largest ratio of evidences: 3 to 8 do much the same
NOTHING = 0.5  # prior mass on "nothing is wrong"; the rest on single causes and on families alike
LEVEL = 0.95


class Family(NamedTuple):
    """A random error with many amplitudes.

    Attributes
    ----------
    parts
        Columns, and a square root L of the covariance of their amplitudes, (columns, k); several of
        them have the same effect on the readings.
    sizes
        Prior sizes that are tried: the root mean square of what it does to a reading, in standard
        deviations of the noise.
    beside
        Sizes that are tried with each single cause of the same size beside it.
    """

    parts: tuple[tuple[IntArray, Array], ...]
    sizes: tuple[float, ...]
    beside: tuple[float, ...] = ()


class Causes(NamedTuple):
    """Single causes, a column each.

    Attributes
    ----------
    columns
        Their columns, (causes,).
    most
        Largest standard deviation of each amplitude that is plausible, in its own unit, (causes,).
    sizes
        As of a family.
    """

    columns: IntArray
    most: Array
    sizes: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Readings as a linear model of the unknowns and of what may be wrong, in units of the noise.

    Attributes
    ----------
    J, Z, z
        Derivatives by the coordinates xi, effects of the errors, and readings less the prior
        prediction, (readings, p), (readings, columns), (readings,).
    T
        What is asked for, as rows on xi, (numbers, p).
    """

    J: Array
    Z: Array
    z: Array
    T: Array

    @cached_property
    def _known(self) -> tuple[Array, Array]:
        """A^(-1/2) J^T Z and A^(-1/2) J^T z, with A = 1 + J^T J = R^T R."""
        R = scipy.linalg.cholesky(np.eye(self.J.shape[1]) + self.J.T @ self.J)
        both = self.J.T @ np.column_stack([self.Z, self.z])
        left = scipy.linalg.solve_triangular(R, both, trans="T")
        right = scipy.linalg.solve_triangular(R, self.T.T, trans="T")
        return left, right

    @cached_property
    def squares(self) -> Array:
        """Z^T Z."""
        found: Array = self.Z.T @ self.Z
        return found

    @cached_property
    def left(self) -> tuple[Array, Array, float]:
        """Products of Z and z with the unknowns taken out: Z^T P Z, Z^T P z and z^T P z."""
        both, _ = self._known
        taken, rest = both[:, :-1], both[:, -1]
        S = self.squares - taken.T @ taken
        s = self.Z.T @ self.z - taken.T @ rest
        return S, s, float(self.z @ self.z - rest @ rest)

    @cached_property
    def asked(self) -> tuple[Array, Array, Array]:
        """Mean and variance of the numbers if nothing is wrong, and their shifts by errors."""
        both, right = self._known
        shifts: Array = right.T @ both[:, :-1]
        mean: Array = right.T @ both[:, -1]
        return mean, (right**2).sum(axis=0), shifts

    def usual(self, columns: IntArray, root: Array) -> float:
        """Return the root mean square of what amplitudes with a covariance do to a reading."""
        own = self.squares[np.ix_(columns, columns)]
        return math.sqrt(max(float(((own @ root) * root).sum()), 0.0) / len(self.z))


class Mixture(NamedTuple):
    """Normal components of numbers.

    Attributes
    ----------
    weights, means, deviations
        Shapes (components,), (components, numbers), (components, numbers).
    """

    weights: Array
    means: Array
    deviations: Array

    def widened(self, shift: Array) -> Mixture:
        """Return the same numbers with an error of a known size besides, (numbers,)."""
        return self._replace(deviations=np.hypot(self.deviations, shift))

    def quantile(self, share: float) -> Array:
        """Return a quantile of each number."""
        target = scipy.special.ndtri(share)
        ends = self.means + target * self.deviations
        low, high = ends.min(axis=0), ends.max(axis=0)
        for _ in range(60):  # each component has its quantile between the ends
            middle = 0.5 * (low + high)
            below = scipy.special.ndtr((middle - self.means) / self.deviations)
            less = self.weights @ below < share
            low, high = np.where(less, middle, low), np.where(less, high, middle)
        found: Array = 0.5 * (low + high)
        return found

    @property
    def interval(self) -> tuple[Array, Array]:
        """The interval that holds 95 % of each number."""
        return self.quantile(0.5 - 0.5 * LEVEL), self.quantile(0.5 + 0.5 * LEVEL)


class _Axes(NamedTuple):
    """A family in the principal axes of its effect, with a size of one.

    Attributes
    ----------
    effect, along
        Squared effect on the readings, and product with the residuals, of each axis, (k,).
    moved
        Shift of each number by each axis, (numbers, k).
    shared
        Products of each axis with single causes, (k, causes).
    """

    effect: Array
    along: Array
    moved: Array
    shared: Array

    @classmethod
    def of(cls, model: LinearModel, family: Family, columns: IntArray) -> _Axes:
        S, s, _ = model.left
        shifts, blocks, places = model.asked[2], [], []
        for own, root in family.parts:
            usual = model.usual(own, root) * math.sqrt(len(family.parts))
            if usual > 0.0:
                blocks.append(root / usual)
                places.append(own)
        if not blocks:
            nothing = np.zeros(0)
            return cls(nothing, nothing, shifts[:, :0], S[:0][:, columns])
        place, L = np.concatenate(places), scipy.linalg.block_diag(*blocks)
        effect, axes = np.linalg.eigh(L.T @ S[np.ix_(place, place)] @ L)
        L = L @ axes
        shared = L.T @ S[np.ix_(place, columns)]
        return cls(np.maximum(effect, 0.0), L.T @ s[place], shifts[:, place] @ L, shared)


class _Tried(NamedTuple):
    """Hypotheses: sum of squares left, half a determinant, shifts and variances of the numbers.

    Shapes (hypotheses,), (hypotheses,), and (hypotheses, numbers) twice.
    """

    squares: Array
    volume: Array
    shift: Array
    variance: Array


def _alone(model: LinearModel, axes: _Axes, size: float) -> _Tried:
    """Return a family of a size."""
    D = 1.0 + size**2 * axes.effect
    gained = size**2 * axes.along / D
    return _Tried(
        np.array([model.left[2] - float(gained @ axes.along)]),
        np.array([0.5 * float(np.log(D).sum())]),
        -(axes.moved @ gained)[None],
        (axes.moved**2 @ (size**2 / D))[None],
    )


def _beside(model: LinearModel, axes: _Axes, causes: Causes, asked: float) -> _Tried:
    """Return a family of a size together with each of the causes."""
    S, s, _ = model.left
    usual = np.sqrt(np.diag(model.squares)[causes.columns] / len(model.z))
    some = np.flatnonzero(usual > 0.0)
    columns, usual = causes.columns[some], usual[some]
    size = np.minimum(asked, causes.most[some] * usual) / usual
    # The cause is one row more of the matrix, which is diagonal for the family.
    alone, D = _alone(model, axes, asked), 1.0 + asked**2 * axes.effect
    u = asked**2 * axes.shared[:, some] / D[:, None]
    rest = np.maximum(np.diag(S)[columns] - (u * axes.shared[:, some]).sum(axis=0), 0.0)
    kappa = 1.0 + size**2 * rest
    beta = s[columns] - u.T @ axes.along
    moved = model.asked[2][:, columns] - axes.moved @ u
    return _Tried(
        alone.squares - size**2 * beta**2 / kappa,
        alone.volume + 0.5 * np.log(kappa),
        alone.shift - (moved * (size**2 * beta / kappa)).T,
        alone.variance + (moved**2 * (size**2 / kappa)).T,
    )


NO_FAMILY = Family((), ())


def averaged(model: LinearModel, causes: Causes, families: Sequence[Family]) -> Mixture:
    """Return the tempered average over "nothing is wrong", single causes and families."""
    total, (mean, variance, _) = model.left[2], model.asked
    n, none = len(model.z), _Axes.of(model, NO_FAMILY, causes.columns)
    single = [_beside(model, none, causes, size) for size in causes.sizes]
    several = []
    for family in families:
        axes = _Axes.of(model, family, causes.columns)
        several += [_alone(model, axes, size) for size in family.sizes]
        several += [_beside(model, axes, causes, size) for size in family.beside]
    nothing = [_alone(model, none, 0.0)]
    tried = [*nothing, *single, *several]
    squares, volume, shift, more = (np.concatenate(part) for part in zip(*tried, strict=True))
    squares = np.maximum(squares, 0.0)
    told = -0.5 * (NU + n) * np.log((NU + squares) / (NU + total)) - volume
    shares = (NOTHING, 0.5 * (1.0 - NOTHING), 0.5 * (1.0 - NOTHING))
    masses = []
    for share, group in zip(shares, (nothing, single, several), strict=True):
        count = sum(len(one.squares) for one in group)
        masses.append(np.full(count, math.log(share / max(count, 1))))
    prior = np.concatenate(masses)
    excess = float((told + prior).max() - told[0] - prior[0])
    eta = 1.0 if excess <= TEMPER else TEMPER / excess
    tempered = prior + eta * told
    weights = np.exp(tempered - scipy.special.logsumexp(tempered))
    level = np.maximum(1.0, (NU + squares) / (NU + n))
    return Mixture(weights, mean + shift, np.sqrt((variance + more) * level[:, None]))
