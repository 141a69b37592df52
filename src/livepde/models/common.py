"""Common parts of nonlinear wave equations: coefficients, boundaries, initial state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, TypeAlias

from livepde.fem import Field, Integrand, Unknown
from livepde.model import Model
from livepde.models.description import Variable

Number: TypeAlias = Unknown | float
"""A coefficient of an equation: unknown, or a known number."""

INITIAL = Variable("", "initial state, a field; else the case's `initial`", optional=True)
SIDES = (("left", "right"), ("bottom", "top"), ("front", "back"))


def state(mesh: Any, element: Any, dirichlet: Mapping[str, Any] | None, unit: str = "") -> Field:
    """Return the field of the state: periodic, or with Dirichlet values."""
    if dirichlet is not None:
        return Field(mesh, element, dirichlet=dict(dirichlet), unit=unit)
    pairs = [pair for pair in SIDES if set(pair) <= set(mesh.boundaries or {})]
    return Field(mesh, element, periodic=pairs, unit=unit)


def autonomous(
    u: Field,
    coefficients: Mapping[str, Number],
    u0: Unknown | None,
    form: Callable[[Any, Any, Any], Any],
    formula: str,
) -> Model:
    """Return u_t + A(u) = 0 with A by a form (c, u, v) of its coefficients c, known or unknown."""
    known = {k: float(v) for k, v in coefficients.items() if isinstance(v, int | float)}
    unknown: dict[str, Any] = {k: v for k, v in coefficients.items() if k not in known}
    begun, initial = _beginning(u0, u)

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return form(SimpleNamespace(**known, **{k: getattr(q, k) for k in unknown}), u, v)

    return Model(u, {**unknown, **begun}, A=A, initial=initial, formula=formula)


def _beginning(u0: Unknown | None, u: Field) -> tuple[dict[str, Unknown], Integrand | None]:
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
