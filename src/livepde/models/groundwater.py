"""Flow and transport in the ground: aquifers, pumping tests, tracers in a soil column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import pi
from typing import Any

import numpy as np

from livepde.errors import ModelError, require_positive
from livepde.fem import Channel, Field, On, Piecewise, Place, Unknown, dot, grad, linear
from livepde.linalg import Array
from livepde.model import Model
from livepde.models.description import (
    Equation,
    Number,
    Option,
    Variable,
    around_axis,
    by_name,
    everywhere,
    one_number,
)


def pumping_test(
    mesh: Any,
    k: Unknown,
    Ss: Unknown,
    leakance: Unknown | None = None,
    *,
    b: float,
    element: Any = None,
) -> Model:
    """Return Ss r s_t - (k r s_r)_r + r leakance s/b = 0 for the drawdown around a well.

    At the wall of the well, -2 pi r b k s_r = Q; at the far end, s = 0. For a small radius and a
    constant rate, this is the problem of Theis (1935), s = Q/(4 pi k b) E1(r^2 Ss/(4 k t)). With a
    leaky layer above, it is the problem of Hantush and Jacob (1955). The rate Q is the input
    channel "Q" in m^3/s, positive for extraction. It may vary (step tests, recovery). The unknowns
    are positive: use `LogNormal`.

    Parameters
    ----------
    mesh
        Radius in m, from the wall ("left") to beyond the influence of the test ("right"), a few
        times sqrt(4 k t/Ss). Grade it: `livepde.interval(0.1, 5000.0, 80, geometric=True)`.
    k
        Hydraulic conductivity in m/s.
    Ss
        Specific storage in 1/m.
    leakance
        Vertical conductivity over thickness of a leaky layer above, in 1/s: the inverse of its
        resistance. Without it, the aquifer is confined.
    b
        Thickness of the aquifer in m. With 1 m, the unknowns are transmissivity and storativity.

    Raises
    ------
    ModelError
        The thickness is not positive, or Ss is an unknown that varies in space.
    """
    one_number("pumping_test", Ss=Ss)
    everywhere("pumping_test", mesh, k=k)
    require_positive("pumping_test: b, the thickness,", b, ModelError)
    ends = {"right": 0.0}
    state = Field(mesh, element or linear(mesh), dirichlet=ends, unit="m", weight=around_axis)
    terms: list[Any] = [
        lambda q, u, v, x: q.diffusivity * dot(grad(u), grad(v)),
        On("left", lambda q, _, v, x: -x.inputs["Q"] / (2 * pi * b * x[0]) * q.per_storage * v),
    ]
    unknowns = {"k": k, "Ss": Ss}
    if leakance is not None:
        unknowns["leakance"] = leakance
        terms.append(lambda q, u, v, x: q.leaked * u * v)

    def coefficients(q: Any) -> dict[str, Any]:
        values = {"diffusivity": q.k / q.Ss, "per_storage": 1 / q.Ss}
        return values if leakance is None else {**values, "leaked": q.leakance / (b * q.Ss)}

    return Model(
        state,
        unknowns,
        A=terms,
        coefficients=coefficients,
        inputs={"Q": "m^3/s"},
        **PUMPING_TEST.about(unknowns),
    )


def groundwater(
    mesh: Any,
    T: Unknown,
    S: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    wells: Mapping[str, Sequence[float]] | None = None,
    radius: float = 1.0,
    recharge: float = 0.0,
    element: Any = None,
) -> Model:
    """Return S h_t - div(T grad h) = recharge - sum of Q_w delta_w for the head h of an aquifer.

    The equation is divided by S, so that the storativity may also be unknown. Each well is a
    smooth, round source (see `well`). The head equals the head of a point source only beyond its
    radius, so place no sensor inside. T and S are positive: use `LogNormal`.

    Parameters
    ----------
    mesh, element
        See `heat`; the mesh is two-dimensional.
    T
        Transmissivity in m^2/s: a number, by region, or a `Field`.
    S
        Storativity, dimensionless: a number or a `Field`. A `Piecewise` would violate the water
        balance at jumps of S.
    dirichlet
        See `heat`; heads in m. Other boundaries have no flow.
    wells
        Mapping from name to (x, y). The name is the input channel of the rate in m^3/s, positive
        for extraction.
    radius
        Radius of the source of a well in m: at least the diameter of the cells around it.
    recharge
        Recharge from above, in m/s.

    Raises
    ------
    ModelError
        A well is outside the mesh or in cells wider than its radius, or S is a `Piecewise`.

    Examples
    --------
    >>> import livepde as lp
    >>> mesh = lp.rectangle((-50.0, 50.0), (-50.0, 50.0), (40, 40))
    >>> T, S = (lp.LogNormal(x, x) for x in (1e-2, 1e-2))
    >>> model = groundwater(mesh, T, S, {"boundary": 0.0}, wells={"Q": (0, 0)}, radius=5.0)
    >>> model.inputs
    ('Q',)
    """
    sources = {name: _place(mesh, name, at, radius) for name, at in (wells or {}).items()}
    # The term grad(1/S) would be a delta function at jumps of S.
    if isinstance(S, Piecewise):
        raise ModelError("groundwater: S by region is not possible; take a number or a Field.")
    everywhere("groundwater", mesh, T=T)
    varies = isinstance(S, Field)

    def flow(q: Any, u: Any, v: Any, x: Place) -> Any:
        term = q.T / q.S * dot(grad(u), grad(v))
        if varies:  # grad(v/S) = grad(v)/S - v grad(S)/S^2
            term = term - q.T / q.S**2 * dot(grad(u), grad(q.S)) * v
        return term

    def taken(q: Any, _: Any, v: Any, x: Place) -> Any:
        rate: Any = -recharge
        for name, at in sources.items():
            rate = rate + x.inputs[name] * well(x, at, radius)
        return rate / q.S * v

    boundary_values = dict(dirichlet or {})
    return Model(
        # The source of a well is a polynomial of degree four.
        Field(mesh, element or linear(mesh), dirichlet=boundary_values, unit="m", quadrature=4),
        {"T": T, "S": S},
        A=[flow, taken],
        inputs=dict.fromkeys(sources, "m^3/s"),
        **GROUNDWATER.about(),
    )


def well(x: Place, at: Sequence[float], radius: float) -> Array:
    """Return the density of a round source of unit mass, 3/(pi R^2) (1 - r^2/R^2)^2, in 1/m^2.

    It is zero beyond the radius R in m around the position `at` of the well.
    """
    distance = ((x[0] - at[0]) ** 2 + (x[1] - at[1]) ** 2) / radius**2
    return 3 / (pi * radius**2) * np.maximum(1 - distance, 0.0) ** 2


def _place(mesh: Any, name: str, at: Sequence[float], radius: float) -> tuple[float, float]:
    """Return the position of a well; raise an error if the mesh does not fit."""
    if mesh.dim() != 2 or len(at) != 2:
        raise ModelError(f"groundwater: well '{name}' needs a mesh of a plane and a place (x, y).")
    place = float(at[0]), float(at[1])
    try:
        cell = mesh.element_finder()(*(np.array([c]) for c in place))[0]
    except ValueError:
        raise ModelError(f"groundwater: well '{name}' at {place} lies outside the mesh.") from None
    corners = mesh.p[:, mesh.t[:, cell]]
    width = float(np.linalg.norm(np.ptp(corners, axis=1)))
    if not radius >= width:
        raise ModelError(
            f"groundwater: well '{name}' lies in a cell of diameter {width:.3g} m; refine the mesh "
            f"there, or give radius={1.01 * width:.3g} or more (got {radius:g})."
        )
    return place


def _build_plane(
    mesh: Any,
    unknowns: Mapping[str, Any],
    dirichlet: Mapping[str, Any],
    *,
    x: float,
    y: float,
    **options: Any,
) -> Model:
    return groundwater(mesh, dirichlet=dirichlet, wells={"Q": (x, y)}, **unknowns, **options)


PUMPING_TEST = Equation(
    name="pumping_test",
    summary="radial flow to a pumped well in a confined (Theis) or leaky aquifer",
    formula="Ss r s_t = (k r s_r)_r - r leakance s/b,  "
    "-2 pi r b k s_r = Q at the well,  s = 0 far away",
    state=Variable("m", "drawdown"),
    unknowns={
        "k": Variable("m/s", "hydraulic conductivity"),
        "Ss": Variable("1/m", "specific storage"),
        "leakance": Variable("1/s", "conductivity over thickness of a leaky layer above", True),
    },
    inputs={"Q": Variable("m^3/s", "rate of the well, positive when water is taken out")},
    options={"b": Option("m", "thickness of the aquifer; with 1 m k is T and Ss is S")},
    build=by_name(pumping_test, "is pumped by the input Q, with 0 far away"),
    element=linear,
    loss="leakance",
    capacity=("Ss", "b"),
    spacing="geometric",
)

GROUNDWATER = Equation(
    name="groundwater",
    summary="confined aquifer in plan view with a well; unknown transmissivity and storativity",
    formula="S h_t = div(T grad h) + recharge - Q delta(x, y)",
    state=Variable("m", "head"),
    unknowns={
        "T": Variable("m^2/s", "transmissivity: a number, by region, or a field"),
        "S": Variable("", "storativity: a number or a field"),
    },
    inputs={"Q": Variable("m^3/s", "rate of the well, positive when water is taken out")},
    options={
        "x": Option("m", "position of the well", 0.0),
        "y": Option("m", "position of the well", 0.0),
        "radius": Option("m", "radius of the well's source, at least a cell", 1.0),
        "recharge": Option("m/s", "water gained from above", 0.0),
    },
    build=_build_plane,
    element=linear,
    dimension=2,
)


INLETS = ("flux", "fixed")


def advection_dispersion(
    mesh: Any,
    D: Unknown,
    v: Unknown,
    *,
    R: float = 1.0,
    decay: Number = 0.0,
    inlet: str = "flux",
    element: Any = None,
    unit: str = "",
) -> Model:
    """Return R c_t = D c_xx - v c_x - decay c in a column with inflow on the left.

    The inflow concentration is the channel "c_in". With inlet = "flux", the tracer enters with the
    water, v c - D c_x = v c_in (third type; c is the concentration in the column). With "fixed", c
    = c_in (first type). On the right, the tracer leaves with the water, c_x = 0. If the front does
    not reach this end, the column is semi-infinite as in the analytic solutions (Toride, Leij, van
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
        Rate of decay in 1/h, known or unknown: a number, or by layer.
    inlet
        "flux" or "fixed".
    element, unit
        See `heat`.

    Raises
    ------
    ModelError
        R is below 1, or `inlet` has another value.
    """
    _check("advection_dispersion", inlet, R)
    everywhere("advection_dispersion", mesh, D=D)
    state = _column(mesh, inlet, element, unit)

    # Advection and dispersion are both integrated by parts, so that the natural boundary condition
    # is of the third type: a given total flux v c - D c_x.
    def flux(q: Any, c: Any, w: Any, x: Any) -> Any:
        return (q.D * grad(c)[0] - q.v * c) * grad(w)[0]

    fixed_decay, unknowns = True, {"D": D, "v": v}
    if not isinstance(decay, int | float):
        fixed_decay, unknowns = False, {**unknowns, "decay": decay}
    return Model(
        state,
        unknowns,
        A=[
            flux,
            *_ends(lambda q: q.v, lambda u: u, inlet),
            *([] if fixed_decay else [lambda q, c, w, x: q.decay * c * w]),
        ],
        B=[lambda c, w, x: decay * c * w] if fixed_decay else [],
        M=lambda c, w, x: R * c * w,
        inputs={"c_in": unit},
        **ADVECTION_DISPERSION.about(),
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

    (Coats and Smith 1964; van Genuchten and Wierenga 1976). Sensors specify their component, as in
    `Points([11.0], of="c")`. For omega -> infinity, this is `advection_dispersion` with phi D.

    Parameters
    ----------
    mesh, inlet, element, unit
        See `advection_dispersion`, also for the channel "c_in".
    D
        Coefficient of dispersion in the mobile water, cm^2/h.
    v
        Mean pore velocity in cm/h: flux over total water content. Mobile water moves at v/phi.
    phi
        Mobile share of the water, in (0, 1): use `LogitNormal`.
    omega
        Rate of exchange in 1/h.

    Raises
    ------
    ModelError
        `inlet` has another value, or phi is an unknown that varies in space.
    """
    _check("mobile_immobile", inlet)
    one_number("mobile_immobile", phi=phi)

    # The equations are divided by phi and 1 - phi, so that the mass form contains no unknowns.
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
        inputs={"c_in": unit},
        **MOBILE_IMMOBILE.about(),
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
    # With c_x = 0, the total flux is v c on the right; on the left it is v c_in.
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
    unknowns={
        **COLUMN,
        "decay": Variable("1/h", "rate of decay, instead of the option", True),
    },
    inputs=INFLOW,
    options={
        "R": Option("", "retardation factor", 1.0),
        "decay": Option("1/h", "rate of decay", 0.0),
        "inlet": INLET,
    },
    build=by_name(advection_dispersion, FED),
    element=linear,
    loss="decay",
    capacity=("R",),
    length_unit="cm",
    time_unit="h",
)

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
    build=by_name(mobile_immobile, FED),
    element=linear,
    components=("c", "s"),
    length_unit="cm",
    time_unit="h",
)
