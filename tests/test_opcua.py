"""Changes on a real OPC UA server arrive as rows, also after the server was unavailable."""

import asyncio
import logging
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from certificates import certificate
from live_rod import live, rows
from patience import PATIENCE
from ports import kept_port

import livepde as lp
from benchmarks.faults.rod import case_text as rod_case
from livepde.cases import load
from livepde.cases.data import publishers_of
from livepde.streams.opcua import OpcuaServer, OpcuaSink, OpcuaSource
from livepde.streams.sources import Row, Rows, drained

pytestmark = pytest.mark.broker

pytest.importorskip("asyncua")
COLUMNS = {"ns=2;s=a": "a", "ns=2;s=b": "b", "ns=2;s=left": "left"}


class Server:
    """A server with three values, in a thread of its own."""

    def __init__(self, certificate: Path | None = None, key: Path | None = None) -> None:
        self.files = certificate, key
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
        kinds = ua.SecurityPolicyType
        self.server.set_security_policy([kinds.NoSecurity])
        if self.files != (None, None):
            self.server.set_security_policy([kinds.Basic256Sha256_SignAndEncrypt])
            await self.server.load_certificate(self.files[0])
            await self.server.load_private_key(self.files[1])
        space = await self.server.register_namespace("plant")
        self.nodes = {}
        for name in ("a", "b", "left"):
            node = ua.NodeId(name, space)
            self.nodes[name] = await self.server.nodes.objects.add_variable(node, name, 0.0)
        for name, value in (("alpha", 0.0), ("alpha_std", 0.0), ("verdict", ""), ("count", 0)):
            node = ua.NodeId(name, space)
            self.nodes[name] = await self.server.nodes.objects.add_variable(node, name, value)
            await self.nodes[name].set_writable()
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

    def read(self, name: str):
        return self._do(self.nodes[name].read_value())

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
    for name in ("a", "b", "left"):
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
    return OpcuaSource(OpcuaServer(server.url, **options), COLUMNS, "t", interval=0.05)


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
        OpcuaSource(OpcuaServer(server.url), {"ns=2;s=none": "x", "ns=2;s=a": "a"}, "t")
    with pytest.raises(lp.errors.DataError, match="not a node"):
        OpcuaSource(OpcuaServer(server.url), {"not a node": "x"}, "t")
    source(server, username="operator", password="right").close()
    with pytest.raises(lp.errors.DataError, match="BadUserAccessDenied") as refused:
        source(server, username="operator", password="wrong")
    assert "wrong" not in str(refused.value)
    with pytest.raises(lp.errors.DataError, match="use `username` instead"):
        OpcuaSource(OpcuaServer("opc.tcp://me:secret@localhost:4840"), COLUMNS, "t")
    with pytest.raises(lp.errors.DataError, match="interval must be"):
        OpcuaSource(OpcuaServer(server.url), COLUMNS, "t", interval=0.0)
    server.stop()
    with pytest.raises(lp.errors.DataError, match=r"opc.tcp://127.0.0.1.*failed"):
        source(server)


# --- estimates that are written back -------------------------------------------------------------

WRITTEN = {"ns=2;s=alpha": "k", "ns=2;s=alpha_std": "k_std", "ns=2;s=verdict": "verdict"}


def written(server, wanted) -> None:
    until = time.monotonic() + PATIENCE
    while not wanted() and time.monotonic() < until:
        time.sleep(0.05)
    assert wanted()


def test_estimates_are_written_to_nodes(server, tmp_path):
    sink = OpcuaSink(OpcuaServer(server.url), WRITTEN)
    wrong = ({**row, "a": 0.7 * row["left"], "b": 0.4 * row["left"]} for row in rows(12))
    run = live(tmp_path, Rows(wrong), sinks=[sink])
    run.run()
    last = [record.numbers for record in run.journal][-1]
    sink.close()  # writes the newest one
    value, std = sink_numbers = server.read("alpha"), server.read("alpha_std")
    assert sink_numbers != (0.0, 0.0)
    assert value in last
    assert std > 0.0
    assert server.read("verdict") == "do not trust"  # k is at the limit of its prior
    run.journal.close()


def test_estimates_are_written_after_the_server_was_away(server, tmp_path):
    kept = []
    run = live(tmp_path, Rows(rows(3)), sinks=[SimpleNamespace(put=kept.append)])
    run.run()
    run.journal.close()
    sink = OpcuaSink(OpcuaServer(server.url), WRITTEN)
    server.stop()
    sink.put(kept[0])
    sink.put(kept[-1])
    server.start()
    written(server, lambda: server.read("alpha") == kept[-1].parameters["k"][0])
    sink.close()
    assert not sink._thread.is_alive()


