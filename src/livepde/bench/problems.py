"""The problems of the benchmark suite: what is unknown, what is seen, where the data come from.

A problem makes a `Process` for each seed: the model that every estimator is given, and a truth of
which it is given the samples only. Except for `seed` and `seed-excited`, whose example is the
paper's with data of the same scheme, the truth comes from a finer mesh with shorter steps and is
drawn anew for each seed from the prior, so that an honest interval has something to be honest
about.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise
from time import process_time
from typing import Any

import numpy as np

from livepde.cases import load
from livepde.errors import CaseError
from livepde.fem import (
    Field,
    Inputs,
    On,
    RandomWalk,
    Scalar,
    Scalars,
    Sobolev,
    dot,
    grad,
    hermite,
    interval,
    linear,
    rectangle,
)
from livepde.identifier import Sample
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import burgers
from livepde.observation import Observation, Observed, Points
from livepde.reproduce import seed, seed_excited
from livepde.stepping import (
    Advance,
    Alexander2,
    ForwardStage,
    ImplicitEuler,
    Interval,
    Scheme,
    advance,
    simulate,
)
from livepde.streams import Twin

__all__ = ["PROBLEMS", "WARM_UP", "Data", "Problem", "Process"]

WARM_UP = 2  # samples whose time does not count: matrices are built that are built once
LEVELS = (0.0, 0.01, 0.05, 0.1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Process:
    """What an estimator is given, and the truth behind it.

    Attributes
    ----------
    model, observation, u0, scheme, dt_max, inputs, withheld, assimilate_from
        As an `Identifier` takes them; `inputs` are the channels at each time.
    times
        Of the samples, shape (times,); the first is the initial time.
    exact
        Data without noise, shape (times, sensors).
    q_true
        Coefficients of the exact parameter at each time, shape (times, m); None for a real
        process, of which nobody knows them.
    hidden
        Measured values of the withheld sensors, shape (times, withheld).
    weights
        Gram matrix of Z, shape (sensors, sensors); None: Euclidean.
    """

    model: Model
    observation: Observation
    times: Array
    exact: Array
    q_true: Array | None
    u0: Any
    scheme: Scheme = field(default_factory=ImplicitEuler)
    dt_max: float = np.inf
    inputs: Sequence[Mapping[str, float]] | None = None
    weights: Array | None = None
    withheld: Observation | None = None
    hidden: Array | None = None
    assimilate_from: float = -np.inf

    @cached_property
    def size(self) -> Array:
        """Share of each sensor in the root mean square of the exact data, shape (sensors,)."""
        weights = np.eye(self.exact.shape[1]) if self.weights is None else self.weights
        square = np.einsum("ti,ij,tj->t", self.exact, weights, self.exact).mean()
        return np.asarray(np.sqrt(square / (len(weights) * np.diag(weights))))


@dataclass(frozen=True, eq=False)
class Data:
    """One noisy data set of a problem.

    Attributes
    ----------
    problem, process
        Where it comes from.
    observation
        The sensors, with the noise level that estimators are told.
    noise
        That level for each sensor, shape (sensors,).
    z
        Measurements, shape (times, sensors).
    """

    problem: Problem
    process: Process
    observation: Observation
    noise: Array
    z: Array

    def __len__(self) -> int:
        return len(self.z)

    def __iter__(self) -> Iterator[Sample]:
        process = self.process
        names = self.observed.names
        hidden = process.withheld.names(0) if process.withheld is not None else ()
        for k, t in enumerate(process.times):
            z: Any = self.z[k]
            if process.hidden is not None:
                z = dict(zip(names, z, strict=True)) | dict(
                    zip(hidden, process.hidden[k], strict=True)
                )
            yield Sample(float(t), z, process.inputs[k] if process.inputs else None)

    @cached_property
    def observed(self) -> Observed:
        """The sensors bound to the model."""
        model = self.process.model
        return self.observation.bind(model.state_space, model.X, model.parameter_space)

    @cached_property
    def forward(self) -> float:
        """Processor time of a forward step with the parameter at its prior: the unit of cost."""
        return float(np.median([self._forward() for _ in range(3)]))

    def _forward(self) -> float:
        process, model = self.process, self.process.model
        stage_of, control = ForwardStage(model), Advance(process.scheme, process.dt_max)
        q, none = model.latent.prior, np.zeros(0)
        rows = [Inputs(dict(row)) for row in process.inputs or [{}] * len(self)]
        times = process.times.tolist()
        at = Interval(times[0], times[0], rows[0], rows[0], none, none)
        u = model.initial(process.u0, at.end)
        start = process_time()
        for k in range(1, len(times)):
            interval = Interval(times[k - 1], times[k], rows[k - 1], rows[k], none, none)

            def stage(c: Array, t: float, h: float, of: Interval = interval) -> Array:
                return stage_of.solve(c, q, h, of.at(t))

            u, _, failure = advance(control, stage, u, interval)
            if failure is not None:
                raise failure
            if k == WARM_UP:
                start = process_time()
        return (process_time() - start) / (len(times) - 1 - WARM_UP)

    @property
    def modes(self) -> dict[str, int]:
        """Modes of each field, as `SensitivityLaw` takes them."""
        return dict.fromkeys(self.process.model.parameter_space.fields, self.problem.modes)

    def until(self, at: int) -> Data:
        """Return the data up to the sample with this number."""
        process, stop = self.process, at + 1

        def cut(values: Any) -> Any:
            return None if values is None else values[:stop]

        shorter = replace(
            process,
            times=process.times[:stop],
            exact=process.exact[:stop],
            q_true=cut(process.q_true),
            inputs=cut(process.inputs),
            hidden=cut(process.hidden),
        )
        return replace(self, process=shorter, z=self.z[:stop])


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A benchmark problem.

    Parameters
    ----------
    name, summary
        What it is called, and one sentence.
    make
        Seed -> process.
    floor
        Told instead of a smaller noise level, relative to the data: what the estimator's mesh and
        step leave unexplained.
    levels
        Noise levels relative to the root mean square of the data; None: the data are measured.
    modes
        Modes of a field in the reduced coordinates that all estimators share.
    gain
        Of the gradient law, set by hand; None where the law is not meant for the sensors.
    varying
        The parameter moves: the score is the mean over the second half instead of the end.
    """

    name: str
    summary: str
    make: Callable[[int], Process]
    floor: float = 1e-3
    levels: tuple[float | None, ...] = LEVELS
    modes: int = 12
    gain: float | None = None
    varying: bool = False

    def data(self, level: float | None, seed: int) -> Data:
        """Return the data of a seed, which draws truth and noise."""
        process = self.make(seed)
        if level is None:
            observed = process.observation.bind(
                process.model.state_space, process.model.X, process.model.parameter_space
            )
            noise = observed.noise
            told = np.ones(observed.size) if noise is None else noise
            return Data(self, process, process.observation, told, process.exact)
        rng = np.random.default_rng([seed, 1])
        noise = process.size * rng.standard_normal(process.exact.shape)
        told = max(level, self.floor) * process.size
        observation = replace(process.observation, noise=told.tolist())
        return Data(self, process, observation, told, process.exact + level * noise)

    def chosen(self, levels: Sequence[float] | None) -> Sequence[float | None]:
        """Return the noise levels to run: those given, if the data are not measured."""
        return self.levels if levels is None or None in self.levels else levels

    def error(self, process: Process, q: Array, at: int = -1) -> float:
        """Return the relative error of q at a time: the root mean square over the unknowns."""
        if process.q_true is None:
            return float("nan")
        model, exact = process.model, process.q_true[at]
        shares = []
        for name in model.parameter_space.blocks:
            part = model.parameter_space.part(name)
            mass = model.parameter_mass[part, part]
            e, true = (q - exact)[part], exact[part]
            shares.append(float(e @ (mass @ e)) / float(true @ (mass @ true)))
        return float(np.sqrt(np.mean(shares)))


