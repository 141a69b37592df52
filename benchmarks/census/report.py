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

WRONG = 3.0  # standard deviations from which an estimate counts as wrong
SILENT = 0.01  # largest share of all runs that are trusted although an estimate is wrong
SILENT_WRONG = 0.03  # largest share of faulty runs that are trusted although an estimate is wrong
GRAVE = 0.2  # relative error that may be trusted in `FALSE` of the faulty runs
NEAR, REFUSED = 0.05, 0.2  # largest share of "do not trust" among runs with a smaller error
FALSE = 0.02  # largest share of correct runs that are doubted
COVERED = 0.90  # smallest coverage of intervals with model errors in usable faulty runs
COVERED_CAUTION = 0.95  # smallest coverage of these intervals in faulty runs with a caution
WIDER = 1.1, 1.15, 1.5  # largest median, mean and 95 % quantile of their relative widths, no fault
RANKED = 0.6  # smallest rank correlation of reported effect and actual error
NAMED = 0.70  # smallest share of doubted runs that name the cause, if it can be named


def outcome(scores: Sequence[Score]) -> Outcome:
    """Return tables, checks and notes of all runs."""
    whole = [score for score in scores if not score.failure]
    sound = [score for score in whole if not score.fault]
    silent = [s for s in whole if s.verdict == "trusted" and s.off > WRONG]
    shown_silent = [s for s in silent if not s.trace < VISIBLE]
    false = [s for s in sound if s.verdict != "trusted"]
    hidden = [s for s in whole if s.trace < VISIBLE]
    shown = [s for s in whole if not s.trace < VISIBLE]
    doubted = [s for s in shown if s.named is not None and s.verdict != "trusted"]
    named = [s for s in doubted if s.named]
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
        Check("cause among the first two", _share(named, doubted), NAMED, ">="),
        Check("runs that ended early", len(scores) - len(whole), 0, "<="),
    ]
    allowed, more = _intervals(wrong, sound)
    checks += more
    rows = []
    for fault in dict.fromkeys(score.fault for score in scores):
        runs = [score for score in whole if score.fault == fault]
        if runs:
            rows.append(_row(fault, runs))
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
    tables = [Table("Verdicts by fault", columns, rows), allowed]
    tables.append(
        Table(
            "Trusted wrong results and false alarms",
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
                    s.sentence[:160],
                ]
                for s in [*silent, *false]
            ],
        )
    )
    notes = [
        "off: runs with an error of more than three reported standard deviations; told: share of "
        "runs with caution or do not trust; silent: runs that are off and trusted; named: share of "
        "doubted runs with the right cause among the first two; delay: median and 90 % quantile of "
        "the samples from a fault in the middle of the run to the verdict.",
        "trace: median norm of the residuals of a best fit of noise-free readings by the truth's "
        "own code, relative to the noise (none for noise, start and settings); hidden: runs with a "
        f"trace below {VISIBLE:g}, where the unknowns absorb the fault and no test of the readings "
        f"can detect it ({len(hidden)} runs in total).",
        f"{len(whole)} runs, {len(sound)} without a fault; delays of all late faults: median "
        f"{_quantile(delays, 0.5)}, 90 % quantile {_quantile(delays, 0.9)}.",
    ]
    return Outcome(
        tables,
        checks,
        notes + [f"{s.problem}, {s.fault}: {s.failure}" for s in scores if s.failure],
    )


def _intervals(wrong: Sequence[Score], sound: Sequence[Score]) -> tuple[Table, list[Check]]:
    """Return a table and checks of intervals with model errors."""
    usable = [s for s in wrong if s.verdict in ("trusted", "caution")]
    parts = {
        "wrong, trusted or caution": usable,
        "wrong, caution": [s for s in wrong if s.verdict == "caution"],
        "wrong, do not trust": [s for s in wrong if s.verdict == "do not trust"],
        "nothing": sound,
    }
    rows, numbers = [], {}
    for name, scores in parts.items():
        each = np.array([row for score in scores for row in score.allowed], dtype=float)
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
    title = "Intervals with model errors (width relative to intervals without them)"
    return Table(title, columns, rows), checks


def _rank(scores: Sequence[Score]) -> float:
    """Return the rank correlation of the reported effects and the actual errors."""
    every = np.array([row for score in scores for row in score.allowed], dtype=float)
    if len(every) < 3:
        return float("nan")
    return float(spearmanr(every[:, 3], every[:, 4]).statistic)


def _share(subset: Sequence[Score], of: Sequence[Score]) -> float:
    return len(subset) / len(of) if of else float("nan")


def _quantile(values: Sequence[int], share: float) -> str:
    return f"{np.quantile(values, share):.0f}" if values else "–"


def _row(fault: str, runs: Sequence[Score]) -> list[object]:
    off = [s for s in runs if s.off > WRONG]
    traces = [s.trace for s in runs if np.isfinite(s.trace)]
    doubted = [s for s in runs if s.verdict != "trusted"]
    known = [s.named for s in doubted if s.named is not None]
    delays = [s.delay for s in runs if s.delay is not None and s.delay >= 0 and not s.early]
    return [
        FAULTS[fault].text if fault else "nothing",
        len(runs),
        round(float(np.median(traces)), 1) if traces else None,
        sum(s.trace < VISIBLE for s in runs),
        len(off),
        round(len(doubted) / len(runs), 2),
        sum(s.verdict == "trusted" for s in off),
        round(float(np.mean(known)), 2) if known else None,
        _quantile(delays, 0.5),
        _quantile(delays, 0.9),
    ]
