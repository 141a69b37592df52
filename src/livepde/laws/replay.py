"""Replays of the stored samples about a better reference: options, and how far one has come."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.errors import LawError
from livepde.laws.filter_state import FilterState
from livepde.linalg import Array, IntArray, Mask

__all__ = ["FIXED", "Replay", "ReplayState"]

FIXED = 1 << 60  # samples before a first replay that never comes: the reference stays


@dataclass(frozen=True)
class Replay:
    """Keep one reference trajectory and replay the stored samples from a better one.

    Each plain update u += L K d leaves a second-order error that a state with long memory never
    forgets. With a replay the filter stays linear about one reference, and whenever the number of
    assimilated samples has doubled, the reference is moved to the estimate and the stored samples
    are run through again, until reference and estimate agree within half a standard deviation: a
    Gauss-Newton iteration, whose steps are at most one prior standard deviation long. One replay
    for each doubling makes less than four times the steps in all; more than one is needed mostly
    while the store is short.

    A replay takes `slice` stored samples again for each new one, so that no step takes much longer
    than others: less than 20 times the median on a rod with two unknowns. Until it has caught up,
    estimates are linear about the reference of before. Where it ends does not depend on the slices
    while each replay ends before the next is due: its references come from the samples that were
    there when it began. Where few samples have readings a slice is longer, by the number of samples
    for each that has one. With finished data a larger slice costs nothing but longer steps. A run
    ends with the result of the replay under way (`Identifier.settled`).

    Parameters
    ----------
    window
        At most this many samples are stored. When it is full, the estimate of that moment becomes
        the new start and the store is emptied.
    first
        Number of assimilated samples before the first replay.
    iterations
        At most this many replays for each doubling.
    slice
        Stored samples that are taken again for each new one; more than `iterations`.
    """

    window: int = 4096
    first: int = 8
    iterations: int = 4
    slice: int = 6

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.window:
            raise LawError(
                f"Replay: needs 1 <= first <= window; got first = {self.first}, "
                f"window = {self.window}."
            )
        if self.iterations < 1:
            raise LawError(f"Replay: iterations must be at least 1; got {self.iterations}.")
        if self.slice <= self.iterations:
            raise LawError(
                f"Replay: slice must be larger than iterations = {self.iterations}, so that a "
                f"replay ends before the next is due; got {self.slice}."
            )


@dataclass(frozen=True, eq=False)
class ReplayState:
    """How far the replay of each member has come; the leading axis is the members.

    Attributes
    ----------
    x
        The filter of the replay.
    row, until
        Rows of the log: of the sample taken last, -1 if no replay is under way; and the last one
        that there was when the replay began, from which the next reference comes.
    rounds
        How many more times the samples may be run through about another reference; -1 once the
        reference is final, and the samples since `until` are caught up with.
    reference
        Latent parameter at the start of the window from which the reference of `x` comes, (m,).
    count
        Samples assimilated when the replay began.
    distance
        Between estimate and reference, at the last end, in standard deviations.
    """

    x: FilterState
    row: IntArray
    until: IntArray
    rounds: IntArray
    reference: Array
    count: IntArray
    distance: Array

    @classmethod
    def none(cls, x: FilterState) -> ReplayState:
        """Return the value while no replay is under way."""
        never, zero = np.full(len(x), -1), np.zeros(len(x), dtype=np.int64)
        return cls(x, never, never, never, x.q, zero, np.zeros(len(x)))

    @property
    def active(self) -> Mask:
        """Members whose replay is under way, shape (members,)."""
        active: Mask = self.row >= 0
        return active
