"""Operations whose results may overflow or be invalid, because they are checked afterwards."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


class nonfinite_allowed:
    """A context, or a decorator, without warnings of numbers that are not finite.

    Not `np.errstate` as a decorator: that is one object for all calls, which with NumPy 1 keeps the
    old state of all threads in one place. This one makes an object for each call. Nor
    `contextlib.contextmanager`, whose generator costs a step of a small model more.
    """

    def __enter__(self) -> None:
        self._state = np.errstate(over="ignore", invalid="ignore", divide="ignore")
        self._state.__enter__()

    def __exit__(self, *error: Any) -> None:
        self._state.__exit__(*error)

    def __call__(self, function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def inner(*args: P.args, **kwargs: P.kwargs) -> R:
            with nonfinite_allowed():
                return function(*args, **kwargs)

        return inner
