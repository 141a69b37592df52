"""Schema of case files, as pydantic models: a class for each table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    StrictBool,
    Tag,
    WithJsonSchema,
    model_validator,
)

from livepde.cases.data_schema import BrokerSpec, DataSpec, IntakeSpec, NodesSpec
from livepde.cases.values import (
    LIST,
    NUMBER,
    TEXT,
    Also,
    Box,
    Expected,
    Identifier,
    Name,
    NonNegativeInt,
    NonzeroFloat,
    Number,
    Pair,
    Point,
    PositiveFloat,
    PositiveInt,
    Quantity,
    Spec,
    options_of,
    short,
)
from livepde.fem import Scalar
from livepde.laws import GradientLaw, Guards, Jumps, Refit, SensitivityLaw, Shadows
from livepde.observation import Discrepancy
from livepde.runs.backlog import Retention
from livepde.stepping import Between

SENSORS = ("sensor", "validation", "ignored")  # roles of channels that are sensors


Spacing = Literal["uniform", "geometric"]


class MeshSpec(Spec):
    """An interval (from, to, cells; or nodes), a rectangle (x, y, cells; or nodes), or a file."""

    start: Quantity | None = Field(None, alias="from")
    stop: Quantity | None = Field(None, alias="to")
    nodes: tuple[Quantity, ...] | None = Field(None, min_length=2)
    x: tuple[Quantity, ...] | None = Field(None, min_length=2)
    y: tuple[Quantity, ...] | None = Field(None, min_length=2)
    file: Name | None = None
    unit: str | None = None
    cells: PositiveInt | tuple[PositiveInt, PositiveInt] | None = None
    spacing: Spacing | tuple[Spacing, Spacing] = "uniform"

    @model_validator(mode="after")
    def _one_kind(self) -> MeshSpec:
        # Keys in the file, without defaults.
        given = self.model_fields_set - {"spacing", "unit"}
        if given in ({"nodes"}, {"file"}, {"x", "y"}):
            if "spacing" in self.model_fields_set:
                raise ValueError("spacing requires an interval with cells")
        elif given == {"start", "stop", "cells"}:
            if not isinstance(self.cells, int):
                raise ValueError("cells: expected one number for an interval")
            if isinstance(self.spacing, tuple):
                raise ValueError("spacing: expected one word for an interval")
        elif given == {"x", "y", "cells"}:
            self._check_rectangle()
        else:
            raise ValueError(
                "expected from and to (an interval) or x and y (a rectangle), with cells; or nodes "
                "(an interval); or file"
            )
        if self.unit is not None and self.file is None:
            raise ValueError("unit requires file")
        return self

    def _check_rectangle(self) -> None:
        pair = isinstance(self.spacing, tuple)
        if isinstance(self.cells, int) or (self.spacing != "uniform" and not pair):
            raise ValueError("expected cells = [nx, ny], spacing = [of x, of y] of a rectangle")
        if any(side is None or len(side) != 2 for side in (self.x, self.y)):
            raise ValueError("x and y: expected [from, to] each; or nodes, and no cells")


class EvolutionSpec(Spec):
    """How an unknown changes over time."""

    kind: Literal["random-walk", "mean-reverting", "periodic"]
    rate: Quantity | None = None
    time: Quantity | None = None
    period: Quantity | None = None
    harmonics: PositiveInt = 1

    @model_validator(mode="after")
    def _one_kind(self) -> EvolutionSpec:
        needed = {"random-walk": "rate", "mean-reverting": "time", "periodic": "period"}[self.kind]
        known = {"kind", needed, *(["harmonics"] if self.kind == "periodic" else [])}
        if getattr(self, needed) is None or self.model_fields_set - known:
            raise ValueError(f"'{self.kind}' takes {' and '.join(sorted(known - {'kind'}))}")
        return self


class PriorSpec(Spec):
    """Keys of the prior of an unknown, or of a region with its own prior."""

    prior: Quantity | None = None
    std: Quantity | None = None
    bounds: Pair | None = None
    transform: Literal["log", "logit"] | None = None
    evolution: EvolutionSpec | None = None
    within: PositiveFloat | None = None


class RegionSpec(PriorSpec):
    """A region, with values of the unknown that hold there instead of everywhere."""

    over: Pair | Box | Name


Region: TypeAlias = Annotated[RegionSpec, short("over"), Also(LIST, TEXT)]


class UnknownSpec(PriorSpec):
    """One unknown: a number, one number for each layer, or a field."""

    prior: Quantity
    std: Quantity
    within: PositiveFloat = Scalar.within
    unit: str | None = None
    regions: dict[Name, Region] | None = None
    field: bool = False
    length: Quantity | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> UnknownSpec:
        if self.field and (self.regions or (self.bounds and not self.transform)):
            raise ValueError("a field has no regions, and bounds only with a transform")
        if self.length is not None and not self.field:
            raise ValueError("length requires field = true")
        return self

    def at(self, region: RegionSpec) -> UnknownSpec | None:
        """Return the unknown with the prior keys of a region; None if it overrides no key."""
        own = {key: getattr(region, key) for key in region.model_fields_set - {"over"}}
        return self.model_copy(update=own) if own else None


class CorrelatedSpec(Spec):
    """Error of a sensor with correlation time `time` and standard deviation `std`."""

    time: Quantity
    std: Quantity


class TimeConstantSpec(Spec):
    """An unknown time constant of a sensor: its median and standard deviation."""

    value: Quantity
    std: Quantity


FLUX = "flux"  # value of `quantity` for a sensor that measures a flux


class ChannelSpec(Spec):
    """One channel of the stream and its role."""

    role: Literal["boundary", "sensor", "validation", "ignored", "input", "position"]
    column: Name | None = None
    columns: tuple[Name, ...] | None = None
    at: Quantity | tuple[Quantity, ...] | None = None
    at_std: Quantity | None = None
    over: Pair | Box | Name | None = None
    along: tuple[Point, Point] | None = None
    follows: Name | tuple[Name, ...] | None = None
    each: tuple[Quantity, Quantity, PositiveInt] | None = None
    positions: Name | None = None
    quantity: str | None = None
    of: Name | None = None
    component: NonNegativeInt | None = None
    noise: Quantity | None = None
    noise_column: Name | None = None
    unit: str | None = None
    factor: NonzeroFloat | None = None
    late: Quantity | None = None
    offset: Quantity | None = None
    gain: PositiveFloat | None = None
    correlated: CorrelatedSpec | None = None
    time_constant: TimeConstantSpec | Quantity | None = None
    wait: Quantity | None = None
    repeated: Literal["first", "last"] | None = None
    valid: Pair | None = None
    missing: Literal["interpolate", "hold", "skip"] | None = None
    spikes: Literal["refuse", "keep"] | None = None
    between: Between = "line"

    @property
    def is_point(self) -> bool:
        """Whether the channel has a position, or is a family of channels with positions."""
        return (self.at, self.each, self.positions) != (None, None, None)

    @property
    def is_fixed(self) -> bool:
        """Whether the channel measures a scalar state at an exactly known position."""
        own = (self.at_std, self.component, self.quantity)
        return self.at is not None and own == (None, None, None)

    @property
    def is_flux(self) -> bool:
        """Whether the channel measures a flux instead of the state."""
        return self.quantity == FLUX

    @property
    def is_calibrated(self) -> bool:
        """Whether an offset, gain or correlated error of the channel is an unknown."""
        return (self.offset, self.gain, self.correlated) != (None, None, None)

    @property
    def drives(self) -> bool:
        """Whether the channel drives the model: a boundary value or another input."""
        return self.role in ("boundary", "input")

    @property
    def gaps(self) -> Literal["interpolate", "hold", "skip"]:
        """Treatment of missing values: `missing`, or its default."""
        bridged = self.drives and self.between != "hold"
        return self.missing or ("interpolate" if bridged else "hold")

    @property
    def screened(self) -> bool:
        """Whether spikes are removed."""
        return self.drives and self.between == "line" and self.spikes != "keep"

    @model_validator(mode="after")
    def _one_column(self) -> ChannelSpec:
        if self.positions is None and (self.column is None) == (not self.columns):
            raise ValueError("expected column = name, or columns = [names] that are averaged")
        return self

    @property
    def _placed(self) -> int:
        """Number of keys that state where the channel measures."""
        fixed = (self.at, self.over, self.along, self.each, self.positions)
        quantity = None if self.is_flux else self.quantity
        return sum(place is not None for place in (*fixed, self.follows, quantity))

    @model_validator(mode="after")
    def _place_of_flux(self) -> ChannelSpec:
        if not self.is_flux:
            return self
        if self.role not in SENSORS:
            raise ValueError(
                'quantity = "flux" requires a sensor; a flux that drives the model is an input '
                "that boundary.NAME.flux names"
            )
        if self.at is None or self._placed != 1:
            raise ValueError(
                'quantity = "flux" needs at = the name of an end, as "left", or a position'
            )
        keys = {"correlated", "at_std", "of", "component", "time_constant"}
        if own := keys & self.model_fields_set:
            raise ValueError(f'{own.pop()} is not possible with quantity = "flux": leave it out')
        return self

    @model_validator(mode="after")
    def _one_place(self) -> ChannelSpec:
        if self.role in ("input", "position") and self._placed:
            raise ValueError(f"a channel of role {self.role} has no place: leave it out")
        if self.role == "boundary" and not isinstance(self.at, str):
            raise ValueError('a boundary channel needs at = the name of a boundary, as "left"')
        if self.role in SENSORS and self._placed != 1:
            raise ValueError(
                "expected one of: at = position, over = [from, to], along = [start, end], "
                "follows = channel, each = [from, to, count], positions = file, quantity = name"
            )
        return self

    @model_validator(mode="after")
    def _families(self) -> ChannelSpec:
        if self.each is not None and "{}" not in (self.column or ""):
            raise ValueError('each needs column = a name with {} for the number, as "u_{}"')
        if self.positions is not None and (self.columns or "{}" not in (self.column or "{}")):
            raise ValueError('positions takes column = a name with {} for that of a row, as "T_{}"')
        if self.at_std is not None and not self.is_point:
            raise ValueError("at_std requires at = position")
        return self

    @model_validator(mode="after")
    def _options_of_sensors(self) -> ChannelSpec:
        own = {"offset", "gain", "correlated", "at_std"} & self.model_fields_set
        # A sensor that is temporarily ignored keeps its keys.
        if self.role == "boundary":
            own -= {"offset"}
        if own and self.role not in ("sensor", "ignored"):
            raise ValueError(f"{own.pop()} requires role = 'sensor'")
        return self

    @model_validator(mode="after")
    def _options_of_all_sensors(self) -> ChannelSpec:
        sensor = self.role in SENSORS
        placed = (self.follows, self.quantity, self.at_std) == (None, None, None)
        if self.time_constant is not None and not (sensor and placed):
            raise ValueError("time_constant requires a sensor at a fixed place, without at_std")
        if self.of is not None and not sensor:
            raise ValueError(f"of requires a sensor, but the role is {self.role}")
        if self.component is not None and not (sensor and self.is_point):
            raise ValueError("component requires a sensor at a position")
        return self

    @model_validator(mode="after")
    def _options_of_inputs(self) -> ChannelSpec:
        if not self.drives and (self.missing == "interpolate" or self.spikes is not None):
            raise ValueError(
                'missing = "interpolate" and spikes require a boundary or input channel; '
                "outliers of sensors are rejected by law.gate"
            )
        if not self.drives and "between" in self.model_fields_set:
            raise ValueError("between requires a boundary or input channel: leave it out")
        if self.between != "line" and self.spikes == "refuse":
            raise ValueError('spikes = "refuse" requires between = "line": leave it out')
        if self.between == "hold" and self.missing is not None:
            raise ValueError(
                'a value with between = "hold" is never missing: leave out the key missing'
            )
        return self

    @model_validator(mode="after")
    def _options_of_noise(self) -> ChannelSpec:
        if self.noise_column is not None and self.role not in SENSORS:
            raise ValueError("noise_column requires a sensor: leave it out")
        if self.role == "position" and self.noise is not None:
            raise ValueError("noise of a channel of role position is not possible: leave it out")
        return self

    @property
    def sources(self) -> tuple[str, ...]:
        """Columns of the data file that are averaged; usually one."""
        return self.columns or (str(self.column),)


class SensitivitySpec(Spec):
    """The law for sparse, noisy sensors."""

    kind: Literal["sensitivity"] = "sensitivity"
    noise: Quantity | None = None
    modes: PositiveInt | Literal["auto"] = "auto"
    rank: PositiveInt | None = SensitivityLaw.rank
    gate: PositiveFloat = SensitivityLaw.gate
    gate_patience: PositiveInt = SensitivityLaw.gate_patience
    shadows: StrictBool | Annotated[Shadows, options_of(Shadows)] = True
    drift: Quantity = SensitivityLaw.drift
    memory: Quantity | None = None
    refit: StrictBool | Annotated[Refit, options_of(Refit)] = True
    jumps: (
        StrictBool
        | Annotated[tuple[Name, ...], Field(min_length=1)]
        | Annotated[Jumps, options_of(Jumps)]
    ) = False
    guards: StrictBool | Annotated[Guards, options_of(Guards)] = True
    verdict: StrictBool | Literal["cheap"] = True


class TikhonovSpec(Spec):
    """Regularised reconstruction of the observed part from noisy samples."""

    norm: Literal["X", "V"] = "V"
    alpha: PositiveFloat | Literal["discrepancy"] = "discrepancy"
    tau: PositiveFloat = Discrepancy.tau


class GradientSpec(Spec):
    """The paper's law, for observed subdomains and averages."""

    kind: Literal["gradient"]
    gain: Number | Literal["auto"] = GradientLaw.gain
    c1: Number | None = None
    mu: Number | None = None
    nu: Number = GradientLaw.nu
    sigma: Number = GradientLaw.sigma
    tikhonov: bool | TikhonovSpec = False

    @model_validator(mode="after")
    def _one_damping(self) -> GradientSpec:
        if self.c1 is not None and self.mu is not None:
            raise ValueError("c1 and mu are two damping rules: keep one")
        if self.gain == "auto" and not (self.c1 is None and self.mu is None and self.sigma == 0.0):
            raise ValueError("gain = 'auto' chooses c1, mu and sigma itself: leave them out")
        return self


