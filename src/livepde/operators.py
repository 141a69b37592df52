"""Linear operators between Hilbert spaces, with transpose and adjoint."""

from __future__ import annotations

from dataclasses import dataclass

import scipy.sparse as sp

from livepde.errors import SpaceError
from livepde.linalg import Array
from livepde.spaces import HilbertSpace

__all__ = ["DualOperator"]


@dataclass(frozen=True, eq=False)
class DualOperator:
    """A linear operator T: source -> target*, given by a weak form.

    Parameters
    ----------
    matrix
        Shape (target.dim, source.dim); row i is the functional tested with basis function i.
    source, target
        The spaces; the values of the operator are *dual* vectors of `target`.
    """

    matrix: sp.csr_array
    source: HilbertSpace
    target: HilbertSpace

    def __post_init__(self) -> None:
        expected = (self.target.dim, self.source.dim)
        if self.matrix.shape != expected:
            raise SpaceError(
                f"Operator {self.source.name} -> {self.target.name}*: matrix of shape "
                f"{self.matrix.shape}, the spaces need {expected}."
            )

    def __call__(self, x: Array) -> Array:
        """Return T x, a dual vector of the target, shape (target.dim,)."""
        value: Array = self.matrix @ x
        return value

    def transposed(self, y: Array) -> Array:
        """Return T^T y, a dual vector of the source, for y in the target."""
        value: Array = self.matrix.T @ y
        return value

    def adjoint(self, y: Array) -> Array:
        """Return T* y in the source: (T* y, xi)_source = <T xi, y> for every tangent xi.

        The paper's A(u)^*: Q <- X of (est_exact_q), a transpose and one Riesz solve.
        """
        return self.source.riesz(self.transposed(y))
