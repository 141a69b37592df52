"""Faults of sensors, channels, process, model and settings of a run."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import livepde as lp
from benchmarks.census import rods
from benchmarks.honest.problem import Problem
from benchmarks.honest.problems import PROBLEMS

Array = NDArray[Any]
HALF = 0.5  # share of the run after which sudden faults begin


@dataclass(frozen=True, eq=False)
class Scene:
    """Data of a run, and the configuration of livepde.

    Attributes
    ----------
    problem, theta
        Process, and coordinates of its truth.
    z
        Readings without noise, shape (samples, sensors).
    errors
        Noise of the readings in units of `noise`, shape (samples, sensors).
    inputs
        Channels as livepde reads them, shape (samples, channels).
    noise
        True standard deviation of the sensors.
    sensor
        Index of the faulty sensor.
    rng
        Generator of random numbers.
    points, model, u0, scheme, held
        Configuration of livepde; `held` means piecewise constant inputs.
    subject
        Name of the faulty part; empty for the process.
    believed
        Problem whose process livepde uses; None for the problem of the truth.
    """

    problem: Problem
    theta: Array
    z: Array
    errors: Array
    inputs: Array
    noise: float
    sensor: int
    rng: np.random.Generator
    points: Mapping[str, Any]
    model: Callable[[], lp.Model]
    u0: float
    scheme: Any = None
    held: bool = False
    subject: str = ""
    believed: Problem | None = None

    @property
    def name(self) -> str:
        """Name of the faulty sensor."""
        return list(self.points)[self.sensor]

    @property
    def length(self) -> int:
        """Number of samples."""
        return len(self.z)

    def like(self, other: Problem) -> Problem:
        """Return another problem, shortened to the samples and sensors of this scene."""
        return shortened(other, self.length - 1, self.z.shape[1])


def shortened(problem: Problem, intervals: int, sensors: int) -> Problem:
    """Return a problem with only its first intervals and its first sensors."""
    if intervals >= problem.intervals and sensors >= len(problem.points):
        return problem
    short = copy.copy(problem)
    short.length = problem.length * intervals / problem.intervals
    short.intervals = intervals
    short.points = dict(list(problem.points.items())[:sensors])
    return short


Change = Callable[[Scene], Scene]


@dataclass(frozen=True)
class Fault:
    """Fault of a run.

    Attributes
    ----------
    text
        Description of the fault.
    change
        Function that adds the fault to a scene.
    kinds
        Kinds of causes of a verdict that name the fault correctly; empty if there are none.
    only
        Problems with this fault; empty for all problems that meet its requirements.
    channels
        Whether the fault requires a channel.
    late
        Whether the fault begins in the middle of the run.
    own_state
        Whether the fault requires a problem with a given initial state.
    traced
        Whether it is a fault of readings, channels or process, not of noise, start or settings.
    """

    text: str
    change: Change
    kinds: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    channels: bool = False
    late: bool = False
    own_state: bool = False
    traced: bool = True


def _sensor(change: Callable[[Scene, Array], Array]) -> Change:
    """Return a change of the readings of the faulty sensor."""

    def changed(scene: Scene) -> Scene:
        z = scene.z.copy()
        z[:, scene.sensor] = change(scene, z[:, scene.sensor].copy())
        return replace(scene, z=z, subject=scene.name)

    return changed


def _late(scene: Scene, values: Array, fault: Array) -> Array:
    half = int(HALF * scene.length)
    return np.concatenate([values[:half], fault[half:]])


def _shifted(values: Array, samples: float) -> Array:
    at = np.arange(len(values))
    return np.asarray(np.interp(at - samples, at, values))


def _scaled(values: Array, factor: float) -> Array:
    return np.asarray(values[0] + factor * (values - values[0]))


def _errors(change: Callable[[Scene, Array], Array]) -> Change:
    """Return a change of the noise of the faulty sensor."""

    def changed(scene: Scene) -> Scene:
        errors = scene.errors.copy()
        errors[:, scene.sensor] = change(scene, errors[:, scene.sensor].copy())
        return replace(scene, errors=errors, subject=scene.name)

    return changed


def _autoregressive(scene: Scene, errors: Array) -> Array:
    rho, noise = 0.95, errors.copy()
    for k in range(1, len(errors)):
        noise[k] = rho * noise[k - 1] + np.sqrt(1.0 - rho**2) * errors[k]
    return noise


def _stuck(scene: Scene) -> Scene:
    z, errors, half = scene.z.copy(), scene.errors.copy(), int(HALF * scene.length)
    z[half:, scene.sensor], errors[half:, scene.sensor] = z[half, scene.sensor], 0.0
    return replace(scene, z=z, errors=errors, subject=scene.name)


def _swapped(scene: Scene) -> Scene:
    other = (scene.sensor + 1) % scene.z.shape[1]
    z = scene.z.copy()
    z[:, [scene.sensor, other]] = z[:, [other, scene.sensor]]
    return replace(scene, z=z, subject=scene.name)


def _moved(scene: Scene) -> Scene:
    at = np.atleast_1d(np.asarray(scene.points[scene.name], dtype=float)).copy()
    at[0] += 0.05
    place = float(at[0]) if len(at) == 1 else tuple(at.tolist())
    return replace(scene, points={**scene.points, scene.name: place}, subject=scene.name)


def _slow(scene: Scene, values: Array) -> Array:
    """Return readings of a sensor with a time constant of four samples."""
    lagged, share = values.copy(), 1.0 - np.exp(-1.0 / 4.0)
    for k in range(1, len(values)):
        lagged[k] = lagged[k - 1] + share * (values[k] - lagged[k - 1])
    return np.asarray(lagged)


def _means(scene: Scene) -> Scene:
    """Return a scene in which each reading is the mean of the last eight."""
    z = np.cumsum(np.concatenate([np.repeat(scene.z[:1], 8, axis=0), scene.z]), axis=0)
    return replace(scene, z=(z[8:] - z[:-8]) / 8.0)


def _common(scene: Scene) -> Scene:
    """Return a scene with an autoregressive error that all sensors share."""
    shared = _autoregressive(scene, scene.rng.standard_normal(scene.length))
    return replace(scene, errors=scene.errors + 1.5 * shared[:, None])


def _rounded(scene: Scene) -> Scene:
    """Return a scene with readings rounded to steps of three standard deviations."""
    step = 3.0 * scene.noise
    shown = np.round((scene.z + scene.noise * scene.errors) / step) * step
    return replace(scene, errors=(shown - scene.z) / scene.noise)


def _depths(scene: Scene) -> Scene:
    """Return a scene in which livepde uses positions that are 5 % too deep."""
    points = {
        name: 1.05 * place if np.ndim(place) == 0 else tuple(1.05 * np.asarray(place))
        for name, place in scene.points.items()
    }
    return replace(scene, points=points)


def _saturated(scene: Scene, values: Array) -> Array:
    low, high = values.min(), values.max()
    return np.asarray(np.minimum(values, low + 0.8 * (high - low)))


def _rod(truth: Callable[[Problem, float], Array]) -> Change:
    """Return a change that replaces the readings by readings of another rod with the same k."""

    def changed(scene: Scene) -> Scene:
        k = float(np.exp(scene.problem.latents["k"].value(scene.theta, 0)).item())
        return replace(scene, z=truth(scene.problem, k))

    return changed


def _channel(change: Callable[[Scene, Array], Array]) -> Change:
    def changed(scene: Scene) -> Scene:
        inputs = scene.inputs.copy()
        inputs[:, 0] = change(scene, inputs[:, 0].copy())
        return replace(scene, inputs=inputs, subject=next(iter(scene.problem.channels)))

    return changed


def _gaps(scene: Scene, values: Array) -> Array:
    gone = scene.rng.random(len(values)) < 0.3
    gone[0] = False
    return np.where(gone, np.nan, values)


def _channels_swapped(scene: Scene) -> Scene:
    return replace(scene, inputs=scene.inputs[:, ::-1].copy())


def _other(scene: Scene, share: Array) -> Scene:
    """Return a scene whose first coordinate moves by 1.5, with weight `share` at each sample."""
    theta = scene.theta.copy()
    theta[0] += 1.5 if theta[0] < 0.0 else -1.5
    z = scene.problem.predict(theta)
    mixed = (1.0 - share[:, None]) * scene.z + share[:, None] * z
    return replace(scene, z=mixed, subject=next(iter(scene.problem.latents)))


def _jump(scene: Scene) -> Scene:
    return _other(scene, (np.arange(scene.length) >= int(HALF * scene.length)).astype(float))


def _ramp(scene: Scene) -> Scene:
    return _other(scene, np.linspace(0.0, 1.0, scene.length))


def _lacks(of: str, **other: float) -> Change:
    """Return a change that uses the truth of another problem with the same sensors."""

    def changed(scene: Scene) -> Scene:
        truth = scene.like(PROBLEMS[of])
        theta = np.zeros(truth.coordinates)
        for place, value in other.items():
            theta[int(place[1:])] = value
        theta[0] = scene.theta[0]
        return replace(scene, z=truth.predict(theta))

    return changed


def _layers(scene: Scene) -> Scene:
    wall = scene.like(PROBLEMS["wall"])
    theta = np.array([1.5, -1.5, 1.5, -1.5])
    names = list(wall.points)
    z = wall.predict(theta)
    keep = {name: wall.points[name] for name in names}
    errors = scene.rng.standard_normal(z.shape)
    inputs = wall.inputs(wall.times)
    return replace(scene, z=z, points=keep, errors=errors, inputs=inputs, sensor=0)


def _bent(scene: Scene) -> Scene:
    theta = scene.theta.copy()
    theta[1] = 1.5
    rod = scene.like(PROBLEMS["rod"])
    z = scene.problem.predict(theta)
    return replace(scene, z=z, theta=theta, model=rod.model, believed=rod)


def _with_u0(scene: Scene) -> Scene:
    return replace(scene, u0=scene.u0 + 15.0 * scene.noise)


FAULTS: Mapping[str, Fault] = {
    "offset": Fault(
        "a sensor reads 4 sigma too high",
        _sensor(lambda s, v: v + 4.0 * s.noise),
        ("offset", "drift"),
    ),
    "offset, late": Fault(
        "a sensor reads 4 sigma too high from the middle on",
        _sensor(lambda s, v: _late(s, v, v + 4.0 * s.noise)),
        ("offset", "drift"),
        late=True,
    ),
    "drift": Fault(
        "a sensor drifts by 8 sigma in total",
        _sensor(lambda s, v: v + 8.0 * s.noise * np.linspace(0.0, 1.0, len(v))),
        ("drift", "offset"),
    ),
    "scale": Fault(
        "a sensor's scale is 20 % too large", _sensor(lambda s, v: _scaled(v, 1.2)), ("gain",)
    ),
    "unit": Fault(
        "a sensor in degrees Fahrenheit",
        _sensor(lambda s, v: 32.0 * s.noise + 1.8 * v),
        ("unit", "gain", "offset", "drift"),
    ),
    "sign": Fault("a sensor with the wrong sign", _sensor(lambda s, v: -v), ("gain",)),
    "lag": Fault("a sensor is 4 samples late", _sensor(lambda s, v: _shifted(v, 4.0)), ("lag",)),
    "lag, late": Fault(
        "a sensor is 4 samples late from the middle on",
        _sensor(lambda s, v: _late(s, v, _shifted(v, 4.0))),
        ("lag",),
        late=True,
    ),
    "lead": Fault("a sensor is 4 samples early", _sensor(lambda s, v: _shifted(v, -4.0)), ("lag",)),
    "position": Fault("a sensor's position is 0.05 too large", _moved, ("position",)),
    "swapped": Fault("two sensors are swapped", _swapped, ("exchange",)),
    "stands": Fault("a sensor is stuck", _stuck, ("stuck", "offset", "gain"), late=True),
    "noisy": Fault("a sensor is four times as noisy", _errors(lambda s, e: 4.0 * e), traced=False),
    "burst": Fault(
        "a sensor is five times as noisy for a tenth of the run",
        _errors(lambda s, e: np.where(np.abs(np.linspace(-1, 1, len(e))) < 0.1, 5.0 * e, e)),
        traced=False,
    ),
    "following": Fault(
        "errors of a sensor are AR(1) with coefficient 0.95", _errors(_autoregressive), traced=False
    ),
    "heavy tails": Fault(
        "Student errors with 3 degrees of freedom",
        lambda s: replace(s, errors=s.rng.standard_t(3, s.errors.shape) / np.sqrt(3.0)),
        traced=False,
    ),
    "channel offset": Fault(
        "a channel reads 6 sigma too high",
        _channel(lambda s, v: v + 6.0 * s.noise),
        ("boundary", "channel", "source", "flux", "offset"),
        channels=True,
    ),
    "channel scale": Fault(
        "a channel's scale is 20 % too large",
        _channel(lambda s, v: 1.2 * v),
        ("boundary", "channel", "gain"),
        channels=True,
    ),
    "channel lag": Fault(
        "a channel is 4 samples late",
        _channel(lambda s, v: _shifted(v, 4.0)),
        ("boundary", "channel", "lag"),
        channels=True,
    ),
    "channel gaps": Fault("30 % of a channel are missing", _channel(_gaps), channels=True),
    "channels swapped": Fault(
        "two channels are swapped",
        _channels_swapped,
        ("boundary", "channel", "exchange"),
        only=("rod", "wall", "profile"),
        channels=True,
    ),
    "start": Fault(
        "the initial state is 15 sigma off", _with_u0, ("initial",), own_state=True, traced=False
    ),
    "jump": Fault("the first unknown jumps", _jump, ("jump",), late=True),
    "ramp": Fault("the first unknown moves during the whole run", _ramp, ("jump",)),
    "loss": Fault(
        "a loss is missing in the model",
        _lacks("lossy-rod", t1=1.0, t2=-0.67),
        ("loss",),
        only=("rod",),
    ),
    "source": Fault(
        "a source is missing in the model",
        _lacks("lossy-rod", t1=-8.0, t2=1.0),
        ("source",),
        only=("rod",),
    ),
    "layers": Fault("layers are missing in the model", _layers, only=("rod",)),
    "bend": Fault(
        "the conductivity depends on the temperature, but not in the model",
        _bent,
        only=("warm-rod",),
    ),
    "slow": Fault("a sensor with a time constant of 4 samples", _sensor(_slow), ("lag",)),
    "means": Fault("readings are means of the last 8 samples", _means, ("lag",)),
    "saturates": Fault("a sensor saturates at 80 % of its range", _sensor(_saturated)),
    "common noise": Fault("all sensors share an AR(1) error", _common, traced=False),
    "rounded": Fault("readings are rounded to steps of 3 sigma", _rounded, traced=False),
    "depths": Fault("all depths are 5 % too large", _depths, only=("rod", "profile", "wall")),
    "advection": Fault("a flow is missing in the model", _rod(rods.advected), only=("rod",)),
    "contact": Fault("a contact resistance is missing", _rod(rods.contact), only=("rod",)),
    "averages": Fault("sensors average over a fifth", _rod(rods.averaged), only=("rod",)),
    "source, late": Fault(
        "a source from the middle on", _rod(rods.heated_late), ("source",), only=("rod",), late=True
    ),
    "loss, late": Fault(
        "a loss from the middle on", _rod(rods.cooled_late), ("loss",), only=("rod",), late=True
    ),
    "nonlinear sink": Fault("a sink of 0.5 u |u| is missing", _rod(rods.nonlinear), only=("rod",)),
    "steps": Fault(
        "implicit Euler with one step per sample",
        lambda s: replace(s, scheme=lp.ImplicitEuler()),
        traced=False,
    ),
    "held": Fault(
        "channels are piecewise constant, not linear, between samples",
        lambda s: replace(s, held=True),
        channels=True,
        traced=False,
    ),
}