# --- the paper's equation ------------------------------------------------------------------------


def _twin(twin: Twin) -> Process:
    return Process(
        model=twin.model,
        observation=twin.observation,
        times=np.asarray(twin.times, dtype=float),
        exact=twin.exact_data,
        q_true=np.tile(twin.q, (len(twin.times), 1)),
        u0=twin.states[0],
        scheme=twin.scheme,
        weights=twin.weights,
    )


@cache
def _seed(_: int) -> Process:
    model, omega = seed.build(std=0.01)
    return _twin(
        Twin(
            model=model,
            observation=omega,
            q_true=seed.q_true,
            u_true=seed.u_true,
            times=seed.TIMES,
        )
    )


@cache
def _seed_excited(_: int) -> Process:
    model, full = seed_excited.build(std=3.0)
    return _twin(
        Twin(
            model=model,
            observation=full,
            q_true=seed_excited.q_true,
            u_true=seed_excited.u_true,
            times=seed_excited.TIMES,
        )
    )


# --- heat in the plane ---------------------------------------------------------------------------

PLATE_TIMES = np.linspace(0.0, 20.0, 401)
PLATE_POINTS = [(x, y) for x in (0.2, 0.5, 0.8) for y in (0.2, 0.5, 0.8)]
PLATE_WAVES = 13  # largest j^2 + k^2 of the cosines that the exact logarithm is made of


