"""What a ready-made equation is, for programs, case files and `livepde init`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from livepde.errors import ModelError
from livepde.fem import Place, Unknown
from livepde.model import Model

__all__ = ["Equation", "Fluxes", "Option", "Quantity", "Variable", "by_name", "closed"]


@dataclass(frozen=True)
class Variable:
    """An unknown, the state, or an input: its unit, what it is, and whether it may be left out."""

    unit: str
    text: str
    optional: bool = False


@dataclass(frozen=True)
class Option:
    """A known number of an equation; `default` None means that it must be given.

    An option whose default is text or a boolean, or that has `choices`, takes such a value.
    """

    unit: str
    text: str
    default: float | str | bool | None = None
    choices: tuple[str, ...] = ()

    @property
    def kind(self) -> type[float] | type[str] | type[bool]:
        """What it takes."""
        if isinstance(self.default, bool):
            return bool
        return str if self.choices or isinstance(self.default, str) else float


@dataclass(frozen=True)
class Quantity:
    """Something that is measured and is not simply the state at a point.

    Attributes
    ----------
    text
        What it is.
    at
        (left end, right end) of the mesh -> where the state enters.
    direct
        Options -> the part (q, x) that depends on the parameter directly, linear in q.
    """

    text: str
    at: Callable[[float, float], float]
    direct: Callable[[Mapping[str, Any]], Callable[[Any, Place], Any]]


class Fluxes(NamedTuple):
    """Units of what a case may let pass through boundaries and gain inside.

    Attributes
    ----------
    flux, transfer, source
        Of D u_n, of the coefficient of an exchange h (ambient - u), and of what is gained for each
        unit of volume and time.
    """

    flux: str
    transfer: str
    source: str


@dataclass(frozen=True)
class Equation:
    """A PDE with a name, and what a case file may say about it.

    Attributes
    ----------
    name, summary, formula
        Name in a case file, one line about it, and the equation as text.
    state
        Unit and meaning of u.
    unknowns, inputs, options
        By name.
    build
        (mesh, unknowns, dirichlet, **options) -> `Model`.
    quantities
        Measured quantities besides the state itself.
    element
        mesh -> element of the state, and of an unknown field.
    fluxes
        Units of fluxes and sources (`livepde.models.with_conditions`); None: it takes none.
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


def by_name(function: Callable[..., Model]) -> Callable[..., Model]:
    """Return the `build` of a function that takes unknowns, `dirichlet` and options by name.

    Without boundary values `dirichlet` is None: what the function takes by default.
    """

    def build(
        mesh: Any, unknowns: Mapping[str, Unknown], dirichlet: Mapping[str, Any], **options: Any
    ) -> Model:
        return function(mesh, dirichlet=dirichlet or None, **unknowns, **options)

    return build


def closed(function: Callable[..., Model], why: str) -> Callable[..., Model]:
    """Return the same for a function that takes no boundary values, and says why: `ModelError`."""

    def build(
        mesh: Any, unknowns: Mapping[str, Unknown], dirichlet: Mapping[str, Any], **options: Any
    ) -> Model:
        if dirichlet:
            raise ModelError(
                f"{function.__name__} {why}: leave out the values on {sorted(dirichlet)}."
            )
        return function(mesh, **unknowns, **options)

    return build
