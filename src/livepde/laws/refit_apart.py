"""A refit in its own thread, while samples continue.

The refit is a function of the state where it began, so that it may run at any time, and again after
a restart. When the filter goes over to it depends on the number of samples alone.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future
from weakref import WeakKeyDictionary

import numpy as np

from livepde.laws.assimilation import assimilate
from livepde.laws.filter_state import FilterState
from livepde.laws.history import intervals_since
from livepde.laws.law import numerical
from livepde.laws.member_arrays import changed
from livepde.laws.refit_options import Refit
from livepde.laws.refits import refitted_now
from livepde.laws.sensitivity_state import Fork, SensitivityState, SensitivityWork
from livepde.linalg import nonfinite_allowed

LATER = 8  # a refit of n samples is used n / 8 samples after it began
AT_A_TIME = 3  # samples since then that a step takes with the filter of the refit

UNDER_WAY: WeakKeyDictionary[FilterState, Future[SensitivityState]] = WeakKeyDictionary()
LOCK = threading.Lock()


def go_on(work: SensitivityWork, state: SensitivityState) -> SensitivityState:
    """Return one member after a sample, with the refit under way taken a step further."""
    fork, options = state.fork, work.refit
    if options is None:
        return state
    if not fork.fitted[0]:
        refit = _under_way(work, options, state)
        count = int(fork.samples[0])
        if state.assimilated[0] < count + max(count // LATER, 1):
            return state
        try:
            found = refit.result()
        except Exception as error:
            if numerical(error) is None:
                raise
            # Of the same samples it would fail again: the filter goes on, and the fit is none.
            failed = changed(state.fit, samples=fork.samples, converged=np.zeros(1))
            return _without(changed(state, fit=failed), fork.filter)
        state = changed(state, fit=found.fit)
        if found.now is fork.filter:  # no better trajectory was found
            return _without(state, fork.filter)
        fork = changed(fork, filter=found.now, fitted=np.ones(1, dtype=bool))
    return _caught_up(work, state, fork)


def _under_way(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> Future[SensitivityState]:
    """Return the refit of one member, which is begun where it is not yet."""
    fork = state.fork
    with LOCK:
        if fork.filter in UNDER_WAY:
            return UNDER_WAY[fork.filter]
        future = UNDER_WAY[fork.filter] = Future()
    log = state.log[:, : int(fork.row[0]) + 1]
    begun = changed(state, now=fork.filter, log=log, assimilated=fork.samples)
    begun = _without(begun, fork.filter)
    # A daemon: a program that ends does not wait for it.
    threading.Thread(target=_run, args=(future, work, options, begun), daemon=True).start()
    return future


@nonfinite_allowed()  # such a trajectory is refused
def _run(
    future: Future[SensitivityState],
    work: SensitivityWork,
    options: Refit,
    state: SensitivityState,
) -> None:
    try:
        future.set_result(refitted_now(work, options, state))
    except Exception as error:  # noqa: BLE001, raised where the result is asked for
        future.set_exception(error)


def _caught_up(work: SensitivityWork, state: SensitivityState, fork: Fork) -> SensitivityState:
    """Return one member after the next samples since a refit, which has ended."""
    row, last, x = int(fork.row[0]), state.log.shape[1] - 1, fork.filter
    rows = state.log[:, row : row + 1 + AT_A_TIME]
    for interval in intervals_since(rows, work.filter.problem.channels):
        x, told = assimilate(work.filter, x, work.filter.span(interval), work.options)
        if not (told.status.ok and told.finite[0]):
            return _without(state, x)
        x, row = work.filter.relinearised(x), row + 1
    if row < last:
        return changed(state, fork=changed(fork, filter=x, row=np.array([row])))
    newer = x if state.since_newer[0] == last else state.newer
    return _without(changed(state, now=x, newer=newer), x)


def _without(state: SensitivityState, x: FilterState) -> SensitivityState:
    return changed(state, fork=Fork.none(x))