def _plate(cells: int) -> Model:
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells))
    sides = {
        "left": lambda x, t: np.sin(1.1 * t) + 0.0 * x[0],
        "right": lambda x, t: np.sin(0.7 * t) * x[1],
        "bottom": lambda x, t: np.sin(1.1 * t) * (1 - x[0]),
        "top": lambda x, t: np.sin(1.1 * t) * (1 - x[0]) + np.sin(0.7 * t) * x[0],
    }
    a = Field(
        mesh, linear(mesh), inner=Sobolev(2.0, 0.3), prior=0.1, std=PLATE_STD, transform="log"
    )
    return Model(
        Field(mesh, linear(mesh), dirichlet=sides),
        {"a": a},
        A=lambda q, u, v, x: q.a * dot(grad(u), grad(v)),
    )


PLATE_STD = 0.06


def _plate_field(seed: int) -> Callable[[Any], Any]:
    """Return a log-normal diffusivity with the covariance of the prior, as a sum of cosines."""
    rng = np.random.default_rng([seed, 0])
    waves = [(j, k) for j in range(4) for k in range(4) if j**2 + k**2 <= PLATE_WAVES]
    weights = {wave: rng.standard_normal() for wave in waves}

    def value(x: Any) -> Any:
        log = 0.0 * x[0]
        for (j, k), weight in weights.items():
            norm = np.sqrt((2.0 if j else 1.0) * (2.0 if k else 1.0))
            scale = PLATE_STD / 0.1 * norm / (1 + (0.3 * np.pi) ** 2 * (j**2 + k**2))
            log = log + scale * weight * np.cos(j * np.pi * x[0]) * np.cos(k * np.pi * x[1])
        return 0.1 * np.exp(log)

    return value


@cache
def _heat2d(seed: int) -> Process:
    model, fine = _plate(12), _plate(24)
    points, true = Points(PLATE_POINTS), {"a": _plate_field(seed)}
    G = points.matrix(fine.state_space)
    q = fine.latent.inverse(fine.parameter_space.interpolate(true))
    control = Advance(Alexander2(), dt_max=0.025)
    run = simulate(fine, q, 0.0, PLATE_TIMES.tolist(), control)
    return Process(
        model=model,
        observation=points,
        times=PLATE_TIMES,
        exact=np.array([G @ u for _, u in run]),
        q_true=np.tile(model.parameter_space.interpolate(true), (len(PLATE_TIMES), 1)),
        u0=0.0,
        scheme=Alexander2(),
    )


# --- Burgers with a viscosity that wanders -------------------------------------------------------

FLOW_TIMES = np.linspace(0.0, 20.0, 401)
FLOW_RATE = 0.1  # deviation of the logarithm per square root of time
FLOW_POINTS = [0.25, 0.5, 0.75]
FLOW_SIDES: dict[str, Any] = {
    "left": lambda x, t: 0.5 + 0.5 * np.sin(2.0 * t) + 0.0 * x[0],
    "right": 0.0,
}


def _flow_u0(x: Any) -> Any:
    return 0.5 * (1.0 - x[0])


@cache
def _burgers_varying(seed: int) -> Process:
    nu = Scalar(0.1, 0.05, transform="log", evolution=RandomWalk(FLOW_RATE))
    model = burgers(interval(0.0, 1.0, 32), nu, dirichlet=FLOW_SIDES)
    rng = np.random.default_rng([seed, 0])
    gained = FLOW_RATE * np.sqrt(np.diff(FLOW_TIMES, prepend=FLOW_TIMES[0]))
    gained[0] = 0.5  # the prior deviation of the logarithm
    path = 0.1 * np.exp(np.cumsum(gained * rng.standard_normal(len(FLOW_TIMES))))
    mesh = interval(0.0, 1.0, 96)
    fine = Model(
        Field(mesh, hermite(mesh), dirichlet=FLOW_SIDES),
        {"a": Scalar(1.0, 1.0)},
        A=lambda q, u, v, x: q.a * u * grad(u)[0] * v + x.inputs["nu"] * dot(grad(u), grad(v)),
        inputs=["nu"],
    )
    points = Points(FLOW_POINTS)
    G = points.matrix(fine.state_space)

    def inputs(t: float) -> dict[str, float]:
        return {"nu": float(np.interp(t, FLOW_TIMES, path))}

    control = Advance(Alexander2(), dt_max=0.0125)
    run = simulate(fine, np.ones(1), _flow_u0, FLOW_TIMES.tolist(), control, inputs)
    return Process(
        model=model,
        observation=points,
        times=FLOW_TIMES,
        exact=np.array([G @ u for _, u in run]),
        q_true=path[:, None],
        u0=_flow_u0,
        scheme=Alexander2(),
    )


