"""Source of rows and sink of estimates for a message broker (MQTT 5, with paho-mqtt)."""

from __future__ import annotations

import json
import logging
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import combinations, zip_longest
from typing import TYPE_CHECKING, Any

from livepde.errors import DataError, optional
from livepde.estimate import Estimate
from livepde.streams.growing_file import LONGEST
from livepde.streams.sources import Row, RowSource, drained, json_row

if TYPE_CHECKING:
    from paho.mqtt.client import Client

__all__ = ["Broker", "MqttSink", "MqttSource"]

LARGEST = 16 * LONGEST  # bytes of a message; the broker does not send larger ones
UNCONFIRMED = 20  # largest number of unconfirmed messages of a sink
PATIENCE = 10.0  # seconds for the first connection, and for the last messages
CONFIRMED = 1000  # acknowledged messages that are recognised if an acknowledgement is lost
TAKEN_OVER = 142  # reason code: a newer client has the same client identifier

log = logging.getLogger("livepde.mqtt")


@dataclass(frozen=True)
class Broker:
    """Connection to a broker: address, session, login and encryption.

    Parameters
    ----------
    host, port
        Address of the broker.
    client_id
        Name of the session, for which the broker queues messages while the client is offline. Each
        run needs its own name.
    username, password
        Login, if the broker requires one; the password is never written anywhere.
    tls
        Whether to encrypt; certificates are verified against those of the system.
    ca_file
        File of the only trusted certificates (PEM); implies encryption.
    session
        Seconds for which the broker keeps the session of an offline client.
    ahead
        Largest number of unacknowledged messages that the broker may send, at most 65535. A message
        is acknowledged when its sample is in the journal.
    """

    host: str = "localhost"
    port: int = 1883
    client_id: str = "livepde"
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: bool = False
    ca_file: str | None = None
    session: int = 7 * 86400
    ahead: int = 65535

    def __post_init__(self) -> None:
        if not 1 <= self.ahead <= 65535:
            raise DataError(f"MQTT: ahead must be a number from 1 to 65535; got {self.ahead}.")

    @property
    def address(self) -> str:
        """Host and port."""
        return f"{self.host}:{self.port}"

    def client(self, suffix: str = "") -> Client:
        """Return a client without a connection."""
        with optional("mqtt", "MQTT needs paho-mqtt", DataError):
            from paho.mqtt.client import Client, MQTTv5
            from paho.mqtt.enums import CallbackAPIVersion
        # With manual acknowledgement, the broker keeps a message until its sample is in the journal
        client = Client(
            CallbackAPIVersion.VERSION2,
            client_id=self.client_id + suffix,
            protocol=MQTTv5,
            manual_ack=True,
        )
        if self.username is not None:
            client.username_pw_set(self.username, self.password)
        if self.tls or self.ca_file is not None:
            try:
                client.tls_set(self.ca_file)
            except OSError as error:
                raise DataError(f"MQTT: ca_file {self.ca_file} cannot be used: {error}.") from error
        client.reconnect_delay_set(1, 30)
        return client

    def connect(self, client: Client) -> None:
        """Connect to the broker; a separate thread reconnects after a loss of the connection."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = self.session
        properties.ReceiveMaximum = self.ahead
        properties.MaximumPacketSize = LARGEST
        try:
            # Without a clean start, the broker resumes the session and sends the queued messages.
            client.connect(self.host, self.port, clean_start=False, properties=properties)
        except (OSError, ValueError) as error:
            raise DataError(f"MQTT: no broker at {self.address} ({error}).") from error
        client.loop_start()


class _Peer:
    """A client that reconnects to its broker and logs losses of the connection."""

    def __init__(self, broker: Broker, suffix: str = "") -> None:
        self._broker = broker
        self._started = threading.Event()
        self._since = 0.0
        self._refusal = ""
        self._client = broker.client(suffix)
        self._client.on_connect = self._on_connect
        self._client.on_disconnect = self._on_disconnect

    def _start(self) -> None:
        """Connect; raise `DataError` if the broker refuses or does not answer."""
        self._broker.connect(self._client)
        if not self._started.wait(PATIENCE):
            self._refusal = self._refusal or "no answer"
        if self._refusal:
            self._leave()
            raise DataError(f"MQTT: the broker at {self._broker.address}: {self._refusal}.")

    def _leave(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def _refused(self, reason: str) -> None:
        if self._started.is_set():
            log.warning("the broker at %s refuses: %s", self._broker.address, reason)
        else:
            self._refusal = reason
            self._started.set()

    def _on_connect(self, client: Any, data: Any, flags: Any, reason: Any, more: Any) -> None:
        if reason.is_failure:
            self._refused(str(reason))
            return
        self._since = time.monotonic()
        if self._started.is_set():
            log.info("connected to the broker at %s again", self._broker.address)
        self._connected(bool(flags.session_present))

    def _on_disconnect(self, client: Any, data: Any, flags: Any, reason: Any, more: Any) -> None:
        if reason.is_failure and self._started.is_set():
            soon = time.monotonic() - self._since < PATIENCE
            remedy = "; has another client the same client_id?" if soon else ""
            text = "connection to the broker at %s lost: %s%s"
            log.warning(text, self._broker.address, reason, remedy)
        self._disconnected(int(reason.value))

    def _connected(self, resumed: bool) -> None:
        """Handle a new connection; `resumed`: whether the broker has resumed the session."""
        raise NotImplementedError

    def _disconnected(self, reason: int) -> None:
        """Handle a lost connection."""


@dataclass(eq=False, slots=True)
class _Delivery:
    """A message to acknowledge: its number, the hash of its content, and its connection.

    The broker assigns the numbers. After a reconnect, it repeats unacknowledged messages with the
    same numbers, but a number from an earlier connection may refer to another message.
    """

    number: int
    content: int
    connection: int
    safe: bool = False


def _check_filter(topic: str) -> None:
    """Refuse an invalid topic filter."""
    levels = topic.split("/")
    signs = [level for level in levels if "+" in level or "#" in level]
    alone = all(sign in ("+", "#") for sign in signs)
    if not topic or "\0" in topic or not alone or "#" in levels[:-1]:
        raise DataError(
            f"MQTT: got the topic '{topic}'; '+' replaces one whole level, as in plant/+/level, "
            "and '#' at the end all that follow."
        )


def _check_overlap(one: str, other: str) -> None:
    """Refuse two topic filters that match the same message."""
    # No message matches both if at a level they have different words, or only one has ended.
    for level, against in zip_longest(one.split("/"), other.split("/")):
        if "#" in (level, against):
            break
        if level != against and (None in (level, against) or "+" not in (level, against)):
            return
    raise DataError(
        f"MQTT: the topics '{one}' and '{other}' receive some messages twice: let each message "
        "match one topic."
    )


class MqttSource(_Peer, RowSource):
    """Rows from topics; unacknowledged messages are delivered again, even after a restart.

    A message is a row (a JSON object, column -> value). For a topic with its own column, it is a
    number, alone or as {"value": 1.5, TIME: ...}. A number without a time has the time of its
    arrival, but is refused if the broker has retained or repeated it: its time is then unknown.

    Parameters
    ----------
    broker
        Connection to the broker.
    topics
        Topic filter, perhaps with "+" or "#" -> column of its numbers; None: its messages are rows.
    time
        Name of the time column.

    Attributes
    ----------
    dropped
        Number of messages without acknowledgement (QoS 0) that were lost since the queue was full.
    """

    def __init__(self, broker: Broker, topics: Mapping[str, str | None], time: str) -> None:
        super().__init__(broker)
        for topic in topics:
            _check_filter(topic)
        for one, other in combinations(topics, 2):
            _check_overlap(one, other)
        self.dropped = 0
        self._topics = dict(topics)
        self._time = time
        self._rows: queue.Queue[Row] = queue.Queue()
        self._lock = threading.Lock()
        self._deliveries: dict[int, _Delivery] = {}
        self._confirmed: deque[_Delivery] = deque()
        self._came = 0.0
        self._connection = 0
        self._taken_over = False
        self._client.on_subscribe = self._on_subscribe
        self._client.on_message = self._on_message
        self._start()

    def _connected(self, resumed: bool) -> None:
        # A new session has no unacknowledged messages and reuses their numbers.
        if not resumed:
            with self._lock:
                self._deliveries.clear()
                self._confirmed.clear()
        self._client.subscribe([(topic, 1) for topic in self._topics])

    def _disconnected(self, reason: int) -> None:
        with self._lock:
            self._connection += 1
        if reason == TAKEN_OVER:
            self._taken_over = True
            self._client.disconnect()  # stops reconnecting

    def _on_subscribe(self, client: Any, data: Any, mid: int, reasons: Any, more: Any) -> None:
        for topic, reason in zip(self._topics, reasons, strict=True):
            if reason.is_failure:
                self._refused(f"topic '{topic}': {reason}")
        self._started.set()

    def _on_message(self, client: Client, userdata: Any, message: Any) -> None:
        payload = bytes(message.payload)
        try:
            topic = str(message.topic)
        except UnicodeDecodeError:
            topic = ""
        columns = self._columns(topic)
        if not columns:  # the session still has a subscription of an earlier case
            client.ack(message.mid, message.qos)
            return
        with self._lock:
            self._came = time.monotonic()
            delivery = None
            if message.qos:
                content = hash((topic, payload))
                known = self._deliveries.get(message.mid)
                # Repeated after a reconnect: its row is already in the queue or in the journal.
                if message.dup and known is not None and known.content == content:
                    known.connection = self._connection
                    if known.safe:
                        self._confirm(known)
                    return
                delivery = _Delivery(message.mid, content, self._connection)
                self._deliveries[message.mid] = delivery
            # The broker sends messages of QoS 0 without a limit, so that the queue needs a limit.
            elif self._rows.qsize() >= self._broker.ahead:
                self.dropped += 1
                return
            old = message.dup or message.retain
            self._rows.put(self._row(columns[0], payload, delivery, old))

    def _confirm(self, delivery: _Delivery) -> None:
        self._client.ack(delivery.number, 1)
        # If the acknowledgement is lost, the message is repeated and must be recognised.
        self._confirmed.append(delivery)
        if len(self._confirmed) > CONFIRMED:
            oldest = self._confirmed.popleft()
            if self._deliveries.get(oldest.number) is oldest:
                del self._deliveries[oldest.number]

    def _row(self, column: str | None, payload: bytes, token: Any, old: bool) -> Row:
        if column is None:
            return json_row(payload, token)
        if len(payload) > LONGEST:
            return Row({}, token=token, broken=f"longer than {LONGEST} characters")
        try:
            found = json.loads(payload)
        except (ValueError, RecursionError) as error:
            return Row({}, token=token, broken=f"not a number ({type(error).__name__})")
        values = found if isinstance(found, dict) else {"value": found}
        if self._time not in values and old:
            return Row({}, token=token, broken="retained by the broker without a time")
        moment = values.get(self._time, datetime.now(UTC).isoformat())
        return Row({self._time: moment, column: values.get("value")}, token=token)

    def _columns(self, topic: str) -> list[str | None]:
        """Return the column of a subscribed topic in a list; empty for other topics."""
        from paho.mqtt.client import topic_matches_sub

        return [column for sub, column in self._topics.items() if topic_matches_sub(sub, topic)]

    @property
    def done(self) -> bool:
        """False: a broker never reports the end of its messages."""
        return False

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the rows of messages that have arrived.

        Raises `DataError`: another client has taken over the session; or the broker sends no more
        messages, because `ahead` messages are unacknowledged and wait for later ones.
        """
        rows = drained(self._rows, wait)
        if wait and not rows:
            self._check()
        return rows

    def _check(self) -> None:
        if self._taken_over:
            raise DataError(
                f"MQTT: another client uses the session '{self._broker.client_id}': give each "
                "run its own `client_id`."
            )
        with self._lock:
            # The broker sends no more than `ahead` messages before one is acknowledged.
            here = (d for d in self._deliveries.values() if d.connection == self._connection)
            count = sum(not delivery.safe for delivery in here)
            quiet = self._rows.empty() and time.monotonic() - self._came > PATIENCE
            if count >= self._broker.ahead and quiet:
                raise DataError(
                    f"MQTT: {count} messages wait for later ones, and no more are sent "
                    "before the first is acknowledged: reduce `intake.wait`, or send rows with "
                    "several channels."
                )

    def acknowledge(self, tokens: Iterable[Any]) -> None:
        """Acknowledge messages to the broker, or after the reconnect if it is offline."""
        with self._lock:
            for token in tokens:
                known = None if token is None else self._deliveries.get(token.number)
                if known is None or known is not token or known.safe:
                    continue
                known.safe = True
                if known.connection == self._connection:
                    self._confirm(known)

    def close(self) -> None:
        """Disconnect; the broker queues later messages for the session."""
        self._leave()


