"""Tables and checks of the census."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import spearmanr

from benchmarks.census.faults import FAULTS
from benchmarks.census.trace import VISIBLE
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome

if TYPE_CHECKING:
    from benchmarks.census.run import Score

WRONG = 3.0  # standard deviations
SILENT = 0.01  # share of all runs that are wrong and trusted, at most
SILENT_WRONG = 0.03  # share of wrong runs that are trusted and off, at most
GRAVE = 0.2  # relative error that may be trusted in `FALSE` of the wrong runs
NEAR, REFUSED = 0.05, 0.2  # of runs with a smaller error, at most this share are not to be trusted
FALSE = 0.02  # share of sound runs that are doubted, at most
COVERED = 0.90  # share of numbers of wrong runs in the interval that allows for model errors
COVERED_CAUTION = 0.95  # the same of runs with a caution
WIDER = 1.1, 1.15, 1.5  # median, mean and 95 % quantile of its width where nothing is wrong
RANKED = 0.6  # rank correlation of the stated effect with the error made
NAMED = 0.70  # share of doubted runs with a cause that can be named in which it is, at least


def outcome(scores: Sequence[Score]) -> Outcome:
    """Return tables and checks."""
    whole = [score for score in scores if not score.failure]
    sound = [score for score in whole if not score.fault]
    silent = [s for s in whole if s.verdict == "trusted" and s.off > WRONG]
    shown_silent = [s for s in silent if not s.trace < VISIBLE]
    false = [s for s in sound if s.verdict != "trusted"]
    hidden = [s for s in whole if s.trace < VISIBLE]
    shown = [s for s in whole if not s.trace < VISIBLE]
    told = [s for s in shown if s.named is not None and s.verdict != "trusted"]
    delays = [s.delay for s in whole if s.delay is not None and s.delay >= 0 and not s.early]
    wrong = [score for score in whole if score.fault]
    grave = [s for s in wrong if s.verdict == "trusted" and s.error > GRAVE]
    near = [s for s in wrong if s.error < NEAR]
    refused = [s for s in near if s.verdict == "do not trust"]
    strong = [s for s in wrong if not s.weak]
    checks = [
        Check("wrong by three deviations and trusted", _share(silent, whole), SILENT, "<="),
        Check("the same of wrong runs", _share(silent, wrong), SILENT_WRONG, "<="),
        Check(
            "the same of wrong runs with many data",
            _share([s for s in silent if not s.weak], strong),
            SILENT,
            "<=",
        ),
        Check("error above 20 % and trusted", _share(grave, wrong), FALSE, "<="),
        Check("error below 5 % and do not trust", _share(refused, near), REFUSED, "<="),
        Check("the same of those with a trace", _share(shown_silent, shown), SILENT, "<="),
        Check("nothing wrong and doubted", _share(false, sound), FALSE, "<="),
        Check("cause among the first two", _share([s for s in told if s.named], told), NAMED, ">="),
        Check("runs that ended early", len(scores) - len(whole), 0, "<="),
    ]
    allowed, found = _intervals(wrong, sound)
    checks += found
    rows = []
    for fault in dict.fromkeys(score.fault for score in scores):
        some = [score for score in whole if score.fault == fault]
        if some:
            rows.append(_row(fault, some))
    columns = [
        "wrong",
        "runs",
        "trace",
        "hidden",
        "off",
        "told",
        "silent",
        "named",
        "delay",
        "90 %",
    ]
    tables = [Table("What runs say of themselves", columns, rows), allowed]
    told_of = [*silent, *false]
    tables.append(
        Table(
            "Silent wrong answers and false alarms",
            ["wrong", "problem", "seed", "stated", "level", "trace", "off", "verdict", "said"],
            [
                [
                    s.fault or "nothing",
                    s.problem,
                    s.seed,
                    s.stated,
                    s.level,
                    round(s.trace, 1) if np.isfinite(s.trace) else None,
                    round(s.off, 1),
                    s.verdict,
                    s.said[:160],
                ]
                for s in told_of
            ],
        )
    )
    notes = [
        "off: runs with an unknown more than three reported standard deviations off; told: share "
        "with a verdict of caution or do not trust; silent: off and trusted; named: share of those "
        "told whose cause is among the first two; delay: median and 90 % quantile of the samples "
        "from a fault in the middle of the run to the verdict.",
        "trace: norm of what is left of readings without noise after the best fit of the truth's "
        "own code, over the noise, median (none for noise, start and settings); hidden: runs in "
        f"which it is below {VISIBLE:g}, so that the unknowns take the fault up and no test of the "
        f"readings can tell ({len(hidden)} runs in all).",
        f"{len(whole)} runs, {len(sound)} with nothing wrong; delays of all late faults: median "
        f"{_quantile(delays, 0.5)}, 90 % {_quantile(delays, 0.9)}.",
    ]
    return Outcome(
        tables,
        checks,
        notes + [f"{s.problem}, {s.fault}: {s.failure}" for s in scores if s.failure],
    )


def _intervals(wrong: Sequence[Score], sound: Sequence[Score]) -> tuple[Table, list[Check]]:
    """Return the table of intervals that allow for errors of the model, and its checks."""
    usable = [s for s in wrong if s.verdict in ("trusted", "caution")]
    parts = {
        "wrong, trusted or caution": usable,
        "wrong, caution": [s for s in wrong if s.verdict == "caution"],
        "wrong, do not trust": [s for s in wrong if s.verdict == "do not trust"],
        "nothing": sound,
    }
    rows, numbers = [], {}
    for name, some in parts.items():
        each = np.array([row for score in some for row in score.allowed], dtype=float)
        if not len(each):
            continue
        plain, wide, wider, *_ = each.T
        quantiles = np.quantile(wider, 0.5), wider.mean(), np.quantile(wider, 0.95)
        numbers[name] = float(wide.mean()), [float(number) for number in quantiles]
        rows.append([name, len(each), round(float(plain.mean()), 2), round(float(wide.mean()), 2)])
        rows[-1] += [round(number, 2) for number in numbers[name][1]]
    columns = ["runs", "numbers", "plain holds", "allowing holds", "width", "mean", "95 %"]
    nothing = (float("nan"), [float("nan")] * 3)
    widths = numbers.get("nothing", nothing)[1]
    weak, strong = [s for s in wrong if s.weak], [s for s in wrong if not s.weak]
    held = [numbers.get(name, nothing)[0] for name in parts]
    checks = [
        Check("allowing interval holds the truth", held[0], COVERED, ">="),
        Check("the same of runs with a caution", held[1], COVERED_CAUTION, ">="),
        Check("its width where nothing is wrong, median", widths[0], WIDER[0], "<="),
        Check("the same, mean", widths[1], WIDER[1], "<="),
        Check("the same, 95 %", widths[2], WIDER[2], "<="),
        Check("rank correlation of effect and error", _rank(wrong), RANKED, ">="),
        Check("the same of runs with few data", _rank(weak), RANKED, ">="),
        Check("the same of the others", _rank(strong), RANKED, ">="),
    ]
    title = "Intervals that allow for errors of the model (width over that of the noise alone)"
    return Table(title, columns, rows), checks


def _rank(scores: Sequence[Score]) -> float:
    """Return the rank correlation of the stated effects with the errors made."""
    every = np.array([row for score in scores for row in score.allowed], dtype=float)
    if len(every) < 3:
        return float("nan")
    return float(spearmanr(every[:, 3], every[:, 4]).statistic)


def _share(some: Sequence[Score], of: Sequence[Score]) -> float:
    return len(some) / len(of) if of else float("nan")


def _quantile(values: Sequence[int], share: float) -> str:
    return f"{np.quantile(values, share):.0f}" if values else "–"


def _row(fault: str, some: Sequence[Score]) -> list[object]:
    off = [s for s in some if s.off > WRONG]
    traces = [s.trace for s in some if np.isfinite(s.trace)]
    told = [s for s in some if s.verdict != "trusted"]
    known = [s.named for s in told if s.named is not None]
    delays = [s.delay for s in some if s.delay is not None and s.delay >= 0 and not s.early]
    return [
        FAULTS[fault].text if fault else "nothing",
        len(some),
        round(float(np.median(traces)), 1) if traces else None,
        sum(s.trace < VISIBLE for s in some),
        len(off),
        round(len(told) / len(some), 2),
        sum(s.verdict == "trusted" for s in off),
        round(float(np.mean(known)), 2) if known else None,
        _quantile(delays, 0.5),
        _quantile(delays, 0.9),
    ]
