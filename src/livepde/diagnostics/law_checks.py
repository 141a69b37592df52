"""Checks of observation operators and of update laws."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp

from livepde import checkpoint
from livepde.diagnostics.check_report import Check, CheckReport
from livepde.diagnostics.form_checks import largest, relative
from livepde.errors import LawError, ObservationError
from livepde.estimate import Estimate
from livepde.fem import Inputs, Latent, Moment
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, Belief, Law, Problem, Report
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed, Split
from livepde.samples import Sample, sample_of
from livepde.start import with_sensors
from livepde.stepping import Interval, Scheme, Stage, StepFailed

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

    For every sensor: `jacobian` is compared with differences of `predict` in u and in q, and it
    must not be zero in both.

    For linear sensors, with R = G^+ G and P = I - R: R and P are idempotent, R P = 0, P maps into
    the null space of G, G G^+ G = G, R is self-adjoint in the inner product in which G^+ is taken,
    `reconstruct` returns R u from z = G u, and missing sensors only remove rows of G. For
    `Transformed` sensors all this holds for their linear part G_0. Print the report, or call
    `raise_if_failed`, which raises `ObservationError`.

    Parameters
    ----------
    observed
        A bound observation (`identifier.observed`), or an observation and its model.
    at
        Size of the state at which the derivatives are compared with differences.
    inputs
        Mapping from channel to value, for sensors that read channels (default 1); positions of
        moving sensors must lie in the mesh.
    seed
        Seed of the random vectors and times.

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
        model = with_sensors(model, observed)
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
    """Compare the derivatives of sensors with a reading with central differences."""
    n, latent = observed.X.dim, Latent(observed.parameter)
    size = max(abs(at), 1e-300)
    u = at * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, n))
    spread = latent.deviations * rng.uniform(-1.0, 1.0, latent.dim)
    a = np.clip(latent.prior + 0.1 * spread, *latent.bounds)
    q = latent.value(a)
    seen = observed.available(moment)
    H_u, in_q = observed.jacobian(u, q, moment)
    H_q = np.zeros((observed.size, len(q))) if in_q is None else in_q
    du = size * rng.standard_normal(n)
    along = latent.deviations * rng.standard_normal(latent.dim)
    dq = latent.tangent(a, along[:, None])[:, 0]
    z = observed.predict(u, q, moment)[seen]
    reacts = np.asarray(abs(H_u).sum(axis=1)).ravel() + abs(H_q).sum(axis=1) > 0.0
    blind = np.logical_and(seen, ~reacts)
    text = (
        "derivative= must be that of function=; without it, function must be analytic, and "
        "defined near the state at= of the check."
    )

    def line(name: str, step: tuple[Array, Array], exact: Array) -> Check:
        more, less = (
            observed.predict(u + s * step[0], q + s * step[1], moment) for s in (STEP, -STEP)
        )
        error = np.abs((more - less) / (2.0 * STEP) - exact)[seen]
        # Differences cannot resolve changes far below the magnitude of a reading. Each sensor has
        # its own magnitude: an error of a small one would vanish beside large ones.
        size = np.maximum(np.maximum(np.abs(exact[seen]), 1e-4 * np.abs(z)), 1e-300)
        return Check.at_most(name, largest(error / size), TAYLOR, text)

    return [
        Check.at_most(
            "sensors without a reading",
            1.0 - float(seen.any()),
            0.0,
            "give inputs= at which at least one sensor has a reading (a position in the mesh).",
        ),
        Check.at_most(
            "sensors that depend on nothing",
            float(blind.sum()),
            0.0,
            f"{[name for name, one in zip(observed.names, blind, strict=True) if one]} depend "
            "neither on the state nor on the unknowns: check their rows of the matrix, or give at= "
            "a state to which they react.",
        ),
        line("G'(u) by differences", (du, 0.0 * dq), H_u @ du),
        line("G'(q) by differences", (0.0 * du, dq), H_q @ dq),
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


def check_law(
    law: AnyLaw, build: Callable[[AnyLaw], Identifier], samples: Iterable[Any]
) -> CheckReport:
    """Check an update law on a few samples of a problem.

    The law must be deterministic; its state must be a value of arrays and numbers that no step
    changes in place; a run continued from a saved state must give bit-identical numbers; estimates
    must be finite and within their bounds; factors of the covariance must have matching shapes;
    innovations must change with the readings, and constant unknowns must not change without them
    (so a `GradientLaw` with sigma fails); missing samples must not be errors; a failed step must
    keep the state and leave the stream usable. Print the report, or call `raise_if_failed`, which
    raises `LawError`.

    Parameters
    ----------
    build
        Function that returns a new identifier with the law passed to it.
    samples
        At least four items of a stream: (t, z), (t, z, inputs), or `Sample`.

    Examples
    --------
    >>> import numpy as np
    >>> import livepde as lp
    >>> from skfem import ElementLineP1
    >>> mesh = lp.interval(0.0, 1.0, 8)
    >>> model = lp.Model(
    ...     lp.Field(mesh, ElementLineP1()), lp.Normal(1.0), A=lambda q, u, v, x: q * u * v
    ... )
    >>> sensors = lp.Points([0.2, 0.7], noise=0.1)
    >>> report = check_law(
    ...     lp.SensitivityLaw(),
    ...     lambda law: lp.Identifier(model, sensors, law, u0=1.0),
    ...     [(t, np.exp([-t, -t])) for t in (0.1, 0.2, 0.3, 0.4)],
    ... )
    >>> report.ok
    True
    """
    items = [sample_of(item) for item in samples]
    if len(items) < 4:
        raise LawError(f"check_law: needs at least four samples; got {len(items)}.")

    def run(items: list[Sample], law: AnyLaw = law) -> list[Estimate]:
        identifier = build(law)
        return [_step(identifier, item) for item in items]

    middle, names = len(items) // 2, build(law).observed.names
    two, every = (middle, middle + 1), range(len(items))
    lines = [
        _count(
            "two runs agree (numbers that differ)",
            lambda: _differing(run(items), run(items)),
            "step must depend on its arguments alone: seed every generator from the state, and let "
            "nothing that prepare returned change the numbers.",
        ),
        _count(
            "the state is a value (violations)",
            lambda: _violations(law, run, items),
            "the state must be a frozen dataclass of arrays and numbers, and step must return a "
            "new one and leave the old one and the interval as they are.",
        ),
        _count(
            "restart equality (numbers that differ)",
            lambda: _differing(run(items)[middle:], _restarted(law, build, items, middle)),
            "everything that evolves must be in the state: keep nothing between steps in the law "
            "or in what prepare returned.",
        ),
        _count(
            "finite estimates (failures)",
            lambda: sum(map(_unusable, run(items))),
            "estimates must stay finite and steps must succeed: check gains, bounds and dt_max.",
        ),
        _count(
            "bounds kept (violations)",
            lambda: _outside(build(law), run(items)),
            "clip q to problem.model.latent.bounds.",
        ),
        _count(
            "factors of the covariance (wrong shapes)",
            lambda: sum(map(_misshapen, run(items))),
            "q_factor and u_factor of the belief must have shapes (m, k) and (n, k): "
            "q_factor @ q_factor.T is the covariance of q.",
        ),
        _count(
            "innovations follow the readings (sensors that do not)",
            lambda: _unmoved(run, items, middle, names),
            "`predicted` of the report must be what the model predicts, not the readings.",
        ),
        _count(
            "no readings at all (constant unknowns that change)",
            lambda: _changed(build(law), run(_without(items, every, names, names))),
            "without readings, a law must keep the constant unknowns: it may learn from "
            "interval.z1 where interval.present is True, and from nothing else, such as a known "
            "truth or a missing reading set to zero.",
        ),
        _count(
            "all sensors missing (failures)",
            lambda: sum(map(_unusable, run(_without(items, two, names, names)))),
            "with no sensor present a step must predict and not update.",
        ),
        _count(
            "one sensor missing (failures)",
            lambda: sum(map(_unusable, run(_without(items, two, names, names[:1])))),
            "use the sensors of interval.present alone: z is NaN elsewhere.",
        ),
        _count(
            "a failed step keeps the state (violations)",
            lambda: _failing(law, build, items, middle),
            "when a step fails, step must return the state it was given and a status that is not "
            "ok; the next step starts from there.",
        ),
    ]
    return CheckReport(f"law {type(law).__name__}", tuple(lines), LawError)


def _step(identifier: Identifier, item: Sample) -> Estimate:
    return identifier.step(item.t, item.z, item.inputs)


def _count(name: str, count: Callable[[], int], remedy: str) -> Check:
    """Return a line that holds if the count is zero; an exception of the law fails it."""
    try:
        return Check.at_most(name, count(), 0, remedy)
    except Exception as error:  # noqa: BLE001  reported as a failed line
        return Check.at_most(name, np.inf, 0, f"{type(error).__name__}: {error} ({remedy})")


def _numbers(estimate: Estimate) -> Array:
    """Return all numbers of the belief of a law, in one vector."""
    belief = estimate.belief
    parts = [belief.q, belief.u]
    parts += [factor for factor in (belief.q_factor, belief.u_factor) if factor is not None]
    return np.concatenate([np.ravel(part) for part in parts])


def _differing(first: list[Estimate], second: list[Estimate]) -> int:
    pairs = zip(map(_numbers, first), map(_numbers, second), strict=True)
    return sum(int(np.sum((a != b) & ~(np.isnan(a) & np.isnan(b)))) for a, b in pairs)


def _unusable(estimate: Estimate) -> int:
    return int(not estimate.status.ok) + int((~np.isfinite(_numbers(estimate))).sum())


def _outside(identifier: Identifier, estimates: list[Estimate]) -> int:
    lower, upper = identifier.model.latent.limits
    return sum(int(((e.q < lower) | (e.q > upper)).sum()) for e in estimates)


def _restarted(
    law: AnyLaw, build: Callable[[AnyLaw], Identifier], items: list[Sample], middle: int
) -> list[Estimate]:
    """Return the estimates after a restart from a state saved in the middle."""
    first, second = build(law), build(law)
    for item in items[:middle]:
        _step(first, item)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.bin"
        first.save(path)
        second.load(path)
    return [_step(second, item) for item in items[middle:]]


def _misshapen(estimate: Estimate) -> int:
    belief = estimate.belief
    pairs = ((belief.q_factor, belief.q), (belief.u_factor, belief.u))
    shapes = [(factor.shape, len(x)) for factor, x in pairs if factor is not None]
    return sum(len(s) != 2 or s[0] != size or s[1] != shapes[0][0][-1] for s, size in shapes)


def _unmoved(
    run: Callable[[list[Sample]], list[Estimate]],
    items: list[Sample],
    at: int,
    names: tuple[str, ...],
) -> int:
    """Count sensors whose innovation is the same after their reading has changed."""
    shifted = _with(items, (at,), names, names, lambda z: z + 1.0 + np.abs(z))
    before, after = (run(some[: at + 1])[at].innovation for some in (items, shifted))
    return int((before == after).sum())


def _changed(identifier: Identifier, estimates: list[Estimate]) -> int:
    """Count the coefficients of constant unknowns that differ between estimates."""
    space = identifier.model.parameter_space
    q = np.array([estimate.q for estimate in estimates])
    moved = np.ptp(q, axis=0) > 1e-9 * (1e-300 + np.abs(q).max(axis=0))
    constant = (n for n, unknown in space.unknowns.items() if not unknown.evolution.moves)
    return sum(int(moved[space.part(name)].sum()) for name in constant)


def _without(
    items: list[Sample], rows: Iterable[int], names: tuple[str, ...], gone: tuple[str, ...]
) -> list[Sample]:
    """Return the samples without the readings of the first sensors, `gone`, in given samples."""
    return _with(items, rows, names, gone, lambda z: z * np.nan)


def _with(
    items: list[Sample],
    rows: Iterable[int],
    names: tuple[str, ...],
    some: tuple[str, ...],
    change: Callable[[Any], Any],
) -> list[Sample]:
    """Return the samples with changed readings of the first sensors, `some`, in given samples."""
    changed = list(items)
    for k in rows:
        z = items[k].z
        if isinstance(z, Mapping):
            new: Any = {**z, **{name: change(np.asarray(z[name])) for name in some if name in z}}
        else:
            new = np.atleast_1d(np.array(z, dtype=float))
            values = new.reshape(len(names), -1)[: len(some), 0]  # a second column is the noise
            values[:] = change(values)
        changed[k] = replace(items[k], z=new)
    return changed


@dataclass(frozen=True)
class _Wrapped(Law[Any, Any]):
    """Law that delegates to another law; subclasses add the instrumentation."""

    law: AnyLaw

    def weighs_readings(self) -> bool:
        return self.law.weighs_readings()

    def prepare(self, problem: Problem) -> Any:
        return self.law.prepare(problem)

    def init(self, work: Any, q0: Array, u0: Array) -> Any:
        return self.law.init(work, q0, u0)

    def start(self, work: Any, q0: Array, u0: Array, moment: Moment) -> Any:
        return self.law.start(work, q0, u0, moment)

    def begin(self, work: Any, state: Any, interval: Interval) -> Any:
        return self.law.begin(work, state, interval)

    def step(self, work: Any, state: Any, interval: Interval) -> tuple[Any, Report]:
        return self.law.step(work, state, interval)

    def belief(self, work: Any, state: Any) -> Belief:
        return self.law.belief(work, state)


@dataclass(frozen=True)
class _Watched(_Wrapped):
    """Counter of states that are not plain values, and of arguments changed in place."""

    violations: list[str] = field(default_factory=list)

    def step(self, work: Any, state: Any, interval: Interval) -> tuple[Any, Report]:
        given = {**checkpoint.flatten(state), "z0": interval.z0, "z1": interval.z1}
        copies = {name: np.copy(value) for name, value in given.items()}
        result, report = self.law.step(work, state, interval)
        now = {**checkpoint.flatten(state), "z0": interval.z0, "z1": interval.z1}
        for name, value in now.items():
            if not np.array_equal(value, copies[name], equal_nan=True):
                self.violations.append(f"{name} changed in place")
        for name, value in checkpoint.flatten(result).items():
            if np.asarray(value).dtype.kind not in "biuf":
                self.violations.append(f"{name} is {type(value).__name__}")
        return result, report


def _violations(
    law: AnyLaw, run: Callable[[list[Sample], AnyLaw], list[Estimate]], items: list[Sample]
) -> int:
    watched = _Watched(law)
    run(items, watched)
    return len(watched.violations)


@dataclass(frozen=True)
class _FragileScheme(Scheme):
    """Time scheme that fails after one substep, while armed."""

    order: ClassVar[int] = 2  # whatever the scheme: stages are solved to the end

    scheme: Scheme
    calls: list[str]  # empty: not armed; shared with the law, since both are frozen

    @property
    def weight(self) -> float:
        return self.scheme.weight

    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        if self.calls:
            self.calls.append("called")
            if len(self.calls) > 2:
                raise StepFailed("not_converged", "provoked by check_law")
        return self.scheme.advance(stage, y, t, h)


@dataclass(frozen=True)
class _Fragile(_Wrapped):
    """Law with a scheme that fails in the middle of a step, while `calls` holds "armed"."""

    dt_max: float
    calls: list[str] = field(default_factory=list)

    def prepare(self, problem: Problem) -> Any:
        control = problem.control
        scheme = _FragileScheme(control.scheme, self.calls)
        dt_max = min(control.dt_max, self.dt_max)
        return self.law.prepare(
            replace(problem, control=replace(control, scheme=scheme, dt_max=dt_max))
        )


def _failing(
    law: AnyLaw, build: Callable[[AnyLaw], Identifier], items: list[Sample], middle: int
) -> int:
    """Provoke a failure after the first of two substeps; return the number of violations."""
    # With half of the shortest interval as dt_max every interval has two substeps or more.
    shortest = float(np.diff([item.t for item in items]).min())
    fragile = _Fragile(law, dt_max=0.5 * shortest)
    identifier = build(fragile)
    before = [_step(identifier, item) for item in items[:middle]][-1]
    fragile.calls.append("armed")
    failed = _step(identifier, items[middle])
    provoked = len(fragile.calls) > 2
    fragile.calls.clear()
    after = _step(identifier, items[middle + 1])
    if not provoked:  # a law that does not step by problem.control cannot be tested
        return _unusable(after)
    return int(failed.status.ok) + _differing([before], [failed]) + _unusable(after)