class StepsSpec(Spec):
    """Time steps between samples; the default scheme is that of the law."""

    dt_max: Quantity | None = None
    scheme: Literal["implicit-euler", "alexander2"] | None = None


class PublishSpec(BrokerSpec):
    """Where estimates are published."""

    topic: Name
    discovery: Literal["homeassistant"] | None = None


class OutputSpec(Spec):
    """Stored output of a run, and further destinations of its estimates."""

    fields_every: PositiveInt = 24
    retain: Quantity | None = None
    thin: PositiveInt = Retention.every
    smoothed: StrictBool = False
    surface_resistances: tuple[Quantity, Quantity] | None = None
    mqtt: PublishSpec | None = None
    opcua: NodesSpec | None = None

    @model_validator(mode="after")
    def _thins_the_past(self) -> OutputSpec:
        if self.thin > 1 and self.retain is None:
            raise ValueError("thin requires retain, the time for which all estimates are kept")
        if self.smoothed and self.retain is not None:
            raise ValueError("smoothed requires all samples, which retain does not keep")
        return self


class VariantSpec(Spec):
    """A variant of the case with other values, run by 'python -m benchmarks cases'."""

    name: Name
    set: dict[str, Any] = Field(default_factory=dict)
    seeds: PositiveInt = 1
    reference: dict[Name, Quantity] = Field(default_factory=dict)
    expect: Expected = Field(default_factory=dict)


