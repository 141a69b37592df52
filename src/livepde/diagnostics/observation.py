"""The observation operator and its projections, which must split the state as in the theory."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.report import CheckLine, CheckReport
from livepde.diagnostics.space import largest, relative
from livepde.errors import ObservationError
from livepde.fem import START
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed, Split, TransformedObserved

__all__ = ["check_observation"]

ROUNDING = 1e-12
TAYLOR = 1e-6  # of central differences with steps of 1e-5
INVERSE = 1e-9  # G^+ of sensors that nearly repeat each other amplifies rounding


def check_observation(
    observed: Observed | Observation,
    model: Model | None = None,
    *,
    seed: int = 0,
    at: float = 1.0,
) -> CheckReport:
    """Check the observation operator G and its projections R = G^+ G and P = I - R.

    R and P are idempotent, R P = 0, P maps into the null space of G, G G^+ G = G, R is self-adjoint
    in the inner product in which G^+ is taken, `reconstruct` returns R u from z = G u, and missing
    sensors shrink G and nothing else. For nonlinear sensors all this holds for their linear part
    G_0, and G'(u) is compared with differences of the readings.

    Parameters
    ----------
    observed
        A bound observation (`identifier.observed`), or an observation and its model.
    seed
        Of the random vectors.
    at
        Size of the state at which the derivative of nonlinear sensors is compared with differences.

    Returns
    -------
    CheckReport
        Print it, or call `raise_if_failed`, which raises `ObservationError`.

    >>> import livepde as lp
    >>> from skfem import ElementLineP1
    >>> mesh = lp.interval(0.0, 1.0, 8)
    >>> model = lp.Model(
    ...     lp.Field(mesh, ElementLineP1()), lp.Scalar(), A=lambda q, u, v, x: q * u * v
    ... )
    >>> check_observation(lp.Points([0.25, 0.3, 0.3]), model).ok
    True
    """
    if isinstance(observed, Observation):
        if model is None:
            raise ObservationError(
                "check_observation: an observation alone has no matrix; give its model too."
            )
        observed = observed.bind(model.state_space, model.X, model.parameter_space)
    rng = np.random.default_rng(seed)
    everything = np.ones(observed.size, dtype=bool)
    lines = _lines(observed, observed.split(), everything, rng, "")
    if observed.size > 1:
        present = everything.copy()
        present[rng.integers(observed.size)] = False
        split = observed.split(present)
        lines += _lines(observed, split, present, rng, "one sensor missing: ")
        more = split.R.trace() - observed.split().R.trace()
        lines.append(
            CheckLine.at_most(
                "one sensor missing: growth of rank R",
                more,
                ROUNDING * observed.X.dim,
                "split(present) must use the rows of G that are present, and no others.",
            )
        )
    nothing = observed.split(np.zeros(observed.size, dtype=bool))
    lines.append(
        CheckLine.at_most(
            "all sensors missing: |R|",
            largest(nothing.R),
            0.0,
            "split(present) must give R = 0 when nothing is present.",
        )
    )
    if isinstance(observed, TransformedObserved):
        lines.append(_taylor(observed, at, rng))
    return CheckReport("observation", tuple(lines), ObservationError)


def _taylor(observed: TransformedObserved, at: float, rng: np.random.Generator) -> CheckLine:
    """Compare the derivative of nonlinear sensors with a central difference of their readings."""
    u = at * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, observed.X.dim))
    direction = rng.standard_normal(observed.X.dim)
    q, step = np.zeros(observed.parameter.dim), 1e-5 * max(abs(at), 1e-300)
    more, less = (observed.predict(u + s * direction, q, START) for s in (step, -step))
    slope = observed.slope(u, q, START)
    exact = observed.G @ direction if slope is None else slope * (observed.G @ direction)
    return CheckLine.at_most(
        "G'(u) by differences",
        relative((more - less) / (2.0 * step) - exact, exact),
        TAYLOR,
        "derivative= must be that of function=; without it, function must be analytic, and "
        "defined near the state at= of the check.",
    )


def _lines(
    observed: Observed, split: Split, present: Array, rng: np.random.Generator, prefix: str
) -> list[CheckLine]:
    X, R, P = observed.X, split.R, split.P
    free = sp.diags_array(X.free)
    G = sp.csr_array(observed.G[np.flatnonzero(present)] @ free)
    gram = sp.eye_array(X.dim) if observed.observation.nodal else X.tangent_gram
    size = max(largest(R), 1.0)
    null = "R and P must come from the null space of G (M^-1 M_omega is not a projection)."
    repeated = null + " Two sensors that differ by less than 1e-6 count as one: give one of them."
    u = rng.standard_normal(X.dim)
    boundary = u * (1.0 - X.free)
    z = observed.G @ u
    z[np.logical_not(present)] = np.nan
    rebuilt = split.reconstruct(z, boundary)
    images = [
        ("R R = R", largest(R @ R - R) / size, null),
        ("P P = P", largest(P @ P - P) / size, null),
        ("R P = 0", largest(R @ P) / size, null),
        ("G P = 0", relative(G @ free @ P, G), repeated),
        ("G G^+ G = G", relative(G @ R - G, G), repeated),
    ]
    lines = [
        CheckLine.at_most(prefix + name, value, ROUNDING, text) for name, value, text in images
    ]
    dual = gram @ R
    return [
        *lines,
        CheckLine.at_most(
            prefix + "R self-adjoint",
            relative(sp.csr_array(dual - dual.T), sp.csr_array(dual)),
            INVERSE,
            "R must be orthogonal in X, or for a selection of coefficients symmetric.",
        ),
        CheckLine.at_most(
            prefix + "reconstruct(G u) = R u",
            relative(rebuilt - R @ u, R @ u),
            INVERSE,
            "reconstruct must apply G^+ to the samples present, less the known boundary values.",
        ),
    ]
