"""Functions for weak forms: scikit-fem's helpers by their mathematical names, and branches.

NumPy's abs of a complex number is its modulus, and max compares imaginary parts: both lose the
derivative of a complex step. The functions here select the branch by the real part, so that the
complex step differentiates that branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from skfem.helpers import dd as hess
from skfem.helpers import ddot, div, dot, grad, mul, trace, transpose

__all__ = [
    "absolute",
    "ddot",
    "div",
    "dot",
    "grad",
    "hess",
    "maximum",
    "minimum",
    "mul",
    "positive",
    "trace",
    "transpose",
]


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
