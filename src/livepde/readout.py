"""Marginals of unknowns, and the numbers of all scalar unknowns as one row."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.fem import FunctionSpace, Normal
from livepde.laws import Belief
from livepde.linalg import Array
from livepde.verdict import FLAT, Finding, at_bound, flat

LEVEL = 0.95


class ScalarReadout:
    """Function that returns the numbers of scalar unknowns, in the order of `Layout.numbers`.

    Results equal those of `Belief` and `Scalar.interval` to the last bit. Interval ends of many
    beliefs are computed together, since the cost of a call exceeds the cost of its arithmetic.
    """

    def __init__(self, space: FunctionSpace) -> None:
        rows = list(space.labels.values())
        consecutive = bool(rows) and rows == list(range(rows[0], rows[0] + len(rows)))
        self._rows: Any = slice(rows[0], rows[-1] + 1) if consecutive else rows
        self._unknowns = [space.unknown_of(label) for label in space.labels]
        self._prior: tuple[Array | None, list[float]] = (None, [])

    def __call__(self, beliefs: Sequence[Belief]) -> Array:
        """Return the numbers of all scalar unknowns for each belief, shape (beliefs, numbers).

        They are value, standard deviation, interval ends and ratio to the prior deviation.
        """
        if not (self._unknowns and beliefs):
            return np.empty((len(beliefs), 0))
        read = [(belief.q[self._rows], *self._deviations(belief)) for belief in beliefs]
        columns: list[Array] = []
        # Contiguous rows, one for each unknown: NumPy may round strided numbers differently.
        rows = (np.array(part).T.copy() for part in zip(*read, strict=True))
        for unknown, value, std, share in zip(self._unknowns, *rows, strict=True):
            ends = () if unknown.prior.symmetric else unknown.interval(value, std, LEVEL)
            columns += (value, std, *ends, share)
        return np.stack(columns, axis=1)

    def _deviations(self, belief: Belief) -> tuple[list[float], list[float]]:
        """Return standard deviations, and their ratios to prior standard deviations."""
        factor, unknown = belief.q_factor, [math.nan] * len(self._unknowns)
        if factor is None:
            return unknown, unknown
        # Rows of a column-major matrix are summed in another order and round differently.
        rows = factor[self._rows]
        without_rest = np.sqrt(np.add.reduce(rows * rows, axis=1))
        std = without_rest
        if not factor.flags.c_contiguous:
            std = np.sqrt(np.add.reduce(factor * factor, axis=1))[self._rows]
        if belief.rest is not None:
            std = np.hypot(std, belief.rest[self._rows])
        if belief.prior_factor is None:
            return std.tolist(), unknown
        if self._prior[0] is not belief.prior_factor:
            self._prior = belief.prior_factor, self._prior_deviations(belief.prior_factor)
        pairs = zip(without_rest.tolist(), self._prior[1], strict=True)
        return std.tolist(), [share / before for share, before in pairs]

    def _prior_deviations(self, prior: Array) -> list[float]:
        """Return prior standard deviations, NaN where they are zero."""
        deviations = np.linalg.norm(prior[self._rows], axis=1)
        positive: list[float] = np.where(deviations > 0.0, deviations, np.nan).tolist()
        return positive


@dataclass(frozen=True, eq=False)
class Marginal:
    """Marginal distribution of an unknown in an estimate: Gaussian in its latent value.

    `median`: a number, or for a field an array of coefficients.
    `deviation`: standard deviation to first order: latent standard deviation times the slope of the
    transform at the median; NaN for a law without covariance.
    `unknown`: the unknown with its prior.
    """

    median: Any
    deviation: Any
    unknown: Any = field(repr=False)
    _read: Callable[[ArrayLike], Marginal] | None = field(default=None, repr=False)

    def at(self, points: ArrayLike) -> Marginal:
        """Return the marginals of the values of a field at points.

        `points`: coordinates of one or more points: a number or shape (points,) on an interval,
        otherwise shape (d,) or (points, d).

        Returns
        -------
        marginals
            Marginal whose median, deviation, mean, std and intervals have a number for each point,
            or for a vector field a row of components.

        Raises `ConfigurationError`: the unknown is a number, or the estimate was pickled.
        Raises `ObservationError`: a point is outside the mesh.

        Examples
        --------
        >>> import livepde as lp
        >>> from livepde.models import heat
        >>> model = heat(lp.interval(0.0, 1.0, 20), lp.Normal(0.1, std=0.05))
        >>> rod = lp.Identifier(model, lp.Points({"middle": 0.5}, noise=0.1), u0=20.0)
        >>> estimate = rod.step(0.1, [20.0])
        >>> estimate["u"].at([0.25, 0.5]).mean.round(3)
        array([20., 20.])
        """
        if self._read is None:
            raise ConfigurationError("at: only a field has values at points; this is a number.")
        return self._read(points)

    @property
    def mean(self) -> Any:
        """Mean: equal to the median of a `Normal`, larger for a `LogNormal`."""
        return self._moments[0]

    @property
    def std(self) -> Any:
        """Standard deviation: equal to `deviation` of a `Normal`, larger for a `LogNormal`."""
        return self._moments[1]

    @cached_property
    def _moments(self) -> tuple[Any, Any]:
        mean, std = self.unknown.prior.moments(self.median, self.deviation)
        return (float(mean), float(std)) if isinstance(self.median, float) else (mean, std)

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Return the ends of the central interval with probability `level`.

        They are within the bounds of the unknown, asymmetric for a `LogNormal` or `LogitNormal`,
        and NaN for a law without covariance.
        """
        low, high = self.unknown.interval(self.median, self.deviation, level)
        return (float(low), float(high)) if isinstance(self.median, float) else (low, high)

    def __str__(self) -> str:
        """Return mean and standard deviation, or median and 95 % interval under a transform.

        For a law without covariance, only the value is returned.
        """
        if not isinstance(self.median, float):
            return repr(self)
        if np.isnan(self.deviation):
            return f"{self.median:.4g}"
        if isinstance(self.unknown.prior, Normal):
            return f"{self.mean:.4g} ± {self.std:.2g}"
        low, high = self.interval()
        return f"{self.median:.4g} (95 %: {low:.4g} to {high:.4g})"


