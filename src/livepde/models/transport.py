"""Tracer transport in a soil column: advection and dispersion, with or without immobile water."""

from __future__ import annotations

from typing import Any

import numpy as np

from livepde.errors import ModelError
from livepde.fem import Channel, Field, On, Unknown, grad, linear
from livepde.model import Model
from livepde.models.description import Equation, Option, Variable, closed

INLETS = ("flux", "fixed")


def advection_dispersion(
    mesh: Any,
    D: Unknown,
    v: Unknown,
    *,
    R: float = 1.0,
    decay: float = 0.0,
    inlet: str = "flux",
    element: Any = None,
    unit: str = "",
) -> Model:
    """Return R c_t = D c_xx - v c_x - decay c in a column with inflow on the left.

    The inflow concentration is the channel "c_in". With inlet = "flux" the tracer enters with the
    water, v c - D c_x = v c_in (third type; c is the concentration in the column); with "fixed" c =
    c_in (first type). On the right the tracer leaves with the water, c_x = 0: if the front does not
    reach this end, the column is semi-infinite as in the analytic solutions (Toride, Leij, van
    Genuchten 1999, CXTFIT 2.1, USDA Research Report 137).

    Parameters
    ----------
    mesh
        Depth in cm, from "left" to "right".
    D, v
        Coefficient of dispersion in cm^2/h and pore velocity in cm/h: numbers, or by layer.
    R
        Retardation factor.
    decay
        Rate of decay in 1/h.
    inlet
        "flux" or "fixed".
    element
        Element of the state; default of first order.
    unit
        Unit of c.

    Raises
    ------
    ModelError
        R is below 1, or the inlet is unknown.
    """
    _check("advection_dispersion", inlet, R)
    state = _column(mesh, inlet, element, unit)

    # Advection and dispersion are integrated by parts together, so that the natural condition is
    # the third type: a given total flux v c - D c_x.
    def flux(q: Any, c: Any, w: Any, x: Any) -> Any:
        return (q.D * grad(c)[0] - q.v * c) * grad(w)[0]

    return Model(
        state,
        {"D": D, "v": v},
        A=[flux, *_ends(lambda q: q.v, lambda u: u, inlet)],
        B=lambda c, w, x: decay * c * w,
        M=lambda c, w, x: R * c * w,
        inputs=["c_in"],
        time_unit="h",
        length_unit="cm",
        formula=ADVECTION_DISPERSION.written(),
    )


def mobile_immobile(
    mesh: Any,
    D: Unknown,
    v: Unknown,
    phi: Unknown,
    omega: Unknown,
    *,
    inlet: str = "flux",
    element: Any = None,
    unit: str = "",
) -> Model:
    """Return dispersion in mobile water c with first-order exchange with immobile water s.

        phi c_t = phi D c_xx - v c_x - omega (c - s)
        (1 - phi) s_t = omega (c - s)

    (Coats and Smith 1964; van Genuchten and Wierenga 1976). Sensors name their component, as in
    `Points([11.0], of="c")`. For omega -> infinity this is `advection_dispersion` with phi D.

    Parameters
    ----------
    mesh, inlet, element, unit
        As for `advection_dispersion`, with the same channel "c_in".
    D
        Coefficient of dispersion in the mobile water, cm^2/h.
    v
        Mean pore velocity in cm/h: flux over total water content. The mobile water moves at v/phi.
    phi
        Mobile share of the water, in (0, 1): a `LogitNormal`.
    omega
        Rate of exchange in 1/h.

    Raises
    ------
    ModelError
        The inlet is unknown.
    """
    _check("mobile_immobile", inlet)

    # The equations are divided by phi and 1 - phi: the mass form is free of unknowns.
    def transport(q: Any, u: Any, w: Any, x: Any) -> Any:
        return (q.D * grad(u.c)[0] - q.velocity * u.c) * grad(w.c)[0]

    def exchange(q: Any, u: Any, w: Any, x: Any) -> Any:
        return (u.c - u.s) * (q.into_mobile * w.c - q.into_immobile * w.s)

    return Model(
        {
            "c": _column(mesh, inlet, element, unit),
            "s": Field(mesh, element or linear(mesh), unit=unit),
        },
        {"D": D, "v": v, "phi": phi, "omega": omega},
        A=[transport, exchange, *_ends(lambda q: q.velocity, lambda u: u.c, inlet)],
        coefficients=lambda q: {
            "velocity": q.v / q.phi,
            "into_mobile": q.omega / q.phi,
            "into_immobile": q.omega / (1 - q.phi),
        },
        inputs=["c_in"],
        time_unit="h",
        length_unit="cm",
        formula=MOBILE_IMMOBILE.written(),
    )


def _check(name: str, inlet: str, R: float = 1.0) -> None:
    if inlet not in INLETS:
        raise ModelError(f"{name}: inlet='{inlet}'; expected one of {', '.join(INLETS)}.")
    if not (np.isfinite(R) and R >= 1):
        raise ModelError(f"{name}: the retardation factor R must be at least 1; got {R}.")


def _column(mesh: Any, inlet: str, element: Any, unit: str) -> Field:
    dirichlet = {"left": Channel("c_in")} if inlet == "fixed" else {}
    return Field(mesh, element or linear(mesh), dirichlet=dirichlet, unit=unit)


def _ends(velocity: Any, solute: Any, inlet: str) -> list[On]:
    """Return the boundary terms of inflow on the left and outflow on the right."""
    # With c_x = 0 the total flux on the right is v c; that on the left is v c_in.
    out = On("right", lambda q, u, w, x: velocity(q) * solute(u) * solute(w))
    into = On("left", lambda q, _, w, x: -velocity(q) * x.inputs["c_in"] * solute(w))
    return [out, into] if inlet == "flux" else [out]


COLUMN = {
    "D": Variable("cm^2/h", "coefficient of dispersion: a number, or by layer"),
    "v": Variable("cm/h", "mean pore velocity"),
}
INFLOW = {"c_in": Variable("", "concentration that flows in")}
FED = "is fed by the input c_in"
INLET = Option("", "what the inflow prescribes", "flux", INLETS)

ADVECTION_DISPERSION = Equation(
    name="advection_dispersion",
    summary="a tracer in a column of soil that is fed on the left",
    formula="R c_t = D c_xx - v c_x - decay c,  v c - D c_x = v c_in on the left",
    state=Variable("", "concentration, relative to that of the feed"),
    unknowns=COLUMN,
    inputs=INFLOW,
    options={
        "R": Option("", "retardation factor", 1.0),
        "decay": Option("1/h", "rate of decay", 0.0),
        "inlet": INLET,
    },
    build=closed(advection_dispersion, FED),
    element=linear,
    length_unit="cm",
    time_unit="h",
)
"""Advection-dispersion."""

MOBILE_IMMOBILE = Equation(
    name="mobile_immobile",
    summary="a tracer in a column of soil with partly immobile water",
    formula="phi c_t = phi D c_xx - v c_x - omega (c - s),  (1 - phi) s_t = omega (c - s)",
    state=Variable("", "concentration in the mobile (c) and the immobile water (s)"),
    unknowns={
        **COLUMN,
        "phi": Variable("", "share of the water that moves", transform="logit"),
        "omega": Variable("1/h", "rate of exchange"),
    },
    inputs=INFLOW,
    options={"inlet": INLET},
    build=closed(mobile_immobile, FED),
    element=linear,
    components=("c", "s"),
    length_unit="cm",
    time_unit="h",
)
"""Advection-dispersion with an immobile zone."""
