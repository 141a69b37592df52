"""Heat conduction, or any diffusion: u_t = div(alpha grad u)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.fem import Field, Unknown, dot, grad, linear
from livepde.model import Model
from livepde.models.base import Equation, Variable

__all__ = ["HEAT", "heat"]


def heat(
    mesh: Any,
    alpha: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    element: Any = None,
    unit: str = "degC",
) -> Model:
    """Return u_t - div(alpha grad u) = 0 in any dimension, with unknown diffusivity alpha.

    Parameters
    ----------
    mesh
        Any mesh of scikit-fem, or `livepde.interval(...)`; coordinates in m.
    alpha
        Diffusivity in m^2/s: a `Scalar`, a `Piecewise` by layer, or a `Field`.
    dirichlet
        Boundary -> number, function g(x, t), or `Channel`. Boundaries without one are insulated.
    element
        Element of the state; default of first order.
    unit
        Unit of u.

    >>> import livepde as lp
    >>> model = heat(lp.interval(0, 1, 10), lp.Scalar(5e-7, 2e-7), {"left": lp.Channel("T0")})
    >>> model.channels
    ('T0',)
    """
    state = Field(mesh, element or linear(mesh), dirichlet=dict(dirichlet or {}), unit=unit)
    return Model(
        state,
        {"alpha": alpha},
        A=lambda q, u, v, x: q.alpha * dot(grad(u), grad(v)),
        time_unit="s",
    )


def _build(mesh: Any, unknowns: Mapping[str, Unknown], dirichlet: Mapping[str, Any]) -> Model:
    return heat(mesh, unknowns["alpha"], dirichlet)


HEAT = Equation(
    name="heat",
    summary="heat conduction without sources; unknown diffusivity",
    formula="u_t = div(alpha grad u)",
    state=Variable("degC", "temperature"),
    unknowns={"alpha": Variable("m^2/s", "diffusivity: a number, by layer, or a field")},
    build=_build,
    element=linear,
)
