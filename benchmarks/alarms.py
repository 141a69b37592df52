"""Detection of jumps and of wrong models, and false alarms.

Jumps: a coefficient changes by a fifth between two samples, with noise of 1 % of the data. It must
be flagged within 30 samples, and the estimate must reach the new value without a restart. Without
a jump, the same filters may raise one alarm in 10 000 samples on average.

Wrong models are uniform although the ground has layers, or lack a loss or a source. The run must
report that the model does not explain the data; with the right model it must not. Simulated data
use the estimator's own scheme, so that the right model is exact. Measured data are from the cases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from benchmarks.cases import find_cases
from benchmarks.jobs import each
from livepde.cases import load
from livepde.errors import LivepdeError
from livepde.fem import Field, LogNormal, Normal, Piecewise, dot, grad, interval, linear
from livepde.identifier import Identifier
from livepde.laws import Jumps, SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import burgers
from livepde.observation import Observation, Points, Subdomain
from livepde.plots import NORMAL_95
from livepde.reproduce import seed_excited
from livepde.runs import Check, Outcome, Table, drive, unexplained
from livepde.stepping import Advance, simulate

JUMP = 0.2  # relative change of the coefficient
NOISE = 0.01  # relative to the root mean square of the data
STEP = 0.05  # time between two samples
BEFORE = (200, 300)  # samples before the jump
AFTER = 300  # samples after it
CALM = 3000  # samples of a run without a jump
CALM_RUNS = 3  # runs of each process without a jump
SOON = 30  # samples within which a jump must be flagged
SELDOM = 1.0  # largest number of false alarms in 10 000 samples
FOUND = JUMP / 3  # largest relative error after the jump
WATCHED = 300  # samples of a run with a wrong or a right model
TWINS = 10  # data sets for each wrong model

POINTS = (0.25, 0.5, 0.75)
MESH = interval(0.0, 1.0, 20, regions={"left half": lambda x: x[0] < 0.5})


# --- processes that jump -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Process:
    """A process with a coefficient that may jump.

    Attributes
    ----------
    title
        What jumps, and what is observed.
    model, observation, u0
        Arguments of `Identifier`.
    draw
        rng -> coefficients of the truth before the jump, shape (m,).
    law
        Law of the estimator.
    where
        Coefficients that are compared with the truth; default all.
    """

    title: str
    model: Model
    observation: Observation
    u0: Any
    draw: Callable[[np.random.Generator], Array]
    law: SensitivityLaw = field(default_factory=lambda: SensitivityLaw(jumps=Jumps()))
    where: Any = field(default_factory=lambda: slice(None))

    def data(self, at: int, count: int, change: float, rng: np.random.Generator) -> Data:
        """Return `count` samples; after sample `at`, q jumps by `change` (relative, 0: no jump)."""
        q, times = self.draw(rng), _times(count)
        states = _states(self.model, q, self.u0, times[: at + 1])
        if at < count:
            states += _states(self.model, (1.0 + change) * q, states[-1], times[at:])[1:]
        return _seen(self.model, self.observation, states, times, q, rng)


@dataclass(frozen=True, eq=False)
class Data:
    """Noisy samples of a process.

    Attributes
    ----------
    times, z
        Shapes (count + 1,), (count + 1, sensors); the first is the start.
    q
        Coefficients before the jump.
    observation
        Observation operator with the noise of the data.
    """

    times: Array
    z: Array
    q: Array
    observation: Any


def _seen(
    model: Model,
    observation: Any,
    states: Sequence[Array],
    times: Array,
    q: Array,
    rng: np.random.Generator,
) -> Data:
    """Return noisy readings of states."""
    observed = observation.bind(model.state_space, model.X, model.parameter_space)
    exact = np.array([observed.G @ u for u in states])
    noise = NOISE * float(np.sqrt((exact**2).mean()))
    z = exact + noise * rng.standard_normal(exact.shape)
    return Data(times, z, q, replace(observation, noise=noise))


def _times(count: int) -> Array:
    times: Array = STEP * np.arange(count + 1.0)
    return times


def _states(model: Model, q: Array, u0: Any, times: Array) -> list[Array]:
    """Return the states of the forward model, computed by the estimator's own scheme."""
    latent, control = model.latent.inverse(q), Advance(SensitivityLaw.scheme)
    return [u for _, u in simulate(model, latent, u0, times.tolist(), control)]


def _driven(x: Any, t: float) -> Any:
    return np.sin(3.0 * t) + 0.0 * x[0]


