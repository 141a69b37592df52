"""Heat conduction or diffusion with side loss, heat transfer at boundaries and sources."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from operator import attrgetter
from typing import Any

import numpy as np

from livepde import fem
from livepde.errors import ModelError
from livepde.fem.measure import START, Measure
from livepde.model import Model
from livepde.models.description import (
    AMBIENT,
    COORDINATES,
    UNIT,
    Equation,
    Fluxes,
    Option,
    Variable,
    by_name,
    everywhere,
    exchange,
    one_number,
    volume_element,
)


def heat(
    mesh: Any,
    alpha: fem.Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    loss: fem.Unknown | None = None,
    transfer: fem.Unknown | None = None,
    source: fem.Unknown | None = None,
    element: Any = None,
    unit: str = "degC",
    coordinates: str = "cartesian",
) -> Model:
    """Return u_t - div(alpha grad u) + loss (u - ambient) = source in any dimension.

    Boundaries without a value have a Robin condition, -alpha u_n = transfer (u - ambient) (Newton's
    law of cooling). Omitted terms are zero: without `transfer`, these boundaries are insulated. The
    input channel "ambient", for `loss` or `transfer`, is the temperature of the surroundings.

    Parameters
    ----------
    mesh
        Any mesh of scikit-fem, or `livepde.interval(...)`, with coordinates in m.
    alpha
        Diffusivity in m^2/s: a number, a `Piecewise` by layer, or a `Field`. The flux alpha u_n is
        continuous between layers, so all layers must have the same heat capacity; otherwise use
        `conduction`.
    dirichlet
        Boundary -> number, function g(x, t), or `Channel`.
    loss
        Rate of exchange with the surroundings in the whole domain, in 1/s: a rod without
        insulation.
    transfer
        Heat-transfer coefficient over volumetric heat capacity, in m/s.
    source
        Heat source, in K/s. With `evolution=MeanReverting(...)` it represents all unmodelled
        effects, such as rain, evaporation or lateral flow.
    element
        Element of the state; by default of first order.
    unit
        Unit of u.
    coordinates
        "cartesian"; or "cylinder" or "sphere", where the first coordinate is the radius.

    Raises
    ------
    ModelError
        `transfer` is given, but every boundary has a value; a radius is negative, or a mesh around
        a centre is not an interval.

    Examples
    --------
    >>> import livepde as lp
    >>> model = heat(lp.interval(0, 1, 10), lp.Normal(5e-7, 2e-7), {"left": lp.Channel("T0")})
    >>> model.channels
    ('T0',)
    """
    unknowns = {"alpha": alpha, "loss": loss, "transfer": transfer, "source": source}
    return _model(HEAT, mesh, unknowns, dirichlet, lambda x: 1.0, element, unit, coordinates)


def conduction(
    mesh: Any,
    k: fem.Unknown,
    dirichlet: Mapping[str, Any] | None = None,
    *,
    C: float | Callable[[fem.Place], Any] | fem.Unknown,
    loss: fem.Unknown | None = None,
    transfer: fem.Unknown | None = None,
    source: fem.Unknown | None = None,
    element: Any = None,
    unit: str = "degC",
    coordinates: str = "cartesian",
) -> Model:
    """Return C u_t - div(k grad u) + loss (u - ambient) = source with heat capacity C.

    If C is unknown, the equation is divided by it. Temperatures alone determine only k/C, so add a
    known flux or source by `with_conditions(..., per="C")`.

    At boundaries without a Dirichlet value, -k u_n = transfer (u - ambient).

    Parameters
    ----------
    mesh, dirichlet, element, unit, coordinates
        See `heat`.
    k
        Conductivity in W/(m K).
    C
        Volumetric heat capacity in J/(m^3 K): a number, a function of x, or one unknown number.
    loss, transfer, source
        Loss rate, transfer coefficient and source, in W/(m^3 K), W/(m^2 K) and W/m^3.

    Raises
    ------
    ModelError
        C is not positive, or an unknown that varies in space; or `transfer` is given, but every
        boundary has a value.

    Examples
    --------
    >>> import livepde as lp
    >>> layers = lp.interval(0.0, 0.5, 50)
    >>> dry, wet = 1.3e6, 2.9e6
    >>> model = conduction(
    ...     layers,
    ...     lp.Normal(1.0, 0.5),
    ...     {"boundary": 10.0},
    ...     C=lambda x: dry + (wet - dry) * (x[0] > 0.2),
    ... )
    """
    unknowns = {"k": k, "loss": loss, "transfer": transfer, "source": source}
    one_number("conduction", C=C)
    constant: Any = C
    if isinstance(C, fem.Scalar | fem.Prior):
        unknowns["C"], constant = C, 1.0
    elif not callable(C) and not (isinstance(constant, Real) and float(constant) > 0.0):
        raise ModelError(f"conduction: the heat capacity C must be positive; got {C!r:.60}.")
    capacity = constant if callable(constant) else lambda x: constant
    smallest = float(np.min(capacity(Measure(mesh, 1).place(START))))
    if not smallest > 0.0:
        raise ModelError(
            f"conduction: the heat capacity C must be positive everywhere; its least value is "
            f"{smallest:g}."
        )
    return _model(CONDUCTION, mesh, unknowns, dirichlet, capacity, element, unit, coordinates)


def _model(
    equation: Equation,
    mesh: Any,
    unknowns: Mapping[str, fem.Unknown | None],
    dirichlet: Mapping[str, Any] | None,
    capacity: Callable[[fem.Place], Any],
    element: Any,
    unit: str,
    coordinates: str,
) -> Model:
    everywhere(equation.name, mesh, **{equation.conductivity: unknowns[equation.conductivity]})
    field = fem.Field(
        mesh,
        element or fem.linear(mesh),
        dirichlet=dict(dirichlet or {}),
        unit=unit,
        weight=volume_element(equation.name, mesh, coordinates),
    )
    # Omit terms whose unknown is not given, and their inputs.
    used = {key: unknown for key, unknown in unknowns.items() if unknown is not None}
    # The equation is divided by an unknown heat capacity. The form is linear in the ratios, which
    # are its coefficients.
    divided = "C" in used
    part = {key: attrgetter(key + "_per_C" * divided) for key in used}
    return Model(
        field,
        used,
        A=_terms(equation, part, field),
        M=lambda u, v, x: capacity(x) * u * v,
        inputs={AMBIENT: unit} if {"loss", "transfer"} & set(used) else {},
        coefficients=(lambda q: _ratios(q, part)) if divided else None,
        **equation.about(used),
    )


def _ratios(q: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return 1/C, and the other unknowns divided by C."""
    return {"per_C": 1.0 / q.C, **{f"{k}_per_C": getattr(q, k) / q.C for k in names if k != "C"}}


