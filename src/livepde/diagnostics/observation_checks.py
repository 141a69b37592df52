"""Check of an observation operator: derivatives, projections R and P, reconstruction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.check_report import Check, CheckReport
from livepde.diagnostics.space_checks import largest, relative
from livepde.errors import ObservationError
from livepde.fem import Inputs, Latent, Moment
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed, Split

ROUNDING = 1e-12
# Relative step of central differences: the cube root of the rounding unit balances truncation and
# rounding errors.
STEP = 1e-5
TAYLOR = 1e-6
# Tolerance for identities with G^+, which amplifies rounding for nearly redundant sensors.
INVERSE = 1e-9


def check_observation(
    observed: Observed | Observation,
    model: Model | None = None,
    *,
    seed: int = 0,
    at: float = 1.0,
    inputs: Mapping[str, float] | None = None,
) -> CheckReport:
    """Check the derivatives of the readings, and for linear sensors the projections R and P.

    For every sensor: `jacobian` is compared with differences of `predict` in u and in q.

    For linear sensors, with R = G^+ G and P = I - R: R and P are idempotent, R P = 0, P maps into
    the null space of G, G G^+ G = G, R is self-adjoint in the inner product in which G^+ is taken,
    `reconstruct` returns R u from z = G u, and missing sensors only remove rows of G. For
    `Transformed` sensors all this holds for their linear part G_0.

    Parameters
    ----------
    observed
        A bound observation (`identifier.observed`), or an observation and its model.
    seed
        Seed of the random vectors and times.
    at
        Size of the state at which the derivatives are compared with differences.
    inputs
        Mapping from channel to value, for sensors that read channels (default 1); positions of
        moving sensors must lie in the mesh.

    Returns
    -------
    CheckReport
        Print it, or call `raise_if_failed`, which raises `ObservationError`.

    Examples
    --------
    >>> import livepde as lp
    >>> from skfem import ElementLineP1
    >>> mesh = lp.interval(0.0, 1.0, 8)
    >>> model = lp.Model(
    ...     lp.Field(mesh, ElementLineP1()), lp.Normal(), A=lambda q, u, v, x: q * u * v
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
    lines = _projections(observed, rng) if observed.linear else []
    channels = {**dict.fromkeys(observed.observation.inputs, 1.0), **(inputs or {})}
    lines += _taylor(observed, at, Moment(rng.uniform(), Inputs(channels)), rng)
    return CheckReport("observation", tuple(lines), ObservationError)


def _projections(observed: Observed, rng: np.random.Generator) -> list[Check]:
    everything = np.ones(observed.size, dtype=bool)
    lines = _lines(observed, observed.split(), everything, rng, "")
    if observed.size > 1:
        present = everything.copy()
        present[rng.integers(observed.size)] = False
        split = observed.split(present)
        lines += _lines(observed, split, present, rng, "one sensor missing: ")
        more = split.R.trace() - observed.split().R.trace()
        lines.append(
            Check.at_most(
                "one sensor missing: growth of rank R",
                more,
                ROUNDING * observed.X.dim,
                "split(present) must use the rows of G that are present, and no others.",
            )
        )
    nothing = observed.split(np.zeros(observed.size, dtype=bool))
    lines.append(
        Check.at_most(
            "all sensors missing: |R|",
            largest(nothing.R),
            0.0,
            "split(present) must give R = 0 when nothing is present.",
        )
    )
    return lines


def _taylor(observed: Observed, at: float, moment: Moment, rng: np.random.Generator) -> list[Check]:
    """Compare the derivatives with central differences of the readings.

    Only sensors with a reading are compared, and at least one must have a reading.
    """
    n, latent = observed.X.dim, Latent(observed.parameter)
    size = max(abs(at), 1e-300)
    u = at * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, n))
    spread = latent.deviations * rng.uniform(-1.0, 1.0, latent.dim)
    a = np.clip(latent.prior + 0.1 * spread, *latent.bounds)
    q = latent.value(a)
    seen = observed.available(moment)
    H_u, H_q = observed.jacobian(u, q, moment)
    du = size * rng.standard_normal(n)
    along = latent.deviations * rng.standard_normal(latent.dim)
    dq = latent.tangent(a, along[:, None])[:, 0]
    nothing = np.zeros(observed.size)
    z = observed.predict(u, q, moment)[seen]
    text = (
        "derivative= must be that of function=; without it, function must be analytic, and "
        "defined near the state at= of the check."
    )

    def line(name: str, step: tuple[Array, Array], exact: Array) -> Check:
        more, less = (
            observed.predict(u + s * step[0], q + s * step[1], moment) for s in (STEP, -STEP)
        )
        error = ((more - less) / (2.0 * STEP) - exact)[seen]
        # Differences cannot resolve changes far below the magnitude of the readings.
        size = max(largest(exact[seen]), 1e-4 * largest(z), 1e-300)
        return Check.at_most(name, largest(error) / size, TAYLOR, text)

    return [
        Check.at_most(
            "sensors without a reading",
            1.0 - float(seen.any()),
            0.0,
            "give inputs= at which at least one sensor has a reading (a position in the mesh).",
        ),
        line("G'(u) by differences", (du, 0.0 * dq), H_u @ du),
        line("G'(q) by differences", (0.0 * du, dq), nothing if H_q is None else H_q @ dq),
    ]


def _lines(
    observed: Observed, split: Split, present: Array, rng: np.random.Generator, prefix: str
) -> list[Check]:
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
    lines = [Check.at_most(prefix + name, value, ROUNDING, text) for name, value, text in images]
    dual = gram @ R
    return [
        *lines,
        Check.at_most(
            prefix + "R self-adjoint",
            relative(sp.csr_array(dual - dual.T), sp.csr_array(dual)),
            INVERSE,
            "R must be orthogonal in X, or for a selection of coefficients symmetric.",
        ),
        Check.at_most(
            prefix + "reconstruct(G u) = R u",
            relative(rebuilt - R @ u, R @ u),
            INVERSE,
            "reconstruct must apply G^+ to the samples present, less the known boundary values.",
        ),
    ]