@cache
def _heat() -> Process:
    model = Model(
        Field(MESH, linear(MESH), dirichlet={"left": _driven, "right": 0.0}),
        {"a": LogNormal(0.3, 0.1)},
        A=lambda q, u, v, x: q.a * dot(grad(u), grad(v)),
    )
    return Process(
        "diffusivity, three points",
        model,
        Points(POINTS),
        0.0,
        lambda rng: rng.uniform(0.2, 0.4, 1),
    )


def _reaction(unknown: Any, title: str, observation: Observation, **options: Any) -> Process:
    """Return a process with the paper's equation and the forcing of `seed-excited`."""
    model = Model(
        Field(MESH, linear(MESH), dirichlet={"boundary": 0.0}),
        {"q": unknown},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: seed_excited.D * dot(grad(u), grad(v)),
        f=seed_excited.f,
    )
    return Process(title, model, observation, lambda x: seed_excited.u_true(x, 0.0), **options)


@cache
def _reaction_number() -> Process:
    return _reaction(
        Normal(3.0, 1.0),
        "reaction q of the paper's equation, three points",
        Points(POINTS),
        draw=lambda rng: rng.uniform(2.0, 4.0, 1),
    )


@cache
def _reaction_field() -> Process:
    x = MESH.p[0]

    def draw(rng: np.random.Generator) -> Array:
        return np.asarray(2.0 + rng.uniform(1.0, 3.0) * np.sin(np.pi * x) ** 2)

    return _reaction(
        Field(MESH, linear(MESH), inner="H1", prior=Normal(3.0, std=1.0)),
        "reaction q(x) of the paper's equation, seen on (0.3, 0.87)",
        Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87)),
        draw=draw,
        where=(x > 0.3) & (x < 0.87),
    )


@cache
def _burgers() -> Process:
    sides: dict[str, Any] = {"left": lambda x, t: 0.5 + 0.5 * np.sin(2.0 * t) + 0.0 * x[0]}
    nu = LogNormal(0.1, 0.03)
    model = burgers(interval(0.0, 1.0, 32), nu, dirichlet={**sides, "right": 0.0})
    return Process(
        "viscosity of Burgers' equation, three points",
        model,
        Points(POINTS),
        lambda x: 0.5 * (1.0 - x[0]),
        lambda rng: rng.uniform(0.08, 0.12, 1),
    )


PROCESSES: Mapping[str, Callable[[], Process]] = {
    "heat": _heat,
    "reaction": _reaction_number,
    "reaction field": _reaction_field,
    "burgers": _burgers,
}
"""Name -> function that returns the process."""


@dataclass(frozen=True)
class Detection:
    """Alarms and errors of a run with one jump, or without a jump.

    Attributes
    ----------
    delay
        Samples from the jump to the first alarm after it; infinite if there was none.
    false
        Alarms before the jump.
    repeated
        Alarms after the first one that follows the jump.
    error
        Relative error at the end, root mean square over the compared coefficients.
    covered
        Share of the compared coefficients that lie in their 95 % interval at the end.
    """

    delay: float
    false: int
    repeated: int
    error: float
    covered: float


def followed(process: Process, seed: int, change: float = 0.0, samples: int = 0) -> Detection:
    """Run a process with a jump; a seed determines all numbers.

    Parameters
    ----------
    change
        Relative change of the coefficient; zero: no jump in `samples` samples.
    """
    rng = np.random.default_rng(seed)
    at = int(rng.integers(*BEFORE)) if change else samples
    count = at + AFTER if change else samples
    data = process.data(at, count, change, rng)
    identifier = Identifier(process.model, data.observation, process.law, u0=process.u0)
    alarms = []
    for k in range(1, count + 1):
        estimate = identifier.step(data.times[k], data.z[k])
        if estimate.diagnostics.jump > 0.0:
            alarms.append(k)
    late = [k - at for k in alarms if k > at]
    truth = ((1.0 + change) * data.q)[process.where]
    belief, latent = identifier._latent_belief(), process.model.latent
    error = latent.value(belief.q)[process.where] / truth - 1.0
    # Coverage in latent coefficients is equivalent, since transforms map the ends of intervals.
    std = np.asarray(belief.q_std, dtype=float)
    exact = latent.inverse((1.0 + change) * data.q)
    inside = np.abs(belief.q - exact) <= NORMAL_95 * std
    return Detection(
        late[0] if late else np.inf,
        len(alarms) - len(late),
        max(len(late) - 1, 0),
        float(np.sqrt(np.mean(error**2))),
        float(inside[process.where].mean()),
    )


# --- wrong models --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Suspect:
    """A wrong model, and the right model for the same data.

    Attributes
    ----------
    title
        What is wrong with the wrong model.
    right, wrong
        Models of a rod with three points.
    draw
        rng -> coefficients of the truth in the right model, shape (m,).
    """

    title: str
    right: Model
    wrong: Model
    draw: Callable[[np.random.Generator], Array]


