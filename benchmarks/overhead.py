"""Overhead of the command line: time to the first estimates, and per sample relative to a loop.

The rod has 31 nodes, two unknowns, five sensors, and both ends as channels of the stream. Times to
first estimates are processor times of new processes of `livepde run`, including the start of the
interpreter; bytecode exists, as after an installation by pip. Per sample, `livepde run` (rows,
journal, result, checkpoints) alternates with a loop of `Identifier.step` over the same samples.
Other load on the machine therefore affects both. Estimates are evaluated lazily. A second loop also
reads the values that a run writes: parameters with standard deviations, and diagnostics.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from benchmarks.processes import usual_environment
from livepde.cases import Case, load
from livepde.estimate import Estimate
from livepde.fem import Channel, Inputs, Normal, interval
from livepde.models import heat
from livepde.runs import JOURNAL, Check, Outcome, Table, drive
from livepde.stepping import Advance, ImplicitEuler, simulate

SAMPLES = 2000
RATIO = 1.4  # largest time per sample of livepde run over Identifier.step in a loop
FIRST = 0.8  # s, largest processor time until the first estimate after a step
NOISE = 0.05
SENSORS = 5
CELLS = 30
CASE = """\
title = "A rod"
equation = "heat"
initial = "interpolate"

[mesh]
from = 0
to = "40 cm"
cells = {cells}

[data]
file = "rod.csv"
time = "time_s"
time_unit = "s"

[unknowns.alpha]
prior = "5e-5 m^2/s"
std = "3e-5 m^2/s"
bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]

[unknowns.source]
prior = "0 degC/s"
std = "0.01 degC/s"

[law]
kind = "sensitivity"

[channels]
T_left = {{ role = "boundary", column = "T_left", at = "left" }}
T_right = {{ role = "boundary", column = "T_right", at = "right" }}
{sensors}
"""
# A new process of `livepde run` prints its processor time after two estimates, and exits.
SCRIPT = """
import os, sys
from time import process_time
from livepde.identifier import Identifier
step, spent = Identifier.step, []
def timed(*given):
    estimate = step(*given)
    estimate.parameters
    spent.append(process_time())
    if len(spent) == 2:
        print(*spent, flush=True)
        os._exit(0)
    return estimate
Identifier.step = timed
from livepde.cli import main
sys.argv = ["livepde", "run", "case.toml", "--out", sys.argv[1]]
main()
"""


def rod(folder: Path, samples: int = SAMPLES) -> Path:
    """Write the case and its data into a folder, and return the path of the case."""
    ends = {"left": Channel("T_left"), "right": Channel("T_right")}
    model = heat(interval(0.0, 0.4, 2 * CELLS), Normal(9.7e-5), ends, source=Normal(1e-3))
    q = model.initial_parameter({"alpha": 9.7e-5, "source": 1e-3})
    block, rng = model.state_block, np.random.default_rng(1)
    at = np.linspace(0, 2 * CELLS, SENSORS + 2).astype(int)[1:-1]
    names = [f"T_{k}" for k in range(1, SENSORS + 1)]

    def inputs(t: float) -> Inputs:
        left = 20.0 + 15.0 * np.sin(2.0 * np.pi * t / 1200.0)
        return Inputs({"T_left": left, "T_right": 20.0 + np.sin(2.0 * np.pi * t / 3600.0)})

    times = (20.0 * np.arange(samples)).tolist()
    lines = [",".join(["time_s", "T_left", "T_right", *names])]
    for t, u in simulate(model, q, 20.0, times, Advance(ImplicitEuler()), inputs):
        measured = (block.at_vertices @ u)[at] + NOISE * rng.normal(size=SENSORS)
        lines.append(",".join(f"{x:.6f}" for x in (t, *inputs(t).values(), *measured)))
    (folder / "rod.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    points = (0.4 * at / (2 * CELLS)).tolist()
    sensors = "\n".join(
        f'{name} = {{ role = "sensor", column = "{name}", at = "{x:.9g} m", noise = "{NOISE} K" }}'
        for name, x in zip(names, points, strict=True)
    )
    case = folder / "case.toml"
    case.write_text(CASE.format(cells=CELLS, sensors=sensors), encoding="utf-8")
    return case


def overhead(rounds: int = 5, samples: int = SAMPLES) -> Outcome:
    """Time first estimates of the command line, and its samples relative to a loop of steps.

    Parameters
    ----------
    rounds
        Number of new processes, and of runs of each kind.
    samples
        Samples of a run.
    """
    with TemporaryDirectory() as place:
        folder = Path(place)
        loaded = load(rod(folder, samples))
        _first(folder, "cold")  # writes the bytecode
        firsts = np.array([_first(folder, f"first-{k}") for k in range(rounds)])
        times = np.array(
            [
                (_loop(loaded), _loop(loaded, _written), _run(loaded, folder, k))
                for k in range(rounds)
            ]
        )
    step, read, run = times.T
    rows = [
        (name, *np.quantile(values, (0.0, 0.5, 1.0)).tolist())
        for name, values in (
            ("s to the estimate of the first sample", firsts[:, 0]),
            ("s to the estimate of the second sample", firsts[:, 1]),
            ("us per sample, Identifier.step in a loop", 1e6 * step),
            ("us per sample, Identifier.step, estimates read", 1e6 * read),
            ("us per sample, livepde run", 1e6 * run),
            ("livepde run / Identifier.step", run / step),
            ("livepde run / Identifier.step, estimates read", run / read),
        )
    ]
    return Outcome(
        tables=[Table("The command line, in processor time", ("", "min", "median", "max"), rows)],
        checks=[
            Check("first estimate of livepde run after a step, s", rows[1][2], FIRST, "<="),
            Check("livepde run / Identifier.step in a loop, per sample", rows[5][2], RATIO, "<="),
            Check("livepde run / a loop that reads estimates", rows[6][2], RATIO, "<="),
        ],
        notes=[f"{rounds} new processes, and {rounds} runs of {samples} samples of each kind."],
    )


def _first(folder: Path, out: str) -> tuple[float, float]:
    """Return the processor times of a new process until its first and second estimate."""
    command = [sys.executable, "-c", SCRIPT, str(folder / out)]
    given = usual_environment(folder / "bytecode")
    done = subprocess.run(
        command, env=given, cwd=folder, capture_output=True, text=True, check=True
    )
    first, second = map(float, done.stdout.split())
    return first, second


def _written(estimate: Estimate) -> Any:
    """Evaluate the parts of an estimate that a run writes."""
    return estimate.parameters, estimate.diagnostics.named()


def _loop(loaded: Case, read: Callable[[Estimate], Any] = lambda _: None) -> float:
    """Return the processor time per sample of a loop that calls `read` on each estimate."""
    prepared = loaded.prepare()
    step, samples = prepared.identifier.step, list(prepared.stream)
    begun = process_time()
    for sample in samples:
        read(step(sample.t, sample.z))
    return (process_time() - begun) / len(samples)


def _run(loaded: Case, folder: Path, number: int) -> float:
    """Return the processor time per sample of a run with a journal, as in `livepde run`."""
    prepared = loaded.prepare()
    with ExitStack() as stack:
        journal = stack.enter_context(prepared.journal(folder / f"{number}-{JOURNAL}"))
        begun = process_time()
        driven = drive(
            prepared.identifier,
            prepared.stream,
            progress=True,
            fields_every=loaded.spec.output.fields_every,
            journal=journal,
        )
        return (process_time() - begun) / len(driven.result)
