"""Excitation Gramian (asspof), link conditions (cond:link), interpolation inequality (interpol)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh

from livepde.diagnostics.theory.constants import Spaces
from livepde.diagnostics.theory.state_parts import lanczos
from livepde.errors import ConfigurationError
from livepde.fem import Inputs, Moment
from livepde.laws.damping import Norms
from livepde.linalg import Array
from livepde.spaces import HilbertSpace

# Number of entries of a block of states, which bounds the size of temporary arrays.
ENTRIES = 5_000_000
# Number of parameters up to which the Gramian is stored as a matrix.
DENSE = 1000


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues and modes of an excitation Gramian in the inner product of Q.

    Attributes
    ----------
    strength
        ||integral of R A(w) phi_k||_X for Q-normal modes phi_k, descending; the last is the
        epsilon_0 of asspof.
    modes
        Modes phi_k as columns, shape (m, count), normalised in the gain-scaled inner product of Q.
    windows
        Number of windows over which the squares were summed.
    """

    strength: Array
    modes: Array
    windows: int

    @property
    def epsilon(self) -> float:
        """Constant epsilon_0 of asspof; for a field it tends to zero with the mesh size."""
        return float(self.strength[-1]) if len(self.strength) else 0.0

    def pinned(self, share: float = 1e-2) -> int:
        """Return the number of modes with at least `share` of the strongest excitation."""
        if not len(self.strength) or self.strength[0] <= 0:
            return 0
        return int((self.strength >= share * self.strength[0]).sum())

    def error_bounds(self, window: float, rate: float) -> Array:
        """Return 2 gamma_0 ||d~||_X / epsilon for each mode, as in th:parameter_noisesmooth.

        The theorem bounds the error of q by it in the limit only under the link conditions
        (cond:link, see `link`), which do not hold for a data error that does not vanish. Without
        them it is a scale, not a bound.

        A mode whose bound exceeds its size in Q (1: the prior standard deviation, for gain 1) is
        not determined by data whose error changes at that rate.
        """
        tiny = np.finfo(float).tiny
        return 2.0 * window * rate / np.maximum(self.strength, tiny)


@dataclass(frozen=True, eq=False)
class ExcitationState:
    """State of `Excitation`: accumulated integrals, as a plain value."""

    # t, begun: times of the last sample and of the start of the open window; NaN before the first.
    t: float = np.nan
    begun: float = np.nan
    # A(w) at t for latent coefficients, dual vectors of X in columns, shape (n, m).
    last: sp.csr_array | None = None
    # integral, latest: integrals over the open window, and over the last whole one, None before.
    integral: sp.csr_array | None = None
    latest: sp.csr_array | None = None
    # Sum over whole windows of their Gramians, shape (m, m); None beyond 1000 parameters.
    gram: Array | None = None
    windows: int = 0  # number of whole windows


