"""State of the discretisation shadows of each member: see `livepde.laws.shadows`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.laws.member_arrays import changed
from livepde.linalg import Array, IntArray
from livepde.stepping import KeptFactors


@dataclass(frozen=True, eq=False)
class ShadowState:
    """Shifts of the estimates of each member; the leading axis of every array is the members."""

    # Shifts of state and reduced unknowns by the discretisation, a row for each shadow, shapes
    # (members, shadows, n) and (members, shadows, k).
    u: Array
    a: Array
    # Steps so far, and at which the shadows were taken last and are taken next, (members,).
    count: IntArray
    last: IntArray
    due: IntArray
    # Change of the state per unit of time in the last step, how much that usually differs from one
    # step to the next, and the count of steps at which it last differed by much more; shapes
    # (members, n), (members,) and (members,).
    rate: Array
    usual: Array
    jumped: IntArray
    size: Array  # norm of the last error that the step shadow found, (members,); infinite before
    # Time, state and inputs where the shadows were taken last; the state without columns if no
    # shadow needs it. Shapes (members,), (members, n) and (members, channels).
    begun: Array
    u0: Array
    inputs0: Array
    # Of the last interval, infinite before the first, and how inputs changed in it per unit of
    # time; shapes (members,) and (members, channels).
    length: Array
    slope: Array
    # Integral over the last interval of the difference of the inputs from straight lines, and the
    # sum of these integrals that no shadow has stepped with yet, shapes (members, channels).
    bend: Array
    missed: Array
    # Of inputs that are held: last value, last change, and sums of the squares of changes and of
    # their differences, shape (members, 4, channels).
    held: Array
    # Warm-start data of the last stages of halved steps, and of a block of steps.
    halves: KeptFactors
    blocks: KeptFactors
    # The state on the halved mesh minus that of the filter, shape (members, N), and the warm-start
    # data of the last stage on the halved mesh.
    fine: Array
    fine_stage: KeptFactors
    seen: Array  # the difference in the predicted readings due to `fine`, shape (members, sensors)
    # Sum of the gains of the samples since the shadows were taken last, each times the time since
    # then, shape (members, sensors, k); without sensors if no shadow needs it.
    gains: Array
    failed: IntArray  # how many shadow steps had no solution, shape (members,)
    # Error of the last step that the step shadow took, over what is allowed, shape (members,).
    excess: Array
    # How many steps were left with a larger one, and the largest `excess` of them, (members,).
    coarse: IntArray
    coarsest: Array

    def __len__(self) -> int:
        return len(self.count)

    @classmethod
    def none(cls, members: int, n: int, k: int) -> ShadowState:
        """Return the value without any shadow."""
        # No step writes into the arrays of a state, so that several fields may share one.
        zero, nothing = np.zeros(members, dtype=np.int64), np.zeros((members, 0))
        time, kept = np.zeros(members), KeptFactors.none(members)
        u, a = np.zeros((members, 0, n)), np.zeros((members, 0, k))
        return cls(
            u,
            a,
            count=zero,
            last=zero,
            due=zero,
            rate=np.zeros((members, n)),
            usual=time,
            jumped=zero,
            size=time + np.inf,
            begun=time,
            u0=nothing,
            inputs0=nothing,
            length=time + np.inf,
            slope=nothing,
            bend=nothing,
            missed=nothing,
            held=np.zeros((members, 4, 0)),
            halves=kept,
            blocks=kept,
            fine=nothing,
            fine_stage=kept,
            seen=nothing,
            gains=np.zeros((members, 0, k)),
            failed=zero,
            excess=time,
            coarse=zero,
            coarsest=time,
        )

    def without_stages(self) -> ShadowState:
        """Return the shifts alone, without the data that only the next steps need."""
        nothing = np.zeros((len(self), 0))
        return changed(
            self,
            halves=self.halves.forgotten(),
            blocks=self.blocks.forgotten(),
            fine_stage=self.fine_stage.forgotten(),
            u0=nothing,
            inputs0=nothing,
            gains=np.zeros((len(self), 0, self.a.shape[2])),
        )
