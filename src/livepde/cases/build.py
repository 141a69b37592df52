"""From a case file to an identifier and its stream."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from livepde.cases.equations import resolve
from livepde.cases.read import did_you_mean, read_spec, read_text
from livepde.cases.schema import CaseSpec, ChannelSpec, GradientSpec, MeshSpec, UnknownSpec
from livepde.cases.units import conversion, convert
from livepde.errors import CaseError, DataError
from livepde.fem import Channel, Field, Piecewise, Scalar, dot, grad, interval, rectangle
from livepde.identifier import Identifier, Sample
from livepde.laws import (
    AnyLaw,
    ConstantDamping,
    Damping,
    GradientLaw,
    Replay,
    ResidualDamping,
    SensitivityLaw,
)
from livepde.model import Model
from livepde.models import Equation
from livepde.observation import Averages, Observation, Points
from livepde.runs.outcome import Bound, Sense
from livepde.stepping import Alexander2, ImplicitEuler, Scheme
from livepde.streams import Clock, Column, JsonLines, Table, read_csv, read_json_lines

__all__ = ["Case", "Prepared", "load"]

DATE = re.compile(r"\s*\d{4}-\d{2}-\d{2}")
VARIABLE = "${LIVEPDE_DATA}"


@dataclass(frozen=True, eq=False)
class Prepared:
    """A case with its data: ready to run.

    Attributes
    ----------
    first
        The first sample, which describes the start.
    stream
        All samples. A `Table` can be iterated again, standard input cannot.
    assimilate_from
        Model time from which sensors are assimilated; scores count from here, too.
    origin
        Date of t = 0, if the data have dates.
    """

    case: Case
    first: Sample
    stream: Iterable[Sample]
    assimilate_from: float
    origin: datetime | None

    @property
    def law(self) -> AnyLaw:
        """The update law."""
        return self.case.law

    @cached_property
    def identifier(self) -> Identifier:
        """The identifier, before the first sample."""
        return self.identifier_with(self.law)

    def identifier_with(self, law: AnyLaw) -> Identifier:
        """Return an identifier for the same case with another law."""
        case = self.case
        return Identifier(
            case.model,
            case.observation,
            law,
            u0=case.initial(self.first),
            t0=float(self.first.t),
            withheld=case.withheld,
            scheme=case.scheme,
            dt_max=case.dt_max,
            assimilate_from=self.assimilate_from,
        )

    @property
    def attributes(self) -> dict[str, Any]:
        """What a dataset of this case should say about itself."""
        equation = self.case.equation
        found: dict[str, Any] = {
            "title": self.case.title,
            "equation": equation.formula,
            "time_units": equation.time_unit,
            "length_units": equation.length_unit,
        }
        if np.isfinite(self.assimilate_from):
            found["assimilate_from"] = self.assimilate_from
        if self.origin is not None:
            found["origin"] = self.origin.isoformat(sep=" ")
        return found


def load(path: str | os.PathLike[str], *, allow_code: bool = False) -> Case:
    """Read and check a case file.

    Parameters
    ----------
    path
        A TOML file.
    allow_code
        Load an equation of the user's own ('module:function' or 'file.py:function').

    Raises
    ------
    CaseError
        One sentence: which key, what it got, what was expected, and the remedy.
    """
    file = Path(path)
    text = read_text(file)
    spec = read_spec(text, str(file))
    case = Case(file, text, spec, resolve(spec, file.parent, str(file), allow_code))
    case.check()
    return case


@dataclass(frozen=True, eq=False)
class Case:
    """A case file whose parts fit together; `prepare` adds the data.

    Attributes
    ----------
    path, text
        The file and its content.
    spec
        Its content, checked.
    equation
        The PDE it names.
    """

    path: Path
    text: str
    spec: CaseSpec
    equation: Equation

    @property
    def title(self) -> str:
        """The title, or the name of the file."""
        return self.spec.title or self.path.stem

    def where(self, key: str) -> str:
        """Return file and key for a message."""
        return f"{self.path}: {key}"

    def check(self) -> None:
        """Build all that needs no data; raises `CaseError`."""
        _ = self.model, self.observation, self.withheld, self.law, self.columns, self.clock
        _ = self.scheme, self.dt_max

    def _convert(self, value: Any, unit: str, key: str, *, difference: bool = False) -> float:
        return convert(value, unit, self.where(key), difference=difference)

    # --- mesh and model ----------------------------------------------------------------------

    @cached_property
    def mesh(self) -> Any:
        """The mesh."""
        spec: MeshSpec = self.spec.mesh
        unit = self.equation.length_unit
        if spec.x is not None and spec.y is not None:
            x = self._pair(spec.x, unit, "mesh.x")
            y = self._pair(spec.y, unit, "mesh.y")
            return rectangle(x, y, spec.cells if isinstance(spec.cells, tuple) else (1, 1))
        start = self._convert(spec.start, unit, "mesh.from")
        stop = self._convert(spec.stop, unit, "mesh.to")
        if not stop > start:
            raise CaseError(f"{self.where('mesh')}: got from {start} to {stop}; needs from < to.")
        geometric = spec.spacing == "geometric"
        if geometric and not start > 0:
            raise CaseError(f"{self.where('mesh.spacing')}: 'geometric' needs from > 0.")
        cells = spec.cells if isinstance(spec.cells, int) else spec.cells[0]
        return interval(start, stop, cells, geometric=geometric)

    def _pair(self, pair: tuple[Any, Any], unit: str, key: str) -> tuple[float, float]:
        low, high = (self._convert(value, unit, key) for value in pair)
        if not low < high:
            raise CaseError(f"{self.where(key)}: got [{low}, {high}]; needs low < high.")
        return low, high

    @cached_property
    def options(self) -> dict[str, float]:
        """Known numbers of the equation."""
        known = self.equation.options
        self._only(self.spec.options, known, "options")
        values = {}
        for name, option in known.items():
            key = f"options.{name}"
            if name in self.spec.options:
                values[name] = self._convert(self.spec.options[name], option.unit, key)
            elif option.default is not None:
                values[name] = option.default
            else:
                raise CaseError(
                    f"{self.where(key)} is missing: the {option.text}, in {option.unit}."
                )
        return values

    def _only(self, given: Iterable[str], known: Iterable[str], key: str) -> None:
        for name in given:
            if name not in known:
                raise CaseError(
                    f"{self.where(key)}: the equation '{self.equation.name}' has no '{name}' here; "
                    f"{did_you_mean(name, known)}"
                )

    @cached_property
    def unknowns(self) -> dict[str, Any]:
        """The unknowns, with priors in the model's units."""
        known = self.equation.unknowns
        self._only(self.spec.unknowns, known, "unknowns")
        for name, variable in known.items():
            if name not in self.spec.unknowns:
                raise CaseError(
                    f"{self.where(f'unknowns.{name}')} is missing: the {variable.text}, with prior "
                    f"and std in {variable.unit or 'no unit'}."
                )
        return {
            name: self._unknown(name, spec, known[name].unit)
            for name, spec in self.spec.unknowns.items()
        }

    def _unknown(self, name: str, spec: UnknownSpec, unit: str) -> Any:
        key = f"unknowns.{name}"
        rule = conversion(spec.unit or unit, unit, self.where(f"{key}.unit"))

        def value(given: float | str, item: str, *, difference: bool = False) -> float:
            if isinstance(given, float):
                return rule.factor * given + (0.0 if difference else rule.offset)
            return self._convert(given, unit, f"{key}.{item}", difference=difference)

        prior = value(spec.prior, "prior")
        std = value(spec.std, "std", difference=True)
        if not std > 0:
            raise CaseError(f"{self.where(f'{key}.std')}: got {spec.std!r}; expected more than 0.")
        if spec.field:
            return self._field(spec, prior, std, unit, key)
        low, high = -np.inf, np.inf
        if spec.bounds is not None:
            low, high = (value(bound, "bounds") for bound in spec.bounds)
            if not low <= prior <= high or low == high:
                raise CaseError(
                    f"{self.where(f'{key}.bounds')}: got {list(spec.bounds)}; expected low < high "
                    f"with the prior {spec.prior!r} between them."
                )
        if spec.regions is None:
            return Scalar(prior, std, (low, high), unit)
        return Piecewise(self._regions(spec.regions, key), prior, std, (low, high), unit)

    def _field(self, spec: UnknownSpec, prior: float, std: float, unit: str, key: str) -> Field:
        mesh = self.mesh
        length = float(mesh.p[0].max() - mesh.p[0].min()) / 3
        if spec.length is not None:
            length = self._convert(spec.length, self.equation.length_unit, f"{key}.length")
        if not length > 0:
            raise CaseError(f"{self.where(f'{key}.length')}: got {length}; expected more than 0.")

        # In one dimension the covariance is exp(-|x - y|/length): std holds at every point.
        def inner(u: Any, v: Any, x: Any) -> Any:
            return 0.5 * (u * v / length + length * dot(grad(u), grad(v)))

        element = self.equation.element(mesh)
        return Field(mesh, element, inner=inner, prior=prior, std=std, unit=unit)

    def _regions(self, regions: Mapping[str, Any], key: str) -> dict[str, Any]:
        """Return predicates of layers; they have to tile the mesh."""
        mesh, unit = self.mesh, self.equation.length_unit
        if len(mesh.p) != 1:
            raise CaseError(f"{self.where(f'{key}.regions')}: layers need a mesh of an interval.")
        middle = mesh.p[0][mesh.t].mean(axis=0)
        count = np.zeros(len(middle))
        found = {}
        for name, pair in regions.items():
            low, high = self._pair(pair, unit, f"{key}.regions.{name}")

            def inside(x: Any, low: float = low, high: float = high) -> Any:
                return (x[0] >= low) & (x[0] < high)

            here = inside(middle[None])
            if not here.any():
                raise CaseError(
                    f"{self.where(f'{key}.regions.{name}')}: [{low:g}, {high:g}] {unit} holds no "
                    f"cell of the mesh, which spans {mesh.p.min():g} to {mesh.p.max():g} {unit}."
                )
            count += here
            found[name] = inside
        wrong = np.flatnonzero(count != 1)
        if len(wrong):
            x, times = middle[wrong[0]], int(count[wrong[0]])
            raise CaseError(
                f"{self.where(f'{key}.regions')}: {x:.4g} {unit} lies in {times} layers; every "
                "point of the mesh has to lie in exactly one."
            )
        return found

    @cached_property
    def model(self) -> Model:
        """The model."""
        inputs = self._roles("input")
        self._only(inputs, self.equation.inputs, "channels (role input)")
        for name, variable in self.equation.inputs.items():
            if name not in inputs:
                raise CaseError(
                    f"{self.where(f'channels.{name}')} is missing: the {variable.text}, "
                    "with role = 'input'."
                )
        return self.equation.build(self.mesh, self.unknowns, self._dirichlet, **self.options)

    @cached_property
    def _dirichlet(self) -> dict[str, Any]:
        known = [*(self.mesh.boundaries or {}), "boundary"]
        values: dict[str, Any] = {}
        unit = self.equation.state.unit
        for name, value in self.spec.boundary.items():
            if name not in known:
                key = self.where("boundary")
                raise CaseError(f"{key}: no boundary '{name}'; {did_you_mean(name, known)}")
            values[name] = self._convert(value, unit, f"boundary.{name}")
        for name, channel in self._roles("boundary").items():
            key, at = self.where(f"channels.{name}.at"), str(channel.at)
            if at not in known:
                raise CaseError(f"{key}: no boundary '{at}'; {did_you_mean(at, known)}")
            if at in values:
                raise CaseError(f"{key}: the boundary '{at}' has a value already; keep one.")
            values[at] = Channel(name)
        return values

    # --- channels ----------------------------------------------------------------------------

    def _roles(self, *roles: str) -> dict[str, ChannelSpec]:
        return {name: item for name, item in self.spec.channels.items() if item.role in roles}

    def unit(self, name: str) -> str:
        """Return the model's unit of a channel."""
        if self.spec.channels[name].role == "input":
            return self.equation.inputs[name].unit
        return self.equation.state.unit

    @cached_property
    def columns(self) -> dict[str, Column]:
        """Channel -> where it comes from in the data."""
        found = {}
        for name, channel in self.spec.channels.items():
            unit = self.unit(name)
            rule = conversion(channel.unit or unit, unit, self.where(f"channels.{name}.unit"))
            found[name] = Column(channel.sources, rule.factor, rule.offset)
        return found

    @cached_property
    def observation(self) -> Observation:
        """What is assimilated."""
        observation = self._observe(self._roles("sensor"))
        if observation is None:
            raise CaseError(
                f"{self.where('channels')}: there is no sensor to learn from; give at least one "
                "channel role = 'sensor'."
            )
        return observation

    @cached_property
    def withheld(self) -> Observation | None:
        """What is scored only."""
        return self._observe(self._roles("withheld"))

    def _observe(self, channels: Mapping[str, ChannelSpec]) -> Observation | None:
        if not channels:
            return None
        unit = self.equation.state.unit
        noise = self._noise(channels)
        averages = {name for name, item in channels.items() if item.over is not None}
        if averages and averages != set(channels):
            raise CaseError(
                f"{self.where('channels')}: sensors of one role are all points (at) or all "
                f"averages (over); averages are {', '.join(sorted(averages))}."
            )
        if averages:
            return Averages(self._spans(channels), noise=noise, unit=unit)
        points, direct = {}, {}
        for name, channel in channels.items():
            points[name] = self.position(name, channel)
            if channel.quantity is not None:
                quantity = self.equation.quantities[channel.quantity]
                direct[name] = quantity.direct(self.options)
        return Points(points, direct, noise=noise, unit=unit)

    def _spans(self, channels: Mapping[str, ChannelSpec]) -> dict[str, Any]:
        found = {}
        for name, channel in channels.items():
            if channel.over is None:
                continue
            pair = self._pair(channel.over, self.equation.length_unit, f"channels.{name}.over")

            def inside(x: Any, low: float = pair[0], high: float = pair[1]) -> Any:
                return (x[0] >= low) & (x[0] <= high)

            found[name] = inside
        return found

    def position(self, name: str, channel: ChannelSpec) -> Any:
        """Return where a point sensor sits: a number, or a list of coordinates."""
        mesh, key = self.mesh, f"channels.{name}.at"
        low, high = mesh.p.min(axis=1), mesh.p.max(axis=1)
        if channel.quantity is not None:
            known = self.equation.quantities
            if channel.quantity not in known:
                where = self.where(f"channels.{name}.quantity")
                raise CaseError(
                    f"{where}: '{self.equation.name}' has no quantity '{channel.quantity}'; "
                    f"{did_you_mean(channel.quantity, known)}"
                )
            return known[channel.quantity].at(float(low[0]), float(high[0]))
        given = channel.at if isinstance(channel.at, tuple) else (channel.at,)
        unit = self.equation.length_unit
        point = [self._convert(value, unit, key) for value in given]
        if len(point) != len(low):
            raise CaseError(f"{self.where(key)}: got {len(point)} coordinates; needs {len(low)}.")
        for x, left, right in zip(point, low, high, strict=True):
            slack = 1e-9 * (right - left)
            if not left - slack <= x <= right + slack:
                raise CaseError(
                    f"{self.where(key)}: {x:g} {unit} lies outside of the mesh, which spans "
                    f"{left:g} to {right:g} {unit}; check the position and its unit."
                )
        inside = [float(np.clip(x, a, b)) for x, a, b in zip(point, low, high, strict=True)]
        return inside[0] if len(inside) == 1 else inside

    def _noise(self, channels: Mapping[str, ChannelSpec]) -> list[float] | None:
        unit = self.equation.state.unit
        levels = []
        for name, channel in channels.items():
            if channel.noise is None:
                continue
            key = f"channels.{name}.noise"
            level = self._convert(channel.noise, unit, key, difference=True)
            if not level > 0:
                raise CaseError(f"{self.where(key)}: got {channel.noise!r}; expected more than 0.")
            levels.append(level)
        if levels and len(levels) < len(channels):
            missing = next(name for name, item in channels.items() if item.noise is None)
            raise CaseError(
                f"{self.where(f'channels.{missing}.noise')} is missing: give every sensor its "
                "noise, or none and law.noise instead."
            )
        return levels or None

    # --- law ---------------------------------------------------------------------------------

    @cached_property
    def law(self) -> AnyLaw:
        """The update law."""
        spec = self.spec.law
        if isinstance(spec, GradientSpec):
            damping: Damping = ResidualDamping(1.0 if spec.c1 is None else spec.c1)
            if spec.mu is not None:
                damping = ConstantDamping(spec.mu)
            return GradientLaw(spec.gain, damping, nu=spec.nu, sigma=spec.sigma)
        time = self.equation.time_unit
        noise, memory = None, np.inf
        if spec.noise is not None:
            unit = self.equation.state.unit
            noise = self._convert(spec.noise, unit, "law.noise", difference=True)
        elif self._noise(self._roles("sensor")) is None:
            raise CaseError(
                f"{self.where('law.noise')} is missing: the sensitivity law weighs the sensors by "
                "their noise (a standard deviation); give it here or with every sensor."
            )
        if spec.memory is not None:
            memory = self._convert(spec.memory, time, "law.memory")
        drift = self._convert(spec.drift, f"1/{time}" if time else "", "law.drift")
        replay = Replay() if spec.replay is True else None
        if not isinstance(spec.replay, bool):
            replay = Replay(**spec.replay.model_dump())
        return SensitivityLaw(spec.modes, noise, drift, memory, replay)

    @property
    def expected(self) -> dict[str, tuple[Sense, Bound]]:
        """Numbers that the case expects of its run."""
        return dict(self.spec.expect)

    @property
    def notes(self) -> list[str]:
        """What is allowed and yet deserves a word."""
        found = []
        if isinstance(self.law, GradientLaw) and isinstance(self.observation, Points):
            found.append(
                "The gradient law is made for observed subdomains and averages; a few noisy point "
                "sensors mislead it. Use law.kind = 'sensitivity' for points."
            )
        nodes = self.mesh.p[0]
        for name, unknown in self.spec.unknowns.items():
            for layer, pair in (unknown.regions or {}).items():
                edges = [self._convert(v, self.equation.length_unit, name) for v in pair]
                if max(np.abs(nodes - edge).min() for edge in edges) > 1e-9 * np.ptp(nodes):
                    found.append(
                        f"Layer '{layer}' of {name} ends inside of a cell: choose mesh.cells such "
                        "that nodes fall on the edges."
                    )
        return found

    # --- data --------------------------------------------------------------------------------

    @cached_property
    def clock(self) -> Clock:
        """How times are read."""
        data, unit = self.spec.data, self.equation.time_unit
        rule = conversion(data.time_unit or unit, unit, self.where("data.time_unit"))
        second = conversion("s", unit, self.where("data.time")).factor if unit else 1.0
        return Clock(
            data.time,
            rule.factor,
            self._instant(data.start, "start"),
            self._instant(data.stop, "stop"),
            second,
        )

    def _instant(self, value: Any, key: str) -> Any:
        """Return a date as it is, a quantity in the model's unit."""
        if isinstance(value, str) and not DATE.match(value):
            return self._convert(value, self.equation.time_unit, f"data.{key}")
        return value

    @cached_property
    def data_file(self) -> Path:
        """The data file; relative names start at the case file."""
        given = self.spec.data.file
        if given is None:
            raise CaseError(
                f"{self.where('data.file')} is missing: give a file, or run with --data."
            )
        if VARIABLE in given:
            given = given.replace(VARIABLE, str(self._data_folder()))
        path = self.path.parent / Path(given).expanduser()
        if not path.is_file():
            raise CaseError(f"{self.where('data.file')}: there is no file '{path}'.")
        return path

    def _data_folder(self) -> Path:
        named = os.environ.get("LIVEPDE_DATA")
        if named:
            return Path(named).absolute()
        for base in (Path.cwd(), *self.path.absolute().parents):
            folder = base.parent / "shared" / "data"
            if folder.is_dir():
                return folder
        raise CaseError(
            f"{self.where('data.file')}: {VARIABLE} is not set; set the environment variable "
            "LIVEPDE_DATA to the folder that holds the measurements."
        )

    def read(self, source: str | Iterable[str] | None = None) -> Table | JsonLines:
        """Return the data: of the case's file, another file, or lines of JSON as they come."""
        spec = self.spec.data
        options: dict[str, Any] = {"every": spec.every, "missing": spec.missing}
        if source is not None and not isinstance(source, str):
            return JsonLines(source, self.columns, self.clock, **options)
        path = Path(source) if source is not None else self.data_file
        if path.suffix in (".jsonl", ".ndjson"):
            return read_json_lines(path, self.columns, self.clock, **options)
        return read_csv(path, self.columns, self.clock, **options)

    def prepare(self, source: str | Iterable[str] | None = None) -> Prepared:
        """Return an identifier and its stream.

        Parameters
        ----------
        source
            A file instead of the case's own, or lines of JSON.

        Raises
        ------
        DataError
            The data cannot be used; the message names file, row and column.
        """
        data = self.read(source)
        samples: Iterator[Sample] = iter(data)
        first = next(samples, None)
        if first is None:
            raise DataError(f"{self.path}: the data hold no sample between start and stop.")
        assimilate_from = self._assimilate_from(data.origin)
        stream = data if isinstance(data, Table) else chain([first], samples)
        prepared = Prepared(self, first, stream, assimilate_from, data.origin)
        _ = prepared.identifier  # raises what does not fit together
        return prepared

    @cached_property
    def scheme(self) -> Scheme:
        """The time scheme."""
        return Alexander2() if self.spec.steps.scheme == "alexander2" else ImplicitEuler()

    @cached_property
    def dt_max(self) -> float:
        """The longest time step."""
        if self.spec.steps.dt_max is None:
            return float(np.inf)
        unit, key = self.equation.time_unit, "steps.dt_max"
        dt_max = self._convert(self.spec.steps.dt_max, unit, key)
        if not dt_max > 0:
            raise CaseError(f"{self.where(key)}: got {dt_max:g} {unit}; expected more than 0.")
        return dt_max

    def _assimilate_from(self, origin: datetime | None) -> float:
        value = self._instant(self.spec.data.assimilate_from, "assimilate_from")
        if value is None:
            return -np.inf
        if isinstance(value, float | int):
            return float(value)
        key = self.where("data.assimilate_from")
        if origin is None:
            raise CaseError(f"{key}: got the date {value}; the times of the data are numbers.")
        moment = datetime.fromisoformat(value) if isinstance(value, str) else value
        if isinstance(moment, date) and not isinstance(moment, datetime):
            moment = datetime(moment.year, moment.month, moment.day)
        if moment.tzinfo is not None:
            moment = moment.astimezone(UTC).replace(tzinfo=None)
        return (moment - origin).total_seconds() * self.clock.second

    def initial(self, first: Sample) -> Any:
        """Return the initial state: a number, or the first sample interpolated."""
        if self.spec.initial != "interpolate":
            return self._convert(self.spec.initial, self.equation.state.unit, "initial")
        mesh = self.mesh
        if len(mesh.p) != 1:
            raise CaseError(
                f"{self.where('initial')}: 'interpolate' needs an interval; give a number."
            )
        ends = {"left": float(mesh.p.min()), "right": float(mesh.p.max())}
        values = dict(first.z) if isinstance(first.z, Mapping) else {}
        pairs = []
        for name, channel in self._roles("sensor", "boundary").items():
            if channel.role == "boundary" and channel.at in ends:
                pairs.append((ends[str(channel.at)], values[name]))
            elif channel.role == "sensor" and channel.over is None and channel.quantity is None:
                pairs.append((self.position(name, channel), values[name]))
        present = sorted(pair for pair in pairs if np.isfinite(pair[1]))
        if not present:
            raise CaseError(
                f"{self.where('initial')}: 'interpolate' found no sensor or boundary with a value "
                "in the first sample; start later, or give a number."
            )
        at, level = zip(*present, strict=True)
        return lambda x: np.interp(x[0], at, level)
