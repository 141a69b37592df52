"""Rows from a message broker, and estimates back to it (MQTT 5, by paho-mqtt)."""

from __future__ import annotations

import json
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from livepde.errors import DataError
from livepde.result import Estimate
from livepde.streams.sources import BATCH, LONGEST, Row, json_row

if TYPE_CHECKING:
    from paho.mqtt.client import Client

__all__ = ["Broker", "MqttSink", "MqttSource"]

INFLIGHT = 65535  # messages that may wait to be acknowledged
PATIENCE = 10.0  # seconds for the first connection


@dataclass(frozen=True)
class Broker:
    """How to reach a broker.

    Parameters
    ----------
    host, port
        Where it listens.
    client_id
        Name of the session: the broker keeps what comes while nobody listens under this name.
    username, password
        If it asks for them; the password is never written anywhere.
    tls
        Encrypt, with the certificates that the system trusts.
    session
        Seconds for which the broker keeps the session of a client that is away.
    """

    host: str = "localhost"
    port: int = 1883
    client_id: str = "livepde"
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: bool = False
    session: int = 7 * 86400

    def client(self, suffix: str = "") -> Client:
        """Return a client that is not connected yet."""
        try:
            from paho.mqtt.client import Client, MQTTv5
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError:
            raise DataError("MQTT needs paho-mqtt: pip install 'livepde[mqtt]'.") from None
        client = Client(
            CallbackAPIVersion.VERSION2,
            client_id=self.client_id + suffix,
            protocol=MQTTv5,
            manual_ack=True,
        )
        if self.username is not None:
            client.username_pw_set(self.username, self.password)
        if self.tls:
            client.tls_set()
        client.reconnect_delay_set(1, 30)
        return client

    def connect(self, client: Client) -> None:
        """Connect, and go on reconnecting in a thread of its own when the broker goes away."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = self.session
        properties.ReceiveMaximum = INFLIGHT
        try:
            client.connect(self.host, self.port, clean_start=False, properties=properties)
        except (OSError, ValueError) as error:
            raise DataError(f"MQTT: no broker at {self.host}:{self.port} ({error}).") from error
        client.loop_start()


class MqttSource:
    """Rows from topics; what was not taken for good is brought again, also after a restart.

    A message is a row (a JSON object, column -> value), or for a topic with a column of its own a
    number, alone or as {"value": 1.5, TIME: ...}; a number without a time has that of its arrival,
    in seconds since 1970.

    Parameters
    ----------
    broker
        How to reach it.
    topics
        Topic -> column of its numbers; None: its messages are rows. "+" and "#" as usual.
    time
        Name of the time column.
    """

    def __init__(self, broker: Broker, topics: Mapping[str, str | None], time: str) -> None:
        self._topics = dict(topics)
        self._time = time
        self._rows: queue.Queue[Row] = queue.Queue()
        self._refused: list[str] = []
        self._ready = threading.Event()
        self._client = broker.client()
        self._client.on_connect = self._connected
        self._client.on_subscribe = self._subscribed
        self._client.on_message = self._message
        broker.connect(self._client)
        if not self._ready.wait(PATIENCE) or self._refused:
            self.close()
            reason = self._refused[0] if self._refused else "it does not answer"
            raise DataError(f"MQTT: the broker at {broker.host}:{broker.port}: {reason}.")

    def _connected(
        self, client: Client, userdata: Any, flags: Any, reason: Any, properties: Any
    ) -> None:
        if reason.is_failure:
            self._refused.append(str(reason))
            self._ready.set()
        else:
            client.subscribe([(topic, 1) for topic in self._topics])

    def _subscribed(
        self, client: Client, userdata: Any, mid: int, reasons: Any, properties: Any
    ) -> None:
        self._refused += [str(reason) for reason in reasons if reason.is_failure]
        self._ready.set()

    def _message(self, client: Client, userdata: Any, message: Any) -> None:
        token = (message.mid, message.qos)
        column = self._column(message.topic)
        if column is None:
            self._rows.put(json_row(message.payload, token))
        else:
            self._rows.put(self._number(column, message.payload, token))

    def _column(self, topic: str) -> str | None:
        from paho.mqtt.client import topic_matches_sub

        if topic in self._topics:
            return self._topics[topic]
        found = (c for t, c in self._topics.items() if topic_matches_sub(t, topic))
        return next(found, None)

    def _number(self, column: str, payload: bytes, token: Any) -> Row:
        if len(payload) > LONGEST:
            return Row({}, token, f"longer than {LONGEST} characters")
        try:
            found = json.loads(payload)
        except (ValueError, RecursionError) as error:
            return Row({}, token, f"not a number ({type(error).__name__})")
        if isinstance(found, dict):
            moment = found.get(self._time, time.time())
            return Row({self._time: moment, column: found.get("value")}, token)
        return Row({self._time: time.time(), column: found}, token)

    @property
    def done(self) -> bool:
        """A broker never says that nothing more will come."""
        return False

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the messages that have come."""
        rows: list[Row] = []
        while len(rows) < BATCH:
            try:
                row = self._rows.get_nowait() if rows or not wait else self._rows.get(timeout=wait)
            except queue.Empty:
                break
            rows.append(row)
        return rows

    def position(self, waiting: Iterable[Any]) -> str:
        """The broker remembers what was acknowledged."""
        return ""

    def acknowledge(self, tokens: Iterable[Any]) -> None:
        """Tell the broker which messages it may forget."""
        for mid, qos in tokens:
            self._client.ack(mid, qos)

    def close(self) -> None:
        """Disconnect; the broker keeps what comes from now on."""
        self._client.disconnect()
        self._client.loop_stop()


class MqttSink:
    """Publishes estimates: one JSON object for each sample, and each number to a topic of its own.

    Parameters
    ----------
    broker, topic
        Where to: TOPIC has the objects, TOPIC/LABEL the unknowns, retained.
    """

    def __init__(self, broker: Broker, topic: str) -> None:
        self._topic = topic.rstrip("/")
        self._sent: deque[Any] = deque()
        self._client = broker.client("-out")
        broker.connect(self._client)

    def put(self, estimate: Estimate) -> None:
        """Publish an estimate."""
        row = numbers(estimate)
        while self._sent and self._sent[0].is_published():
            self._sent.popleft()
        self._publish(self._topic, row)
        for label in estimate.parameters:
            self._publish(f"{self._topic}/{label}", row[label], retain=True)

    def _publish(self, topic: str, content: Any, retain: bool = False) -> None:
        self._sent.append(self._client.publish(topic, json.dumps(content), qos=1, retain=retain))

    def close(self) -> None:
        """Disconnect when all is sent, or the broker has not answered for some time."""
        until = time.monotonic() + PATIENCE
        for message in self._sent:
            message.wait_for_publish(max(until - time.monotonic(), 0.0))
        self._client.disconnect()
        self._client.loop_stop()


def numbers(estimate: Estimate) -> dict[str, Any]:
    """Return time, unknowns with deviations, status and innovations as JSON can hold them."""
    row: dict[str, Any] = {"t": estimate.t, "status": estimate.status.code}
    for label, (value, std) in estimate.parameters.items():
        row |= {label: value, f"{label}_std": std if math.isfinite(std) else None}
    row["innovation"] = [x if math.isfinite(x) else None for x in estimate.innovation.tolist()]
    return row
