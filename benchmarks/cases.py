"""Estimates, errors and costs of every case of the project and of its variants.

Each run alternates, sample by sample, with a forward run whose unknowns stay at their prior. The
forward run provides two references: the error of the model without data, and the time of a forward
step, in which the cost of the law is expressed.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from livepde.cases import Prepared, load
from livepde.diagnostics.check_report import Bound, Sense
from livepde.errors import CaseError, LivepdeError
from livepde.laws import Belief, Law, Problem, Report, Status
from livepde.linalg import Array
from livepde.progress import watched
from livepde.records import interval_95, scalars
from livepde.result import Result
from livepde.runs import Check, Outcome, Table, measures, verdict
from livepde.runs.directory import markdown
from livepde.runs.summary import digits, shown
from livepde.stepping import ForwardStage, Interval, advance
from livepde.verdict import MOST

GALLERY = """\
# Gallery

Every case on published measurements or fields, with its variants: estimates with both intervals,
published values, and the checks of the case. *With model errors*: a dash where this interval was
not computed. *Inside*: whether the published value lies in it, else in the plain one. RMSE is one
step ahead and includes the learning phase; *prior* is the RMSE of the model with its unknowns at
their prior. *Time* is the processor time of a sample over the time of a forward step. Figures show
the first run of each case.

**What to expect of measurements.** No model of a field is exact, and a long record shows it. Then
the verdict is `caution` and not `trusted`: use the interval with model errors. `do not trust` means
that no such interval is narrow enough to use, or that the fit failed. `livepde compare` then tests
the likely causes. Its recommendation is shown below each case on measurements.

Experiments of the paper and of examples have [their own page](experiments.md). Written by
`python -m benchmarks cases --gallery docs/gallery --compared 6`.

