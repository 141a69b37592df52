"""States of several members: dataclasses of arrays whose leading axis is over members.

Arrays that a state does not use are empty, with a leading axis of length zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from livepde.linalg.arrays import Array, Mask

State = TypeVar("State")


def changed(state: State, **parts: Any) -> State:
    """Return a state with new values of fields, ten times faster than `dataclasses.replace`."""
    # Neither __init__ nor __post_init__ is called. States must not have cached properties, because
    # these would be copied.
    new: State = object.__new__(type(state))
    object.__setattr__(new, "__dict__", {**state.__dict__, **parts})
    return new


def product(one: Array, other: Array) -> Array:
    """Return the product of stacks of matrices, (members, ., .), faster for a single member."""
    return one[0].dot(other[0])[None] if len(one) == 1 else one @ other


def _each(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a state whose arrays are a function of the corresponding arrays of states."""
    if isinstance(first, np.ndarray):
        return function(first, *others)
    parts = {
        name: _each(function, value, *(getattr(other, name) for other in others))
        for name, value in vars(first).items()
    }
    return changed(first, **parts)


def _members(state: Any) -> int:
    while not isinstance(state, np.ndarray):
        state = next(iter(vars(state).values()))
    return len(state)


def take(state: State, which: Any) -> State:
    """Return the state of the members in an index array, or of one member by its index.

    For a state with one member it is the state itself, because arrays of states are immutable.
    """
    if isinstance(which, int) and _members(state) == 1:
        return state
    if isinstance(which, int):  # slicing is faster; without a copy, all members stay in memory
        part = slice(which, which + 1)
        taken: State = _each(lambda array: array[part].copy(), state)
    else:
        taken = _each(lambda array: array[which] if len(array) else array, state)
    return taken


def join(*states: State) -> State:
    """Return the concatenation of states along the axis of members."""

    def joined(*arrays: Array) -> Array:
        return np.concatenate(_widened(arrays))

    whole: State = _each(joined, *states)
    return whole


def join_fields(states: Sequence[State], names: Sequence[str]) -> State:
    """Return the concatenation of states for some fields; a single state is returned unchanged.

    Other fields are not set, so that access to them is an error instead of a wrong value.
    """
    if len(states) == 1:
        return states[0]
    new: State = object.__new__(type(states[0]))
    parts = {name: join(*(getattr(state, name) for state in states)) for name in names}
    object.__setattr__(new, "__dict__", parts)
    return new


def put(state: State, which: Any, part: State) -> State:
    """Return a state with members replaced by `part`, at an index array or a single index.

    For a state with one member it is `part` itself, because arrays of states are immutable.
    """
    if isinstance(which, int) and _members(state) == 1:
        return part
    index = [which] if isinstance(which, int) else which

    def exchanged(array: Array, new: Array) -> Array:
        if not len(array):
            return array
        array, new = _widened((array, new))
        result = array.copy()
        result[index] = new
        return result

    whole: State = _each(exchanged, state, part)
    return whole


def put_each(state: State, parts: Mapping[int, State]) -> State:
    """Return a state with members replaced, by index, with a single copy of the arrays."""
    if len(parts) < 2:
        return next((put(state, k, one) for k, one in parts.items()), state)
    return put(state, np.array([*parts]), join(*parts.values()))


def where(chosen: Mask, state: State, other: State) -> State:
    """Return a state with the chosen members of `state` and the other members of `other`."""
    if chosen.all():
        return state
    if not chosen.any():
        return other

    def either(one: Array, two: Array) -> Array:
        if not len(one):
            return one
        one, two = _widened((one, two))
        return np.where(chosen.reshape(-1, *(1,) * (one.ndim - 1)), one, two)

    mixed: State = _each(either, state, other)
    return mixed


def zeros(state: State) -> State:
    """Return a state of zeros with the shapes of a state."""
    nothing: State = _each(np.zeros_like, state)
    return nothing


def _widened(arrays: tuple[Array, ...]) -> list[Array]:
    """Return arrays of members with the rows of square roots padded to a common number."""
    # Rows of zeros do not change the covariance [U C]^T [U C].
    if arrays[0].ndim < 3 or len({array.shape[1] for array in arrays}) == 1:
        return list(arrays)
    rows = max(array.shape[1] for array in arrays)
    return [np.pad(array, ((0, 0), (0, rows - array.shape[1]), (0, 0))) for array in arrays]
