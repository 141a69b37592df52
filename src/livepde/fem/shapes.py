"""Notation of weak forms: scikit-fem's helpers under their mathematical names."""

from __future__ import annotations

from skfem.helpers import dd as hess
from skfem.helpers import ddot, div, dot, grad, mul, trace, transpose

__all__ = ["ddot", "div", "dot", "grad", "hess", "mul", "trace", "transpose"]
