"""Errors e, r, p of a twin experiment with the paper's conditions and bounds; stopping time T*."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.check_report import Check, CheckReport
from livepde.diagnostics.theory.constants import Spaces
from livepde.errors import ConfigurationError
from livepde.estimate import Estimate
from livepde.fem import Moment
from livepde.laws.damping import (
    Constants,
    Damping,
    Norms,
    nu_exact,
    nu_noisy,
    theta_exact,
    theta_noisy,
    theta_smoothed,
)
from livepde.linalg import Array
from livepde.observation import Observed, Tikhonov
from livepde.streams import Twin

Data = Literal["exact", "noisy", "smoothed"]
# Relative violation of an inequality between norms that is attributed to rounding.
ROUNDING = 1e-9
# For each section the paper's labels of the bound on mu, of a stronger one, and of the bound on nu.
CONDITIONS: dict[Data, tuple[str, str, str]] = {
    "exact": ("cond:mu_1", "cond:mu02", "cond:nu"),
    "noisy": ("ass:mu_nu, mu", "ass:mu_noisy", "ass:mu_nu, nu"),
    "smoothed": ("ass:mu_nu_smooth, mu", "cond:mu_smooth_2", "ass:mu_nu_smooth, nu"),
}
UNUSED = (
    "The hypothesis of the proposition does not hold along the run: see the conditions, or the "
    "flux D grad p through the boundary of omega, which is zero in the paper's V^."
)


@dataclass(frozen=True)
class Errors:
    """Error norms of a twin experiment at one sample."""

    t: float
    e: float  # ||q - q*||_Q, gain-scaled
    # r, p, d, r_alpha: norms of R(u - u*), P(u - u*), u_alpha - R u* and R u - u_alpha. With a
    # `Subdomain` they are integrals of u - u* over omega (r) and over its complement (p).
    r: Norms
    p: Norms
    d: Norms
    r_alpha: Norms
    Pu: float  # ||P u*||_V^
    rate: float  # ||d~||_X, the rate of change of d since the previous sample; 0 at the first
    theta: float  # value of the damping rule for r_alpha
    u_alpha: float = 0.0  # ||u_alpha||_X, the reference of relative floors

    @property
    def energy(self) -> float:
        """||e||_Q^2 + ||r||_X^2, which never grows with exact data of all of u (align:neplusnr).

        With partial data it does not grow as long as mu is at least the bound of cond:mu_1.
        """
        return self.e**2 + self.r.X**2

    @property
    def smoothed_energy(self) -> float:
        """||e||_Q^2 + ||r_alpha||_X^2 of Proposition prop:wellposed_noisesmooth."""
        return self.e**2 + self.r_alpha.X**2

    @property
    def margin(self) -> float:
        """||r||_VX~^2 / (||r||_X ||d||_V~): condition (cond_d) asks for 2 C_M/c_M at least."""
        if self.d.V == 0.0:
            return np.inf
        return self.r.VX**2 / (self.r.X * self.d.V) if self.r.X > 0.0 else 0.0


class TwinTracker:
    """Tracker of the errors of a run against its twin; no feedback to the estimator.

    Parameters
    ----------
    spaces
        Spaces that define the norms; `Spaces.of(model, observed, law)` uses the operators of the
        law.
    gain, damping
        Gain and damping rule of the law: ||e||_Q^2 is divided by the gain; the rule returns theta.
    reconstruct
        Function z -> u_alpha as used by the law; default `reconstruct` of the observation.

    Raises
    ------
    ConfigurationError
        An unknown has an evolution, or the model is not linear in the latent coefficients.

    Examples
    --------
    ::

        tracker = TwinTracker(twin, Spaces.of(model, observed, law), law.gain, law.damping)
        for sample in twin:
            tracker.add(identifier.step(sample.t, sample.z), sample.z)
        print(bounds(tracker.errors, constants(...)))
    """

    def __init__(
        self,
        twin: Twin,
        spaces: Spaces,
        gain: float | Literal["auto"] = 1.0,
        damping: Damping | None = None,
        reconstruct: Callable[[Array], Array] | None = None,
    ) -> None:
        model = twin.model
        if gain == "auto":
            raise ConfigurationError(
                "TwinTracker: the paper's bounds are those of a constant gain; with gain='auto' "
                "the inner product of Q changes with every sample."
            )
        if model.latent.moves or not model.form_A.linear_in_parameter:
            raise ConfigurationError(
                "TwinTracker: the paper's errors are those of a constant parameter in which the "
                "model is linear; leave out `transform` and `evolution` of the unknowns."
            )
        self.twin = twin
        self.spaces = spaces
        self.gain = gain
        self.damping = damping
        self.reconstruct = reconstruct
        self.errors: list[Errors] = []
        self._last: tuple[float, Array] | None = None

    def add(self, estimate: Estimate, z: Any) -> Errors:
        """Compare one estimate with the truth and record the errors; z has the shape (sensors,)."""
        twin, spaces = self.twin, self.spaces
        exact, split = twin.u(estimate.t), spaces.split
        boundary = twin.model.impose(np.zeros(len(exact)), Moment(estimate.t))
        z = spaces.observed.linearised(np.asarray(z, dtype=float), estimate.u)
        if self.reconstruct is not None:
            u_alpha = self.reconstruct(z)
        else:
            u_alpha = spaces.observed.reconstruct(z, boundary=boundary).u
        error = estimate.u - exact
        # Estimate and truth have the same Dirichlet values, so the error lies in the tangent space.
        # The data error d is defined for the free coefficients, hence without the boundary values.
        d = u_alpha - split.R @ (exact - boundary)
        residual = split.R @ error - d
        seen, hidden = spaces.observed_part, spaces.hidden_part
        rate = 0.0
        if self._last is not None:
            step = estimate.t - self._last[0]
            rate = seen.norms(d - self._last[1]).X / step
        self._last = (estimate.t, d)
        theta = 0.0
        if self.damping is not None:
            size = seen.stage_norms(u_alpha)
            theta = self.damping.theta(seen.stage_norms(residual).residual(size))
        e = estimate.q - twin.q
        found = Errors(
            estimate.t,
            twin.model.Q.norm(e) / float(np.sqrt(self.gain)),
            seen.norms(error),
            hidden.norms(error),
            seen.norms(d),
            seen.norms(residual),
            hidden.norms(exact).V,
            rate,
            theta,
            seen.norms(u_alpha).X,
        )
        self.errors.append(found)
        return found

    @property
    def q_true(self) -> float:
        return self.twin.model.Q.norm(self.twin.q) / float(np.sqrt(self.gain))


def _values(errors: Sequence[Errors], get: Callable[[Errors], float]) -> Array:
    return np.array([get(item) for item in errors])


def _least_theta(data: Data, c: Constants, sigma: float, item: Errors, c1: float) -> float:
    if data == "exact":
        return theta_exact(c, item.p.V, item.r, c1)
    if data == "noisy":
        return theta_noisy(c, item.e, item.p.V, item.r, item.d, sigma, c1)
    return theta_smoothed(c, item.p.V, item.r_alpha, item.d.V, item.rate, c1)


def conditions(
    errors: Sequence[Errors],
    c: Constants,
    *,
    data: Data = "exact",
    nu: float = 0.0,
    sigma: float = 0.0,
    c1: float = 0.0,
    floor: float = 0.0,
) -> CheckReport:
    """Report the share of samples at which the paper's conditions on mu, nu and d hold.

    These are the conditions of the propositions on the errors (`bounds`). Convergence of q also
    requires persistence of excitation (asspof, `Excitation`) and the link conditions (cond:link,
    `link`). The link conditions fail for every data error d that does not vanish: theta tends to
    zero with r_alpha, ||p||_V^ + ||d||_V~ does not.

    With data on a subdomain all conditions assume a p without flux D grad p through the boundary of
    omega, as in the paper's V^. A continuous discrete u has such a flux. It acts on r at the nodes
    of that boundary, in addition to nu times the flux of u, so that a mu that barely satisfies the
    conditions may be insufficient.

    Parameters
    ----------
    data
        Section of the paper: "exact" (cond:mu_1, cond:mu02, cond:nu), "noisy" (ass:mu_nu,
        ass:mu_noisy, (cond_d)) or "smoothed" (ass:mu_nu_smooth, cond:mu_smooth_2).
    c1
        Constant of the stronger bound on mu for the convergence of the state.
    floor
        Floor of the damping rule. If ||r_alpha||_X is below this share of ||u_alpha||_X, it counts
        as zero and the bounds on mu as satisfied (mu r/||r|| is then any vector up to mu).
    """
    n = len(errors)
    if not n:
        raise ConfigurationError("conditions: the tracker has not seen any estimate.")
    first, second, third = CONDITIONS[data]

    def line(name: str, holds: Any, remedy: str) -> Check:
        return Check.at_least(f"{name} (share of samples)", np.mean(holds), 1.0, remedy)

    theta = _values(errors, lambda item: item.theta) * (1 + ROUNDING)
    lines = []
    for name, level in [(first, 0.0), *([(second, c1)] if c1 > 0 else [])]:
        asked = np.array([_least_theta(data, c, sigma, item, level) for item in errors])
        zero = _values(errors, lambda item: item.r_alpha.X - floor * item.u_alpha) <= 0.0
        asked[zero] = 0.0
        lines.append(
            line(
                name,
                theta >= asked,
                f"mu is below the paper's bound: it asks for theta up to {asked.max():.3g}, the "
                f"rule gave {theta.max():.3g} at most. Take the rule `ExactBound`, `NoisyBound` or "
                "`SmoothedBound`, or go on: the bound is sufficient, not necessary.",
            )
        )
    exact = data == "exact"
    asked = np.array(
        [
            nu_exact(c, item.e, item.p) if exact else nu_noisy(c, item.e, item.p, item.d.V)
            for item in errors
        ]
    )
    lines.append(
        line(
            third,
            nu * (1 + ROUNDING) >= asked,
            f"nu = {nu:.3g} is below the paper's bound, which asks for up to {asked.max():.3g}; "
            "take `unobserved_damping`, or go on: the bound is sufficient, not necessary, and nu "
            "pulls P u to zero, not to the truth. Where the process itself damps P u (D > 0) "
            "nu = 0 serves, too.",
        )
    )
    if data == "noisy":
        need = 2.0 * c.C_M / c.c_M
        lines.append(
            line(
                "(cond_d)",
                _values(errors, lambda item: item.margin) >= need,
                "the data error d outweighs the residual r, so T* has passed: smooth the data "
                "(in V~, not only in L2), or stop learning at T* (`OnlineStopping`).",
            )
        )
    return CheckReport(f"conditions, {data} data", tuple(lines))


def bounds(
    errors: Sequence[Errors],
    c: Constants,
    *,
    data: Data = "exact",
    nu: float = 0.0,
    sigma: float = 0.0,
    q_true: float = 0.0,
    until: float = np.inf,
) -> CheckReport:
    """Evaluate the error bounds of one of the paper's propositions along a run.

    "exact": prop:welldefine; "noisy": well_defined_noisy, up to T*; "smoothed":
    prop:wellposed_noisesmooth, with r_alpha instead of r.

    1. ||e||_Q^2 + ||r||_X^2 <= its value at the start (sigma > 0: or ||q*||_Q^2 if that is larger).
    2. ||p||_X^2 <= max{||p(0)||_X^2, 2 b} with b = C_N^2 C^4/c_N^2 sup ||P u*||_V^^2
       + C_A C^2/(c_N nu) (||e(0)||_Q^2 + ||r(0)||_X^2), C = C_{VX^ X}. The three propositions print
       this bound in three ways (C_A^2 or C_A, C^2 in the numerator or the denominator, c_N or
       c_N^2, with and without the factor 2); this is what their proofs give. It needs nu > 0.
    3. The integral of ||p||_V^ ||r||_X <= (||e(0)||_Q^2 + ||r(0)||_X^2)/(2 L_C), as in the proofs
       (sigma = 0; prop:welldefine prints twice that).

    Time integrals are trapezoidal sums over the samples. `q_true` is ||q*||_Q, gain-scaled, for
    sigma > 0; `until` is T*, for noisy data. The report has one line for each bound; their
    hypotheses are checked by `conditions`.
    """
    # For noisy data the bounds hold before T*; they depend on the errors at the first sample.
    kept = [item for item in errors if item.t < until or item is errors[0]]
    if not kept:
        raise ConfigurationError("bounds: the tracker has not seen any estimate.")
    label, name = ("r_alpha", "smoothed_energy") if data == "smoothed" else ("r", "energy")
    energy, residual = attrgetter(name), attrgetter(f"{label}.X")
    start = energy(kept[0])
    # sigma pulls q to zero, where ||e||_Q = ||q*||_Q.
    limit = max(start, q_true**2) if sigma > 0 else start
    lines = [
        Check.at_most(
            f"1. ||e||^2 + ||{label}||^2",
            float(_values(kept, energy).max()),
            limit * (1 + ROUNDING),
            "The energy grew. " + UNUSED,
        )
    ]
    lines += _unobserved(kept, c, nu, limit)
    if sigma == 0 and c.L_C > 0:
        values = _values(kept, attrgetter("p.V")) * _values(kept, residual)
        widths = np.diff(_values(kept, attrgetter("t")))  # by hand: NumPy 1.26 has no `trapezoid`
        part = float((widths * (values[1:] + values[:-1]) / 2.0).sum())
        lines.append(
            Check.at_most(
                f"3. integral of ||p||_V ||{label}||_X",
                part,
                start / (2.0 * c.L_C) * (1 + ROUNDING),
                "The unobserved error lasts. " + UNUSED,
            )
        )
    return CheckReport(f"error bounds, {data} data", tuple(lines))


def _unobserved(kept: Sequence[Errors], c: Constants, nu: float, limit: float) -> Iterator[Check]:
    """Yield the check of ||p||_X^2, if nu > 0 or p = 0; `limit`: bound on ||e||_Q^2 + ||r||_X^2."""
    largest = float(_values(kept, attrgetter("p.X")).max()) ** 2
    if nu > 0:
        C = c.hidden_VX_X
        b = c.C_N**2 * C**4 / c.c_N**2 * float((_values(kept, attrgetter("Pu")) ** 2).max())
        b += c.C_A * C**2 / (c.c_N * nu) * limit
        most = max(kept[0].p.X ** 2, 2.0 * b) * (1 + ROUNDING)
        yield Check.at_most("2. ||p||^2", largest, most, "p grew. " + UNUSED)
    elif largest == 0.0:
        yield Check.at_most("2. ||p||^2 (all observed)", largest, 0.0, "")


# Number of sensors up to which the error norms are computed exactly, sensor by sensor.
MOST_SENSORS = 2000
# Number of random vectors beyond that: the relative standard error is at most sqrt(2/(4 PROBES)) =
# 1/8.
PROBES = 32
# Number of sensors up to which the matrix of G_alpha is formed.
MOST_COLUMNS = 10_000


def stopping_time(errors: Sequence[Errors], c: Constants) -> float:
    """Return T*: the first sample time that violates (cond_d); infinity if none does.

    ||d||_V~ > c_M/(2 C_M) ||r||_VX~^2/||r||_X, with the true d and r of a `TwinTracker`.
    """
    for item in errors:
        if item.margin < 2.0 * c.C_M / c.c_M:
            return item.t
    return np.inf


def noise_size(
    spaces: Spaces,
    std: Array,
    reconstruction: Array | sp.csr_array | None = None,
    u_alpha: Array | None = None,
) -> Norms:
    """Return the root mean square of the data error d in X, VX~ and V~ from a noise level.

    d = G_alpha eta + (G_alpha G - R) u*: the propagated noise, and the regularisation error of the
    exact state. The second part is estimated by applying G_alpha G - R to u_alpha. Beyond 2000
    sensors the first is the mean over 32 fixed random vectors, with a relative standard error of at
    most 1/8, which decreases with the number of independent coefficients that contribute.

    Parameters
    ----------
    std
        Standard deviation of each sensor, shape (sensors,); errors are independent.
    reconstruction
        Matrix of G_alpha, shape (n, sensors); default G^+. Raw nodal noise is about 1/h^2 times
        larger in V~ than in X, so without smoothing T* is reached immediately.
    u_alpha
        Reconstruction of the sample, shape (n,); None: omit the second part.
    """
    matrix = spaces.split.inverse if reconstruction is None else reconstruction
    if matrix.shape[1] != len(std):
        raise ConfigurationError(
            f"noise_size: {len(std)} standard deviations for {matrix.shape[1]} sensors."
        )
    std = np.asarray(std, dtype=float)
    if len(std) > MOST_SENSORS:
        signs = 2.0 * np.random.default_rng(0).integers(0, 2, (len(std), PROBES)) - 1.0
        factor = matrix @ (std[:, None] * signs) / np.sqrt(PROBES)
    else:
        factor = (matrix.toarray() if sp.issparse(matrix) else np.asarray(matrix)) * std
    if u_alpha is not None:
        lost = matrix @ (spaces.observed.G @ u_alpha) - u_alpha
        factor = np.column_stack([factor, lost])
    return spaces.observed_part.root_mean_square(factor)


def reconstruction_matrix(observed: Observed, alpha: float | None = None) -> Array:
    """Return the matrix of z -> u_alpha with all sensors present, shape (n, sensors).

    `alpha` is the regularisation parameter if the rule has one; for the discrepancy principle that
    of the sample (`observed.reconstruct(z).alpha`), at which the map is linearised.
    """
    rule = observed.observation.reconstruction
    if not rule.regularises:
        inverse = observed.split().inverse
        if inverse.shape[1] > MOST_COLUMNS:
            raise ConfigurationError(
                f"reconstruction_matrix: {inverse.shape[1]} sensors, up to {MOST_COLUMNS} are "
                "possible; G^+ as a sparse matrix is observed.split().inverse."
            )
        return inverse.toarray()
    if alpha is not None and isinstance(rule, Tikhonov):
        rule = replace(rule, alpha=float(alpha))
    apply = rule.prepare(observed, np.ones(observed.size, dtype=bool))
    nothing = np.zeros(observed.X.dim)
    return np.column_stack([apply(unit, nothing).u for unit in np.eye(observed.size)])


@dataclass(frozen=True)
class StoppingState:
    """State of `OnlineStopping` after the sample at t.

    T is the time of the first sample that violated the surrogate condition, infinity if none yet;
    `margin` the ratio of right to left side of (cond_d) at the last sample: below 1 it is violated.
    """

    t: float = -np.inf
    T: float = np.inf
    margin: float = np.inf


@dataclass(frozen=True)
class OnlineStopping:
    """Online surrogate of T* without truth.

    (cond_d) contains the unknown d and r. Here ||d||_V~ is replaced by its root mean square for the
    noise level (`noise_size`), and the true residual by the observed one minus the noise: r_alpha =
    r - d, so for noise that the estimate does not follow yet ||r||^2 = ||r_alpha||^2 - ||d||^2 in
    the mean, in X as in VX~. Of the constants only C_M/c_M is used.

    Examples
    --------
    >>> stop = OnlineStopping(Constants(1.0, 1.0))
    >>> state = stop.add(stop.init(), 0.0, Norms(1.0, 3.0, 9.0), Norms(0.01, 0.1, 1.0))
    >>> stop.add(state, 1.0, Norms(0.1, 0.3, 0.9), Norms(0.01, 0.1, 1.0)).T
    1.0
    """

    constants: Constants

    def init(self) -> StoppingState:
        """Return the state before the first sample."""
        return StoppingState()

    def margin(self, r_alpha: Norms, d: Norms) -> float:
        """Return c_M/(2 C_M) ||r||_VX~^2/(||r||_X ||d||_V~), with estimated r."""
        VX = max(r_alpha.VX**2 - d.VX**2, 0.0)
        X = np.sqrt(max(r_alpha.X**2 - d.X**2, 0.0))
        if d.V == 0.0:
            return np.inf
        # ||r||_X = 0 means that r does not exceed the noise.
        if X == 0.0:
            return 0.0
        c = self.constants
        return float(c.c_M / (2.0 * c.C_M) * VX / (X * d.V))

    def add(self, state: StoppingState, t: float, r_alpha: Norms, d: Norms) -> StoppingState:
        """Add the residual and the noise size of a sample and return the new state."""
        margin = self.margin(r_alpha, d)
        T = t if margin < 1.0 and not np.isfinite(state.T) else state.T
        return replace(state, t=t, T=T, margin=margin)
