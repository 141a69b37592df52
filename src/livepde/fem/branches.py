"""Piecewise smooth functions that complex-step differentiation handles correctly.

NumPy's abs of a complex number is its modulus, and max compares imaginary parts: both lose the
derivative. The functions here select the branch by the real part, so that the complex step
differentiates that branch.
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
    """Return the larger of two values, pointwise, with its derivative."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a.real >= b.real, a, b)


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two values, pointwise, with its derivative."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a.real <= b.real, a, b)


def positive(a: Any) -> Any:
    """Return max(a, 0)."""
    return maximum(a, 0.0)
