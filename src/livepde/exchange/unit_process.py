"""Process behind a co-simulation unit: identifier, input and output channels."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from livepde.cases import Case
from livepde.errors import ConfigurationError, LivepdeError
from livepde.identifier import Identifier
from livepde.laws import GradientLaw
from livepde.model import Model
from livepde.observation import Observed
from livepde.records import STATUS_CODES
from livepde.result import Estimate, Result, vertex_order
from livepde.samples import Sample, number
from livepde.streams import Column
from livepde.streams.table import channel_value
from livepde.units import conversion

# Name of the parameter of a unit.
PERIOD = "sample_period"
REFUSED, WAITING = -2, -1  # beside the indices of `STATUS_CODES`
# Largest number of vertices of a field that become outputs, one for each vertex.
LARGEST = 1000
# Units of differences on temperature scales with an offset.
STEPS = {"degC": "K", "degF": "degR"}
STATUS = "How the last step went: {}, {} waits for a first sample, {} sample refused.".format(
    ", ".join(f"{k} {code}" for k, code in enumerate(STATUS_CODES)), WAITING, REFUSED
)


@dataclass(frozen=True)
class Port:
    """Input or output channel of a unit, in the unit of its data.

    Attributes
    ----------
    column
        Conversion of values to the unit of the model.
    """

    name: str
    unit: str
    text: str
    column: Column

    def taken(self, value: float, missing: frozenset[float]) -> float:
        """Return a value in the unit of the model; NaN if it is missing or invalid."""
        given = number(value, f"input '{self.name}'")
        found = channel_value(self.column, {self.name: given}, missing)
        low, high = self.column.valid
        return found if low <= found <= high else math.nan

    def given(self, value: float) -> float:
        """Return a value of the model in the unit of the channel."""
        return (value - self.column.offset) / self.column.factor


@dataclass(frozen=True)
class OutputVariable:
    """Description of an output variable."""

    name: str
    unit: str
    text: str


@dataclass(frozen=True)
class DataTimes:
    """First and last time and usual step of the data, in seconds; None: unknown."""

    start: float
    stop: float | None = None
    step: float | None = None


@dataclass(frozen=True, eq=False)
class UnitProcess:
    """An identifier with the inputs and outputs of a co-simulation unit.

    Attributes
    ----------
    name, title
        A short name, and one line about it.
    inputs
        Input channels, read at each communication point.
    sensors
        Sensor channels whose model values are outputs, including withheld ones.
    begin
        Function that returns the identifier started by a first sample; it may raise `LivepdeError`.
    second
        One second in the model's unit of time.
    missing
        Numbers that denote a missing sample, in addition to NaN.
    covariance
        True if the law provides standard deviations.
    experiment
        Times of the case's own data, if it has any.
    """

    name: str
    title: str
    model: Model
    inputs: tuple[Port, ...]
    sensors: tuple[Port, ...]
    begin: Callable[[Sample], Identifier]
    second: float = 1.0
    missing: frozenset[float] = frozenset()
    covariance: bool = True
    experiment: DataTimes | None = None

    @property
    def fields(self) -> tuple[str, ...]:
        """Unknown fields that are outputs: those that are not too large."""
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

    def outputs(self) -> list[OutputVariable]:
        """Return descriptions of the outputs except the status, in the order of `shown`.

        Raises
        ------
        ConfigurationError
            Two outputs have the same name.
        """
        found = [OutputVariable("estimate_time", "s", "Time of the last sample that was used.")]
        space = self.model.parameter_space
        for label in space.labels:
            found += self._estimated(label, label)
        for name in self.fields:
            for k in range(len(self.model.mesh.p[0])):
                found += self._estimated(name, f"{name}[{k + 1}]")
        for port in self.sensors:
            text = f"The model's value of {port.name}."
            found.append(OutputVariable(f"{port.name}_model", port.unit, text))
        names = [port.name for port in self.inputs] + [item.name for item in found]
        names += ["status", "time", PERIOD]
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(
                    f"{self.name}: two variables of the unit would be called '{name}'; rename the "
                    "channel."
                )
        return found

    def _estimated(self, label: str, name: str) -> Iterator[OutputVariable]:
        unit = self.model.parameter_space.unknown_of(label).unit
        yield OutputVariable(name, unit, f"Estimate of {name}.")
        if self.covariance:
            yield OutputVariable(
                f"{name}_std", STEPS.get(unit, unit), f"Standard deviation of {name}."
            )

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
            result = Result(identifier.model, identifier.observed, identifier.withheld)
            profiles = result.snapshot(estimate).profiles
            for name in self.fields:
                values = profiles[name]
                deviations = profiles.get(f"{name}_std", np.full_like(values, math.nan))
                for pair in zip(values.tolist(), deviations.tolist(), strict=True):
                    found += self._pair(*pair)
        # A forecast for the present has the model's values of all sensors, withheld ones too.
        now = identifier.forecast(identifier.t)
        return [*found, *(port.given(float(now[port.name][0])) for port in self.sensors)]

    def _pair(self, value: float, std: float) -> list[float]:
        return [value, std] if self.covariance else [value]


def of_case(case: Case, origin: datetime | None = None) -> UnitProcess:
    """Return the process of a case.

    Parameters
    ----------
    origin
        The date of t = 0, if the times of the case's data are dates.
    """
    ports = {}
    for name, channel in case.spec.channels.items():
        unit = channel.unit or case.unit(name)
        column = replace(case.columns[name], names=(name,))
        columns = " and ".join(channel.sources)
        text = f"Channel of role {channel.role}, as column {columns} of the data."
        ports[name] = Port(name, unit, text, column)
    withheld = case.roles("withheld", "ignored")
    return UnitProcess(
        case.name,
        case.title,
        case.model,
        tuple(port for name, port in ports.items() if name not in withheld),
        tuple(ports[name] for name in (*case.sensors, *withheld)),
        lambda first: case.begin(first, origin).identifier,
        case.clock.second,
        frozenset(case.spec.data.missing),
        _has_covariance(case.law),
    )


def of_code(name: str, build: Callable[[], Identifier]) -> UnitProcess:
    """Return the process of a function that returns an identifier before its first sample.

    Raises
    ------
    ConfigurationError
        The function fails, or returns another type.
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
    unseen = [] if identifier.withheld is None else _ports(identifier.withheld, "Withheld sensor.")
    inputs = [Port(c, "", "Input of model or sensors.", Column((c,))) for c in identifier.inputs]
    time_unit = identifier.model.time_unit
    second = conversion("s", time_unit, f"{name}: time_unit").factor if time_unit else 1.0
    return UnitProcess(
        name.rpartition(":")[2],
        f"Identifier of {name}",
        identifier.model,
        (*sensors, *inputs),
        (*sensors, *unseen),
        # Each instance of the unit starts from a copy: `identifier` stays as it was built.
        lambda first: copy.deepcopy(identifier),
        second,
        covariance=_has_covariance(identifier.law),
        experiment=DataTimes(identifier.t / second),
    )


def _ports(observed: Observed, text: str) -> list[Port]:
    named = zip(observed.names, observed.units, strict=True)
    return [Port(name, unit, text, Column((name,))) for name, unit in named]


def _has_covariance(law: object) -> bool:
    return not isinstance(law, GradientLaw)
