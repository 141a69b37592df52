"""Last samples of the members of a fleet, and counts of all their samples for verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from livepde.laws import Status
from livepde.laws.verdict import COUNTS
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.records import STATUS_CODES
from livepde.stepping import Advance


@dataclass(frozen=True, eq=False, kw_only=True)
class TakenByMembers:
    """`TakenSamples` of all members; the leading axis of every array is the members."""

    t: Array  # time of the last accepted sample, shape (members,)
    z: Array  # readings of this sample, (members, sensors), and inputs, (members, channels)
    inputs: Array
    known: Array  # last known inputs; inputs with "hold" also from samples of failed steps
    held: Array  # time for which each input has been held so far, (members, channels)
    # Counts for verdicts, as in `InputLedger` and `StepLedger`.
    held_counts: IntArray
    unstated: Array
    steps: IntArray

    @classmethod
    def start(cls, t0: float, sensors: int, channels: int, members: int) -> TakenByMembers:
        """Return the value before the first sample."""
        unknown, zeros = np.full((members, channels), np.nan), np.zeros((members, channels))
        return cls(
            t=np.full(members, float(t0)),
            z=np.full((members, sensors), np.nan),
            inputs=unknown,
            known=unknown,
            held=zeros,
            held_counts=np.zeros((members, 1 + channels), dtype=np.int64),
            unstated=zeros,
            steps=np.zeros((members, COUNTS), dtype=np.int64),
        )

    def begun(self, inputs: Array, unstated: Mask) -> TakenByMembers:
        """Return the value at the start; `unstated`: True for inputs without an initial value."""
        return changed(self, inputs=inputs, known=inputs, unstated=unstated.astype(float))

    def after(
        self,
        t: float,
        z: Array,
        inputs: Array,
        missing: Array,
        statuses: Sequence[Status],
        control: Advance,
        holding: Mask,
    ) -> TakenByMembers:
        """Return the value after a sample.

        A member whose step failed keeps its time and values: its next step covers both intervals.

        `missing`: 1 for each input that holds its last value.
        `holding`: True for inputs with "hold", whose value stays valid after a failed step.
        """
        codes = [STATUS_CODES.index(status.code) for status in statuses]
        steps = self.steps + np.eye(COUNTS, dtype=np.int64)[codes]
        steps[:, -1] += [*map(control.stretches, (t - self.t).tolist())]
        accepted = np.array([status.taken for status in statuses])
        rows = accepted[:, None]
        counts = self.held_counts
        if missing.shape[1]:
            added = np.column_stack([np.ones(len(accepted)), missing > 0.0]).astype(np.int64)
            counts = counts + added * rows
        return changed(
            self,
            t=np.where(accepted, t, self.t),
            z=np.where(rows, z, self.z),
            inputs=np.where(rows, inputs, self.inputs),
            known=np.where(rows | holding, inputs, self.known),
            held=np.where(rows, (self.held + (t - self.t)[:, None]) * missing, self.held),
            held_counts=counts,
            steps=steps,
        )

    def restored(self, leaves: Mapping[str, Array]) -> TakenByMembers:
        """Return the value stored in leaves of a checkpoint; raise `KeyError` or `ValueError`."""
        for name, value in vars(self).items():
            if leaves[name].shape != value.shape:
                raise ValueError(f"{name} has shape {leaves[name].shape}, needs {value.shape}")
        return changed(self, **{name: leaves[name] for name in vars(self)})
