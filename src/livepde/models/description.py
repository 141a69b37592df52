"""Descriptions of predefined equations, and common parts of their models."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from livepde.errors import ModelError
from livepde.fem import Field, Integrand, Piecewise, Place, Scalars, Unknown
from livepde.fem.fields import SIDES
from livepde.fem.measure import unweighted
from livepde.model import Model

AMBIENT = "ambient"  # input of an exchange with the surroundings


def exchange(coefficient: Callable[[Any], Any]) -> list[Any]:
    """Return coefficient (u - ambient) v as two terms: the term in u must not depend on inputs."""
    return [
        lambda q, u, v, x: coefficient(q) * u * v,
        lambda q, _, v, x: -coefficient(q) * x.inputs[AMBIENT] * v,
    ]


def around_axis(x: Any) -> Any:
    """Return the volume element for a first coordinate that is the distance from an axis."""
    return x[0]


POWERS = {"cartesian": 0, "cylinder": 1, "sphere": 2}
"""Coordinates -> power of the radius in the volume element."""


def volume_element(equation: str, mesh: Any, coordinates: str) -> Callable[[Any], Any]:
    """Return the volume element of a mesh in coordinates by name."""
    if coordinates not in POWERS:
        text = f"coordinates = {coordinates!r}; expected one of {', '.join(POWERS)}."
        raise ModelError(f"{equation}: {text}")
    if coordinates == "sphere" and len(mesh.p) > 1:
        raise ModelError(f"{equation}: coordinates = 'sphere' requires an interval of radii.")
    if coordinates != "cartesian" and not mesh.p[0].min() >= 0.0:
        text = f"the first coordinate is a radius, and begins at {mesh.p[0].min():g}; expected 0 "
        raise ModelError(f"{equation}: {text}or more.")
    # It is of order one, which keeps the matrices well scaled.
    power, largest = POWERS[coordinates], float(mesh.p[0].max())
    return (lambda x: (x[0] / largest) ** power) if power else unweighted


@dataclass(frozen=True)
class Variable:
    """Unknown, state, or input of an equation, with unit and meaning.

    Attributes
    ----------
    transform
        Transform of the unknown in a case from `livepde init`: "log" for a positive quantity,
        "logit" for a share between 0 and 1, empty for a quantity that may be negative.
    """

    unit: str
    text: str
    optional: bool = False
    transform: Literal["log", "logit", ""] = "log"


@dataclass(frozen=True)
class Option:
    """Known number of an equation; it is required if `default` is None.

    The value is text or a boolean if the default is, and text if there are `choices`.
    """

    unit: str
    text: str
    default: float | str | bool | None = None
    choices: tuple[str, ...] = ()

    @property
    def kind(self) -> type[float] | type[str] | type[bool]:
        """Type of the value."""
        if isinstance(self.default, bool):
            return bool
        return str if self.choices or isinstance(self.default, str) else float


@dataclass(frozen=True)
class Quantity:
    """Measured quantity other than the state at a point.

    Attributes
    ----------
    at
        Function (left end, right end) of the mesh -> position of the state in it.
    direct
        Function of the options that returns the direct dependence on the parameter, a function
        (q, x) that is linear in q.
    """

    text: str
    at: Callable[[float, float], float]
    direct: Callable[[Mapping[str, Any]], Callable[[Any, Place], Any]]


class Fluxes(NamedTuple):
    """Units of a flux D u_n, of h in an exchange h (ambient - u), and of a source density."""

    flux: str
    transfer: str
    source: str


@dataclass(frozen=True)
class Equation:
    """Named PDE, with the entries that a case file may contain.

    Attributes
    ----------
    name, summary, formula
        Name in a case file, a one-line summary, and the equation as text.
    state
        Unit and meaning of u.
    unknowns, inputs, options
        Mappings from name to description.
    build
        Function (mesh, unknowns, dirichlet, **options) -> `Model`.
    quantities
        Measured quantities other than the state.
    element
        Function mesh -> element of the state and of unknown fields.
    fluxes
        Units of fluxes and sources (`livepde.models.with_conditions`); None if not supported.
    conductivity
        Unknown D of the flux -D u_x, for sensors with `quantity = "flux"`; empty if none.
    storage
        Option that may be an unknown instead. The equation is then divided by it, and only ratios
        of other unknowns to it are determined without a known flux or source.
    loss
        Unknown of the exchange with the surroundings.
    capacity
        Unknowns and options whose product with a rate of change of the state is a source, and with
        a rate of decay a loss.
    spacing
        Spacing of an interval's mesh: "geometric" if u changes most at the left end (a well).
    alternatives
        Unknowns of which a case requires at least one -> their inputs and options.
    components
        Names of the components of u; empty if there is only one.
    omits
        Effect at the start of the process that the equation omits, and the equation with it.
    settles
        Function (values of unknowns and options, left end of the mesh) -> time after which the
        omitted effect is negligible; None if unknown.
    dimension
        Dimension of the mesh that `livepde init` writes: 1 for an interval, 2 for a rectangle.
    """

    name: str
    summary: str
    formula: str
    state: Variable
    unknowns: Mapping[str, Variable]
    build: Callable[..., Model]
    element: Callable[[Any], Any]
    inputs: Mapping[str, Variable] = field(default_factory=dict)
    options: Mapping[str, Option] = field(default_factory=dict)
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    length_unit: str = "m"
    time_unit: str = "s"
    fluxes: Fluxes | None = None
    conductivity: str = ""
    storage: str = ""
    loss: str = "loss"
    capacity: tuple[str, ...] = ()
    spacing: Literal["uniform", "geometric"] = "uniform"
    alternatives: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    components: tuple[str, ...] = ()
    omits: str = ""
    settles: Callable[[Mapping[str, float], float], float] | None = None
    dimension: Literal[1, 2] = 1

    def about(self, unknowns: Collection[str] = ()) -> dict[str, Any]:
        """Return units and formula of a model, without the terms of optional unknowns it lacks."""
        omitted = [
            name for name, item in self.unknowns.items() if item.optional and name not in unknowns
        ]
        main, comma, conditions = self.formula.partition(",  ")
        # Omit only terms outside brackets, because a sum in brackets has other terms.
        first, *signed_terms = re.split(r" ([+-]) (?![^(]*\))", main)
        parts = zip(signed_terms[::2], signed_terms[1::2], strict=True)
        terms = [
            (sign, term) for sign, term in parts if not set(omitted) & set(re.findall(r"\w+", term))
        ]
        formula = "".join([first, *(f" {sign} {term}" for sign, term in terms), comma, conditions])
        units = {"time_unit": self.time_unit, "length_unit": self.length_unit}
        return {**units, "formula": formula}

    def in_unit(self, unit: str) -> Equation:
        """Return the equation of a state in another unit; units of fluxes and sources follow."""
        per = f"({unit})" if re.search(r"[/ ]", unit) else unit or "1"

        def renamed(given: str) -> str:
            return unit if given == self.state.unit else re.sub(r"\bK\b", lambda _: per, given)

        def variables(known: Mapping[str, Variable]) -> dict[str, Variable]:
            return {name: replace(one, unit=renamed(one.unit)) for name, one in known.items()}

        return replace(
            self,
            state=Variable(unit, f"measured in {unit}"),
            unknowns=variables(self.unknowns),
            inputs=variables(self.inputs),
            fluxes=self.fluxes and Fluxes(*map(renamed, self.fluxes)),
        )

    @property
    def takes_values(self) -> bool:
        """Whether a case may give values of the state on boundaries."""
        return not getattr(self.build, "closed", "")


@dataclass(frozen=True)
class by_name:
    """The `build` of an equation whose function takes unknowns, `dirichlet` and options by keyword.

    An unknown replaces the option of the same name. `closed` is the reason why a function has no
    `dirichlet`, for the error message if a case has boundary values.
    """

    function: Callable[..., Model]
    closed: str = ""

    def __call__(
        self,
        mesh: Any,
        unknowns: Mapping[str, Unknown],
        dirichlet: Mapping[str, Any],
        **options: Any,
    ) -> Model:
        arguments = {**options, **unknowns}
        if not self.closed:
            return self.function(mesh, dirichlet=dirichlet or None, **arguments)
        if dirichlet:
            name, places = self.function.__name__, sorted(dirichlet)
            raise ModelError(f"{name} {self.closed}: leave out the values on {places}.")
        return self.function(mesh, **arguments)


Number: TypeAlias = Unknown | float
"""A coefficient of an equation: unknown, or a known number."""

# Unknowns with several numbers. If an equation is divided by such an unknown, the gradient of its
# inverse is an additional term.
VARYING = (Field, Piecewise, Scalars)


def one_number(equation: str, **unknowns: Any) -> None:
    """Raise an error if an unknown that divides the equation varies in space."""
    for name, unknown in unknowns.items():
        if isinstance(unknown, VARYING):
            text = f"an unknown {name} must be one number; give a Scalar or a prior."
            raise ModelError(f"{equation}: {text}")


def everywhere(equation: str, mesh: Any, **unknowns: Any) -> None:
    """Raise an error if a cell is not in exactly one region of a piecewise coefficient.

    The coefficient would be zero there, or the sum of several numbers.
    """
    middle = mesh.p[:, mesh.t].mean(axis=1)
    for name, unknown in unknowns.items():
        if not isinstance(unknown, Piecewise):
            continue
        count = np.zeros(mesh.nelements)
        for label, region in unknown.regions.items():
            inside = np.zeros(mesh.nelements, dtype=bool)
            if callable(region):
                inside[:] = region(middle)
            else:  # an unknown name is an error when forms are evaluated
                inside[(mesh.subdomains or {}).get(region, [])] = True
            if callable(region) and not inside.any():
                raise ModelError(
                    f"{equation}: no cell of the mesh lies in the region '{label}' of '{name}'."
                )
            count += inside
        wrong = np.flatnonzero(count != 1)
        if len(wrong):
            at = ", ".join(f"{x:.4g}" for x in middle[:, wrong[0]])
            raise ModelError(
                f"{equation}: the point {at} lies in {int(count[wrong[0]])} regions of '{name}'; "
                "every point must lie in exactly one."
            )


COORDINATES = Option("", "whether the first coordinate is a radius", "cartesian", tuple(POWERS))
UNIT = Option("", "unit of the state, such as mg/l", "degC")
INITIAL = Variable("", "initial state, a field; else the case's `initial`", optional=True)


def state(mesh: Any, element: Any, dirichlet: Mapping[str, Any] | None, unit: str = "") -> Field:
    """Return the field of the state: with Dirichlet values, or periodic if they are None."""
    if dirichlet is not None:
        return Field(mesh, element, dirichlet=dict(dirichlet), unit=unit)
    pairs = [pair for pair in SIDES[-1] if set(pair) <= set(mesh.boundaries or {})]
    return Field(mesh, element, periodic=pairs, unit=unit)


def autonomous(
    u: Field,
    coefficients: Mapping[str, Number],
    u0: Unknown | None,
    form: Callable[[Any, Any, Any], Any],
    about: Mapping[str, Any],
) -> Model:
    """Return u_t + A(u) = 0, with A from a form (c, u, v) with known or unknown coefficients c."""
    fixed = {k: float(v) for k, v in coefficients.items() if isinstance(v, int | float)}
    unknown: dict[str, Any] = {k: v for k, v in coefficients.items() if k not in fixed}
    initial_unknown, initial = _beginning(u0, u)

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return form(SimpleNamespace(**fixed, **{k: getattr(q, k) for k in unknown}), u, v)

    return Model(u, {**unknown, **initial_unknown}, A=A, initial=initial, **about)


def _beginning(u0: Unknown | None, u: Field) -> tuple[dict[str, Unknown], Integrand | None]:
    """Return name -> unknown initial state, and the form `initial` of a model.

    A field inherits periodic boundaries and zero Dirichlet values from the state.
    """
    if u0 is None:
        return {}, None
    if isinstance(u0, Field):
        zero_values = {name: 0.0 for name, value in u.dirichlet.items() if value == 0.0}
        u0 = replace(u0, dirichlet=zero_values, periodic=u.periodic)
    return {"u0": u0}, lambda q, v, x: q.u0 * v
