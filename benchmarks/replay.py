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
from livepde.runs.outcome import Check, Outcome, Table

__all__ = ["replay"]

SAMPLES = 8_000
LONGEST = 20.0  # medians that one call may take
ROD = Rod(31, 2, "channels")


def replay(samples: int = SAMPLES) -> Outcome:
    """Time each call of a run whose window holds all of so many samples."""
    law = SensitivityLaw(replay=Replay(window=samples))
    identifier = Identifier(ROD.model, ROD.sensors, law, u0=0.0)
    spent = []
    for t, z, inputs in ROD.samples(samples):
        begun = process_time()
        identifier.step(t, z, inputs)
        spent.append(process_time() - begun)
    calls = np.array(spent[1:]) / np.median(spent)
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
        f"Processor times of a rod of 31 nodes with 2 unknowns; {beyond} calls took more than "
        f"{LONGEST:g} medians."
    )
    return Outcome(tables=[table], checks=checks, notes=[note])
