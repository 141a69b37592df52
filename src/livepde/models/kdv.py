"""Korteweg-de Vries equation: u_t + a u u_x + b u_xxx = 0, periodic."""

from __future__ import annotations

from typing import Any

from livepde.fem import Unknown, grad, hess, smooth
from livepde.model import Model
from livepde.models.common import INITIAL, Number, autonomous, state
from livepde.models.description import Equation, Variable, closed


def kdv(mesh: Any, advection: Number, dispersion: Number, u0: Unknown | None = None) -> Model:
    """Return the Korteweg-de Vries equation u_t + a u u_x + b u_xxx = 0 on a periodic interval.

    The weak form -b (u_xx, v_x) needs elements of class C^1: cubic Hermite. Use the scheme
    `Alexander2`, which hardly damps resolved waves; implicit Euler damps solitons.

    Parameters
    ----------
    mesh
        `livepde.interval(...)`, with its ends identified.
    advection, dispersion
        The coefficients a and b: unknown or numbers.
    u0
        Unknown initial state, usually a `Field` on the same mesh; None: given to the `Identifier`.
    """
    u = state(mesh, smooth(mesh), None)
    # Integration by parts is applied once to the third derivative, so that second derivatives of u
    # remain: hence C^1 elements.
    return autonomous(
        u,
        {"advection": advection, "dispersion": dispersion},
        u0,
        lambda c, u, v: (
            c.advection * u * grad(u)[0] * v - c.dispersion * hess(u)[0, 0] * grad(v)[0]
        ),
        KDV.written(),
    )


KDV = Equation(
    name="kdv",
    summary="Korteweg-de Vries on a ring, with unknown initial state",
    formula="u_t + a u u_x + b u_xxx = 0",
    state=Variable("", "height of the wave"),
    unknowns={
        "advection": Variable("", "coefficient a of u u_x", transform=""),
        "dispersion": Variable("", "coefficient b of u_xxx", transform=""),
        "u0": INITIAL,
    },
    build=closed(kdv, "is periodic"),
    element=smooth,
    length_unit="",
    time_unit="",
)
