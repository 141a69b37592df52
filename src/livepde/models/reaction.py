"""Reaction and diffusion: the paper's example, Fisher-KPP, porous Fisher, Allen-Cahn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from livepde.errors import ModelError, require_positive
from livepde.fem import Field, Source, Unknown, dot, grad, hermite, linear, positive
from livepde.model import Model
from livepde.models.description import (
    INITIAL,
    Equation,
    Number,
    Option,
    Variable,
    autonomous,
    by_name,
    everywhere,
    state,
)


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
    q
        Reaction coefficient, usually a `Field`.
    dirichlet
        See `heat`; default zero on all boundaries.
    D
        Diffusivity: a number or a function of x.
    f
        Source density: a number or f(x, t).
    element
        Element of the state; default cubic Hermite on an interval (as in the paper) or first order.
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
        **REACTION_DIFFUSION.about(),
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


def fisher_kpp(
    mesh: Any,
    D: Unknown,
    r: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    K: float = 1.0,
    element: Any = None,
    unit: str = "1/mm^2",
) -> Model:
    """Return u_t = div(D grad u) + r u (1 - u/K) with unknown D and r (Fisher 1937, KPP 1937).

    Parameters
    ----------
    mesh, dirichlet, element, unit
        See `heat`, with coordinates in mm. Boundaries without a value have no flux.
    D, r
        Diffusivity in mm^2/d and growth rate in 1/d: numbers, by region, or fields.
    K
        Carrying capacity: the density at which growth ends, in the unit of u.

    Examples
    --------
    >>> import livepde as lp
    >>> D, r = lp.LogNormal(0.01, 0.01), lp.LogNormal(1.0, 0.5)
    >>> fisher_kpp(lp.interval(0.0, 1.9, 38), D, r, K=1700.0).affine
    False
    """
    require_positive("fisher_kpp: the carrying capacity K", K, ModelError)
    everywhere("fisher_kpp", mesh, D=D)
    return Model(
        _state(mesh, dirichlet, element, unit),
        {"D": D, "r": r},
        A=lambda q, u, v, x: q.D * dot(grad(u), grad(v)) - q.r * u * (1 - u / K) * v,
        **FISHER_KPP.about(),
    )


def porous_fisher(
    mesh: Any,
    D: Unknown,
    r: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    K: float = 1.0,
    m: float = 1.0,
    element: Any = None,
    unit: str = "1/mm^2",
) -> Model:
    """Return u_t = div(D (u/K)^m grad u) + r u (1 - u/K): Gurney and Nisbet (1975).

    The diffusivity is zero for negative u, which only discretisation errors can cause.

    Parameters
    ----------
    mesh, D, r, dirichlet, K, element, unit
        See `fisher_kpp`; D is the diffusivity at u = K.
    m
        Exponent, at least 1.

    Raises
    ------
    ModelError
        m is below 1, so that the derivative of the diffusivity at u = 0 is infinite, or K is not
        positive.
    """
    require_positive("porous_fisher: the carrying capacity K", K, ModelError)
    if not (np.isfinite(m) and m >= 1):
        raise ModelError(f"porous_fisher: the exponent m must be at least 1; got {m}.")

    return Model(
        _state(mesh, dirichlet, element, unit),
        {"D": D, "r": r},
        # `positive` keeps the equation parabolic if discretisation errors make u negative.
        A=lambda q, u, v, x: (
            q.D * positive(u / K) ** m * dot(grad(u), grad(v)) - q.r * u * (1 - u / K) * v
        ),
        **POROUS_FISHER.about(),
    )


def _state(mesh: Any, dirichlet: Mapping[str, Any] | None, element: Any, unit: str) -> Field:
    element = element or linear(mesh)
    # The quadrature is exact for u^2 v.
    order = 3 * int(element.maxdeg)
    return Field(mesh, element, dirichlet=dict(dirichlet or {}), unit=unit, quadrature=order)


DENSITY = Variable("1/mm^2", "density of the population")
CAPACITY = Option("1/mm^2", "carrying capacity: the density at which growth ends")
RATE = Variable("1/d", "growth rate at low density")

FISHER_KPP = Equation(
    name="fisher_kpp",
    summary="a population that spreads by diffusion and grows logistically",
    formula="u_t = div(D grad u) + r u (1 - u/K)",
    state=DENSITY,
    unknowns={"D": Variable("mm^2/d", "diffusivity: a number, by layer, or a field"), "r": RATE},
    options={"K": CAPACITY},
    build=by_name(fisher_kpp),
    element=linear,
    length_unit="mm",
    time_unit="d",
)

POROUS_FISHER = Equation(
    name="porous_fisher",
    summary="a population that spreads the faster the denser it is, and grows logistically",
    formula="u_t = div(D (u/K)^m grad u) + r u (1 - u/K)",
    state=DENSITY,
    unknowns={"D": Variable("mm^2/d", "diffusivity at u = K"), "r": RATE},
    options={"K": CAPACITY, "m": Option("", "exponent of the diffusivity, at least 1", 1.0)},
    build=by_name(porous_fisher),
    element=linear,
    length_unit="mm",
    time_unit="d",
)


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
        Any mesh. Several cells must resolve a front, whose width is about 4 (2 D/r)^(1/2).
    D, r
        Diffusivity and rate of reaction: unknowns or numbers.
    u0
        See `burgers`.
    dirichlet
        See `heat`. {}: no flux on all boundaries; None: periodic.
    element
        Element of the state; by default cubic Hermite on an interval, otherwise first order.
    """
    u = state(mesh, element or hermite(mesh), dirichlet)
    return autonomous(
        u,
        {"D": D, "r": r},
        u0,
        lambda c, u, v: c.D * dot(grad(u), grad(v)) + c.r * (u**3 - u) * v,
        ALLEN_CAHN.about(),
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
