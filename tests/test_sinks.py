"""Destinations of estimates and logs, failures of sinks, and output on standard error."""

import io
import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from live_rod import live, rows
from patience import PATIENCE

from livepde.runs.monitor import JsonLinesSink, configure
from livepde.streams.sources import Rows


def test_each_estimate_is_a_line(tmp_path):
    stream = io.StringIO()
    run = live(tmp_path, Rows(rows(4)), sinks=[JsonLinesSink(stream)], verdict=False)
    run.run()
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["t"] for line in lines] == [record.t for record in run.journal]
    last = run.result.last
    value, std = last.parameters["k"]
    told = lines[-1]["unknowns"]["k"]
    assert (told["value"], told["std"]) == pytest.approx((value, std))
    assert lines[-1]["innovation"] == last.innovation.tolist()
    assert lines[-1]["status"] == "ok"
    run.journal.close()


def test_what_is_no_number_is_null(tmp_path):
    stream = io.StringIO()
    row = {**next(iter(rows(1))), "b": None}
    run = live(tmp_path, Rows([row]), sinks=[JsonLinesSink(stream)])
    run.run()
    assert json.loads(stream.getvalue())["innovation"][1] is None
    run.journal.close()


CHILD = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from live_rod import live, rows
from livepde.runs.monitor import JsonLinesSink
from livepde.streams.sources import Rows
run = live(Path(sys.argv[1]), Rows(rows(30)), sinks=[JsonLinesSink(sys.stdout)])
run.run()
events = [(event.kind, event.message) for event in run.journal.events]
print(len(run.journal), events, file=sys.stderr)
run.journal.close()
"""


def child(folder: Path, output) -> str:
    command = [sys.executable, "-c", CHILD, str(folder), str(Path(__file__).parent)]
    ended = subprocess.run(
        command, stdout=output, stderr=subprocess.PIPE, text=True, timeout=PATIENCE, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stderr


@pytest.mark.process
def test_a_closed_pipe_ends_the_sink_and_not_the_run(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    told = child(tmp_path, writing)
    os.close(writing)
    assert told.count("JsonLinesSink failed and was removed") == 2  # the event, and the log
    assert "30 [('sink', " in told
    assert "Exception ignored" not in told


@pytest.mark.process
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_ends_the_sink_and_not_the_run(tmp_path):
    with Path("/dev/full").open("w") as full:
        told = child(tmp_path, full)
    assert "No space left on device" in told
    assert "30 [('sink', " in told


def test_a_log_in_json_has_the_fields_of_an_event(tmp_path, capsys, logs):
    configure("json")
    late = {"t": 0.0, "a": 0.0, "b": 0.0, "left": 0.0}
    run = live(tmp_path, Rows([*rows(3), late]))
    run.run()
    run.journal.close()
    logging.getLogger("livepde.mqtt").warning("lost")
    logging.getLogger("another").info("not said")
    *events, lost = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert {(event["kind"], event["channel"]) for event in events} == {
        ("conflict", "a"),
        ("conflict", "b"),
        ("conflict", "left"),
    }
    assert events[0]["level"] == "WARNING"
    assert all(isinstance(event["t"], float) for event in events)
    assert lost["logger"] == "livepde.mqtt"
    assert lost["message"] == "lost"
    assert lost["time"].endswith("Z")


def test_a_log_as_text(capsys, logs):
    configure("text", logging.WARNING)
    logging.getLogger("livepde.run").warning("nothing from the source")
    logging.getLogger("livepde.run").info("not said")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("WARNING nothing from the source")


PROGRAM = """
import logging, sys, warnings
import numpy as np, typer
from livepde.cli import main
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
