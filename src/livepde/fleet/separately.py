"""Any law, member by member, with its precomputed parts shared by all members."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from livepde import checkpoint
from livepde.fem import Moment
from livepde.fleet.steppers import Beliefs, reported
from livepde.laws import AnyLaw, Belief, MemberReports, Problem
from livepde.linalg import Array, IntArray
from livepde.stepping import Span

__all__ = ["Separately"]


class Separately:
    """Stepper of members one after the other; the state is a tuple of the states of the law."""

    def __init__(self, law: AnyLaw, work: Any, problem: Problem) -> None:
        self.law = law
        self.work = work
        self.problem = problem

    def subset(self, which: IntArray) -> Separately:
        return self

    def start(
        self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]
    ) -> tuple[Any, ...]:
        each = zip(q0, u0, moments, strict=True)
        return tuple(self.law.start(self.work, q, u, moment) for q, u, moment in each)

    def begin(self, state: tuple[Any, ...], span: Span) -> tuple[Any, ...]:
        return tuple(self.law.begin(self.work, one, span.member(k)) for k, one in enumerate(state))

    def step(self, state: tuple[Any, ...], span: Span) -> tuple[tuple[Any, ...], MemberReports]:
        taken = [self.law.step(self.work, one, span.member(k)) for k, one in enumerate(state)]
        return tuple(new for new, _ in taken), reported([report for _, report in taken])

    def settled(self, state: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(self.law.settled(self.work, one) for one in state)

    def believed(self, state: tuple[Any, ...], k: int) -> Belief:
        belief: Belief = self.law.belief(self.work, state[k])
        return belief

    def beliefs(self, state: tuple[Any, ...]) -> Beliefs:
        beliefs = [self.problem.physical(self.believed(state, k)) for k in range(len(state))]
        stds = [belief.q_std for belief in beliefs]
        known = [std for std in stds if std is not None]
        q, u = (np.array([getattr(belief, name) for belief in beliefs]) for name in ("q", "u"))
        return Beliefs(q, u, np.array(known) if known else None)

    def member(self, state: tuple[Any, ...], k: int) -> Any:
        return state[k]

    def leaves(self, state: tuple[Any, ...]) -> dict[str, Any]:
        return checkpoint.flatten(state)

    def restored(self, template: tuple[Any, ...], leaves: Mapping[str, Array]) -> tuple[Any, ...]:
        rebuilt: tuple[Any, ...] = checkpoint.rebuild(template, leaves)
        return rebuilt
