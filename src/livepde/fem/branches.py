"""Functions with kinks, written so that a complex step differentiates them.

NumPy's abs of a complex number is its modulus, and max compares imaginary parts: both lose the
derivative. These take the branch by the real part, so that derivatives are those of the branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["absolute", "maximum", "minimum", "positive"]


def absolute(a: Any) -> Any:
    """Return |a|; its derivative is the sign of a."""
    a = np.asarray(a)
    return np.where(a.real < 0.0, -a, a)


def maximum(a: Any, b: Any) -> Any:
    """Return the larger one of two, point by point, with its derivative."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a.real >= b.real, a, b)


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller one of two, point by point, with its derivative."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a.real <= b.real, a, b)


def positive(a: Any) -> Any:
    """Return max(a, 0)."""
    return maximum(a, 0.0)
