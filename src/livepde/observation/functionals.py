"""Integral observations: fluxes, weighted masses, energies; and heat-flux plates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ModelError, ObservationError
from livepde.fem import FieldBlock, Form, FunctionSpace, Integrand, Moment, Named, Normal, On
from livepde.fem.field_blocks import base_name
from livepde.fem.fields import placed
from livepde.fem.measure import Measure
from livepde.fem.space import LocalSpace
from livepde.linalg import Array
from livepde.observation.operator import Observation, Observed
from livepde.spaces import HilbertSpace

STATE, PARAMETER = "u_", "q_"  # prefixes of the names of unknowns in the joint space


@dataclass(frozen=True, eq=False)
class Functionals(Observation):
    """Integral observations, z_k = integral of g_k(q, u, x), for any integrand g of a weak form.

    Derivatives in u and q use a complex step, as in `Model`, which is exact for analytic g.
    Integrals use the volume element of the state (`Field.weight`).

    Parameters
    ----------
    integrands
        Mapping from sensor name to g(q, u, x), integrated over the mesh, or to `On(name, g)` for a
        boundary or a subdomain. The arguments are those of weak forms: grad(u), x.normal, x.t,
        x.inputs.
    order
        Quadrature order. The default is exact for products of u with fields of q.

    Examples
    --------
    >>> import livepde as lp
    >>> flux = Functionals(
    ...     {"Q": lp.On("right", lambda q, u, x: -q.k * lp.dot(lp.grad(u), x.normal))}, noise=0.01
    ... )
    """

    integrands: Mapping[str, Integrand | On]
    order: int | None = None
    portable = True
    listed = ("integrands", "integrand")

    def __post_init__(self) -> None:
        self._refuse_component("an integrand names its component, as u.c.")
        super().__post_init__()

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        return FunctionalsObserved(self, state, X, parameter)


class FunctionalsObserved(Observed):
    """Bound `Functionals`: each sensor is a form in (u, q), tested with w = 1."""

    observation: Functionals
    linear = False

    def _prepare(self) -> None:
        # State and parameter form one nonlinear argument, so that one complex step differentiates
        # with respect to both.
        unknowns = {STATE + name: unknown for name, unknown in self.state.unknowns.items()}
        unknowns |= {PARAMETER + name: item for name, item in self.parameter.unknowns.items()}
        spaces = {"w": FunctionSpace.of(Normal(), "w"), "uq": FunctionSpace(unknowns, False)}
        self.forms = [self._form(name, spaces) for name in self.observation.integrands]

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(len(self.observation.integrands))

    def _form(self, name: str, spaces: Mapping[str, FunctionSpace]) -> Form:
        inputs = self.observation.inputs
        g, region = placed(self.observation.integrands[name])

        def integrand(w: Any, uq: Any, x: Any) -> Any:
            q = _jets(uq, PARAMETER, self.parameter)
            return g(q, _jets(uq, STATE, self.state), x) * w

        form = integrand if region is None else On(region, integrand)
        try:
            return Form(name, form, spaces, self.state.mesh, self._order, "uq", inputs=inputs)
        except ModelError as error:
            raise ObservationError(f"Functionals, sensor '{name}': {error}") from error

    @property
    def _order(self) -> int:
        if self.observation.order is not None:
            return self.observation.order
        fields = [block.field for block in self.state.fields.values()]
        degrees = [int(block.field.element.maxdeg) for block in self.parameter.fields.values()]
        return max(field.order for field in fields) + max(degrees, default=0)

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        uq = np.concatenate([u[: self.state.seen], q])
        return np.array([form.vector("w", moment, uq=uq)[0] for form in self.forms])

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        size = self.state.seen
        uq = np.concatenate([u[:size], q])
        rows = sp.csr_array(
            sp.vstack([form.matrix("w", "uq", moment, uq=uq) for form in self.forms])
        )
        zeros = sp.csr_array((rows.shape[0], len(u) - size))
        H = sp.csr_array(sp.hstack([rows[:, :size], zeros], format="csr"))
        return H, rows[:, size:].toarray()


def _jets(uq: Any, prefix: str, space: FunctionSpace) -> Any:
    """Return state or parameter as an argument of a weak form."""
    names = (name for name in space.names if name not in space.sensors)
    jets = {name: getattr(uq, prefix + name) for name in names}
    return next(iter(jets.values())) if space.single else Named(**jets)


def in_cells(parameter: FunctionSpace, mesh: Any, name: str) -> sp.csr_array:
    """Return the matrix from q to the mean of an unknown over each cell, shape (cells, m)."""
    if name not in parameter.names:
        raise ObservationError(
            f"FluxPlates: the model has no unknown '{name}'; it has {list(parameter.names)}. Set "
            "conductivity to the name of the unknown coefficient."
        )
    measure = Measure(mesh, 2)
    local = LocalSpace(parameter, measure)
    cells, count = measure.shape
    shares = measure.weights / measure.weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(cells), count)
    means = sp.csr_array((shares.ravel(), (rows, np.arange(cells * count))))
    size, start = cells * count, 0
    matrix = sp.csr_array((cells, parameter.dim))
    for key, part in zip(parameter.blocks, local.locals, strict=True):
        if base_name(key) == name:
            matrix = matrix + means @ local.evaluation[start * size : (start + 1) * size]
        start += part.components
    return sp.csr_array(matrix)


@dataclass(frozen=True, eq=False)
class FluxPlates(Observation):
    """Flux sensors in one dimension, z_k = -D u_x at x_k, such as heat-flux plates.

    At a named end, flux **into** the domain is positive; at a position, flux towards larger x.

    Parameters
    ----------
    points
        Sensor name -> the name of an end of the mesh ("left"), or a position.
    conductivity
        Name of the unknown D: one number, one for each layer, or a field.

    Notes
    -----
    The flux is interpolated linearly between the centres of cells, where the slope of the state is
    most accurate. It is of second order, also at an end or where D jumps between cells.

    Raises
    ------
    ObservationError
        There is no sensor. On binding: the mesh is not an interval, a position is outside the mesh
        or at its right end, or the model lacks the unknown D.

    Examples
    --------
    >>> plates = FluxPlates({"q_inside": "left", "q_middle": 0.12}, noise=0.3, unit="W/m^2")
    """

    points: Mapping[str, float | str]
    conductivity: str = "k"
    portable = True
    listed = ("points", "place")

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        return FluxPlatesObserved(self, state, X, parameter)


class FluxPlatesObserved(Observed):
    """Bound `FluxPlates`: z = W (D q * S u), with means D q and slopes S u in cells."""

    observation: FluxPlates
    linear = False

    def _prepare(self) -> None:
        observation, state, parameter = self.observation, self.state, self.parameter
        block = observation.scalar_block(state)
        if len(block.field.mesh.p) != 1:
            raise ObservationError(
                "FluxPlates requires a mesh of one dimension; use Functionals with an integral "
                "over a boundary."
            )
        ends = np.sort(block.field.mesh.p[0][block.field.mesh.t], axis=0)
        order = np.argsort(ends[0])
        ends = ends[:, order]
        middles = ends.mean(axis=0)
        if len(middles) < 2:
            raise ObservationError("FluxPlates requires a mesh of two cells or more.")
        values = block.probe(ends.reshape(1, -1))
        slopes = sp.diags_array(1.0 / np.diff(ends, axis=0)[0]) @ (
            values[len(middles) :] - values[: len(middles)]
        )
        self._slopes = state.widen(sp.csr_array(slopes), observation.of)
        self._D = in_cells(parameter, block.field.mesh, observation.conductivity)[order]
        self._weights = np.array(
            [self._row(block, middles, name, at) for name, at in observation.points.items()]
        )

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(len(self.observation.points))

    @staticmethod
    def _row(block: FieldBlock, middles: Array, name: str, at: float | str) -> Array:
        """Return the weights of the fluxes at the centres of all cells, shape (cells,)."""
        mesh, sign = block.field.mesh, -1.0
        low, high = float(mesh.p.min()), float(mesh.p.max())
        if isinstance(at, str):
            facets = (mesh.boundaries or {}).get(at)
            if facets is None:
                names = sorted(mesh.boundaries or {})
                raise ObservationError(
                    f"FluxPlates: '{name}' is at '{at}'; the mesh names {names}."
                )
            place = float(mesh.p[0][mesh.facets[0][np.asarray(facets)]].mean())
            if place not in (low, high):
                raise ObservationError(f"FluxPlates: '{name}' is at '{at}', which is not an end.")
            # Flux into the domain is towards smaller x at the right end.
            sign = -1.0 if place == low else 1.0
        else:
            place = float(at)
        if not low <= place <= high:
            raise ObservationError(
                f"FluxPlates: '{name}' is at {place:g}, outside the mesh from {low:g} to {high:g}."
            )
        if place == high and not isinstance(at, str):
            raise ObservationError(
                f"FluxPlates: '{name}' is at {place:g}, the end of the mesh; give the name of "
                "this end, where a flux into the domain is positive."
            )
        k = int(np.clip(np.searchsorted(middles, place) - 1, 0, len(middles) - 2))
        share = (place - middles[k]) / (middles[k + 1] - middles[k])
        row = np.zeros(len(middles))
        row[k], row[k + 1] = sign * (1.0 - share), sign * share
        return row

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        return np.asarray(self._weights @ ((self._D @ q) * (self._slopes @ u)))

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        H_u = sp.csr_array(self._weights * (self._D @ q)) @ self._slopes
        H_q = (self._weights * (self._slopes @ u)) @ self._D
        return sp.csr_array(H_u), np.asarray(H_q)
