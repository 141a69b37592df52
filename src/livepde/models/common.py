"""Common parts of nonlinear wave equations: coefficients, boundaries, initial state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from livepde.fem import Field, Integrand, Unknown
from livepde.models.description import Variable

__all__ = ["INITIAL", "Coefficients", "Number", "beginning", "state"]

Number: TypeAlias = Unknown | float
"""A coefficient of an equation: unknown, or a known number."""

INITIAL = Variable("", "initial state, a field; else the case's `initial`", optional=True)
SIDES = (("left", "right"), ("bottom", "top"), ("front", "back"))


@dataclass(frozen=True)
class Coefficients:
    """Coefficients of an equation by name, known or unknown."""

    given: Mapping[str, Number]

    @property
    def unknown(self) -> dict[str, Unknown]:
        """The unknown coefficients."""
        return {k: v for k, v in self.given.items() if not isinstance(v, int | float)}

    def __call__(self, q: Any, name: str) -> Any:
        """Return the value of a coefficient within a form."""
        value = self.given[name]
        return float(value) if isinstance(value, int | float) else getattr(q, name)


def state(mesh: Any, element: Any, dirichlet: Mapping[str, Any] | None, unit: str = "") -> Field:
    """Return the field of the state: periodic, or with Dirichlet values."""
    if dirichlet is not None:
        return Field(mesh, element, dirichlet=dict(dirichlet), unit=unit)
    pairs = [pair for pair in SIDES if set(pair) <= set(mesh.boundaries or {})]
    return Field(mesh, element, periodic=pairs, unit=unit)


def beginning(u0: Unknown | None, u: Field) -> tuple[dict[str, Unknown], Integrand | None]:
    """Return an unknown initial state by name, and the form `initial` of a model.

    A field inherits the boundaries of the state: periodic, or zero where the state is fixed at
    zero.
    """
    if u0 is None:
        return {}, None
    if isinstance(u0, Field):
        held = {name: 0.0 for name, value in u.dirichlet.items() if value == 0.0}
        u0 = replace(u0, dirichlet=held, periodic=u.periodic)
    return {"u0": u0}, lambda q, v, x: q.u0 * v
