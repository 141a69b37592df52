"""What brings rows to a run: a file that grows, and topics of a broker that can be stopped."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np

from benchmarks.faults.rod import Row
from livepde.errors import RunError

__all__ = [
    "BROKER",
    "PATIENCE",
    "GrowingFile",
    "Mosquitto",
    "Plant",
    "StandardInput",
    "Topic",
    "wait",
]

AGAIN = 6  # fewer rows than this are sent again that are kept already
PATIENCE = 120.0  # seconds after which a run that does not go on is given up
BROKER = "/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin:/opt/homebrew/sbin"


class Plant(Protocol):
    """Brings rows to a run."""

    source: str

    def supply(self, count: int) -> None:
        """Have the first so many rows there."""


class GrowingFile:
    """A file that grows, not always by whole lines."""

    source = 'file = "rows.csv"\nfollow = true'

    def __init__(self, folder: Path, rows: Sequence[Row], seed: int) -> None:
        self.path = folder / "rows.csv"
        self._rng = np.random.default_rng(seed)
        self._lines = [",".join(map(str, row.values())) + "\n" for row in rows]
        self._text = ",".join(rows[0]) + "\n"
        self._count = 0
        self._written = 0

    def supply(self, count: int) -> None:
        whole = len(self._lines) <= count
        self._text += "".join(self._lines[self._count : count])
        self._count = max(count, self._count)
        cut = 0 if whole else int(self._rng.integers(0, 40))
        end = max(len(self._text) - cut, self._written)
        with self.path.open("a") as file:
            file.write(self._text[self._written : end])
        self._written = end


class StandardInput:
    """Rows as lines of JSON to standard input: a new process is sent again what it has not kept.

    And some rows that it has, as of a feeder that knows the last stored time not quite.
    """

    source = ""

    def __init__(self, rows: Sequence[Row], seed: int) -> None:
        self._lines = [(json.dumps(row) + "\n").encode() for row in rows]
        self._rng = np.random.default_rng(seed)
        self._stream: IO[bytes] | None = None
        self._count = self._sent = 0
        self.twice = 0  # rows that the process of now was sent although they are kept

    def connect(self, stream: IO[bytes], stored: int) -> None:
        """Begin with a new process, whose journal has so many rows."""
        self.close()
        self._stream = stream
        self.twice = min(int(self._rng.integers(1, AGAIN)), stored)
        self._sent = stored - self.twice
        self.supply(0)

    def supply(self, count: int) -> None:
        self._count = max(count, self._count)
        if self._stream is None:
            return
        with suppress(BrokenPipeError):  # it was killed
            self._stream.write(b"".join(self._lines[self._sent : self._count]))
            self._stream.flush()
        self._sent = self._count

    def close(self) -> None:
        """Let go of the last process."""
        if self._stream is not None:
            with suppress(BrokenPipeError):
                self._stream.close()
        self._stream = None


class Topic:
    """Messages of a broker that keeps them for who is away."""

    def __init__(self, broker: Mosquitto, rows: Sequence[Row], name: str) -> None:
        from livepde.streams.mqtt import Broker, MqttSource

        self._topic, self._count = f"{name}/rows", 0
        self._messages = [json.dumps(row) for row in rows]
        self.source = (
            f'[data.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\nclient_id = "{name}"\n'
            f'rows = ["{self._topic}"]'
        )
        place = ("127.0.0.1", broker.port)
        MqttSource(Broker(*place, name), {self._topic: None}, "time").close()  # a session
        self._client = Broker(*place, f"{name}-plant").client()
        Broker(*place, f"{name}-plant").connect(self._client)

    def supply(self, count: int) -> None:
        wait(self.connected, "the plant does not reach its broker")
        sent = [self.send(text) for text in self._messages[self._count : count]]
        for message in sent:
            message.wait_for_publish(PATIENCE)
        self._count = max(count, self._count)

    def connected(self) -> bool:
        """Return whether it reaches the broker."""
        return bool(self._client.is_connected())

    def send(self, message: str | bytes) -> Any:
        return self._client.publish(self._topic, message, qos=1)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


class Mosquitto:
    """A broker of its own, with sessions that survive its restart, in a folder of its own."""

    def __init__(self, parent: Path) -> None:
        program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:{BROKER}")
        if program is None:
            raise RunError(
                "there is no MQTT broker: install mosquitto (Debian's package of that name), or "
                "leave it out with --only file --only malformed."
            )
        self._kept = socket.socket()  # keeps the port for the broker, also while it is away
        self._kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._kept.bind(("127.0.0.1", 0))
        self.port = int(self._kept.getsockname()[1])
        folder = parent / "broker"
        folder.mkdir()
        config = folder / "mosquitto.conf"
        user = "user root\n" if os.geteuid() == 0 else ""
        config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_location {folder}/\nautosave_interval 1\nautosave_on_changes true\n"
            f"max_queued_messages 0\n{user}"
        )
        self._command = [program, "-c", str(config)]
        self.start()

    def start(self) -> None:
        """Start it and wait until it listens."""
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

        def listens() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.port)) == 0

        wait(listens, "mosquitto does not listen")

    def stop(self) -> None:
        """Stop it; what it keeps is on disk."""
        self._process.terminate()
        self._process.wait()

    def close(self) -> None:
        """Stop it for good."""
        self.stop()
        self._kept.close()


def wait(what: Callable[[], bool], why: str, patience: float = PATIENCE) -> None:
    """Wait until something is so; raises `RunError` that says why it is not."""
    end = time.monotonic() + patience
    while not what():
        if time.monotonic() > end:
            raise RunError(f"benchmark faults: {why}.")
        time.sleep(0.002)
