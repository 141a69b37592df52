"""Kills at random moments of runs that read a file, standard input or a broker."""

from __future__ import annotations

import math
import shutil
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.faults.damage import Damage, Found
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import Feeder, GrowingFile, Mosquitto, Plant, Topic, wait
from benchmarks.faults.rod import Row, rod_rows
from benchmarks.faults.run import Run, undisturbed
from livepde.runs import Check, Outcome, Table

STRIDE = 0.25  # largest delay of a kill after the run makes progress, in seconds
LEAD = (20, 400)  # range of the number of rows supplied in advance
MOMENTS = {"start": 0.25, "step": 0.4, "write": 0.25, "end": 0.1}  # share of the kills
PROGRESS = 0.7  # smallest share of kills after new samples

Plants = Callable[[Path, Sequence[Row], int], Plant]


def kills_of_files(plan: Plan) -> Outcome:
    """Kill runs that follow a growing file."""
    with TemporaryDirectory() as folder:
        return _killed(plan, Path(folder), "file", GrowingFile)


def kills_of_input(plan: Plan) -> Outcome:
    """Kill runs that read standard input; rows without an estimate are sent again."""
    with TemporaryDirectory() as name, ExitStack() as stack:

        def plant(here: Path, rows: Sequence[Row], seed: int) -> Feeder:
            return stack.enter_context(closing(Feeder(here, rows, seed)))

        return _killed(plan, Path(name), "stdin", plant)


def kills_of_topics(plan: Plan) -> Outcome:
    """Kill runs that subscribe to a broker."""
    with TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        broker = Mosquitto(folder)
        stack.callback(broker.close)

        def plant(here: Path, rows: Sequence[Row], seed: int) -> Topic:
            return stack.enter_context(closing(Topic(broker, rows, here.name)))

        return _killed(plan, folder, "mqtt", plant)


KILLED = {"file": kills_of_files, "stdin": kills_of_input, "mqtt": kills_of_topics}


@dataclass
class _Hunt:
    """Kills runs in several threads until the planned number of kills is reached.

    Attributes
    ----------
    fallen
        Moment -> number of kills.
    progress
        Number of kills after new samples.
    uncounted
        Number of repeated rows that were not counted as repeated, or were counted as late.
    """

    plan: Plan
    folder: Path
    name: str
    plants: Plants
    bar: Iterator[int]
    damage: Damage = field(default_factory=Damage)
    fallen: Counter[str] = field(default_factory=Counter)
    progress: int = 0
    uncounted: int = 0
    _begun: int = 0
    _over: bool = False
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def open(self) -> bool:
        """Whether more kills are needed."""
        few = self.fallen.total() < self.plan.kills
        return not self._over and (few or self.progress < PROGRESS * self.plan.kills)

    def hunt(self) -> None:
        """Kill one run after another; an error in one thread stops all threads."""
        try:
            while self.open:
                with self._lock:
                    number = self._begun
                    self._begun += 1
                self._run(number)
        except BaseException:
            self._over = True
            raise

    def _run(self, number: int) -> None:
        rows, rng = rod_rows(self.plan.samples), np.random.default_rng([self.plan.seed, number])
        expected, start = undisturbed(self.plan.samples)
        here = self.folder / f"{self.name}-{number}"
        here.mkdir()
        plant = self.plants(here, rows, self.plan.seed + number)
        with closing(Run(here, plant.source, plant.launch)) as run:
            while self.open and run.look() < len(rows) - LEAD[0]:
                before = run.look()
                moment = str(rng.choice([*MOMENTS], p=[*MOMENTS.values()]))
                if _kill(run, plant, len(rows) - 1, moment, start, rng):
                    self._fell(moment, run.look() > before)
            before, repeated = run.look(), run.counted("repeated")
            plant.supply(len(rows))
            run.start()
            run.end(len(rows))
        found = Found.of(here / "run")
        with self._lock:
            self.damage.compare(found, expected)
            if isinstance(plant, Feeder):  # it knows which rows it sent again
                resent = before - plant.first
                self.uncounted += abs(found.counts["repeated"] - repeated - resent)
                self.uncounted += found.counts["late"]
        shutil.rmtree(here)

    def _fell(self, moment: str, after_progress: bool) -> None:
        with self._lock:
            self.fallen[moment] += 1
            self.progress += after_progress
            next(self.bar, None)

    def outcome(self) -> Outcome:
        """Return the table of kills and damage, and the checks."""
        name, damage = self.name, self.damage
        head = ("runs", *(f"at {moment}" for moment in MOMENTS), "lost", "doubled", "different")
        moments = (self.fallen[moment] for moment in MOMENTS)
        row = (damage.runs, *moments, damage.lost, damage.doubled, damage.different, self.progress)
        title = f"Kills, {name}: {self.plan.samples} samples a run"
        table = Table(title, (*head, "after new samples"), [row])
        least = math.ceil(PROGRESS * self.plan.kills)
        checks = [
            Check(f"{name}: kills", self.fallen.total(), self.plan.kills, ">="),
            Check(f"{name}: kills after new samples", self.progress, least, ">="),
            *damage.checks(name),
        ]
        if name == "stdin":
            text = "rows sent again that are not counted as repeated"
            checks.append(Check(f"{name}: {text}", self.uncounted, 0, "<="))
        return Outcome(tables=[table], checks=checks)


def _killed(plan: Plan, folder: Path, name: str, plants: Plants) -> Outcome:
    undisturbed(plan.samples)  # compute once, before the threads start
    bar = plan.watched(plan.kills, f"kills, {name}")
    next(bar, None)
    hunt = _Hunt(plan, folder, name, plants, bar)
    with ThreadPoolExecutor(plan.workers) as pool:
        for ended in [pool.submit(hunt.hunt) for _ in range(plan.workers)]:
            ended.result()
    return hunt.outcome()


def _kill(
    run: Run, plant: Plant, rows: int, moment: str, start: float, rng: np.random.Generator
) -> bool:
    """Start a run and kill it at a kind of moment; return whether it was still running."""
    seen = run.look()
    plant.supply(min(seen + int(rng.integers(*LEAD)), rows))
    run.start()
    if moment == "start":  # includes the resume
        time.sleep(float(rng.uniform(0.0, 1.2 * start)))
        return run.kill()
    wait(lambda: not run.alive() or run.look() > seen, "a run does not go on")
    plant.supply(min(run.look() + int(rng.integers(*LEAD)), rows))
    until = time.monotonic() + float(rng.uniform(0.0, STRIDE))
    if moment == "write":  # when its log grows, or after the delay
        size = run.log_size
        while run.log_size == size and time.monotonic() < until:
            pass
        return run.kill()
    time.sleep(max(until - time.monotonic(), 0.0))
    if moment == "end":
        run.signal(signal.SIGTERM)
        time.sleep(float(rng.uniform(0.0, STRIDE)))
    return run.kill()
