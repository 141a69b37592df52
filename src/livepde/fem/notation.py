"""Functions for weak forms: scikit-fem's helpers by their mathematical names, branches, upwinding.

NumPy's abs of a complex number is its modulus, and max compares imaginary parts: both lose the
derivative of a complex step. The functions here select the branch by the real part, so that the
complex step differentiates that branch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

SERIES = (1 / 3, -1 / 45, 2 / 945, -1 / 4725, 2 / 93555, -1382 / 638512875)
# Square of the Peclet number below which the truncated series is exact to rounding.
SMALL = 0.01


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


def upwind(b: Any, kappa: Any, h: Any) -> Any:
    """Return the optimal artificial diffusion, |b| h/2 (coth Pe - 1/Pe) with Pe = |b| h/(2 kappa).

    Added to kappa, it makes elements of first order on a uniform line exact at the vertices for
    the steady -kappa u'' + b u' = 0, however large the cell Peclet number Pe (Brooks and Hughes
    1982, section 2); it vanishes like h^2 on fine meshes. In more dimensions it acts along
    the streamlines only. Smooth also at b = 0, so that derivatives by complex steps hold.

    Parameters
    ----------
    b
        Velocity: a number or array in 1D, else a tuple or list of d components.
    kappa
        Diffusivity, positive.
    h
        Size of the cells, `x.h` in a form.

    Returns
    -------
    A number for each point in 1D, else the tensor b b^T/|b|^2 times it, shape (d, d, ...).

    Examples
    --------
    >>> import livepde as lp
    >>> k = 0.01
    >>> line = lambda u, v, x: (k + upwind(2.0, k, x.h)) * lp.dot(lp.grad(u), lp.grad(v))
    >>> def plane(u, v, x):
    ...     return lp.dot(lp.fem.mul(upwind((2.0, x[0]), k, x.h), lp.grad(u)), lp.grad(v))
    >>> round(float(upwind(2.0, k, 0.1)), 6)  # nearly |b| h/2
    0.09
    """
    components = list(b) if isinstance(b, Sequence) else [b]
    square = sum(part * part for part in components)
    factor = h * h / (4.0 * kappa) * _even(square * (h / (2.0 * kappa)) ** 2)
    if not isinstance(b, Sequence):
        return factor * square
    rows = [[factor * p * q for q in components] for p in components]
    flat = np.broadcast_arrays(*(entry for row in rows for entry in row))
    return np.stack(flat).reshape(len(rows), len(rows), *flat[0].shape)


def _even(w: Any) -> Any:
    """Return (coth z - 1/z)/z with w = z^2: analytic in w, also at zero."""
    w = np.asarray(w)
    small = np.abs(w) < SMALL
    z = np.sqrt(np.where(small, 1.0, w))
    decay = np.exp(-2.0 * z)
    far = ((1.0 + decay) / (1.0 - decay) - 1.0 / z) / z
    near = np.polynomial.polynomial.polyval(np.where(small, w, 0.0), SERIES)
    return np.where(small, near, far)
