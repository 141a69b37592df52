"""Kuramoto-Sivashinsky equation: u_t + a u u_x + b u_xx + c u_xxxx = 0, periodic."""

from __future__ import annotations

from typing import Any

from livepde.fem import Unknown, grad, hess, smooth
from livepde.model import Model
from livepde.models.common import INITIAL, Number, autonomous, state
from livepde.models.description import Equation, Variable, closed


def kuramoto_sivashinsky(
    mesh: Any,
    advection: Number,
    instability: Number,
    damping: Number,
    u0: Unknown | None = None,
) -> Model:
    """Return u_t + a u u_x + b u_xx + c u_xxxx = 0 on a periodic interval.

    Waves longer than 2 pi (c/b)^(1/2) grow, shorter ones decay. The dynamics are chaotic, and state
    errors grow quickly, so the state must be observed at several points and at short intervals.

    Parameters
    ----------
    mesh
        `livepde.interval(...)`, with its ends identified.
    advection, instability, damping
        The coefficients a, b and c: unknown or numbers.
    u0
        Unknown initial state; None: given to the `Identifier`.
    """
    u = state(mesh, smooth(mesh), None)
    return autonomous(
        u,
        {"advection": advection, "instability": instability, "damping": damping},
        u0,
        lambda c, u, v: (
            c.advection * u * grad(u)[0] * v
            - c.instability * grad(u)[0] * grad(v)[0]
            + c.damping * hess(u)[0, 0] * hess(v)[0, 0]
        ),
        KURAMOTO_SIVASHINSKY.written(),
    )


KURAMOTO_SIVASHINSKY = Equation(
    name="kuramoto_sivashinsky",
    summary="Kuramoto-Sivashinsky (chaotic) on a ring, with unknown initial state",
    formula="u_t + a u u_x + b u_xx + c u_xxxx = 0",
    state=Variable("", "velocity of the front"),
    unknowns={
        "advection": Variable("", "coefficient a of u u_x", transform=""),
        "instability": Variable("", "coefficient b of u_xx", transform=""),
        "damping": Variable("", "coefficient c of u_xxxx", transform=""),
        "u0": INITIAL,
    },
    build=closed(kuramoto_sivashinsky, "is periodic"),
    element=smooth,
    length_unit="",
    time_unit="",
)
