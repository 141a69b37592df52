"""Viscous Burgers: u_t + a u u_x = nu u_xx."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.fem import Unknown, dot, grad, hermite
from livepde.model import Model
from livepde.models.common import INITIAL, Number, autonomous, state
from livepde.models.description import Equation, Variable, by_name


def burgers(
    mesh: Any,
    nu: Number,
    advection: Number = 1.0,
    u0: Unknown | None = None,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    element: Any = None,
) -> Model:
    """Return u_t + a u u_x - nu u_xx = 0 on an interval.

    Parameters
    ----------
    mesh
        `livepde.interval(...)` or `livepde.fem.line(...)`. A shock is about 4 nu/(a jump) wide and
        must be resolved by several cells of the default element.
    nu
        Viscosity: unknown or a number.
    advection
        The coefficient a: unknown or a number.
    u0
        Unknown initial state, usually a `Field` on the same mesh; None: given to the `Identifier`.
    dirichlet
        Mapping from boundary to number, function g(x, t), or `Channel`; None: periodic.
    element
        Element of the state; default cubic Hermite.
    """
    u = state(mesh, element or hermite(mesh), dirichlet)
    return autonomous(
        u,
        {"advection": advection, "nu": nu},
        u0,
        lambda c, u, v: c.advection * u * grad(u)[0] * v + c.nu * dot(grad(u), grad(v)),
        BURGERS.written(),
    )


BURGERS = Equation(
    name="burgers",
    summary="viscous Burgers, periodic or between given values, with unknown initial state",
    formula="u_t + a u u_x = nu u_xx",
    state=Variable("", "velocity"),
    unknowns={
        "nu": Variable("", "viscosity"),
        "advection": Variable("", "coefficient a of the advection; else 1", optional=True),
        "u0": INITIAL,
    },
    build=by_name(burgers),
    element=hermite,
    length_unit="",
    time_unit="",
)
