"""States of members that have their own sample times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from livepde import checkpoint
from livepde.fleet.engines import State
from livepde.fleet.fleet import Fleet
from livepde.linalg import Array, IntArray

LOG = "state.log"  # its second axis has as many rows as a member needs
ROOM = 8  # rows by which a log grows


class OwnStates:
    """States of members that step one by one, each a separate value."""

    def __init__(self, template: State, count: int) -> None:
        self._template = template[0]
        self._states = [self._template] * count

    def rows(self, k: int) -> int:
        """Return 0: states that are stepped one by one need not be alike."""
        return 0

    def take(self, which: IntArray) -> State:
        """Return the states of some members as their engine steps them."""
        return tuple(self._states[k] for k in which)

    def put(self, which: IntArray, state: State) -> None:
        """Store states that were stepped."""
        for k, one in zip(which.tolist(), state, strict=True):
            self._states[k] = one

    def leaves(self) -> dict[str, Any]:
        """Return all states as arrays by name."""
        return checkpoint.flatten(tuple(self._states))

    def restored(self, leaves: Mapping[str, Array]) -> OwnStates:
        """Return the states from their `leaves`; raises KeyError or ValueError if they misfit."""
        other = OwnStates((self._template,), 0)
        each = range(len(self._states))
        other._states = [checkpoint.rebuild(self._template, leaves, f"state.{k}") for k in each]
        return other


class JoinedStates:
    """States of members that step as blocks: arrays over members, written in place.

    A leaf that is equal for all members (such as a fit before the first one) is stored
    once. Of the log each member has rows of its own.
    """

    def __init__(self, template: State, count: int) -> None:
        self._template = template
        self._count = count
        self._rows: IntArray = np.zeros(count, dtype=np.int64)
        self._leaves: dict[str, Array] = checkpoint.flatten(template)
        self._log = np.zeros((count, 0, self._leaves.pop(LOG).shape[2]))
        self._once = set(self._leaves)
        self._taken: dict[str, Array] = {}

    def rows(self, k: int) -> int:
        """Return how many rows the log of a member has: those of a block are as long."""
        return int(self._rows[k])

    def take(self, which: IntArray) -> State:
        """Return the states of some members, with as many rows in their logs."""
        length, first = len(which), int(which[0])
        index: Any = which
        if np.array_equal(which, np.arange(first, first + length)):
            index = slice(first, first + length)  # no copy
        found = {
            path: _repeated(leaf, length) if path in self._once else leaf[index]
            for path, leaf in self._leaves.items()
        }
        self._taken = found
        found = {**found, LOG: self._log[which][:, : self._rows[first]]}
        state: State = checkpoint.rebuild(self._template, found)
        return state

    def put(self, which: IntArray, state: State) -> None:
        """Store states that were stepped: those that were taken last, or begun."""
        leaves = checkpoint.flatten(state)
        self._put_log(which, leaves.pop(LOG))
        changed = {path: new for path, new in leaves.items() if new is not self._taken.get(path)}
        # An array may be a view of one that is overwritten now, as of a filter that becomes the
        # older one: it is copied first.
        changed = {path: new if new.base is None else new.copy() for path, new in changed.items()}
        for path, new in changed.items():
            self._put_leaf(which, path, new)
        self._taken = {}

    def _put_leaf(self, which: IntArray, path: str, new: Array) -> None:
        leaf = self._leaves[path]
        if not len(new):  # there is nothing of any member
            self._leaves[path] = new
            return
        if path in self._once:  # stored once as long as no member differs
            if leaf.shape[1:] == new.shape[1:] and np.array_equal(
                np.broadcast_to(leaf, new.shape), new, equal_nan=leaf.dtype.kind == "f"
            ):
                return
            self._once.remove(path)
            leaf = np.repeat(leaf, self._count, axis=0)
        if leaf.ndim > 2:  # square roots of covariances, whose rows may become more
            room = max(leaf.shape[1], new.shape[1])
            leaf, new = (_widened(array, room, 0.0) for array in (leaf, new))
        leaf[which] = new
        self._leaves[path] = leaf

    def _put_log(self, which: IntArray, log: Array) -> None:
        rows = log.shape[1]
        if rows > self._log.shape[1]:
            self._log = _widened(self._log, rows + ROOM, np.inf)
        self._log[which, :rows] = log
        self._log[which, rows:] = np.inf
        self._rows[which] = rows

    def leaves(self) -> dict[str, Any]:
        """Return all states as arrays by name."""
        return {"rows": self._rows, LOG: self._log, **self._leaves}

    def restored(self, leaves: Mapping[str, Array]) -> JoinedStates:
        """Return the states from their `leaves`; raises KeyError or ValueError if they misfit."""
        other = JoinedStates(self._template, self._count)
        other._rows, other._log = leaves["rows"].astype(np.int64), leaves[LOG]
        other._leaves = {path: leaves[path] for path in self._leaves}
        lengths = {path: len(leaf) for path, leaf in other._leaves.items()}
        other._once = {path for path, length in lengths.items() if length < self._count}
        if {len(other._rows), len(other._log), *lengths.values()} - {0, 1, self._count}:
            raise ValueError(f"states of other than {self._count} members")
        if self._count == 1:
            other._once = set()
        other.take(np.array([0]))  # raises unless they have the structure of the template
        return other


def _repeated(leaf: Array, length: int) -> Array:
    """Return a leaf of one member as that of several; one without members stays so."""
    return (
        leaf if length == 1 or not len(leaf) else np.broadcast_to(leaf, (length, *leaf.shape[1:]))
    )


def _widened(array: Array, room: int, value: float) -> Array:
    """Return an array with so many entries on its second axis."""
    more = room - array.shape[1]
    if more <= 0:
        return array
    return np.pad(array, ((0, 0), (0, more), (0, 0)), constant_values=value)


MemberStates = OwnStates | JoinedStates


def states_of(fleet: Fleet) -> MemberStates:
    """Return room for the states of the members of a fleet."""
    store = JoinedStates if fleet.together else OwnStates
    return store(fleet.template(), len(fleet))
