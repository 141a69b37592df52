"""Thermal response test of a borehole heat exchanger in homogeneous ground."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import pi
from typing import Any

from livepde.fem import Field, On, Place, Unknown, dot, grad, linear
from livepde.model import Model
from livepde.models.common import Number
from livepde.models.description import Equation, Option, Quantity, Variable, closed

__all__ = ["BOREHOLE", "borehole", "fluid"]


def borehole(
    mesh: Any,
    k: Unknown,
    R_b: Unknown,
    *,
    H: float,
    rho_c: Number,
    T0: float,
    element: Any = None,
) -> Model:
    """Return rho_c r T_t - (k r T_r)_r = 0 around a borehole heated by the power Q(t).

    At the wall -2 pi r k H T_r = Q, and T = T0 at the far end. The mean temperature of the fluid is
    T(wall) + R_b Q/H: observe it with `Points({"T": r_wall}, direct={"T": fluid(H)})`.

    Parameters
    ----------
    mesh
        Radius in m, from the wall ("left") to beyond the influence of the test ("right"); best
        graded: `livepde.interval(r_wall, r_far, 40, geometric=True)`.
    k
        Conductivity of the ground in W/(m K).
    R_b
        Resistance between fluid and wall in m K/W. It enters the sensor only, not the PDE.
    H
        Length of the borehole in m.
    rho_c
        Volumetric heat capacity of the ground in J/(m^3 K), known or unknown.
    T0
        Undisturbed temperature in degC.

    The power in W is the input channel "Q".
    """
    # Quadrature of order four integrates the weight r with elements of first order exactly.
    state = Field(mesh, element or linear(mesh), dirichlet={"right": T0}, unit="degC", quadrature=4)
    if isinstance(rho_c, int | float):
        return Model(
            state,
            {"k": k, "R_b": R_b},
            A=lambda q, u, v, x: q.k * x[0] * dot(grad(u), grad(v)),
            M=lambda u, v, x: rho_c * x[0] * u * v,
            f=On("left", lambda x, _: x.inputs["Q"] / (2 * pi * H)),
            inputs=["Q"],
            time_unit="s",
            length_unit="m",
        )
    # The mass term must not contain unknowns, so the equation is divided by the heat capacity.
    return Model(
        state,
        {"k": k, "R_b": R_b, "rho_c": rho_c},
        A=[
            lambda q, u, v, x: q.k / q.rho_c * x[0] * dot(grad(u), grad(v)),
            On("left", lambda q, _, v, x: -x.inputs["Q"] / (2 * pi * H * q.rho_c) * v),
        ],
        M=lambda u, v, x: x[0] * u * v,
        inputs=["Q"],
        time_unit="s",
        length_unit="m",
    )


def fluid(H: float) -> Callable[[Any, Place], Any]:
    """Return the direct part of a fluid temperature sensor, R_b Q/H in addition to T(wall)."""
    return lambda q, x: q.R_b * x.inputs["Q"] / H


def _build(
    mesh: Any, unknowns: Mapping[str, Unknown], dirichlet: Mapping[str, Any], **options: Any
) -> Model:
    """Return the process of a case; an unknown heat capacity replaces the option."""
    known = {name: value for name, value in options.items() if name not in unknowns}
    return closed(borehole, "is heated by the input Q, with T0 far away")(
        mesh, unknowns, dirichlet, **known
    )


BOREHOLE = Equation(
    name="borehole",
    summary="thermal response test: radial conduction around a heated borehole",
    formula="rho_c r T_t = (k r T_r)_r,  -2 pi r k H T_r = Q at the wall,  T = T0 far away",
    state=Variable("degC", "temperature of the ground"),
    unknowns={
        "k": Variable("W/(m K)", "conductivity of the ground"),
        "R_b": Variable("m K/W", "resistance between fluid and wall of the borehole"),
        "rho_c": Variable("J/(m^3 K)", "volumetric heat capacity, instead of the option", True),
    },
    inputs={"Q": Variable("W", "power given to the fluid")},
    options={
        "H": Option("m", "length of the borehole"),
        "rho_c": Option("J/(m^3 K)", "volumetric heat capacity of the ground", 2.3e6),
        "T0": Option("degC", "undisturbed temperature of the ground"),
    },
    quantities={
        "fluid": Quantity(
            "mean temperature of the fluid, T(wall) + R_b Q/H",
            at=lambda left, right: left,
            direct=lambda options: fluid(options["H"]),
        )
    },
    build=_build,
    element=linear,
    spacing="geometric",
)
