"""Functions that see overflow and undefined values in their results, without warnings of NumPy."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

__all__ = ["silenced"]

Given = ParamSpec("Given")
Result = TypeVar("Result")


def silenced(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Decorate a function in which overflow, division by zero and undefined values are no news."""

    # np.errstate itself is no decorator here: with NumPy 1 one object keeps the state of before,
    # for all threads, and for calls within calls.
    @wraps(function)
    def called(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return function(*args, **kwargs)

    return called
