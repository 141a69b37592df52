"""Commands as users give them: in this process, in one of their own, or as a service."""

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
    """Leave logging as it was."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    own = {name: logging.getLogger(name).level for name in ("livepde", "asyncua")}
    try:
        yield
    finally:
        root.handlers[:] = before
        root.setLevel(level)
        for name, was in own.items():
            logging.getLogger(name).setLevel(was)


def call(
    *arguments: str | Path, stdin: str | None = None, program: typer.Typer = cli.app
) -> tuple[int, str]:
    """Return exit code and output of a command that ends as it should."""
    with unchanged_logging():  # a live run configures it, with a stream that is closed here
        result = CliRunner().invoke(program, list(map(str, arguments)), input=stdin)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def bench(*arguments: str) -> tuple[int, str]:
    """Return exit code and output of a benchmark."""
    return call(*arguments, program=benchmarks)


def bad(*arguments: str) -> str:
    """Return the one sentence of a command that ends with bad input."""
    with pytest.raises(LivepdeError) as error:
        call(*arguments)
    return str(error.value)


def shell(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    code = "import sys; from livepde.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, **options)


def cut(whole: str, target: str, samples: int) -> None:
    """Copy a run as if it had been killed within its sample of this number."""
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
    """Return how many samples a run has estimated."""
    path = Path(folder) / JOURNAL
    if not path.exists():
        return 0
    try:
        with Journal.open(path) as journal:
            return len(journal)
    except RunError:  # it is being made
        return 0


def stopped(process: subprocess.Popen[str], how: signal.Signals = signal.SIGTERM) -> str:
    process.send_signal(how)
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    return output
