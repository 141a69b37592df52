"""Observation of the state on a subdomain omega, or on the whole domain, as in the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Predicate
from livepde.fem.measure import Measure
from livepde.linalg import Array, IntArray, Mask
from livepde.observation.operator import Observation

if TYPE_CHECKING:
    import xarray as xr

# Quadrature order of the points at which the predicate is evaluated. All points are inside the
# element, so that the result does not depend on boundary nodes.
INTERIOR = 3


@dataclass(frozen=True, eq=False)
class Subdomain(Observation):
    """Observation of the state on omega, z = u|_omega (obsdiff), a union of elements.

    An element is part of omega if the predicate holds at its inner quadrature points. The data z
    are the free coefficients of these elements in increasing order (values and slopes for Hermite
    elements), including nodes on the boundary of omega. Coefficients on the Dirichlet boundary are
    known and not part of z.

    Elements that the boundary of omega cuts are excluded. If this strip matters, place mesh nodes
    at the ends of omega: `interval(0, 1, 30, through=(0.3, 0.87))`.

    Examples
    --------
    >>> import livepde as lp
    >>> left = lp.Subdomain(lambda x: x[0] < 0.5, noise=0.1)
    >>> left.noise
    0.1
    """

    omega: Predicate
    nodal = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not callable(self.omega):
            raise ObservationError(
                f"{type(self).__name__}: omega must be a function of x, as lambda x: x[0] < 0.5; "
                f"got {self.omega!r}."
            )

    def elements(self, state: FieldBlock) -> IntArray:
        """Return the indices of the elements in omega."""
        inside = np.zeros(state.field.mesh.nelements, dtype=bool)
        for cells, piece in Measure(state.field.mesh, INTERIOR).pieces():
            x = piece.points
            in_omega = np.broadcast_to(self.omega(x.reshape(len(x), -1)), x[0].size)
            inside[cells] = in_omega.reshape(x.shape[1:]).all(axis=1)
        return np.flatnonzero(inside)

    def region(self, state: FunctionSpace) -> Mask:
        block, _ = state.component(self.of)
        inside = np.zeros(block.field.mesh.nelements, dtype=bool)
        inside[self.elements(block)] = True
        return inside

    def selected(self, state: FieldBlock) -> IntArray:
        """Return the indices of the free coefficients of elements in omega."""
        inside = np.zeros(state.size, dtype=bool)
        inside[state.element_dofs[:, self.elements(state)]] = True
        inside[state.fixed] = False
        free: IntArray = np.flatnonzero(inside)
        if not len(free):
            raise ObservationError(
                "Subdomain: no element of the mesh with a free coefficient lies in omega; check "
                "the predicate and the unit of its coordinates, or refine the mesh."
            )
        return free

    def sample(self, given: Callable[[Array], Any] | xr.DataArray, state: FunctionSpace) -> Array:
        """Return the data z of one or several samples from values in space.

        Elements of first order use the values at nodes, other elements the L2 projection on omega.

        Parameters
        ----------
        given
            Function of x, shape (d, points), that returns a value for each point; for a vector
            field, a row for each component. Or a `DataArray` over the coordinates `x`, `y`, `z` of
            the mesh, which is interpolated linearly. If it has an additional dimension for samples,
            such as time, z has the shape (samples, sensors). Missing values are NaN.
        state
            State space of the model, `model.state_space`.

        Raises
        ------
        ObservationError
            The values have a wrong shape, do not cover omega, or are infinite. For elements that
            are not of first order, a value is NaN.

        Examples
        --------
        >>> import livepde as lp
        >>> from livepde.models import heat
        >>> model = heat(lp.interval(0.0, 1.0, 4), lp.Normal(0.1, std=0.05))
        >>> omega = lp.Subdomain(lambda x: x[0] < 0.5)
        >>> omega.sample(lambda x: 10.0 * x[0], model.state_space)
        array([0. , 2.5, 5. ])
        """
        block, _ = state.component(self.of)
        selected = self.selected(block)
        points, fit = block.fitted(self.elements(block))
        what = f"{type(self).__name__}.sample"
        values: Any
        if callable(given):
            values, many = np.asarray(given(points), dtype=float)[None], False
        else:
            values, many = _interpolated(given, points, what)
        shape = len(block.variables("u")), points.shape[1]
        if shape[0] > 1 and values.shape[1:] != shape:
            raise ObservationError(
                f"{what}: the state is a vector field: give a function of x that returns a row for "
                f"each of {shape[0]} components, shape {shape}."
            )
        try:
            rows = values.reshape(len(values), shape[0], -1)
            values = np.broadcast_to(rows, (len(values), *shape))
        except ValueError:
            raise ObservationError(
                f"{what}: the function returns shape {values.shape[1:]} for x of shape "
                f"{points.shape}; expected one value for each point."
            ) from None
        if np.isinf(values).any() or (not block.nodal and np.isnan(values).any()):
            raise ObservationError(
                f"{what}: a value is not finite. A missing value may be NaN for elements of first "
                "order only."
            )
        z = np.array([fit(sample_values)[selected] for sample_values in values])
        return z if many else z[0]

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        block, _ = state.component(self.of)
        selected = self.selected(block)
        entries = (np.ones(len(selected)), (np.arange(len(selected)), selected))
        return state.widen(sp.csr_array(entries, shape=(len(selected), block.size)), self.of)


def _interpolated(given: Any, points: Array, what: str) -> tuple[Array, bool]:
    """Return values of a DataArray at points, (samples, points), and whether it has samples."""
    import xarray as xr

    axes = ["x", "y", "z"][: len(points)]
    if not isinstance(given, xr.DataArray):
        raise ObservationError(
            f"{what}: got {type(given).__name__}; expected a function of x or a DataArray."
        )
    other_axes = [dimension for dimension in given.dims if dimension not in axes]
    if len(other_axes) > 1 or not all(axis in given.indexes for axis in axes):
        raise ObservationError(
            f"{what}: the DataArray has the dimensions {list(map(str, given.dims))}; expected the "
            f"coordinates {axes}, and at most one dimension more."
        )
    coordinates = {}
    for axis, x in zip(axes, points, strict=True):
        grid = given[axis].values
        low, high = float(grid.min()), float(grid.max())
        tolerance = 1e-9 * (high - low)
        if x.min() < low - tolerance or x.max() > high + tolerance:
            raise ObservationError(
                f"{what}: the DataArray has values for {axis} from {low:g} to {high:g}; they are "
                f"needed from {x.min():g} to {x.max():g}."
            )
        coordinates[axis] = xr.DataArray(np.clip(x, low, high), dims="at the points")
    result = given.interp(coordinates).transpose(*other_axes, "at the points")
    return np.atleast_2d(np.asarray(result.values, dtype=float)), bool(other_axes)


def _everywhere(x: object) -> bool:
    return True


@dataclass(frozen=True, eq=False)
class Full(Subdomain):
    """Observation of the full state, omega = Omega: P is zero except on the Dirichlet boundary.

    Examples
    --------
    >>> import livepde as lp
    >>> whole = lp.Full(noise=0.1)
    >>> whole.noise
    0.1
    """

    omega: Predicate = _everywhere
