"""Journals that are damaged by a bit or cut off: an error, never other numbers."""

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

CUT = 0.25  # share of the journals that are cut off; in the others one bit is changed


def damaged_journals(plan: Plan) -> Outcome:
    """Damage copies of a journal, and read them."""
    rng = np.random.default_rng(plan.seed)
    told = silent = 0
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
            found = _read(copy, expected)
            told += found is None
            silent += found is False
    table = Table(
        f"Damaged journals of {records.sizes['time']} estimates",
        ("damaged", "told", "read, nothing different", "different"),
        [(plan.flips, told, plan.flips - told - silent, silent)],
    )
    return Outcome(
        tables=[table],
        checks=[Check("damaged journals: numbers that differ and are not told", silent, 0, "<=")],
    )


def _damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a journal that is cut off, or one bit of which is another."""
    place = int(rng.integers(len(content)))
    if rng.random() < CUT:
        return content[:place]
    other = bytearray(content)
    other[place] ^= 1 << int(rng.integers(8))
    return bytes(other)


def _read(path: Path, expected: dict[int, Record]) -> bool | None:
    """Return whether a journal is read as it was; None if it says that it is damaged."""
    try:
        with Journal.open(path) as kept:
            found = dict(kept.after(0))
            _ = kept.events, kept.counts, kept.position
            list(kept.samples())
    except RunError:
        return None
    return found.keys() == expected.keys() and all(same(found[k], expected[k]) for k in expected)
