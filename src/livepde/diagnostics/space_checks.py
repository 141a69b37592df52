"""Check of a Hilbert space: symmetric positive definite Gram matrix, and Riesz map."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.check_report import Check, CheckReport
from livepde.errors import LinearAlgebraError, SpaceError
from livepde.linalg import Array
from livepde.spaces import HilbertSpace

ROUNDING = 1e-12


def check_space(space: HilbertSpace, *, seed: int = 0) -> CheckReport:
    """Check symmetry, positivity and the Riesz map of a Hilbert space.

    Parameters
    ----------
    space
        The space, such as `model.X` or `model.Q`.
    seed
        Seed of the random vectors.

    Examples
    --------
    >>> import scipy.sparse as sp
    >>> import livepde as lp
    >>> check_space(lp.spaces.HilbertSpace(sp.csr_array([[2.0, 1.0], [1.0, 2.0]]))).ok
    True
    """
    rng = np.random.default_rng(seed)
    name = f"space {space.name}"
    gram = space.tangent_gram
    lines = [
        Check.at_most(
            "G = G^T",
            relative(gram - gram.T, gram),
            ROUNDING,
            "Write the inner product as a form that does not change when u and v are exchanged.",
        ),
        definite(space),
    ]
    if lines[-1].ok:
        x = rng.standard_normal(space.dim) * space.free
        functional = rng.standard_normal(space.dim)
        y = space.riesz(functional)
        size = (space.norm(x) * space.norm(y)) or 1.0
        singular = (
            "The Gram matrix is close to singular: add a zero-order term to the inner product or "
            "fix boundary values."
        )
        lines += [
            Check.at_most(
                "(riesz(f), x) = f(x)",
                abs(space.inner(y, x) - float(functional @ x)) / size,
                ROUNDING,
                singular,
            ),
            Check.at_most(
                "riesz(dual(x)) = x",
                space.norm(space.riesz(space.dual(x)) - x) / (space.norm(x) or 1.0),
                1e-9,
                singular,
            ),
        ]
    return CheckReport(name, tuple(lines), SpaceError)


def definite(space: HilbertSpace) -> Check:
    """Return the line on positive definiteness: the Gram matrix can be factorised."""
    remedy = ""
    try:
        _ = space.factor
    except (SpaceError, LinearAlgebraError) as error:
        remedy = str(error)
    return Check.at_most("G positive definite (failures)", bool(remedy), 0, remedy)


def relative(difference: sp.csr_array | Array, reference: sp.csr_array | Array) -> float:
    """Return the largest entry of a difference relative to the largest entry of a reference."""
    return relative_to(largest(difference), largest(reference))


def relative_to(error: float, size: float) -> float:
    """Return an error relative to a size; the error itself if the size is zero."""
    return error / size if size > 0 else error


def largest(matrix: sp.csr_array | Array) -> float:
    """Return the largest entry in modulus; NaN if one is not finite."""
    data = matrix.data if sp.issparse(matrix) else np.asarray(matrix)
    return float(np.abs(data).max(initial=0.0))
