"""Process behind a co-simulation unit: identifier, channels, present inputs and outputs."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from livepde import checkpoint
from livepde.cases import Case
from livepde.cases.data import refuse_late
from livepde.errors import ConfigurationError, LivepdeError
from livepde.estimate import Estimate
from livepde.frames import snapshot_of, vertex_order
from livepde.identifier import Identifier
from livepde.laws import GradientLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.records import STATUS_CODES
from livepde.samples import Sample, number
from livepde.streams import Column
from livepde.streams.cells import Missing
from livepde.streams.table import channel_value
from livepde.units import conversion

# Name of the parameter of a unit.
PERIOD = "sample_period"
REFUSED, WAITING = -2, -1  # statuses in addition to the indices of `STATUS_CODES`
# Largest number of vertices of a field that become outputs, one for each vertex.
LARGEST = 1000
# Units of differences on temperature scales with an offset.
STEPS = {"degC": "K", "degF": "degR"}
STATUS = "How the last step went: {}, {} waits for a first sample, {} sample refused.".format(
    ", ".join(f"{k} {code}" for k, code in enumerate(STATUS_CODES)), WAITING, REFUSED
)
# Largest difference of equal times due to rounding, relative to the period.
SAME = 1e-9


@dataclass(frozen=True)
class ScalarVariable:
    """Description of a variable of a unit."""

    name: str
    unit: str
    text: str


@dataclass(frozen=True)
class Port(ScalarVariable):
    """Input or output channel of a unit, in the unit of its data."""

    column: Column  # conversion of values to the unit of the model

    def taken(self, value: float, missing: Missing) -> float:
        """Return a value in the unit of the model; NaN if it is missing or invalid."""
        given = number(value, f"input '{self.name}'")
        found = channel_value(self.column, {self.name: given}, missing)
        low, high = self.column.valid
        return found if low <= found <= high else math.nan

    def given(self, value: float) -> float:
        """Return a value of the model in the unit of the channel."""
        return (value - self.column.offset) / self.column.factor


@dataclass(frozen=True)
class DataTimes:
    """First and last time and usual step of the data, in seconds; None: unknown."""

    start: float
    stop: float | None = None
    step: float | None = None


@dataclass(frozen=True, eq=False)
class UnitProcess:
    """An identifier with the inputs and outputs of a co-simulation unit."""

    name: str
    title: str  # one-line description
    model: Model
    inputs: tuple[Port, ...]  # input channels, read at each communication point
    # Sensor channels whose model values are outputs, including those for validation
    sensors: tuple[Port, ...]
    # Function that returns the identifier started by a first sample; it may raise `LivepdeError`
    begin: Callable[[Sample], Identifier]
    second: float = 1.0  # one second in the model's unit of time
    missing: Missing = frozenset()  # numbers for missing values, in addition to NaN
    covariance: bool = True  # true if the law provides standard deviations
    experiment: DataTimes | None = None  # times of the case's own data, if it has any

    @property
    def fields(self) -> tuple[str, ...]:
        """Unknown fields that are outputs, since they are not too large."""
        small = len(self.model.mesh.p[0]) <= LARGEST
        return tuple(self.model.parameter_space.fields) if small else ()

    @property
    def notes(self) -> list[str]:
        """Messages about omitted outputs."""
        space, vertices = self.model.parameter_space, len(self.model.mesh.p[0])
        return [
            f"The field {name} is not an output: it has {vertices} vertices, more than {LARGEST}."
            for name in space.fields
            if name not in self.fields
        ]

    def outputs(self) -> list[ScalarVariable]:
        """Return descriptions of the outputs except the status, in the order of `shown`.

        Raises `ConfigurationError`: two outputs have the same name.
        """
        found = [ScalarVariable("estimate_time", "s", "Time of the last sample that was used.")]
        space = self.model.parameter_space
        for label in space.labels:
            found += self._estimated(label, label)
        for name in self.fields:
            for k in range(len(self.model.mesh.p[0])):
                found += self._estimated(name, f"{name}[{k + 1}]")
        for port in self.sensors:
            text = f"The model's value of {port.name}."
            found.append(ScalarVariable(f"{port.name}_model", port.unit, text))
        names = [port.name for port in self.inputs] + [item.name for item in found]
        names += ["status", "time", PERIOD]
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(
                    f"{self.name}: two variables of the unit would be called '{name}'; rename the "
                    "channel."
                )
        return found

    def _estimated(self, label: str, name: str) -> Iterator[ScalarVariable]:
        unit = self.model.parameter_space.unknown_of(label).unit
        yield ScalarVariable(name, unit, f"Estimate of {name}.")
        if self.covariance:
            text = f"Standard deviation of {name}."
            yield ScalarVariable(f"{name}_std", STEPS.get(unit, unit), text)

    def unknown(self) -> list[float]:
        """Return the outputs before the first sample: the prior, and NaN for model values."""
        model, space = self.model, self.model.parameter_space
        q = model.latent.value(model.initial_parameter())
        found = [math.nan]
        for label, k in space.labels.items():
            found += self._pair(float(q[k]), float(space.unknown_of(label).prior.std))
        for name in self.fields:
            values = space.fields[name].at_vertices @ q[space.part(name)]
            for value in values[vertex_order(model)].tolist():
                found += self._pair(value, float(space.unknowns[name].prior.std))
        return [*found, *[math.nan] * len(self.sensors)]

    def shown(self, identifier: Identifier, estimate: Estimate) -> list[float]:
        """Return the outputs after a sample, in the order of `outputs`."""
        found = [identifier.t / self.second]
        for value, std in estimate.parameters.values():
            found += self._pair(value, std)
        if self.fields:
            profiles = snapshot_of(identifier.model, estimate.belief).profiles
            for name in self.fields:
                values = profiles[name]
                deviations = profiles.get(f"{name}_std", np.full_like(values, math.nan))
                for pair in zip(values.tolist(), deviations.tolist(), strict=True):
                    found += self._pair(*pair)
        # A forecast for the current time has the model's values of all sensors and validation.
        now = identifier.forecast(identifier.t)
        return [*found, *(port.given(float(now[port.name][0])) for port in self.sensors)]

    def _pair(self, value: float, std: float) -> list[float]:
        return [value, std] if self.covariance else [value]


def of_case(case: Case, origin: datetime | None = None) -> UnitProcess:
    """Return the process of a case.

    `origin`: the date of t = 0, if the times of the case's data are dates.

    Raises `CaseError`: a channel is late, or has a column of noise: an input of the unit has
    neither.
    """
    refuse_late(case)
    ports = {}
    for name, channel in case.spec.channels.items():
        if channel.noise_column is not None:
            text = "an exported unit has no input for the noise of each reading: leave it out."
            raise case.error(f"channels.{name}.noise_column", text)
        # With a factor, the unit of the data is not known.
        unit = "" if channel.factor is not None else channel.unit or case.unit(name)
        column = replace(case.columns[name], names=(name,))
        columns = " and ".join(channel.sources)
        text = f"Channel of role {channel.role}, as column {columns} of the data."
        ports[name] = Port(name, unit, text, column)
    validation = case.roles("validation", "ignored")
    return UnitProcess(
        case.name,
        case.title,
        case.model,
        tuple(port for name, port in ports.items() if name not in validation),
        tuple(ports[name] for name in (*case.sensors, *validation)),
        lambda first: case.begin(first, origin).identifier,
        case.clock.second,
        frozenset(case.spec.data.missing),
        not isinstance(case.law, GradientLaw),
    )


def of_code(name: str, build: Callable[[], Identifier]) -> UnitProcess:
    """Return the process of a function that returns an identifier before its first sample.

    Raises `ConfigurationError`: the function fails, or returns another type.
    """
    try:
        identifier = build()
    except LivepdeError:
        raise
    except Exception as error:
        text = f"{name} failed with {type(error).__name__}: {error}."
        raise ConfigurationError(text) from error
    if not isinstance(identifier, Identifier):
        raise ConfigurationError(
            f"{name} returned {type(identifier).__name__}; expected () -> livepde.Identifier."
        )
    sensors = _ports(identifier.observed, "Sensor.")
    unseen = _ports(identifier.validation, "Validation sensor.")
    inputs = [Port(c, "", "Input of model or sensors.", Column((c,))) for c in identifier.inputs]
    time_unit = identifier.model.time_unit
    second = conversion("s", time_unit, f"{name}: time_unit").factor if time_unit else 1.0
    return UnitProcess(
        name.rpartition(":")[2],
        f"Identifier of {name}",
        identifier.model,
        (*sensors, *inputs),
        (*sensors, *unseen),
        # Each instance of the unit starts from a copy, so that `identifier` is not changed.
        lambda first: copy.deepcopy(identifier),
        second,
        covariance=not isinstance(identifier.law, GradientLaw),
        experiment=DataTimes(identifier.t / second),
    )


def _ports(observed: Observed | None, text: str) -> list[Port]:
    if observed is None:
        return []
    named = zip(observed.names, observed.units, strict=True)
    return [Port(name, unit, text, Column((name,))) for name, unit in named]


class Component:
    """Co-simulation component: one sample per communication point; bad samples set a status.

    `inputs`: present values of the channels, NaN if missing.
    `period`: sampling period in seconds: the first step of each period takes a sample. 0: every
    step.
    `outputs`, `status`: output values, in the order of `UnitProcess.outputs`, and status code of
    the last step.
    """

    def __init__(self, process: UnitProcess) -> None:
        self.process = process
        self.inputs = [math.nan] * len(process.inputs)
        self.outputs = process.unknown()
        self.status = WAITING
        self.period = 0.0
        self._next = -math.inf
        self._first = np.zeros(0)
        self._identifier: Identifier | None = None

    def take(self, seconds: float) -> str:
        """Use the present inputs as the sample at a time; return a message for the user, or ''."""
        if self.period > 0.0 and seconds < self._next:
            return ""
        process, t = self.process, seconds * self.process.second
        try:
            z = self._sample()
            if z is None:
                return ""
            if self._identifier is None:
                self._identifier = self._begun(np.array([t, *z.values()]))
            estimate = self._identifier.step(t, z)
            if self.period > 0.0:
                # Sample times are multiples of the period, with a tolerance: rounding of
                # communication times must neither skip nor repeat a sample.
                self._next = self.period * (math.floor(seconds / self.period + SAME) + 1.0 - SAME)
        except LivepdeError as error:
            if math.isnan(self.outputs[0]):  # first sample failed: the next one may begin
                self._identifier = None
            self.status = WAITING if self._identifier is None else REFUSED
            return f"t = {seconds:g} s: {error}"
        self.status = STATUS_CODES.index(estimate.status.code)
        self.outputs = process.shown(self._identifier, estimate)
        return "" if estimate.status.ok else f"t = {seconds:g} s: {estimate.status}"

    def dump(self) -> bytes:
        """Return the complete state; `restore` continues with identical numbers."""
        leaves = {"inputs": self.inputs, "outputs": self.outputs, "status": self.status}
        leaves |= {"period": self.period, "next": self._next}
        if self._identifier is not None:
            leaves["first"] = self._first
            leaves["identifier"] = np.frombuffer(self._identifier.dump(), dtype=np.uint8)
        return checkpoint.packed({}, leaves)

    def restore(self, content: bytes) -> None:
        """Restore a state returned by `dump`; raise `RunError` if it is from a different unit."""
        where = "the state of the unit"
        _, leaves = checkpoint.unpacked(content, where)
        self.inputs, self.outputs = leaves["inputs"].tolist(), leaves["outputs"].tolist()
        self.status = int(leaves["status"])
        self.period, self._next = float(leaves["period"]), float(leaves["next"])
        if "identifier" not in leaves:
            self._identifier = None
            return
        # A new identifier is built only if the state began with another sample.
        same = np.array_equal(self._first, leaves["first"], equal_nan=True)
        if self._identifier is None or not same:
            self._identifier = self._begun(leaves["first"])
        self._identifier.restore(leaves["identifier"].tobytes(), where)

    def _sample(self) -> dict[str, float] | None:
        """Return the inputs in the model's units, NaN if missing; None if a needed one is."""
        ports, missing = self.process.inputs, self.process.missing
        given = zip(ports, self.inputs, strict=True)
        z = {port.name: port.taken(value, missing) for port, value in given}
        # Rows of a case's data without a needed channel are also left out.
        lost = any(math.isnan(z[port.name]) for port in ports if port.column.needed)
        return None if lost else z

    def _begun(self, first: Array) -> Identifier:
        """Return the identifier started by a first sample of a time and the inputs."""
        self._first = first
        names = [port.name for port in self.process.inputs]
        z = dict(zip(names, first[1:].tolist(), strict=True))
        return self.process.begin(Sample(t=float(first[0]), z=z))
