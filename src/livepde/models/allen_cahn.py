"""Allen-Cahn: u_t = D lap u + r (u - u^3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.fem import Unknown, dot, grad, hermite
from livepde.model import Model
from livepde.models.common import INITIAL, Number, autonomous, state
from livepde.models.description import Equation, Variable, by_name


def allen_cahn(
    mesh: Any,
    D: Number,
    r: Number,
    u0: Unknown | None = None,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    element: Any = None,
) -> Model:
    """Return u_t - D div(grad u) - r (u - u^3) = 0: two phases, u = 1 and u = -1.

    Parameters
    ----------
    mesh
        Any mesh. A front is about 4 (2 D/r)^(1/2) wide and must be resolved by several cells.
    D
        Diffusivity: unknown or a number.
    r
        Rate of reaction: unknown or a number.
    u0
        Unknown initial state, usually a `Field` on the same mesh; None: given to the `Identifier`.
    dirichlet
        Mapping from boundary to number, function g(x, t), or `Channel`, {} for no flux everywhere;
        None: periodic.
    element
        Element of the state; default cubic Hermite on a line, else first order.
    """
    u = state(mesh, element or hermite(mesh), dirichlet)
    return autonomous(
        u,
        {"D": D, "r": r},
        u0,
        lambda c, u, v: c.D * dot(grad(u), grad(v)) + c.r * (u**3 - u) * v,
        ALLEN_CAHN.written(),
    )


ALLEN_CAHN = Equation(
    name="allen_cahn",
    summary="two phases with a front between them, with unknown initial state",
    formula="u_t = D div(grad u) + r (u - u^3)",
    state=Variable("", "phase, from -1 to 1"),
    unknowns={
        "D": Variable("", "diffusivity"),
        "r": Variable("", "rate of reaction"),
        "u0": INITIAL,
    },
    build=by_name(allen_cahn),
    element=hermite,
    length_unit="",
    time_unit="",
)
