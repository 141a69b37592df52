"""Krylov methods that return to a stated tolerance, or say why they did not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse.linalg import LinearOperator
from scipy.sparse.linalg import gmres as scipy_gmres

from livepde.errors import LinearAlgebraError
from livepde.linalg.types import Array

__all__ = ["conjugate_gradients", "gmres"]

Map = Callable[[Array], Array]


def conjugate_gradients(
    apply: Map, precondition: Map, b: Array, tolerance: float, limit: int, remedy: str
) -> tuple[Array, int]:
    """Solve with a symmetric positive definite matrix, for all right-hand sides at once.

    Parameters
    ----------
    apply, precondition
        Products with the matrix and with the approximate inverse, for arrays like b.
    b
        Shape (n,) or (n, k).
    tolerance
        Bound on the residual, relative to each right-hand side.
    limit
        At most this many iterations.
    remedy
        What to do if they do not suffice.

    Returns
    -------
    x
        The solution.
    iterations
        How many it took.

    Raises
    ------
    LinearAlgebraError
        The matrix or the preconditioner is not positive definite, or `limit` was reached.
    """
    x, r = np.zeros_like(b), b.copy()
    goal = tolerance * np.linalg.norm(b, axis=0)
    p, rz = np.zeros_like(b), np.ones(b.shape[1:])
    for iteration in range(limit + 1):
        left = np.linalg.norm(r, axis=0)
        if np.all(left <= goal):
            return x, iteration
        z = precondition(r)
        new = np.einsum("i...,i...->...", r, z)
        p = z + _ratio(new, rz if iteration else np.full_like(rz, np.inf)) * p
        Kp = apply(p)
        curvature = np.einsum("i...,i...->...", p, Kp)
        active = left > goal
        if not (np.all(curvature[active] > 0) and np.all(new[active] > 0)):
            raise LinearAlgebraError(
                "The matrix is not positive definite to working precision: check the signs of the "
                "forms, or take a smaller time step."
            )
        step = _ratio(new * active, curvature)
        x += step * p
        r -= step * Kp
        rz = new
    worst = float(np.max(_ratio(left, np.linalg.norm(b, axis=0))))
    raise LinearAlgebraError(
        f"{limit} iterations of conjugate gradients left a residual of {worst:.1e}, with "
        f"{tolerance:.0e} asked for: {remedy}"
    )


def _ratio(a: Array, b: Array) -> Array:
    """Return a/b, zero where b is."""
    ratio: Array = np.divide(a, b, out=np.zeros_like(np.asarray(b, dtype=float)), where=b != 0)
    return ratio


def gmres(
    apply: Map, precondition: Map, b: Array, tolerance: float, limit: int, remedy: str
) -> tuple[Array, int]:
    """Solve with any regular matrix, preconditioned from the left; as `conjugate_gradients`.

    `tolerance` bounds the preconditioned residual, which is about the error, relative to the
    preconditioned right-hand side. b has shape (n,).
    """
    right = precondition(b)
    if not np.isfinite(right).all():
        raise LinearAlgebraError("The preconditioned right-hand side is not finite.")
    shape = (len(b), len(b))
    operator = LinearOperator(shape, matvec=lambda x: precondition(apply(x)), dtype=float)
    seen: list[float] = []
    x, failed = scipy_gmres(
        operator,
        right,
        rtol=tolerance,
        restart=limit,
        maxiter=1,
        callback=seen.append,
        callback_type="pr_norm",
    )
    if failed:
        raise LinearAlgebraError(
            f"{limit} iterations of GMRES left a residual of {seen[-1]:.1e}, with "
            f"{tolerance:.0e} asked for: {remedy}"
        )
    return x, len(seen)