def _rod(a: Any, loss: float = 0.0, source: float = 0.0) -> Model:
    ends: dict[str, Any] = {"left": lambda x, t: 5.0 * np.sin(t) + 0.0 * x[0], "right": 0.0}

    def others(u: Any, v: Any, x: Any) -> Any:
        heating = source * np.exp(-(((x[0] - 0.4) / 0.1) ** 2))
        return loss * (u - 2.0) * v - heating * v

    return Model(
        Field(MESH, linear(MESH), dirichlet=ends),
        {"a": a},
        A=lambda q, u, v, x: q.a * dot(grad(u), grad(v)),
        B=others,
    )


def _suspects() -> dict[str, Suspect]:
    number = LogNormal(0.3, 0.1)
    halves: dict[str, Any] = {"left": "left half", "right": lambda x: x[0] >= 0.5}
    layers = Piecewise(halves, LogNormal(0.3, std=0.1))
    plain = _rod(number)

    def layered(rng: np.random.Generator) -> Array:
        first = rng.uniform(0.2, 0.4)
        return np.array([first, first * rng.choice([0.5, 2.0])])

    def one(rng: np.random.Generator) -> Array:
        return rng.uniform(0.2, 0.4, 1)

    return {
        "uniform": Suspect(
            "uniform; it has two layers, one twice the other", _rod(layers), plain, layered
        ),
        "loss": Suspect("no side loss; it has one", _rod(number, loss=0.5), plain, one),
        "forcing": Suspect("no source; it has one", _rod(number, source=2.0), plain, one),
    }


SUSPECTS: Mapping[str, Suspect] = _suspects()
"""Name -> wrong and right model."""

CASES: tuple[tuple[str, str, dict[str, Any], bool], ...] = (
    ("soil, uniform", "soil_uniform", {"law.noise": "0.1 K"}, True),
    ("soil, layers with offsets", "soil_offsets", {}, False),
    ("stream bed, uniform", "streambed_035_uniform", {}, True),
    ("stream bed, layers with offsets", "streambed_035_layers", {}, False),
)
"""Row, case, settings, and whether the model is wrong; the noise is always the thermometers'."""


def warned(suspect: Suspect, seed: int) -> tuple[bool, bool]:
    """Return whether the right and the wrong model are doubted on the same data."""
    rng = np.random.default_rng(seed)
    q, times = suspect.draw(rng), _times(WATCHED)
    states = _states(suspect.right, q, 0.0, times)
    data = _seen(suspect.right, Points(POINTS), states, times, q, rng)
    doubted = []
    for model in (suspect.right, suspect.wrong):
        identifier = Identifier(model, data.observation, SensitivityLaw(), u0=0.0)
        run = identifier.run(zip(times[1:], data.z[1:], strict=True))
        doubted.append(unexplained(run.to_xarray()))
    return doubted[0], doubted[1]


# --- the benchmark -------------------------------------------------------------------------------


def alarms(seeds: int = 5, *, few: bool = False, progress: bool = False) -> Outcome:
    """Run all processes with and without jumps, all wrong models, and all cases.

    Parameters
    ----------
    seeds
        Number of jumps up, and of jumps down, of each process.
    few
        True: one run without a jump of each process, and one data set for each wrong model.
    """
    calm_runs, twins = (1, 1) if few else (CALM_RUNS, TWINS)
    runs = [
        (name, seed, sign * JUMP) for name in PROCESSES for seed in range(seeds) for sign in (1, -1)
    ]
    runs += [(name, seed, 0.0) for name in PROCESSES for seed in range(calm_runs)]
    jumps: dict[str, list[Detection]] = {name: [] for name in PROCESSES}
    quiet: dict[str, list[Detection]] = {name: [] for name in PROCESSES}
    for (name, _, change), detection in each(_followed, runs, "runs", progress=progress):
        (jumps if change else quiet)[name].append(detection)
    models: dict[str, list[tuple[bool, bool]]] = {name: [] for name in SUSPECTS}
    pairs = [(name, seed) for name in SUSPECTS for seed in range(twins)]
    for (name, _), doubted in each(_warned, pairs, "wrong models", progress=progress):
        models[name].append(doubted)
    real, notes = [], []
    for (name, *_, wrong), answer in each(_case, CASES, "cases", progress=progress):
        if isinstance(answer, str):
            notes.append(answer)
        else:
            real.append((name, wrong, answer))
    tables = [_jumps(jumps), _false(jumps, quiet), _models(models, real)]
    return Outcome(tables, _checks(jumps, quiet, models, real), [*NOTES, *notes])


