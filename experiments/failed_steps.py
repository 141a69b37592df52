"""Failed steps of a study: counted, printed at its end, and checked."""

from __future__ import annotations

import sys

from livepde.estimate import Estimate


class FailedSteps:
    """A count of failed steps, over all runs of a study.

    Parameters
    ----------
    most
        Number up to which the study is in order.
    """

    def __init__(self, most: int = 0) -> None:
        self.most = most
        self.steps = 0
        self.failed = 0

    def seen(self, estimate: Estimate) -> Estimate:
        """Return an estimate after it was counted."""
        self.add(1, 0 if estimate.status.ok else 1)
        return estimate

    def add(self, steps: int, failed: int) -> None:
        """Add the count of a run."""
        self.steps += steps
        self.failed += failed

    def report(self) -> None:
        """Print the count, and end the program with code 1 if it is too large."""
        ok = self.failed <= self.most
        print(
            f"\n{'ok' if ok else 'MISSED'}: {self.failed} of {self.steps} steps failed, "
            f"<= {self.most}"
        )
        if not ok:
            sys.exit(1)
