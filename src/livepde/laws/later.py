"""Values that are computed when they are read, for many samples at once where that is cheaper."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Generic, TypeVar

T = TypeVar("T")
Other = TypeVar("Other")


@dataclass(frozen=True, eq=False)
class Later(Generic[T]):
    """A function without arguments that can be evaluated together with others of its kind."""

    of: Callable[[Sequence[Any]], Sequence[Any]]  # returns a value for each of several items
    item: Any  # the item of this function
    kind: Hashable  # equal for functions with the same `of` and compatible items; None: not joined
    change: Callable[[Any], T] = lambda value: value  # applied to the value before it is returned

    def __call__(self) -> T:
        return self.change(self.of([self.item])[0])


def then(read: Callable[[], T], change: Callable[[T], Other]) -> Callable[[], Other]:
    """Return the composition of `change` with a function without arguments."""
    if isinstance(read, Later):
        return replace(read, change=lambda value: change(read.change(value)))
    return lambda: change(read())


def together(reads: Sequence[Callable[[], T]]) -> list[T]:
    """Return the values of functions; consecutive functions of one kind are evaluated at once."""
    values: list[T] = []
    for kind, each in groupby(reads, lambda read: getattr(read, "kind", None)):
        group: list[Any] = [*each]
        if kind is None:
            values += [read() for read in group]
        else:
            results = group[0].of([read.item for read in group])
            values += [read.change(value) for read, value in zip(group, results, strict=True)]
    return values
