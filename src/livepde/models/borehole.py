"""Thermal response tests: radial conduction around a borehole, and a resolved borehole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import log, pi
from typing import Any

import numpy as np

from livepde.errors import ModelError
from livepde.fem import Field, On, Place, Scalar, Unknown, declared, dot, grad, linear
from livepde.model import Model
from livepde.models.description import (
    Equation,
    Number,
    Option,
    Quantity,
    Variable,
    around_axis,
    by_name,
    one_number,
)

# Time in units of r^2/diffusivity after which the error of a line source is at most 2.5 %; after 5
# it is at most 10 % (S. Gehlin, Thermal Response Test, Lulea 2002).
SETTLED = 20.0


def borehole(
    mesh: Any, k: Unknown, R_b: Unknown, *, H: float, rho_c: Number, T0: float, element: Any = None
) -> Model:
    """Return rho_c r T_t - (k r T_r)_r = 0 around a borehole heated by the power Q(t).

    At the wall, -2 pi r k H T_r = Q; at the far end, T = T0. The power in W is the input channel
    "Q". The mean temperature of the fluid, T(wall) + R_b Q/H, is observed by
    `Points({"T": r_wall}, direct={"T": fluid(H)})`.

    Parameters
    ----------
    mesh
        Radius in m, from the wall ("left") to beyond the influence of the test ("right"),
        preferably graded: `livepde.interval(r_wall, r_far, 40, geometric=True)`.
    k
        Conductivity of the ground in W/(m K).
    R_b
        Resistance between fluid and wall in m K/W. It is part of the sensor, not of the PDE.
    H
        Length of the borehole in m.
    rho_c
        Volumetric heat capacity of the ground in J/(m^3 K), known or unknown.
    T0
        Undisturbed temperature in degC.

    Raises
    ------
    ModelError
        rho_c is an unknown that varies in space.
    """
    one_number("borehole", rho_c=rho_c)
    ends = {"right": T0}
    state = Field(mesh, element or linear(mesh), dirichlet=ends, unit="degC", weight=around_axis)
    if isinstance(rho_c, int | float):
        return Model(
            state,
            {"k": k, "R_b": R_b},
            A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)),
            M=lambda u, v, x: rho_c * u * v,
            f=On("left", lambda x, _: _heating(x, H)),
            inputs={"Q": "W"},
            **BOREHOLE.about(),
        )
    # The mass term must not contain unknowns, so the equation is divided by the heat capacity.
    return Model(
        state,
        {"k": k, "R_b": R_b, "rho_c": rho_c},
        A=[
            lambda q, u, v, x: q.diffusivity * dot(grad(u), grad(v)),
            On("left", lambda q, _, v, x: -_heating(x, H) * q.per_capacity * v),
        ],
        coefficients=lambda q: {"diffusivity": q.k / q.rho_c, "per_capacity": 1 / q.rho_c},
        inputs={"Q": "W"},
        **BOREHOLE.about(),
    )


def _heating(x: Place, H: float) -> Any:
    """Return the heat flux through the wall, in W/m^2."""
    return x.inputs["Q"] / (2 * pi * H * x[0])


def fluid(H: float) -> Callable[[Any, Place], Any]:
    """Return the direct part of a fluid temperature sensor: R_b Q/H, which is added to T(wall)."""
    return lambda q, x: q.R_b * x.inputs["Q"] / H


HEATED = "is heated by the input Q, with T0 far away"

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
    build=by_name(borehole, HEATED),
    element=linear,
    spacing="geometric",
    omits="The equation omits the heat that fluid and grout store, which `equation = "
    '"grouted_borehole"` contains.',
    settles=lambda values, r_wall: SETTLED * r_wall**2 * values["rho_c"] / values["k"],
)


def grouted_borehole(
    mesh: Any,
    k: Unknown,
    rho_c: Unknown,
    R_b: Unknown,
    share: Unknown,
    *,
    H: float,
    r_p: float,
    r_b: float,
    C_f: float,
    C_p: float,
    C_g: float,
    T0: float,
    C_c: float = 0.0,
) -> Model:
    """Return conduction from the fluid of a heated borehole into the ground around it.

    The pipes of a U-tube are represented by one pipe of an equivalent radius r_p,

        fluid    C_f T_t = Q/H - (T - T(r_p))/R_p                       R_p = share R_b
        grout    C_g r T_t = (k_g r T_r)_r,       r_p < r < r_b         ln(r_b/r_p)/(2 pi k_g) =
        ground   rho_c r T_t = (k r T_r)_r,       r_b < r                        (1 - share) R_b

    and T = T0 at the right end. The state at the left end of the mesh is the temperature of the
    fluid. On a two-dimensional mesh, radius times height, heat also flows along the borehole. The
    bottom is the plane of its end, where the ground has T0, and the top is the plane of its middle.
    The power in W, the input channel "Q", is distributed evenly, and the mean over "left" is the
    temperature of the fluid.

    All unknowns are positive: use `LogNormal`, and `LogitNormal` for the share.

    To allow for an unknown capacity of the ground, its radii are replaced by a coordinate x that
    measures heat content: x^2 - r_b^2 = (rho_c/rho_0) (r^2 - r_b^2), with the prior centre rho_0.
    In x the capacity is known, and the conductivity is k (rho_c/rho_0) r^2/x. The right end in r
    depends on rho_c. A source that is added there is per heat content of rho_0.

    Parameters
    ----------
    mesh
        Radius in m, preferably graded: `livepde.interval(0.9 * r_p, r_far, 60, geometric=True)`.
        It starts slightly below r_p, with the fluid; the nodes next to r_p and r_b are moved there.
        Or radius and height in m, `livepde.fem.grid(r, z)` with z from 0 to H/2, graded to 0.
    k
        Conductivity of the ground in W/(m K).
    rho_c
        Volumetric heat capacity of the ground in J/(m^3 K), one number.
    R_b
        Resistance between fluid and wall of the borehole in m K/W.
    share
        Share of R_b that is due to the pipes (film and wall). The rest is due to the grout.
    H
        Length of the borehole in m.
    r_p, r_b
        Equivalent radius of the pipes, and radius of the borehole in m. Two pipes of diameter d
        with axes at a distance s have the equivalent radius sqrt(d s/2) (Gu and O'Neal 1998).
    C_f, C_p, C_c
        Heat capacities per metre of borehole, in J/(m K): of everything within r_p, including the
        fluid, of the walls of the pipes, and of a casing at r_b.
    C_g
        Volumetric heat capacity of the grout in J/(m^3 K).
    T0
        Undisturbed temperature.

    Raises
    ------
    ModelError
        The radii are not inside the mesh in this order, or rho_c is not one number.
    """
    if not isinstance(heat := declared(rho_c), Scalar):
        raise ModelError("grouted_borehole: rho_c must be one number: a prior, or a Scalar.")
    layered = _layered(mesh, r_p, r_b)
    thickness, around, rho_0 = r_p - float(mesh.p[0].min()), log(r_b / r_p), heat.prior.centre
    cold = {name: T0 for name in ("right", "end") if name in layered.boundaries}
    state = Field(layered, linear(layered), dirichlet=cold, unit="degC", weight=around_axis)

    def pipes(q: Any, u: Any, v: Any, x: Place) -> Any:
        return thickness / (2 * pi * q.share * q.R_b) * _outwards(u, v) / x[0]

    def grout(q: Any, u: Any, v: Any, x: Place) -> Any:
        return around / (2 * pi * (1 - q.share) * q.R_b) * dot(grad(u), grad(v))

    def ground(q: Any, u: Any, v: Any, x: Place) -> Any:
        # Weak form in the coordinate x, see the docstring.
        ratio, radial = q.rho_c / rho_0, _outwards(u, v)
        square = r_b**2 + (x[0] ** 2 - r_b**2) / ratio
        tangential = dot(grad(u), grad(v)) - radial
        return q.k * (ratio * square / x[0] ** 2 * radial + tangential / ratio)

    return Model(
        state,
        {"k": k, "rho_c": rho_c, "R_b": R_b, "share": share},
        A=[On("pipes", pipes), On("grout", grout), On("ground", ground)],
        M=[
            On("left", lambda u, v, x: C_f / (2 * pi * x[0]) * u * v),
            On("pipes", lambda u, v, x: C_p / (2 * pi * thickness * x[0]) * u * v),
            On("grout", lambda u, v, x: C_g * u * v),
            On("wall", lambda u, v, x: C_c / (2 * pi * x[0]) * u * v),
            On("ground", lambda u, v, x: rho_0 * u * v),
        ],
        f=On("left", lambda x, _: _heating(x, H)),
        inputs={"Q": "W"},
        **GROUTED_BOREHOLE.about(),
    )


def _outwards(u: Any, v: Any) -> Any:
    """Return the radial part u_r v_r of the gradient product."""
    return grad(u)[0] * grad(v)[0]


def _layered(mesh: Any, r_p: float, r_b: float) -> Any:
    """Return the mesh with nodes at both radii and names for its layers.

    The names are the subdomains "pipes", "grout" and "ground", the boundary "wall" at r_b, and in
    two dimensions the boundary "end", the bottom of the ground.
    """
    points = mesh.p.copy()
    radii = points[0]
    first, last = float(radii.min()), float(radii.max())
    # The nearest nodes are moved to the radii, so that layers end at nodes: a coefficient that
    # jumps inside a cell would reduce the order of convergence.
    inner, wall = (float(radii[np.abs(radii - r).argmin()]) for r in (r_p, r_b))
    if not first < r_p < r_b < last or not first < inner < wall < last:
        raise ModelError(
            f"grouted_borehole: the radii r_p = {r_p:g} m and r_b = {r_b:g} m must lie inside "
            f"the mesh, {first:g} to {last:g} m, in different cells: let it start a little below "
            "r_p, and use more cells or geometric spacing."
        )
    points[0] = np.where(radii == inner, r_p, np.where(radii == wall, r_b, radii))
    fitted = replace(mesh, doflocs=points)
    ends = fitted.p[:, fitted.facets]
    boundaries = {"wall": np.flatnonzero(np.isclose(ends[0], r_b).all(axis=0))}
    if len(points) > 1:
        bottom = np.isclose(ends[1], points[1].min()).all(axis=0)
        boundaries["end"] = np.flatnonzero(bottom & (ends[0].mean(axis=0) > r_b))
    return fitted.with_boundaries(boundaries).with_subdomains(
        {
            "pipes": lambda x: x[0] < r_p,
            "grout": lambda x: (x[0] > r_p) & (x[0] < r_b),
            "ground": lambda x: x[0] > r_b,
        }
    )


GROUTED_BOREHOLE = Equation(
    name="grouted_borehole",
    summary="thermal response test with fluid, pipes, grout and ground",
    formula="C_f T_t = Q/H - (T - T(r_p))/R_p,  C_g r T_t = (k_g r T_r)_r,  "
    "rho_c r T_t = (k r T_r)_r,  T = T0 far away",
    state=Variable("degC", "temperature: of the fluid at the left end, then of grout and ground"),
    unknowns={
        "k": Variable("W/(m K)", "conductivity of the ground"),
        "rho_c": Variable("J/(m^3 K)", "volumetric heat capacity of the ground"),
        "R_b": Variable("m K/W", "resistance between fluid and wall of the borehole"),
        "share": Variable("", "part of R_b that the pipes make", transform="logit"),
    },
    inputs={"Q": Variable("W", "power given to the fluid")},
    options={
        "H": Option("m", "length of the borehole"),
        "r_p": Option("m", "radius of the pipes, as one pipe"),
        "r_b": Option("m", "radius of the borehole"),
        "C_f": Option("J/(m K)", "heat capacity of fluid and all else within r_p, for each metre"),
        "C_p": Option("J/(m K)", "heat capacity of the walls of the pipes, for each metre"),
        "C_c": Option("J/(m K)", "heat capacity of a casing, for each metre", 0.0),
        "C_g": Option("J/(m^3 K)", "volumetric heat capacity of the grout"),
        "T0": Option("degC", "undisturbed temperature of the ground"),
    },
    build=by_name(grouted_borehole, HEATED),
    element=linear,
    spacing="geometric",
)
