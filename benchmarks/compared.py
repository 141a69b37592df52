"""Recommendations of `livepde compare` for wrong tables and wrong cases, without a hint.

Each walk of docs/first-hour.md has one fault that a setting of the case can correct. A channel is
late, scaled, exchanged, in degrees Fahrenheit or shifted by a constant, or the case has a wrong
position or a wrong initial value. The verdict of the recommended variant should be `trusted` or
`caution`, and its intervals should contain the truth.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks import ROOT
from benchmarks.first_hour import FOLDER, TABLES, save
from benchmarks.jobs import each
from benchmarks.wrong_channels import FAULTS, Fault, with_fault
from livepde.cases import load
from livepde.cases.proposals import proposed
from livepde.cases.read import parse
from livepde.cases.recommendation import recommended
from livepde.cases.variants import AS_STATED, Variant, run_variant
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome

RIGHT = 0.6  # smallest share of usable variants whose intervals contain the truth
WRONG = 0.03  # largest share of trusted variants with an error larger than `FAR`
FAR = 3.0  # standard deviations, as in the census: correct 95 % intervals miss in 5 %
TWO_SIDED = 1.96  # standard deviations from the middle of a 95 % interval to its ends
USABLE = "trusted", "caution"


class Stated(NamedTuple):
    """Case of a walk with a wrong setting."""

    walk: str
    setting: str

    def __str__(self) -> str:
        return f"{self.walk}: {self.setting}"


WRONGS: tuple[Fault | Stated, ...] = (
    *FAULTS,
    Fault("heater", ("T_30",), "offset", 1.5),
    Fault("heater", ("T_60",), "offset", -1.0),
    Fault("furnace", ("T_3",), "offset", 2.0),
    Fault("wall", ("T_outside",), "offset", 1.0),
    Fault("pumping", ("OW2",), "offset", 0.1),
    Stated("heater", "channels.T_30.at='34 mm'"),
    Stated("heater", "channels.T_10.at='12 mm'"),
    Stated("heater", "initial='23 degC'"),
    Stated("furnace", "channels.T_3.at='45 mm'"),
    Stated("furnace", "initial='35 degC'"),
    Stated("column", "initial=0.1"),
    Stated("pumping", "channels.OW2.at='80 m'"),
)
QUICK = tuple(one for one in WRONGS if str(one) in ("heater: T_60 offset", "column: initial=0.1"))


class Ended(NamedTuple):
    """Result of a comparison.

    Attributes
    ----------
    before, level
        Verdict levels of the case itself, and of the recommended variant.
    variant
        Name of the recommended variant.
    outside
        Unknowns whose truth lies outside their intervals.
    off
        Largest error of an unknown, in standard deviations.
    """

    before: str
    level: str
    variant: str
    outside: str
    off: float


def compared(
    wrongs: Sequence[Fault | Stated],
    *,
    seeds: int,
    workers: int | None = None,
    progress: bool = False,
) -> Outcome:
    """Compare variants of each wrong case.

    Parameters
    ----------
    seeds
        Number of truths of each wrong case.
    workers
        Processes, default one for each processor.
    """
    todo = [(wrong, seed) for wrong in wrongs for seed in range(seeds)]
    rows, right, trusted = [], 0, 0
    runs = each(_ended, todo, "cases", workers=workers or os.cpu_count() or 1, progress=progress)
    for (wrong, seed), ended in runs:
        right += not ended.outside and ended.level in USABLE
        trusted += ended.off > FAR and ended.level == "trusted"
        rows.append((str(wrong), seed, *ended[:3], ended.outside or "–", ended.off))
    columns = ("wrong", "truth", "verdict", "of the variant", "variant", "truth outside of", "off")
    share = right / len(todo)
    checks = [
        Check("recommended variants that are usable and right", share, RIGHT, ">="),
        Check("recommended variants that are trusted and wrong", trusted / len(todo), WRONG, "<="),
    ]
    title = "livepde compare without a hint"
    return Outcome(tables=[Table(title, columns, sorted(rows))], checks=checks)


def _ended(wrong: Fault | Stated, seed: int) -> Ended:
    """Compare variants of one wrong case, and return the result."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / FOLDER.relative_to(ROOT)
        shutil.copytree(FOLDER, folder)
        path = folder / f"{wrong.walk}.toml"
        header, table, truths = TABLES[wrong.walk](seed)
        settings: list[str] = []
        if isinstance(wrong, Stated):
            settings = [wrong.setting]
        else:
            channels = load(path).spec.channels
            columns = {name: str(item.column) for name, item in channels.items()}
            table = with_fault(wrong, header, table, columns)
        save(folder / f"{wrong.walk}.csv", header, table)
        base = run_variant(path, settings, Variant(AS_STATED))
        if base.error:
            raise RuntimeError(f"{wrong}: {base.error}")
        prepared = load(path, settings=parse(settings)).prepare()
        variants = proposed(prepared, base)
        best = recommended(base, [run_variant(path, settings, each) for each in variants])
    known = {name: one for name, one in best.estimates.items() if name in truths}
    outside = [name for name, one in known.items() if not one.low <= truths[name] <= one.high]
    off = max(
        abs(truths[name] - one.value) / (one.high - one.low) * 2.0 * TWO_SIDED
        for name, one in known.items()
    )
    return Ended(base.level, best.level, best.variant.name, ", ".join(outside), off)
