"""Advection-diffusion along a column: heat or a solute carried by a flow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.errors import ModelError
from livepde.fem import Field, Unknown, absolute, dot, grad, linear
from livepde.fem.notation import upwind
from livepde.model import Model
from livepde.models.description import Equation, Option, Variable, by_name


def advection_diffusion(
    mesh: Any,
    kappa: Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    v: Unknown | None = None,
    K: Unknown | None = None,
    dispersivity: Unknown | None = None,
    source: Unknown | None = None,
    L: float = 1.0,
    ratio: float = 1.0,
    stabilise: bool = False,
    element: Any = None,
    unit: str = "degC",
) -> Model:
    """Return u_t + w u_z - div((kappa + dispersivity |w|) grad u) = source, along z = x[0].

    The velocity is w = ratio (v + K dH/L): a flux v, the Darcy flux of a measured head difference
    dH, or the sum of both. Examples are heat in a stream bed (Stallman 1965) and solutes.

    Parameters
    ----------
    mesh
        `livepde.interval(...)`, or a mesh of more dimensions with the flow along its first; in m.
    kappa
        Diffusivity in m^2/s: a number, a `Piecewise` by layer, or a `Field`.
    dirichlet
        Mapping from boundary to number, function g(x, t), or `Channel`. Other boundaries have no
        diffusive flux.
    v
        Flux in m/s, positive along z; a time-dependent one has an `evolution`. It is a number,
        since the same water passes all layers of a column.
    K
        Hydraulic conductivity in m/s. dH in m is the input channel "dH".
    dispersivity
        Dispersivity in m.
    source
        Source in unit/s, as in `heat`.
    L
        Length in m of the head drop dH.
    ratio
        Ratio of velocity to flux: for heat the volumetric heat capacity of water over that of the
        saturated bed (about 1.5), for a solute 1/porosity.
    stabilise
        True: add the artificial diffusion of `livepde.fem.notation`, for flows with a cell Peclet
        number |w| h/(2 kappa) above 1.
    element
        Element of the state; default of first order.
    unit
        Unit of u.

    Raises
    ------
    ModelError
        Neither v nor K is given, or a length or ratio is not positive.

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
    if v is None and K is None:
        raise ModelError("advection_diffusion: give v (a flux), K (with the input dH), or both.")
    for name, value in {"L": L, "ratio": ratio}.items():
        if not value > 0:
            raise ModelError(f"advection_diffusion: {name} must be positive; got {value}.")
    every = {"kappa": kappa, "v": v, "K": K, "dispersivity": dispersivity, "source": source}
    unknowns = {name: unknown for name, unknown in every.items() if unknown is not None}

    def velocity(q: Any, x: Any) -> Any:
        flux = q.v if v is not None else 0.0
        if K is not None:
            flux = flux + q.K * x.inputs["dH"] / L
        return ratio * flux

    def transport(q: Any, u: Any, test: Any, x: Any) -> Any:
        w = velocity(q, x)
        spread = q.kappa
        if dispersivity is not None:
            # `absolute` instead of abs: complex steps must differentiate the term by w.
            spread = spread + q.dispersivity * absolute(w)
        moved = spread * dot(grad(u), grad(test)) + w * grad(u)[0] * test
        if stabilise:  # along the flow only
            moved = moved + upwind(w, spread, x.h) * grad(u)[0] * grad(test)[0]
        return moved if source is None else moved - q.source * test

    return Model(
        Field(mesh, element or linear(mesh), dirichlet=dict(dirichlet or {}), unit=unit),
        unknowns,
        A=transport,
        inputs=["dH"] if K is not None else [],
        time_unit="s",
        length_unit="m",
        formula=ADVECTION_DIFFUSION.written(unknowns),
    )


ADVECTION_DIFFUSION = Equation(
    name="advection_diffusion",
    summary="heat or a solute carried by a flow along a column: stream beds",
    formula="u_t = div((kappa + dispersivity |w|) grad u) - w u_z,  w = ratio (v + K dH/L)",
    state=Variable("degC", "temperature"),
    unknowns={
        "kappa": Variable("m^2/s", "diffusivity: a number, by layer, or a field"),
        "v": Variable("m/s", "flux along z", True, transform=""),
        "K": Variable("m/s", "hydraulic conductivity, with the input dH", True),
        "dispersivity": Variable("m", "dispersivity", True),
        "source": Variable("K/s", "heat gained over heat capacity", True, transform=""),
    },
    inputs={"dH": Variable("m", "head difference, positive if it drives along z", True)},
    options={
        "L": Option("m", "length over which the head falls by dH", 1.0),
        "ratio": Option("", "velocity over flux: C of water over C of the wet bed", 1.0),
        "stabilise": Option("", "whether to add the diffusion that fast flows need", False),
    },
    build=by_name(advection_diffusion),
    element=linear,
    alternatives={"K": ("dH", "L", "ratio"), "v": ("ratio",)},
)
