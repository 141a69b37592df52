"""The only object with state: one call for every sample."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from livepde import checkpoint
from livepde.errors import (
    ConfigurationError,
    MissingInputError,
    RunError,
    SampleError,
    TimeOrderError,
)
from livepde.fem import Inputs, Moment
from livepde.laws import AnyLaw, Belief, Problem, Report, Status
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.result import Estimate, Result
from livepde.stepping import Advance, ImplicitEuler, Interval, Scheme

__all__ = ["Identifier", "Sample"]

FORMAT = 2  # of the checkpoint
NOTHING = np.zeros(0)  # withheld sensors without a value
MOST_SUBSTEPS = 1_000_000  # between two samples: a clock that is wrong must not hold a run up


@dataclass(frozen=True)
class Sample:
    """One moment of a stream.

    Attributes
    ----------
    t
        Time, in the unit of the model.
    z
        Measurements: an array of shape (sensors,), or channel name -> value for everything that
        was measured at t (sensors, inputs, withheld channels). NaN or absent: missing.
    inputs
        Input and boundary channels, if they are not in z.
    """

    t: float
    z: ArrayLike | Mapping[str, float]
    inputs: Mapping[str, float] | None = None


class Identifier:
    """Identifies parameter and state of a model, sample by sample.

    Parameters
    ----------
    model
        The process.
    observation
        What the assimilated sensors see.
    law
        How estimates are updated.
    q0, u0
        Where to start: numbers, functions of x, coefficients, or for several unknowns a mapping.
        q0 defaults to the prior mean, u0 to what the model says (`initial`), else zero.
    t0
        Initial time. A first sample at exactly t0 describes the start and takes no step; a law
        may learn from it what is unknown there.
    withheld
        Sensors that are never assimilated, only scored.
    scheme, dt_max
        Time scheme; a longer interval between samples is divided into substeps.
    assimilate_from
        Samples before this time drive inputs and are scored, but not assimilated.
    hold
        Whether inputs are held between samples at what the later one brings, as an actuator that
        is set anew at each sample leaves them; else they change linearly.

    Raises
    ------
    ConfigurationError
        Parts that do not fit together.
    """

    def __init__(
        self,
        model: Model,
        observation: Observation,
        law: AnyLaw,
        *,
        q0: Any = None,
        u0: Any = None,
        t0: float = 0.0,
        withheld: Observation | None = None,
        scheme: Scheme | None = None,
        dt_max: float = np.inf,
        assimilate_from: float = -np.inf,
        hold: bool = False,
    ) -> None:
        if not dt_max > 0:
            raise ConfigurationError(f"dt_max must be positive; got {dt_max}.")
        if not np.isfinite(t0):
            raise ConfigurationError(f"t0 must be a finite number; got {t0}.")
        self.model = model
        self.law = law
        spaces = (model.state_space, model.X, model.parameter_space)
        self.observed: Observed = observation.bind(*spaces)
        self.withheld = withheld.bind(*spaces) if withheld is not None else None
        control = Advance(scheme or ImplicitEuler(), dt_max, hold=hold)
        self.problem = Problem(model, self.observed, control)
        self.assimilate_from = assimilate_from
        self._check_names()
        self._work = law.prepare(self.problem)
        self._q0 = model.initial_parameter(q0)
        if u0 is not None and model.form_initial is not None:
            raise ConfigurationError(
                "the model has an initial state of its own (initial=): leave out u0."
            )
        self._u0 = model.state_space.interpolate(0.0 if u0 is None else u0)
        self._state: Any = None
        self._t = float(t0)
        self._z = np.full(self.observed.size, np.nan)
        self._inputs: Inputs = Inputs({})
        self._samples = 0
        if not self.inputs:
            self._begin(self._inputs)

    def placed(self, state: Any, t: float, z: Array, inputs: Array, samples: int) -> Identifier:
        """Return an identifier of the same parts that stands elsewhere; for `Fleet.identifier`.

        Parameters
        ----------
        state
            Of the law; None before it has begun.
        t, z, inputs
            Time, measurements and input channels of the last accepted sample.
        samples
            How many were taken.
        """
        other = copy.copy(self)
        other._state, other._t, other._z, other._samples = state, t, z, samples
        begun = zip(self.inputs, inputs.tolist(), strict=True) if state is not None else ()
        other._inputs = Inputs(dict(begun))
        return other

    def _check_names(self) -> None:
        hidden = self.withheld.names if self.withheld else ()
        both = [name for name in hidden if name in self.observed.names]
        if both:
            raise ConfigurationError(
                f"channels {both} are both assimilated and withheld: give the sensors names of "
                'their own, as in Points({"T_30": 0.3}).'
            )

    def _begin(self, inputs: Inputs) -> None:
        moment = Moment(self._t, inputs)
        if self.model.form_initial is not None:
            u0 = self.model.initial_state(self._q0, moment)
        else:
            u0 = self.model.impose(self._u0, moment)
        self._state = self.law.start(self._work, self._q0, u0, moment)
        self._inputs = inputs

    @property
    def u0(self) -> Array:
        """Coefficients of the given initial state, without boundary values, shape (n,)."""
        return self._u0

    @property
    def t(self) -> float:
        """Time of the last accepted sample."""
        return self._t

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Every channel a sample may name."""
        withheld = self.withheld.names if self.withheld else ()
        return tuple(dict.fromkeys([*self.observed.names, *withheld, *self.inputs]))

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Channels that the model and the sensors read."""
        withheld = self.withheld.observation.inputs if self.withheld else ()
        return tuple(dict.fromkeys([*self.problem.channels, *withheld]))

    @cached_property
    def optional_inputs(self) -> frozenset[str]:
        """Inputs that may be missing: positions of moving sensors."""
        sensors = [item.observation for item in (self.observed, self.withheld) if item is not None]
        needed = {name for item in sensors for name in set(item.inputs) - item.optional}
        found = frozenset().union(*(item.optional for item in sensors))
        return found - needed - set(self.model.channels)

    def step(
        self,
        t: float,
        z: ArrayLike | Mapping[str, float],
        inputs: Mapping[str, float] | None = None,
    ) -> Estimate:
        """Take one sample and return the estimate at its time.

        A step that fails numerically changes nothing and says so in `status`; the next sample
        tries again from the last good state. Bad input raises and changes nothing.

        Raises
        ------
        SampleError
            Wrong shape, text, infinity, or an unknown channel.
        TimeOrderError
            t is not later than the sample before.
        MissingInputError
            An input has no value yet; a later gap holds the last value and is noted. The position
            of a moving sensor may be missing, and is not held.
        """
        t = _number(t, "time t")
        if math.isnan(t):
            raise SampleError("time t is NaN; give the time of the sample.")
        measured, withheld, named = self._parse(z, inputs or {})
        values, held = self._filled(named)
        first = self._samples == 0
        if t - self._t > MOST_SUBSTEPS * self.problem.control.dt_max:
            raise SampleError(
                f"the sample at t = {t:g} is more than {MOST_SUBSTEPS} substeps of dt_max = "
                f"{self.problem.control.dt_max:g} after t = {self._t:g}: check its time, or take a "
                "longer dt_max."
            )
        if t < self._t or (t == self._t and not first):
            raise TimeOrderError(
                f"the sample at t = {t!r} is not later than the last one at t = {self._t!r}: "
                "sort the stream, and drop repeated samples."
            )
        if self._state is None:
            self._begin(values)
        used = measured if t >= self.assimilate_from else np.full_like(measured, np.nan)
        if t == self._t:
            moment = Moment(t, values)
            belief = self._belief()
            report = Report(Status(), self.observed.predict(belief.u, belief.q, moment))
            interval = Interval(t, t, values, values, used, used)
            self._state = self.law.begin(self._work, self._state, interval)
        else:
            interval = Interval(self._t, t, self._inputs, values, self._z, used)
            self._state, report = self.law.step(self._work, self._state, interval)
        self._samples += 1
        if report.status.ok:
            self._t, self._z, self._inputs = t, used, values
        return self._estimate(t, measured, withheld, values, report, held)

    def latent_belief(self) -> Belief:
        """Return what the law itself believes: q and its factor in latent coefficients.

        Those are the coefficients of `Model.Q`: of logarithms, say, or of harmonics.
        """
        belief: Belief = self.law.belief(self._work, self._state)
        return belief

    def _belief(self) -> Belief:
        """Return what the law believes, of the physical parameter."""
        return self.problem.physical(self.latent_belief())

    def _estimate(
        self,
        t: float,
        measured: Array,
        withheld: Array,
        inputs: Inputs,
        report: Report,
        held: tuple[str, ...],
    ) -> Estimate:
        belief = self._belief()
        error = withheld
        if self.withheld is not None:
            error = withheld - self.withheld.predict(belief.u, belief.q, Moment(t, inputs))
        return Estimate(
            t=t,
            q=belief.q,
            u=belief.u,
            belief=belief,
            innovation=measured - report.predicted,
            withheld_error=error,
            status=report.status,
            steps=report.steps,
            notes=report.notes,
            held=held,
            space=self.model.parameter_space,
        )

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last accepted sample.

        Raises
        ------
        MissingInputError
            Model or sensors need channels and no sample has come yet.
        """
        if self._state is None:
            raise MissingInputError(
                f"No estimate before the first sample: it brings the inputs {list(self.inputs)}."
            )
        nothing = np.full(self.observed.size, np.nan)
        hidden = np.full(self.withheld.size if self.withheld else 0, np.nan)
        belief = self._belief()
        moment = Moment(self._t, self._inputs)
        report = Report(Status(), self.observed.predict(belief.u, belief.q, moment))
        return self._estimate(self._t, nothing, hidden, self._inputs, report, ())

    def run(
        self,
        stream: Iterable[Any],
        *,
        progress: bool = False,
        total: int | None = None,
        fields_every: int = 1,
    ) -> Result:
        """Take every sample of a stream and collect the estimates.

        Parameters
        ----------
        stream
            (t, z), (t, z, inputs), or `Sample` items.
        progress
            Show a bar with rate and time left.
        total
            Number of samples, for the time left; default len(stream) if it has one.
        fields_every
            Keep the fields of every so many samples (scalars and innovations of all).
        """
        result = Result(self.model, self.observed, self.withheld, fields_every)
        for item in _watched(stream, progress, total):
            sample = item if isinstance(item, Sample) else Sample(*item)
            result.add(self.step(sample.t, sample.z, sample.inputs))
        return result

    def _parse(
        self, z: ArrayLike | Mapping[str, float], inputs: Mapping[str, float]
    ) -> tuple[Array, Array, dict[str, float]]:
        """Return assimilated values, withheld values, and inputs, all checked."""
        hidden = self.withheld.names if self.withheld else ()
        if not isinstance(z, np.ndarray) and isinstance(z, Mapping):
            unknown = [name for name in (*z, *inputs) if name not in self.channels]
            if unknown:
                raise SampleError(
                    f"unknown channel '{unknown[0]}'; this identifier has {list(self.channels)}."
                )
            values = {name: _number(value, f"channel '{name}'") for name, value in z.items()}
            measured = np.array([values.get(name, np.nan) for name in self.observed.names])
            withheld = np.array([values.get(name, np.nan) for name in hidden])
            named = {name: values[name] for name in self.inputs if name in values}
        else:
            measured = _array(z, self.observed)
            withheld, named = np.full(len(hidden), np.nan) if hidden else NOTHING, {}
        for name, value in inputs.items():
            if name not in self.inputs:
                raise SampleError(
                    f"unknown input '{name}'; model and sensors have {list(self.inputs)}."
                )
            named[name] = _number(value, f"input '{name}'")
        return measured, withheld, named

    def _filled(self, named: dict[str, float]) -> tuple[Inputs, tuple[str, ...]]:
        """Return all inputs; a missing one holds its last value."""
        if not self.inputs:
            return self._inputs, ()
        values, held, last = {}, [], dict(self._inputs)
        for name in self.inputs:
            value = named.get(name, np.nan)
            if np.isnan(value) and name not in self.optional_inputs:
                if name not in last:
                    needed = [c for c in self.inputs if c not in self.optional_inputs]
                    raise MissingInputError(
                        f"input '{name}' has no value in the first sample; start the stream where "
                        f"all of {needed} have one."
                    )
                value = last[name]
                held.append(name)
            values[name] = value
        return Inputs(values), tuple(held)

    def _fingerprint(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "law": type(self.law).__name__,
            "n": self.model.X.dim,
            "m": self.model.Q.dim,
            "sensors": list(self.observed.names),
            "channels": list(self.inputs),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file, from which `load` continues with bit-identical numbers."""
        checkpoint.write(path, self.dump())

    def dump(self) -> bytes:
        """Return the state as `save` writes it."""
        header = {**self._fingerprint(), "begun": self._state is not None}
        leaves = {
            "t": self._t,
            "z": self._z,
            "samples": self._samples,
            "inputs": np.array([self._inputs[c] for c in self._inputs]),
        }
        if self._state is not None:
            leaves |= checkpoint.flatten(self._state)
        return checkpoint.packed(header, leaves)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continue from a saved state; the identifier must be built as the one that was saved.

        Raises
        ------
        RunError
            The file is damaged, or of another model, law or set of sensors.
        """
        self.restore(checkpoint.read(path), str(path))

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Continue from what `dump` returned; `where` names it in messages. Raises as `load`."""
        header, leaves = checkpoint.unpacked(content, where)
        mine = self._fingerprint()
        for key, value in mine.items():
            if header.get(key) != value:
                if key == "format":
                    raise RunError(
                        f"{where} was saved by another version of livepde, in another format: go "
                        "on with that version, or begin anew."
                    )
                raise RunError(
                    f"{where} was saved with {key} = {header.get(key)!r}; this identifier has "
                    f"{value!r}. Build it as it was when it was saved."
                )
        state = None
        try:
            t, samples, z = float(leaves["t"]), int(leaves["samples"]), leaves["z"]
            names = self.inputs if len(leaves["inputs"]) else ()
            inputs = Inputs(dict(zip(names, leaves["inputs"].tolist(), strict=True)))
            if header["begun"]:
                template = self.law.init(self._work, self._q0, self._u0)
                state = checkpoint.rebuild(template, leaves)
        except (KeyError, ValueError) as error:
            raise RunError(
                f"{where} does not fit this identifier ({error}): build it with the law's options "
                "as they were when it was saved."
            ) from error
        self._t, self._samples, self._z, self._inputs = t, samples, z, inputs
        self._state = state
        if state is None and not self.inputs:
            self._begin(inputs)


def _number(value: Any, what: str) -> float:
    """Return a float; None is missing (NaN)."""
    if type(value) is float and math.isfinite(value):
        return value
    if value is None:
        return np.nan
    if isinstance(value, str | bytes | bool):
        raise SampleError(f"{what}: got {value!r}; expected a number (NaN if it is missing).")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise SampleError(f"{what}: got {value!r}; expected a number (NaN if missing).") from None
    if np.isinf(number):
        raise SampleError(f"{what}: got {number}; send NaN for a missing sample, never infinity.")
    return number


def _array(z: Any, observed: Observed) -> Array:
    usual = type(z) is np.ndarray and z.dtype == float and z.shape == (observed.size,)
    if usual and np.isfinite(z).all():
        return np.array(z)
    if (
        np.asarray(z).dtype.kind in "USb"
        if not isinstance(z, list | tuple)
        else any(isinstance(value, str | bytes | bool) for value in z)
    ):
        raise SampleError(f"z = {z!r} is not an array of numbers.")
    try:
        array = np.asarray(z, dtype=float)
    except (TypeError, ValueError):
        raise SampleError(f"z = {z!r} holds something that is not a number.") from None
    if array.ndim == 0 and observed.size == 1:
        array = array.reshape(1)
    if array.shape != (observed.size,):
        raise SampleError(
            f"z has shape {array.shape}; the observation has {observed.size} sensors, so it "
            f"needs ({observed.size},), NaN where a sample is missing."
        )
    if np.isinf(array).any():
        where = observed.names[int(np.flatnonzero(np.isinf(array))[0])]
        raise SampleError(f"channel '{where}' is infinite; send NaN for a missing sample.")
    return array.copy()


def _watched(stream: Iterable[Any], progress: bool, total: int | None) -> Iterable[Any]:
    if not progress:
        return stream
    from livepde.progress import watched

    size = total if total is not None else getattr(stream, "__len__", lambda: None)()
    return watched(stream, size)