def _terms(
    equation: Equation, part: Mapping[str, Callable[[Any], Any]], field: fem.Field
) -> list[Any]:
    """Return the terms of A; `part`: name of an unknown or ratio -> function of q."""
    D = part[equation.conductivity]
    terms: list[Any] = [lambda q, u, v, x: D(q) * fem.dot(fem.grad(u), fem.grad(v))]
    if "loss" in part:
        terms += exchange(part["loss"])
    if "transfer" in part:
        sides = _free_sides(equation, field)
        terms += [fem.On(side, term) for side in sides for term in exchange(part["transfer"])]
    if "source" in part:
        terms.append(lambda q, _, v, x: -part["source"](q) * v)
    return terms


def _free_sides(equation: Equation, field: fem.Field) -> list[str]:
    """Return the named boundaries without a Dirichlet value, where heat transfer acts."""
    dirichlet = field.dirichlet
    sides = [] if "boundary" in dirichlet else [*(field.mesh.boundaries or {})]
    free = [side for side in sides if side not in dirichlet]
    if not free:
        raise ModelError(
            f"{equation.name}: transfer acts at named boundaries without a value, and there is "
            "none: leave it out, or leave one out of dirichlet."
        )
    return free


SURROUNDINGS = {
    AMBIENT: Variable("degC", "temperature of the surroundings, for loss and transfer", True)
}

HEAT = Equation(
    name="heat",
    summary="heat conduction, or another diffusion, with side loss, heat transfer and sources",
    formula="u_t = div(alpha grad u) - loss (u - ambient) + source",
    state=Variable("degC", "temperature"),
    unknowns={
        "alpha": Variable("m^2/s", "diffusivity: a number, by layer, or a field"),
        "loss": Variable("1/s", "rate of exchange with the surroundings", True),
        "transfer": Variable("m/s", "heat transfer over heat capacity, free boundaries", True),
        "source": Variable("K/s", "heat gained over heat capacity", True),
    },
    inputs=SURROUNDINGS,
    options={"unit": UNIT, "coordinates": COORDINATES},
    build=by_name(heat),
    element=fem.linear,
    fluxes=Fluxes("K m/s", "m/s", "K/s"),
    conductivity="alpha",
)

CONDUCTION = Equation(
    name="conduction",
    summary="heat conduction by conductivity and heat capacity",
    formula="C u_t = div(k grad u) - loss (u - ambient) + source",
    state=Variable("degC", "temperature"),
    unknowns={
        "k": Variable("W/(m K)", "conductivity: a number, by layer, or a field"),
        "C": Variable("J/(m^3 K)", "heat capacity in place of the option, with a flux", True),
        "loss": Variable("W/(m^3 K)", "exchange with the surroundings", True),
        "transfer": Variable("W/(m^2 K)", "heat transfer at free boundaries", True),
        "source": Variable("W/m^3", "heat gained", True),
    },
    inputs=SURROUNDINGS,
    options={
        "C": Option("J/(m^3 K)", "volumetric heat capacity"),
        "coordinates": COORDINATES,
    },
    build=by_name(conduction),
    element=fem.linear,
    fluxes=Fluxes("W/m^2", "W/(m^2 K)", "W/m^3"),
    conductivity="k",
    storage="C",
    capacity=("C",),
)
