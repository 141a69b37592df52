"""The method exactly as stated by Boiger and Kaltenbacher (2016), in one namespace.

The defaults of livepde differ from some of the paper's choices. Here none is changed: q is never
held, each step is solved to 1e-12 and never divided, M and N are (MN1) and (MN2). The page "The
paper exactly" lists and explains the differences.
"""

from __future__ import annotations

from typing import Any

from livepde.fem import Field, smooth
from livepde.identifier import Identifier
from livepde.laws import Damping, GradientLaw, ResidualDamping, diffusion_operator
from livepde.laws.damping import Diffusivity
from livepde.model import Model
from livepde.observation import Observation
from livepde.stepping import Newton

STRICT = Newton(tolerance=1e-12, share=0.0)
"""Every step is solved to rounding, not only to the error of the time step."""


def space(mesh: Any, **options: Any) -> Field:
    """Return a field in the paper's space: cubic Hermite functions phi_j, psi_j, j = 2, ..., N - 1.

    The basis has neither value nor slope functions at the ends, so every function of this space has
    zero values and zero slopes there. On quadrilaterals these are Bogner-Fox-Schmit functions.
    `options` are those of `Field`: inner, prior, name.
    """
    return Field(mesh, smooth(mesh), dirichlet={"boundary": 0.0}, clamped=True, **options)


def law(
    gain: float = 1.0,
    damping: Damping | None = None,
    D: Diffusivity = 1.0,
    nu: float = 0.0,
    sigma: float = 0.0,
) -> GradientLaw:
    """Return the paper's law: (est_exact_q), (est_exact_u), with sigma (noisy_q), (noisy_u).

    Parameters
    ----------
    gain
        Scale of the inner product of Q, implicitly 1 in the paper.
    damping
        Rule for mu; default `ResidualDamping()`, the lower bound of Assumption cond:mu02, c_1 = 1.
    D
        Diffusivity in (MN1), (MN2), equal to that of the model.
    nu, sigma
        As in the paper.
    """
    MN = diffusion_operator(D)
    rule = ResidualDamping() if damping is None else damping
    return GradientLaw(gain, rule, nu, sigma, M_op=MN, N_op=MN, newton=STRICT, gate=None)


def identifier(
    model: Model,
    observation: Observation,
    *,
    gain: float = 1.0,
    damping: Damping | None = None,
    D: Diffusivity = 1.0,
    nu: float = 0.0,
    sigma: float = 0.0,
    q0: Any = 0.0,
    u0: Any = None,
) -> Identifier:
    """Return the paper's method: its law, by implicit Euler with the steps of the samples.

    The model has fields in `space`; gain, damping, D, nu and sigma are as for `law`, and the
    initial estimates q0 and u0 (est_exact0) as for `Identifier`.

    Examples
    --------
    >>> import numpy as np, livepde as lp
    >>> mesh = lp.interval(0, 1, 30, through=(0.3, 0.87))
    >>> model = lp.Model(
    ...     state=lp.paper.space(mesh),
    ...     parameter=lp.paper.space(mesh, inner="H1"),
    ...     A=lambda q, u, v, x: q * u * v,
    ...     B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    ... )
    >>> omega = lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))
    >>> run = lp.paper.identifier(model, omega, gain=100.0, u0=lambda x: np.sin(np.pi * x[0]))
    """
    rules = law(gain, damping, D, nu, sigma)
    return Identifier(model, observation, rules, q0=q0, u0=u0, halvings=0)
