"""A case beside a running process: where its rows come from, what becomes of them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from livepde.cases.case import Case
from livepde.cases.data import data_file, read_data
from livepde.cases.frame import Frame
from livepde.cases.schema import BrokerSpec
from livepde.runs.journal import Journal
from livepde.runs.live import Backlog, Feed, Gathered, Paced, Retention, Samples, Sink
from livepde.streams.intake import Habit, Intake, Policy
from livepde.streams.sources import Follow, Lines, Source

if TYPE_CHECKING:
    from livepde.streams.mqtt import Broker

__all__ = ["Wiring", "policy_of", "source_text"]


class Wiring:
    """What joins a case to a process.

    Parameters
    ----------
    case
        The case.
    data
        A file instead of the case's own source; or lines of JSON as they come.
    pace
        How many times faster than they happened samples of a finished file are taken; infinity: as
        fast as it goes. None for a source that goes on.
    journal
        What an earlier part of the run has taken.

    Raises
    ------
    CaseError, DataError
        No source, one that cannot be reached, a policy that makes no sense.
    """

    def __init__(
        self,
        case: Case,
        data: str | Iterable[str] | None = None,
        *,
        pace: float = math.inf,
        journal: Journal | None = None,
    ) -> None:
        self.case = case
        self.frame = frame = case.frame
        # Before anything is connected: a case that is wrong says so at once.
        self.backlog, self.retention, self.silence = _limits(frame)
        self._policy = policy_of(frame)
        self._journal = journal
        self._origin: datetime | None = None
        self._intake: Intake | None = None
        self.feed = self._feed(data)
        if math.isfinite(pace):
            self.feed = Paced(self.feed, pace * case.clock.second)

    @property
    def origin(self) -> datetime | None:
        """The date of t = 0, if times are dates; known after the first row."""
        return self._origin if self._intake is None else self._intake.start

    def _feed(self, data: str | Iterable[str] | None) -> Feed:
        case, journal = self.case, self._journal
        last = -math.inf if journal is None else journal.last
        file = self.frame.spec.data.file if data is None else data
        reader = data is None and self.frame.reader is not None
        if reader or (isinstance(file, str) and file.endswith(".parquet")):
            table = read_data(self.frame, case.columns, case.clock, data)
            self._origin = getattr(table, "origin", None)
            return Samples(table, after=last)
        origin = None
        if journal is not None:
            origin = _seconds(journal.layout.attrs.get("origin"))
        self._intake = Intake(
            case.columns,
            case.clock,
            self._policy,
            missing=self.frame.spec.data.missing,
            origin=origin,
            last=last,
        )
        position = "" if journal is None else journal.position
        return Gathered(self._source(data, position), self._intake)

    def _source(self, data: str | Iterable[str] | None, position: str) -> Source:
        frame, spec = self.frame, self.frame.spec.data
        if data is not None and not isinstance(data, str):
            return Lines(data)
        if data is None and spec.mqtt is not None:
            from livepde.streams.mqtt import MqttSource

            topics = {**dict.fromkeys(spec.mqtt.rows), **spec.mqtt.columns}
            return MqttSource(_broker(frame, spec.mqtt, "data.mqtt"), topics, spec.time)
        if data is None and spec.opcua is not None:
            from livepde.streams.opcua import OpcuaSource

            return OpcuaSource(
                spec.opcua.url,
                spec.opcua.columns,
                spec.time,
                interval=frame.positive(spec.opcua.interval, "s", "data.opcua.interval"),
                username=spec.opcua.username,
                password=_password(frame, spec.opcua.password_env, "data.opcua"),
            )
        path = Path(data) if data is not None else data_file(frame)
        follow = spec.follow and data is None
        return Follow(path, separator=spec.separator, follow=follow, position=position)

    def publishers(self) -> list[Sink]:
        """Return the sinks that the case names."""
        spec = self.frame.spec.output.mqtt
        if spec is None:
            return []
        from livepde.streams.mqtt import MqttSink

        return [MqttSink(_broker(self.frame, spec, "output.mqtt"), spec.topic)]


def source_text(frame: Frame) -> str:
    """Return in words where the rows of a case come from."""
    spec = frame.spec.data
    if spec.mqtt is not None:
        topics = ", ".join([*spec.mqtt.rows, *spec.mqtt.columns])
        return f"{topics} of the broker at {spec.mqtt.host}:{spec.mqtt.port}"
    if spec.opcua is not None:
        return f"{len(spec.opcua.columns)} nodes of {spec.opcua.url}"
    return str(spec.file or spec.reader)


def _broker(frame: Frame, spec: BrokerSpec, key: str) -> Broker:
    from livepde.streams.mqtt import Broker

    return Broker(
        host=spec.host,
        port=spec.port,
        client_id=spec.client_id or f"livepde-{frame.path.stem}",
        username=spec.username,
        password=_password(frame, spec.password_env, key),
        tls=spec.tls,
        ca_file=spec.ca_file,
        session=round(frame.positive(spec.session, "s", f"{key}.session")),
    )


def _password(frame: Frame, variable: str | None, key: str) -> str | None:
    if variable is None:
        return None
    if variable not in os.environ:
        raise frame.error(
            f"{key}.password_env", f"the environment variable {variable} is not set; set it."
        )
    return os.environ[variable]


def _limits(frame: Frame) -> tuple[Backlog, Retention, float]:
    spec = frame.spec
    span = math.inf
    if spec.output.retain is not None:
        span = frame.positive(spec.output.retain, frame.equation.time_unit, "output.retain")
    silence = math.inf
    if spec.intake.silence is not None:
        silence = frame.positive(spec.intake.silence, "s", "intake.silence")
    backlog = Backlog(spec.intake.overflow, spec.intake.queue)
    return backlog, Retention(span, spec.output.thin), silence


def policy_of(frame: Frame) -> Policy:
    """Return what becomes of rows that do not come one by one, in order and complete."""
    spec, unit = frame.spec.intake, frame.equation.time_unit

    def duration(value: float | str, key: str) -> float:
        return frame.convert(value, unit, key, difference=True)

    habits = {}
    for name, channel in frame.spec.channels.items():
        wait = 0.0
        if channel.wait is not None:
            wait = duration(channel.wait, f"channels.{name}.wait")
        habits[name] = Habit(wait, channel.repeated)
    leap = math.inf
    if spec.leap is not None:
        leap = frame.positive(spec.leap, unit, "intake.leap")
    return Policy(
        wait=duration(spec.wait, "intake.wait"),
        tolerance=duration(spec.tolerance, "intake.tolerance"),
        leap=leap,
        repeated=spec.repeated,
        channels=habits,
    )


def _seconds(origin: str | None) -> float:
    """Return the seconds since 1970 of an origin as a layout has it; 0 if times are numbers."""
    if origin is None:
        return 0.0
    return datetime.fromisoformat(origin).replace(tzinfo=UTC).timestamp()
