"""The paper's operators M and N for diffusion, (MN1) and (MN2), as an integrand for both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from livepde.fem import dot, grad

Diffusivity: TypeAlias = float | Callable[[Any], Any]


@dataclass(frozen=True)
class DiffusionOperator:
    """The integrand |D| grad v . grad phi + v phi of M and N.

        (M v, phi)_X = integral over omega of |D| grad v . grad phi + v phi                 (MN1)

    and (MN2) the same for N over Omega without omega: the law integrates each over its part. With
    |D| both are coercive whatever the sign of D,
    (M v, v)_X = ||sqrt|D| grad v||^2 + ||v||^2 = ||v||_VX~^2 with c_M = 1; in their own norms M and
    N are bounded as long as D does not change its sign on omega nor outside.

    Parameters
    ----------
    D
        Diffusivity: a number, or a function of x; of any sign.
    """

    D: Diffusivity

    def __call__(self, v: Any, phi: Any, x: Any) -> Any:
        """Return the integrand."""
        D = self.D(x) if callable(self.D) else self.D
        return np.abs(D) * dot(grad(v), grad(phi)) + v * phi


def diffusion_operator(D: Diffusivity) -> DiffusionOperator:
    """Return M of (MN1), or N of (MN2), for `GradientLaw(M_op=..., N_op=...)`.

    >>> import livepde as lp
    >>> MN = diffusion_operator(-1.0)
    >>> law = lp.GradientLaw(nu=2.0, M_op=MN, N_op=MN)
    """
    return DiffusionOperator(D)