"""

QUICK = (
    "burgers",
    "horkheim",
    "oude_korendijk",
    "scratch_assay",
    "soil_column",
    "soil_uniform",
    "thermal_response",
)
"""One case for each kind of process; each takes seconds."""
MEASURED = (
    "horkheim",
    "oude_korendijk",
    "scratch_assay",
    "sioux",
    "soil_column",
    "soil_column_immobile",
    "soil_layers",
    "soil_offsets",
    "soil_uniform",
    "streambed_035_layers",
    "streambed_035_uniform",
    "streambed_047",
    "thermal_response",
    "thermal_response_grout",
)
"""Cases on measurements with constant unknowns, for which `livepde compare` is shown."""
WORKERS = 2
WARM_UP = 2  # untimed samples, in which matrices are assembled once


@dataclass(frozen=True)
class Job:
    """Description of one run: a case, or one of its variants with one seed."""

    path: Path
    variant: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    figure: Path | None = None
    compared: int = 0  # variants of `livepde compare`

    @property
    def label(self) -> str:
        """Name of the case and the variant."""
        return f"{self.path.stem}: {self.variant}" if self.variant else self.path.stem


@dataclass(frozen=True)
class Run:
    """Result of a run.

    Attributes
    ----------
    numbers
        Result of `runs.measures`.
    unknowns
        Label -> unit, reference (NaN if none).
    expected
        Expectations of the case on these numbers.
    samples, ratio
        Number of samples, and time of a sample over the time of a forward step.
    prior
        RMSE with the unknowns at their prior.
    verdict
        Level of the last verdict, and its findings except notes.
    intervals
        Label -> ends of the 95 % interval, and of the interval with model errors.
    compared
        Output of `livepde compare --json`; empty if it was not called.
    error
        Reason why the run failed; empty otherwise.
    """

    title: str = ""
    source: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    unknowns: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    expected: Mapping[str, tuple[Sense, Bound]] = field(default_factory=dict)
    samples: int = 0
    ratio: float = math.nan
    prior: float = math.nan
    verdict: str = ""
    intervals: Mapping[str, tuple[float, float, float, float]] = field(default_factory=dict)
    compared: Mapping[str, Any] = field(default_factory=dict)
    error: str = ""


def find_cases(folder: Path | None = None) -> list[Path]:
    """Return the case files in a folder, by default in the nearest 'cases' here or in a parent.

    Raises
    ------
    CaseError
        There are no case files.
    """
    here = Path.cwd()
    folders = [folder] if folder else [base / "cases" for base in (here, *here.parents)]
    for place in folders:
        paths = sorted(place.glob("*.toml"))
        if paths:
            return paths
    raise CaseError(
        f"{folder or here}: there are no case files (*.toml) here"
        + ("." if folder else ", nor in 'cases' here or in a parent folder. Add --folder DIR.")
    )


def _one_thread() -> None:
    """Limit a worker to one thread, since matrices are small and each core has a worker."""
    threadpool_limits(1)


def bench_cases(
    paths: Sequence[Path],
    *,
    progress: bool = False,
    pictures: Path | None = None,
    variants: bool = True,
    compared: int = 0,
) -> tuple[Outcome, list[tuple[Job, Run]]]:
    """Run cases with their variants in separate processes, and execute code that the cases name.

    Parameters
    ----------
    paths
        Case files.
    progress
        Show a bar on standard error.
    variants
        Whether to run the variants of the cases.
    pictures
        Folder for a figure of each case.
    compared
        Variants that `livepde compare` tries on cases with measurements; 0: do not call it.

    Returns
    -------
    outcome
        Two tables, and a check for every number that a case expects.
    runs
        Results of each case and of each variant, averaged over seeds.
    """
    # Workers start with a new interpreter, so that they inherit no threads from this process.
    with ProcessPoolExecutor(WORKERS, get_context("spawn"), _one_thread) as pool:
        order, failed = _jobs(paths, pictures, variants, compared)
        done = _collect(pool, order, progress)
    runs = [(job, _mean(several)) for job, several in _grouped(done)] + failed
    runs.sort(key=lambda item: [path.name for path in paths].index(item[0].path.name))
    checks = [check for job, run in runs for check in _checks(job, run)]
    notes = [f"{job.label}: {run.error}" for job, run in runs if run.error]
    notes.append(
        "time: processor time of a sample over a forward step of the same model, run in turns; "
        "prior: RMSE of the model with its unknowns at their prior."
    )
    return Outcome(_tables(runs), checks, notes), runs


def _jobs(
    paths: Sequence[Path], pictures: Path | None, variants: bool, compared: int
) -> tuple[list[Job], list[tuple[Job, Run]]]:
    """Return the jobs of all cases, and a failed run for each case that cannot be read."""
    order: list[Job] = []
    failed = []
    for path in paths:
        try:
            first, *others = jobs_of(path, pictures, variants)
        except LivepdeError as error:
            failed.append((Job(path), Run(error=str(error))))
            continue
        order += [replace(first, compared=compared * (path.stem in MEASURED)), *others]
    return order, failed


def _collect(pool: Executor, order: Sequence[Job], progress: bool) -> list[tuple[Job, Run]]:
    """Return each job with its run."""
    waiting = {pool.submit(run_job, job): job for job in order}
    done: Iterable[Any] = as_completed(waiting)
    for _ in watched(done, len(order), "runs") if progress else done:
        pass
    return [(job, _outcome(future)) for future, job in waiting.items()]


def _outcome(future: Future[Run]) -> Run:
    """Return a run; an unexpected exception becomes the error of the run."""
    error = future.exception()
    return Run(error=f"{type(error).__name__}: {error}") if error else future.result()


def jobs_of(path: Path, pictures: Path | None = None, variants: bool = True) -> list[Job]:
    """Return the jobs of a case: the case itself, and its variants with all seeds."""
    figure = pictures / f"{path.stem}.png" if pictures else None
    jobs = [Job(path, figure=figure)]
    if not variants:
        return jobs
    for variant in load(path, allow_code=True).spec.variants:
        changed = dict(variant.set)
        for key, value in variant.reference.items():
            changed[f'reference."{key}"'] = value
        for seed in range(variant.seeds):
            seeds = {"data.options.seed": seed} if variant.seeds > 1 else {}
            jobs.append(Job(path, variant.name, changed | seeds))
    return jobs


def run_job(job: Job) -> Run:
    """Run a case together with its forward model; a failure becomes the error of the run."""
    try:
        case = load(job.path, allow_code=True, settings=job.settings)
        prepared = case.prepare()
        data, prior, ratio = _paired(prepared)
    except LivepdeError as error:
        return Run(error=str(error))
    if job.figure is not None:
        from livepde import plots

        plots.overview(data, title=case.title).savefig(job.figure, dpi=120)
    variants = {variant.name: variant.expect for variant in case.spec.variants}
    space = case.model.parameter_space
    return Run(
        title=case.title,
        source=case.source,
        numbers=measures(data),
        unknowns={
            label: (space.unknown_of(label).unit, case.references.get(label, math.nan))
            for label in space.labels
        },
        expected=variants[job.variant] if job.variant else case.expected,
        samples=data.sizes["time"],
        ratio=ratio,
        prior=measures(prior)["rmse"],
        verdict=_verdict(data),
        intervals=_both_intervals(data),
        compared=_compared(job) if job.compared else {},
    )


def _both_intervals(data: xr.Dataset) -> dict[str, tuple[float, float, float, float]]:
    """Return the last intervals of each constant, without and with model errors (NaN if none)."""
    errors, intervals = verdict(data).errors, {}
    allowed = {one.label: one for one in errors.unknowns} if errors is not None else {}
    for label in scalars(data):
        low, high = (float(end[-1]) for end in interval_95(data, label))
        intervals[label] = low, high, math.nan, math.nan
        if label in allowed:
            one = allowed[label]
            intervals[label] = one.plain_low, one.plain_high, one.low, one.high
    return intervals


def _compared(job: Job) -> dict[str, Any]:
    """Return the JSON output of `livepde compare` for a case."""
    command = [sys.executable, "-m", "livepde", "compare", str(job.path), "--json", "--jobs", "1"]
    command += ["--most", str(job.compared), "--allow-code"]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(ended.stdout))


def _verdict(data: xr.Dataset) -> str:
    """Return the level of a verdict and its findings except notes, the most severe first."""
    judged = verdict(data)
    graver = [item for item in judged.findings if item.severity != "note"]
    findings = dict.fromkeys(f"{item.what} {item.subject}".strip() for item in graver)
    return ": ".join(filter(None, (judged.level, ", ".join([*findings][:MOST]))))


# --- a run in turns with a forward run -----------------------------------------------------------


class _Frozen(Law[tuple[Problem, ForwardStage], tuple[Array, Array]]):
    """Law that keeps the parameter at its start, and records the time of its forward steps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def prepare(self, problem: Problem) -> tuple[Problem, ForwardStage]:
        return problem, ForwardStage(problem.model)

    def init(self, work: tuple[Problem, ForwardStage], q0: Array, u0: Array) -> tuple[Array, Array]:
        return u0, q0

    def step(
        self,
        work: tuple[Problem, ForwardStage],
        state: tuple[Array, Array],
        interval: Interval,
    ) -> tuple[tuple[Array, Array], Report]:
        (problem, forward), (u, q) = work, state

        def stage(c: Array, t: float, h: float) -> Array:
            return forward.solve(c, q, h, interval.at(t))

        start = perf_counter()
        end, steps, failure = advance(problem.control, stage, u, interval.t0, interval.t1)
        self.seconds += perf_counter() - start
        status = Status() if failure is None else Status.of(failure)
        end = u if failure is not None else end
        return (end, q), Report(status, problem.predict(end, q, interval.end), steps)

    def belief(self, work: tuple[Problem, ForwardStage], state: tuple[Array, Array]) -> Belief:
        u, q = state
        return Belief(q, u)