@dataclass(frozen=True, eq=False)
class Excitation:
    """Accumulator of the integrals of R A(w) over windows [t, t + gamma_0] of a run.

    For a `Subdomain`, R A(w) is A(w) on omega.

    The argument w = u_alpha + P u is known to the law, so no truth is needed. The windows are
    disjoint; a window ends at the first sample at or after its length.

    Parameters
    ----------
    window
        Length gamma_0, in the unit of time. Contributions that cancel within a window do not count,
        so it should be shorter than the periods of the excitation.
    gain
        Gain of the law.
    count
        Number of modes that are computed for more than 1000 parameters.

    Examples
    --------
    >>> import livepde as lp, numpy as np
    >>> from skfem import ElementLineP1
    >>> rod = lp.Field(lp.interval(0, 1, 4), ElementLineP1())
    >>> model = lp.Model(rod, lp.Normal(std=2.0), A=lambda q, u, v, x: q * u * v)
    >>> full = lp.Full().bind(model.state_space, model.X, model.parameter_space)
    >>> excitation = Excitation(Spaces(model, full), window=0.5)
    >>> state = excitation.init()
    >>> for t in (0.0, 0.25, 0.5):
    ...     state = excitation.add(state, t, np.full(5, 3.0))
    >>> excitation.spectrum(state).strength.round(9)  # 0.5 * 3 * std
    array([3.])
    """

    spaces: Spaces
    window: float
    gain: float = 1.0
    count: int = 20

    def __post_init__(self) -> None:
        if not self.window > 0:
            raise ConfigurationError(f"Excitation: window must be positive; got {self.window}.")

    def init(self) -> ExcitationState:
        """Return the state before the first sample."""
        m = self.spaces.model.Q.dim
        return ExcitationState(gram=np.zeros((m, m)) if m <= DENSE else None)

    def add(
        self,
        state: ExcitationState,
        t: float,
        w: Array,
        inputs: Mapping[str, float] | None = None,
        q: Array | None = None,
    ) -> ExcitationState:
        """Add the state estimate w at time t and return the new state.

        `w`: u_alpha + P u, or u where both are close, shape (n,). `inputs`: input
        channels at t. `q`: estimate of the parameter, shape (m,), default the prior mean: the
        linearisation point of A for a model that is nonlinear in the latent coefficients.
        """
        model, moment = self.spaces.model, Moment(t, Inputs(inputs or {}))
        at = None
        if q is not None and not model.form_A.linear_in_parameter:
            at = model.latent.inverse(q)
        now = self.spaces.observed_A(w, moment, at)
        if state.last is None or state.integral is None:
            empty = sp.csr_array(now.shape)
            return replace(state, t=t, begun=t, last=now, integral=empty)
        # Trapezoidal rule from sample to sample; the window may end a rounding error early.
        integral = sp.csr_array(state.integral + (0.5 * (t - state.t)) * (state.last + now))
        if t - state.begun < self.window * (1 - 1e-9):
            return replace(state, t=t, last=now, integral=integral)
        gram = state.gram
        if gram is not None:
            gram = gram + self._gramian(integral, np.eye(gram.shape[0]))
        return ExcitationState(
            t, t, now, sp.csr_array(now.shape), integral, gram, state.windows + 1
        )

    def _gramian(self, integral: sp.csr_array, x: Array) -> Array:
        """Return S* S x with S = R M^{-1} integral: Q -> X, as dual vectors of Q."""
        # Columns are taken in blocks that bound the memory of S x, shape (n, width).
        width = max(1, ENTRIES // integral.shape[0])
        if x.ndim == 2 and x.shape[1] > width:
            starts = range(0, x.shape[1], width)
            return np.hstack([self._gramian(integral, x[:, k : k + width]) for k in starts])
        return integral.T @ self.spaces.observed_part.projected(integral @ x)

    def spectrum(self, state: ExcitationState, *, latest: bool = False) -> Spectrum:
        """Return the spectrum of all whole windows so far, or of the latest one.

        All modes are computed up to 1000 parameters; beyond, the `count` strongest of the latest
        window by Lanczos.

        Raises `ConfigurationError`: no window is complete yet.
        """
        integral = state.latest
        if integral is None:
            raise ConfigurationError(
                f"Excitation: no window of length {self.window:g} is complete yet; add more "
                "samples, or take a shorter window."
            )
        # Strengths squared are the eigenvalues of S* S in the gain-scaled inner product of Q.
        Q = self.spaces.model.Q
        free = np.flatnonzero(Q.free)
        gram = sp.csr_array(Q.tangent_gram[free][:, free] / self.gain)
        if state.gram is not None:
            m = Q.dim
            total = self._gramian(integral, np.eye(m)) if latest else state.gram
            total = total[np.ix_(free, free)]
            values, vectors = eigh(0.5 * (total + total.T), gram.toarray())
            windows = 1 if latest else state.windows
        else:

            def apply(x: Array) -> Array:
                full = np.zeros(Q.dim)
                full[free] = x
                return self._gramian(integral, full)[free]

            space = HilbertSpace(gram)
            values, vectors = lanczos(apply, space.dual, space.riesz, len(free), self.count)
            windows = 1
        modes = np.zeros((Q.dim, len(values)))
        order = np.argsort(values)[::-1]
        modes[free] = vectors[:, order]
        return Spectrum(np.sqrt(np.maximum(values[order], 0.0)), modes, windows)


# Largest growth of the constant from the first to the second half of a run that is ignored.
STEADY = 1.5


@dataclass(frozen=True)
class Link:
    """A link condition with its fitted exponent, lambda or kappa, in [1, inf).

    `constant` is C_lambda or C_kappa, the largest value over all windows; `first` and `second` are
    the constant over the first and over the second half of the windows.
    """

    exponent: float
    constant: float
    first: float
    second: float

    @property
    def holds(self) -> bool:
        """True if the constant does not grow along the run, over its length."""
        return bool(np.isfinite(self.constant) and self.second <= STEADY * self.first)

    def __str__(self) -> str:
        verdict = "does not grow" if self.holds else "grows: the condition is in doubt"
        return f"exponent {self.exponent:.3g}, constant {self.constant:.3g}, which {verdict}"


def link(
    times: Array,
    x: Array,
    theta: Array,
    window: float,
    *,
    exponent: float | None = None,
    start: float = -np.inf,
) -> Link:
    """Fit one link condition.

    Both conditions are hypotheses of the theorems on the convergence of q. That of lambda fails for
    a data error that does not vanish: theta tends to zero with r, but x does not.

    C >= (integral over [t, t + gamma_0] of (x^a/theta)^(1/(a - 1)))^((a - 1)/a), and
    C >= sup x/theta for a = 1. For lambda x = ||p||_V^ (with noise + ||d||_V~), which needs the
    truth; for kappa x = mu.

    Values along the run have the shape (samples,); theta = mu ||r||_VX~^2/||r||_V~ as in the paper,
    the theta of a damping rule times ||r||_VX~^2. The window is gamma_0; times before `start`,
    T_lambda or T_kappa, are ignored.

    Examples
    --------
    >>> t = np.linspace(0, 10, 101)
    >>> found = link(t, np.exp(-t), np.exp(-2 * t), window=1.0)
    >>> round(found.exponent, 6), found.holds
    (2.0, True)
    >>> link(t, np.exp(-t), np.exp(-2 * t), window=1.0, exponent=1.0).holds
    False
    """
    kept = (times >= start) & (theta > 0)
    if kept.sum() < 3:
        raise ConfigurationError("link: needs three or more samples with theta > 0.")
    t, x, theta = times[kept], np.maximum(x[kept], 0.0), theta[kept]
    if not x.any():
        return Link(1.0, 0.0, 0.0, 0.0)
    a = _slope(x, theta) if exponent is None else exponent
    if not a >= 1:
        raise ConfigurationError(f"link: the exponent must be at least 1; got {a}.")
    # Close to 1 the integral norm tends to the maximum norm, which is used instead.
    if a - 1 < 1e-2:
        values, at = x / theta, t
    else:
        # The ratio is scaled by its largest value: for a near 1 the power 1/(a - 1) would overflow.
        quotient = x**a / theta
        scale = quotient.max()
        power = (quotient / scale) ** (1.0 / (a - 1.0))
        running = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (power[1:] + power[:-1]))])
        at = t[t + window <= t[-1] * (1 + 1e-12)]
        if not len(at):
            raise ConfigurationError(f"link: the run is shorter than the window {window:g}.")
        whole = np.interp(at + window, t, running) - np.interp(at, t, running)
        values = scale ** (1.0 / a) * whole ** ((a - 1.0) / a)
    middle = 0.5 * (at[0] + at[-1])
    early = values[at <= middle].max()
    return Link(float(a), float(values.max()), float(early), float(values[at >= middle].max()))


