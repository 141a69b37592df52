"""Checks of results that were once wrong without a warning.

Each part is a module whose function `checks` returns its checks. The correct value comes from a
computation without livepde, or from a definition.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from benchmarks.jobs import each
from livepde.diagnostics.check_report import Check
from livepde.runs import Outcome

__all__ = ["PARTS", "silent"]

PARTS = {
    "smoother": "a reading states its noise: smoother and filter agree at the last sample",
    "moving": "unknowns that move between sparse samples",
    "unjudged": "a run that was not tested is not trusted",
    "partial": "the gradient law that tunes itself, with partial data",
    "repeats": "rows that arrive twice, and clocks that go back",
    "sensors": "sensors that fail for a while, and wild first rows",
    "start": "boundary values of the start, and what the numbers of an estimate are",
    "checkpoint": "checkpoints of another problem, results that are pickled",
    "paper": "the paper's law: stages, damping, failed steps",
}


def _part(name: str) -> list[Check]:
    checks: list[Check] = import_module(f"benchmarks.silent.{name}").checks()
    return checks


def silent(names: Sequence[str], workers: int | None = None, *, progress: bool = False) -> Outcome:
    """Run the named parts, and return their checks in the order of the names."""
    jobs = [(name,) for name in names]
    done = dict(each(_part, jobs, "parts", workers=workers or 2, progress=progress))
    return Outcome(checks=[check for (name,) in jobs for check in done[(name,)]])
