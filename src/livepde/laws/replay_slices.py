"""Replays in slices: some stored samples are taken again with each new one."""

from __future__ import annotations

from collections import defaultdict
from itertools import chain

import numpy as np

from livepde.laws.assimilation import absorb, assimilate
from livepde.laws.filter_state import FilterState
from livepde.laws.gauss_newton import CONVERGED, Window, distance, next_reference, placed
from livepde.laws.history import first_interval, following, span_between
from livepde.laws.member_arrays import changed, join, put, take
from livepde.laws.replay import Replay, ReplayState
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Mask

__all__ = ["finish_replays", "replay_slice"]


def replay_slice(
    work: SensitivityWork, state: SensitivityState
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after a slice of their replays, and diagnostics if one ended."""
    replay = work.replay
    if replay is None:
        return state, None
    active = state.replay.active
    due = (state.assimilated >= state.due) & ~active
    if not np.count_nonzero(active | due):
        return state, None
    for k in np.flatnonzero(due).tolist():
        state = _with(state, k, _begun(work, replay, take(state, k)))
    # To begin costs as much as a sample. Those without a reading are taken again, too, but the next
    # replay is due when readings have doubled: to end before, a slice has its share of them.
    stored = state.replay.until - state.window
    share = np.maximum(stored / np.maximum(state.replay.count, 1), 1.0)
    return _advanced(work, state, replay.slice * share - due)


def finish_replays(work: SensitivityWork, state: SensitivityState) -> SensitivityState:
    """Return all members after the replays that are under way."""
    return _advanced(work, state, np.full(len(state), np.inf))[0]


def _with(state: SensitivityState, k: int, replay: ReplayState) -> SensitivityState:
    return changed(state, replay=put(state.replay, k, replay))


def _advanced(
    work: SensitivityWork, state: SensitivityState, most: Array
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after at most so many stored samples of each, and diagnostics."""
    which = np.flatnonzero(state.replay.active)
    if not len(which):
        return state, None
    # Those that replay are apart, so that no stored sample copies the others, or the log.
    part = take(state, which) if len(which) < len(state) else state
    ended, taken = np.zeros(len(which), dtype=bool), 0
    failures = ended.copy()
    while (going := part.replay.active & (taken < most[which])).any():
        part, failed = _one_sample(work, part, going)
        for k in np.flatnonzero(going).tolist():
            part, ended[k] = _turned(work, part, k, k in failed)
            failures[k] = k in failed
        taken += 1
    told = None
    if ended.any():
        left, wrong = np.full((2, len(state)), np.nan)
        left[which[ended]], wrong[which[failures]] = part.replay.distance[ended], 1.0
        told = Diagnostics(replay_left=left, replay_failed=wrong)
    if len(which) == len(state):
        return part, told
    log = state.log
    part, state = (changed(one, log=one.log[:, :0]) for one in (part, state))
    return changed(put(state, which, part), log=log), told


def _window(work: SensitivityWork, state: SensitivityState, now: FilterState) -> Window:
    """Return the window of one member, from its start to the row `until` of its replay."""
    begin = int(state.window[0])
    first = first_interval(state.log[:, begin:], work.filter.problem.channels)
    length = float(np.nanmax(state.log[0, begin : int(state.replay.until[0]) + 1, 0])) - first.t1
    reference = state.replay.reference[0]
    return Window(
        start=state.start,
        now=now,
        reference=reference,
        initial=bool(state.initial[0]),
        moment=first.end,
        length=length,
    )


def _begun(work: SensitivityWork, replay: Replay, state: SensitivityState) -> ReplayState:
    """Return the replay of one member, where it begins."""
    begun = changed(
        state.replay,
        until=np.flatnonzero(np.isfinite(state.log[0, :, 0]))[-1:],
        rounds=np.array([replay.iterations]),
        reference=state.reference,
        count=state.assimilated,
    )
    return _again(work, changed(state, replay=begun), state.now)


def _again(work: SensitivityWork, state: SensitivityState, now: FilterState) -> ReplayState:
    """Return the replay of one member at the start of its window, about the next reference."""
    filter_, window = work.filter, _window(work, state, now)
    q = next_reference(filter_, window)
    x = placed(filter_, window, q)
    if state.opening[0]:
        first = first_interval(state.log[:, int(state.window[0]) :], filter_.problem.channels)
        x, _ = absorb(filter_, x, filter_.span(first), work.options)
    rounds = state.replay.rounds - 1
    return changed(state.replay, x=x, row=state.window, rounds=rounds, reference=q[None])


def _one_sample(
    work: SensitivityWork, state: SensitivityState, going: Mask
) -> tuple[SensitivityState, set[int]]:
    """Return all members after the next stored sample of those `going`, and whose replays fail."""
    replay, together = state.replay, defaultdict(list)
    for k in np.flatnonzero(going).tolist():
        row = int(replay.row[k])
        # Members with the same interval of time take it together, as arrays.
        together[float(state.log[k, row, 0]), following(state.log[k], row)].append(k)
    failed: set[int] = set()
    for (_, row), members in together.items():
        x, wrong = _assimilated(work, state, members, row)
        at = replay.row.copy()
        at[members] = row
        whole = len(members) == len(state)
        replay = changed(replay, x=x if whole else put(replay.x, members, x), row=at)
        failed.update(wrong)
    return changed(state, replay=replay), failed


def _assimilated(
    work: SensitivityWork, state: SensitivityState, members: list[int], row: int
) -> tuple[FilterState, list[int]]:
    """Return the filters of some replays after a row of the log, and whose replays failed."""
    filter_ = work.filter
    whole = len(members) == len(state)
    x = state.replay.x if whole else take(state.replay.x, members)
    log = state.log if whole else state.log[members]
    span = span_between(log, state.replay.row[members], row, filter_.problem)
    new, told = assimilate(filter_, x, span, work.options)
    if told.status.ok:
        return new, [k for k, finite in zip(members, told.finite, strict=True) if not finite]
    if len(members) == 1:
        return x, members
    each = [_assimilated(work, state, [k], row) for k in members]  # one that fails stops all
    filters, wrong = zip(*each, strict=True)
    return join(*filters), list(chain.from_iterable(wrong))


def _turned(
    work: SensitivityWork, state: SensitivityState, k: int, failed: bool
) -> tuple[SensitivityState, bool]:
    """Return all members after a replay may have come to an end, and whether it has for good."""
    replay, log = state.replay, state.log[k]
    row, until = int(replay.row[k]), int(replay.until[k])
    if failed:  # the linear estimate is kept, and the next replay is tried when doubled
        return _ended(state, k, take(state, k)), True
    if row < until:
        return state, False
    # At the row where the replay began: go round again about the next reference, or keep this one
    # and catch up with the samples that came meanwhile.
    if row == until and replay.rounds[k] >= 0:
        one = take(state, k)
        left = distance(work.filter, _window(work, one, one.replay.x))
        one = changed(one, replay=changed(one.replay, distance=np.array([left])))
        if left > CONVERGED and replay.rounds[k] > 0:
            return _with(state, k, _again(work, one, one.replay.x)), False
        state = _with(state, k, changed(one.replay, rounds=np.array([-1])))
    if following(log, row) < len(log):  # samples came while the replay ran
        return state, False
    one = take(state, k)
    return _ended(state, k, changed(one, now=one.replay.x, reference=one.replay.reference)), True


def _ended(state: SensitivityState, k: int, one: SensitivityState) -> SensitivityState:
    """Return all members with one of them, whose replay is over.

    A filter to go back to that was set with this sample, before its replay, is that after it.
    """
    if one.since_newer[0] == one.log.shape[1] - 1:
        one = changed(one, newer=one.now)
    replay = changed(ReplayState.none(one.start), distance=one.replay.distance)
    return put(state, k, changed(one, replay=replay, due=2 * one.replay.count))
