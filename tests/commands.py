"""Functions that run commands in this process, in a separate process, or as a service."""

import logging
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import typer
from patience import PATIENCE
from typer.testing import CliRunner

from benchmarks.__main__ import app as benchmarks
from livepde import cli
from livepde.errors import LivepdeError, RunError
from livepde.runs import JOURNAL, Journal


@contextmanager
def unchanged_logging() -> Iterator[None]:
    """Restore the configuration of logging at the end of a context."""
    root = logging.getLogger()
    handlers, root_level = list(root.handlers), root.level
    levels = {name: logging.getLogger(name).level for name in ("livepde", "asyncua")}
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(root_level)
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def call(
    *arguments: str | Path, stdin: str | None = None, program: typer.Typer = cli.app
) -> tuple[int, str]:
    """Run a command in this process; return its exit code and output, or raise its exception."""
    with unchanged_logging():  # a live run logs to a stream that is closed afterwards
        result = CliRunner().invoke(program, list(map(str, arguments)), input=stdin)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def bench(*arguments: str) -> tuple[int, str]:
    """Run a benchmark; return its exit code and output."""
    return call(*arguments, program=benchmarks)


def bad(*arguments: str) -> str:
    """Run a command that must fail with a `LivepdeError`, and return the message."""
    with pytest.raises(LivepdeError) as error:
        call(*arguments)
    return str(error.value)


def shell(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    """Run the command in a separate process."""
    code = "import sys; from livepde.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, **options)


def cut(whole: str, target: str, samples: int) -> None:
    """Copy a run as if it had been killed while processing sample number `samples`."""
    shutil.copytree(whole, target)
    with closing(sqlite3.connect(f"{target}/{JOURNAL}")) as journal, journal:
        journal.execute("DELETE FROM checkpoints")
        journal.execute("DELETE FROM samples WHERE id > ?", (samples,))
        journal.execute("DELETE FROM estimates WHERE id >= ?", (samples,))
        journal.execute("DELETE FROM fields WHERE id >= ?", (samples,))


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "livepde", "run", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def until(what, process: subprocess.Popen[str]) -> None:
    end = time.monotonic() + PATIENCE
    while not what():
        if process.poll() is not None or time.monotonic() > end:
            process.kill()
            raise AssertionError(process.communicate())
        time.sleep(0.02)


def estimates(folder: str | Path) -> int:
    """Return the number of samples that a run has estimated."""
    path = Path(folder) / JOURNAL
    if not path.exists():
        return 0
    try:
        with Journal.open(path) as journal:
            return len(journal)
    except RunError:  # the journal is being created
        return 0


def stopped(process: subprocess.Popen[str], how: signal.Signals = signal.SIGTERM) -> str:
    process.send_signal(how)
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    return output
