"""Pauses of a source: in an interval much longer than usual, inputs are no straight lines.

After a pause the state is re-anchored: it is as uncertain as inputs could have made it that varied
in the pause as they did before. So the next readings correct the state and hardly the unknowns,
which are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array, Mask
from livepde.stepping import Span

PAUSE = 5.0  # usual intervals: in a longer one inputs are not known
SETTLED = 20  # intervals before which none is usual
SPREAD = 1.0 / np.sqrt(8.0)  # standard deviation of a sine over its range


@dataclass(frozen=True, eq=False)
class InputHistory:
    """What the inputs have done so far, and at which pace."""

    # Range of each input, and its largest rate of change, shapes (members, channels).
    low: Array
    high: Array
    steepest: Array
    pace: Array  # longest usual interval, shape (members,); 0 before
    count: Array  # intervals so far, at most `SETTLED`, shape (members,)
    pause: Mask  # whether the last interval was a pause, shape (members,)

    @classmethod
    def start(cls, channels: int, members: int = 1) -> InputHistory:
        """Return the value before any interval."""
        far = np.full((members, channels), np.inf)
        none = np.zeros(members)
        return cls(
            low=far, high=-far, steepest=np.zeros_like(far), pace=none, count=none, pause=none > 0.0
        )

    def after(self, span: Span) -> InputHistory:
        """Return the value after an interval; a pause does not show how steep inputs are."""
        length = span.t1 - span.t0
        if not length.all():
            return self
        pause: Mask = (length > PAUSE * self.pace) & (self.count >= SETTLED)
        known = self.low.shape[1]  # a fleet's withheld sensors may read more channels
        first, last = span.inputs0[:, :known], span.inputs1[:, :known]
        slopes = np.abs(last - first) / length[:, None]
        if np.count_nonzero(pause):
            slopes = np.where(pause[:, None], 0.0, slopes)
            # A pace that changes for good is usual after a few samples.
            length = np.where(pause, PAUSE * self.pace, length)
        return InputHistory(
            low=np.fmin(self.low, last),
            high=np.fmax(self.high, last),
            steepest=np.fmax(self.steepest, slopes),
            pace=np.maximum(self.pace, length),
            count=np.minimum(self.count + 1.0, SETTLED),
            pause=pause,
        )

    def deviation(self, length: Array) -> Array:
        """Return by how much inputs may leave their lines in pauses, (members, channels)."""
        spread = SPREAD * (self.high - self.low)
        found: Array = np.minimum(spread, 0.5 * self.steepest * length[:, None])
        return np.where(np.isfinite(found), found, 0.0)


def pauses(times: Sequence[float] | Array) -> list[int]:
    """Return the numbers of the samples that end a pause, by the rule of `InputHistory`."""
    found, pace = [], 0.0
    for k, length in enumerate(np.diff(times).tolist()):
        if k >= SETTLED and length > PAUSE * pace:
            found.append(k + 1)
            length = PAUSE * pace
        pace = max(pace, length)
    return found
