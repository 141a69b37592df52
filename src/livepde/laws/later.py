"""Values that are computed when they are read: of many samples at once, where that costs less."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Generic, TypeVar

T = TypeVar("T")
Other = TypeVar("Other")


@dataclass(frozen=True, eq=False)
class Later(Generic[T]):
    """A function without arguments, which others of its kind can be called together with."""

    of: Callable[[Sequence[Any]], Sequence[Any]]  # returns a value for each of several items
    item: Any  # the item of this function
    kind: Hashable  # equal for functions with one `of` whose items fit together; None: for none
    change: Callable[[Any], T] = lambda value: value  # of the value, before it is returned

    def __call__(self) -> T:
        return self.change(self.of([self.item])[0])


def then(read: Callable[[], T], change: Callable[[T], Other]) -> Callable[[], Other]:
    """Return a function that returns a function of what another one returns."""
    if isinstance(read, Later):
        return replace(read, change=lambda value: change(read.change(value)))
    return lambda: change(read())


def together(reads: Sequence[Callable[[], T]]) -> list[T]:
    """Return the values of functions: those of one kind are computed at once."""
    found: list[T] = []
    for kind, each in groupby(reads, lambda read: getattr(read, "kind", None)):
        group: list[Any] = [*each]
        if kind is None:
            found += [read() for read in group]
        else:
            values = group[0].of([read.item for read in group])
            found += [read.change(value) for read, value in zip(group, values, strict=True)]
    return found
