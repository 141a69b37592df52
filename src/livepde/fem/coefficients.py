"""Numbers that are computed from the unknowns, and in which a form is linear: k/C, say."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any

import numpy as np

from livepde.fem.fields import Integrand, On, Scalars
from livepde.fem.forms import STEP
from livepde.fem.priors import Normal
from livepde.fem.space import FunctionSpace, Named
from livepde.linalg import Array


def numbers(parameter: FunctionSpace, q: Array) -> Any:
    """Return the parameter in the form of sensor functions: numbers, arrays, mappings by name."""
    seen: dict[str, Any] = {}
    for name in parameter.names:
        part = q[parameter.part(name)]
        unknown = parameter.unknowns.get(name)
        if isinstance(unknown, Scalars):
            seen[name] = dict(zip(unknown.names, part, strict=True))
        else:
            seen[name] = part[0] if len(part) == 1 else part
    if parameter.single:
        return next(iter(seen.values()))
    return Named(**seen)


@dataclass(frozen=True, eq=False)
class Coefficients:
    """Unknowns q followed by numbers c(q) of which a form reads q.name.

    Parameters
    ----------
    parameter
        Space of the unknowns, each with a name.
    function
        q -> {name: value}, of numbers and of what forms see, point by point; analytic.
    typical
        Unknowns for which the function has values, shape (m,).
    """

    parameter: FunctionSpace
    function: Callable[[Any], Mapping[str, Any]]
    typical: Array

    @cached_property
    def _computed(self) -> Mapping[str, Any]:
        """Values for typical unknowns; arrays of those that are computed from more than numbers."""
        seen = vars(numbers(self.parameter, self.typical))
        # Regions of one unknown and nodes of another have no common shape.
        one = {name: v[:1] if isinstance(v, np.ndarray) else v for name, v in seen.items()}
        return self.function(Named(**one))

    @property
    def names(self) -> list[str]:
        """Names of the numbers."""
        return list(self._computed)

    @property
    def numeric(self) -> bool:
        """False if one of them varies in space, since an unknown does that it is computed from."""
        return all(np.ndim(value) == 0 for value in self._computed.values())

    @cached_property
    def space(self) -> FunctionSpace:
        """Space of the unknowns and of the numbers, of dimension p."""
        more = dict.fromkeys(self.names, Normal(0.0, std=1.0))
        return FunctionSpace.of({**self.parameter.unknowns, **more}, "q")

    def value(self, q: Array) -> Array:
        """Return (q, c(q)), shape (p,), for unknowns of shape (m,)."""
        computed = self.function(numbers(self.parameter, q)).values()
        return np.concatenate([q, np.array([*computed], dtype=q.dtype)])

    def slopes(self, q: Array) -> Array:
        """Return the derivative of `value`, shape (p, m), by a complex step."""
        found = np.zeros((self.space.dim, len(q)))
        found[: len(q)] = np.eye(len(q))
        for column in self.parameter.labels.values():
            stepped = q.astype(complex)
            stepped[column] += 1j * STEP
            found[len(q) :, column] = np.imag(self.value(stepped)[len(q) :]) / STEP
        return found

    def expanded(self, terms: Integrand | On | Sequence[Integrand | On]) -> list[Integrand | On]:
        """Return terms of the unknowns alone, which compute the numbers at each point."""

        def one(term: Any) -> Any:
            if isinstance(term, On):
                return On(term.name, one(term.form))

            @wraps(term)  # so that the names of its arguments stay
            def integrand(q: Any, *others: Any) -> Any:
                return term(Named(**vars(q), **self.function(q)), *others)

            return integrand

        return [one(term) for term in (terms if isinstance(terms, Sequence) else [terms])]
