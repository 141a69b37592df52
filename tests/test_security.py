"""Foreign files are never executed, excessive input is refused, requests need authorisation."""

import hashlib
import http.client
import io
import json
import pickle
import shutil
import socket
import threading
import time
import tomllib
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from factories import short_rod
from live_rod import identifier, live, rows
from patience import PATIENCE
from typer.testing import CliRunner
from waitress import parser

import livepde as lp
from livepde import cases, checkpoint, runs
from livepde.atomic_write import replacing, write_bytes
from livepde.cli import app
from livepde.runs import RunWriter, visitors
from livepde.runs.monitor import Metrics, Monitor
from livepde.runs.visitors import IN_MEMORY, LONGEST_BODY, THREADS
from livepde.runs.web import Address, Server
from livepde.streams.clock import Clock
from livepde.streams.growing_file import LONGEST
from livepde.streams.intake import Intake
from livepde.streams.sources import Follow, Lines, Rows
from livepde.streams.table import Column

TOKEN = "long-enough-to-be-a-token"


# --- no foreign code is executed -----------------------------------------------------------------


class Hostile:
    """Object whose unpickling creates a file."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self):
        return (Path.touch, (self.trace,))


def test_the_hostile_object_would_be_run(tmp_path):
    pickle.loads(pickle.dumps(Hostile(tmp_path / "trace")))
    assert (tmp_path / "trace").exists()


def forged(described: object, numbers: bytes = b"", header: object = None) -> bytes:
    """Return a forged checkpoint with a valid digest."""
    text = json.dumps([header or {}, described]).encode()
    body = text + bytes(-len(text) % checkpoint.ALIGNED) + numbers
    digest = hashlib.blake2b(body, digest_size=checkpoint.DIGEST).digest()
    return checkpoint.START.pack(checkpoint.MAGIC, len(text), digest) + body


def test_a_checkpoint_is_not_unpickled(tmp_path):
    trace, path = tmp_path / "trace", tmp_path / "checkpoint.bin"
    who = identifier()
    hostile = pickle.dumps(Hostile(trace))
    for content in (hostile, forged([["z", "|O", [1]]], hostile.ljust(1024))):
        path.write_bytes(content)
        with pytest.raises(lp.errors.RunError, match="not a checkpoint"):
            who.load(path)
    assert not trace.exists()
    with pytest.raises(TypeError, match="numbers and texts"):
        checkpoint.packed({}, {"z": np.array([Hostile(trace)], dtype=object)})


@pytest.mark.parametrize(
    "described",
    [
        [["z", "<f8", [10**13]]],  # more than the file contains
        [["z", "<f8", [10**40, 10**40]]],
        [["z", "<f8", [-1]]],
        [["z", "<f8", ["many"]]],
        [["z", "no type", [1]]],
        [["z", "<f8"]],
        "nothing",
    ],
)
def test_a_checkpoint_with_a_false_size_or_type_is_refused(described):
    with pytest.raises(lp.errors.RunError, match="not a checkpoint"):
        checkpoint.unpacked(forged(described, bytes(16)), "it")


def test_an_array_keeps_type_and_shape_in_a_checkpoint():
    leaves = {
        "a": np.arange(6.0).reshape(2, 3).T,
        "b": np.array(True),
        "c": np.array("text"),
        "d": np.zeros((0, 4), dtype=np.int64),
        "e": np.array([1.0 + 2.0j]),
    }
    header, found = checkpoint.unpacked(checkpoint.packed({"kind": "any"}, leaves), "it")
    assert header == {"kind": "any"}
    assert list(found) == list(leaves)
    for name, array in leaves.items():
        assert found[name].dtype == array.dtype
        assert np.array_equal(found[name], array)
        found[name][...] = array  # it is writable


def test_a_damaged_checkpoint_is_refused_with_one_sentence():
    whole = bytearray(identifier().dump())
    rng = np.random.default_rng(0)
    who, refused = identifier(), 0
    for _ in range(300):
        content = bytearray(whole)
        for place in rng.integers(0, len(content), 3):
            content[place] = rng.integers(0, 256)
        if rng.random() < 0.3:
            del content[int(rng.integers(0, len(content))) :]
        try:
            who.restore(bytes(content))
        except lp.errors.RunError:
            refused += 1
    assert refused > 250


CODE = 'from pathlib import Path\nPath("trace").touch()\ndef equation(*_, **__): return None\n'


@pytest.fixture(scope="module")
def a_run(tmp_path_factory):
    """Provide the folder of a case and its run."""
    folder = tmp_path_factory.mktemp("run")
    case = short_rod(folder / "mycase", 21)
    assert call("run", str(case), "--out", str(folder / "run"))[0] == 0
    return folder


@pytest.fixture
def hostile(a_run, tmp_path, monkeypatch):
    """Provide a run directory from someone else, with a case that names code."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(a_run, tmp_path, dirs_exist_ok=True)
    folder = tmp_path / "run"
    text = (folder / "case.toml").read_text()
    equation = tomllib.loads(text)["equation"]
    (folder / "case.toml").write_text(text.replace(f'"{equation}"', '"evil.py:equation"'))
    assert "evil.py" in (folder / "case.toml").read_text()
    # An attacker recomputes the digests.
    digest = hashlib.sha256((folder / "case.toml").read_bytes()).hexdigest()
    record = runs.open(folder).record | {"case_copy_sha256": digest}
    runs.RunWriter(folder, record)._save_record()
    for place in (folder, tmp_path, tmp_path / "mycase"):
        (place / "evil.py").write_text(CODE)
    return folder


