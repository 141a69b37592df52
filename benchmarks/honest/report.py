"""Tables and checks of the scores of many twins."""

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
Results: TypeAlias = Mapping[tuple[str, str], Sequence[Run]]

ENOUGH = 40  # number of twins from which the bounds on coverage are used unchanged
CHANCE = 0.005  # probability that chance breaks the bound for fewer twins, on each side
SINGLE = 1e-4  # this probability for a single unknown and time; there are hundreds of them
WIDTH = 1.3  # largest median width over the width of the batch posterior
SMOOTHED_COVERAGE = (0.90, 0.98)
ERROR = 1.2  # largest error over the error of the batch fit
SMOOTHED = 1.1  # largest error of the smoother over the error of the batch fit
WIDEST = 1.5  # largest width over the width of the prior
SHIFT = 0.5  # largest shift of an estimate by a spike, in standard deviations
CONSTANT = 0.90  # smallest coverage of a constant in a problem with a moving unknown
MOVING = {"flux": "k", "warm-flux": "k"}
"""Problem with a moving unknown -> its constant unknown."""


def outcome(runs: Iterable[Run]) -> Outcome:
    """Return tables and checks of runs."""
    grouped: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        grouped.setdefault((run.problem, run.kind), []).append(run)
    order = [(p, k) for k in KINDS for p in PROBLEMS if (p, k) in grouped]
    kept: Results = {key: grouped[key] for key in order}
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
    "Coverage: share of truths in their 95 % interval, for a field the share of vertices; columns "
    "10 % to 100 % are shares of the run. Widths and errors are in the Gaussian coordinates of the "
    "prior (the logarithm of positive unknowns). width/batch: median width over the width of a "
    "batch posterior of the same samples, with the code of the truth as model. error/fit: root "
    "mean square error at the end over the error of the batch fit of all data without the spike. "
    "widest/prior: width of the widest interval over the prior's. mean z: mean error at the end in "
    "standard deviations of the estimate, unsigned for a field.",
    f"With fewer than {ENOUGH} twins, bounds on coverage are relaxed. If the true coverage equals "
    f"the bound, chance breaks the relaxed bound with probability {CHANCE:g} on each side.",
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
    """Return coverage and RMS error of the smoother for an unknown, and RMS error of the fit."""
    j = list(PROBLEMS[problem].latents).index(label)
    scores = [run.smoothed for run in several if run.smoothed is not None]
    covered = float(np.mean([one.covered[j] for one in scores]))
    error, fit = (
        float(np.sqrt(np.mean([values[j] ** 2 for values in each])))
        for each in ([one.error for one in scores], [one.fit for one in scores])
    )
    return covered, error, fit


def _smoothed(results: Results) -> Iterator[Table]:
    """Yield the table of the smoother, if it was run for any twin."""
    rows = []
    for (problem, kind), several in results.items():
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


def _pooled_checks(results: Results) -> Iterator[Check]:
    """Yield checks of the coverage of each kind at each time, over all problems."""
    for kind, about in KINDS.items():
        several = [runs for (_, k), runs in results.items() if k == kind]
        if about.coverage is None or not several:
            continue
        shares = np.mean(
            [np.mean([run.covered.mean(axis=1) for run in runs], axis=0) for runs in several],
            axis=0,
        )
        for share, value in zip(SHARES, shares, strict=True):
            text = f"all problems, {kind}: coverage after {share:.0%} of the run"
            yield _coverage(text, np.array(value), about.coverage, min(map(len, several)))


def _overview(results: Results) -> Table:
    rows = []
    for (problem, kind), several in results.items():
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
    return Table("Coverage of 95 % intervals with default options", columns, rows)


def _details(results: Results) -> Table:
    rows = []
    for (problem, kind), several in results.items():
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
    """Return the largest value except NaN; NaN if no value is finite."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")
