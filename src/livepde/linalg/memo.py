"""Values computed once for each key, which threads may ask for at the same time."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

__all__ = ["Memo"]

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Memo(Generic[Key, Value]):
    """A bounded memo of a function: it empties itself rather than grow beyond `most` values.

    Two threads that ask for the same key at once both compute it, and get equal values; what is
    kept must never change.

    >>> squares = Memo(most=2)
    >>> sum(squares.get(k, lambda k=k: k**2) for k in (1, 2, 3))
    14
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # Replaced as a whole and never changed: a thread that has read it finds what it has seen.
        self._values: Mapping[Key, Value] = {}

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of a key, made if it is not known."""
        values = self._values
        if key in values:
            return values[key]
        value = make()
        values = self._values
        self._values = {**(values if len(values) < self._most else {}), key: value}
        return value

    def __len__(self) -> int:
        return len(self._values)
