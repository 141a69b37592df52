"""`livepde run` as a process that can be killed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.faults.damage import Found
from benchmarks.faults.plants import (
    PATIENCE,
    GrowingFile,
    Mosquitto,
    Topic,
    launched,
    wait,
)
from benchmarks.faults.rod import Row, case_text, rod_rows
from livepde.errors import RunError
from livepde.runs import JOURNAL, Journal
from livepde.runs.database import log_of


class Run:
    """`livepde run` of the case in a folder, as a process that can be killed.

    Parameters
    ----------
    folder, source
        Where it runs, and the lines of its case that name the source.
    launch
        Starts the command.
    options, wrapper
        What comes after its command, and before it.
    codes
        With which it may end by itself.
    """

    def __init__(
        self,
        folder: Path,
        source: str,
        launch: Callable[[Sequence[str], Path], subprocess.Popen[bytes]] = launched,
        *,
        options: Sequence[str] = (),
        wrapper: Sequence[str] = (),
        codes: Sequence[int] = (0, -signal.SIGKILL),
    ) -> None:
        self.folder = folder
        self._options, self._wrapper, self._codes = options, wrapper, codes
        self._launch = launch
        self.out = folder / "run"
        self._journal: Journal | None = None
        self._process: subprocess.Popen[bytes] | None = None
        (folder / "case.toml").write_text(case_text(source))

    def start(self) -> None:
        command = [sys.executable, "-m", "livepde", "run", "case.toml", "--out", "run", "--resume"]
        self._process = self._launch([*self._wrapper, *command, *self._options], self.folder)

    def look(self) -> int:
        """Return how many samples are accepted; a reader is open all the time."""
        if self._journal is None and (self.out / JOURNAL).exists():
            self._journal = Journal.open(self.out / JOURNAL)
        return 0 if self._journal is None else self._journal.accepted

    def estimated(self) -> int:
        """Return how many samples have been estimated."""
        self.look()
        return 0 if self._journal is None else len(self._journal)

    def counted(self, kind: str) -> int:
        """Return how many remarks of a kind the journal has."""
        self.look()
        counts = {} if self._journal is None else self._journal.counts
        return sum(number for (what, _), number in counts.items() if what == kind)

    @property
    def log_size(self) -> int:
        """Bytes of the journal's write-ahead log."""
        log = log_of(self.out / JOURNAL)
        return log.stat().st_size if log.exists() else 0

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process that was started last."""
        if self._process is None:
            raise RunError("benchmark faults: nothing was started.")
        return self._process

    def alive(self) -> bool:
        """Return whether it runs; one that has ended by itself is an error."""
        code = self.process.poll()
        if code is not None and code not in self._codes:
            told = (self.folder / "log.txt").read_text()[-2000:]
            raise RunError(f"benchmark faults: a run ended with code {code}:\n{told}")
        return code is None

    def signal(self, number: int) -> bool:
        """Send a signal; return whether there was still somebody to hear it."""
        if not self.alive():
            return False
        self.process.send_signal(number)
        return True

    def kill(self) -> bool:
        """Kill it; return whether it was still there."""
        there = self.signal(signal.SIGKILL)
        return self.process.wait() == -signal.SIGKILL and there

    def wait_for(self, samples: int) -> None:
        """Wait until so many samples have been estimated."""

        def enough() -> bool:
            self.alive()
            return self.estimated() >= samples

        wait(enough, f"a run did not take {samples} samples")

    def wait_for_event(self, kind: str, number: int) -> None:
        """Wait until something has happened so often."""

        def happened() -> bool:
            self.alive()
            self.look()
            events = () if self._journal is None else self._journal.events
            return sum(event.kind == kind for event in events) >= number

        wait(happened, f"a run did not say {kind!r}")

    def end(self, samples: int) -> None:
        """Let it take all samples, and end it as a service is ended."""
        self.wait_for(samples)
        self.signal(signal.SIGTERM)
        self.process.wait(PATIENCE)
        self.alive()

    def close(self) -> None:
        """Leave nothing behind."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._journal is not None:
            self._journal.close()


@contextmanager
def hearing(rows: Sequence[Row], saved: bool = False) -> Iterator[tuple[Mosquitto, Topic, Run]]:
    """Yield a broker, a topic that has rows, and a run that hears it."""
    with TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name) / "mqtt"
        folder.mkdir()
        broker = Mosquitto(Path(name), saved)
        stack.callback(broker.close)
        topic = stack.enter_context(closing(Topic(broker, rows, "rod")))
        run = stack.enter_context(closing(Run(folder, topic.source)))
        run.start()
        yield broker, topic, run


def undisturbed_journal(folder: Path, count: int) -> Path:
    """Return the journal of a run in a folder that nobody disturbs."""
    plant = GrowingFile(folder, rod_rows(count), 0)
    plant.supply(count)
    with closing(Run(folder, plant.source)) as run:
        run.start()
        run.end(count)
    path = folder / "run" / JOURNAL
    Journal.open(path, write=True).close()  # all in one file: nothing is left in the log
    return path


@cache
def undisturbed(count: int) -> tuple[Found, float]:
    """Return what a run finds that nobody disturbs, and the seconds until its first sample."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        plant = GrowingFile(folder, rod_rows(count), 0)
        plant.supply(count)
        with closing(Run(folder, plant.source)) as run:
            begun = time.monotonic()
            run.start()
            wait(lambda: run.alive() and run.look() > 0, "a run did not begin")
            start = time.monotonic() - begun
            run.end(count)
        return Found.of(folder / "run"), start
