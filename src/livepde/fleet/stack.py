"""Values of many members as arrays with a leading axis of members."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde import checkpoint
from livepde.linalg import Array, Mask

__all__ = ["Stack"]

PREFIX = "value"


@dataclass(frozen=True, eq=False)
class Stack:
    """Values of one type, one for each member: every leaf is an array over members.

    Attributes
    ----------
    template
        A value of the type: a dataclass of arrays and numbers.
    leaves
        Dotted path of each leaf -> array of shape (members, ...).
    """

    template: Any
    leaves: Mapping[str, Array]

    @classmethod
    def of(cls, values: Sequence[Any]) -> Stack:
        """Stack values of one type and of equal shapes."""
        rows = [_leaves(value) for value in values]
        return cls(values[0], {path: np.stack([row[path] for row in rows]) for path in rows[0]})

    def __getitem__(self, path: str) -> Array:
        return self.leaves[path]

    def member(self, k: int) -> Any:
        """Return the value of one member."""
        leaves = {f"{PREFIX}.{path}": leaf[k] for path, leaf in self.leaves.items()}
        return checkpoint.rebuild(self.template, leaves, PREFIX)

    def changed(self, leaves: Mapping[str, Array]) -> Stack:
        """Return the values with some leaves exchanged."""
        return Stack(self.template, {**self.leaves, **leaves})

    def where(self, chosen: Mask, other: Stack) -> Stack:
        """Return these values for the members chosen, those of another stack for the rest."""
        if chosen.all():
            return self
        if not chosen.any():
            return other
        leaves = {}
        for path, leaf in self.leaves.items():
            mask = chosen.reshape(-1, *(1,) * (leaf.ndim - 1))
            leaves[path] = np.where(mask, leaf, other[path])
        return Stack(self.template, leaves)

    def put(self, values: Mapping[int, Any]) -> Stack:
        """Return the stack with the values of some members exchanged."""
        if not values:
            return self
        leaves = {path: leaf.copy() for path, leaf in self.leaves.items()}
        for k, value in values.items():
            for path, leaf in _leaves(value).items():
                leaves[path][k] = leaf
        return Stack(self.template, leaves)


def _leaves(value: Any) -> dict[str, Any]:
    flat = checkpoint.flatten(value, PREFIX)
    return {path.removeprefix(f"{PREFIX}."): leaf for path, leaf in flat.items()}
