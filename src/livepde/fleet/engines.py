"""Engines of a fleet, which step all members as blocks of arrays or one after the other."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np

from livepde import checkpoint, laws
from livepde.fem import Moment
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.linalg import Array, IntArray, nonfinite_allowed
from livepde.linalg.member_arrays import join, take
from livepde.stepping import Span

State: TypeAlias = Any
"""State of all members, of a type that depends on the engine."""


@dataclass(frozen=True, eq=False)
class Factors:
    """Square roots of the covariances of all members; see `livepde.laws.Belief`."""

    # q, u, prior: shapes (members, m, r), (members, n, r) and (members, m, k)
    q: Array
    u: Array
    prior: Array


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Estimates of all members, in physical parameters; see `livepde.laws.Belief`."""

    # q, u: shapes (members, m) and (members, n)
    q: Array
    u: Array
    q_std: Array | None  # standard deviations of q; None if the law has no covariance
    # Square roots of covariances; None if members are stepped separately
    factors: Factors | None = None


class Beginning(NamedTuple):
    """The problem of a member, with its own initial state, and the prepared data for it."""

    problem: laws.Problem
    work: Any


def beginnings(
    law: laws.AnyLaw,
    work: Any,
    problem: laws.Problem,
    readings: Sequence[Mapping[str, laws.InitialReading]],
    errors: Sequence[Array],
    initial: Sequence[Any],
) -> list[Beginning]:
    """Return the beginning of each member.

    `readings`: readings from which each initial state was computed. `errors`: its own errors,
    (errors, n). `initial`: u0 as specified, which laws with a covariance evaluate on other meshes.
    """
    shared: dict[int, Beginning] = {}  # one for members with the same u0: work caches matrices
    result = []
    for initial_readings, own_errors, u0 in zip(readings, errors, initial, strict=True):
        separate = bool(initial_readings) or bool(len(own_errors))
        begin = shared.get(id(u0)) if not separate else None
        if begin is None:
            own = replace(
                problem,
                initial_readings=initial_readings,
                initial_errors=own_errors,
                initial=u0,
            )
            begin = Beginning(own, law.work_from(work, own))
            shared |= {} if separate else {id(u0): begin}
        result.append(begin)
    return result


class FleetEngine(ABC):
    """Abstract base of engines, which step all members with one law.

    States are values: a returned state never changes.
    """

    def __init__(self, law: Any, work: Any, begins: Sequence[Beginning]) -> None:
        self.law = law
        self.work = work
        self._begins = begins

    def subset(self, which: IntArray) -> Self:
        """Return an engine for the members with these numbers."""
        engine = copy.copy(self)
        engine._begins = [self._begins[k] for k in which]
        return engine

    def begun(self, k: int) -> Beginning:
        """Return the beginning of a member."""
        return self._begins[k]

    def _started(
        self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]
    ) -> Iterator[Any]:
        """Yield the initial state of the law for each member."""
        for begin, *start in zip(self._begins, q0, u0, moments, strict=True):
            yield self.law.start(begin.work, *start)

    @abstractmethod
    def start(self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]) -> State:
        """Return the initial state, from coefficients of each member."""

    @abstractmethod
    def begin(self, state: State, span: Span) -> State:
        """Return the state after a sample at the initial time."""

    @abstractmethod
    def step(self, state: State, span: Span) -> tuple[State, laws.MemberReports]:
        """Return the state at the end of a span; members that fail keep their previous state."""

    @abstractmethod
    def settled(self, state: State) -> State:
        """Return the state after the deferred work of the law; see `Law.settled`."""

    @abstractmethod
    def believed(self, state: State, k: int) -> laws.Belief:
        """Return the belief of a member, in latent coefficients."""

    @abstractmethod
    def beliefs(self, state: State) -> Beliefs:
        """Return the beliefs of all members."""

    @abstractmethod
    def member(self, state: State, k: int) -> Any:
        """Return the state of a member in the form that the law uses for a single process."""

    def restored(self, template: State, leaves: Mapping[str, Array]) -> State:
        """Return the state stored in `leaves`; raise KeyError or ValueError if they do not fit."""
        return checkpoint.rebuild(template, leaves)


class SeparateEngine(FleetEngine):
    """Engine for any law, which steps members one by one and shares the prepared data of the law.

    The state is a tuple with the state of each member.
    """

    def __init__(
        self, law: laws.AnyLaw, work: Any, begins: Sequence[Beginning], problem: laws.Problem
    ) -> None:
        super().__init__(law, work, begins)
        self.problem = problem

    def start(
        self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]
    ) -> tuple[Any, ...]:
        return tuple(self._started(q0, u0, moments))

    def begin(self, state: tuple[Any, ...], span: Span) -> tuple[Any, ...]:
        members = zip(self._begins, state, strict=True)
        return tuple(
            laws.stepped(self.law, begin.work, self.problem, previous, span.member(k))[0]
            for k, (begin, previous) in enumerate(members)
        )

    def step(
        self, state: tuple[Any, ...], span: Span
    ) -> tuple[tuple[Any, ...], laws.MemberReports]:
        context = self.law, self.work, self.problem
        results = [laws.stepped(*context, old, span.member(k)) for k, old in enumerate(state)]
        members, sensors = len(results), len(results[0][1].predicted)
        zeros = np.zeros((members, sensors)), np.zeros(members, dtype=int)
        reports = laws.MemberReports((laws.Status(),) * members, *zeros)
        by_member = {k: report for k, (_, report) in enumerate(results)}
        return tuple(new for new, _ in results), reports.with_members(by_member)

    def settled(self, state: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(self.law.settled(self.work, member) for member in state)

    def believed(self, state: tuple[Any, ...], k: int) -> laws.Belief:
        belief: laws.Belief = self.law.belief(self.work, state[k])
        return belief

    def beliefs(self, state: tuple[Any, ...]) -> Beliefs:
        beliefs = [self.problem.physical(self.believed(state, k)) for k in range(len(state))]
        stds = [belief.q_std for belief in beliefs]
        given_stds = [std for std in stds if std is not None]
        q, u = (np.array([getattr(belief, name) for belief in beliefs]) for name in ("q", "u"))
        return Beliefs(q, u, np.array(given_stds) if given_stds else None)

    def member(self, state: tuple[Any, ...], k: int) -> Any:
        return state[k]


class BlockEngine(FleetEngine):
    """Engine of `SensitivityLaw.step_members`: arrays with the members as the leading axis."""

    law: laws.SensitivityLaw
    work: SensitivityWork

    def start(
        self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]
    ) -> SensitivityState:
        joined: SensitivityState = join(*self._started(q0, u0, moments))
        return joined

    def begin(self, state: SensitivityState, span: Span) -> SensitivityState:
        members = enumerate(self._begins)
        joined: SensitivityState = join(
            *(self.law.begin(own.work, take(state, k), span.member(k)) for k, own in members)
        )
        return joined

    def step(
        self, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, laws.MemberReports]:
        return self.law.step_members(self.work, state, span)

    def settled(self, state: SensitivityState) -> SensitivityState:
        return self.law.settled(self.work, state)

    def believed(self, state: SensitivityState, k: int) -> laws.Belief:
        return self.law.member_belief(self.work, state.now, k)

    @nonfinite_allowed()  # members with a failed step
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

    def member(self, state: SensitivityState, k: int) -> SensitivityState:
        return take(state, k)

    def restored(self, template: SensitivityState, leaves: Mapping[str, Array]) -> SensitivityState:
        state: SensitivityState = super().restored(template, leaves)
        if len(state) != len(template):
            raise ValueError(f"{len(state)} members, needs {len(template)}")
        return state