def test_what_cannot_be_written_is_one_sentence(server, tmp_path):
    for node, name, why in (
        ("ns=2;s=none", "k", "node 'ns=2;s=none': .*BadNodeIdUnknown"),
        ("ns=2;s=a", "k", "node 'ns=2;s=a': expected a number .* may write"),  # read only
        ("ns=2;s=count", "k", "expected a number"),
        ("ns=2;s=alpha", "verdict", "expected a text"),
    ):
        with pytest.raises(lp.errors.DataError, match=why):
            OpcuaSink(OpcuaServer(server.url), {node: name})
    sink = OpcuaSink(OpcuaServer(server.url), {"ns=2;s=alpha": "beta"})
    run = live(tmp_path, Rows(rows(3)), sinks=[sink])
    run.run()
    sink.close()
    (event,) = [event for event in run.journal.events if event.kind == "sink"]
    assert "got 'beta' to write; there are verdict, k, k_std" in event.message
    assert len(run.journal) == 3
    run.journal.close()


# --- encrypted messages --------------------------------------------------------------------------


def test_certificates_are_next_to_the_case(tmp_path, monkeypatch):
    path, security = tmp_path / "case.toml", "Basic256Sha256,Sign,a.pem,b.pem"
    nodes = 'url = "opc.tcp://plant:4840", columns = { "ns=2;s=alpha" = "alpha" }, username = "me"'
    path.write_text(f'{rod_case()}opcua = {{ {nodes}, security = "{security}" }}\n')
    monkeypatch.setattr("livepde.streams.opcua.OpcuaSink", lambda *given: given)
    ((server, columns),) = publishers_of(load(path), {"output.opcua": "secret"})
    assert columns == {"ns=2;s=alpha": "alpha"}
    files = f"{tmp_path / 'a.pem'},{tmp_path / 'b.pem'}"
    expected = f"Basic256Sha256,Sign,{files}"
    assert server == OpcuaServer("opc.tcp://plant:4840", "me", "secret", expected)
    assert "secret" not in repr(server)
    for wrong in ("Basic128Rsa15,Sign,a,b", "Basic256Sha256,None,a,b", "Basic256Sha256,Sign,a"):
        path.write_text(f'{rod_case()}opcua = {{ {nodes}, security = "{wrong}" }}\n')
        with pytest.raises(lp.errors.CaseError, match=r"output.opcua.security"):
            load(path)


def test_a_node_for_a_number_that_no_run_has_is_refused_before_the_run(tmp_path):
    path = tmp_path / "case.toml"
    nodes = 'url = "opc.tcp://plant:4840", columns = { "ns=2;s=alpha" = "alfa_std" }'
    path.write_text(f"{rod_case()}opcua = {{ {nodes} }}\n")
    why = r"output.opcua.columns.'ns=2;s=alpha': a run has no number 'alfa_std'.*alpha_std"
    with pytest.raises(lp.errors.CaseError, match=why):
        load(path)


@pytest.mark.slow
def test_messages_are_encrypted_and_the_server_is_known_by_its_certificate(tmp_path):
    theirs = certificate(tmp_path, "plant", "urn:freeopcua:python:server")
    ours = certificate(tmp_path, "run", "urn:livepde:run")
    other = certificate(tmp_path, "other", "urn:other")
    nameless = certificate(tmp_path, "nameless", "")
    encrypted = Server(*theirs)
    try:
        with pytest.raises(lp.errors.DataError):
            source(encrypted)  # the server has no other policy
        policy = "Basic256Sha256,SignAndEncrypt"
        text = ",".join([policy, *map(str, (*ours, theirs[0]))])
        heard = source(encrypted, security=text)
        encrypted.write("a", 1.5)
        listen(heard, lambda row: row.values.get("a") == 1.5)
        heard.close()
        with pytest.raises(lp.errors.DataError):  # a server of another certificate
            source(encrypted, security=",".join([policy, *map(str, (*ours, other[0]))]))
        with pytest.raises(lp.errors.DataError, match="names no application"):
            source(encrypted, security=",".join([policy, *map(str, nameless)]))
        with pytest.raises(lp.errors.DataError, match="No such file"):
            source(encrypted, security=f"{policy},{tmp_path / 'none.pem'},{ours[1]}")
    finally:
        encrypted.close()