# --- a wall of three layers ----------------------------------------------------------------------

WALL_TIMES = np.linspace(0.0, 240.0, 481)  # h
LAYERS = {"inner": (0.0, 0.1), "middle": (0.1, 0.2), "outer": (0.2, 0.3)}  # m
FILM = {"left": 8.0, "right": 20.0}  # W/(m^2 K)
BLEND = 0.004  # m, over which one layer turns into the next


def _share(x: Any, name: str) -> tuple[Any, Any]:
    """Return how much of a layer is at x, and the derivative of that."""
    start, stop = LAYERS[name]
    up = 1.0 if start == 0.0 else 0.5 * (1 + np.tanh((x[0] - start) / BLEND))
    down = 1.0 if stop == 0.3 else 0.5 * (1 - np.tanh((x[0] - stop) / BLEND))
    slope_up = 0.0 if start == 0.0 else 0.5 / BLEND / np.cosh((x[0] - start) / BLEND) ** 2
    slope_down = 0.0 if stop == 0.3 else -0.5 / BLEND / np.cosh((x[0] - stop) / BLEND) ** 2
    return up * down + 0.0 * x[0], slope_up * down + up * slope_down + 0.0 * x[0]


def _mixed(values: Any, x: Any) -> tuple[Any, Any]:
    """Return a layered coefficient and its derivative in x."""
    parts = [(values[name], *_share(x, name)) for name in LAYERS]
    return sum(value * share for value, share, _ in parts), sum(
        value * slope for value, _, slope in parts
    )


def _wall_air(t: float) -> dict[str, float]:
    """Return the temperatures of the air: heated by day, with a cold spell outside."""
    day = 2 * np.pi * t / 24.0
    heating = 2.0 * np.tanh(4.0 * np.sin(day))
    outside = 5.0 + 5.0 * np.sin(day - 2.0) + 4.0 * np.sin(day / 4.3)
    return {"inside": 20.0 + heating, "outside": outside}


def _wall_u0(x: Any) -> Any:
    return 20.0 - 50.0 * x[0]


def _wall_model() -> Model:
    """Return the wall with unknown k and C: divided by C, since the mass may not be unknown.

    C u_t = (k u_x)_x tested with v/C, whose derivative is v_x/C - v C_x/C^2.
    """
    mesh = interval(0.0, 0.3, 60)

    def conduct(q: Any, u: Any, v: Any, x: Any) -> Any:
        (k, _), (C, slope) = _mixed(q.k, x), _mixed(q.C, x)
        return k * grad(u)[0] * (grad(v)[0] / C - v * slope / C**2)

    return Model(
        Field(mesh, linear(mesh), unit="degC"),
        {
            "k": Scalars(list(LAYERS), 0.6, 0.3, unit="W/(m K)", transform="log"),
            "C": Scalars(list(LAYERS), 350.0, 140.0, unit="W h/(m^3 K)", transform="log"),
        },
        A=[
            conduct,
            On(
                "left",
                lambda q, u, v, x: FILM["left"] * (u - x.inputs["inside"]) * v / q.C["inner"],
            ),
            On(
                "right",
                lambda q, u, v, x: FILM["right"] * (u - x.inputs["outside"]) * v / q.C["outer"],
            ),
        ],
        inputs=["inside", "outside"],
        time_unit="h",
    )


def _wall_truth(k: dict[str, float], C: dict[str, float]) -> Model:
    """Return the wall as one writes it with known coefficients, on a finer mesh."""
    mesh = interval(0.0, 0.3, 240)
    return Model(
        Field(mesh, linear(mesh)),
        {"a": Scalar(1.0, 1.0)},
        A=[
            lambda q, u, v, x: q.a * _mixed(k, x)[0] * grad(u)[0] * grad(v)[0],
            On("left", lambda q, u, v, x: q.a * FILM["left"] * (u - x.inputs["inside"]) * v),
            On("right", lambda q, u, v, x: q.a * FILM["right"] * (u - x.inputs["outside"]) * v),
        ],
        M=lambda u, v, x: _mixed(C, x)[0] * u * v,
        inputs=["inside", "outside"],
    )


