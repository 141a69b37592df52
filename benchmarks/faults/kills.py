"""Kills of runs at any moment, that take rows from a file, a pipe or a broker."""

from __future__ import annotations

import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.faults.damage import Damage, Found
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import GrowingFile, Mosquitto, Plant, StandardInput, Topic, wait
from benchmarks.faults.rod import Row, rod_rows
from benchmarks.faults.run import Run, undisturbed
from livepde.runs import Check, Outcome, Table

__all__ = ["kills_of_files", "kills_of_pipes", "kills_of_topics"]

STRIDE = 0.25  # seconds after a sign of life within which a kill falls
LEAD = (20, 400)  # rows that are there before they are asked for
MOMENTS = {"start": 0.25, "step": 0.4, "write": 0.25, "end": 0.1}  # share of the kills


def kills_of_files(plan: Plan) -> Outcome:
    """Kill runs of a file that grows."""
    with TemporaryDirectory() as folder:
        return _killed(plan, Path(folder), "file", GrowingFile)


def kills_of_pipes(plan: Plan) -> Outcome:
    """Kill runs that read standard input, and send them again what they have not kept."""

    def plant(here: Path, rows: Sequence[Row], seed: int) -> StandardInput:
        return StandardInput(rows, seed)

    with TemporaryDirectory() as folder:
        return _killed(plan, Path(folder), "stdin", plant)


def kills_of_topics(plan: Plan) -> Outcome:
    """Kill runs that listen to a broker."""
    with TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        broker = Mosquitto(folder)
        stack.callback(broker.close)

        def plant(here: Path, rows: Sequence[Row], seed: int) -> Topic:
            return stack.enter_context(closing(Topic(broker, rows, here.name)))

        return _killed(plan, folder, "mqtt", plant)


def _killed(
    plan: Plan, folder: Path, name: str, plants: Callable[[Path, Sequence[Row], int], Plant]
) -> Outcome:
    rows, rng = rod_rows(plan.samples), np.random.default_rng(plan.seed)
    expected, start = undisturbed(plan.samples)
    damage, fallen, progress = Damage(), Counter[str](), 0
    again = untold = 0  # rows that were sent twice, and counted or not
    bar = plan.watched(plan.kills, f"kills, {name}")
    next(bar, None)
    while fallen.total() < plan.kills:
        here = folder / f"{name}-{damage.runs}"
        here.mkdir()
        plant = plants(here, rows, plan.seed + damage.runs)
        with closing(_run(here, plant)) as run:
            while run.look() < len(rows) - LEAD[0] and fallen.total() < plan.kills:
                before = run.look()
                moment = str(rng.choice([*MOMENTS], p=[*MOMENTS.values()]))
                if _kill(run, plant, len(rows) - 1, moment, start, rng):
                    fallen[moment] += 1
                    progress += run.look() > before
                    next(bar, None)
            plant.supply(len(rows))
            run.start()
            run.end(len(rows))
        found = Found.of(here / "run")
        damage.compare(found, expected)
        if isinstance(plant, StandardInput):
            again += found.counts["repeated"]
            untold += max(plant.twice - found.counts["repeated"], 0)
        shutil.rmtree(here)
    table = Table(
        f"Kills, {name}: {plan.samples} samples a run",
        (
            "runs",
            *(f"at {moment}" for moment in MOMENTS),
            "lost",
            "doubled",
            "different",
            "after new samples",
            "rows sent again",
        ),
        [
            (
                damage.runs,
                *(fallen[moment] for moment in MOMENTS),
                damage.lost,
                damage.doubled,
                damage.different,
                progress,
                again,
            )
        ],
    )
    enough = Check(f"{name}: kills", fallen.total(), plan.kills, ">=")
    counted = Check(f"{name}: rows sent again and not counted", untold, 0, "<=")
    return Outcome(tables=[table], checks=[enough, *damage.checks(name), counted])


def _run(folder: Path, plant: Plant) -> Run:
    """Return the run of a plant."""
    if isinstance(plant, StandardInput):
        return Run(folder, plant.source, options=("--data", "-"), feeder=plant)
    return Run(folder, plant.source)


def _kill(
    run: Run, plant: Plant, rows: int, moment: str, start: float, rng: np.random.Generator
) -> bool:
    """Start a run and kill it at such a moment; return whether it was still there."""
    seen = run.look()
    plant.supply(min(seen + int(rng.integers(*LEAD)), rows))
    run.start()
    if moment == "start":  # also while it resumes
        time.sleep(float(rng.uniform(0.0, 1.2 * start)))
        return run.kill()
    wait(lambda: not run.alive() or run.look() > seen, "a run does not go on")
    plant.supply(min(run.look() + int(rng.integers(*LEAD)), rows))
    until = time.monotonic() + float(rng.uniform(0.0, STRIDE))
    if moment == "write":  # while its log grows, if it does
        size = run.log_size
        while run.log_size == size and time.monotonic() < until:
            pass
        return run.kill()
    time.sleep(max(until - time.monotonic(), 0.0))
    if moment == "end":
        run.signal(signal.SIGTERM)
        time.sleep(float(rng.uniform(0.0, STRIDE)))
    return run.kill()
