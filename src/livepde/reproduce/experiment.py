"""Experiments of the command line and their common run loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde import plots
from livepde.diagnostics.check_report import Check
from livepde.errors import ConfigurationError
from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.progress import watched
from livepde.result import Result
from livepde.runs import Outcome
from livepde.streams import Twin


@dataclass(frozen=True)
class Experiment:
    """A published or stated experiment: its name on the command line, and one sentence.

    `truths` are the supported kinds of truth (see `Twin`), the default first; `conduct` is a
    function (truth, progress) -> outcome.
    """

    name: str
    summary: str
    truths: tuple[str, ...]
    conduct: Callable[[str, bool], Outcome]

    def run(self, truth: str | None = None, progress: bool = False) -> Outcome:
        """Run the experiment and return tables, checks and figures.

        `truth`: origin of the data, by default the first of `truths`. `progress`: whether each run
        shows a progress bar.

        Raises
        ------
        ConfigurationError
            The experiment does not support this truth.
        """
        truth = self.truths[0] if truth is None else truth
        if truth not in self.truths:
            raise ConfigurationError(
                f"experiment '{self.name}': truth '{truth}'; expected one of "
                f"{', '.join(self.truths)}."
            )
        return self.conduct(truth, progress)


@dataclass(frozen=True, eq=False)
class Track:
    """Run with the errors against its truth.

    `times`, `errors`: relative L2 error of q after each sample, both of shape (samples,).
    `u_error`: relative error of the state in X at the end.
    `divided`: number of samples with a divided step. Its truncation error differs from that in the
    truth, which is sufficient to hide a parameter as small as the paper's.
    """

    result: Result
    last: Estimate
    times: Array
    errors: Array
    u_error: float
    divided: int

    @property
    def failed(self) -> int:
        """Number of samples with a failed step."""
        return int(np.isnan(self.errors).sum())

    def error(self, t: float) -> float:
        """Return the error of q at the sample nearest to t."""
        return float(self.errors[np.abs(self.times - t).argmin()])


def failures(runs: Iterable[Any], where: str = "", most: int = 0) -> Check:
    """Return the check of the number of failed steps in all runs."""
    return Check(f"failed steps{where}", float(sum(run.failed for run in runs)), float(most), "<=")


def track(identifier: Identifier, twin: Twin, what: str, progress: bool = False) -> Track:
    """Run an identifier on the samples of a twin and compare each estimate with the truth."""
    result = Result(identifier.model, identifier.observed, None)
    samples = watched(twin, len(twin), what) if progress else twin
    times, errors, divided = [], [], 0
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        result.add(estimate)
        times.append(sample.t)
        errors.append(twin.error(estimate.q) if estimate.status.ok else np.nan)
        divided += estimate.steps > 1
    return Track(
        result, estimate, np.array(times), np.array(errors), twin.u_error(estimate), divided
    )


def draw_errors(runs: Mapping[str, Track]) -> Any:
    """Draw the error of q over time of all runs."""
    series = {name: (found.times, found.errors) for name, found in runs.items()}
    drawn, axes = plots.figure()
    plots.history(series, ylabel="relative L2 error of q", levels={"q = 0": 1.0}, ax=axes[0])
    return drawn