def call(*arguments: str) -> tuple[int, str]:
    """Run a command; return its exit code and output."""
    result = CliRunner().invoke(app, list(arguments))
    if isinstance(result.exception, lp.LivepdeError):
        return 2, str(result.exception)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.output


@pytest.mark.slow
def test_a_foreign_run_directory_executes_no_code(hostile):
    trace = Path("trace")
    assert call("report", str(hostile))[0] == 0
    code, text = call("report", str(hostile), "--theory")
    assert code == 2
    assert "add --allow-code" in text
    code, text = call("run", str(hostile / "case.toml"), "--out", str(hostile), "--resume")
    assert code == 2
    assert "add --allow-code" in text
    assert runs.open(hostile).dataset.sizes["time"] > 0
    assert not trace.exists()
    code, text = call("run", str(hostile / "case.toml"), "--out", "another", "--allow-code")
    assert trace.exists()  # with permission the code runs


@pytest.mark.slow
def test_a_report_is_not_written_through_a_link(hostile, tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (hostile / "report.md").unlink()
    (hostile / "report.md").symlink_to(mine)
    assert call("report", str(hostile)) == (
        2,
        f"{hostile / 'report.md'} is a link: data written to it would go elsewhere.",
    )
    assert mine.read_text() == "mine"


@pytest.mark.slow
def test_a_case_cannot_allow_its_own_code(hostile):
    path = hostile / "case.toml"
    path.write_text("allow_code = true\n" + path.read_text())
    with pytest.raises(lp.errors.CaseError, match="allow_code"):
        cases.load(path)
    assert not Path("trace").exists()


# --- excessive input -----------------------------------------------------------------------------


def test_a_long_case_is_refused(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text("#" * 1_000_001)
    with pytest.raises(lp.errors.CaseError, match="longer than 1000000 bytes"):
        cases.load(path)
    path.write_text("a = " + "[" * 100_000)
    with pytest.raises(lp.errors.CaseError, match="not valid TOML"):
        cases.load(path)


def test_a_long_record_is_refused(tmp_path):
    path = tmp_path / "run.json"
    path.write_text('{"format": 1, "title": "' + "x" * 10_000_000 + '"}')
    with pytest.raises(lp.errors.RunError, match="longer than"):
        runs.open(tmp_path)
    for text in (b"[" * 100_000, b"{", b"[]", b'{"format": "1"}', b"\xff"):
        path.write_bytes(text)
        with pytest.raises(lp.errors.RunError, match=r"run\.json"):
            runs.open(tmp_path)


def test_long_lines_are_refused_and_the_next_one_is_read(tmp_path):
    long = '{"t": 0, "a": "' + "x" * (2 * LONGEST) + '"}\n'
    good = '{"t": 1, "a": 2}\n'
    path = tmp_path / "data.jsonl"
    path.write_text(long + good)
    source = Follow(path)
    first, second = source.poll(0.0)
    source.close()
    assert "longer than" in first.broken
    assert len(first.values) == 0
    assert second.values == {"t": 1, "a": 2}
    table = tmp_path / "data.csv"
    table.write_text("t,a\n" + "1," * LONGEST + "\n3,4\n")
    source = Follow(table)
    first, second = source.poll(0.0)
    source.close()
    assert "longer than" in first.broken
    assert second.values == {"t": "3", "a": "4"}
    piped = Lines(io.TextIOWrapper(io.BytesIO((long + good).encode() + b"\xff\xfe\n" + b"5\n")))
    rows = []
    while not piped.done:
        rows += piped.poll(5.0)
    assert [row.values for row in rows if not row.broken] == [{"t": 1, "a": 2}]
    assert sum("longer than" in row.broken for row in rows) >= 1
    assert any("UnicodeDecodeError" in row.broken for row in rows)


@pytest.mark.long
def test_an_event_truncates_long_text(tmp_path):
    row = {"t": "x" * 500_000, "a": 1.0}
    run = live(tmp_path, Rows([row, *rows(2)]))
    run.run()
    (event,) = run.journal.events
    assert event.kind == "malformed"
    assert len(event.message) < 1000
    run.journal.close()


@pytest.mark.parametrize("value", [10**400, "9" * 5000, [1], {}, True, "2026-01-01T00:00:00+99:99"])
def test_invalid_values_are_refused(value):
    intake = Intake({"a": Column(("a",))}, Clock("t"))
    assert {r.kind for r in intake.take({"t": value, "a": 1.0}).remarks} == {"malformed"}
    if not isinstance(value, str):
        assert {r.kind for r in intake.take({"t": 1.0, "a": value}).remarks} >= {"malformed"}


# --- authorisation -------------------------------------------------------------------------------


def hello(environ, start):
    start("200 OK", [("Content-Type", "text/plain")])
    return [b"hello"]


@pytest.fixture
def serving():
    opened = []

    def serve(**address) -> Server:
        opened.append(Server(hello, Address(**address)))
        return opened[-1]

    yield serve
    for server in opened:
        server.close()


def ask(server, path="/", **headers) -> tuple[int, str, http.client.HTTPMessage]:
    """Send a request; return status code, content and headers."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text, answer.headers


@pytest.mark.slow
def test_a_local_server_only_answers_requests_to_its_own_names(serving):
    server = serving()
    for host in ("localhost", "127.0.0.1", f"127.0.0.1:{server.port}", "[::1]", "127.9.9.9"):
        assert ask(server, Host=host)[0] == 200
    for host in ("rebound.example", "127.0.0.1.example", "localhost.example", "0.0.0.0", "", "::"):
        assert ask(server, Host=host)[0] == 403


@pytest.mark.slow
def test_a_token_opens_once_and_sets_a_cookie(serving):
    server = serving(token=TOKEN)
    code, text, headers = ask(server)
    assert code == 403
    assert TOKEN not in text + str(headers)
    assert ask(server, f"/?token={TOKEN[:-1]}")[0] == 403
    assert ask(server, "/?token=")[0] == 403
    assert ask(server, Authorization="Bearer ")[0] == 403
    assert ask(server, Authorization=f"Bearer {TOKEN}x")[0] == 403
    assert ask(server, Cookie="livepde_token=; livepde_token")[0] == 403
    assert ask(server, Cookie=f"another={TOKEN}")[0] == 403
    assert ask(server, Authorization=f"Bearer {TOKEN}")[0] == 200
    code, _, headers = ask(server, f"/?token={TOKEN}", Host="anything.example")
    assert code == 200
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert ask(server, Cookie=cookie.partition(";")[0])[0] == 200
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.slow
def test_a_server_for_other_machines_creates_a_token(serving):
    one, other = Address("0.0.0.0"), Address("0.0.0.0")
    assert len(one.token) >= 32
    assert one.token != other.token
    assert one.token not in repr(one)
    server = serving(host="0.0.0.0")
    assert ask(server)[0] == 403
    with urllib.request.urlopen(
        server.url.replace("0.0.0.0", "127.0.0.1"), timeout=PATIENCE
    ) as answer:
        assert answer.status == 200
    assert server.shown == server.url  # only the server can show it


@pytest.mark.parametrize(
    ("host", "token"),
    [("0.0.0.0", "short"), ("127.0.0.1", "a b"), ("127.0.0.1", "a;b"), ("127.0.0.1", "a\nb: c")],
)
def test_invalid_tokens_are_refused(host, token):
    with pytest.raises(lp.errors.RunError, match="token"):
        Address(host, token=token)


@pytest.mark.long
def test_a_given_token_is_shown_nowhere(serving, tmp_path, monkeypatch, logs):
    server = serving(token=TOKEN)
    assert TOKEN in server.url
    assert TOKEN not in server.shown
    monkeypatch.chdir(tmp_path)
    call("init", "mycase")
    monkeypatch.setattr("sys.argv", ["livepde", "run", "--token", TOKEN, f"--token={TOKEN}", "x"])
    options = ("--realtime", "--speed", "inf", "--listen", "0", "--token", TOKEN, "--out", "run")
    code, text = call("run", "mycase/case.toml", *options)
    assert code == 0, text
    assert "health and metrics at http://127.0.0.1" in text
    assert TOKEN not in text
    for path in Path("run").iterdir():
        assert TOKEN.encode() not in path.read_bytes()
    assert json.loads(Path("run/run.json").read_text())["command"][2:5] == [
        "--token",
        "...",
        "--token=...",
    ]


@pytest.mark.slow
def test_requests_that_are_too_long_are_refused(serving):
    server = serving()
    assert ask(server, "/" + "x" * 20_000)[0] == 431
    assert ask(server, Long="x" * 20_000)[0] == 431
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    connection.putrequest("POST", "/")
    connection.putheader("Content-Length", str(LONGEST_BODY + 1))
    connection.endheaders()
    assert connection.getresponse().status == 413
    connection.close()
    assert ask(server)[0] == 200


@pytest.mark.slow
def test_serving_threads_do_not_keep_a_program_alive(serving):
    before = {*threading.enumerate()}
    server = serving()
    assert ask(server)[0] == 200
    begun = {*threading.enumerate()} - before
    assert len(begun) > THREADS
    assert all(thread.daemon for thread in begun)


@pytest.mark.slow
@pytest.mark.parametrize("token", ["", TOKEN])
def test_slow_clients_do_not_block_others(serving, monkeypatch, token):
    """Many more slow clients than threads do not block a thread."""
    monkeypatch.setattr(visitors, "DEADLINE", 2)
    server = serving(token=token)
    slow = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(4 * THREADS)]
    for k, one in enumerate(slow):
        line = b"GET / HTTP/1.1\r\n", b"POST / HTTP/1.1\r\nContent-Length: 9\r\nHost: a\r\n\r\n"
        one.sendall(line[k % 2])
    for k in range(5):
        assert ask(server, Authorization=f"Bearer {token}")[0] == 200
        for one in slow[::2]:
            with suppress(OSError):  # the client's time may be over already
                one.sendall(b"X-%d: 1\r\n" % k)
    for one in slow:
        one.settimeout(PATIENCE)
        try:
            answer = one.recv(1000)
        except ConnectionResetError:
            answer = b""
        assert answer == b"" or b"403" in answer.split(b"\r\n")[0]  # their time is over
        one.close()
    assert ask(server, Authorization=f"Bearer {token}")[0] == 200


@pytest.mark.slow
def test_a_server_closes_while_an_answer_wakes_it(monkeypatch):
    """Answering threads use the same trigger, and any of its pulls may be the last one."""
    server = Server(hello, Address())
    assert ask(server)[0] == 200
    trigger = server._server.trigger
    pull = trigger._physical_pull

    def slowly() -> None:
        pull()
        server._thread.join(PATIENCE)
        pull()

    monkeypatch.setattr(trigger, "_physical_pull", slowly)
    server.close()
    assert not server._thread.is_alive()
    with pytest.raises(ConnectionRefusedError):
        ask(server)


@pytest.mark.slow
def test_an_unauthorised_client_gets_an_answer_for_any_body(serving):
    server = serving(token=TOKEN)
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    connection.putrequest("POST", "/")
    connection.putheader("Content-Length", "50000")
    connection.endheaders(b"a" * 50000)
    answer = connection.getresponse()
    assert answer.status == 403
    assert "token" in answer.read().decode()
    connection.close()


@pytest.mark.slow
@pytest.mark.parametrize("chunked", [False, True])
def test_bodies_of_unauthorised_clients_are_not_stored(serving, monkeypatch, chunked):
    """Bodies of many unauthorised clients would fill memory and disk."""
    kept: list[int] = []

    class Counting(parser.OverflowableBuffer):
        def append(self, data: bytes) -> None:
            kept.append(len(data))
            super().append(data)

    monkeypatch.setattr(parser, "OverflowableBuffer", Counting)
    server, body = serving(token=TOKEN), b"a" * 200_000
    for token, status, expected in (("wrong", 403, 0), (TOKEN, 200, len(body))):
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
        header = {"Authorization": f"Bearer {token}"}
        content = iter([body]) if chunked else body
        connection.request("POST", "/", content, header, encode_chunked=chunked)
        assert connection.getresponse().status == status
        assert sum(kept) == expected
        connection.close()


@pytest.mark.slow
def test_bodies_reach_the_page():
    """Short bodies, and one that exceeds the memory buffer, reach the page."""

    def size(environ, start):
        start("200 OK", [("Content-Type", "text/plain")])
        return [str(len(environ["wsgi.input"].read())).encode()]

    server = Server(size, Address())
    for length in (0, 10, IN_MEMORY + 100_000):
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
        for _ in range(2):  # the second request uses the same connection
            connection.request("POST", "/", b"a" * length)
            answer = connection.getresponse()
            assert (answer.status, answer.read()) == (200, str(length).encode())
        connection.close()
    server.close()


@pytest.mark.slow
def test_a_client_that_sends_a_long_body_slowly_is_disconnected(serving, monkeypatch):
    monkeypatch.setattr(visitors, "DEADLINE", 2)
    server = serving()
    one = socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE)
    length = IN_MEMORY + 1000
    head = f"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n"
    one.sendall(head.encode() + b"a" * (IN_MEMORY + 10))
    begun = time.monotonic()
    with pytest.raises(OSError, match=r"reset|Broken pipe"):  # noqa: PT012
        while time.monotonic() - begun < PATIENCE:
            one.sendall(b"a")
            time.sleep(0.2)
    one.close()


@pytest.mark.slow
def test_a_client_that_reads_a_long_answer_slowly_is_disconnected(monkeypatch):
    """A slow reader blocks a thread if the answer exceeds the server's buffer."""
    monkeypatch.setattr(visitors, "LONGEST", 1)
    ended, piece = threading.Event(), b"a" * 1_000_000

    def answer(environ, start):
        start("200 OK", [])
        try:
            for _ in range(40):
                yield piece
        finally:
            ended.set()

    server = Server(answer, Address())
    one = socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE)
    one.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    begun = time.monotonic()
    while not ended.is_set() and time.monotonic() - begun < PATIENCE:
        one.recv(10_000)
        time.sleep(0.1)
    assert ended.is_set()
    got = 0
    with suppress(ConnectionResetError):
        while content := one.recv(1_000_000):
            got += len(content)
    assert got < 40 * len(piece)
    one.close()
    server.close()


@pytest.mark.slow
def test_clients_beyond_the_limit_are_refused(serving, monkeypatch):
    monkeypatch.setattr(visitors, "ROOM", 5)
    server = serving()
    waiting = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(20)]
    for one in waiting:
        one.sendall(b"GET")
    assert ask(server)[0] == 200
    for one in waiting:
        one.close()


