"""Processes of `livepde run` that can be killed, and undisturbed runs to compare with."""

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
        Folder of the run, and lines of its case that configure the data source.
    launch
        Function that starts the command.
    options, wrapper
        Arguments after the command, and before it.
    codes
        Exit codes that are no error.
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
        """Return the number of accepted samples; the journal stays open for reading."""
        if self._journal is None and (self.out / JOURNAL).exists():
            self._journal = Journal.open(self.out / JOURNAL)
        return 0 if self._journal is None else self._journal.accepted

    def estimated(self) -> int:
        """Return the number of samples with an estimate."""
        self.look()
        return 0 if self._journal is None else len(self._journal)

    def counted(self, kind: str) -> int:
        """Return the number of remarks of a kind in the journal."""
        self.look()
        counts = {} if self._journal is None else self._journal.counts
        return sum(number for (what, _), number in counts.items() if what == kind)

    @property
    def log_size(self) -> int:
        """Size of the journal's write-ahead log in bytes."""
        log = log_of(self.out / JOURNAL)
        return log.stat().st_size if log.exists() else 0

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The most recently started process."""
        if self._process is None:
            raise RunError("benchmark faults: nothing was started.")
        return self._process

    def alive(self) -> bool:
        """Return whether the process is running; raise `RunError` for an unexpected exit code."""
        code = self.process.poll()
        if code is not None and code not in self._codes:
            log = (self.folder / "log.txt").read_text()[-2000:]
            raise RunError(f"benchmark faults: a run ended with code {code}:\n{log}")
        return code is None

    def signal(self, number: int) -> bool:
        """Send a signal; return whether the process was still running."""
        if not self.alive():
            return False
        self.process.send_signal(number)
        return True

    def kill(self) -> bool:
        """Kill the process; return whether it was still running."""
        running = self.signal(signal.SIGKILL)
        return self.process.wait() == -signal.SIGKILL and running

    def wait_for(self, samples: int) -> None:
        """Wait until `samples` samples have an estimate."""

        def enough() -> bool:
            self.alive()
            return self.estimated() >= samples

        wait(enough, f"a run did not take {samples} samples")

    def wait_for_event(self, kind: str, number: int) -> None:
        """Wait until the journal has `number` events of a kind."""

        def happened() -> bool:
            self.alive()
            self.look()
            events = () if self._journal is None else self._journal.events
            return sum(event.kind == kind for event in events) >= number

        wait(happened, f"a run did not say {kind!r}")

    def end(self, samples: int) -> None:
        """Wait until all samples have an estimate, and stop the process by SIGTERM."""
        self.wait_for(samples)
        self.signal(signal.SIGTERM)
        self.process.wait(PATIENCE)
        self.alive()

    def close(self) -> None:
        """Kill the process, and close the journal."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._journal is not None:
            self._journal.close()


@contextmanager
def hearing(rows: Sequence[Row], saved: bool = False) -> Iterator[tuple[Mosquitto, Topic, Run]]:
    """Yield a broker, a topic with rows, and a run that subscribes to it."""
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
    """Run undisturbed in a folder, and return the path of the journal."""
    plant = GrowingFile(folder, rod_rows(count), 0)
    plant.supply(count)
    with closing(Run(folder, plant.source)) as run:
        run.start()
        run.end(count)
    path = folder / "run" / JOURNAL
    Journal.open(path, write=True).close()  # moves the write-ahead log into the file
    return path


@cache
def undisturbed(count: int) -> tuple[Found, float]:
    """Run undisturbed; return the results, and the seconds until the first sample."""
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