def _kind(value: Any) -> Any:
    """Set `kind` to the sensitivity law if the table does not specify it."""
    return {"kind": "sensitivity", **value} if isinstance(value, Mapping) else value


Law: TypeAlias = Annotated[
    Annotated[SensitivitySpec | GradientSpec, Field(discriminator="kind")], BeforeValidator(_kind)
]


class BoundarySpec(Spec):
    """A boundary: its value, or the flux through it; each a number, a channel or an unknown."""

    value: Quantity | None = None
    flux: Quantity | None = None
    transfer: Quantity | None = None
    ambient: Quantity | None = None

    @property
    def passes(self) -> bool:
        """Whether the boundary has a flux or an exchange instead of a value."""
        return self.flux is not None or self.transfer is not None

    @model_validator(mode="after")
    def _consistent(self) -> BoundarySpec:
        if (self.transfer is None) != (self.ambient is None):
            raise ValueError("transfer and ambient require each other: give both")
        if (self.value is None) != self.passes:
            raise ValueError("expected a value, or flux, or transfer with ambient")
        return self


Boundary: TypeAlias = Annotated[BoundarySpec, short("value"), Also(NUMBER, TEXT)]


class SourceSpec(Spec):
    """A source term in a region, or everywhere: a number, a channel or an unknown."""

    value: Quantity
    over: Pair | Box | Name | None = None


