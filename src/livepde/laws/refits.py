"""Refits of members that are due: at once, or in a thread while samples continue.

A refit in a thread is a function of the state where it began, so that it may run at any time, and
again after a restart. When the filter goes over to it depends on the number of samples alone.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future
from weakref import WeakKeyDictionary

import numpy as np

from livepde.laws.assimilation import assimilate
from livepde.laws.filter_state import FilterState
from livepde.laws.history import intervals_since
from livepde.laws.iterated_smoother import HOLDS, apart, iterate_starts, usual
from livepde.laws.law import numerical
from livepde.laws.member_arrays import changed, put_each, take
from livepde.laws.policies import Refit
from livepde.laws.refit import Found, refitted
from livepde.laws.sensitivity_state import (
    FitState,
    Fork,
    SensitivityState,
    SensitivityWork,
    new_window,
)
from livepde.laws.step_diagnostics import Diagnostics
from livepde.laws.stored_samples import StoredSamples
from livepde.linalg import Array, Mask, nonfinite_allowed

AT_ONCE = 64  # samples up to which a refit takes no thread of its own: it is as short as ten steps
NEAR = 1.0  # standard deviations within which a refit that another one follows keeps these sums
LATER = 8  # a refit of n samples is used n / 8 samples after it began
AT_A_TIME = 3  # samples since then that a step takes with the filter of the refit

UNDER_WAY: WeakKeyDictionary[FilterState, Future[SensitivityState]] = WeakKeyDictionary()
LOCK = threading.Lock()


def refit_due(
    work: SensitivityWork, state: SensitivityState, due: Mask
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after the refits that are due, and diagnostics if there was one."""
    if not work.fits:
        return iterate_starts(work, state, due)
    if (options := work.refit) is None:
        return state, None
    each: dict[int, SensitivityState] = {}
    for k in np.flatnonzero(due).tolist():
        one = take(state, k)
        count = int(one.assimilated[0])
        if max(count, one.log.shape[1] - 1 - int(one.window[0])) >= options.window:
            one = new_window(work, one.now, one)
        else:
            # A window but the first begins with what is known: it has nothing to search for.
            if count <= options.start and options.apart and len(state) == 1 and count > AT_ONCE:
                one = changed(one, fork=Fork.of(one))
            elif count <= options.start:
                one = refitted_now(work, options, one)
            later = 2 * count if 2 * count <= options.start else options.window
            one = changed(one, due=np.array([later]))
        each[k] = one
    return put_each(state, each), None


@nonfinite_allowed()  # such a trajectory is refused
def settle(
    work: SensitivityWork, state: SensitivityState
) -> tuple[SensitivityState, list[Mask | None]]:
    """Return all members after a last refit, and the readings it has used or None, of each."""
    used: list[Mask | None] = [None] * len(state)
    each: dict[int, SensitivityState] = {}
    options = work.refit
    if options is None or not work.fits:
        return state, used
    for k in range(len(state)):
        one = take(state, k)
        if one.log.shape[1] and (one.assimilated[0] or one.opening[0]):
            samples = StoredSamples.of(work, one)
            found = refitted(samples, options, last=True, screened=int(one.fit.screened[0]))
            used[k] = None if found is None else found.used
            one = changed(one, fork=Fork.none(one.now))  # this is a refit of more samples
            each[k] = _after(work, one, samples, found, last=True)
    return put_each(state, each), used


def refitted_now(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> SensitivityState:
    """Return one member after a refit that another one follows."""
    samples = StoredSamples.of(work, state)
    found = refitted(samples, options, last=False, screened=int(state.fit.screened[0]))
    return _after(work, state, samples, found, last=False)


def _after(
    work: SensitivityWork,
    state: SensitivityState,
    samples: StoredSamples,
    found: Found | None,
    *,
    last: bool,
) -> SensitivityState:
    count, spent = state.assimilated, state.fit.work
    x = None if found is None else _filter(samples, found, last=last)
    if found is None or x is None:
        fit = changed(state.fit, samples=count, converged=np.zeros(1))
        return changed(state, fit=fit)
    there = np.isfinite(samples.readings)
    fit = FitState(
        samples=count,
        cost=np.array([found.best.cost(found.used)]),
        readings=np.array([float(there.sum())]),
        refused=np.array([float((there & ~found.used).sum())]),
        work=spent + found.passes * len(samples.spans),
        converged=np.array([float(found.converged)]),
        screened=np.array([len(samples.spans)]) if found.screened else state.fit.screened,
    )
    now = work.filter.relinearised(x)
    # A filter to go back to that was set with this sample is that after the fit.
    newer = now if state.since_newer[0] == state.log.shape[1] - 1 else state.newer
    return changed(state, now=now, newer=newer, fit=fit)


def _filter(samples: StoredSamples, found: Found, *, last: bool) -> FilterState | None:
    """Return the filter that continues from the end of a search; None if a step fails."""
    now = samples.state.now
    evidence = samples.state.start.evidence + samples.log_evidence(found.best, found.used)
    best = changed(samples.updated(found.best, found.used), evidence=evidence)
    away = apart(samples.filter, best, now)
    # Sums of the verdict and errors of the discretisation stay with the filter until then: a later
    # refit of the same samples may compute them again.
    if (away <= HOLDS and usual(now)) or (away <= NEAR and not last):
        return best
    x = samples.judged(found.best, found.used)
    return None if x is None else changed(x, evidence=evidence)


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
