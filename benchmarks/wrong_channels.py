"""The walks of docs/first-hour.md with one wrong channel: late, scaled, exchanged or in °F.

The run of such a table must not be trusted, and must name the channel first.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import ROOT
from benchmarks.first_hour import FOLDER, TABLES, save
from benchmarks.jobs import each
from livepde.cases import load
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome
from livepde.verdict import Verdict

Array = NDArray[Any]
NAMED = 0.8  # smallest share of runs that name the channel first
SCALE = 1.15
WITHOUT = """
Faults that other unknowns explain equally well are excluded: a scale of the rate of a pumping test,
of the heat into a borehole or of a flux plate multiplies the unknowns. In a column with one probe,
and in a pumping test with two wells, either channel may be named, because the data determine only
their ratio: a factor on all readings is equivalent to a factor on T and S.
"""


class Fault(NamedTuple):
    """Fault of one or two channels of a walk.

    Attributes
    ----------
    walk, channels
        Walk, and its faulty channels; if there are several, the run may name either.
    kind
        "late", "scaled", "fahrenheit", "exchanged" or "offset".
    amount
        Delay in sampling intervals of "late", or shift of "offset".
    """

    walk: str
    channels: tuple[str, ...]
    kind: str
    amount: float = 0.0

    def __str__(self) -> str:
        return f"{self.walk}: {' and '.join(self.channels)} {self.kind}"


FAULTS = (
    Fault("pumping", ("OW1",), "late", 10.0),
    Fault("pumping", ("OW1", "OW2"), "scaled"),
    Fault("pumping", ("OW2", "OW1"), "scaled"),
    Fault("pumping", ("Q",), "late", 15.0),
    Fault("pumping", ("OW1", "OW2"), "exchanged"),
    Fault("column", ("c", "c_in"), "scaled"),
    Fault("heater", ("T_30",), "late", 5.0),
    Fault("heater", ("T_30",), "scaled"),
    Fault("heater", ("T_10",), "fahrenheit"),
    Fault("heater", ("T_60",), "fahrenheit"),
    Fault("heater", ("heater",), "late", 10.0),
    Fault("heater", ("heater",), "scaled"),
    Fault("heater", ("T_10", "T_60"), "exchanged"),
    Fault("wall", ("T_inside",), "late", 6.0),
    Fault("wall", ("T_outside",), "late", 6.0),
    Fault("wall", ("T_outside",), "fahrenheit"),
    Fault("wall", ("T_inside", "T_outside"), "exchanged"),
    Fault("wall", ("q",), "late", 6.0),
    Fault("furnace", ("T_2",), "late", 30.0),
    Fault("furnace", ("T_2",), "scaled"),
    Fault("furnace", ("T_cold",), "fahrenheit"),
    Fault("furnace", ("T_2", "T_4"), "exchanged"),
)


def with_fault(fault: Fault, header: Sequence[str], table: Array, columns: dict[str, str]) -> Array:
    """Return a copy of a table with a fault.

    Parameters
    ----------
    columns
        Channel -> its column.
    """
    faulty, t = table.copy(), table[:, 0]
    places = [list(header).index(columns[name]) for name in fault.channels]
    first = places[0]
    if fault.kind == "exchanged":
        faulty[:, places] = table[:, places[::-1]]
    elif fault.kind == "scaled":
        faulty[:, first] *= SCALE
    elif fault.kind == "offset":
        faulty[:, first] += fault.amount
    elif fault.kind == "fahrenheit":
        faulty[:, first] = 1.8 * table[:, first] + 32.0
    else:
        known = np.isfinite(table[:, first])
        # Sampling interval of the sensors: rows of inputs logged at changes lie in between.
        seen = np.isfinite(table[:, -1])
        delay = fault.amount * float(np.median(np.diff(t[seen])))
        late = t[known] + delay
        if known.all():
            faulty[:, first] = np.interp(t, late, table[known, first])
        else:  # an input logged at changes is constant until the next change
            at = np.searchsorted(late, t, side="right") - 1
            faulty[:, first] = table[known, first][np.maximum(at, 0)]
    return faulty


def first_named(verdict: Verdict) -> str:
    """Return the channel that the first finding with a cause or a channel names; default empty."""
    for finding in verdict.findings:
        if finding.causes:
            return finding.causes[0].subject
        if finding.severity == "do not trust" and finding.subject:
            return finding.subject
    return ""


def wrong_channels(faults: Sequence[Fault], *, seeds: int, progress: bool = False) -> Outcome:
    """Run walks with one wrong channel each.

    Parameters
    ----------
    seeds
        Number of truths for each fault.
    """
    todo = [(fault, seed) for fault in faults for seed in range(seeds)]
    rows, trusted, named = [], 0, 0
    for (fault, seed), (level, subject, text) in each(_judged, todo, "tables", progress=progress):
        right = any(name in subject for name in fault.channels)
        trusted += level == "trusted"
        named += right
        rows.append((str(fault), seed, level, subject or "–", "yes" if right else "no", text))
    checks = [
        Check("wrong tables that are trusted", float(trusted), 0.0, "<="),
        Check("share of runs that name the channel first", named / len(todo), NAMED, ">="),
    ]
    columns = ("wrong", "truth", "verdict", "named first", "right", "cause")
    note = " ".join(WITHOUT.split())
    return Outcome(tables=[Table("One wrong channel", columns, rows)], checks=checks, notes=[note])


def _judged(fault: Fault, seed: int) -> tuple[str, str, str]:
    """Return the level of the verdict, the channel that it names first, and the first cause."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / FOLDER.relative_to(ROOT)
        shutil.copytree(FOLDER, folder)
        case = load(folder / f"{fault.walk}.toml")
        columns = {name: str(item.column) for name, item in case.spec.channels.items()}
        header, table, _ = TABLES[fault.walk](seed)
        save(folder / f"{fault.walk}.csv", header, with_fault(fault, header, table, columns))
        prepared = load(folder / f"{fault.walk}.toml").prepare()
        last = prepared.identifier.run(prepared.stream).last
        if last is None:
            raise RuntimeError(f"{fault}: the run has no samples")
        verdict = last.verdict
        texts = [cause.text for finding in verdict.findings for cause in finding.causes]
        return verdict.level, first_named(verdict), (texts or ["–"])[0]
