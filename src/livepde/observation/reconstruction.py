"""Reconstruction of the observed part of the state by G_alpha (section 3.2).

With noisy data, G^+ z is undefined or unstable if the range of G is not closed. If it is closed,
noise still enters the law through B(w), which takes two derivatives. The paper replaces G^+ z by
u_alpha = G_alpha z. Here G_alpha z minimises

    ||G v - z||_Z^2 + alpha |v|^2        over v in N(G)^perp,

where |.| is the norm of X, as in the paper, or a stronger norm.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
import scipy.linalg as sl
import scipy.sparse as sp

from livepde.errors import ObservationError, require_positive
from livepde.fem import FieldBlock, Form, Integrand, ddot, dot, grad, hess
from livepde.linalg import Array, Mask
from livepde.observation.operator import (
    Observed,
    Reconstructed,
    Reconstruction,
    Reconstructor,
    data_norm,
    weights,
)

SMALLEST, LARGEST = 1e-12, 1e12  # bounds of alpha in the discrepancy principle, over its scale
# Relative accuracy of alpha in the discrepancy principle.
ROOT = 1e-10
# Largest number of sensors for a dense eigendecomposition.
MOST_SENSORS = 10_000


class Alpha(ABC):
    """Abstract parameter choice rule for alpha.

    The noise level in Z is `delta`, or `level` relative to ||z||_Z. If both are None, it follows
    from `noise` of the observation.
    """

    delta: float | None
    level: float | None

    def _check(self, **values: float) -> None:
        for name, value in {**values, "delta": self.delta, "level": self.level}.items():
            if value is not None:
                require_positive(f"{type(self).__name__}: {name}", value, ObservationError)

    @abstractmethod
    def choose(self, misfit: Callable[[float], float], delta: float, scale: float) -> float:
        """Return alpha >= 0 for one sample with noise level delta in Z.

        `misfit` is the nondecreasing function alpha -> ||G u_alpha - z||_Z, and `scale` the alpha
        at which both terms have equal weight.
        """


@dataclass(frozen=True)
class Apriori(Alpha):
    """A priori parameter choice, alpha = factor · delta^power.

    Regularisation theory requires alpha -> 0 and delta^2/alpha -> 0, so 0 < power < 2. The noise
    level ||z^delta - z||_Z is `delta`, or `level` relative to ||z^delta||_Z; by default it follows
    from `noise` of the observation.
    """

    power: float = 1.0
    factor: float = 1.0
    delta: float | None = None
    level: float | None = None

    def __post_init__(self) -> None:
        self._check(factor=self.factor)
        if not 0 < self.power < 2:
            raise ObservationError(
                f"Apriori: power must lie between 0 and 2, so that alpha and delta^2/alpha vanish "
                f"with the noise; got {self.power}."
            )

    def choose(self, misfit: Callable[[float], float], delta: float, scale: float) -> float:
        return float(self.factor * delta**self.power)


@dataclass(frozen=True)
class Discrepancy(Alpha):
    """Discrepancy principle: alpha with ||G u_alpha - z||_Z = tau · delta, for each sample.

    A scalar equation is solved for each sample, and a decomposition is computed once for each set
    of present sensors. If every misfit is above tau · delta, because redundant sensors disagree,
    alpha is the lower end of the search interval. If every misfit is below, it is the upper end.
    Theory requires tau > 1, so that alpha is not too small for the noise. See `Apriori` for `delta`
    and `level`.
    """

    tau: float = 1.1
    delta: float | None = None
    level: float | None = None

    def __post_init__(self) -> None:
        self._check(tau=self.tau)

    def choose(self, misfit: Callable[[float], float], delta: float, scale: float) -> float:
        target = self.tau * delta
        low, high = np.log(SMALLEST * scale), np.log(LARGEST * scale)
        if misfit(float(np.exp(low))) >= target:
            return float(np.exp(low))
        if misfit(float(np.exp(high))) <= target:
            return float(np.exp(high))
        root = scipy.optimize.brentq(
            lambda s: misfit(float(np.exp(s))) - target, low, high, xtol=ROOT
        )
        return float(np.exp(root))


@dataclass(frozen=True)
class Tikhonov(Reconstruction):
    """Tikhonov-Phillips regularisation G_alpha: Z -> N(G)^perp (section 3.2).

    The norm ||.||_Z depends on the observation. For a `Subdomain` it is the norm of X on omega,
    ||z||_Z = ||G^+ z||_X, as Z = L2(omega) in the paper. Otherwise it is Euclidean, with weights
    1/noise^2 if the noise is known; delta is then the root of the number of sensors.

    The cost is a dense generalised eigendecomposition for each set of present sensors, whose size
    is the dimension of N(G)^perp, and a matrix-vector product of that size for each sample. It is
    intended for up to a few thousand sensors; more than 10 000 are an error.

    Parameters
    ----------
    norm
        "X"
            Norm of X, as in the paper: (G* G + alpha I)^{-1} G*. For a subdomain G* G = I, so it
            only shrinks the data.
        "V"
            Second derivatives in L2, the stronger norm V~, which damps components that B(w) would
            amplify. For a subdomain they are integrated only over elements in omega, which avoids a
            bias towards zero at its border; known Dirichlet values count. Elements without second
            derivatives use a discrete Laplacian, K M^{-1} K with lumped mass, without border rows.
        a form (u, v, x)
            A symmetric, positive semidefinite form, integrated over the same elements.
    alpha
        A number >= 0, `Apriori`, or `Discrepancy` (default).

    Examples
    --------
    >>> import numpy as np, livepde as lp
    >>> from skfem import ElementLineP1
    >>> from livepde.observation import Discrepancy, Full, Tikhonov
    >>> rod = lp.Field(lp.interval(0, 1, 20), ElementLineP1())
    >>> model = lp.Model(rod, lp.Normal(1.0), lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)))
    >>> full = Full(noise=0.1, reconstruction=Tikhonov("V", Discrepancy(tau=1.1)))
    >>> observed = full.bind(model.state_space, model.X, model.parameter_space)
    >>> z = 1 + 0.1 * (-1.0) ** np.arange(21)
    >>> found = observed.reconstruct(z)
    >>> bool(np.abs(found.u - 1).max() < 0.02)
    True
    """

    norm: str | Integrand = "V"
    alpha: float | Alpha = field(default_factory=Discrepancy)

    def __post_init__(self) -> None:
        if not callable(self.norm) and self.norm not in ("X", "V"):
            raise ObservationError(
                f"Tikhonov: norm {self.norm!r}; expected 'X', 'V', or a symmetric form (u, v, x)."
            )
        if not isinstance(self.alpha, Alpha) and not (np.isfinite(self.alpha) and self.alpha >= 0):
            raise ObservationError(
                f"Tikhonov: alpha must be a number >= 0, Apriori(...) or Discrepancy(...); got "
                f"{self.alpha!r}."
            )

    def prepare(self, observed: Observed, present: Array) -> Reconstructor:
        return Spectral(self, observed, present)


class Spectral(Reconstructor):
    """Simultaneous diagonalisation of fit and penalty, which yields minimisers for every alpha.

    Both quadratic forms are diagonal in a basis phi of N(G)^perp, with entries s for ||G v||_Z^2
    and k for |v|^2, scaled so that s + rho k = 1. This is accurate for tiny s (the range of G is
    not closed) and for k = 0 (the null space of |.|).
    """

    def __init__(self, config: Tikhonov, observed: Observed, present: Array) -> None:
        self.config = config
        self.present = present
        if (count := int(present.sum())) > MOST_SENSORS:
            raise ObservationError(
                f"Tikhonov: {count} sensors; it decomposes a dense matrix of them and takes up to "
                f"{MOST_SENSORS}. Observe fewer points or averages, or leave out reconstruction=."
            )
        self.G = sp.csr_array(observed.G[np.flatnonzero(present)])
        self.weights = weights(observed, present)
        self.level: float | None = None  # root mean square of ||noise||_Z
        if observed.noise is not None:
            self.level = float(np.sqrt(self.weights.diagonal() @ observed.noise[present] ** 2))
        basis = observed.split(present).basis
        penalty = penalty_matrix(config.norm, observed, basis)
        self.size = basis.shape[1]
        if self.size == 0:
            return
        self.root = np.linalg.cholesky(self.weights.toarray()).T
        images = self.root @ (self.G @ basis)
        fit = images.T @ images
        cost = basis.T @ (penalty @ basis)
        cost = (cost + cost.T) / 2
        # Scale of alpha: for alpha = rho, fit and penalty have the same trace.
        self.rho = float(np.trace(fit) / (np.trace(cost) or 1.0))
        s, phi = sl.eigh(fit, fit + self.rho * cost)
        # s is a divisor below, and rounding may make it zero or negative.
        self.s = np.clip(s, np.finfo(float).tiny, 1.0)
        # In the null space of |.|, k must be exactly zero: for large alpha, alpha k would amplify
        # rounding errors.
        remainder = 1.0 - s
        self.k = np.where(remainder > 10 * len(s) * np.finfo(float).eps, remainder, 0.0) / self.rho
        self.phi = basis @ phi
        self.fitted = (self.G @ self.phi).T @ self.weights
        self.pulled = sp.csr_array(penalty.T) @ self.phi
        self.image = np.linalg.qr(images)[0]

    def __call__(self, z: Array, boundary: Array, delta: float | None = None) -> Reconstructed:
        data = z[self.present] - self.G @ boundary
        if self.size == 0:
            return Reconstructed(np.zeros(len(boundary)), 0.0, data_norm(data, self.weights), delta)
        beta = self.fitted @ data
        shift = boundary @ self.pulled
        in_noise = self.root @ data
        # No alpha fits the part of the data outside the range of G, where redundant sensors
        # disagree.
        outside = in_noise - self.image @ (self.image.T @ in_noise)
        unfitted = float(outside @ outside)

        def misfit(alpha: float) -> float:
            residual = alpha * (self.k * beta + shift * self.s) / (self.s + alpha * self.k)
            return float(np.sqrt(unfitted + residual @ (residual / self.s)))

        delta, alpha = self._alpha(misfit, delta, data)
        # v = boundary + sum c phi: each c minimises s c^2 - 2 beta c + alpha (k c^2 + 2 shift c).
        u = self.phi @ ((beta - alpha * shift) / (self.s + alpha * self.k))
        return Reconstructed(u, alpha, misfit(alpha), delta)

    def _alpha(
        self, misfit: Callable[[float], float], delta: float | None, z: Array
    ) -> tuple[float | None, float]:
        rule = self.config.alpha
        if not isinstance(rule, Alpha):
            return (self.level if delta is None else delta), float(rule)
        delta = rule.delta if delta is None else delta
        if delta is None and rule.level is not None:
            delta = rule.level * data_norm(z, self.weights)
        delta = self.level if delta is None else delta
        if delta is None:
            raise ObservationError(
                f"Tikhonov: {type(rule).__name__} needs the noise level: give noise= to the "
                "observation, delta= or level= to the rule, or a number for alpha."
            )
        return delta, rule.choose(misfit, delta, self.rho)


def penalty_matrix(norm: str | Integrand, observed: Observed, basis: Array) -> sp.csr_array:
    """Return the matrix of |v|^2 on all coefficients, shape (n, n)."""
    if norm == "X":
        free = sp.diags_array(observed.X.free)
        return sp.csr_array(free @ observed.X.gram @ free)
    space = observed.state
    if len(space.fields) > 1:
        raise ObservationError(
            "Tikhonov: norm 'V' and forms know states of one component; take norm='X'."
        )
    block, _ = space.component()
    inside = _determined_elements(block, basis) if observed.observation.nodal else None

    def matrix(integrand: Any) -> sp.csr_array:
        pair = {"u": space, "v": space}
        form = Form("norm", integrand, pair, block.field.mesh, block.field.order)
        if not form.constant:
            raise ObservationError("Tikhonov: the norm may not depend on time or inputs.")
        return (form if inside is None else form.on(np.flatnonzero(inside))).matrix("v", "u")

    if callable(norm):
        penalty = matrix(norm)
        if abs(penalty - penalty.T).max() > 1e-10 * abs(penalty).max():
            raise ObservationError(
                "Tikhonov: the form of the norm is not symmetric; write one that does not change "
                "when its two functions are exchanged."
            )
        return penalty
    if block.bends:
        return matrix(lambda u, v, x: ddot(hess(u), hess(v)))
    try:
        stiff = matrix(lambda u, v, x: dot(grad(u), grad(v)))
        mass = matrix(lambda u, v, x: u * v)
    except Exception as error:
        raise ObservationError(
            "Tikhonov: norm 'V' knows scalar states with gradients; give a form (u, v, x) instead."
        ) from error
    # Diagonal lumping, since the row sums of the mass matrix vanish at the vertices of quadratic
    # elements.
    lumped = mass.diagonal() * (mass.sum() / (mass.diagonal().sum() or 1.0))
    rows = lumped > 0
    rows[block.boundary] = False
    if inside is not None:  # coefficients at the border of omega
        rows[block.element_dofs[:, ~inside]] = False
    scale = np.where(rows, 1.0 / np.where(rows, lumped, 1.0), 0.0)
    return sp.csr_array(stiff.T @ sp.diags_array(scale) @ stiff)


def _determined_elements(block: FieldBlock, basis: Array) -> Mask:
    """Return the mask of elements whose coefficients are all observed or known."""
    determined = np.asarray(np.abs(basis).any(axis=1))
    determined[block.fixed] = True
    return np.asarray(determined[block.element_dofs].all(axis=0))
