"""The paper's operators M and N for diffusion, (MN1) and (MN2), as integrands for `GradientLaw`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from livepde.fem import Predicate, dot, grad

__all__ = ["DampingOperator", "observed_operator", "unobserved_operator"]

Diffusivity: TypeAlias = float | Callable[[Any], Any]


@dataclass(frozen=True)
class DampingOperator:
    """The integrand of M or N: |D| grad v . grad phi on a part of the domain, v phi on all of it.

        (M v, phi)_X = integral over omega of |D| grad v . grad phi
                       + integral over Omega of v phi                                      (MN1)

    and (MN2) the same for N on Omega without omega. With |D| both are coercive whatever the sign
    of D, (M v, v)_X = ||sqrt|D| grad v||^2 + ||v||^2 = ||v||_VX~^2 with c_M = 1; in their own norms
    M and N are bounded as long as D does not change its sign on omega nor outside.

    Parameters
    ----------
    D
        Diffusivity: a number, or a function of x; of any sign.
    part
        Predicate on x of shape (d, ...), evaluated at the quadrature points.
    """

    D: Diffusivity
    part: Predicate

    def __call__(self, v: Any, phi: Any, x: Any) -> Any:
        """Return the integrand."""
        D = self.D(x) if callable(self.D) else self.D
        slopes = dot(grad(v), grad(phi))
        place = np.array([x[axis] for axis in range(len(grad(v)))])
        inside = np.asarray(self.part(place), dtype=float)
        return inside * np.abs(D) * slopes + v * phi


def observed_operator(omega: Predicate, D: Diffusivity) -> DampingOperator:
    """Return M of (MN1), for `GradientLaw(M_op=...)`; omega as for `Subdomain`.

    >>> import livepde as lp
    >>> omega = lambda x: x[0] < 0.5
    >>> M, N = observed_operator(omega, -1.0), unobserved_operator(omega, -1.0)
    >>> law = lp.GradientLaw(nu=2.0, M_op=M, N_op=N)
    """
    return DampingOperator(D, omega)


def unobserved_operator(omega: Predicate, D: Diffusivity) -> DampingOperator:
    """Return N of (MN2), for `GradientLaw(N_op=...)`: the gradient counts outside of omega."""
    return DampingOperator(D, _Outside(omega))


@dataclass(frozen=True)
class _Outside:
    """The complement of a set."""

    inside: Predicate

    def __call__(self, x: Any) -> Any:
        return np.logical_not(self.inside(x))
