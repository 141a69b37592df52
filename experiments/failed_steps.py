"""Count the failed steps of a study, and fail the study if there are too many."""

from __future__ import annotations

import sys

from livepde.estimate import Estimate


class FailedSteps:
    """Counter of failed steps over all runs of a study.

    Parameters
    ----------
    most
        Largest accepted number of failed steps.
    """

    def __init__(self, most: int = 0) -> None:
        self.most = most
        self.steps = 0
        self.failed = 0

    def seen(self, estimate: Estimate) -> Estimate:
        """Count the step of an estimate, and return the estimate."""
        self.add(1, 0 if estimate.status.ok else 1)
        return estimate

    def add(self, steps: int, failed: int) -> None:
        """Add the steps of a run, and how many of them failed."""
        self.steps += steps
        self.failed += failed

    def report(self) -> None:
        """Print the count; if it exceeds `most`, end the program with exit code 1."""
        ok = self.failed <= self.most
        print(
            f"\n{'ok' if ok else 'MISSED'}: {self.failed} of {self.steps} steps failed, "
            f"<= {self.most}"
        )
        if not ok:
            sys.exit(1)