NOTES = (
    f"Jumps by {JUMP:.0%} up or down, noise of {NOISE:.0%}, samples every {STEP:g}, data from the "
    f"estimator's scheme. Errors and coverage of 95 % intervals: {AFTER} samples after the jump.",
)


def _followed(name: str, seed: int, change: float) -> Detection:
    return followed(PROCESSES[name](), seed, change, CALM)


def _warned(name: str, seed: int) -> tuple[bool, bool]:
    return warned(SUSPECTS[name], seed)


def _case(row: str, name: str, settings: Mapping[str, Any], _wrong: bool) -> bool | str:
    """Return whether a run of a case doubts its model, or why the case cannot be run."""
    try:
        path = next((path for path in find_cases() if path.stem == name), None)
        if path is None:
            return f"{row}: not run, since the folder of cases has no {name}.toml."
        prepared = load(path, settings=settings).prepare()
        run = drive(prepared.identifier, prepared.stream, journal=prepared.journal())
    except LivepdeError as error:
        return f"{row}: not run, {error}"
    return unexplained(run.result.to_xarray())


def _jumps(detections: Mapping[str, Sequence[Detection]]) -> Table:
    rows = []
    for name, runs in detections.items():
        delays = np.array([run.delay for run in runs])
        errors = np.array([run.error for run in runs])
        rows.append(
            (
                name,
                PROCESSES[name]().title,
                len(runs),
                _percent(delays <= SOON),
                float(np.median(delays)),
                float(delays.max()),
                sum(run.repeated for run in runs),
                f"{100 * np.median(errors):.2g} %",
                f"{100 * errors.max():.2g} %",
                _percent(np.array([run.covered for run in runs])),
            )
        )
    columns = (
        "process",
        "what jumps",
        "jumps",
        f"flagged in {SOON}",
        "median delay",
        "longest",
        "more alarms",
        "median error",
        "largest",
        "in the interval",
    )
    return Table("Jumps", columns, rows)


def _false(
    jumps: Mapping[str, Sequence[Detection]], quiet: Mapping[str, Sequence[Detection]]
) -> Table:
    rows = []
    for name, runs in quiet.items():
        number = sum(run.false for run in runs)
        rows.append((name, CALM * len(runs), number, sum(run.false for run in jumps[name])))
    columns = ("process", "samples without a jump", "alarms", "alarms before a jump")
    return Table("False alarms", columns, rows)


def _models(
    models: Mapping[str, Sequence[tuple[bool, bool]]], real: Sequence[tuple[str, bool, bool]]
) -> Table:
    rows: list[tuple[Any, ...]] = []
    for name, pairs in models.items():
        right, wrong = (sum(doubts) for doubts in zip(*pairs, strict=True))
        rows.append((SUSPECTS[name].title, f"{wrong} of {len(pairs)}", f"{right} of {len(pairs)}"))
    for name, wrong, doubted in real:
        answer = "yes" if doubted else "no"
        rows.append((f"{name} (real)", *((answer, "–") if wrong else ("–", answer))))
    columns = ("model", "warned", "the right one warned")
    return Table("Runs that report that the model does not explain the data", columns, rows)


def _percent(values: Any) -> str:
    return f"{100 * float(np.mean(values)):.3g} %"


def _checks(
    jumps: Mapping[str, Sequence[Detection]],
    quiet: Mapping[str, Sequence[Detection]],
    models: Mapping[str, Sequence[tuple[bool, bool]]],
    real: Sequence[tuple[str, bool, bool]],
) -> list[Check]:
    checks = []
    for name, runs in jumps.items():
        soon = float(np.mean([run.delay <= SOON for run in runs]))
        largest = max(run.error for run in runs)
        checks.append(Check(f"{name}: flagged within {SOON} samples", soon, 1.0, ">="))
        checks.append(Check(f"{name}: error after the jump", largest, FOUND, "<="))
    samples = CALM * sum(len(runs) for runs in quiet.values())
    number = sum(run.false for runs in quiet.values() for run in runs)
    rate = 1e4 * number / samples
    checks.append(Check("false alarms in 10 000 samples", rate, SELDOM, "<="))
    for name, pairs in models.items():
        right, wrong = (float(np.mean(doubts)) for doubts in zip(*pairs, strict=True))
        checks.append(Check(f"{name}: wrong model warned", wrong, 1.0, ">="))
        checks.append(Check(f"{name}: right model warned", right, 0.0, "<="))
    for name, wrong, warns in real:
        bound, sense = (1.0, ">=") if wrong else (0.0, "<=")
        checks.append(Check(f"{name}: warned", float(warns), bound, sense))  # type: ignore[arg-type]
    return checks
