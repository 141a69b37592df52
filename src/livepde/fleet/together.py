"""Members that a law steps together, as arrays whose leading axis is the members."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from livepde import checkpoint
from livepde.fem import Moment
from livepde.fleet.steppers import Beliefs, Factors
from livepde.laws import Belief, InitialReading, MemberReports
from livepde.laws.member_arrays import join, take
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.linalg import Array, IntArray
from livepde.stepping import Span

__all__ = ["Together"]


class Together:
    """Steps all members of one model by `SensitivityLaw.step_members`.

    `readings` are those that the initial state of each member was made of, `initial` how it was
    given.
    """

    def __init__(
        self,
        law: Any,
        work: SensitivityWork,
        readings: Sequence[Mapping[str, InitialReading]],
        initial: Sequence[Any],
    ) -> None:
        self.law = law
        self.work = work
        made: dict[int, SensitivityWork] = {}  # of members that begin alike: it caches matrices
        self._begins = []
        for one, u0 in zip(readings, initial, strict=True):
            begin = made.get(id(u0)) if not one else None
            if begin is None:
                begin = work.made_of(one, u0)
                made |= {} if one else {id(u0): begin}
            self._begins.append(begin)

    def subset(self, which: IntArray) -> Together:
        other = copy.copy(self)
        other._begins = [self._begins[k] for k in which]
        return other

    def start(
        self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]
    ) -> SensitivityState:
        starts = zip(self._begins, q0, u0, moments, strict=True)
        first: SensitivityState = join(*(self.law.start(*start) for start in starts))
        return first

    def begin(self, state: SensitivityState, span: Span) -> SensitivityState:
        each = enumerate(self._begins)
        begun: SensitivityState = join(
            *(self.law.begin(work, take(state, k), span.member(k)) for k, work in each)
        )
        return begun

    def step(self, state: SensitivityState, span: Span) -> tuple[SensitivityState, MemberReports]:
        stepped: tuple[SensitivityState, MemberReports] = self.law.step_members(
            self.work, state, span
        )
        return stepped

    def settled(self, state: SensitivityState) -> SensitivityState:
        settled: SensitivityState = self.law.settled(self.work, state)
        return settled

    def member(self, state: SensitivityState, k: int) -> SensitivityState:
        return take(state, k)

    def believed(self, state: SensitivityState, k: int) -> Belief:
        belief: Belief = self.law.member_belief(self.work, state.now, k)
        return belief

    @np.errstate(over="ignore", invalid="ignore")  # of members whose step has failed
    def beliefs(self, state: SensitivityState) -> Beliefs:
        now, reduction = state.now, self.work.filter.reduction
        latent = self.work.filter.problem.model.latent
        a = reduction.bounded(self.work.filter.estimate(now))
        U, C = self.law.factors(self.work, now)
        factor = reduction.directions(a, C).transpose(0, 2, 1)
        units = np.broadcast_to(np.eye(reduction.size), (len(a), *2 * (reduction.size,)))
        prior = reduction.directions(a, units).transpose(0, 2, 1)
        std = np.sqrt((factor**2).sum(axis=2))
        factors = Factors(factor, U.transpose(0, 2, 1), prior)
        return Beliefs(latent.value(a.T).T, now.u + now.du, std, factors)

    def leaves(self, state: SensitivityState) -> dict[str, Any]:
        return checkpoint.flatten(state)

    def restored(self, template: SensitivityState, leaves: Mapping[str, Array]) -> SensitivityState:
        state: SensitivityState = checkpoint.rebuild(template, leaves)
        if len(state) != len(template):
            raise ValueError(f"{len(state)} members, needs {len(template)}")
        return state
