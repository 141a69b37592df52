"""Interface of the steppers of a fleet, and the beliefs they return."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np

from livepde.fem import Moment
from livepde.laws import Belief, MemberReports, Report, Status
from livepde.linalg import Array, IntArray
from livepde.stepping import Span

__all__ = ["Beliefs", "Factors", "FleetEngine", "State", "reported"]

State: TypeAlias = Any
"""What evolves: the arrays or values of an engine."""


def reported(reports: Sequence[Report]) -> MemberReports:
    """Return the report of members of which each has its own."""
    members, sensors = len(reports), len(reports[0].predicted)
    blank = MemberReports(
        (Status(),) * members, np.zeros((members, sensors)), np.zeros(members, dtype=int)
    )
    return blank.with_members(dict(enumerate(reports)))


@dataclass(frozen=True, eq=False)
class Factors:
    """Square roots of the covariances of all members; see `livepde.laws.Belief`.

    Attributes
    ----------
    q, u, prior
        Shapes (members, m, r), (members, n, r) and (members, m, k).
    """

    q: Array
    u: Array
    prior: Array


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Estimates of all members, of the physical parameter; see `livepde.laws.Belief`.

    Attributes
    ----------
    q, u
        Shapes (members, m) and (members, n).
    q_std
        Standard deviations of q, or None if the law has no covariance.
    factors
        Covariances; None where members step separately, each with its own.
    """

    q: Array
    u: Array
    q_std: Array | None
    factors: Factors | None = None


class FleetEngine(Protocol):
    """Abstract stepper of all members. A state is a value: a returned state never changes."""

    def subset(self, which: IntArray) -> FleetEngine:
        """Return a stepper of some members, by number."""
        ...

    def start(self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]) -> State:
        """Return the state at the start, from coefficients of each member."""
        ...

    def begin(self, state: State, span: Span) -> State:
        """Return the state after a sample at the initial time."""
        ...

    def step(self, state: State, span: Span) -> tuple[State, MemberReports]:
        """Return the state at the end of a span, with that before it for members that failed."""
        ...

    def settled(self, state: State) -> State:
        """Return the state after the work that the law spreads over samples; see `Law.settled`."""
        ...

    def believed(self, state: State, k: int) -> Belief:
        """Return the belief about a member, in latent coefficients."""
        ...

    def beliefs(self, state: State) -> Beliefs:
        """Return the beliefs about all members."""
        ...

    def member(self, state: State, k: int) -> Any:
        """Return the state of a member as the law itself has it."""
        ...

    def leaves(self, state: State) -> dict[str, Any]:
        """Return the state as plain arrays."""
        ...

    def restored(self, template: State, leaves: Mapping[str, Array]) -> State:
        """Return the state that `leaves` gave; raises KeyError or ValueError if it does not fit."""
        ...
