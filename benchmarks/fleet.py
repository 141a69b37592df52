"""Costs of a fleet of rods relative to separate identifiers, per step and for the command."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import TypeAlias

import numpy as np

from livepde.diagnostics.check_report import Check, Table
from livepde.fem import Channel, LogNormal, interval
from livepde.fleet import Fleet
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import heat
from livepde.observation import Points
from livepde.runs import Outcome
from livepde.stepping import Advance, simulate

NODES = 100
SENSORS = (0.2, 0.4, 0.6, 0.8)
NOISE = 0.01
STEP = 0.05
TRUTHS = 20  # rods with different coefficients; each member has its own noise
BEGIN = 20  # untimed samples before the first pair, which include one-time computations
LENGTH = 5  # steps of a pair
REPETITIONS = 7
FASTER = 10.0  # smallest speed-up of a step
EQUAL = 1e-8  # largest relative difference of estimates, due to rounding
SAMPLES = 1000  # samples of a run
RUN = f"rod of {NODES} nodes, {SAMPLES} samples"
COMMAND_FASTER = 4.0  # smallest speed-up of the command: output costs as much as computation
CASE = """\
title = "A rod"
equation = "heat"
initial = 0.0
boundary = {{ right = 0.0 }}

[mesh]
from = 0.0
to = 1.0
cells = {cells}

[data]
time = "time"

[unknowns.alpha]
prior = 0.5
std = 0.25
transform = "log"
bounds = [0.0, inf]

[unknowns.loss]
prior = 0.5
std = 0.5
transform = "log"
bounds = [0.0, inf]

[channels]
heated = {{ role = "boundary", column = "heated", at = "left" }}
ambient = {{ role = "input", column = "ambient" }}
{sensors}