class InitialSpec(Spec):
    """Initial state: its source, and its standard deviation."""

    start: Quantity = Field(alias="from")
    std: Quantity | None = None
    length: Quantity | None = None


def _has_from(value: Any) -> str:
    """Return the tag of an initial state: a table without `from` lists components."""
    whole = not isinstance(value, Mapping) or "from" in value
    return "whole" if whole else "components"


Components: TypeAlias = Annotated[
    dict[Name, Quantity],
    WithJsonSchema(
        {
            "type": "object",
            "additionalProperties": {"anyOf": [NUMBER, TEXT]},
            "not": {"required": ["from"]},
        }
    ),
]
Initial: TypeAlias = Annotated[
    Annotated[InitialSpec, Tag("whole")] | Annotated[Components, Tag("components")],
    Discriminator(_has_from),
    short("from"),
    Also(NUMBER, TEXT),
]


class CaseSpec(Spec):
    """A whole case file."""

    title: str = ""
    equation: Name
    initial: Initial | None = None
    mesh: MeshSpec
    options: dict[Identifier, StrictBool | Quantity] = Field(default_factory=dict)
    boundary: dict[Name, Boundary] = Field(default_factory=dict)
    sources: dict[Name, SourceSpec] = Field(default_factory=dict)
    inputs: dict[Name, Quantity] = Field(default_factory=dict)
    data: DataSpec
    intake: IntakeSpec = Field(default_factory=IntakeSpec)
    unknowns: dict[Identifier, UnknownSpec] = Field(min_length=1)
    channels: dict[Name, ChannelSpec] = Field(min_length=1)
    law: Law = SensitivitySpec()
    steps: StepsSpec = Field(default_factory=StepsSpec)
    output: OutputSpec = Field(default_factory=OutputSpec)
    reference: dict[Name, Quantity] = Field(default_factory=dict)
    expect: Expected = Field(default_factory=dict)
    variants: tuple[VariantSpec, ...] = ()

    @model_validator(mode="after")
    def _names_once(self) -> CaseSpec:
        names = [variant.name for variant in self.variants]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"variants: two have the name '{name}'")
        return self