@cache
def _wall(seed: int) -> Process:
    model = _wall_model()
    rng = np.random.default_rng([seed, 0])
    latent = model.latent
    q = latent.value(latent.prior + latent.deviations * rng.standard_normal(latent.dim))
    k, C = (dict(zip(LAYERS, values, strict=True)) for values in (q[:3].tolist(), q[3:].tolist()))
    points = Points({"inner_surface": 0.0, "outer_surface": 0.3}, unit="degC")
    fine = _wall_truth(k, C)
    G = points.matrix(fine.state_space)
    control = Advance(Alexander2(), dt_max=0.125)
    inputs = [_wall_air(float(t)) for t in WALL_TIMES]

    def air(t: float) -> dict[str, float]:  # what is between two samples nobody measures
        return {
            name: float(np.interp(t, WALL_TIMES, [row[name] for row in inputs]))
            for name in ("inside", "outside")
        }

    run = simulate(fine, np.ones(1), _wall_u0, WALL_TIMES.tolist(), control, air)
    return Process(
        model=model,
        observation=points,
        times=WALL_TIMES,
        exact=np.array([G @ u for _, u in run]),
        q_true=np.tile(q, (len(WALL_TIMES), 1)),
        u0=_wall_u0,
        scheme=Alexander2(),
        inputs=inputs,
    )


# --- soil ----------------------------------------------------------------------------------------


@cache
def _soil(_: int) -> Process:
    from livepde.bench.cases import find_cases

    path = next((path for path in find_cases() if path.stem == "soil_layers"), None)
    if path is None:
        raise CaseError("there is no case soil_layers.toml beside the other cases.")
    prepared = load(path).prepare()
    identifier = prepared.identifier
    samples = list(prepared.stream)
    names, hidden = identifier.observed.names, prepared.identifier.withheld
    rows = [dict(sample.z) for sample in samples]  # type: ignore[arg-type]
    rows = [row | dict(sample.inputs or {}) for row, sample in zip(rows, samples, strict=True)]

    def values(channels: Sequence[str]) -> Array:
        return np.array([[row.get(name, np.nan) for name in channels] for row in rows])

    case = prepared.case
    inputs = values(identifier.inputs)
    for before, row in pairwise(inputs):
        row[np.isnan(row)] = before[np.isnan(row)]
    observation = replace(case.observation, noise=getattr(case.law, "noise", None))
    return Process(
        model=case.model,
        observation=observation,
        times=np.array([sample.t for sample in samples]),
        exact=values(names),
        q_true=None,
        u0=prepared.u0,
        scheme=case.scheme,
        dt_max=case.dt_max,
        inputs=[dict(zip(identifier.inputs, row, strict=True)) for row in inputs.tolist()],
        withheld=case.withheld,
        hidden=values(hidden.names if hidden else ()),
        assimilate_from=prepared.assimilate_from,
    )


PROBLEMS: Mapping[str, Problem] = {
    problem.name: problem
    for problem in (
        Problem(
            name="seed",
            summary="Paper's example: q(x) from u on (0.3, 0.87), data of the same scheme",
            make=_seed,
            floor=1e-5,
            gain=1e8,
        ),
        Problem(
            name="seed-excited",
            summary="The same equation, excited and fully observed, data of the same scheme",
            make=_seed_excited,
            gain=1e2,
        ),
        Problem(
            name="heat2d",
            summary="Heat in a plate: log-normal diffusivity, nine point sensors",
            make=_heat2d,
            floor=5e-3,
            modes=15,
        ),
        Problem(
            name="burgers-varying",
            summary="Burgers with a wandering viscosity, three point sensors",
            make=_burgers_varying,
            floor=3e-3,
            varying=True,
        ),
        Problem(
            name="wall",
            summary="Wall of three layers: k and C of each from the temperature of its surfaces",
            make=_wall,
        ),
        Problem(
            name="soil",
            summary="Soil, April 2025: a diffusivity for each layer; scored by a withheld sensor",
            make=_soil,
            levels=(None,),
        ),
    )
}
"""Name -> problem."""
