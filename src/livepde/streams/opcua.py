"""Rows from the server of a control system (OPC UA, by asyncua)."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as OutOfTime
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

from livepde.errors import DataError, optional
from livepde.streams.sources import Row, RowSource, drained

__all__ = ["OpcuaSource"]

PATIENCE = 5.0  # seconds for each answer
LOOK = 1.0  # seconds between two looks at whether the server is there
LONGEST_WAIT = 30.0  # seconds between two attempts to reach it again
HELD = 65535  # rows that wait to be taken; newer ones are dropped then
QUEUED = 10  # values of a node that the server keeps between two messages

log = logging.getLogger("livepde.opcua")


class OpcuaSource(RowSource):
    """Rows from nodes of a server, one for each change of a value.

    A row has the time at which the server's source saw the change, as a date. A value whose status
    is not good is a broken row. A constant value is sent only once. Changes while the server cannot
    be reached are lost; the source tries to reconnect until the server is back.

    Parameters
    ----------
    url
        Address of the server: opc.tcp://HOST:PORT/...
    columns
        Node -> column, as {"ns=2;s=T_05": "T_05"}.
    time
        Name of the time column.
    interval
        Sampling interval of the server, in seconds.
    username, password
        Login, if the server requires one; the password is never written anywhere.

    Attributes
    ----------
    dropped
        Rows that came faster than they were taken.
    undated
        Values without a source time, which have the server's, or the time of their arrival.

    Raises
    ------
    DataError
        There is no server, it refuses the name, or a node does not exist.
    """

    def __init__(
        self,
        url: str,
        columns: Mapping[str, str],
        time: str,
        interval: float = 1.0,
        username: str | None = None,
        password: str | None = None,
    ) -> None:
        with optional("opcua", "OPC UA needs asyncua", DataError):
            import asyncua  # noqa: F401
        if "@" in url:
            raise DataError("OPC UA: the url contains a password: use `username` instead.")
        if not interval > 0.0:
            raise DataError(f"OPC UA: interval must be a time > 0; got {interval}.")
        self.dropped = self.undated = 0
        self._url = url
        self._columns = dict(columns)
        self._time = time
        self._interval = interval
        self._user = (username, password)
        self._rows: queue.Queue[Row] = queue.Queue(HELD)
        self._seen: dict[str, datetime | None] = {}
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
            raise DataError(f"OPC UA: {url}: {str(error) or 'no answer'}.") from error

    # --- the thread of the connection ------------------------------------------------------------

    def _work(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._stay())

    async def _stay(self) -> None:
        """Listen, and reconnect when the connection is lost."""
        from asyncua.ua.uaerrors import UaError

        while not self._stop.is_set():
            try:
                await self._listen()
                return
            except (DataError, UaError, OSError, ValueError) as error:
                reason = str(error) or type(error).__name__
            if not self._started.done():
                self._started.set_exception(DataError(reason))
                return
            log.warning("connection to the server at %s lost: %s", self._url, reason)
            if await self._stopped(self._wait):
                return
            self._wait = min(2.0 * self._wait, LONGEST_WAIT)

    async def _listen(self) -> None:
        from asyncua.client.client import Client

        client = Client(self._url, timeout=PATIENCE)
        username, password = self._user
        if username is not None:
            client.set_user(username)
            client.set_password(password or "")
        async with client:
            changes = _Changes(self)
            nodes = {name: client.get_node(name) for name in self._columns}
            changes.columns = {nodes[name].nodeid: self._columns[name] for name in nodes}
            period = 1000.0 * self._interval
            subscription: Any = await client.create_subscription(period, changes)
            answers = await subscription.subscribe_data_change(
                list(nodes.values()), queuesize=QUEUED, sampling_interval=period
            )
            for name, answer in zip(nodes, answers, strict=True):
                if not isinstance(answer, int):
                    raise DataError(f"node '{name}': {answer.name}")
            if self._started.done():
                log.info("reconnected to the server at %s", self._url)
            else:
                self._started.set_result(None)
            self._wait = LOOK
            while not await self._stopped(LOOK):
                await client.check_connection()
                if changes.ended:
                    raise DataError(f"the server ended the subscription ({changes.ended})")

    async def _stopped(self, wait: float) -> bool:
        """Wait, and return whether to stop."""
        try:
            await asyncio.wait_for(self._stop.wait(), wait)
        except TimeoutError:
            return False
        return True

    def _take(self, column: str, found: Any) -> None:
        """Take a value with its time and status; after a reconnect it may be a known one."""
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

    # --- what a source is ------------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """False: the data of a server never end."""
        return False

    @property
    def steady(self) -> bool:
        """False: a server does not send a value that stays the same."""
        return False

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the changes that have come.

        Raises
        ------
        DataError
            The thread of the connection has ended by an unforeseen error.
        """
        broken = not self._thread.is_alive()  # asked first: its last rows come before the error
        rows = drained(self._rows, wait)
        if broken and not rows:
            raise DataError(f"OPC UA: {self._url}: the connection failed, see the log.")
        return rows

    def close(self) -> None:
        """Disconnect from the server."""
        with suppress(RuntimeError):  # the loop has closed by itself: nothing is left to stop
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(PATIENCE)


class _Changes:
    """Handler of the notifications of a subscription."""

    def __init__(self, source: OpcuaSource) -> None:
        self.columns: dict[Any, str] = {}
        self.ended = ""
        self._source = source

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self._source._take(self.columns[node.nodeid], data.monitored_item.Value)

    def status_change_notification(self, status: Any) -> None:
        self.ended = status.Status.name
