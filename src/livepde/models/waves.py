"""Transport and waves: advection-diffusion, damped waves, Burgers, KdV, Kuramoto-Sivashinsky."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

from livepde.errors import ModelError, require_positive
from livepde.fem import (
    Field,
    Source,
    Unknown,
    absolute,
    dot,
    grad,
    hermite,
    hess,
    linear,
    smooth,
    upwind,
)
from livepde.model import Model
from livepde.models.description import (
    AMBIENT,
    INITIAL,
    UNIT,
    Equation,
    Number,
    Option,
    Variable,
    autonomous,
    by_name,
    everywhere,
    exchange,
    state,
)


def advection_diffusion(
    mesh: Any,
    kappa: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    v: Unknown | None = None,
    K: Unknown | None = None,
    dispersivity: Unknown | None = None,
    loss: Unknown | None = None,
    source: Unknown | None = None,
    L: float = 1.0,
    ratio: float = 1.0,
    flow: bool = False,
    stabilise: bool = False,
    element: Any = None,
    unit: str = "degC",
) -> Model:
    """Return u_t + w u_z - div(D grad u) + loss (u - ambient) = source, along z = x[0].

    D = kappa + dispersivity |w|, with the velocity w = ratio (flow + v + K dH/L): a measured flux,
    an unknown flux v, the Darcy flux of a measured head difference dH, or their sum. Examples are
    heat in a stream bed (Stallman 1965), a pipe that loses heat, and solutes.

    Parameters
    ----------
    mesh, element, unit
        See `heat`; the flow is along the first axis of the mesh.
    kappa
        Diffusivity in m^2/s: a number, a `Piecewise` by layer, or a `Field`.
    dirichlet
        See `heat`. Other boundaries have no diffusive flux.
    v
        Flux in m/s, positive along z; a time-dependent flux has an `evolution`. It is one number,
        because the same water passes all layers of a column.
    K
        Hydraulic conductivity in m/s. dH in m is the input channel "dH".
    dispersivity
        Dispersivity in m.
    loss, source
        Rate of exchange in 1/s with surroundings at the input channel "ambient", and source in
        unit/s. See `heat`.
    L
        Length in m over which the head drops by dH.
    ratio
        Ratio of velocity to flux. For heat, it is the volumetric heat capacity of water over the
        heat capacity of the saturated bed (about 1.5); for a solute, 1/porosity.
    flow
        Whether the flux, or a part of it, is the input channel "flow" in m/s, positive along z.
    stabilise
        Whether to add the artificial diffusion of `livepde.fem.upwind`, for flows with a cell
        Peclet number |w| h/(2 kappa) above 1.

    Raises
    ------
    ModelError
        None of v, K and flow is given, or L or ratio is not positive.

    Examples
    --------
    >>> import livepde as lp
    >>> bed = lp.interval(0.0, 0.4, 40)
    >>> sides = {"left": lp.Channel("T_river"), "right": lp.Channel("T_40")}
    >>> kappa, K = lp.LogNormal(8e-7, 4e-7), lp.Normal(0.0, 1e-5)
    >>> model = advection_diffusion(bed, kappa, sides, K=K, L=0.4, ratio=1.5)
    >>> model.channels
    ('dH', 'T_river', 'T_40')
    """
    if v is None and K is None and not flow:
        text = "give an unknown flux v, a measured one (the input flow), or K with the input dH."
        raise ModelError(f"advection_diffusion: {text}")
    for name, value in {"L": L, "ratio": ratio}.items():
        require_positive(f"advection_diffusion: {name}", value, ModelError)
    all_unknowns = {
        "kappa": kappa,
        "v": v,
        "K": K,
        "dispersivity": dispersivity,
        "loss": loss,
        "source": source,
    }
    unknowns = {name: unknown for name, unknown in all_unknowns.items() if unknown is not None}
    everywhere("advection_diffusion", mesh, kappa=kappa)

    def velocity(q: Any, x: Any) -> Any:
        flux = x.inputs["flow"] if flow else 0.0
        if v is not None:
            flux = flux + q.v
        if K is not None:
            flux = flux + q.K * x.inputs["dH"] / L
        return ratio * flux

    def transport(q: Any, u: Any, test: Any, x: Any) -> Any:
        w = velocity(q, x)
        spread = q.kappa
        if dispersivity is not None:
            # `absolute` instead of abs, because complex steps differentiate the term by w.
            spread = spread + q.dispersivity * absolute(w)
        density = spread * dot(grad(u), grad(test)) + w * grad(u)[0] * test
        if stabilise:  # along the flow only
            density = density + upwind(w, spread, x.h) * grad(u)[0] * grad(test)[0]
        return density if source is None else density - q.source * test

    units = {"flow": "m/s", "dH": "m", AMBIENT: unit}
    reads = {"flow": flow, "dH": K is not None, AMBIENT: loss is not None}
    return Model(
        Field(mesh, element or linear(mesh), dirichlet=dict(dirichlet or {}), unit=unit),
        unknowns,
        A=[transport, *(exchange(attrgetter("loss")) if loss is not None else [])],
        inputs={name: unit for name, unit in units.items() if reads[name]},
        **ADVECTION_DIFFUSION.about(unknowns),
    )


ADVECTION_DIFFUSION = Equation(
    name="advection_diffusion",
    summary="heat or a solute carried by a flow along a column or a pipe: stream beds",
    formula=(
        "u_t = div((kappa + dispersivity |w|) grad u) - w u_z - loss (u - ambient),  "
        "w = ratio (flow + v + K dH/L)"
    ),
    state=Variable("degC", "temperature"),
    unknowns={
        "kappa": Variable("m^2/s", "diffusivity: a number, by layer, or a field"),
        "v": Variable("m/s", "flux along z", True, transform=""),
        "K": Variable("m/s", "hydraulic conductivity, with the input dH", True),
        "dispersivity": Variable("m", "dispersivity", True),
        "loss": Variable("1/s", "rate of exchange with the surroundings", True),
        "source": Variable("K/s", "heat gained over heat capacity", True, transform=""),
    },
    inputs={
        AMBIENT: Variable("degC", "temperature of the surroundings, for loss", True),
        "dH": Variable("m", "head difference, positive if it drives along z", True),
        "flow": Variable("m/s", "measured flux along z", True),
    },
    options={
        "L": Option("m", "length over which the head falls by dH", 1.0),
        "ratio": Option(
            "", "velocity over flux: C of water over C of the wet bed; 1 in a river", 1.0
        ),
        "flow": Option("", "whether the flux is measured; set by an input `flow`", False),
        "stabilise": Option("", "whether to add the diffusion that fast flows need", False),
        "unit": UNIT,
    },
    build=by_name(advection_diffusion),
    element=linear,
    alternatives={"K": ("dH", "L", "ratio"), "flow": ("flow", "ratio"), "v": ("ratio",)},
)


def wave(
    mesh: Any,
    c2: Unknown,
    d: Unknown | float = 0.0,
    dirichlet: Mapping[str, Any] | None = None,
    velocity: Mapping[str, Any] | None = None,
    *,
    f: Source = 0.0,
    element: Any = None,
) -> Model:
    """Return w_tt + d w_t - div(c^2 grad w) = f, with unknown squared speed c^2 and damping d.

    The state has two components, the displacement w and its velocity p:

        w_t = p,    p_t + d p - div(c^2 grad w) = f.

    Use the scheme `Alexander2`: implicit Euler damps waves strongly.

    Parameters
    ----------
    mesh, element
        See `heat`; both components have the same element.
    c2
        Squared speed in m^2/s^2: a number, a `Piecewise`, or a `Field`.
    d
        Damping in 1/s: a number or an unknown.
    dirichlet
        Mapping from boundary to the value of w: a number, a function g(x, t), or a `Channel`. Other
        boundaries are free ends.
    velocity
        Mapping from boundary to the value of p, which is required if w changes in time there.
    f
        Force per mass: a number or f(x, t).

    Raises
    ------
    ModelError
        A boundary value of w may change in time, but there is no velocity.

    Examples
    --------
    >>> import livepde as lp
    >>> model = wave(lp.interval(0, 1, 20), lp.Normal(1.0, 0.3), dirichlet={"left": 0.0})
    >>> list(model.state_space.blocks)
    ['w', 'p']
    """
    values_w, values_p = dict(dirichlet or {}), dict(velocity or {})
    for name, value in values_w.items():
        if name not in values_p:
            if not isinstance(value, int | float):
                raise ModelError(
                    f"wave: w on '{name}' may move; give its time derivative, too: "
                    f"velocity={{'{name}': ...}}."
                )
            values_p[name] = 0.0
    element = element or linear(mesh)
    everywhere("wave", mesh, c2=c2)
    unknown = {} if isinstance(d, int | float) else {"d": d}
    level = float(d) if isinstance(d, int | float) else 0.0

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        stiffness = q.c2 * dot(grad(u.w), grad(v.p))
        return stiffness + q.d * u.p * v.p if unknown else stiffness

    # First-order form, because implicit one-step schemes and laws require a single time derivative.
    return Model(
        {
            "w": Field(mesh, element, dirichlet=values_w, unit="m"),
            "p": Field(mesh, element, dirichlet=values_p, unit="m/s"),
        },
        {"c2": c2, **unknown},
        A=A,
        B=lambda u, v, x: -u.p * v.w + level * u.p * v.p,
        f={"p": f},
        **WAVE.about(),
    )


WAVE = Equation(
    name="wave",
    summary="waves with damping; unknown squared speed and damping",
    formula="w_tt + d w_t = div(c2 grad w), with the velocity p = w_t",
    state=Variable("m", "displacement"),
    unknowns={
        "c2": Variable("m^2/s^2", "squared speed: a number, by region, or a field"),
        "d": Variable("1/s", "damping"),
    },
    build=by_name(wave),
    element=linear,
    components=("w", "p"),
)


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
        `livepde.interval(...)` or `livepde.fem.line(...)`. Several cells of the default element
        must resolve a shock, whose width is about 4 nu/(a jump).
    nu, advection
        Viscosity, and the coefficient a: unknowns or numbers.
    u0
        Unknown initial state, usually a `Field` on the same mesh; None: given to the `Identifier`.
    dirichlet
        See `heat`; None: periodic.
    element
        Element of the state; by default cubic Hermite.
    """
    u = state(mesh, element or hermite(mesh), dirichlet)
    return autonomous(
        u,
        {"advection": advection, "nu": nu},
        u0,
        lambda c, u, v: c.advection * u * grad(u)[0] * v + c.nu * dot(grad(u), grad(v)),
        BURGERS.about(),
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


def kdv(mesh: Any, advection: Number, dispersion: Number, u0: Unknown | None = None) -> Model:
    """Return the Korteweg-de Vries equation u_t + a u u_x + b u_xxx = 0 on a periodic interval.

    The weak form -b (u_xx, v_x) requires elements of class C^1: cubic Hermite. Use the scheme
    `Alexander2`, which barely damps resolved waves; implicit Euler damps solitons.

    Parameters
    ----------
    mesh
        `livepde.interval(...)`, whose ends are identified.
    advection, dispersion
        The coefficients a and b: unknowns or numbers.
    u0
        See `burgers`.
    """
    u = state(mesh, smooth(mesh), None)
    # The third derivative is integrated by parts once, so that second derivatives of u remain,
    # which require C^1 elements.
    return autonomous(
        u,
        {"advection": advection, "dispersion": dispersion},
        u0,
        lambda c, u, v: (
            c.advection * u * grad(u)[0] * v - c.dispersion * hess(u)[0, 0] * grad(v)[0]
        ),
        KDV.about(),
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
    build=by_name(kdv, "is periodic"),
    element=smooth,
    length_unit="",
    time_unit="",
)


def kuramoto_sivashinsky(
    mesh: Any, advection: Number, instability: Number, damping: Number, u0: Unknown | None = None
) -> Model:
    """Return u_t + a u u_x + b u_xx + c u_xxxx = 0 on a periodic interval.

    Waves longer than 2 pi (c/b)^(1/2) grow, and shorter waves decay. The dynamics are chaotic and
    errors grow quickly, so the state must be observed at several points and at short intervals.

    Parameters
    ----------
    mesh
        `livepde.interval(...)`, whose ends are identified.
    advection, instability, damping
        The coefficients a, b and c: unknowns or numbers.
    u0
        See `burgers`.
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
        KURAMOTO_SIVASHINSKY.about(),
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
    build=by_name(kuramoto_sivashinsky, "is periodic"),
    element=smooth,
    length_unit="",
    time_unit="",
)
