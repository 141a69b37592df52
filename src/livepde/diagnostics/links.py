"""Link conditions (cond:link) and interpolation inequality (interpol) along a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livepde.errors import ConfigurationError
from livepde.laws.damping import Norms
from livepde.linalg import Array

# Growth of the constant from the first to the second half of a run that counts as none.
STEADY = 1.5


@dataclass(frozen=True)
class Link:
    """A link condition with its fitted exponent.

    Attributes
    ----------
    exponent
        lambda or kappa, in [1, inf): the fit of theta ~ x^exponent.
    constant
        C_lambda or C_kappa, the largest value over all windows.
    first, second
        The constant over the first and over the second half of the windows.
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

    Parameters
    ----------
    times, x, theta
        Values along the run, shapes (samples,); theta = mu ||r||_VX~^2/||r||_V~ as in the paper.
    window
        gamma_0.
    exponent
        Given exponent, instead of the fitted one.
    start
        T_lambda or T_kappa: earlier times are ignored.

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
