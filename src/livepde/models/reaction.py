"""The paper's example: diffusion with an unknown reaction coefficient (section 4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.fem import Field, Unknown, dot, grad, hermite
from livepde.model import Model, Source
from livepde.models.description import Equation, Option, Variable, by_name


def reaction_diffusion(
    mesh: Any,
    q: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    D: Any = 1.0,
    f: Source = 0.0,
    element: Any = None,
) -> Model:
    """Return u_t - div(D grad u) + q u = f with unknown q, dimensionless.

    Parameters
    ----------
    mesh
        Any mesh of scikit-fem, or `livepde.interval(...)`.
    q
        Reaction coefficient, usually a `Field`.
    dirichlet
        Mapping from boundary to number, function g(x, t), or `Channel`; default zero on all
        boundaries.
    D
        Diffusivity: a number or a function of x.
    f
        Source density: a number or f(x, t).
    element
        Element of the state; default cubic Hermite on a line, as in the paper, else first order.
    """
    values = {"boundary": 0.0} if dirichlet is None else dict(dirichlet)
    state = Field(mesh, element or hermite(mesh), dirichlet=values)
    diffusivity = D if callable(D) else lambda x: D
    return Model(
        state,
        {"q": q},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: diffusivity(x) * dot(grad(u), grad(v)),
        f=f,
        formula=REACTION_DIFFUSION.written(),
    )


REACTION_DIFFUSION = Equation(
    name="reaction_diffusion",
    summary="the paper's example: unknown reaction coefficient, no units",
    formula="u_t - div(D grad u) + q u = f",
    state=Variable("", "state"),
    unknowns={"q": Variable("", "reaction coefficient", transform="")},
    options={"D": Option("", "diffusivity", 1.0), "f": Option("", "source density", 0.0)},
    build=by_name(reaction_diffusion),
    element=hermite,
    length_unit="",
    time_unit="",
)