def known_badly(belief: Belief, space: FunctionSpace) -> Iterator[Finding]:
    """Yield findings on scalar unknowns that are not identifiable or at a bound."""
    for label, row in space.labels.items():
        unknown, value = space.unknown_of(label), float(belief.q[row])
        lower, upper = map(float, unknown.prior.bounds)
        if value in (lower, upper):
            yield at_bound(label, value)
        left = float(belief.left([row])[0])
        if left > FLAT and not unknown.evolution.moves:
            yield flat(label, left)


def marginals_at(
    name: str,
    points: ArrayLike,
    space: FunctionSpace,
    coefficients: Array,
    deviation: Callable[[Any, slice], Array | None],
) -> Marginal:
    """Return the marginals of the values of a field of a space at points.

    `deviation`: function (rows, part) -> standard deviation of rows @ coefficients[part], or None.
    """
    block, part, unknown = space.fields[name], space.part(name), space.unknown_of(name)
    at, single = coordinates_of(points, len(block.box[0]), name)
    rows = block.probe(at, f"estimate['{name}'].at: point")
    values, std = rows @ coefficients[part], deviation(rows, part)
    std = np.full_like(values, np.nan) if std is None else std
    shape = () if single else (at.shape[1],)
    if block.vector:
        values, std = (x.reshape(-1, at.shape[1]).T for x in (values, std))
        shape = (*shape, values.shape[1])
    if not shape:
        return Marginal(float(values[0]), float(std[0]), unknown)
    return Marginal(values.reshape(shape), std.reshape(shape), unknown)


def coordinates_of(points: ArrayLike, axes: int, name: str) -> tuple[Array, bool]:
    """Return coordinates of points, shape (axes, points), and whether they are a single point."""
    try:
        array = np.asarray(points, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros((0, 0, 0))
    single = array.ndim == 0 or (array.ndim == 1 and axes > 1)
    columns = array.reshape(-1, 1) if axes == 1 and array.ndim < 2 else np.atleast_2d(array)
    if columns.ndim != 2 or columns.shape[1] != axes:
        shapes = "(points,)" if axes == 1 else f"({axes},) or (points, {axes})"
        raise ConfigurationError(
            f"estimate['{name}'].at: got points {points!r:.60}; expected numbers, shape {shapes}."
        )
    return columns.T, single
