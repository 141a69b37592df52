"""Combinations of sensors, calibrated instruments, and nonlinear sensor characteristics.

Nonlinear observations are z = g(G_0 u). The paper takes G linear "for simplicity of exposition.
Most of what follows can be carried over to the case of nonlinear observations" (section 2). The
derivative is G'(u) = diag(g'(G_0 u)) G_0. If g' does not vanish, G'(u) and G_0 have the same null
space, and thus the same R and P. The observed part of the state is a step of Newton's method from
the last estimate u^,

    u_alpha = R u^ - G'(u^)^+ (G(u^) - z) = G_0^+ (y - (g(y) - z)/g'(y)),    y = G_0 u^.

It equals R u* up to the square of the error R (u^ - u*), and G^+ z if g is linear. The square
enters the law through B(w) with two derivatives, as noise does. Therefore the step is repeated a
few times for each sensor, without P u^. The sensitivity law predicts with g and linearises about
its prediction, H = G'(u) L.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FunctionSpace, Moment, Place, SensorState, Unknown, numbers
from livepde.fem.fields import STEP, stepped_by
from livepde.linalg import Array, Mask
from livepde.observation.operator import Direct, Observation, Observed
from livepde.spaces import HilbertSpace


@dataclass(frozen=True, eq=False)
class Combined(Observation):
    """Concatenation of several kinds of sensors.

    The names of all sensors in `parts` must differ. `noise` and `unit` are given either for each
    part, or here for all sensors.

    Examples
    --------
    >>> import livepde as lp
    >>> sensors = Combined(
    ...     [lp.Points({"T_1": 0.3}, noise=0.1), lp.Averages({"wall": "right"}, noise=0.5)]
    ... )
    """

    parts: Sequence[Observation]
    listed = ("parts", "observation")

    def __post_init__(self) -> None:
        self._refuse_component("give of= to the observations it is made of.")
        super().__post_init__()
        if self.noise is not None and any(part.noise is not None for part in self.parts):
            raise ObservationError("Combined: give noise= to it or to its parts, not to both.")
        self._reads(name for part in self.parts for name in part.inputs)

    @property
    def optional(self) -> frozenset[str]:
        required = {name for part in self.parts for name in set(part.inputs) - part.optional}
        return frozenset().union(*(part.optional for part in self.parts)) - required

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        unknowns: dict[str, Unknown] = {}
        for part in self.parts:
            if shared := unknowns.keys() & part.unknowns.keys():
                raise ObservationError(
                    f"Combined: two parts have the unknown '{min(shared)}'; put their sensors "
                    "together."
                )
            unknowns |= part.unknowns
        return unknowns

    @property
    def states(self) -> Mapping[str, SensorState]:
        return {name: item for part in self.parts for name, item in part.states.items()}

    @property
    def nodal(self) -> bool:
        return all(part.nodal for part in self.parts)

    def region(self, state: FunctionSpace) -> Mask | None:
        parts = [part.region(state) for part in self.parts]
        regions = [part for part in parts if part is not None]
        return np.logical_or.reduce(regions) if len(regions) == len(parts) else None

    @property
    def portable(self) -> bool:
        return all(part.portable for part in self.parts)

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        return CombinedObserved(self, state, X, parameter)


class CombinedObserved(Observed):
    """Bound `Combined` observation: readings, matrices and noise of its parts are stacked."""

    observation: Combined

    def _prepare(self) -> None:
        spaces = self.state, self.X, self.parameter
        self.parts = [part.bind(*spaces) for part in self.observation.parts]
        ends = np.cumsum([0] + [part.size for part in self.parts])
        self.slices = [slice(a, b) for a, b in pairwise(ends)]

    def _names(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.names)

    @property
    def places(self) -> Mapping[str, Array]:
        return {name: at for part in self.parts for name, at in part.places.items()}

    @property
    def units(self) -> tuple[str, ...]:
        if self.observation.unit:
            return super().units
        return tuple(unit for part in self.parts for unit in part.units)

    @cached_property
    def noise(self) -> Array | None:
        stated = super().noise
        if stated is not None:
            return stated
        levels = [part.noise for part in self.parts]
        given = [level for level in levels if level is not None]
        return np.concatenate(given) if len(given) == len(levels) else None

    @cached_property
    def G(self) -> sp.csr_array:
        return sp.csr_array(sp.vstack([part.G for part in self.parts]))

    @property
    def linear(self) -> bool:
        return all(part.linear for part in self.parts)

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        return np.concatenate([part.predict(u, q, moment) for part in self.parts])

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        pairs = [part.jacobian(u, q, moment) for part in self.parts]
        H_u = sp.csr_array(sp.vstack([pair[0] for pair in pairs]))
        if all(pair[1] is None for pair in pairs):
            return H_u, None
        H_q = np.zeros((self.size, self.parameter.dim))
        for rows, (_, direct) in zip(self.slices, pairs, strict=True):
            if direct is not None:
                H_q[rows] = direct
        return H_u, H_q

    def available(self, moment: Moment) -> Array:
        return np.concatenate([part.available(moment) for part in self.parts])

    def linearised(self, z: Array, u: Array) -> Array:
        parts = zip(self.parts, self.slices, strict=True)
        return np.concatenate([part.linearised(z[rows], u) for part, rows in parts])


Calibration = Callable[[Array, Any, Place], Any]
"""(y, q, x) -> readings, all of shape (sensors,)."""


@dataclass(frozen=True, eq=False)
class Calibrated(Observation):
    """Instruments with unknown gain, offset or contact resistance: a function of base readings.

        z = function(y, q, x),      y = readings of `base`

    Parameters
    ----------
    base
        The underlying sensors: any observation, including `Combined`, without `noise`.
    function
        (y, q, x) -> readings of shape (sensors,). y are base readings of shape (sensors,). q are
        the scalar unknowns: q.gain, or q.k[1] and q.offset["T_10"] for unknowns by region or name.
        x has x.t and x.inputs["Q"].
    derivatives
        (y, q, x) -> derivatives of the function by y, shape (sensors,), and by unknowns, {"gain":
        shape (sensors,)}. It requires that each reading depends only on its own y. Default: a
        complex step, exact for analytic functions, with one call for each sensor and unknown.
    adds
        Whether the function only adds unknowns to the readings, at all times. Laws then require no
        derivatives in each step.

    Examples
    --------
    >>> import livepde as lp
    >>> sensors = Calibrated(lp.Points([0.3, 0.7]), lambda y, q, x: q.gain * y, noise=0.01)
    """

    base: Observation
    function: Calibration
    derivatives: Callable[[Array, Any, Place], tuple[Array, Mapping[str, Array]]] | None = None
    adds: bool = False

    def __post_init__(self) -> None:
        self._refuse_component("give of= to the observations it is made of.")
        self._add_base_channels(self.base)

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        return self.base.unknowns

    @property
    def states(self) -> Mapping[str, SensorState]:
        return self.base.states

    @property
    def optional(self) -> frozenset[str]:
        return self.base.optional

    @property
    def portable(self) -> bool:
        return self.base.portable

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        return CalibratedObserved(self, state, X, parameter)


class CalibratedObserved(Observed):
    """Bound `Calibrated` observation: derivatives by the chain rule."""

    observation: Calibrated
    linear = False

    def _prepare(self) -> None:
        self.base = self.observation.base.bind(self.state, self.X, self.parameter)

    def _names(self) -> tuple[str, ...]:
        return self.base.names

    @property
    def units(self) -> tuple[str, ...]:
        return super().units if self.observation.unit else self.base.units

    @property
    def places(self) -> Mapping[str, Array]:
        return self.base.places

    def _read(self, y: Any, q: Any, moment: Moment) -> Any:
        # A calibration may use time and inputs, but no coordinates.
        place = Place(np.zeros((0,)), None, moment)
        z = np.asarray(self.observation.function(y, numbers(self.parameter, q), place))
        if z.shape != (self.size,):
            raise ObservationError(
                f"Calibrated: function gave shape {z.shape} for {self.size} sensors; it must "
                f"return one reading for each of {list(self.names)}."
            )
        return z

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        z: Array = self._read(self.base.predict(u, q, moment), q, moment).astype(float)
        z[np.logical_not(self.available(moment))] = np.nan
        return z

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        # H_u = (dz/dy) (dy/du) and H_q = dz/dq + (dz/dy) (dy/dq), column by column.
        y = self.base.predict(u, q, moment)
        available = self.available(moment)
        inner_u, inner_q = self.base.jacobian(u, q, moment)
        if (derivatives := self.observation.derivatives) is not None:
            named = numbers(self.parameter, q)
            slopes, columns = derivatives(y, named, Place(np.zeros((0,)), None, moment))
            slopes = np.where(available, slopes, 0.0)
            H_q = np.zeros((self.size, self.parameter.dim))
            for label, column in columns.items():
                H_q[available, self.parameter.labels[label]] = column[available]
            if inner_q is not None:
                H_q += slopes[:, None] * inner_q
            scaled = copy(inner_u)  # SciPy's constructor would dominate the cost
            scaled.data = inner_u.data * np.repeat(slopes, np.diff(inner_u.indptr))
            return scaled, H_q
        slope = np.zeros((self.size, self.size))
        for k in np.flatnonzero(available):
            slope[available, k] = self._slope(_nudged(y, int(k)), q, moment)[available]
        H_q = np.zeros((self.size, self.parameter.dim))
        for j in self.parameter.labels.values():
            H_q[available, j] = self._slope(y, _nudged(q, j), moment)[available]
        if inner_q is not None:
            H_q += slope @ inner_q
        return sp.csr_array(sp.csr_array(slope) @ inner_u), H_q

    @property
    def steady_matrix(self) -> sp.csr_array:
        return self.base.steady_matrix

    def steady_direct(self, moment: Moment) -> Array | None:
        base = self.base.observation
        plain = type(self.base) is Observed and not (base.directs or base.inputs)
        if not (self.observation.adds and plain):
            return None
        if self._steady_direct is None:
            zero, q = np.zeros(self.state.dim), self.parameter.prior
            direct = self.jacobian(zero, q, moment)[1]
            y, increment = np.arange(1.0, 1.0 + self.size), np.linspace(0.5, 1.5, len(q))
            shift = 0.0 if direct is None else direct @ (q + increment)
            if not np.allclose(self._read(y, q + increment, moment), y + shift):
                raise ObservationError(
                    "Calibrated: adds=True, but function does more than to add unknowns to the "
                    "readings. Leave out adds."
                )
            self._steady_direct = direct
        return self._steady_direct

    def _slope(self, y: Any, q: Any, moment: Moment) -> Array:
        return np.asarray(np.imag(self._read(y, q, moment)) / STEP)

    def available(self, moment: Moment) -> Array:
        available = self.base.available(moment)
        if available.all():
            return available
        # A reading that depends on a missing base reading is also missing.
        z = self._read(np.where(available, 1.0, np.nan), self.parameter.prior, moment)
        return np.asarray(np.logical_and(available, np.logical_not(np.isnan(z))))


def _nudged(values: Array, k: int) -> Any:
    """Return values with a complex step in one of them."""
    nudged: Any = values.astype(complex)
    nudged[k] += 1j * STEP
    return nudged


Reading = Callable[[Array], Array]
"""Sensor characteristic: true values (sensors,) -> readings (sensors,), elementwise."""


@dataclass(frozen=True, eq=False)
class Transformed(Observation):
    """Sensors with a pointwise nonlinear characteristic, z_k = g_k((G_0 u)_k).

    The function g need not be monotone. If g' = 0 at the estimate, a sensor has no information and
    counts as missing in `GradientLaw`.

    Parameters
    ----------
    base
        G_0: `Points`, `Averages`, `Subdomain`, ..., without `noise`. Its `unit` is not used.
    function
        g, elementwise from values of shape (sensors,) to readings of the same shape.
    derivative
        g', with the same shape; by default a complex step (for analytic g).
    iterations
        Number of Newton steps of `GradientLaw` from the last estimate.
    reach
        Maximum length of a Newton step in y = G_0 u, for strongly curved g far from the truth.

    Notes
    -----
    `noise` is the noise of the readings z. A `reconstruction` that uses a noise level acts on the
    linearised data y + (z - g(y))/g'(y), whose noise is larger by the factor 1/g'(y).

    Examples
    --------
    >>> import livepde as lp
    >>> pyrometers = Transformed(lp.Points([0.3, 0.6]), lambda T: T**4, noise=0.01)
    """

    base: Observation
    function: Reading
    derivative: Reading | None = None
    iterations: int = 5
    reach: float = np.inf

    def __post_init__(self) -> None:
        self._refuse_component("give of= to the observations it is made of.")
        self._add_base_channels(self.base)
        if self.base.unknowns:
            raise ObservationError(
                "Transformed: its base has uncertain positions; write the function into "
                "Calibrated, which keeps them."
            )
        if self.iterations < 1:
            raise ObservationError(
                f"Transformed: iterations must be at least 1; got {self.iterations}."
            )
        if not self.reach > 0:
            raise ObservationError(f"Transformed: reach must be positive; got {self.reach}.")

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        return self.base.matrix(state)

    def names(self, count: int) -> tuple[str, ...]:
        return self.base.names(count)

    @property
    def directs(self) -> Mapping[str, Direct]:
        return self.base.directs

    @property
    def states(self) -> Mapping[str, SensorState]:
        return self.base.states

    @property
    def places(self) -> Array | None:
        return self.base.places

    @property
    def nodal(self) -> bool:
        return self.base.nodal

    def region(self, state: FunctionSpace) -> Mask | None:
        return self.base.region(state)

    @property
    def portable(self) -> bool:
        return self.base.portable

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        return TransformedObserved(self, state, X, parameter)

    def read(self, y: Array) -> Array:
        """Return g(y)."""
        z = np.asarray(self.function(y), dtype=float)
        if z.shape != y.shape:
            raise ObservationError(
                f"Transformed: function gave shape {z.shape} for values of shape {y.shape}; it "
                "must act on each sensor by itself."
            )
        return z

    def slope(self, y: Array) -> Array:
        """Return g'(y)."""
        if self.derivative is not None:
            slope = np.asarray(self.derivative(y), dtype=float)
        else:
            stepped: Any = y + 1j * STEP
            slope = stepped_by(lambda: self.function(stepped), "Transformed: function")
        return np.broadcast_to(slope, y.shape)


class TransformedObserved(Observed):
    """Bound `Transformed` sensors: G is the linear part G_0; readings and derivatives use g."""

    observation: Transformed

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        return self.observation.read(super().predict(u, q, moment))

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        slope = self.observation.slope(super().predict(u, q, moment))
        direct = self._direct(moment)
        H_u = sp.csr_array(sp.diags_array(slope) @ self.G)
        return H_u, None if direct is None else slope[:, None] * direct

    def linearised(self, z: Array, u: Array) -> Array:
        sensors, y = self.observation, np.asarray(self.G @ u)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(sensors.iterations):
                step = (z - sensors.read(y)) / sensors.slope(y)
                step[np.isinf(step)] = np.nan  # an insensitive sensor has no information
                # Steps may be large if g' is small, so `reach` limits them.
                y = y + np.clip(step, -sensors.reach, sensors.reach)
        return y