def _paired(prepared: Prepared) -> tuple[xr.Dataset, xr.Dataset, float]:
    """Return the datasets of a run and of a forward run, and the ratio of their times."""
    frozen = _Frozen()
    runs = [prepared.identifier, prepared.identifier_with(frozen)]
    every = prepared.case.spec.output.fields_every
    results = [
        Result(one.model, one.observed, one.validation, every, layout=prepared.layout)
        for one in runs
    ]
    seconds = 0.0
    for count, sample in enumerate(prepared.stream):
        start = perf_counter()
        results[0].add(runs[0].step(sample.t, sample.z, sample.inputs))
        seconds += perf_counter() - start
        results[1].add(runs[1].step(sample.t, sample.z, sample.inputs))
        if count == WARM_UP:
            seconds = frozen.seconds = 0.0
    for run, result in zip(runs, results, strict=True):
        if result.last is not None:
            result._settle(run._settled(result.last))
    datasets = [result.to_xarray() for result in results]
    ratio = seconds / frozen.seconds if frozen.seconds else math.nan
    return datasets[0], datasets[1], ratio


# --- report --------------------------------------------------------------------------------------


def _grouped(done: Sequence[tuple[Job, Run]]) -> Iterator[tuple[Job, list[Run]]]:
    """Yield the first job of each case and variant, with the runs of all seeds."""
    groups: dict[tuple[Path, str], list[tuple[Job, Run]]] = {}
    for job, run in done:
        groups.setdefault((job.path, job.variant), []).append((job, run))
    for pairs in groups.values():
        yield pairs[0][0], [run for _, run in pairs]


def _mean(runs: Sequence[Run]) -> Run:
    """Return the mean over seeds, or the first failed run if there is one."""
    first = next((run for run in runs if run.error), runs[0])
    if first.error or len(runs) == 1:
        return first
    return replace(
        first,
        numbers={name: float(np.mean([r.numbers[name] for r in runs])) for name in first.numbers},
        ratio=float(np.mean([run.ratio for run in runs])),
        prior=float(np.mean([run.prior for run in runs])),
    )


