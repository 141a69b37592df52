"""Journals with a flipped bit or a missing end give an error, never different numbers."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.faults.damage import same
from benchmarks.faults.plan import Plan
from benchmarks.faults.run import undisturbed_journal
from livepde.errors import RunError
from livepde.records import Record
from livepde.runs import Check, Journal, Outcome, Table

CUT = 0.25  # share of truncated journals; one bit is flipped in the others


def damaged_journals(plan: Plan) -> Outcome:
    """Read damaged copies of a journal, and count detected and silent damage."""
    rng = np.random.default_rng(plan.seed)
    detected = silent = 0
    with TemporaryDirectory() as name:
        folder = Path(name)
        path = undisturbed_journal(folder, min(plan.samples, 1000))
        with Journal.open(path) as kept:
            expected = dict(kept.after(0))
            records = kept.dataset()
        content = path.read_bytes()
        copy = folder / "copy" / path.name
        for _ in plan.watched(plan.flips, "damaged journals"):
            shutil.rmtree(copy.parent, ignore_errors=True)
            copy.parent.mkdir()
            copy.write_bytes(_damaged(content, rng))
            intact = _read(copy, expected)
            detected += intact is None
            silent += intact is False
    table = Table(
        f"Damaged journals of {records.sizes['time']} estimates",
        ("damaged", "told", "read, nothing different", "different"),
        [(plan.flips, detected, plan.flips - detected - silent, silent)],
    )
    return Outcome(
        tables=[table],
        checks=[Check("damaged journals: numbers that differ and are not told", silent, 0, "<=")],
    )


def _damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Truncate the content of a journal, or flip one of its bits."""
    place = int(rng.integers(len(content)))
    if rng.random() < CUT:
        return content[:place]
    other = bytearray(content)
    other[place] ^= 1 << int(rng.integers(8))
    return bytes(other)


def _read(path: Path, expected: dict[int, Record]) -> bool | None:
    """Return whether a journal has the expected records; None if reading reports damage."""
    try:
        with Journal.open(path) as kept:
            found = dict(kept.after(0))
            _ = kept.events, kept.counts, kept.position
            list(kept.samples())
    except RunError:
        return None
    return found.keys() == expected.keys() and all(same(found[k], expected[k]) for k in expected)
