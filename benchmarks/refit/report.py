"""Tables and checks of the scores of all priors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from benchmarks.refit.jumps import AT, JumpTrial
from benchmarks.refit.problems import PROBLEMS
from benchmarks.refit.trial import Trial
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome

MEDIAN_PASSES = 9.0
LEVEL = 0.9  # share of the fits with bounded passes, and of fits that outliers must not move
TIMES = 2.0  # largest median processor time of the refits over SciPy's
CLAIM = 1e-3  # largest relative difference between the cost by livepde and by the lean model
KEPT = 3.0  # standard deviations, largest shift of a constant while another unknown jumps
WIDENED = 1.2  # largest ratio of its standard deviations after and before the first jump

NOTES = (
    "cost: half of the squared misfit in standard deviations of the noise plus half of the squared "
    "distance from the prior, by a forward model that shares no code with livepde. best: smallest "
    'cost of livepde and SciPy\'s least_squares ("lm" and "trf", from the prior and the truth). '
    "reached: at most max(1.001 best, best + 0.5). silent: missed, but reported as converged and "
    "without `do not trust`. passes: passes over all samples. time: processor time in addition to "
    "a filter that processes each sample once, relative to the faster SciPy method that reaches "
    "the best cost from the prior; run: time of the whole run. outliers: 20 % of the readings are "
    "10 to 100 standard deviations off, for every second prior; kept: within one standard "
    "deviation of the best fit without outliers.",
)


def outcome(trials: Iterable[Trial], jumps: Sequence[JumpTrial]) -> Outcome:
    """Return tables and checks of all trials."""
    grouped: dict[str, list[Trial]] = {}
    for item in trials:
        grouped.setdefault(item.problem, []).append(item)
    order = [name for name in PROBLEMS if name in grouped]
    checks = [check for name in order for check in _checks(name, grouped[name])]
    tables = [_overview(grouped, order)] if order else []
    missed = [item for name in order for item in grouped[name] if not item.reached]
    if missed:
        tables.append(_missed(missed))
    if jumps:
        tables.append(_jumps(jumps))
        for name in dict.fromkeys(item.process for item in jumps):
            checks += _jump_checks(name, [item for item in jumps if item.process == name])
    return Outcome(tables, checks, NOTES if order else ())


def _checks(name: str, trials: Sequence[Trial]) -> Iterator[Check]:
    problem = PROBLEMS[name]
    reached = float(np.mean([item.reached for item in trials]))
    yield Check(f"{name}: share that reaches the best cost", reached, problem.converging, ">=")
    silent = sum(item.silent for item in trials)
    yield Check(f"{name}: wrong without a word", float(silent), 0.0, "<=")
    passes = [item.fit.passes for item in trials]
    yield Check(f"{name}: passes, median", float(np.median(passes)), MEDIAN_PASSES, "<=")
    most = float(np.quantile(passes, LEVEL))
    yield Check(f"{name}: passes, nine of ten", most, problem.most_passes, "<=")
    if np.isfinite(claims := _claims(trials)).any():
        worst = float(np.nanmax(claims))
        yield Check(f"{name}: reported cost, relative difference", worst, CLAIM, "<=")
    ratios = [item.ratio for item in trials if np.isfinite(item.ratio)]
    if ratios:
        text = f"{name}: processor time / SciPy, median"
        yield Check(text, float(np.median(ratios)), TIMES, "<=")
    if np.isfinite(share := _kept(trials)):
        text = f"{name}: outliers, share within one standard deviation"
        yield Check(text, share, LEVEL, ">=")


def _claims(trials: Sequence[Trial]) -> list[float]:
    """Return the relative errors of reported costs; NaN if no cost is reported."""
    # The best cost is known to half a unit. Smaller differences do not count.
    return [abs(t.fit.claimed - t.fit.cost) / max(t.fit.cost, 0.5 / CLAIM) for t in trials]


def _kept(trials: Sequence[Trial]) -> float:
    """Return the share of fits that outliers did not move; NaN without such fits."""
    run = [item.shifted for item in trials if not np.isnan(item.shifted)]
    return float(np.mean(np.array(run) <= 1.0)) if run else np.nan


def _overview(grouped: dict[str, list[Trial]], order: Sequence[str]) -> Table:
    rows = []
    for name in order:
        trials = grouped[name]
        passes = [item.fit.passes for item in trials]
        seconds = [item.fit.seconds / item.scipy_seconds for item in trials]
        rows.append(
            [
                name,
                len(trials),
                sum(item.reached for item in trials),
                sum(np.isfinite(item.scipy_seconds) for item in trials),
                sum(item.silent for item in trials),
                float(np.median(passes)),
                float(np.quantile(passes, LEVEL)),
                _median([item.ratio for item in trials]),
                _median(seconds),
                _kept(trials),
            ]
        )
    columns = ["problem", "priors", "reached", "SciPy reached", "silent", "passes", "90 %"]
    columns += ["time/SciPy", "run/SciPy", "outliers kept"]
    return Table("Fits of stored samples from distant priors", columns, rows)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else np.nan


def _missed(trials: Sequence[Trial]) -> Table:
    rows = [
        [
            item.problem,
            item.seed,
            item.best,
            item.fit.cost,
            *item.scipy.reached.values(),
            item.fit.converged,
            item.fit.level,
            item.fit.failure,
        ]
        for item in trials
    ]
    columns = ["problem", "seed", "best", "livepde", "lm", "trf", "converged", "level", "failure"]
    return Table("Fits that miss the best known cost", columns, rows)


def _jumps(trials: Sequence[JumpTrial]) -> Table:
    rows = [[t.process, t.seed, t.one, t.every, t.shift, t.widest] for t in trials]
    columns = [
        "process",
        "seed",
        "one may jump",
        "all may jump",
        "constant moved",
        "constant widened",
    ]
    return Table(f"Detected jumps of {len(AT)}, of one unknown among two", columns, rows)


def _jump_checks(name: str, trials: Sequence[JumpTrial]) -> Iterator[Check]:
    jumps = len(AT) * len(trials)
    one, every = (sum(getattr(t, name) for t in trials) / jumps for name in ("one", "every"))
    yield Check(f"jumps, {name}: found where one unknown may jump", one, 1.0, ">=")
    yield Check(f"jumps, {name}: found, one may jump less all may jump", one - every, 0.0, ">=")
    shift, widest = (max(getattr(t, name) for t in trials) for name in ("shift", "widest"))
    yield Check(f"jumps, {name}: constant moved, in standard deviations", shift, KEPT, "<=")
    text = f"jumps, {name}: standard deviation of the constant / before"
    yield Check(text, widest, WIDENED, "<=")
