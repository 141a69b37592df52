"""A case file with its model, sensors, estimator, identifier and stream of samples."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import chain, filterfalse
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomlkit

from livepde import laws
from livepde.cases import case_channels
from livepde.cases.case_content import CaseContent, resolve
from livepde.cases.data import clock_of, read_data, reader_of, time_of, without_gaps
from livepde.cases.process import (
    conditioned,
    model_of,
    process_notes,
    value_of,
    wall_attributes,
)
from livepde.cases.read import apply, did_you_mean, key_path, read_spec, read_text, read_toml
from livepde.cases.schema import SENSORS, GradientSpec, SensitivitySpec
from livepde.diagnostics.check_report import Bound, Sense
from livepde.errors import DataError, LawError
from livepde.fem import Inputs, Moment
from livepde.fem.field_blocks import base_name
from livepde.frames import layout_of
from livepde.identifier import Identifier
from livepde.model import Model
from livepde.observation import Observation, Points
from livepde.records import Layout
from livepde.runs import Journal
from livepde.runs.summary import ROLES, TOTALS
from livepde.samples import Sample
from livepde.start import with_sensors
from livepde.stepping import Alexander2, ImplicitEuler, Scheme
from livepde.streams import Clock, Column, DataTable

Options = TypeVar("Options")


@dataclass(frozen=True, eq=False)
class Prepared:
    """A case with its data: ready to run.

    Attributes
    ----------
    first
        The first sample, which gives the initial state and inputs.
    stream
        All samples. A `DataTable` can be iterated repeatedly, standard input only once. In a table,
        gaps of boundary and input channels are interpolated and their spikes removed.
    assimilate_from
        Model time from which sensors are assimilated and scores are computed.
    origin
        Date of t = 0; None if the data have no dates.
    raw
        The table as read, including its gaps; None for a stream.
    live
        True for a run that waits for its source.
    """

    case: Case
    first: Sample
    stream: Iterable[Sample]
    assimilate_from: float
    origin: datetime | None
    raw: DataTable | None = None
    live: bool = False

    @cached_property
    def identifier(self) -> Identifier:
        """The identifier, before the first sample."""
        law = self.case.law
        identifier = self.identifier_with(law.live() if self.live else law)
        if self.case.spec.output.smoothed and (why := identifier._unsmoothed):
            raise self.case.error("output.smoothed", f"{why}; leave it out.")
        return identifier

    def identifier_with(self, law: laws.AnyLaw, sensors: Observation | None = None) -> Identifier:
        """Return an identifier of this case for a given law and, optionally, other sensors."""
        case = self.case
        return Identifier(
            case.model,
            case.observation if sensors is None else sensors,
            law,
            u0=self.u0,
            t0=self.t0,
            validation=case.validation,
            ignored=case.ignored,
            scheme=case.scheme,
            dt_max=case.dt_max,
            assimilate_from=self.assimilate_from,
            between=case_channels.between_of(case),
            **self.uncertain(law),
        )

    @cached_property
    def t0(self) -> float:
        """Time of the initial state: `data.t0`, by default the time of the first sample."""
        case, first = self.case, float(self.first.t)
        stated = time_of(case, "t0", self.origin)
        if stated is None:
            return first
        if stated > first:
            text = f"{stated:g} {case.equation.time_unit}".rstrip()
            text = f"{text} is later than the first row; state the time of the initial state"
            raise case.error("data.t0", f"{text}, or leave out the rows before with `data.start`.")
        if stated < first and case_channels.interpolates(case):
            text = "the initial state is interpolated from the first row: leave out t0, or give "
            raise case.error("data.t0", f"{text}`initial` a value.")
        return float(stated)

    def uncertain(self, law: laws.AnyLaw) -> dict[str, Any]:
        """Return the options of an identifier for input noise and errors of the initial state."""
        case = self.case
        if isinstance(law, laws.GradientLaw):  # it has no covariance
            return {}
        noise = {"input_noise": case_channels.input_noise_of(case)}
        if self.u0 is None:
            return noise
        weights = case_channels.initial_weights(case, self.first)
        errors = case_channels.initial_errors(case, self.first)
        return {**noise, "u0_from": weights, "u0_errors": errors}

    @cached_property
    def u0(self) -> Any:
        """The initial state: a number, a function of x, or None if the model defines it."""
        case = self.case
        if case.model.form_initial is None:
            return case_channels.initial_of(case, self.first)
        if case.spec.initial is not None:
            raise case.error("initial", "the equation has its own initial state; leave it out.")
        return None

    def typical(self, inputs: Mapping[str, float]) -> float:
        """Return the mean magnitude of the initial state, or 1 if it is zero, for checks."""
        model, moment = self.case.model, Moment(float(self.first.t), Inputs(inputs))
        if self.u0 is None:
            u = model.initial_state(model.initial_parameter(), moment)
        else:
            u = model.initial(self.u0, moment)
        return float(np.abs(u).mean()) or 1.0

    @cached_property
    def layout(self) -> Layout:
        """Layout of the records of a run, with title, origin, units and references of the case."""
        who = self.identifier
        return self.described(layout_of(who.model, who.observed, who.validation, who.ignored))

    def described(self, found: Layout) -> Layout:
        """Return a layout with the references, unit of length and attributes of the case."""
        numbers = dict(found.numbers)
        for label, value in self.case.references.items():
            numbers[label] = {**numbers[label], "reference": value}
        return replace(
            found,
            numbers=numbers,
            length_unit=self.case.equation.length_unit,
            attrs={**found.attrs, **self.attributes},
        )

    def journal(self, path: Path | None = None) -> Journal:
        """Return a new journal for a run of this case, in memory if `path` is None."""
        return Journal.create(path, self.identifier.channels, self.layout)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of a dataset of this case, such as title, equation and origin."""
        equation = self.case.equation
        found: dict[str, Any] = {"title": self.case.title, "equation": equation.formula}
        if np.isfinite(self.assimilate_from):
            found["assimilate_from"] = self.assimilate_from
        if self.origin is not None:
            found["origin"] = self.origin.isoformat(sep=" ")
        if self.case.source:
            found["reference_source"] = self.case.source
        return found | wall_attributes(self.case, self.case.model)


