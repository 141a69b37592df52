"""Bounded memoisation of values by key, safe for threads."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Memo(Generic[Key, Value]):
    """A bounded memo of a function: cleared when it would grow beyond `most` values.

    Two threads that ask for the same key at once both compute it, and get equal values. Values must
    be immutable.

    >>> squares = Memo(most=2)
    >>> sum(squares.get(k, lambda k=k: k**2) for k in (1, 2, 3))
    14
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # The dictionary is replaced as a whole and never mutated, so that a thread may keep reading
        # the one it has: no lock is needed.
        self._values: Mapping[Key, Value] = {}

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of a key, computed on first use."""
        values = self._values
        if key in values:
            return values[key]
        value = make()
        values = self._values
        self._values = {**(values if len(values) < self._most else {}), key: value}
        return value

    def __len__(self) -> int:
        return len(self._values)
