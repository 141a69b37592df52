"""The verdict on a member of a fleet, from its stored samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from livepde.fem import Inputs
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw, stepped
from livepde.laws.history import LogRows, first_interval, intervals_since
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.linalg import Array
from livepde.linalg.member_arrays import changed
from livepde.verdict import Verdict

FORGOTTEN = "innovations: the first samples of the member are no longer stored (`law.refit.window`)"


def assessed(
    one: Identifier,
    law: SensitivityLaw,
    begun: SensitivityWork,
    state: SensitivityState,
    ends: Mapping[str, Array],
    samples: int,
) -> Verdict:
    """Return the verdict on a member, by processing its stored samples with a law that judges.

    Parameters
    ----------
    one
        Identifier of the member before its first sample.
    law
        The law, with its verdict enabled.
    begun, state
        Prepared data of the fleet's law for this member, and its state.
    ends, samples
        As for `Identifier._placed`.
    """
    problem, channels = begun.filter.problem, begun.filter.problem.channels
    rows = LogRows.of(state.log, problem.observed.size)
    if state.window[0] or not len(rows.times) or rows.times[0] != one.t:
        return Verdict.of((), (FORGOTTEN,), judged=False)
    work = law.prepare(problem)
    one.law, one._work = law, work
    replayed = one._start(Inputs(dict(zip(channels, rows.inputs[0].tolist(), strict=True))))
    if np.isfinite(rows.readings[0]).any():
        replayed, _ = stepped(law, work, problem, replayed, first_interval(state.log, channels))
    for interval in intervals_since(state.log, channels):
        replayed, _ = stepped(law, work, problem, replayed, interval)
    # The log lacks readings of excluded sensors: the memory of the gate comes from the last state.
    now = changed(replayed.now, screened=state.now.screened)
    placed = one._placed(changed(replayed, now=now), ends, samples)
    return placed._settled(placed.estimate()).verdict