def _checks(job: Job, run: Run) -> list[Check]:
    if run.error:
        return [Check(f"{job.label}: runs that failed", 1, 0, "<=")]
    return [
        Check(f"{job.label}: {name}", run.numbers.get(name, math.nan), bound, sense)
        for name, (sense, bound) in run.expected.items()
    ]


def _tables(runs: Sequence[tuple[Job, Run]]) -> list[Table]:
    """Return a table of estimates, and a table of errors, costs and verdicts."""
    rows: list[tuple[Any, ...]] = []
    quality: list[tuple[Any, ...]] = []
    for job, run in runs:
        if run.error:
            quality.append((job.label, *["–"] * 5, "failed", "–"))
            continue
        numbers = run.numbers
        rmse, validation = numbers["rmse"], numbers.get("rmse.validation", math.nan)
        errors = [shown(value) for value in (rmse, validation, run.prior)]
        steps = int(numbers["failed_steps"])
        cost = shown(run.ratio, ".1f")
        quality.append((job.label, *errors, run.samples, cost, steps, run.verdict))
        for label, (unit, reference) in run.unknowns.items():
            estimate = digits(numbers[label], numbers[f"{label}.std"])
            std, ends = numbers[f"{label}.std"], run.intervals[label]
            both = (_interval(ends[:2], std), _interval(ends[2:], std))
            low, high = ends[2:] if math.isfinite(ends[2]) else ends[:2]
            held = "yes" if low <= reference <= high else "no"
            inside = held if math.isfinite(reference) else "–"
            published = shown(reference, ".5g")
            rows.append((job.label, label, *estimate, unit, *both, published, inside))
    columns = ("case", "unknown", "estimate", "± std. dev.", "unit")
    held_by = ("95 %", "with model errors", "reference", "inside")
    more = ("case", "RMSE", "validation", "prior", "samples", "time", "failed steps", "verdict")
    return [Table("Estimates", (*columns, *held_by), rows), Table("Runs", more, quality)]


def _interval(ends: Sequence[float], std: float) -> str:
    """Format an interval with the digits that are significant given the standard deviation."""
    return " to ".join(digits(end, std)[0] for end in ends) if math.isfinite(ends[0]) else "–"


def _recommendation(run: Run) -> list[str]:
    """Return the recommendation of `livepde compare` for a case, as Markdown."""
    if not run.compared:
        return []
    shown = [
        Table(title, table["columns"], table["rows"])
        for title, table in zip(
            ("Compared", "Estimates of the variants"), run.compared["tables"], strict=False
        )
    ]
    variants = {one["name"]: one for one in run.compared["variants"]}
    best = variants[run.compared["recommended"]]
    lines = [markdown("", shown, notes=run.compared["notes"])]
    for label, (_, reference) in run.unknowns.items():
        one = best["estimates"].get(label)
        if one is None or not math.isfinite(reference) or one["low"] is None:
            continue
        where = "inside" if one["low"] <= reference <= one["high"] else "outside"
        lines.append(
            f"The published {label} of {reference:.4g} lies {where} the interval of the "
            f"recommended variant, {one['low']:.4g} to {one['high']:.4g}."
        )
    return [line.removeprefix("# \n\n") for line in lines]


def gallery(runs: Sequence[tuple[Job, Run]], folder: Path) -> Path:
    """Write gallery.md with the figure, the tables and the checks of each case."""
    parts = []
    for path in dict.fromkeys(job.path for job, _ in runs):
        pairs = [(job, run) for job, run in runs if job.path == path]
        job, run = pairs[0]
        checks = [check for pair in pairs for check in _checks(*pair)]
        source = [f"Reference: {run.source}"] if run.source else []
        report = markdown("", _tables(pairs), checks, source).removeprefix("# \n\n")
        lines = [f"## {run.title or path.stem}", f"`python -m benchmarks cases --only {path.stem}`"]
        if job.figure and job.figure.exists():
            lines.append(f"![{path.stem}]({job.figure.name})")
        text = "\n\n".join([*lines[1:], report, *_recommendation(run)])
        parts.append("\n\n".join([lines[0], re.sub("(?m)^## (.*)$", r"**\1**", text)]))
    target = folder / "gallery.md"
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=8", "HEAD"]
    commit = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
    recorded = f"Recorded at commit {commit}.\n\n"
    target.write_text(GALLERY + recorded + "\n".join(parts), encoding="utf-8")
    return target
