"""The longest call while replays run, in medians of all calls.

Samples of a rod are stored, and assimilated again in slices. A sample at which a whole replay ran
would stall the loop by as many steps as there are stored samples.
"""

from __future__ import annotations

from time import process_time

import numpy as np

from benchmarks.rods import Rod
from livepde.identifier import Identifier
from livepde.laws import Replay, SensitivityLaw
from livepde.linalg import Array
from livepde.runs.outcome import Check, Outcome, Table

__all__ = ["replay"]

SAMPLES = 8_000
RUNS = 3
LONGEST = 20.0  # medians that one call may take
ROD = Rod(31, 2, "channels")


def _spent(samples: int) -> Array:
    """Return the processor time of each call of a run, shape (samples + 1,)."""
    law = SensitivityLaw(replay=Replay(window=samples))
    identifier = Identifier(ROD.model, ROD.sensors, law, u0=0.0)
    spent = []
    for t, z, inputs in ROD.samples(samples):
        begun = process_time()
        identifier.step(t, z, inputs)
        spent.append(process_time() - begun)
    return np.array(spent)


def replay(samples: int = SAMPLES) -> Outcome:
    """Time each call of a run whose window holds all of so many samples."""
    # All runs do the same, call by call: what one of them takes longer is not its own work.
    spent = np.min([_spent(samples) for _ in range(RUNS)], axis=0)
    # The first sample has no step, and the first step assembles what all others use.
    first, calls = np.split(spent[1:] / np.median(spent), [1])
    late, beyond = float(calls[len(calls) // 2 :].max()), int((calls > LONGEST).sum())
    rows = [
        (name, *np.quantile(part, (0.5, 0.99, 0.999)).tolist(), float(part.max()))
        for name, part in (("all", calls), ("second half", calls[len(calls) // 2 :]))
    ]
    columns = ("calls", "median", "99 %", "99.9 %", "longest")
    table = Table(f"Calls of a run of {samples} samples, in medians of all", columns, rows)
    checks = [
        Check("longest call / median call", float(calls.max()), LONGEST, "<="),
        Check("longest call of the second half / median call", late, LONGEST, "<="),
    ]
    note = (
        f"Processor times of a rod of 31 nodes with 2 unknowns, of each call the least of "
        f"{RUNS} runs; {beyond} calls took more than "
        f"{LONGEST:g} medians. The first step, which assembles the matrices, is not among them: it "
        f"took {first[0]:.3g}."
    )
    return Outcome(tables=[table], checks=checks, notes=[note])
