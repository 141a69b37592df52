"""Integral observations: fluxes through boundaries, weighted masses, energies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ModelError, ObservationError
from livepde.fem import Field, Form, FunctionSpace, Integrand, Moment, Named, Normal, On
from livepde.linalg import Array
from livepde.observation.operator import Observation, Observed
from livepde.spaces import HilbertSpace

STATE, PARAMETER = "u_", "q_"  # in front of the names of unknowns in the joint space


@dataclass(frozen=True, eq=False)
class Functionals(Observation):
    """Integral observations, z_k = integral of g_k(q, u, x), for any integrand g of a weak form.

    The derivatives in u and q are taken by a complex step, as for `Model`: exact for analytic g.

    Parameters
    ----------
    integrands
        Mapping from sensor name to g(q, u, x), integrated over the mesh, or to `On(name, g)` for a
        boundary or a subdomain. The arguments are those of weak forms: grad(u), x.normal, x.t,
        x.inputs.
    order
        Quadrature order; default that of the state, exact for products of u with fields of q.

    Examples
    --------
    >>> import livepde as lp
    >>> flux = Functionals(
    ...     {"Q": lp.On("right", lambda q, u, x: -q.k * lp.dot(lp.grad(u), x.normal))}, noise=0.01
    ... )
    """

    integrands: Mapping[str, Integrand | On]
    order: int | None = None

    def __post_init__(self) -> None:
        self._sees_all("an integrand names its component, as u.c.")
        if not self.integrands:
            raise ObservationError("Functionals: give at least one integrand.")

    def names(self, count: int) -> tuple[str, ...]:
        return tuple(self.integrands)

    @property
    def portable(self) -> bool:
        return True

    def bind(
        self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace
    ) -> FunctionalsObserved:
        return FunctionalsObserved(self, state, X, parameter)


class FunctionalsObserved(Observed):
    """Bound `Functionals`: each is a form in (u, q) jointly, tested with w = 1."""

    observation: Functionals

    def __init__(
        self,
        observation: Functionals,
        state: FunctionSpace,
        X: HilbertSpace,
        parameter: FunctionSpace,
    ) -> None:
        super().__init__(observation, state, X, parameter)
        # State and parameter form one nonlinear argument, so that one complex step differentiates
        # with respect to both.
        unknowns = {STATE + name: unknown for name, unknown in state.unknowns.items()}
        unknowns |= {PARAMETER + name: unknown for name, unknown in parameter.unknowns.items()}
        spaces = {"w": FunctionSpace.of(Normal(), "w"), "uq": FunctionSpace(unknowns, False)}
        self.forms = [self._form(name, spaces) for name in self.names]

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(len(self.observation.integrands))

    def _form(self, name: str, spaces: Mapping[str, FunctionSpace]) -> Form:
        given, inputs = self.observation.integrands[name], self.observation.inputs
        g, where = (given.form, given.name) if isinstance(given, On) else (given, None)

        def integrand(w: Any, uq: Any, x: Any) -> Any:
            q = _jets(uq, PARAMETER, self.parameter)
            return g(q, _jets(uq, STATE, self.state), x) * w

        form = integrand if where is None else On(where, integrand)
        mesh = next(iter(self.state.fields.values())).field.mesh
        try:
            return Form(name, form, spaces, mesh, self._order, "uq", inputs=inputs)
        except ModelError as error:
            raise ObservationError(f"Functionals, sensor '{name}': {error}") from error

    @property
    def _order(self) -> int:
        if self.observation.order is not None:
            return self.observation.order
        fields = [block.field for block in self.state.fields.values()]
        orders = [_quadrature(field) for field in fields]
        degrees = [int(block.field.element.maxdeg) for block in self.parameter.fields.values()]
        return max(orders) + max(degrees, default=0)

    @property
    def linear(self) -> bool:
        return False

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        uq = np.concatenate([u, q])
        return np.array([form.vector("w", moment, uq=uq)[0] for form in self.forms])

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        uq = np.concatenate([u, q])
        rows = sp.csr_array(
            sp.vstack([form.matrix("w", "uq", moment, uq=uq) for form in self.forms])
        )
        return sp.csr_array(rows[:, : len(u)]), rows[:, len(u) :].toarray()


def _quadrature(field: Field) -> int:
    return 2 * int(field.element.maxdeg) if field.quadrature is None else field.quadrature


def _jets(uq: Any, prefix: str, space: FunctionSpace) -> Any:
    """Return state or parameter in the form of weak-form arguments."""
    jets = {name: getattr(uq, prefix + name) for name in space.names}
    return next(iter(jets.values())) if space.single else Named(**jets)
