"""What a weak form may write: scikit-fem's helpers, under the names of the mathematics."""

from __future__ import annotations

from skfem.helpers import dd as hess
from skfem.helpers import ddot, div, dot, grad, mul, trace, transpose

__all__ = ["ddot", "div", "dot", "grad", "hess", "mul", "trace", "transpose"]