def load(
    path: str | os.PathLike[str],
    *,
    allow_code: bool = False,
    settings: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
) -> Case:
    """Read and check a case file.

    Parameters
    ----------
    path
        A TOML file.
    allow_code
        Allow user code for equation and reader ('module:function', 'file.py:function').
    settings
        Key -> value that overrides the file, such as {"law.noise": "2 K"}; several mappings are
        applied in their order.

    Raises
    ------
    CaseError
        The case is invalid. The message contains key, value, expected value and remedy.
    """
    file = Path(path)
    # A run directory stores the effective text, including the settings.
    text = original = read_text(file)
    document = read_toml(text, str(file))
    for each in (settings,) if isinstance(settings, Mapping) else settings or ():
        if each:
            with_members(document, each, file, allow_code)
            document = apply(document, each, str(file))
            text = tomlkit.dumps(document)
    content = conditioned(_expanded(document, file, allow_code))
    whole = content.path, content.spec, content.equation, content.reader, text, original
    case = Case(*whole, families=content.families)
    case.check()
    return case


def _expanded(document: Mapping[str, Any], file: Path, allow_code: bool) -> CaseContent:
    """Return the content of a document, with families of sensors expanded to single channels."""
    spec = read_spec(document, str(file))
    place = (spec, file.parent, str(file), allow_code)
    return case_channels.expanded(CaseContent(file, spec, resolve(*place), reader_of(*place)))