def _slope(x: Array, theta: Array) -> float:
    """Return the exponent a >= 1 of theta ~ x^a by least squares in logarithms."""
    positive = x > 1e-14 * x.max()
    lx, lt = np.log(x[positive]), np.log(theta[positive])
    spread = float(((lx - lx.mean()) ** 2).sum())
    if spread < 1e-12 * len(lx):
        return 2.0 if np.ptp(lt) > 1e-6 else 1.0
    fitted = float(((lx - lx.mean()) * (lt - lt.mean())).sum()) / spread
    return float(np.clip(fitted, 1.0, 20.0))


@dataclass(frozen=True)
class Interpolation:
    """Measured constants of c_int ||r||_V~ ||r||_X <= ||r||_VX~^2 <= C_int ||r||_V~ ||r||_X."""

    c_int: float
    C_int: float


def interpolation(norms: Sequence[Norms]) -> Interpolation:
    """Return the extreme quotients along a run.

    C_int is at most 1 for the norms of M itself, of an r without flux through the boundary of
    omega.
    """
    least = 1e-10 * max((n.X for n in norms), default=0.0)  # the rest is rounding
    quotients = [n.VX**2 / (n.V * n.X) for n in norms if n.V > 0 and least < n.X]
    if not quotients:
        raise ConfigurationError("interpolation: every residual is zero.")
    return Interpolation(min(quotients), max(quotients))
