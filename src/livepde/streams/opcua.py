"""Source of rows and sink of estimates for a control system (OPC UA, with asyncua)."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as OutOfTime
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from livepde.errors import DataError, optional
from livepde.estimate import Estimate
from livepde.streams.sources import Row, RowSource, drained

__all__ = ["OpcuaServer", "OpcuaSink", "OpcuaSource"]

PATIENCE = 5.0  # timeout of requests in seconds
LOOK = 1.0  # seconds between two checks of the connection
LONGEST_WAIT = 30.0  # longest time in seconds between two attempts to reconnect
HELD = 65535  # largest number of waiting rows; newer rows are then dropped
QUEUED = 10  # values of a node that the server queues between two messages

log = logging.getLogger("livepde.opcua")


@dataclass(frozen=True)
class OpcuaServer:
    """Connection to a server: address, login and encryption.

    Parameters
    ----------
    url
        Address of the server: opc.tcp://HOST:PORT/...
    username, password
        Login, if the server requires one; the password is never written anywhere.
    security
        "Policy,Mode,certificate,key" with files (PEM or DER), and optionally the certificate of the
        server, which is then the only trusted one. Empty: no encryption.
    """

    url: str
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    security: str = ""

    async def client(self) -> Any:
        """Return a client without a connection."""
        from asyncua.client.client import Client

        client: Any = Client(self.url, timeout=PATIENCE)
        if self.security:
            # A server compares the URI of a client with the URI in its certificate.
            client.application_uri = _application_of(Path(self.security.split(",")[2]))
            await client.set_security_string(self.security)
        if self.username is not None:
            client.set_user(self.username)
            client.set_password(self.password or "")
        return client


def _application_of(path: Path) -> str:
    """Return the application URI in a certificate."""
    from cryptography import x509

    content = path.read_bytes()
    load = x509.load_der_x509_certificate
    if content.startswith(b"-----BEGIN"):
        load = x509.load_pem_x509_certificate
    certificate = load(content)
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        return names.get_values_for_type(x509.UniformResourceIdentifier)[0]
    except (x509.ExtensionNotFound, IndexError):
        raise DataError(f"the certificate {path} names no application (URI)") from None


class _Client:
    """A connection to a server in its own thread, which reconnects until it is closed."""

    def __init__(self, server: OpcuaServer) -> None:
        with optional("opcua", "OPC UA needs asyncua", DataError):
            import asyncua  # noqa: F401
        if "@" in server.url:
            raise DataError("OPC UA: the url contains a password: use `username` instead.")
        self._server = server
        self._wait = LOOK
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._started: Future[None] = Future()
        self._thread = threading.Thread(target=self._work, name="livepde-opcua", daemon=True)
        self._thread.start()
        try:
            self._started.result(3 * PATIENCE)
        except (DataError, OutOfTime) as error:
            self.close()
            text = f"OPC UA: {server.url}: {str(error) or 'no answer'}."
            raise DataError(text) from error

    def _work(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._stay())

    async def _stay(self) -> None:
        """Serve, and reconnect if the connection is lost."""
        from asyncua.ua.uaerrors import UaError

        while not self._stop.is_set():
            try:
                async with await self._server.client() as client:
                    await self._serve(client)
                return
            except (DataError, UaError, OSError, ValueError) as error:
                reason = str(error) or type(error).__name__
            if not self._started.done():
                self._started.set_exception(DataError(reason))
                return
            log.warning("connection to the server at %s lost: %s", self._server.url, reason)
            if await self._stopped(self._wait):
                return
            self._wait = min(2.0 * self._wait, LONGEST_WAIT)

    async def _serve(self, client: Any) -> None:
        """Use a connection until it is lost, or the peer is closed."""
        raise NotImplementedError

    def _connected(self) -> None:
        """Record that the server accepts requests."""
        if self._started.done():
            log.info("reconnected to the server at %s", self._server.url)
        else:
            self._started.set_result(None)
        self._wait = LOOK

    async def _stopped(self, wait: float) -> bool:
        """Wait until the client is closed, at most `wait` seconds; return whether it is closed."""
        try:
            await asyncio.wait_for(self._stop.wait(), wait)
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        """Disconnect from the server."""
        with suppress(RuntimeError):  # raised if the loop is already closed
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(PATIENCE)


class OpcuaSource(_Client, RowSource):
    """Rows from nodes of a server, one for each change of a value.

    The time of a row is the source time of the change, as a date. A value whose status is not good
    is a broken row. A constant value is sent only once. Changes while the server is unreachable are
    lost; the source tries to reconnect until the server is available again.

    Parameters
    ----------
    server
        Connection to the server.
    columns
        Node -> column, such as {"ns=2;s=T_05": "T_05"}.
    time
        Name of the time column.
    interval
        Sampling interval of the server, in seconds.

    Attributes
    ----------
    dropped
        Number of rows that were lost because the queue was full.
    undated
        Number of values without a source time, which have the server time or the arrival time.

    Raises
    ------
    DataError
        There is no server, it refuses the login, or a node does not exist.
    """

    def __init__(
        self, server: OpcuaServer, columns: Mapping[str, str], time: str, interval: float = 1.0
    ) -> None:
        if not interval > 0.0:
            raise DataError(f"OPC UA: interval must be a time > 0; got {interval}.")
        self.dropped = self.undated = 0
        self._columns = dict(columns)
        self._time = time
        self._interval = interval
        self._rows: queue.Queue[Row] = queue.Queue(HELD)
        self._seen: dict[str, datetime | None] = {}
        super().__init__(server)

    async def _serve(self, client: Any) -> None:
        nodes = {name: client.get_node(name) for name in self._columns}
        columns = {nodes[name].nodeid: self._columns[name] for name in nodes}
        changes = _Changes(self._take, columns)
        period = 1000.0 * self._interval
        subscription = await client.create_subscription(period, changes)
        answers = await subscription.subscribe_data_change(
            list(nodes.values()), queuesize=QUEUED, sampling_interval=period
        )
        for name, answer in zip(nodes, answers, strict=True):
            if not isinstance(answer, int):
                raise DataError(f"node '{name}': {answer.name}")
        self._connected()
        while not await self._stopped(LOOK):
            await client.check_connection()
            if changes.ended:
                raise DataError(f"the server ended the subscription ({changes.ended})")

    def _take(self, column: str, found: Any) -> None:
        """Queue the row of a value, unless the value is known, such as after a reconnect."""
        moment = found.SourceTimestamp or found.ServerTimestamp or datetime.now(UTC)
        if self._seen.get(column) == moment:
            return
        self._seen[column] = moment
        if found.SourceTimestamp is None:
            self.undated += 1
            if self.undated == 1:
                log.warning(
                    "'%s' has no source time: its values, and others without one, have the time of "
                    "%s; set the time at the source if the server is slow",
                    column,
                    "the server" if found.ServerTimestamp else "their arrival",
                )
        row = Row({}, token=None, broken=f"'{column}' is {found.StatusCode.name}")
        if found.StatusCode.is_good():
            time = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            row = Row({self._time: time.isoformat(), column: found.Value.Value})
        try:
            self._rows.put_nowait(row)
        except queue.Full:
            self.dropped += 1

    @property
    def done(self) -> bool:
        """False: a server never reports the end of its data."""
        return False

    @property
    def steady(self) -> bool:
        """False: a server does not send unchanged values."""
        return False

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the rows of changes that have arrived.

        Raises `DataError`: the thread of the connection has ended with an unexpected error.
        """
        broken = not self._thread.is_alive()  # checked first, so that its last rows are returned
        rows = drained(self._rows, wait)
        if broken and not rows:
            raise DataError(f"OPC UA: {self._server.url}: the connection failed, see the log.")
        return rows


