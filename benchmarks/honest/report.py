"""Scores of many twins as tables and checks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from benchmarks.honest.noise import KINDS
from benchmarks.honest.problems import PROBLEMS
from benchmarks.honest.twin import SHARES, Run
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome

Array = NDArray[Any]
Found: TypeAlias = Mapping[tuple[str, str], Sequence[Run]]

ENOUGH = 40  # twins from which the bounds of coverage hold as they stand
CHANCE = 0.005  # probability that chance alone breaks the bound of fewer twins, on each side
SINGLE = 1e-4  # the same for one unknown at one time, of which there are hundreds
WIDTH = 1.3  # median width over that of the batch posterior, at most
SMOOTHED_COVERAGE = (0.90, 0.98)
ERROR = 1.2  # error over that of the batch fit, at most
SMOOTHED = 1.1  # error of the smoother over that of the batch fit, at most
WIDEST = 1.5  # width over that of the prior, at most
SHIFT = 0.5  # that a spike may move an estimate, in standard deviations
CONSTANT = 0.90  # least coverage of a constant beside a moving unknown
MOVING = {"flux": "k", "warm-flux": "k"}
"""Problem with a moving unknown -> the constant beside it."""


def outcome(runs: Iterable[Run]) -> Outcome:
    """Return tables and checks of runs."""
    found: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        found.setdefault((run.problem, run.kind), []).append(run)
    order = [(p, k) for k in KINDS for p in PROBLEMS if (p, k) in found]
    kept: Found = {key: found[key] for key in order}
    checks = [check for key, several in kept.items() for check in _checks(key, several)]
    checks += _pooled_checks(kept)
    failures = sorted(
        {
            f"{r.problem}, {r.kind}, seed {r.seed}: {r.failure}"
            for several in kept.values()
            for r in several
            if r.failure
        }
    )
    tables = [_overview(kept), _details(kept), *_smoothed(kept)]
    return Outcome(tables, checks, [*NOTES, *failures])


NOTES = (
    "Coverage: share of truths in their 95 % interval, for a field of vertices; the columns 10 % "
    "to 100 % are shares of the run. Widths and errors are those of the Gaussian coordinates of "
    "the prior (the logarithm of what is positive). width/batch: median over that of the posterior "
    "of a batch fit of the same samples, whose model is the code of the truth. error/fit: root "
    "mean square at the end over that of the batch fit of all data, of which the spike is left "
    "out. widest/prior: the widest interval over the prior's. mean z: mean error at the end in "
    "standard deviations of the estimate; of a field it has no sign.",
    f"With fewer than {ENOUGH} twins the bounds of coverage are those that chance breaks with a "
    f"probability of {CHANCE:g} on each side if the promised bound just holds.",
)


def _checks(key: tuple[str, str], several: Sequence[Run]) -> Iterator[Check]:
    problem, kind = key
    name, bounds = f"{problem}, {kind}", KINDS[kind].coverage
    covered = np.array([run.covered for run in several])
    if bounds is not None:
        yield _coverage(f"{name}: coverage", covered, bounds, len(several))
        least = float(binom.ppf(SINGLE, len(several), bounds[0])) / len(several)
        lowest = float(covered.mean(axis=0).min())
        yield Check(f"{name}: least coverage of one unknown at one time", lowest, least, ">=")
        if problem in MOVING:
            at = list(PROBLEMS[problem].latents).index(MOVING[problem])
            text = f"{name}: coverage of the constant beside the moving unknown"
            yield _coverage(text, covered[:, :, at], (CONSTANT, 1.0), len(several))
    yield from _smoother_checks(name, problem, several)
    widest = np.array([run.widest for run in several])
    yield Check(f"{name}: widest interval / prior", _largest(widest), WIDEST, "<=")
    if KINDS[kind].right:
        yield Check(f"{name}: median width / batch", _median_width(several), WIDTH, "<=")
        yield Check(f"{name}: error / batch fit", _error_ratio(several), ERROR, "<=")
    if kind == "spike":
        shift = np.array([run.shift for run in several])
        text = f"{name}: largest shift by the spike, in standard deviations"
        yield Check(text, _largest(shift[:, -1]), SHIFT, "<=")
    failed = sum(bool(run.failure) for run in several)
    yield Check(f"{name}: runs that ended early", failed, 0, "<=")


def _smoother_checks(name: str, problem: str, several: Sequence[Run]) -> Iterator[Check]:
    if not any(run.smoothed for run in several):
        return
    for label in PROBLEMS[problem].moving:
        covered, error, fit = _smoothed_scores(problem, label, several)
        text = f"{name}: smoother, coverage of {label}"
        yield _coverage(text, np.array(covered), SMOOTHED_COVERAGE, len(several))
        yield Check(f"{name}: smoother, error of {label} / batch fit", error / fit, SMOOTHED, "<=")


def _smoothed_scores(
    problem: str, label: str, several: Sequence[Run]
) -> tuple[float, float, float]:
    """Return coverage and root mean square errors of smoother and batch fit of an unknown."""
    j = list(PROBLEMS[problem].latents).index(label)
    scores = [run.smoothed for run in several if run.smoothed is not None]
    covered = float(np.mean([one.covered[j] for one in scores]))
    error, fit = (
        float(np.sqrt(np.mean([values[j] ** 2 for values in each])))
        for each in ([one.error for one in scores], [one.fit for one in scores])
    )
    return covered, error, fit


def _smoothed(found: Found) -> Iterator[Table]:
    """Yield the table of the smoother, if it was run."""
    rows = []
    for (problem, kind), several in found.items():
        if any(run.smoothed for run in several):
            for label in PROBLEMS[problem].latents:
                scores = _smoothed_scores(problem, label, several)
                rows.append([problem, kind, len(several), label, *scores])
    if rows:
        columns = ["problem", "kind", "twins", "unknown", "coverage", "error", "error of fit"]
        yield Table(
            "Smoother at all samples; errors in standard deviations of the prior", columns, rows
        )


def _coverage(name: str, covered: Array, bounds: tuple[float, float], twins: int) -> Check:
    low, high = bounds
    if twins < ENOUGH:
        low = float(binom.ppf(CHANCE, twins, low)) / twins
        high = float(binom.ppf(1.0 - CHANCE, twins, high)) / twins
    value = float(covered.mean())
    return Check(name, value, low, ">=") if high >= 1.0 else Check(name, value, (low, high), "in")


def _pooled_checks(found: Found) -> Iterator[Check]:
    """Yield the coverage of each kind at each time, over all problems."""
    for kind, about in KINDS.items():
        several = [runs for (_, k), runs in found.items() if k == kind]
        if about.coverage is None or not several:
            continue
        shares = np.mean(
            [np.mean([run.covered.mean(axis=1) for run in runs], axis=0) for runs in several],
            axis=0,
        )
        for share, value in zip(SHARES, shares, strict=True):
            text = f"all problems, {kind}: coverage after {share:.0%} of the run"
            yield _coverage(text, np.array(value), about.coverage, min(map(len, several)))


def _overview(found: Found) -> Table:
    rows = []
    for (problem, kind), several in found.items():
        covered = np.array([run.covered for run in several])
        by_time = covered.mean(axis=(0, 2))
        shift = np.array([run.shift for run in several])
        rows.append(
            [
                problem,
                kind,
                len(several),
                *map(float, by_time),
                float(covered.mean()),
                _median_width(several),
                _error_ratio(several),
                _largest(np.array([run.widest for run in several])),
                _largest(shift[:, -1]) if kind == "spike" else None,
                sum(run.missed for run in several),
                sum(bool(run.failure) for run in several),
            ]
        )
    columns = [
        "problem",
        "kind",
        "twins",
        *(f"{share:.0%}" for share in SHARES),
        "all",
        "width/batch",
        "error/fit",
        "widest/prior",
        "shift",
        "missed",
        "failed",
    ]
    return Table("Coverage of 95 % intervals, defaults alone", columns, rows)


def _details(found: Found) -> Table:
    rows = []
    for (problem, kind), several in found.items():
        for j, label in enumerate(PROBLEMS[problem].latents):
            covered = np.array([run.covered[:, j] for run in several]).mean(axis=0)
            last = [run.z[-1, j] for run in several]
            width = [run.width[-1, j] for run in several]
            first = [run.width[0, j] for run in several]
            error = [run.error[-1, j] for run in several]
            rows.append(
                [
                    problem,
                    kind,
                    label,
                    *map(float, covered),
                    float(np.mean(last)),
                    float(np.sqrt(np.mean(np.square(last)))),
                    float(np.median(first)),
                    float(np.median(width)),
                    float(np.sqrt(np.mean(np.square(error)))),
                    float(np.sqrt(np.mean([run.fit[j] ** 2 for run in several]))),
                ]
            )
    columns = [
        "problem",
        "kind",
        "unknown",
        *(f"{share:.0%}" for share in SHARES),
        "mean z",
        "rms z",
        "width 10 %",
        "width",
        "error",
        "error of fit",
    ]
    return Table(
        "By unknown; widths and errors in standard deviations of the batch posterior", columns, rows
    )


def _median_width(several: Sequence[Run]) -> float:
    return float(np.median([run.width for run in several]))


def _error_ratio(several: Sequence[Run]) -> float:
    mine = np.mean([np.mean(run.error[-1] ** 2) for run in several])
    fits = np.mean([np.mean(run.fit**2) for run in several])
    return float(np.sqrt(mine / fits))


def _largest(values: Array) -> float:
    """Return the largest of the values; one that is missing beside others is ignored."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")