def with_members(
    document: dict[str, Any], settings: Mapping[str, Any], file: Path, allow_code: bool
) -> None:
    """Replace in a document each family with a member named in settings by single channels."""
    paths = [key_path(key, str(file)) for key in settings]
    names = [path[1] for path in paths if path[0] == "channels" and len(path) > 2]
    case_channels.split_families(document, names, lambda: _expanded(document, file, allow_code))


@dataclass(frozen=True, eq=False)
class Case(CaseContent):
    """A case file whose parts have been checked for consistency; `prepare` adds the data.

    Attributes
    ----------
    text
        Effective text of the case, with settings applied.
    original
        Content of the file.
    """

    text: str
    original: str

    def check(self) -> None:
        """Build all parts that require no data; raises `CaseError`."""
        # The mesh is first: an error about it may cause errors about the parts that use it.
        _ = self.mesh, self.options, self.model, self.observation, self.validation, self.law
        _ = self.columns, self.clock, self.scheme, self.dt_max, self.references
        _ = case_channels.input_noise_of(self), wall_attributes(self, self.model)
        case_channels.check_initial(self)
        self._check_names()

    def _check_names(self) -> None:
        """Refuse names that are reserved for results of a run, and outputs that do not exist."""
        kinds = (
            ("unknowns", "unknown", self.model.parameter_space.labels, TOTALS),
            ("channels", "channel", self.roles(*SENSORS), ROLES),
        )
        for key, kind, given, taken in kinds:
            for name in given:
                if name in taken:
                    text = f"'{name}' is another number in [expect]; give the "
                    raise self.error(f"{key}.{name}", f"{text}{kind} another name.")
        labels = self.model.parameter_space.labels
        written = [*labels, *(f"{label}_std" for label in labels), "verdict"]
        nodes = self.spec.output.opcua
        for node, name in nodes.columns.items() if nodes else ():
            key = f"output.opcua.columns.'{node}'"
            self.require(name, written, key, f"a run has no number '{name}'")

    @property
    def title(self) -> str:
        """The title, by default the name of the file."""
        return self.spec.title or self.path.stem

    @cached_property
    def references(self) -> dict[str, float]:
        """Label of an unknown -> its reference value, in the model's unit."""
        space = self.model.parameter_space
        found = {}
        for label, value in self.spec.reference.items():
            # 'source' is the publication, unless an unknown has this name.
            if label == "source" and label not in space.labels:
                continue
            text = f"there is no unknown number '{label}'"
            self.require(label, space.labels, "reference", text)
            key, name = f"reference.{label}", base_name(label)
            if name in self.spec.unknowns:
                found[label] = value_of(self, name, value, key)
            else:
                found[label] = self.convert(value, space.unknown_of(label).unit, key)
        return found

    @property
    def source(self) -> str:
        """Source of the references, such as a publication; empty if none is given."""
        given = self.spec.reference.get("source", "")
        return given if isinstance(given, str) and "source" not in self.references else ""

    @property
    def expected(self) -> dict[str, tuple[Sense, Bound]]:
        """Name of a result of the run -> how it is compared, and its expected bound or range."""
        return dict(self.spec.expect)

    @cached_property
    def model(self) -> Model:
        """The model, including the states of sensors with a time constant."""
        return with_sensors(model_of(self), self.observation, self.validation)

    @cached_property
    def columns(self) -> dict[str, Column]:
        """Channel -> its column in the data."""
        return case_channels.columns_of(self)

    @cached_property
    def observation(self) -> Observation:
        """The assimilated sensors."""
        observation = case_channels.observation_of(self, "sensor")
        if observation is None:
            text = "there is no sensor. Add at least one channel with role = 'sensor'."
            raise self.error("channels", text)
        return observation

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the assimilated sensors, in the order of the innovation."""
        kinds = case_channels.kinds_of(self.roles("sensor"))
        return tuple(chain.from_iterable(kinds.values()))

    @cached_property
    def validation(self) -> Observation | None:
        """The sensors of role validation or ignored; None if there are none."""
        return case_channels.observation_of(self, "validation", "ignored")

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of the ignored sensors, which are displayed but do not affect any verdict."""
        return tuple(self.roles("ignored"))

    @cached_property
    def law(self) -> laws.AnyLaw:
        """The update law."""
        spec = self.spec.law
        with self.located("law", LawError):
            if not isinstance(spec, GradientSpec):
                return _sensitivity(self, spec)
            damping: laws.Damping = laws.ResidualDamping(1.0 if spec.c1 is None else spec.c1)
            if spec.mu is not None:
                damping = laws.ConstantDamping(spec.mu)
            return laws.GradientLaw(spec.gain, damping, nu=spec.nu, sigma=spec.sigma)

    @cached_property
    def scheme(self) -> Scheme:
        """The time scheme."""
        schemes = {"alexander2": Alexander2(), "implicit-euler": ImplicitEuler()}
        name = self.spec.steps.scheme
        return self.law.scheme if name is None else schemes[name]

    @cached_property
    def dt_max(self) -> float:
        """The longest time step; infinite by default."""
        unit = self.equation.time_unit
        return self.positive(self.spec.steps.dt_max, unit, "steps.dt_max", np.inf)

    @cached_property
    def clock(self) -> Clock:
        """The clock, which converts the time column to model time."""
        return clock_of(self)

    @property
    def notes(self) -> list[str]:
        """Notes on allowed settings that may be mistakes."""
        found = [*process_notes(self, self.model), *case_channels.flux_notes(self)]
        return [*found, *case_channels.cell_notes(self), *self._law_notes, *self._expect_notes]

    @property
    def _law_notes(self) -> Iterator[str]:
        if isinstance(self.law, laws.GradientLaw) and isinstance(self.observation, Points):
            yield (
                "The gradient law is made for observed subdomains and averages; a few noisy point "
                "sensors mislead it. Use law.kind = 'sensitivity' for points."
            )
        if settings := self.with_intervals:
            options = " ".join(f"--set {setting}" for setting in settings)
            noise = "" if case_channels.noise_of(self) else ", and state the `noise` of each sensor"
            yield (
                "The gradient law has no covariance: its estimates have no intervals, and none "
                f"with model errors. For intervals, run this case with `{options}`{noise}."
            )

    @property
    def _expect_notes(self) -> Iterator[str]:
        # The names of all results of a run are defined in `runs.measures`.
        labels = self.model.parameter_space.labels
        known = [
            *labels,
            *(f"{label}.std" for label in labels),
            *(f"{label}.{of}" for label in self.references for of in ("error", "deviations")),
            *TOTALS,
            *(f"rmse.{name}" for name in (*ROLES, *self.roles(*SENSORS))),
        ]
        for name in filterfalse(known.__contains__, self.expected):
            text = f"a run of this case has no such number; {did_you_mean(name, known)}"
            yield f"expect.{name}: {text}"

    def prepare(self, source: str | Iterable[str] | None = None) -> Prepared:
        """Return the case with its data, ready to run.

        Parameters
        ----------
        source
            A file that replaces the file of the case, or lines of JSON.

        Raises
        ------
        DataError
            The data cannot be used. The message contains file, row and column.
        """
        prepared = self.read(source)
        _ = prepared.identifier  # raises errors about inconsistent data here
        return prepared

    def read(self, source: str | Iterable[str] | None = None) -> Prepared:
        """Return the case with its data, without building the identifier as `prepare` does."""
        raw = read_data(self, source)
        table = raw if isinstance(raw, DataTable) else None
        data = raw if table is None else without_gaps(self, table)
        samples: Iterator[Sample] = iter(data)
        first = next(samples, None)
        if first is None:
            raise DataError(f"{self.path}: the data contain no sample between start and stop.")
        start = self._assimilated_from(data.origin)
        # A stream can be read only once: its first sample is put back.
        stream = chain([first], samples) if table is None else data
        return Prepared(self, first, stream, start, data.origin, table)

    def _assimilated_from(self, origin: datetime | None) -> float:
        start = time_of(self, "assimilate_from", origin)
        return -math.inf if start is None else float(start)

    @property
    def live(self) -> bool:
        """Whether the source in the case file is live: a growing file, a broker or a server."""
        return self.spec.data.live

    def is_live(self, data: str | None) -> bool:
        """Return whether the source is live; `data` is a file that replaces the case's source."""
        if data is None:
            return self.live
        return self.spec.data.follow and data != "-" and not data.endswith(".parquet")

    def begin(
        self, first: Sample, origin: datetime | None = None, *, live: bool = False
    ) -> Prepared:
        """Return the case with the first sample of a live process.

        Parameters
        ----------
        first
            The first sample, which gives the initial state and inputs.
        origin
            The date of t = 0; None if times are numbers.
        live
            True for a run that waits for its source.

        Raises
        ------
        DataError
            A value for the initial state or an input is missing in the sample.
        """
        start = self._assimilated_from(origin)
        prepared = Prepared(self, first, (), start, origin, live=live)
        prepared.identifier_with(self.law).step(first.t, first.z)  # raises on missing values
        return prepared


