"""Batched implicit stage: states and tangents of several members of one model.

Column arrays have the shape (1 + r, members, n): the state and r tangents of each member.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from livepde.linalg import Array, IntArray, Mask
from livepde.model import Model
from livepde.stepping.corrections import Kept
from livepde.stepping.interval import Moments
from livepde.stepping.state import ForwardStage

# Relative error of a covariance square root. It affects the gain only, not the innovation, and may
# be coarser than the state.
GAIN = 1e-4
# Relative error of the tangent that carries the estimated mean, as accurate as the state itself.
ESTIMATE = 1e-8


@dataclass(frozen=True, eq=False)
class KeptFactors:
    """Warm-start data of each member, as `Kept` of a single process.

    Attributes
    ----------
    q, h, spent, trend
        Shapes (members, m), (members,), (members,) and (members, n); h = 0 for a member without a
        cached factor. For stages that cache no factors, q and trend have no columns.
    """

    q: Array
    h: Array
    spent: Array
    trend: Array

    @classmethod
    def none(cls, members: int, m: int = 0, n: int = 0) -> KeptFactors:
        """Return empty warm-start data, as before the first stage."""
        zero = np.zeros(members)
        return cls(np.zeros((members, m)), zero, zero, np.zeros((members, n)))

    def forgotten(self) -> KeptFactors:
        """Return empty warm-start data of the same members."""
        return KeptFactors.none(len(self.h)) if self.q.shape[1] else self

    def member(self, k: int) -> Kept:
        """Return the warm-start data of one member."""
        if not self.h[k]:
            return Kept.none()
        return Kept(self.q[k], float(self.h[k]), float(self.spent[k]), self.trend[k])


class StageOfMembers(NamedTuple):
    """Arguments of a batched stage, besides its initial states and tangents.

    Attributes
    ----------
    members
        Numbers of the members, as keys of their cached factors, shape (members,).
    q, directions
        Latent parameters, (members, dim), and derivative of q along each tangent, (members, r, m).
    h, at
        Step length; time and inputs at its end.
    kept
        Warm-start data of the previous stage.
    off_centre
        Mask of members whose last tangent is the offset of the estimated mean from the
        linearisation point, which has to be more accurate than a covariance square root; shape
        (members,).
    factors
        Cache of factorised matrices for this q, keyed by step length, shared by the stages of one
        step of a time scheme; a stage may read it and add to it.
    apart
        Number of trailing tangents that are solved separately, so that their presence does not
        change the rounding of the other columns.
    """

    members: IntArray
    q: Array
    directions: Array
    h: float
    at: Moments
    kept: KeptFactors
    off_centre: Mask
    factors: dict[float, Any]
    apart: int = 0


class MemberStage(ABC):
    """Abstract solver of M (u - c)/h + B(u) + A(u) q = F for states and tangents of members."""

    @abstractmethod
    def kept(self, members: int) -> KeptFactors:
        """Return empty warm-start data of members, as before the first stage."""

    @abstractmethod
    def twin(self) -> MemberStage:
        """Return a stage of the same model with its own factor cache, for other step lengths."""

    @abstractmethod
    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        """Return states and tangents at the end of a stage, and its warm-start data.

        Parameters
        ----------
        columns
            States and tangents at the beginning of the stage, shape (1 + r, members, n).

        Raises
        ------
        StepFailed
            The solver finds no solution of a stage.
        """


class SeparateStages(MemberStage):
    """Loop of one `ForwardStage` per member: serves any model."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._stages: list[ForwardStage] = []

    def _stage(self, k: int) -> ForwardStage:
        """Return the stage of a member: symbolic analysis is shared, numeric factors are not."""
        if not self._stages:
            self._stages.append(ForwardStage(self.model))
        while len(self._stages) <= k:
            self._stages.append(self._stages[0].twin())
        return self._stages[k]

    def twin(self) -> SeparateStages:
        other = SeparateStages(self.model)
        other._stages = [self._stage(0).twin()]
        return other

    def kept(self, members: int) -> KeptFactors:
        stage = self._stage(0)
        if not stage.keeps or not stage.solver.price:
            return KeptFactors.none(members)
        return KeptFactors.none(members, self.model.latent.dim, self.model.X.dim)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        new, left, kept = np.empty_like(columns), [], stage.kept
        for k, member in enumerate(stage.members.tolist()):
            y, after = self._stage(member).advance(
                columns[:, k].T,
                stage.q[k],
                stage.directions[k].T,
                stage.h,
                stage.at.member(k),
                kept.member(k),
                ESTIMATE if stage.off_centre[k] else GAIN,
                stage.apart,
            )
            new[:, k] = y.T
            left.append(after)
        if not kept.q.shape[1]:
            return new, kept
        rows = (np.array([getattr(one, name) for one in left]) for name in vars(left[0]))
        return new, KeptFactors(*rows)
