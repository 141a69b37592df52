"""What reaches standard error of a program: lines of its own, and no raw ones of libraries."""

from __future__ import annotations

import subprocess
import sys

import pytest
from patience import PATIENCE

PROGRAM = """
import logging, sys, warnings
import numpy as np, typer
from livepde.cli.program import main
from livepde.runs.monitor import configure

program = typer.Typer()

@program.command()
def command(live: bool = False):
    if live:
        configure()
    np.array([1000.0]) / np.array([0.0])
    warnings.warn("two\\n  lines", UserWarning)
    try:
        raise ValueError("the page\\nfails")
    except ValueError:
        logging.getLogger("dash.dash").exception("Exception on %s", "/_dash-update-component")
    logging.getLogger("livepde.run").warning("an event")

sys.exit(main(program))
"""
LINES = [
    "<string> warns: divide by zero encountered in divide (RuntimeWarning)",
    "<string> warns: two lines (UserWarning)",
    "dash.dash: Exception on /_dash-update-component: ValueError: the page",
    "an event",
]


@pytest.mark.process
@pytest.mark.parametrize("live", [False, True])
def test_warnings_and_exceptions_of_libraries_are_one_line_each(live: bool) -> None:
    command = [sys.executable, "-W", "default", "-c", PROGRAM, *(["--live"] if live else [])]
    found = subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE, check=True
    ).stderr.splitlines()
    if live:  # after date, time and level
        found = [line.split(" ", 3)[3] for line in found]
    assert found == LINES
