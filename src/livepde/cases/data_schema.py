"""Schema of the tables of a case file that describe sources of rows, as pydantic models."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, StrictBool, model_validator

from livepde.cases.values import (
    TEXT,
    Also,
    Encoding,
    Identifier,
    Instant,
    MissingValue,
    Name,
    NonNegativeInt,
    PositiveInt,
    Quantity,
    Spec,
    TimeFormat,
    short,
)
from livepde.runs.backlog import Backlog
from livepde.streams.csvfile import UTF_8
from livepde.streams.intake import Policy
from livepde.streams.mqtt import Broker


class BrokerSpec(Spec):
    """How to reach a message broker (MQTT)."""

    host: Name = Broker.host
    port: Annotated[int, Field(gt=0, lt=65536)] = Broker.port
    client_id: Name | None = None
    username: Name | None = None
    password_env: Name | None = None
    tls: StrictBool = Broker.tls
    ca_file: Name | None = None
    session: Quantity = "7 d"


class MqttSpec(BrokerSpec):
    """Topics whose messages are rows, and topics whose messages are numbers of one column."""

    rows: tuple[Name, ...] = ()
    columns: dict[Name, Name] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _some_topic(self) -> MqttSpec:
        if not self.rows and not self.columns:
            raise ValueError("expected rows = [topics], or columns = { topic = column }")
        return self


# Policy, mode, certificate and key, and optionally the certificate of the server.
SECURITY = (
    "^(Basic256Sha256|Aes128Sha256RsaOaep|Aes256Sha256RsaPss),(Sign|SignAndEncrypt)(,[^,:]+){2,3}$"
)


class NodesSpec(Spec):
    """Nodes of an OPC UA server, and how to reach it."""

    url: Name
    columns: dict[Name, Name] = Field(min_length=1)
    username: Name | None = None
    password_env: Name | None = None
    security: Annotated[str, Field(pattern=SECURITY)] | None = None


class OpcuaSpec(NodesSpec):
    """Nodes of an OPC UA server."""

    interval: Quantity = "1 s"


class FileSpec(Spec):
    """One of several files, with keys that override those of `[data]`."""

    file: Name
    separator: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] | None = None
    encoding: Encoding | None = None
    skip: NonNegativeInt | None = None
    time: Name | tuple[Name, Name] | None = None
    time_unit: str | None = None
    time_format: TimeFormat | None = None


File: TypeAlias = Annotated[FileSpec, short("file"), Also(TEXT)]


class DataSpec(Spec):
    """Where rows come from, and how their times are read."""

    file: Name | Annotated[tuple[File, ...], Field(min_length=2)] | None = None
    follow: StrictBool = False
    mqtt: MqttSpec | None = None
    opcua: OpcuaSpec | None = None
    separator: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    encoding: Encoding = UTF_8
    reader: Name | None = None
    options: dict[Identifier, Any] = Field(default_factory=dict)
    skip: NonNegativeInt = 0
    time: Name | tuple[Name, Name] = "time"
    time_unit: str | None = None
    time_format: TimeFormat = ""
    sensor: Name | None = None
    value: Name | None = None
    zone: Name = "UTC"
    start: Instant | None = None
    stop: Instant | None = None
    t0: Instant | None = None
    assimilate_from: Instant | None = None
    every: PositiveInt = 1
    missing: tuple[MissingValue, ...] = ()

    @model_validator(mode="after")
    def _one_source(self) -> DataSpec:
        if self.reader is None and self.options:
            raise ValueError("options require a reader")
        sources = [n for n in ("file", "reader", "mqtt", "opcua") if getattr(self, n) is not None]
        if len(sources) > 1:
            raise ValueError(f"{sources[0]} and {sources[1]} are two sources: keep one")
        if self.follow and not isinstance(self.file, str):
            raise ValueError("follow requires a single file that grows")
        return self

    @model_validator(mode="after")
    def _live_source(self) -> DataSpec:
        if self.live and self.is_of_file:
            raise ValueError("skip, sensor and a time in two columns are only valid with a file")
        if self.live and self.every > 1:
            raise ValueError("every requires complete data, not a live source")
        return self

    @model_validator(mode="after")
    def _long_table(self) -> DataSpec:
        if (self.sensor is None) != (self.value is None):
            raise ValueError("sensor and value are two columns of one table: name both")
        if self.long and (isinstance(self.file, tuple) or self.reader is not None):
            raise ValueError("sensor and value require a single file")
        return self

    @property
    def long(self) -> tuple[str, str] | None:
        """The columns of sensors and values, if the table has a row for each reading."""
        return None if self.sensor is None or self.value is None else (self.sensor, self.value)

    def of(self, file: FileSpec) -> DataSpec:
        """Return `[data]` with the overrides of one of several files."""
        own = {key: getattr(file, key) for key in file.model_fields_set}
        return self.model_copy(update=own)

    @property
    def times(self) -> tuple[str, ...]:
        """The time column, or the columns of days and times of day."""
        return (self.time,) if isinstance(self.time, str) else self.time

    @property
    def is_of_file(self) -> bool:
        """Whether a key requires a complete file: skipped lines, two time columns, long table."""
        return bool(self.long) or (not self.follow and (self.skip > 0 or len(self.times) > 1))

    @property
    def live(self) -> bool:
        """Whether the source is live."""
        return self.follow or self.mqtt is not None or self.opcua is not None


class IntakeSpec(Spec):
    """Policy for rows that are late, repeated, malformed or too fast."""

    wait: Quantity = Policy.wait
    tolerance: Quantity = Policy.tolerance
    leap: Quantity | None = None
    repeated: Literal["first", "last"] = Policy.repeated
    shift: Quantity = Policy.shift
    overflow: Literal["queue", "merge", "drop"] = Backlog.overflow
    queue: PositiveInt = Backlog.length
    silence: Quantity | None = None