def _topic_of(topic: str, label: str) -> str:
    """Return the topic of an unknown."""
    return f"{topic}/unknowns/{label.translate(str.maketrans('+#/', '___'))}"


def home_assistant(
    estimate: Estimate, topic: str, title: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield topics and messages of the MQTT discovery of Home Assistant.

    The run is a device. Each unknown and the level of the verdict are its sensors.
    """
    node = re.sub(r"[^A-Za-z0-9_-]", "_", topic)
    shared = {
        "availability_topic": f"{topic}/status",
        "payload_available": "running",
        "payload_not_available": "offline",
        "device": {"identifiers": [node], "name": title, "manufacturer": "livepde"},
    }

    def sensor(name: str, **parts: Any) -> tuple[str, dict[str, Any]]:
        unique = f"{node}_{re.sub(r'[^A-Za-z0-9_-]', '_', name)}"
        content = {"name": name, "unique_id": unique, **parts, **shared}
        return f"homeassistant/sensor/{unique}/config", content

    for label in estimate.parameters:
        unit = estimate.space.unknown_of(label).unit
        yield sensor(
            label,
            state_topic=_topic_of(topic, label),
            value_template="{{ value_json.value }}",
            json_attributes_topic=_topic_of(topic, label),
            state_class="measurement",
            **({"unit_of_measurement": unit} if unit else {}),
        )
    yield sensor("verdict", state_topic=topic, value_template="{{ value_json.verdict }}")


class MqttSink(_Peer):
    """Sink that publishes each estimate as a JSON object, and each unknown to its own topic.

    `put` never waits for the broker. While the broker is offline, the newest estimates are kept,
    and the others are dropped and counted.

    Parameters
    ----------
    broker, topic
        Destination: TOPIC for the objects; TOPIC/unknowns/LABEL for unknowns; TOPIC/status for
        "running", or "offline" if the run has ended or is unreachable. Only TOPIC is not retained.
    discovery
        Whether to publish a discovery message for each sensor of Home Assistant.
    title
        Name of the run in Home Assistant.
    keep
        Largest number of estimates that wait for the broker.

    Attributes
    ----------
    dropped
        Number of estimates that were dropped while the broker was offline.
    """

    def __init__(
        self,
        broker: Broker,
        topic: str,
        *,
        discovery: bool = False,
        title: str = "",
        keep: int = 1000,
    ) -> None:
        super().__init__(broker, "-out")
        self._topic = topic.rstrip("/")
        if not self._topic or any(sign in self._topic for sign in "+#\0"):
            raise DataError(f"MQTT: got the topic '{topic}' to publish to; it has no '+' and '#'.")
        self.dropped = 0
        self._discovery = discovery
        self._title = title or self._topic
        self._waiting: deque[Estimate] = deque(maxlen=keep)
        self._changed = threading.Condition()
        self._announce = False
        self._closing = False
        self._given_up = threading.Event()
        self._free = threading.Semaphore(UNCONFIRMED)
        self._client.on_publish = self._on_publish
        # The broker publishes this last will if the connection breaks.
        self._client.will_set(f"{self._topic}/status", "offline", 1, retain=True)
        self._start()
        self._sender = threading.Thread(target=self._send, daemon=True)
        self._sender.start()

    def _connected(self, resumed: bool) -> None:
        with self._changed:
            self._announce = True
            self._changed.notify()
        self._started.set()

    def put(self, estimate: Estimate) -> None:
        """Queue an estimate, which is published as soon as the broker accepts it."""
        with self._changed:
            if len(self._waiting) == self._waiting.maxlen:
                self.dropped += 1
                if self.dropped == 1:
                    log.warning(
                        "the broker was unreachable for too long: old estimates are not sent"
                    )
            self._waiting.append(estimate)
            self._changed.notify()

    def _send(self) -> None:
        discovered = True  # whether discovery messages were sent to Home Assistant
        while not self._given_up.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._announce or self._closing)
                announce, self._announce = self._announce, False
                estimate = self._waiting.popleft() if self._waiting else None
                last = self._closing and not self._waiting
            if announce:
                discovered = not self._discovery
                self._publish(f"{self._topic}/status", "running")
            if estimate is not None:
                self._publish_numbers(estimate, discovered)
                discovered = True
            if last:
                self._publish(f"{self._topic}/status", "offline")
                return

    def _publish_numbers(self, estimate: Estimate, discovered: bool) -> None:
        """Publish an estimate, after the discovery messages if these were not sent yet."""
        if not discovered:
            for topic, content in home_assistant(estimate, self._topic, self._title):
                self._publish(topic, json.dumps(content))
        row = estimate.to_dict()
        self._publish(self._topic, json.dumps(row), retain=False)
        for label, known in row["unknowns"].items():
            self._publish(_topic_of(self._topic, label), json.dumps(known))

    def _publish(self, topic: str, content: str, *, retain: bool = True) -> None:
        while not self._free.acquire(timeout=0.1):
            if self._given_up.is_set():
                return
        self._client.publish(topic, content, qos=1, retain=retain)

    def _on_publish(self, client: Any, data: Any, mid: int, reason: Any, more: Any) -> None:
        if reason.is_failure:
            log.warning("the broker at %s accepts no estimate: %s", self._broker.address, reason)
        self._free.release()

    def close(self) -> None:
        """Disconnect after all messages were sent, at the latest after `PATIENCE`."""
        until = time.monotonic() + PATIENCE
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._sender.join(PATIENCE)
        # A message releases the semaphore when the broker has confirmed it.
        for _ in range(UNCONFIRMED):
            if not self._free.acquire(timeout=max(until - time.monotonic(), 0.0)):
                log.warning("the broker at %s did not accept all estimates", self._broker.address)
                break
        self._given_up.set()
        self._leave()
        self._sender.join()
