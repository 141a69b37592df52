"""Data sources of a case, and destinations of its estimates."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from livepde.cases.case_frame import Frame
from livepde.cases.data import data_file
from livepde.cases.schema import BrokerSpec
from livepde.runs.live_loop import Backlog, Retention, Sink
from livepde.streams.intake import Habit, Policy
from livepde.streams.sources import Follow, Lines, RowSource

if TYPE_CHECKING:
    from livepde.streams.mqtt import Broker

__all__ = ["Data", "limits_of", "policy_of", "publishers_of", "source_of", "source_text"]

LOG = logging.getLogger("livepde.run")
LEAP = "30 d"  # after a longer pause a second row has to confirm the time

Data: TypeAlias = str | Iterable[str] | RowSource | None  # a file, lines of JSON, or the case's own


def source_of(frame: Frame, data: Data, position: str) -> RowSource:
    """Return the source of the rows of a case, from a position on."""
    match data:
        case None:
            return _own_source(frame, position)
        case str():
            return _file_source(frame, Path(data), position)
        case Iterable():
            return Lines(data)
    return data


def _own_source(frame: Frame, position: str) -> RowSource:
    """Return the source that the case names: a broker, a server or a file."""
    spec = frame.spec.data
    if spec.mqtt is not None:
        from livepde.streams.mqtt import MqttSource

        topics = {**dict.fromkeys(spec.mqtt.rows), **spec.mqtt.columns}
        return MqttSource(_broker(frame, spec.mqtt, "data.mqtt"), topics, spec.times[0])
    if spec.opcua is not None:
        from livepde.streams.opcua import OpcuaSource

        return OpcuaSource(
            spec.opcua.url,
            spec.opcua.columns,
            spec.times[0],
            interval=frame.positive(spec.opcua.interval, "s", "data.opcua.interval"),
            username=spec.opcua.username,
            password=_password(frame, spec.opcua.password_env, "data.opcua"),
        )
    return _file_source(frame, data_file(frame), position)


def _file_source(frame: Frame, path: Path, position: str) -> Follow:
    spec = frame.spec.data
    if spec.follow and not path.exists():
        LOG.warning("there is no file '%s' yet: waits for it", path)
    return Follow(
        path,
        separator=spec.separator,
        encoding=spec.encoding,
        follow=spec.follow,
        position=position,
    )


def publishers_of(frame: Frame) -> list[Sink]:
    """Return the sinks that a case names."""
    spec = frame.spec.output.mqtt
    if spec is None:
        return []
    from livepde.streams.mqtt import MqttSink

    return [MqttSink(_broker(frame, spec, "output.mqtt"), spec.topic)]


def source_text(frame: Frame) -> str:
    """Return a description of the source of the rows of a case."""
    spec = frame.spec.data
    if spec.mqtt is not None:
        topics = ", ".join([*spec.mqtt.rows, *spec.mqtt.columns])
        return f"{topics} of the broker at {spec.mqtt.host}:{spec.mqtt.port}"
    if spec.opcua is not None:
        return f"{len(spec.opcua.columns)} nodes of {spec.opcua.url}"
    if isinstance(spec.file, tuple):
        return ", ".join(file.file for file in spec.file)
    return str(spec.file or spec.reader)


def _broker(frame: Frame, spec: BrokerSpec, key: str) -> Broker:
    from livepde.streams.mqtt import Broker

    return Broker(
        host=spec.host,
        port=spec.port,
        client_id=spec.client_id or f"livepde-{frame.name}",
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


def limits_of(frame: Frame) -> tuple[Backlog, Retention, float]:
    """Return limits of backlog and retention, and the seconds until a source is silent."""
    spec = frame.spec
    # Without these keys all estimates are kept, and no source counts as silent.
    span = math.inf
    if spec.output.retain is not None:
        span = frame.positive(spec.output.retain, frame.equation.time_unit, "output.retain")
    silence = math.inf
    if spec.intake.silence is not None:
        silence = frame.positive(spec.intake.silence, "s", "intake.silence")
    backlog = Backlog(spec.intake.overflow, spec.intake.queue)
    return backlog, Retention(span, spec.output.thin), silence


def policy_of(frame: Frame) -> Policy:
    """Return the policy for rows that are late, repeated or incomplete."""
    spec, unit = frame.spec.intake, frame.equation.time_unit

    def duration(value: float | str, key: str) -> float:
        return frame.convert(value, unit, key, difference=True)

    habits = {}
    for name, channel in frame.spec.channels.items():
        wait = 0.0
        if channel.wait is not None:
            wait = duration(channel.wait, f"channels.{name}.wait")
        interpolated = channel.gaps == "interpolate"
        habits[name] = Habit(wait, channel.repeated, interpolated, channel.screened)
    # Without a unit of time 30 days cannot be converted: then any pause is accepted.
    leap = frame.convert(LEAP, unit, "intake.leap") if unit else math.inf
    if spec.leap is not None:
        leap = frame.positive(spec.leap, unit, "intake.leap")
    return Policy(
        wait=duration(spec.wait, "intake.wait"),
        tolerance=duration(spec.tolerance, "intake.tolerance"),
        leap=leap,
        repeated=spec.repeated,
        channels=habits,
    )