def _sensitivity(case: CaseContent, spec: SensitivitySpec) -> laws.SensitivityLaw:
    time = case.equation.time_unit
    return laws.SensitivityLaw(
        modes=spec.modes,
        memory=case.positive(spec.memory, time, "law.memory", laws.SensitivityLaw.memory),
        drift=case.convert(spec.drift, f"1/{time}" if time else "", "law.drift"),
        noise=_noise(case, spec),
        refit=_chosen(laws.Refit, spec.refit),
        rank=spec.rank,
        gate=spec.gate,
        gate_patience=spec.gate_patience,
        jumps=_jumps(case, spec),
        guards=_chosen(laws.Guards, spec.guards),
        shadows=_chosen(laws.Shadows, spec.shadows),
        verdict=spec.verdict,
    )


def _jumps(case: CaseContent, spec: SensitivitySpec) -> laws.Jumps | None:
    """Return the test for jumps of all unknowns (true), named unknowns, or with given options."""
    given = spec.jumps
    found = laws.Jumps(unknowns=given) if isinstance(given, tuple) else _chosen(laws.Jumps, given)
    known = [*case.spec.unknowns, *case_channels.unknowns_of(case)]
    key = "law.jumps" if isinstance(given, tuple) else "law.jumps.unknowns"
    for name in (found.unknowns if found is not None else None) or ():
        case.require(name, known, key, f"there is no unknown '{name}'")
    return found


def _chosen(kind: type[Options], given: bool | Options) -> Options | None:
    """Return options of a law: defaults for true, None for false, or the options themselves."""
    if isinstance(given, bool):
        return kind() if given else None
    return given


def _noise(case: CaseContent, spec: SensitivitySpec) -> float | str | None:
    """Return the noise of the law: a number, 'auto', or None if every sensor states its noise."""
    if spec.noise is not None and spec.noise != "auto":
        if plates := [name for name, item in case.roles("sensor").items() if item.is_flux]:
            text = (
                f"is the noise of all sensors, but {plates[0]} measures a flux. Leave it out, and "
            )
            raise case.error("law.noise", text + "state the `noise` of every sensor.")
        return case.positive(spec.noise, case.equation.state.unit, "law.noise")
    if case_channels.noise_of(case) is None:
        if spec.noise == "auto":
            text = "'auto' scales a first guess: state the `noise` of every sensor as that guess."
            raise case.error("law.noise", text)
        raise case.missing(
            "law.noise",
            "the sensitivity law weighs the sensors by their noise (a standard deviation); "
            "give it here or with every sensor.",
        )
    return None if spec.noise is None else "auto"
