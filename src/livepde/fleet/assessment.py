"""The verdict on a member of a fleet, from its stored samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.fem import Inputs
from livepde.identifier import Identifier
from livepde.laws import AnyLaw
from livepde.linalg import Array
from livepde.verdict import Verdict


def assessed(
    one: Identifier, law: AnyLaw, state: Any, ends: Mapping[str, Array], samples: int
) -> Verdict:
    """Return the verdict on a member, by processing its stored samples with a law that judges.

    Parameters
    ----------
    one
        Identifier of the member before its first sample, which changes.
    law
        The law, with its verdict enabled.
    state
        State of the fleet's law for this member.
    ends, samples
        As for `Identifier._placed`.
    """
    one.law = law

    def start(work: Any, inputs: Inputs) -> Any:
        one._work = work
        return one._start(inputs)

    result = law.reassessed(one.problem, state, one.t, start)
    if isinstance(result, Verdict):
        return result
    _, after = result
    placed = one._placed(after, ends, samples)
    return placed._settled(placed.estimate()).verdict