@dataclass(eq=False)
class _Changes:
    """Handler of the notifications of a subscription."""

    take: Callable[[str, Any], None]
    columns: Mapping[Any, str]  # identifier of a node -> its column
    ended: str = ""

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self.take(self.columns[node.nodeid], data.monitored_item.Value)

    def status_change_notification(self, status: Any) -> None:
        self.ended = status.Status.name


class OpcuaSink(_Client):
    """Sink that writes the newest estimate to nodes of a server, at most once a second.

    Parameters
    ----------
    server
        Connection to the server.
    columns
        Node -> an unknown, such as alpha; its standard deviation, alpha_std; or verdict.

    Raises
    ------
    DataError
        There is no server, it refuses the login, or a node cannot be written.
    """

    def __init__(self, server: OpcuaServer, columns: Mapping[str, str]) -> None:
        self._columns = dict(columns)
        self._newest: dict[str, float | str | None] = {}
        super().__init__(server)

    def put(self, estimate: Estimate) -> None:
        """Write an estimate as soon as the server is reachable.

        Raises `DataError`: the estimate has no value with one of the names in `columns`.
        """
        row = estimate.to_dict()
        values = {"verdict": row["verdict"]}
        for label, known in row["unknowns"].items():
            values |= {label: known["value"], f"{label}_std": known["std"]}
        for name in self._columns.values():
            if name not in values:
                raise DataError(f"OPC UA: got '{name}' to write; there are {', '.join(values)}.")
        self._newest = values

    async def _serve(self, client: Any) -> None:
        from asyncua.ua import DataValue, Variant

        nodes = [await _writable(client, node, name) for node, name in self._columns.items()]
        self._connected()
        stopped, written = False, None
        while not stopped:
            stopped = await self._stopped(LOOK)  # before the last pass, to write the last values
            await client.check_connection()
            values = self._newest
            for node, kind, name in () if values is written else nodes:
                if (value := values.get(name)) is not None:
                    await node.write_value(DataValue(Variant(value, kind)))
            written = values


async def _writable(client: Any, name: str, column: str) -> tuple[Any, Any, str]:
    """Return a node, its type and the name of the value to write; check that it is writable."""
    from asyncua.ua import AccessLevel, VariantType
    from asyncua.ua.uaerrors import UaError

    try:
        node = client.get_node(name)
        kind = await node.read_data_type_as_variant_type()
        writable = AccessLevel.CurrentWrite in await node.get_user_access_level()
    except (UaError, ValueError) as error:
        raise DataError(f"node '{name}': {error}") from error
    text = column == "verdict"
    kinds = {VariantType.String} if text else {VariantType.Float, VariantType.Double}
    if not (writable and kind in kinds):
        expected = "a text (String)" if text else "a number (Float or Double)"
        raise DataError(f"node '{name}': expected {expected} that this user may write")
    return node, kind, column
