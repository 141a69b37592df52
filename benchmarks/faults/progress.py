"""Runs with short and long steps that are killed every few seconds."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.faults.damage import Damage, Found
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import GrowingFile, wait
from benchmarks.faults.rod import STEP, rod_rows
from benchmarks.faults.run import Run
from livepde.runs import Check, Outcome, Table

LIFE = 8.0  # seconds after which a run is killed
# Duration of a step -> number of substeps, and samples of a run.
STEPS = {"50 ms": (40, 400), "2 s": (1600, 16)}
MOST = 40  # largest number of processes of a run
STOPS = 100  # largest number of signals at random moments of long steps
LATE = 2.5  # seconds from SIGTERM to the exit, for a grace period of 1 s and the report


def frequent_kills(plan: Plan) -> Outcome:
    """Kill runs, or stop them by SIGTERM, every eight seconds until all samples are processed."""
    rows, damage, idle, slowest = [], Damage(), 0, 0.0
    for name, (substeps, samples) in STEPS.items():
        text = f'refit = false\n[steps]\ndt_max = "{STEP / substeps} s"\n'
        with TemporaryDirectory() as folder:
            expected, _, _ = _lives(Path(folder), samples, text, lambda: 1e9, signal.SIGKILL)
        for how in (signal.SIGKILL, signal.SIGTERM):
            with TemporaryDirectory() as folder:
                found, gains, exits = _lives(Path(folder), samples, text, lambda: LIFE, how)
            slow = max(exits, default=0.0)
            damage.compare(found, expected)
            # The first process may end before its first step is complete.
            idle += sum(gain == 0 for gain in gains[1:])
            slowest = max(slowest, slow if how == signal.SIGTERM else 0.0)
            rows.append((name, how.name, len(gains), min(gains[1:], default=0), slow))
    head = ("a step", "signal", "lives", "fewest new samples of a life", "seconds to the exit")
    return Outcome(
        tables=[Table(f"Signals every {LIFE:g} s", head, rows)],
        checks=[
            Check("progress: lives without a new sample", idle, 0, "<="),
            Check("progress: seconds from SIGTERM to the exit", slowest, LATE, "<="),
            *damage.checks("progress"),
        ],
    )


def prompt_stops(plan: Plan) -> Outcome:
    """Stop a run with steps of two seconds by SIGTERM at random moments."""
    rng, count = np.random.default_rng(plan.seed), min(plan.kills, STOPS)
    numbers = iter(plan.watched(count, "SIGTERM"))

    substeps, _ = STEPS["2 s"]
    text = f'refit = false\n[steps]\ndt_max = "{STEP / substeps} s"\n'
    with TemporaryDirectory() as folder:
        log = Path(folder) / "log.txt"

        def life() -> float:
            """Wait until the run has begun, and return its random lifetime in seconds."""
            next(numbers)
            size = log.stat().st_size
            wait(lambda: log.stat().st_size > size, "a run does not begin")
            return float(rng.uniform(0.0, 0.5 * LIFE))

        rows = 20 * count + 10
        _, gains, exits = _lives(Path(folder), rows, text, life, signal.SIGTERM, count)
    soon = sum(seconds <= LATE for seconds in exits)
    row = (len(exits), soon, float(np.median(exits)), max(exits), sum(gains))
    head = ("SIGTERM", f"within {LATE:g} s", "median seconds", "most", "samples")
    check = Check(f"SIGTERM: exits later than {LATE:g} s", len(exits) - soon, 0, "<=")
    return Outcome(tables=[Table("Stops at random moments", head, [row])], checks=[check])


def _lives(
    folder: Path,
    samples: int,
    text: str,
    life: Callable[[], float],
    how: signal.Signals,
    most: int = MOST,
) -> tuple[Found, list[int], list[float]]:
    """Restart a run until it is complete; return its results, new samples and exit times."""
    plant, gains, exits = GrowingFile(folder, rod_rows(samples + 1), 0), list[int](), list[float]()
    plant.supply(samples)  # the last row may be incomplete
    with closing(Run(folder, plant.source)) as run:
        case = folder / "case.toml"
        case.write_text(case.read_text().replace("[output]", text + "[output]"))
        while len(gains) < most:
            before = run.estimated()
            run.start()
            span = life()
            until = time.monotonic() + span
            while time.monotonic() < until and run.alive() and run.estimated() < samples - 1:
                time.sleep(0.02)
            gains.append(run.estimated() - before)
            if run.estimated() >= samples - 1:
                break
            begun = time.monotonic()
            run.signal(how)
            run.process.wait()
            exits.append(time.monotonic() - begun)
        if len(gains) == most and run.estimated() < samples - 1:
            return Found.of(folder / "run"), gains, exits
        # The last sample shows that the last process handles signals.
        plant.supply(samples + 1)
        run.end(samples + 1)
    return Found.of(folder / "run"), gains, exits
