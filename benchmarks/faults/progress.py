"""Runs that are killed every few seconds, with short and with long steps."""

from __future__ import annotations

import signal
import time
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.faults.damage import Damage, Found
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import GrowingFile
from benchmarks.faults.rod import STEP, rod_rows
from benchmarks.faults.run import Run
from livepde.runs import Check, Outcome, Table

LIFE = 8.0  # seconds after which a run is killed
# Name -> substeps of a step, and samples of a run.
STEPS = {"50 ms": (40, 400), "2 s": (1600, 16)}
MOST = 40  # lives of a run
LATE = 2.5  # seconds from SIGTERM to the exit: a second of grace, and the report


def frequent_kills(plan: Plan) -> Outcome:
    """Kill runs every eight seconds until they have taken all samples; stop others by SIGTERM."""
    rows, damage, idle, slowest = [], Damage(), 0, 0.0
    for name, (substeps, samples) in STEPS.items():
        text = f'refit = false\n[steps]\ndt_max = "{STEP / substeps} s"\n'
        with TemporaryDirectory() as folder:
            expected, _, _ = _lives(Path(folder), samples, text, 1e9, signal.SIGKILL)
        for how in (signal.SIGKILL, signal.SIGTERM):
            with TemporaryDirectory() as folder:
                found, gains, slow = _lives(Path(folder), samples, text, LIFE, how)
            damage.compare(found, expected)
            # The first life may end before its first step has.
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


def _lives(
    folder: Path, samples: int, text: str, life: float, how: signal.Signals
) -> tuple[Found, list[int], float]:
    """Return what a run leaves behind, its new samples in each life, and its slowest exit."""
    plant, gains, slow = GrowingFile(folder, rod_rows(samples + 1), 0), list[int](), 0.0
    plant.supply(samples)  # the last row may be without its end
    with closing(Run(folder, plant.source)) as run:
        case = folder / "case.toml"
        case.write_text(case.read_text().replace("[output]", text + "[output]"))
        while len(gains) < MOST:
            before = run.estimated()
            run.start()
            until = time.monotonic() + life
            while time.monotonic() < until and run.alive() and run.estimated() < samples - 1:
                time.sleep(0.02)
            gains.append(run.estimated() - before)
            if run.estimated() >= samples - 1:
                break
            begun = time.monotonic()
            run.signal(how)
            run.process.wait()
            slow = max(slow, time.monotonic() - begun)
        # The last sample shows that the last life hears signals.
        plant.supply(samples + 1)
        run.end(samples + 1)
    return Found.of(folder / "run"), gains, slow
