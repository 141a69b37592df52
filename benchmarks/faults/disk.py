"""Disks that are full or fail for a while during a run."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.faults.damage import Damage, Found
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import PATIENCE, GrowingFile, wait
from benchmarks.faults.rod import Row, rod_rows
from benchmarks.faults.run import Run, undisturbed
from livepde.runs import JOURNAL, Check, Outcome, Table
from livepde.runs.database import log_of

FILLED = 4  # how often the disk is full
SAID = "cannot be written"  # text that /health then contains
BAD_INPUT = 2  # exit code
SIZES = [2**k for k in (14, 16, 18)]  # limits of the file size while a run ends, in bytes
LIMIT = 10  # largest number of processes in one trial
CALLS = {  # failure -> name of the failure point, error number, probability per call
    "writes of the journal, disk full": ("posix/io/rw/pwrite", 28, 0.005),
    "writes of the journal, input/output error": ("posix/io/rw/pwrite", 5, 0.005),
}


def failing_disks(plan: Plan) -> Outcome:
    """Run with disks that are full for a while, and with system calls that fail at random."""
    rows = rod_rows(min(plan.samples, 300))
    trials: dict[str, Callable[[Path], tuple[int, int, int]]] = {}
    notes = []
    if sys.platform == "linux":
        trials["full, and room again"] = lambda folder: _filled(folder, rows, plan.seed)
        trials["full when the run ends"] = lambda folder: _full_at_the_end(folder, rows, plan.seed)
    else:
        notes.append("disk: full disks were left out, they need Linux (prlimit).")
    if shutil.which("fiu-run") is not None:
        for what, (point, number, chance) in CALLS.items():
            command = f"enable_random name={point},probability={chance},failinfo={number}"
            wrapper = ["fiu-run", "-x", "-f", "", "-c", command]
            trials[what] = lambda folder, wrapper=wrapper: _failing(  # type: ignore[misc]
                folder, rows, plan.seed, wrapper
            )
    else:
        notes.append("disk: calls that fail were left out, they need fiu-run (Debian: fiu-utils).")
    return _tried(trials, len(rows), notes)


def _tried(
    trials: dict[str, Callable[[Path], tuple[int, int, int]]], count: int, notes: list[str]
) -> Outcome:
    expected, _ = undisturbed(count)
    rows, total, unclear = [], Damage(), 0
    for what, trial in trials.items():
        damage = Damage()
        with TemporaryDirectory() as name:
            waited, ended, unexplained = trial(Path(name))
            found = Found.of(Path(name) / "run")
        damage.compare(found, expected)
        total.compare(found, expected)
        unclear += unexplained
        rows.append((what, waited, ended, damage.lost, damage.doubled, damage.different))
    columns = ("what failed", "waited", "ended, and gone on", "lost", "doubled", "different")
    check = Check("disk: ends without one sentence, waits without a word", unclear, 0, "<=")
    return Outcome(
        tables=[Table(f"Disks that fail: {count} samples", columns, rows)],
        checks=[check, *total.checks("disk")],
        notes=notes,
    )


def _filled(folder: Path, rows: Sequence[Row], seed: int) -> tuple[int, int, int]:
    """Repeatedly stop the files of a run from growing; return waits, failed ends, silent waits."""
    import resource

    plant, port, silent = GrowingFile(folder, rows, seed), _free_port(), 0
    none = resource.RLIM_INFINITY
    with closing(Run(folder, plant.source, options=("--listen", str(port)))) as run:
        plant.supply(len(rows) // (FILLED + 2))
        run.start()
        for k in range(1, FILLED + 1):
            run.wait_for(k * len(rows) // (FILLED + 2) - 1)  # the last line may be incomplete
            journal = run.out / JOURNAL
            size = max(file.stat().st_size for file in (journal, log_of(journal)))
            resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (size, none))
            plant.supply((k + 1) * len(rows) // (FILLED + 2))
            wait(lambda: SAID in _health(port)["why"], "a full disk is not said")
            silent += _health(port)["ok"]
            resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (none, none))
            wait(lambda: SAID not in _health(port)["why"], "a run does not go on with room")
        plant.supply(len(rows))
        run.end(len(rows))
        return Found.of(run.out).events["disk"], 0, silent


def _full_at_the_end(folder: Path, rows: Sequence[Row], seed: int) -> tuple[int, int, int]:
    """Limit the file size while a run ends, for several sizes; then let the run end."""
    import resource

    plant, ended, unexplained = GrowingFile(folder, rows, seed), 0, 0
    plant.supply(len(rows))
    with closing(Run(folder, plant.source, codes=(0, BAD_INPUT))) as run:
        for size in SIZES:
            _start(run)
            run.wait_for(len(rows))
            limits = (size, resource.RLIM_INFINITY)
            resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, limits)
            bad = _ended(run)
            ended += bad
            unexplained += bad and not _explained(folder)
        _start(run)
        run.end(len(rows))
        return Found.of(run.out).events["disk"], ended, unexplained


def _failing(
    folder: Path, rows: Sequence[Row], seed: int, wrapper: Sequence[str]
) -> tuple[int, int, int]:
    """Start runs whose system calls fail at random until one survives; then end undisturbed."""
    plant, ended, unexplained = GrowingFile(folder, rows, seed), 0, 0
    plant.supply(len(rows))
    with closing(Run(folder, plant.source, wrapper=wrapper, codes=(0, BAD_INPUT))) as run:
        for _ in range(LIMIT):
            _start(run)
            wait(lambda: not run.alive() or run.look() == len(rows), "a run does not go on")
            if run.kill():  # before figures: under fiu-run the import of Pillow aborts or hangs
                break
            ended += 1
            unexplained += not _explained(folder)
    with closing(Run(folder, plant.source)) as run:
        _start(run)
        run.end(len(rows))
        return Found.of(run.out).events["disk"], ended, unexplained


def _start(run: Run) -> None:
    """Start a run, and wait until it handles signals or has ended."""
    log = run.folder / "log.txt"
    before = log.stat().st_size if log.exists() else 0
    run.start()
    wait(lambda: not run.alive() or log.stat().st_size > before, "a run does not begin")


def _ended(run: Run) -> bool:
    """Stop a run that has not ended by itself; return whether it ended with an error."""
    run.signal(signal.SIGTERM)
    code = run.process.wait(PATIENCE)
    run.alive()  # raises for other exit codes
    return code == BAD_INPUT


def _explained(folder: Path) -> bool:
    """Return whether the log of a run ends with an error message and has no traceback."""
    log = (folder / "log.txt").read_text().splitlines()
    return log[-1].startswith("Error: ") and "Traceback" not in "".join(log)


def _health(port: int) -> dict[str, Any]:
    """Return the content of /health, whether ok or not."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=60.0) as answer:
            return dict(json.load(answer))
    except urllib.error.HTTPError as error:
        return dict(json.load(error))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
