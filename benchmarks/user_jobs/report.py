"""Processor times and errors of `livepde run` and of the fits as whole processes."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.interpolate import griddata

from benchmarks import ROOT
from benchmarks.processes import usual_environment
from benchmarks.user_jobs.data import JOBS, Job, true_field
from livepde import runs
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome

QUICK = ("rod", "column")
FEW = 12  # rows of a run whose time consists mainly of imports, figure and report
WORSE = 1.2  # largest error over the error of the fit


class Timed(NamedTuple):
    """Processor time of a whole process, and of its computation, in s.

    For livepde, the time of a run with few rows is subtracted; the fit measures its own part.
    """

    whole: float
    part: float


class Compared(NamedTuple):
    """Relative errors of livepde and of the fit, and difference of their estimates."""

    own: float
    fit: float
    apart: float  # largest difference in standard deviations; NaN for a field


def user_jobs(names: Sequence[str] = (), rounds: int = 3) -> Outcome:
    """Run each job and its fit in turn.

    Parameters
    ----------
    names
        Names of jobs; default all.
    rounds
        Number of runs of each, whose medians are reported.
    """
    rows, checks = [], []
    for job in JOBS:
        if names and job.name not in names:
            continue
        with TemporaryDirectory() as folder:
            times, compared = _measured(job, Path(folder), rounds)
        own, fit = (Timed(*np.median(each, axis=0).tolist()) for each in zip(*times, strict=True))
        part, whole = own.part / fit.part, own.whole / fit.whole
        errors = [f"{100.0 * error:.2g} %" for error in (compared.own, compared.fit)]
        rows.append((job.title, own.whole, fit.whole, part, whole, *errors, compared.apart))
        checks += [
            Check(f"{job.name}: without imports and figure", part, job.part, "<="),
            Check(f"{job.name}: whole processes", whole, job.whole, "<="),
            Check(f"{job.name}: error over the fit's", compared.own / compared.fit, WORSE, "<="),
        ]
    head = ("job", "livepde, s", "fit, s", "ratio", "whole", "error", "of the fit", "apart")
    notes = [
        f"Processor times with one thread, medians of {rounds} rounds. ratio: without imports, and "
        f"for livepde without the time of a run of {FEW} rows. whole: ratio of whole processes; "
        "only livepde computes verdict, intervals, journal, report and figure. The fit of the "
        "field has no standard deviations. apart: largest difference of the estimates, in standard "
        "deviations."
    ]
    return Outcome(tables=[Table("Jobs of users", head, rows)], checks=checks, notes=notes)


def _measured(job: Job, folder: Path, rounds: int) -> tuple[list[tuple[Timed, Timed]], Compared]:
    """Return the times of livepde and of the fit in each round, and the errors of both."""
    job.write(folder / "all")
    job.write(folder / "few", FEW)
    times, cache = [], folder / "bytecode"
    fit = ["benchmarks.user_jobs.fits", job.name, f"{folder}/all"]
    _livepde(folder, "few", "first", cache)  # the first runs write the bytecode
    _run(fit, cache)
    for number in range(rounds):
        own, few = (_livepde(folder, part, number, cache) for part in ("all", "few"))
        whole, printed = _run(fit, cache)
        result = json.loads(printed)
        times.append((Timed(own[0], own[0] - few[0]), Timed(whole, result["seconds"])))
    return times, _compared(job, folder / "all0", result["estimates"])


def _livepde(folder: Path, part: str, number: int | str, cache: Path) -> tuple[float, str]:
    case, out = f"{folder}/{part}/case.toml", f"{folder}/{part}{number}"
    return _run(["livepde", "run", case, "--out", out], cache)


def _run(command: Sequence[str], cache: Path) -> tuple[float, str]:
    """Run a module as a process, and return its processor time in s and its output."""
    given = usual_environment(cache) | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    before = os.times()
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=ROOT,
        env=given,
        check=True,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    after = os.times()
    used = after.children_user - before.children_user
    return used + after.children_system - before.children_system, done.stdout


def _compared(job: Job, folder: Path, estimates: dict[str, float]) -> Compared:
    data = runs.open(folder).dataset
    if not job.truth:
        return _fields(data, estimates)
    last = data.isel(time=-1)
    labels = list(job.truth)
    own = np.array([float(last[label]) for label in labels])
    std = np.array([float(last[f"{label}_std"]) for label in labels])
    fit, true = (np.array([each[label] for label in labels]) for each in (estimates, job.truth))
    apart = float(np.abs((own - fit) / std).max())
    return Compared(_error(own, true), _error(fit, true), apart)


def _fields(data: xr.Dataset, estimates: dict[str, float]) -> Compared:
    """Return the relative errors of both fields at the points of the fit's grid."""
    points = np.array([list(map(float, place.split())) for place in estimates])
    vertices = np.column_stack([data["x"], data["y"]])
    own = griddata(vertices, np.asarray(data["alpha"])[-1], points)
    fit, true = np.array(list(estimates.values())), true_field(*points.T)
    return Compared(_error(own, true), _error(fit, true), math.nan)


def _error(values: np.ndarray, true: np.ndarray) -> float:
    """Return the root mean square of the relative errors."""
    return float(np.sqrt(((values / true - 1.0) ** 2).mean()))