@pytest.mark.slow
def test_health_and_metrics_also_require_the_token():
    monitor = Monitor(Address(token=TOKEN), lambda: {"ok": True}, Metrics(["a"]))
    for path in ("/health", "/metrics", "/none"):
        assert ask(monitor, path)[0] == 403
        assert ask(monitor, path, Authorization=f"Bearer {TOKEN}")[0] in (200, 404)
    assert TOKEN not in monitor.shown
    monitor.close()


def test_nothing_is_written_through_links_in_a_foreign_directory(tmp_path):
    """Links with the names of temporary files are not followed; a run with links is refused."""
    run, victim = tmp_path / "run", tmp_path / "victim"
    victim.write_text("mine")
    options = {"version": "1", "case": "a = 1\n"}
    writer = RunWriter.create(run, command=["x"], title="A run", **options)
    names = ("run.json.partial", "estimates.nc.partial", "checkpoint.bin.partial", "report.md")
    for name in (*names, "estimates.nc", "checkpoint.bin", "overview.png", "case.toml"):
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to(victim)
    who = identifier()
    found = who.run([lp.Sample(row.pop("t"), row) for row in rows(3)]).to_xarray()
    figures = {"overview": lambda: lp.plots.figure()[0]}
    writer.finish(status="finished", dataset=found, identifier=who, figures=figures)
    assert victim.read_text() == "mine"
    for name in ("report.md", "estimates.nc", "checkpoint.bin", "overview.png", "run.json"):
        assert not (run / name).is_symlink()
    with pytest.raises(lp.errors.RunError, match="is a link"):
        RunWriter.reopen(run, command=["x"], settings=(), **options)


def test_a_temporary_file_cannot_be_preempted(tmp_path, monkeypatch):
    monkeypatch.setattr("livepde.atomic_write.secrets.token_hex", lambda size: "0")
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / "a.txt.0.partial").symlink_to(victim)
    with pytest.raises(FileExistsError):
        write_bytes(tmp_path / "a.txt", b"new")
    assert victim.read_text() == "mine"
    (tmp_path / "a.txt.0.partial").unlink()
    (tmp_path / "a.txt").symlink_to(victim)
    write_bytes(tmp_path / "a.txt", b"new", sync=True)
    assert (tmp_path / "a.txt").read_bytes() == b"new"
    assert victim.read_text() == "mine"
    with suppress(ZeroDivisionError), replacing(tmp_path / "a.txt") as partial:
        partial.write_text("half")
        _ = 1 // 0
    assert (tmp_path / "a.txt").read_bytes() == b"new"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.txt", "victim"]
