"""Known, measured or unknown boundary fluxes and sources that are added to a process.

In the weak form of M u_t - div(D grad u) = f, a flux J into the domain contributes the boundary
integral of J v. J has the unit of D u_n.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeAlias

import numpy as np

from livepde.errors import ModelError
from livepde.fem import Channel, On, Place, Unknown, ignores
from livepde.fem.measure import Measure, sizes
from livepde.model import Model

# Largest relative error of the size of a source on the mesh without a warning.
MISSED = 0.01


@dataclass(frozen=True)
class Multiple:
    """Product of a number and the unknown of a given name."""

    unknown: str
    factor: float


Amount: TypeAlias = "float | Channel | str | Multiple"
"""A number, an input channel, the name of an unknown, or a multiple of an unknown."""


@dataclass(frozen=True)
class Flux:
    """Neumann condition D u_n = value, a flux into the domain: W/m^2 for heat conduction."""

    value: Amount


@dataclass(frozen=True)
class Exchange:
    """Robin (Newton) condition, exchange through a boundary: D u_n = coefficient (ambient - u).

    The coefficient is in W/(m^2 K) for heat conduction; `ambient` is the value of u outside.
    """

    coefficient: Amount
    ambient: Amount


Condition: TypeAlias = Flux | Exchange


@dataclass(frozen=True)
class Source:
    """Source in a part of the domain, per volume and time: W/m^3 for heat conduction.

    `over` is a predicate on x or the name of a subdomain of the mesh; None for the whole domain.
    Its border should align with cells of the mesh, because the source is integrated by cells.
    """

    value: Amount
    over: Callable[[Any], Any] | str | None = None


def with_conditions(
    model: Model,
    boundary: Mapping[str, Condition | Sequence[Condition]] | None = None,
    sources: Mapping[str, Source] | None = None,
    unknowns: Mapping[str, Unknown] | None = None,
    per: str | None = None,
) -> Model:
    """Return a process with additional boundary fluxes and sources.

    Parameters
    ----------
    model
        Process with one component and named unknowns.
    boundary
        Mapping from boundary to one or more conditions.
    sources
        Mapping from name, for messages, to source.
    unknowns
        Unknowns that the conditions name, in addition to the unknowns of the model.
    per
        Unknown that divides the equation of the model, such as an unknown heat capacity; the
        conditions are also divided by it. If the model has the coefficient per_NAME, which is 1
        over this unknown, it remains linear for known conditions.

    Raises
    ------
    ModelError
        A boundary does not exist or has a Dirichlet value, no condition names an unknown, or `per`
        is not an unknown of the model.

    Examples
    --------
    Inverse heat conduction with an unknown conductivity and heat flux J(t) into the hot face:

    >>> import livepde as lp
    >>> from livepde.models import Flux, conduction, with_conditions
    >>> wall = lp.interval(0.0, 0.1, 40)
    >>> k = lp.LogNormal(20.0, 10.0)
    >>> J = lp.Scalar(lp.Normal(0.0, 2e4), evolution=lp.RandomWalk(2e3))
    >>> slab = conduction(wall, k, {"right": lp.Channel("T_cold")}, C=3.6e6)
    >>> slab = with_conditions(slab, {"left": Flux("J")}, unknowns={"J": J})
    >>> tuple(slab.parameter_space.labels)
    ('k', 'J')
    """
    added = dict(unknowns or {})
    terms = _Terms(model, tuple(added), per)
    for name, conditions in (boundary or {}).items():
        terms.through(name, conditions)
    for name, source in (sources or {}).items():
        terms.gained(source.value, *_region(model, name, source.over))
    for name in added:
        if name not in terms.named:
            raise ModelError(f"with_conditions: no condition names the unknown '{name}'.")
    extended = model.with_unknowns(added) if added else model
    return extended.with_terms(terms.A, terms.B, terms.inputs)


def _everywhere(x: Place) -> float:
    return 1.0


class _Terms:
    """Additional terms of A, with unknowns, and of B, without unknowns."""

    def __init__(self, model: Model, unknowns: tuple[str, ...], per: str | None) -> None:
        if per is not None and per not in model.parameter_space.labels:
            raise ModelError(
                f"with_conditions: per='{per}' is not an unknown of the model; it has "
                f"{list(model.parameter_space.labels)}."
            )
        self.model, self.unknowns, self.per = model, unknowns, per
        self.inverse = f"per_{per}" if f"per_{per}" in model.computed else None
        self.named: set[str] = set()
        self.inputs: list[str] = []
        self.A: list[Any] = []
        self.B: list[Any] = []

    def through(self, boundary: str, given: Condition | Sequence[Condition]) -> None:
        """Add fluxes and exchanges at a boundary."""
        known = self.model.mesh.boundaries or {}
        if boundary not in known:
            raise ModelError(
                f"with_conditions: the mesh has no boundary '{boundary}'; it has {sorted(known)}."
            )
        if {boundary, "boundary"} & set(self.model.state_block.field.dirichlet):
            raise ModelError(
                f"with_conditions: the boundary '{boundary}' has a value, so its flux is part of "
                "the solution. Keep one of the two."
            )
        for condition in given if isinstance(given, Sequence) else [given]:
            if isinstance(condition, Flux):
                self.gained(condition.value, boundary)
            else:
                self._exchanged(boundary, condition.coefficient, condition.ambient)

    def _exchanged(self, boundary: str, coefficient: Amount, ambient: Amount) -> None:
        if isinstance(coefficient, int | float) and coefficient < 0.0:
            raise ModelError(
                f"with_conditions: the exchange at '{boundary}' has the coefficient {coefficient}; "
                "expected 0 or more. The flux into the domain is coefficient (ambient - u)."
            )
        h, outside = self._divided(coefficient), self._amount(ambient)
        # Two terms, so that the term in u depends on no input: otherwise the matrix of a stage
        # would depend on time, and its factor could not be reused.
        self._add(boundary, lambda q, u, v, x: h(q, x) * u * v, coefficient)
        self._add(boundary, lambda q, _, v, x: -h(q, x) * outside(q, x) * v, coefficient, ambient)

    def gained(
        self, value: Amount, where: str | None, inside: Callable[[Any], Any] = _everywhere
    ) -> None:
        """Add a flux or a source."""
        amount = self._divided(value)
        # The terms are on the left-hand side of M u_t + A(u) q + B(u) = f, hence the sign.
        self._add(where, lambda q, _, v, x: -amount(q, x) * inside(x) * v, value)

    def _add(self, where: str | None, plain: Callable[..., Any], *amounts: Amount) -> None:
        def known(u: Any, v: Any, x: Place) -> Any:
            return plain(None, u, v, x)

        def driving(_: Any, v: Any, x: Place) -> Any:
            return plain(None, None, v, x)

        # B and f must not depend on q, so a term with an unknown amount is part of A.
        form: Callable[..., Any]
        if self.per is not None or any(isinstance(amount, str | Multiple) for amount in amounts):
            form, terms = plain, self.A
        else:
            form, terms = driving if ignores(plain, 1) else known, self.B
        terms.append(form if where is None else On(where, form))

    def _divided(self, value: Amount) -> Callable[[Any, Place], Any]:
        """Return an amount, divided by the unknown that divides the equation, if any."""
        amount, per, inverse = self._amount(value), self.per, self.inverse
        if per is None:
            return amount
        if inverse is not None and not isinstance(value, str | Multiple):
            return lambda q, x: amount(q, x) * getattr(q, inverse)
        return lambda q, x: amount(q, x) / getattr(q, per)

    def _amount(self, value: Amount) -> Callable[[Any, Place], Any]:
        """Return an amount as a function of q and x."""
        if isinstance(value, Channel):
            self.inputs.append(value.name)
            return lambda q, x: x.inputs[value.name]
        if isinstance(value, Multiple):
            amount = self._amount(value.unknown)
            return lambda q, x: value.factor * amount(q, x)
        if not isinstance(value, str):
            number: Any = value
            if not isinstance(number, Real) or not math.isfinite(number):
                raise ModelError(
                    f"with_conditions: got {number!r:.60}; expected a finite number, a Channel, or "
                    "the name of an unknown."
                )
            return lambda q, x: value
        if value not in self.unknowns:
            raise ModelError(
                f"with_conditions: '{value}' is none of the unknowns {list(self.unknowns)}; "
                f"write Channel('{value}') for an input channel."
            )
        self.named.add(value)
        return lambda q, x: getattr(q, value)


def _region(model: Model, name: str, over: Any) -> tuple[str | None, Callable[[Any], Any]]:
    """Return the subdomain of a source, None for the whole domain, and its indicator function."""
    if over is None:
        return None, _everywhere
    if isinstance(over, str):
        if over not in (model.mesh.subdomains or {}):
            raise ModelError(f"source '{name}': the mesh has no subdomain '{over}'.")
        return over, _everywhere
    # The predicate is evaluated at the mean of the vertices of each cell.
    if not np.any(over(model.mesh.p[:, model.mesh.t].mean(axis=1))):
        raise ModelError(f"source '{name}': no cell of the mesh lies in it.")
    measure = Measure(model.mesh, model.order, weight=model.state_space.weight)
    size, exact = sizes(measure, over)
    if abs(size - exact) > MISSED * exact:
        warnings.warn(
            f"source '{name}': its border crosses cells of the mesh, which integrate it over "
            f"{size:.3g} instead of {exact:.3g}, so its power is wrong by the same factor. Let "
            "nodes of the mesh lie on its border, or use smaller cells.",
            stacklevel=3,
        )
    return None, over
