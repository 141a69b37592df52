"""Experiments of the command line, and their common run loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from livepde.diagnostics.check_report import Check
from livepde.errors import ConfigurationError
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.progress import watched
from livepde.result import Estimate, Result
from livepde.runs import Outcome
from livepde.streams import Twin


@dataclass(frozen=True)
class Experiment:
    """A published or stated experiment.

    Attributes
    ----------
    name
        Name on the command line.
    summary
        One sentence.
    truths
        Supported kinds of truth (see `Twin`), the default first.
    conduct
        Function (truth, progress) -> outcome.
    """

    name: str
    summary: str
    truths: tuple[str, ...]
    conduct: Callable[[str, bool], Outcome]

    def run(self, truth: str | None = None, progress: bool = False) -> Outcome:
        """Run it and return tables, checks and figures.

        Parameters
        ----------
        truth
            Origin of the data; default the first of `truths`.
        progress
            True: show a progress bar for every run.

        Raises
        ------
        ConfigurationError
            The experiment has no such truth.
        """
        truth = self.truths[0] if truth is None else truth
        if truth not in self.truths:
            raise ConfigurationError(
                f"experiment '{self.name}': truth '{truth}'; expected one of "
                f"{', '.join(self.truths)}."
            )
        return self.conduct(truth, progress)


class Failing(Protocol):
    """A run that counts its failed steps."""

    @property
    def failed(self) -> int:
        """Number of samples with a failed step."""
        ...


@dataclass(frozen=True, eq=False)
class Track:
    """Run with the errors against its truth.

    Attributes
    ----------
    result, last
        The run, and its last estimate.
    times, errors
        Relative L2 error of q after each sample, both of shape (samples,).
    u_error
        Relative error of the state in X at the end.
    divided
        Number of samples with a divided step. A divided step has another truncation error than the
        truth, which is enough to hide a parameter as small as the paper's.
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


def failures(runs: Iterable[Failing], where: str = "", most: int = 0) -> Check:
    """Return the check that at most so many steps failed, in all runs together."""
    failed = float(sum(run.failed for run in runs))
    return Check(f"failed steps{where}", failed, float(most), "<=")


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
