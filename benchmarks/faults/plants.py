"""Plants that supply rows to a run by a growing file, standard input, MQTT or OPC UA."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from benchmarks.faults.rod import STEP, Row
from livepde.errors import RunError

PATIENCE = 120.0  # time limit for a run to make progress, in seconds
BROKER = "/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin:/opt/homebrew/sbin"


class Plant(Protocol):
    """Supplies rows to a run."""

    source: str

    def supply(self, count: int) -> None:
        """Make the first `count` rows available."""

    def launch(self, command: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
        """Start a run in its folder."""
        return launched(command, folder)


def launched(
    command: Sequence[str],
    folder: Path,
    stdin: int | None = None,
    stdout: int = subprocess.DEVNULL,
) -> subprocess.Popen[bytes]:
    """Start a command in a folder, with its error output in log.txt."""
    with (folder / "log.txt").open("ab") as log:
        return subprocess.Popen(command, cwd=folder, stdin=stdin, stdout=stdout, stderr=log)


class GrowingFile(Plant):
    """Growing file; unless `whole`, its last line may be incomplete."""

    source = 'file = "rows.csv"\nfollow = true'

    def __init__(
        self, folder: Path, rows: Sequence[Row], seed: int = 0, whole: bool = False
    ) -> None:
        self.path = folder / "rows.csv"
        self._rng = np.random.default_rng(seed)
        self._whole = whole
        self._lines = [",".join(str(row.get(name, "")) for name in rows[0]) + "\n" for row in rows]
        self._text = ",".join(rows[0]) + "\n"
        self._count = 0
        self._written = 0

    def supply(self, count: int) -> None:
        whole = self._whole or len(self._lines) <= count
        self._text += "".join(self._lines[self._count : count])
        self._count = max(count, self._count)
        cut = 0 if whole else int(self._rng.integers(0, 40))
        end = max(len(self._text) - cut, self._written)
        with self.path.open("a") as file:
            file.write(self._text[self._written : end])
        self._written = end


class Feeder(Plant):
    """Program that writes rows to the standard input of a run, and reads its estimates.

    Rows up to the last printed estimate are stored by the run. A restarted run gets all rows that
    follow, and often some rows before.

    Attributes
    ----------
    first
        Index of the first row that was sent to the last started run.
    """

    source = ""
    OVERLAP = (0, 0, 1, 40, 400)  # numbers of rows that are sent again unnecessarily

    def __init__(self, folder: Path, rows: Sequence[Row], seed: int) -> None:
        self.first = 0
        self._lines = [json.dumps(row).encode() + b"\n" for row in rows]
        self._estimates = folder / "estimates.jsonl"
        self._rng = np.random.default_rng(seed)
        self._count = self._known = 0
        self._changed = threading.Condition()
        self._fed: subprocess.Popen[bytes] | None = None

    def launch(self, command: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
        """Start a run with a pipe to its standard input."""
        self._known = max(self._known, self._printed())
        self.first = max(self._known - int(self._rng.choice(self.OVERLAP)), 0)
        with self._estimates.open("wb") as out:
            command = [*command, "--realtime", "--data", "-", "--estimates"]
            process = launched(command, folder, subprocess.PIPE, out.fileno())
        self._feed(process)
        threading.Thread(target=self._pump, args=(process, self.first), daemon=True).start()
        return process

    def supply(self, count: int) -> None:
        """Send the first `count` rows as fast as they are read."""
        with self._changed:
            self._count = max(count, self._count)
            self._changed.notify_all()

    def close(self) -> None:
        """Stop sending rows."""
        self._feed(None)

    def _feed(self, process: subprocess.Popen[bytes] | None) -> None:
        with self._changed:
            self._fed = process
            self._changed.notify_all()

    def _printed(self) -> int:
        """Return the number of rows up to the last estimate that was printed as a whole line."""
        if not self._estimates.exists():
            return 0
        *lines, _ = self._estimates.read_bytes().split(b"\n")
        return round(json.loads(lines[-1])["t"] / STEP) + 1 if lines else 0

    def _pump(self, process: subprocess.Popen[bytes], k: int) -> None:
        """Write rows from index k, until another process is fed or the pipe is closed."""
        pipe = process.stdin
        if pipe is None:
            raise RunError("benchmark faults: a run has no standard input.")
        with suppress(OSError), pipe:
            while (end := self._asked_for(process, k)) > k:
                pipe.write(b"".join(self._lines[k:end]))
                pipe.flush()
                k = end

    def _asked_for(self, process: subprocess.Popen[bytes], k: int) -> int:
        """Wait for more than k supplied rows; return their number, 0 if another process is fed."""
        with self._changed:
            self._changed.wait_for(lambda: self._fed is not process or self._count > k)
            return self._count if self._fed is process else 0


class Topic(Plant):
    """MQTT topic of a broker that queues messages for disconnected clients."""

    def __init__(self, broker: Mosquitto, rows: Sequence[Row], name: str) -> None:
        from livepde.streams.mqtt import Broker, MqttSource

        self._topic, self._count = f"{name}/rows", 0
        self._messages = [json.dumps(row) for row in rows]
        self.source = (
            f'[data.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\nclient_id = "{name}"\n'
            f'rows = ["{self._topic}"]'
        )
        place = ("127.0.0.1", broker.port)
        MqttSource(Broker(*place, name), {self._topic: None}, "time").close()  # create a session
        self._client = Broker(*place, f"{name}-plant").client()
        Broker(*place, f"{name}-plant").connect(self._client)

    def supply(self, count: int) -> None:
        wait(self.connected, "the plant does not reach its broker")
        sent = [self.send(text) for text in self._messages[self._count : count]]
        for message in sent:
            message.wait_for_publish(PATIENCE)
        self._count = max(count, self._count)

    def connected(self) -> bool:
        """Return whether the plant is connected to the broker."""
        return bool(self._client.is_connected())

    def send(self, message: str | bytes) -> Any:
        return self._client.publish(self._topic, message, qos=1)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


class Nodes(Plant):
    """OPC UA server with one variable per channel and the times of the rows.

    Parameters
    ----------
    rows
        Rows to supply; the first row has all channels.
    """

    PERIOD = 0.05  # publishing interval of the server, in seconds
    AT_ONCE = 5  # rows written between two messages, fewer than the server's queue size

    def __init__(self, rows: Sequence[Row]) -> None:
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)
        self._rows, self._count = rows, 0
        self._names = [name for name in rows[0] if name != "time"]
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._url = f"opc.tcp://127.0.0.1:{probe.getsockname()[1]}/plant"
        columns = ", ".join(f'"ns=2;s={name}" = "{name}"' for name in self._names)
        self.source = (
            f'[data.opcua]\nurl = "{self._url}"\ninterval = "{self.PERIOD} s"\n'
            f"columns = {{ {columns} }}"
        )
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self._do(self._start())

    def supply(self, count: int) -> None:
        self._do(self._write(self._rows[self._count : count]))
        self._count = max(count, self._count)

    def close(self) -> None:
        """Stop the server."""
        self._do(self._server.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE)

    async def _start(self) -> None:
        from asyncua.server.server import Server

        ua: Any = import_module("asyncua.ua")
        self._server = Server()
        await self._server.init()
        self._server.set_endpoint(self._url)
        self._server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await self._server.register_namespace("plant")
        objects, nothing = self._server.nodes.objects, ua.StatusCodes.BadWaitingForInitialData
        self._nodes = {}
        for name in self._names:
            node = await objects.add_variable(ua.NodeId(name, space), name, 0.0)
            await node.write_value(ua.DataValue(StatusCode=ua.StatusCode(nothing)))
            self._nodes[name] = node
        await self._server.start()

    async def _write(self, rows: Sequence[Row]) -> None:
        ua: Any = import_module("asyncua.ua")
        for number, row in enumerate(rows, start=1):
            moment = datetime.fromisoformat(row["time"]).replace(tzinfo=UTC)
            for name in row.keys() & self._nodes.keys():
                value = ua.DataValue(ua.Variant(float(row[name])), SourceTimestamp=moment)
                await self._nodes[name].write_value(value)
            if number % self.AT_ONCE == 0 or number == len(rows):
                await self._sent()

    async def _sent(self) -> None:
        """Wait until the server has sent all values."""
        subscriptions = self._server.iserver.subscription_service.subscriptions
        while any(item._triggered_datachanges for item in subscriptions.values()):
            await asyncio.sleep(0.2 * self.PERIOD)


class Mosquitto:
    """MQTT broker in its own folder; with `saved`, sessions survive its restart.

    With `saved` it writes all sessions at each message, which dominates the cost.
    """

    def __init__(self, parent: Path, saved: bool = False) -> None:
        program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:{BROKER}")
        if program is None:
            raise RunError(
                "there is no MQTT broker: install mosquitto (Debian's package of that name), or "
                "leave it out with --only file --only malformed."
            )
        self._kept = socket.socket()  # reserves the port, also while the broker is stopped
        self._kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._kept.bind(("127.0.0.1", 0))
        self.port = int(self._kept.getsockname()[1])
        folder = parent / "broker"
        folder.mkdir()
        config = folder / "mosquitto.conf"
        text = f"listener {self.port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 0\n"
        if saved:
            text += f"persistence true\npersistence_location {folder}/\n"
            text += "autosave_interval 1\nautosave_on_changes true\n"
        config.write_text(text + ("user root\n" if os.geteuid() == 0 else ""))
        self._command = [program, "-c", str(config)]
        self.start()

    def start(self) -> None:
        """Start the broker, and wait until it listens."""
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

        def listens() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.port)) == 0

        wait(listens, "mosquitto does not listen")

    def stop(self) -> None:
        """Stop the broker; saved sessions stay on disk."""
        self._process.terminate()
        self._process.wait()

    def close(self) -> None:
        """Stop the broker, and release its port."""
        self.stop()
        self._kept.close()


def wait(what: Callable[[], bool], why: str, patience: float = PATIENCE) -> None:
    """Wait until `what()` is true; after `patience` seconds, raise `RunError` with text `why`."""
    end = time.monotonic() + patience
    while not what():
        if time.monotonic() > end:
            raise RunError(f"benchmark faults: {why}.")
        time.sleep(0.002)