[law]
kind = "sensitivity"
"""

Part: TypeAlias = tuple[Table, list[Check]]


def fleet(members: int = 1000, runs: int = 25) -> Outcome:
    """Time a fleet of heated rods of 100 nodes with unknown diffusivity and loss.

    Parameters
    ----------
    members
        Rods whose joint step is compared with steps of separate identifiers.
    runs
        Rods for which `livepde fleet` writes run directories, jointly and separately; 0 for none.
    """
    parts = [_steps(members), *([_commands(runs)] if runs else [])]
    return Outcome(
        tables=[table for table, _ in parts],
        checks=[check for _, checks in parts for check in checks],
        notes=[
            "Steps: ratios of times measured in turns in one process with one thread. Commands: "
            "ratios of total processor times of `livepde fleet` with --jobs 1, including run "
            "directories."
        ],
    )


def _steps(members: int) -> Part:
    """Time a step of a fleet relative to a step of separate identifiers with the same data."""
    model, sensors, law = _rod(), Points(SENSORS, noise=NOISE), SensitivityLaw()
    together = Fleet(model, sensors, law, members, u0=0.0)
    separate = [Identifier(model, sensors, law, u0=0.0) for _ in range(members)]
    ratios, apart = [], 0.0
    samples = _samples(model, members, BEGIN + REPETITIONS * LENGTH)
    for k in range(REPETITIONS + 1):
        piece = samples[:BEGIN] if not k else samples[BEGIN + (k - 1) * LENGTH :][:LENGTH]
        start = perf_counter()
        for t, z, heated in piece:
            estimate = together.step(t, z, _inputs(heated))
        middle = perf_counter()
        for t, z, heated in piece:
            inputs = _inputs(heated)
            singles = [one.step(t, row, inputs) for one, row in zip(separate, z, strict=True)]
        stop = perf_counter()
        q = np.array([single.q for single in singles])
        apart = max(apart, float(np.abs(estimate.q / q - 1.0).max()))
        if k:
            ratios.append((stop - middle) / (middle - start))
    low, middle_ratio, high = np.quantile(ratios, (0.0, 0.5, 1.0))
    title = f"Separate objects over a fleet of {members}, {REPETITIONS} pairs of {LENGTH} steps"
    rows = [(f"rod of {NODES} nodes, 2 unknowns, 4 sensors", low, middle_ratio, high)]
    table = Table(title, ("time per step and rod", "min", "median", "max"), rows)
    return table, [
        Check("fleet: times faster per step and rod", float(middle_ratio), FASTER, ">="),
        Check("fleet: relative difference of the estimates", apart, EQUAL, "<="),
    ]


def _commands(members: int) -> Part:
    """Time `livepde fleet` relative to `livepde fleet --separately`."""
    import pandas as pd

    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        _write_case(home, members)
        seconds, tables = [], []
        for options in ((), ("--separately",)):
            out = home / f"rods{len(options)}"
            seconds.append(_spent(home, "--out", str(out), *options))
            tables.append(pd.read_csv(out / "fleet.csv").set_index("name"))
        unknowns = tables[1][["alpha", "loss"]]
        apart = float((tables[0][["alpha", "loss"]] / unknowns - 1.0).abs().to_numpy().max())
    ratio = seconds[1] / seconds[0]
    title = f"`livepde fleet --separately` over `livepde fleet`, {members} rods"
    table = Table(title, ("processor time of the command", "ratio"), [(RUN, ratio)])
    return table, [
        Check("fleet command: times faster", ratio, COMMAND_FASTER, ">="),
        Check("fleet command: relative difference of the estimates", apart, EQUAL, "<="),
    ]


def _write_case(home: Path, members: int) -> None:
    """Write a case, a data file for each rod, and the table of members."""
    model = _rod()
    names = [f"T_{100 * x:.0f}" for x in SENSORS]
    sensors = "\n".join(
        f'{name} = {{ role = "sensor", column = "{name}", at = {x}, noise = {NOISE} }}'
        for name, x in zip(names, SENSORS, strict=True)
    )
    (home / "case.toml").write_text(CASE.format(cells=NODES - 1, sensors=sensors))
    samples = _samples(model, members, SAMPLES)
    head = ",".join(["time", "heated", "ambient", *names])
    rods = [f"rod{k:04d}" for k in range(members)]
    for k, rod in enumerate(rods):
        rows = [",".join(map(repr, [t, heated, 0.0, *z[k].tolist()])) for t, z, heated in samples]
        (home / f"{rod}.csv").write_text("\n".join([head, *rows]) + "\n")
    table = [f"{rod},{rod}.csv" for rod in rods]
    (home / "rods.csv").write_text("\n".join(["name,data", *table]) + "\n")


def _spent(home: Path, *options: str) -> float:
    """Run `livepde fleet`, and return its processor time in s."""
    command = [sys.executable, "-m", "livepde", "fleet", "case.toml", "--members", "rods.csv"]
    before = os.times()
    subprocess.run([*command, *options], cwd=home, check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    spent = after.children_user - before.children_user
    return spent + after.children_system - before.children_system


def _rod() -> Model:
    ends = {"left": Channel("heated"), "right": 0.0}
    loss = LogNormal(0.5, std=0.5)
    alpha = LogNormal(0.5, std=0.25)
    return heat(interval(0.0, 1.0, NODES - 1), alpha, ends, loss=loss)


def _inputs(heated: float) -> dict[str, float]:
    return {"heated": heated, "ambient": 0.0}


def _samples(model: Model, members: int, count: int) -> list[tuple[float, Array, float]]:
    """Return, for each sample, time, measurements of all members, and the heated end."""
    rng = np.random.default_rng(0)
    times = [STEP * k for k in range(count + 1)]

    def heated(t: float) -> float:
        return float(np.sin(t) + np.sin(3.1 * t))

    sensors = Points(SENSORS).matrix(model.state_space)
    truths, control = [], Advance(SensitivityLaw.scheme)
    for _ in range(TRUTHS):
        q = model.initial_parameter({"alpha": rng.uniform(0.3, 0.8), "loss": rng.uniform(0.2, 1.0)})
        states = simulate(model, q, 0.0, times, control, lambda t: _inputs(heated(t)))
        truths.append([sensors @ u for _, u in states])
    which = np.arange(members) % TRUTHS
    shown = np.array(truths)[which]
    shown += NOISE * rng.standard_normal(shown.shape)
    return [(t, shown[:, k], heated(t)) for k, t in enumerate(times) if k]
