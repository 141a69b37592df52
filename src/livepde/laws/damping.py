"""Damping rules, which pull the estimate to the observed state, and the bounds of the paper.

The paper's term mu R M (r / ||r||_V~) is 0/0 at r = 0. Therefore a rule returns
theta = mu / ||r||_V~, the factor of R M r. A rule may use only quantities known online. The
formulas of the bounds also return theta (mu / ||r_alpha||_V~ with noise), never mu. In a twin
experiment their arguments are the true norms; for a rule the user provides bounds of the norms.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from livepde.errors import LawError
from livepde.fem import dot, grad

Diffusivity: TypeAlias = float | Callable[[Any], Any]


class Residual:
    """Squared norms of the observed residual r = R u - u_alpha, and of u_alpha as a reference.

    Parameters
    ----------
    X, VX
        ||r||_X^2 and ||r||_VX~^2 = (M_op r, r).
    V
        Function that returns ||r||_V~^2, the squared dual norm of M_op r.
    observed
        Function that returns the squared norms of u_alpha; None: the norms are zero.
    """

    def __init__(
        self,
        X: float,
        VX: float,
        V: Callable[[], float],
        observed: Callable[[], Residual] | None = None,
    ) -> None:
        self.X = X
        self.VX = VX
        self._V = V
        self._observed = observed

    @cached_property
    def V(self) -> float:
        """||r||_V~^2."""
        return self._V()

    @cached_property
    def observed(self) -> Residual:
        """Squared norms of u_alpha, the reference for floors."""
        return Residual(0.0, 0.0, lambda: 0.0) if self._observed is None else self._observed()

    def replaced(self, X: float, VX: float, V: Callable[[], float]) -> Residual:
        """Return a copy with other norms of r; the norms of u_alpha are unchanged."""
        return Residual(X, VX, V, lambda: self.observed)


class Damping(ABC):
    """A rule for theta = mu / ||r||_V~."""

    @abstractmethod
    def theta(self, r: Residual) -> float:
        """Return theta >= 0, in 1/time."""

    def most(self, observed: Residual) -> float:
        """Return a bound of theta for all r, from the norms of u_alpha; default: infinity."""
        return math.inf

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        """Return the derivatives of theta in r.X, r.VX and r.V, for the Newton iteration.

        The default uses difference quotients: their accuracy affects the number of iterations, not
        the result.
        """
        reads: list[bool] = []

        def norm() -> float:
            reads.append(True)
            return r.V

        theta = self.theta(r.replaced(r.X, r.VX, norm))
        step = 1.0 + 1e-6
        dX = dVX = dV = 0.0
        if r.X > 0:
            dX = self.theta(r.replaced(step * r.X, r.VX, lambda: r.V)) - theta
        if r.VX > 0:
            dVX = self.theta(r.replaced(r.X, step * r.VX, lambda: r.V)) - theta
        # ||r||_V~ costs a linear solve, so it is varied only if the rule uses it.
        if reads and r.V > 0:
            dV = (self.theta(r.replaced(r.X, r.VX, lambda: step * r.V)) - theta) / (1e-6 * r.V)
        return dX / (1e-6 * r.X or 1.0), dVX / (1e-6 * r.VX or 1.0), dV


@dataclass(frozen=True)
class ResidualDamping(Damping):
    """The part of the lower bound on mu with c_1 (Assumption cond:mu02).

    mu = c_1 ||r||_X^2 ||r||_V~ / ||r||_VX~^2, hence theta = c_1 ||r||_X^2 / ||r||_VX~^2 is smooth
    and bounded by c_1. The other part of the bound requires the unknown ||p||_V^ and is omitted.
    """

    c1: float = 1.0

    def __post_init__(self) -> None:
        _check_bounds("ResidualDamping", c1=self.c1)

    def theta(self, r: Residual) -> float:
        return self.c1 * r.X / r.VX if r.VX > 0.0 else self.c1

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        if r.VX <= 0.0:
            return 0.0, 0.0, 0.0
        return self.c1 / r.VX, -self.c1 * r.X / r.VX**2, 0.0


@dataclass(frozen=True)
class ConstantDamping(Damping):
    """A constant mu, as in the paper's noisy experiments.

    theta = mu / sqrt(||r||_V~^2 + (floor ||u_alpha||_V~)^2): if the residual is smaller than
    `floor` times the state, the pull is linear instead of 0/0. If u_alpha = 0, theta is
    mu / ||r||_V~, and 0 at r = 0.

    Parameters
    ----------
    mu
        Size of the pull, >= 0, in the unit of ||u||_V~ per time.
    floor
        Relative to ||u_alpha||_V~, > 0, so that results do not depend on the unit of u.
    """

    mu: float = 1.0
    floor: float = 1e-3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mu) and self.mu >= 0 and self.floor > 0):
            raise LawError("ConstantDamping: needs mu >= 0 and floor > 0.")

    def theta(self, r: Residual) -> float:
        size = math.sqrt(r.V + self.floor**2 * r.observed.V)
        return self.mu / size if size > 0.0 else 0.0

    def most(self, observed: Residual) -> float:
        least = self.floor * math.sqrt(observed.V)
        return self.mu / least if least > 0.0 else math.inf

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        squared = r.V + self.floor**2 * r.observed.V
        return 0.0, 0.0, -0.5 * self.mu * squared**-1.5 if squared > 0.0 else 0.0


@dataclass(frozen=True)
class DiffusionOperator:
    """The integrand |D| grad v . grad phi + v phi of M and N.

        (M v, phi)_X = integral over omega of |D| grad v . grad phi + v phi                 (MN1)

    N (MN2) has the same integrand over Omega without omega: the law integrates each over its part.
    With |D| both are coercive for every sign of D,
    (M v, v)_X = ||sqrt|D| grad v||^2 + ||v||^2 = ||v||_VX~^2 with c_M = 1. In their own norms M and
    N are bounded if D does not change sign on omega, nor outside omega.

    Parameters
    ----------
    D
        Diffusivity of any sign: a number, or a function of x.
    """

    D: Diffusivity

    def __call__(self, v: Any, phi: Any, x: Any) -> Any:
        """Return the integrand."""
        D = self.D(x) if callable(self.D) else self.D
        return np.abs(D) * dot(grad(v), grad(phi)) + v * phi


def diffusion_operator(D: Diffusivity) -> DiffusionOperator:
    """Return the integrand of M (MN1) or N (MN2) for `GradientLaw(M_op=..., N_op=...)`.

    >>> import livepde as lp
    >>> MN = diffusion_operator(-1.0)
    >>> law = lp.GradientLaw(nu=2.0, M_op=MN, N_op=MN)
    """
    return DiffusionOperator(D)


@dataclass(frozen=True)
class Norms:
    """||x||_X, ||x||_VX and ||x||_V of one part of the state, or bounds of these norms.

    The spaces have a tilde for an observed part (r, d), and a hat for the unobserved part (p).
    """

    X: float = 0.0
    VX: float = 0.0
    V: float = 0.0

    def residual(self, observed: Norms) -> Residual:
        """Return the argument of a damping rule: these norms of r, and norms of u_alpha."""
        seen = Residual(observed.X**2, observed.VX**2, lambda: observed.V**2)
        return Residual(self.X**2, self.VX**2, lambda: self.V**2, lambda: seen)


@dataclass(frozen=True)
class Constants:
    """The constants of Assumption ass:equation for a discretised model.

    `diagnostics.constants` computes the constants; a user may provide sharper ones.

    Attributes
    ----------
    L_C
        Lipschitz constant of C(q, .) (LipschitzC), in 1/time.
    C_A
        Bound of A: ||A(u* + v)||_{Q -> X} <= C_A (1 + ||v||) (AbdV), (AbdX), (AbdVV).
    c_M, C_M
        Bounds of M: (M v, v)_X >= c_M ||v||_VX~^2, and ||R M v||_X <= C_M ||v||_V~.
    c_N, C_N
        Bounds of N on the unobserved part, defined as for M.
    observed_V_VX, observed_VX_X
        Embedding constants C_{V~ VX~} and C_{VX~ X}.
    hidden_V_VX, hidden_VX_X
        Embedding constants C_{V^ VX^} and C_{VX^ X}; 0 if everything is observed.
    observed_ratio, hidden_ratio
        Largest ||v||_V ||v||_X / ||v||_VX^2 of each part: 1/c_int of (interpol).
    sampled
        Names of the constants that sampling estimated from below; all others are bounds.
    """

    L_C: float
    C_A: float
    c_M: float = 1.0
    C_M: float = 1.0
    c_N: float = 1.0
    C_N: float = 1.0
    observed_V_VX: float = 1.0
    observed_VX_X: float = 1.0
    hidden_V_VX: float = 1.0
    hidden_VX_X: float = 1.0
    observed_ratio: float = 1.0
    hidden_ratio: float = 1.0
    sampled: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("c_M", "C_M", "c_N", "C_N"):
            if not getattr(self, name) > 0:
                raise LawError(f"Constants: {name} must be positive; got {getattr(self, name)}.")
        names = ("L_C", "C_A", "hidden_V_VX", "hidden_VX_X", "hidden_ratio")
        _check_bounds("Constants", **{name: getattr(self, name) for name in names})


def _over(numerator: float, denominator: float) -> float:
    """Return a quotient; 0/0 is 0, because a zero numerator is no constraint."""
    if numerator <= 0.0:
        return 0.0
    return numerator / denominator if denominator > 0.0 else np.inf


def theta_exact(c: Constants, p_V: float, r: Norms, c1: float = 0.0) -> float:
    """Return the least theta for exact data by Assumptions cond:mu_1 and, with c1, cond:mu02.

    mu >= max{2 L_C/c_M ||p||_V^, c_1 ||r||_X} ||r||_X ||r||_V~ / ||r||_VX~^2.

    >>> theta_exact(Constants(L_C=2.0, C_A=1.0), p_V=0.5, r=Norms(1.0, 2.0, 4.0))
    0.5
    """
    return _over(max(2.0 * c.L_C / c.c_M * p_V, c1 * r.X) * r.X, r.VX**2)


def theta_noisy(
    c: Constants, e: float, p_V: float, r: Norms, d: Norms, sigma: float = 0.0, c1: float = 0.0
) -> float:
    """Return the least theta for noisy data by Assumptions ass:mu_nu and, with c1, ass:mu_noisy.

    mu >= max{4 L_C/c_M (||d||_V~ + ||p||_V^) ||r||_X
    + 4 C_A/c_M (1 + ||d||_V~ + ||p||_V^) ||e||_Q ||d||_X, 2 sigma/c_M ||r||_X^2, c_1 ||r||_X^2}
    ||r_alpha||_V~ / ||r||_VX~^2.

    `e`: ||e||_Q in the gain-scaled norm. `r`: norms of the true residual r = R (u - u*), not of
    r_alpha. `d`: norms of the data error u_alpha - R u*.
    """
    rough = d.V + p_V
    pull = 4.0 / c.c_M * (c.L_C * rough * r.X + c.C_A * (1.0 + rough) * e * d.X)
    return _over(max(pull, 2.0 * sigma / c.c_M * r.X**2, c1 * r.X**2), r.VX**2)


def theta_smoothed(
    c: Constants, p_V: float, r: Norms, d_V: float, rate_X: float, c1: float = 0.0
) -> float:
    """Return the least theta for smoothed data, ass:mu_nu_smooth and, with c1, cond:mu_smooth_2.

    mu >= max{2/c_M (L_C (||d||_V~ + ||p||_V^) + ||d~||_X), c_1 ||r_alpha||_X}
    ||r_alpha||_X ||r_alpha||_V~ / ||r_alpha||_VX~^2.

    `r`: norms of r_alpha, which is known online. `rate_X`: ||d~||_X, d~ the rate of the data error.
    """
    pull = 2.0 / c.c_M * (c.L_C * (d_V + p_V) + rate_X)
    return _over(max(pull, c1 * r.X) * r.X, r.VX**2)


def nu_exact(c: Constants, e: float, p: Norms) -> float:
    """Return the least nu for exact data, Assumption cond:nu."""
    embedding = 0.5 * c.hidden_V_VX * c.hidden_VX_X
    weight = 4.0 * (c.L_C + c.C_A * (e + embedding)) / c.c_N
    return weight * _over(p.V * p.X, p.VX**2)


def nu_noisy(c: Constants, e: float, p: Norms, d_V: float) -> float:
    """Return the least nu for noisy and smoothed data, Assumptions ass:mu_nu, ass:mu_nu_smooth."""
    rough = 4.0 * (c.L_C + c.C_A * e) / c.c_N * (p.V + d_V)
    rough += 2.0 * c.C_A * c.hidden_V_VX * c.hidden_VX_X / c.c_N * p.V
    return _over(rough * p.X, p.VX**2)


def unobserved_damping(c: Constants, e_bound: float) -> float:
    """Return a constant nu for `GradientLaw` that satisfies Assumption cond:nu for every p.

    The unknown quotient ||p||_V^ ||p||_X / ||p||_VX^^2 is at most `c.hidden_ratio`, so the bound
    requires only ||e||_Q, with e_bound^2 = ||e(0)||_Q^2 + ||r(0)||_X^2 as a bound for all times.
    For d != 0 no constant exists: the bound for noisy data is unbounded as p vanishes.

    This nu is large, of the order of the inverse element size. The bound on mu then also has to
    cover nu times the flux of u through the boundary of omega: use `ExactBound` with a p_bound of
    about nu ||P u*||_V^.

    >>> unobserved_damping(Constants(1.0, 0.0, hidden_ratio=2.0), e_bound=1.0)
    8.0
    """
    # Norms with the largest possible quotient ||p||_V^ ||p||_X / ||p||_VX^^2.
    return nu_exact(c, e_bound, Norms(c.hidden_ratio, 1.0, 1.0))


def _check_bounds(name: str, floor: float = 1.0, **values: float) -> None:
    for key, value in values.items():
        if not (np.isfinite(value) and value >= 0):
            raise LawError(f"{name}: {key} must be a number >= 0; got {value}.")
    if not floor > 0:
        raise LawError(f"{name}: floor must be positive; got {floor}.")


@dataclass(frozen=True)
class ExactBound(Damping):
    """The complete lower bound on mu for exact data, cond:mu_1 (c1 = 0) and cond:mu02.

    theta = max{2 L_C/c_M p_bound / ||r||_X, c_1} ||r||_X^2 / ||r||_VX~^2.

    Parameters
    ----------
    constants
        Constants of the model.
    p_bound
        Upper bound of ||p||_V^, known to the user; 0 for full observation.
    c1
        c_1 of cond:mu02, as in `ResidualDamping`.
    floor
        Least ||r||_X in the first term, which is 0/0 at r = 0, relative to ||u_alpha||_X. Below
        the floor the pull is linear and weaker than the bound.
    """

    constants: Constants
    p_bound: float
    c1: float = 1.0
    floor: float = 1e-3

    def __post_init__(self) -> None:
        _check_bounds("ExactBound", self.floor, p_bound=self.p_bound, c1=self.c1)

    def theta(self, r: Residual) -> float:
        c = self.constants
        return _pulled(r, 2.0 * c.L_C / c.c_M * self.p_bound, self.c1, self.floor)


@dataclass(frozen=True)
class SmoothedBound(Damping):
    """The lower bound on mu for smoothed data, ass:mu_nu_smooth (c1 = 0) and cond:mu_smooth_2.

    theta = max{2/c_M (L_C (d_bound + p_bound) + rate_bound) / ||r||_X, c_1}
    ||r||_X^2 / ||r||_VX~^2 with r = R u - u_alpha. Of the paper's bounds for inexact data, only
    this one has a residual that is known online.

    Parameters
    ----------
    p_bound, d_bound, rate_bound
        Upper bounds of ||p||_V^, ||d||_V~ and ||d~||_X.
    c1, floor
        See `ExactBound`.
    """

    constants: Constants
    p_bound: float
    d_bound: float
    rate_bound: float
    c1: float = 1.0
    floor: float = 1e-3

    def __post_init__(self) -> None:
        values = {key: getattr(self, key) for key in ("p_bound", "d_bound", "rate_bound", "c1")}
        _check_bounds("SmoothedBound", self.floor, **values)

    def theta(self, r: Residual) -> float:
        c = self.constants
        rough = c.L_C * (self.d_bound + self.p_bound) + self.rate_bound
        return _pulled(r, 2.0 / c.c_M * rough, self.c1, self.floor)


@dataclass(frozen=True)
class NoisyBound(Damping):
    """The lower bound on mu for noisy data, ass:mu_nu (c1 = 0) and ass:mu_noisy.

    The paper's bound contains the true r. Online it is replaced by the bounds
    ||r||_X <= ||r_alpha||_X + ||d||_X and ||r||_VX~ >= ||r_alpha||_VX~ - ||d||_VX~. So the pull is
    at least that of the paper if the residual exceeds the noise. Otherwise no theta satisfies the
    bound (condition (cond_d) fails as well), and the rule returns `theta_max`.

    Parameters
    ----------
    p_bound, e_bound
        Upper bounds of ||p||_V^ and of ||e||_Q in the gain-scaled norm.
    d_bound
        Upper bounds of the norms of the data error d.
    sigma
        `sigma` of the law.
    c1
        Constant c~_1 of ass:mu_noisy.
    theta_max
        Largest theta, in 1/time.
    """

    constants: Constants
    p_bound: float
    e_bound: float
    d_bound: Norms
    sigma: float = 0.0
    c1: float = 0.0
    theta_max: float = 1e3

    def __post_init__(self) -> None:
        names = ("p_bound", "e_bound", "sigma", "c1", "theta_max")
        norms = {f"d_{key}": value for key, value in vars(self.d_bound).items()}
        _check_bounds("NoisyBound", **norms, **{name: getattr(self, name) for name in names})

    def theta(self, r: Residual) -> float:
        d = self.d_bound
        # The true r is unknown: ||r||_X is bounded from above, ||r||_VX~ from below.
        least = np.sqrt(r.VX) - d.VX
        if least <= 0.0:
            return self.theta_max
        size = Norms(float(np.sqrt(r.X)) + d.X, float(least))
        bound = theta_noisy(
            self.constants, self.e_bound, self.p_bound, size, d, self.sigma, self.c1
        )
        return min(bound, self.theta_max)


def _pulled(r: Residual, pull: float, c1: float, floor: float) -> float:
    """Return max{pull / ||r||_X, c_1} ||r||_X^2 / ||r||_VX~^2 with a floor; c_1 if r is zero."""
    size = float(np.sqrt(max(r.X, floor**2 * r.observed.X))) if pull > 0.0 else 0.0
    share = r.X / r.VX if r.VX > 0.0 else 1.0
    return max(pull / size if size > 0.0 else 0.0, c1) * share
