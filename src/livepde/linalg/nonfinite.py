"""Operations whose results may overflow or be invalid, because they are checked afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

__all__ = ["nonfinite_allowed"]


@contextmanager
def nonfinite_allowed() -> Iterator[None]:
    """Return a context, or a decorator, without warnings of numbers that are not finite.

    Not `np.errstate` as a decorator: that is one object for all calls, which with NumPy 1 keeps the
    old state of all threads in one place. This one makes an object for each call.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        yield
