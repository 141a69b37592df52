"""States of several members: dataclasses of arrays whose leading axis is the members.

Arrays without members stay empty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from livepde.linalg.arrays import Array, Mask

State = TypeVar("State")


def changed(state: State, **parts: Any) -> State:
    """Return a state with some fields exchanged: `dataclasses.replace` in a tenth of its time."""
    # Neither __init__ nor __post_init__ runs, and a cached property would be copied with the
    # fields: states have none.
    new: State = object.__new__(type(state))
    object.__setattr__(new, "__dict__", {**state.__dict__, **parts})
    return new


def product(one: Array, other: Array) -> Array:
    """Return the product of stacks of matrices, (members, ., .): a call for one costs less."""
    return one[0].dot(other[0])[None] if len(one) == 1 else one @ other


def _each(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a state whose arrays are a function of those of some states."""
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
    """Return the state of some members, by an index array; of one for a number, as one member.

    The only member is the state itself: no step writes into the arrays of a state.
    """
    if isinstance(which, int) and _members(state) == 1:
        return state
    index = [which] if isinstance(which, int) else which
    taken: State = _each(lambda array: array[index] if len(array) else array, state)
    return taken


def join(*states: State) -> State:
    """Return the states one after the other."""

    def joined(*arrays: Array) -> Array:
        return np.concatenate(_widened(arrays))

    whole: State = _each(joined, *states)
    return whole


def join_fields(states: Sequence[State], names: Sequence[str]) -> State:
    """Return some fields of states one after the other; the only state as it is.

    The others are not there: whoever reads them finds an error, and no wrong number.
    """
    if len(states) == 1:
        return states[0]
    new: State = object.__new__(type(states[0]))
    parts = {name: join(*(getattr(state, name) for state in states)) for name in names}
    object.__setattr__(new, "__dict__", parts)
    return new


def put(state: State, which: Any, part: State) -> State:
    """Return a state with some members exchanged, by an index array or a number.

    The only member is the other state itself: no step writes into the arrays of a state.
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
    """Return a state with some members exchanged: all at once, since each copies all members."""
    if len(parts) < 2:
        return next((put(state, k, one) for k, one in parts.items()), state)
    return put(state, np.array([*parts]), join(*parts.values()))


def where(chosen: Mask, state: State, other: State) -> State:
    """Return one state for the members chosen, another for the rest."""
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
    """Return a state of zeros, which takes no memory for each member of a fleet."""
    nothing: State = _each(np.zeros_like, state)
    return nothing


def _widened(arrays: tuple[Array, ...]) -> list[Array]:
    """Return arrays of members, those with fewer rows of a square root filled up with zeros."""
    # Rows of zeros do not change the covariance [U C]^T [U C].
    if arrays[0].ndim < 3 or len({array.shape[1] for array in arrays}) == 1:
        return list(arrays)
    rows = max(array.shape[1] for array in arrays)
    return [np.pad(array, ((0, 0), (0, rows - array.shape[1]), (0, 0))) for array in arrays]
