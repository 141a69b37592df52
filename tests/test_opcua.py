"""A real OPC UA server: changes come as rows, also after it was away."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from datetime import UTC, datetime

import pytest
from live_rod import live
from patience import PATIENCE
from ports import kept_port

import livepde as lp
from livepde.streams.opcua import OpcuaSource
from livepde.streams.sources import Row, Rows, drained

pytestmark = pytest.mark.broker

pytest.importorskip("asyncua")
COLUMNS = {"ns=2;s=a": "a", "ns=2;s=b": "b", "ns=2;s=left": "left"}


class Server:
    """A server with three values, in a thread of its own."""

    def __init__(self) -> None:
        self.kept, port = kept_port()
        self.url = f"opc.tcp://127.0.0.1:{port}/plant"
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.running = False
        self.start()

    def _do(self, work):
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(PATIENCE)

    def start(self) -> None:
        self._do(self._start())
        self.running = True

    async def _start(self) -> None:
        from asyncua import Server as Asyncua
        from asyncua import ua
        from asyncua.crypto.permission_rules import User, UserRole

        class Guard:
            def get_user(self, server, username=None, password=None, certificate=None):
                known = username is None or (username, password) == ("operator", "right")
                return User(UserRole.User) if known else None

        self.server = Asyncua(user_manager=Guard())
        await self.server.init()
        self.server.set_endpoint(self.url)
        self.server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await self.server.register_namespace("plant")
        self.nodes = {}
        for name in ("a", "b", "left"):
            node = ua.NodeId(name, space)
            self.nodes[name] = await self.server.nodes.objects.add_variable(node, name, 0.0)
        await self.server.start()

    def write(self, name: str, value, *, moment=None, status=0, dated=True) -> None:
        from asyncua import ua

        found = ua.DataValue(
            ua.Variant(value),
            StatusCode=ua.StatusCode(status),
            SourceTimestamp=(moment or datetime.now(UTC)) if dated else None,
            ServerTimestamp=None if dated else datetime.now(UTC),
        )
        self._do(self.nodes[name].write_value(found))

    def stop(self) -> None:
        if self.running:
            self._do(self.server.stop())
        self.running = False

    async def _rest(self) -> None:
        """End what asyncua leaves behind."""
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def close(self) -> None:
        self.stop()
        self._do(self._rest())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(PATIENCE)
        self.loop.close()
        self.kept.close()


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    monkeypatch.setattr("livepde.streams.opcua.PATIENCE", 60.0)


@pytest.fixture(scope="module")
def plant():
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    running = Server()
    yield running
    running.close()


@pytest.fixture
def server(plant):
    """The server of all tests, as it was at first: to make one takes seconds."""
    if not plant.running:
        plant.start()
    for name in plant.nodes:
        plant.write(name, 0.0)
    return plant


def listen(source, wanted) -> list:
    """Return what comes until a row is as wanted."""
    rows = []
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        rows += source.poll(0.2)
        if any(wanted(row) for row in rows):
            return rows
    raise AssertionError(rows)


def source(server, **options) -> OpcuaSource:
    return OpcuaSource(server.url, COLUMNS, "t", interval=0.05, **options)


def test_changes_are_rows_with_the_time_of_their_source(server):
    heard = source(server)
    moment = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    server.write("a", 1.5, moment=moment)
    (row,) = [r for r in listen(heard, lambda r: r.values.get("a") == 1.5) if r.values.get("a")]
    heard.close()
    assert row.values == {"t": "2026-01-02T03:04:05+00:00", "a": 1.5}


def test_values_without_a_source_time_are_counted_and_told_once(server, caplog):
    heard = source(server)
    listen(heard, lambda row: "left" in row.values)
    assert heard.undated == 0
    with caplog.at_level(logging.WARNING, "livepde.opcua"):
        for value in (3.5, 4.5):
            server.write("a", value, dated=False)
            rows = listen(heard, lambda row, value=value: row.values.get("a") == value)
    heard.close()
    assert heard.undated == 2
    assert rows[-1].values["t"]
    told = [record.message for record in caplog.records if "source time" in record.message]
    assert len(told) == 1
    assert "'a' has no source time" in told[0]


def test_a_status_that_is_not_good_is_a_broken_row(server):
    from asyncua import ua

    heard = source(server)
    listen(heard, lambda row: "left" in row.values)
    server.write("b", 3.0, status=ua.StatusCodes.BadSensorFailure)
    (bad,) = listen(heard, lambda row: row.broken)
    server.write("b", 4.0, status=ua.StatusCodes.UncertainLastUsableValue)
    (uncertain,) = listen(heard, lambda row: row.broken)
    heard.close()
    assert bad.broken == "'b' is BadSensorFailure"
    assert uncertain.broken == "'b' is UncertainLastUsableValue"


def test_a_server_that_was_away_is_heard_again(server, caplog):
    caplog.set_level(logging.INFO, "livepde.opcua")
    heard = source(server)
    server.write("a", 1.0)
    listen(heard, lambda row: row.values.get("a") == 1.0)
    server.stop()
    until = time.monotonic() + PATIENCE
    while " lost: " not in caplog.text and time.monotonic() < until:
        time.sleep(0.1)
    server.start()
    listen(heard, lambda row: row.values.get("a") == 0.0)  # a new server has its first values
    server.write("a", 2.0)
    listen(heard, lambda row: row.values.get("a") == 2.0)
    heard.close()
    assert "reconnected to the server" in caplog.text
    assert not heard._thread.is_alive()


def test_a_connection_that_breaks_down_ends_the_run(server):
    heard = source(server)
    listen(heard, lambda row: "left" in row.values)
    heard._loop.call_soon_threadsafe(heard._stop.set)  # as if its thread had failed
    heard._thread.join(PATIENCE)
    while not heard._rows.empty():
        heard.poll(0.0)
    with pytest.raises(lp.errors.DataError, match="connection failed"):
        heard.poll(0.0)


def test_the_last_rows_of_a_connection_that_breaks_down_are_taken(server, monkeypatch):
    """A row that comes between the last look and the end of the thread is not lost."""
    heard = source(server)
    listen(heard, lambda row: "left" in row.values)
    row = Row({"t": "2026-01-01T00:00:00+00:00", "a": 1.0})

    def breaks_down(rows, wait):
        found = drained(rows, wait)
        if heard._thread.is_alive():
            heard.close()
            heard._rows.put(row)
        return found

    monkeypatch.setattr("livepde.streams.opcua.drained", breaks_down)
    assert row in [*heard.poll(0.0), *heard.poll(0.0)]
    with pytest.raises(lp.errors.DataError, match="connection failed"):
        heard.poll(0.0)


def test_a_thread_may_outlive_its_loop(server, monkeypatch):
    """A refused connection closes its loop; its thread is still seen alive for a moment."""
    work = OpcuaSource._work
    leave = threading.Event()

    def lingers(self):
        work(self)
        leave.wait(PATIENCE)

    monkeypatch.setattr(OpcuaSource, "_work", lingers)
    heard = source(server)
    heard._loop.call_soon_threadsafe(heard._stop.set)
    while not heard._loop.is_closed():
        time.sleep(0.01)
    join = heard._thread.join
    monkeypatch.setattr(heard._thread, "join", lambda wait: [leave.set(), join(PATIENCE)])
    assert heard._thread.is_alive()
    heard.close()
    assert not heard._thread.is_alive()


def test_a_run_takes_them(server, tmp_path):
    heard, rows = source(server), []
    listen(heard, lambda row: "left" in row.values)
    for k in range(6):
        moment = datetime(2026, 1, 1, 0, 0, k, tzinfo=UTC)
        values = {"left": 1.0 + 0.01 * k, "a": 0.7 + 0.01 * k, "b": 0.4 + 0.01 * k}
        for name, value in values.items():
            server.write(name, value, moment=moment)
        # The server sends each node's values together: two moments at once would be out of order.
        rows += listen(heard, lambda row, b=values["b"]: row.values.get("b") == b)
    heard.close()
    run = live(tmp_path, Rows([row.values for row in rows]))
    run.feed.intake.origin = None
    run.run()
    assert [record.t for record in run.journal] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    run.journal.close()


def test_what_cannot_be_reached_is_one_sentence(server):
    with pytest.raises(lp.errors.DataError, match="node 'ns=2;s=none': BadNodeIdUnknown"):
        OpcuaSource(server.url, {"ns=2;s=none": "x", "ns=2;s=a": "a"}, "t")
    with pytest.raises(lp.errors.DataError, match="not a node"):
        OpcuaSource(server.url, {"not a node": "x"}, "t")
    source(server, username="operator", password="right").close()
    with pytest.raises(lp.errors.DataError, match="BadUserAccessDenied") as refused:
        source(server, username="operator", password="wrong")
    assert "wrong" not in str(refused.value)
    with pytest.raises(lp.errors.DataError, match="use `username` instead"):
        OpcuaSource("opc.tcp://me:secret@localhost:4840", COLUMNS, "t")
    with pytest.raises(lp.errors.DataError, match="interval must be"):
        OpcuaSource(server.url, COLUMNS, "t", interval=0.0)
    server.stop()
    with pytest.raises(lp.errors.DataError, match=r"opc.tcp://127.0.0.1.*failed"):
        source(server)
