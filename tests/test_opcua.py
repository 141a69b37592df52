"""A real OPC UA server: changes come as rows, also after it was away."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time
from datetime import UTC, datetime

import pytest
from live_rod import live

import livepde as lp
from livepde.streams.opcua import OpcuaSource
from livepde.streams.sources import Rows

pytest.importorskip("asyncua")
COLUMNS = {"ns=2;s=a": "a", "ns=2;s=b": "b", "ns=2;s=left": "left"}


class Server:
    """A server with three values, in a thread of its own."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.url = f"opc.tcp://127.0.0.1:{free.getsockname()[1]}/plant"
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.running = False
        self.start()

    def _do(self, work):
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(30)

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

    def write(self, name: str, value, *, moment=None, status=0) -> None:
        from asyncua import ua

        found = ua.DataValue(
            ua.Variant(value),
            StatusCode=ua.StatusCode(status),
            SourceTimestamp=moment or datetime.now(UTC),
        )
        self._do(self.nodes[name].write_value(found))

    def stop(self) -> None:
        if self.running:
            self._do(self.server.stop())
        self.running = False

    def close(self) -> None:
        self.stop()
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(10)
        self.loop.close()


@pytest.fixture
def server():
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    running = Server()
    yield running
    running.close()


def listen(source, wanted) -> list:
    """Return what comes until a row is as wanted."""
    rows = []
    until = time.monotonic() + 60.0
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
    until = time.monotonic() + 60.0
    while "is lost" not in caplog.text and time.monotonic() < until:
        time.sleep(0.1)
    server.start()
    listen(heard, lambda row: row.values.get("a") == 0.0)  # a new server has its first values
    server.write("a", 2.0)
    listen(heard, lambda row: row.values.get("a") == 2.0)
    heard.close()
    assert "is back" in caplog.text
    assert not heard._thread.is_alive()


def test_a_connection_that_breaks_down_ends_the_run(server):
    heard = source(server)
    listen(heard, lambda row: "left" in row.values)
    heard._loop.call_soon_threadsafe(heard._stop.set)  # as if its thread had failed
    heard._thread.join(30)
    while not heard._rows.empty():
        heard.poll(0.0)
    with pytest.raises(lp.DataError, match="has broken down"):
        heard.poll(0.0)


def test_a_thread_may_outlive_its_loop(server, monkeypatch):
    """A refused connection closes its loop; its thread is still seen alive for a moment."""
    work = OpcuaSource._work
    leave = threading.Event()

    def lingers(self):
        work(self)
        leave.wait(30.0)

    monkeypatch.setattr(OpcuaSource, "_work", lingers)
    heard = source(server)
    heard._loop.call_soon_threadsafe(heard._stop.set)
    while not heard._loop.is_closed():
        time.sleep(0.01)
    threading.Timer(0.2, leave.set).start()
    assert heard._thread.is_alive()
    heard.close()
    assert not heard._thread.is_alive()


def test_a_run_takes_them(server, tmp_path):
    heard = source(server)
    listen(heard, lambda row: "left" in row.values)
    for k in range(6):
        moment = datetime(2026, 1, 1, 0, 0, k, tzinfo=UTC)
        for name, value in (("left", 1.0), ("a", 0.7), ("b", 0.4)):
            server.write(name, value + 0.01 * k, moment=moment)
        time.sleep(0.2)  # the server looks at its values from time to time
    rows = listen(heard, lambda row: row.values.get("b") == 0.45)
    heard.close()
    run = live(tmp_path, Rows([row.values for row in rows]))
    run.feed.intake.origin = None
    run.run()
    assert [record.t for record in run.journal] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    run.journal.close()


def test_what_cannot_be_reached_is_one_sentence(server):
    with pytest.raises(lp.DataError, match="node 'ns=2;s=none': BadNodeIdUnknown"):
        OpcuaSource(server.url, {"ns=2;s=none": "x", "ns=2;s=a": "a"}, "t")
    with pytest.raises(lp.DataError, match="not a node"):
        OpcuaSource(server.url, {"not a node": "x"}, "t")
    source(server, username="operator", password="right").close()
    with pytest.raises(lp.DataError, match="BadUserAccessDenied") as refused:
        source(server, username="operator", password="wrong")
    assert "wrong" not in str(refused.value)
    with pytest.raises(lp.DataError, match="use username instead"):
        OpcuaSource("opc.tcp://me:secret@localhost:4840", COLUMNS, "t")
    with pytest.raises(lp.DataError, match="interval must be"):
        OpcuaSource(server.url, COLUMNS, "t", interval=0.0)
    server.stop()
    with pytest.raises(lp.DataError, match=r"opc.tcp://127.0.0.1.*failed"):
        source(server)
