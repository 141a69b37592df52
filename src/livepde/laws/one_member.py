"""Step of one member of a sensitivity law, with safeguards and alarms.

It is used if a sample moves an unknown too far, a step fails, the estimate runs away, or an alarm
indicates a jump. All states in this module have one member.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from livepde.laws.assimilation import UpdateOptions, assimilate
from livepde.laws.filter_state import FilterState, unaccompanied
from livepde.laws.history import changing, intervals_since, reaching
from livepde.laws.iterated_smoother import (
    AGREED,
    Window,
    distance,
    missed_most,
    next_reference,
    placed,
)
from livepde.laws.law import Report, Status
from livepde.laws.policies import Guards, Jumps, Watch
from livepde.laws.sensitivity_state import (
    SensitivityState,
    SensitivityWork,
    new_window,
    reports_of,
    restarted,
    stored,
    without_past,
)
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Mask
from livepde.linalg.member_arrays import changed, where
from livepde.stepping import Interval, Span

NEAR_ONSETS = (-8, -6, -4, -3, -2, -1, 0, 1, 2, 3)  # samples between trial onsets and first guess
TEMPER = 10.0  # factor on the noise of a sample whose Gauss-Newton steps do not converge


def step_alone(
    work: SensitivityWork, state: SensitivityState, interval: Interval
) -> tuple[SensitivityState, Report]:
    """Return one member after a sample, with safeguards and alarms."""
    new, report = _assimilated(work, state, interval)
    if (guards := work.guards) is not None:
        new, report = _with_safeguards(work, guards, state, interval, new, report)
    if report.status.ok and (jumps := work.jumps) is not None:
        new, report = _with_jump_test(work, jumps, state, interval, new, report)
    return new, report


def filtered(
    work: SensitivityWork, x: FilterState, interval: Interval
) -> tuple[FilterState, Report]:
    """Return the filter after a sample, linear about the reference of `x`, and the report."""
    span = work.filter.span(interval)
    new, outcome = assimilate(work.filter, x, span, work.options)
    status = outcome.status
    if status.ok and not outcome.finite[0]:
        what = "prediction" if not np.isfinite(outcome.predicted).all() else "update"
        status = Status("not_finite", f"the {what} is not finite")
    if not status.ok:
        predicted, _ = work.filter.sensors.observe(x, span.end)
        return x, Report(status, predicted[0])
    return new, reports_of(work, new, outcome).member(0)


def _assimilated(
    work: SensitivityWork, state: SensitivityState, interval: Interval
) -> tuple[SensitivityState, Report]:
    """Return one member after a sample, with Gauss-Newton steps if it moves too far."""
    x, report = filtered(work, state.now, interval)
    if not report.status.ok:
        return state, report
    span = work.filter.span(interval)
    taken = np.ones(1, dtype=bool)
    if (guards := work.guards) is not None:
        x, done = _iterated(work, guards, state, interval, x)
        if done is not None:
            report = report.updated(x.innovations.diagnostics.member(0).updated(done))
    x = work.filter.relinearised(x) if work.relinearises else x
    return stored(work, state, x, span, taken), report


def _iterated(
    work: SensitivityWork,
    guards: Guards,
    state: SensitivityState,
    interval: Interval,
    x: FilterState,
) -> tuple[FilterState, Diagnostics[float] | None]:
    """Return the filter after a sample that may have moved it too far, and the safeguard or None.

    After an excessive move, the sample is assimilated again from the start of its interval.
    """
    before = state.now
    if guards.within_reach(x.da - before.da)[0]:  # a cheap test, before the exact distance
        return x, None
    filter_, kept = work.filter, x.kept

    def levelled(x: FilterState, tempered: int) -> FilterState:
        if not tempered:  # a tempered sample has no information about the noise level
            return x
        return changed(x, level=before.level, samples=before.samples)

    for temper in range(guards.temperings + 1):
        tempered = Diagnostics(tempered=1.0) if temper else None
        # The level is a variance: twice the exponent makes the noise TEMPER^temper times larger.
        begin = changed(before, level=before.level * TEMPER ** (2 * temper), kept=kept)
        if temper:
            x, _ = filtered(work, begin, interval)
            if guards.within_reach(x.da - begin.da)[0]:
                return levelled(x, temper), tempered
        start, length = interval.at(interval.t0), interval.t1 - interval.t0
        window = Window(
            start=begin, now=x, reference=begin.q[0], initial=False, moment=start, length=length
        )
        far = missed_most(filter_, window) > guards.reach
        if not (far and distance(filter_, window) > AGREED):
            return levelled(x, temper), tempered
        after = _converged(work, window, interval, guards.iterations)
        if after is not None:
            return levelled(after, temper), replace(tempered or Diagnostics(), iterated=1.0)
    return filtered(work, before, interval.silent)[0], Diagnostics(held=1.0)


def _converged(
    work: SensitivityWork, window: Window, interval: Interval, most: int
) -> FilterState | None:
    """Return the filter after a sample about the limit of Gauss-Newton steps, or None."""
    # The search omits ledger and discretisation errors, which double its cost.
    filter_, searching, start = work.filter, work.unaccompanied, unaccompanied(window.start)
    for _ in range(most):
        last, q = window, next_reference(filter_, window)
        x, report = filtered(searching, placed(filter_, replace(window, start=start), q), interval)
        if np.count_nonzero(x.screened.refused):
            # Discretisation errors widen the gate, so that it may use the refused readings.
            searching, start = work, window.start
            x, report = filtered(work, placed(filter_, window, q), interval)
        if not report.status.ok:
            return None
        window = replace(window, now=x, reference=q)
        if distance(filter_, window) <= AGREED:
            # Repeat the step about the same reference with ledger and discretisation errors.
            x, report = filtered(work, placed(filter_, last, q), interval)
            return x if report.status.ok else None
    return None


def _with_safeguards(
    work: SensitivityWork,
    guards: Guards,
    state: SensitivityState,
    interval: Interval,
    new: SensitivityState,
    report: Report,
) -> tuple[SensitivityState, Report]:
    """Return one member and report after a sample that may have failed or run away."""
    noise = work.filter.noise_of(state.now, interval)
    z = interval.z1[None]
    scale = state.scale.add(z, z - report.predicted)

    def unusable(report: Report) -> bool:
        beyond = scale.beyond(z - report.predicted, noise)
        return not report.status.ok or bool(beyond[0] > guards.runaway)

    if not unusable(report):
        return changed(
            new, scale=scale.without_refused(state.scale, new.now.screened.refused)
        ), report
    older = changed(work.filter.relinearised(state.older), kept=new.now.kept)
    row = int(state.since_older[0])
    # The older state is propagated without the readings of the samples since.
    silent = [item.silent for item in [*_since(work, state, row), interval]]
    # Try the older estimate with a wider covariance first, and the prior last.
    for start in (work.filter.inflated(older, 1.0), work.filter.with_prior(older)):
        restart, outcome = _reassimilated(work, state, start, row, silent)
        if not unusable(outcome):
            outcome = outcome.updated(Diagnostics(restarted=1.0))
            return changed(without_past(restart), scale=scale), outcome
    if not report.status.ok:
        return state, report
    return changed(new, scale=scale), report.updated(Diagnostics(runaway=1.0))


def _since(work: SensitivityWork, state: SensitivityState, row: int) -> list[Interval]:
    return intervals_since(state.log[:, row:], work.filter.problem.channels)


def _reassimilated(
    work: SensitivityWork,
    state: SensitivityState,
    start: FilterState,
    row: int,
    intervals: Sequence[Interval],
) -> tuple[SensitivityState, Report]:
    """Return one member after assimilating samples again from a filter at a row of the log."""
    state = restarted(work, start, state, row)
    for interval in intervals:
        state, report = _assimilated(work, state, interval)
        if not report.status.ok:
            break
    return state, report


def _most_likely_onset(
    work: SensitivityWork,
    jumps: Jumps,
    x: FilterState,
    known: Sequence[Interval],
    guesses: Sequence[int],
) -> int:
    """Return the number of samples before a jump that maximises the likelihood, near guesses.

    The first guess is the most likely one: numbers near it are tried, too.

    A state propagated without the jump, or with the jump too early, misfits for a long time. The
    constants that do not jump would have to explain this misfit.
    """
    guess = guesses[0]
    near = {*guesses, *(guess + shift for shift in NEAR_ONSETS)}
    tried = {changing(known, number).start for number in near & set(range(len(known)))}
    # Refusals before the first trial onset stay; after it, each trial must explain all readings.
    open_gate = UpdateOptions(adaptive=work.options.adaptive)
    searching = replace(work.unaccompanied, options=open_gate)
    x, score, best = work.filter.relinearised(unaccompanied(x)), -np.inf, guess
    for number, interval in enumerate(known):
        if number in tried:
            likelihood = _likelihood(searching, jumps, x, known[number:])
            score, best = max((score, best), (likelihood, number))
        x, report = filtered(searching if number >= min(tried) else work.unaccompanied, x, interval)
        x = work.filter.relinearised(x)
        if not report.status.ok:
            break
    return best


def _likelihood(
    work: SensitivityWork, jumps: Jumps, x: FilterState, intervals: Sequence[Interval]
) -> float:
    """Return the log-likelihood of all samples if the unknowns jump before `intervals`."""
    when = changing(intervals, 0)
    x, status = _filtered_all(work, x, intervals, when, jumps.part(1.0 / len(when)))
    return float(x.evidence[0]) if status.ok else -np.inf


def _filtered_all(
    work: SensitivityWork, x: FilterState, intervals: Sequence[Interval], when: range, size: float
) -> tuple[FilterState, Status]:
    """Return the filter after samples, up to the first failure, and the last status.

    The unknowns jump by `size` at the start of each interval in `when`.
    """
    status = Status()
    for number, interval in enumerate(intervals):
        if number in when:
            x = work.filter.inflated(x, size, work.jumping)
        x, report = filtered(work, x, interval)
        x, status = work.filter.relinearised(x), report.status
        if not status.ok:
            break
    return x, status


def watched(
    work: SensitivityWork, jumps: Jumps, state: SensitivityState, x: FilterState, span: Span
) -> tuple[Watch, Mask]:
    """Return the watch for jumps after a sample, and the mask of members with an alarm."""
    screened, present = x.screened, span.present
    gaps, newest = work.filter.input_gaps(span), x.innovations.newest
    seen, alarm = jumps.add(state.watch, newest, screened.refused, screened.run, gaps)
    # Without a reading, `newest` is from an earlier sample, which has been counted.
    return where(np.broadcast_to(present, alarm.shape), seen, state.watch), alarm & present


def _with_jump_test(
    work: SensitivityWork,
    jumps: Jumps,
    state: SensitivityState,
    interval: Interval,
    new: SensitivityState,
    report: Report,
) -> tuple[SensitivityState, Report]:
    """Return one member and report after the test for a jump.

    After an alarm, the samples since the jump are assimilated again, from a state before the jump:
    they have led the state away, and earlier readings depend on other values of the unknowns.
    """
    if not interval.present.any():  # there is no innovation; `newest` is from an earlier sample
        return new, report
    watch, alarm = watched(work, jumps, state, new.now, work.filter.span(interval))
    new = changed(new, watch=watch)
    if not alarm[0]:
        return new, report
    screened, e = new.now.screened, new.now.innovations.newest
    row = int(state.since_older[0])
    known = [*_since(work, state, row), interval]
    # `onset` ignores readings that the gate refused in a row, but the jump may explain them.
    doubted = int(np.where(screened.excluded, 0, screened.refused).max())
    moving = np.where(state.watch.repeating(screened.run), np.nan, e)
    shown = [bool(item.present.any()) for item in known]
    onsets = [max(onset, doubted) for onset in jumps.onsets(state.watch, moving)]
    guesses = [len(known) - reaching(shown, onset) for onset in onsets]
    before = _most_likely_onset(work, jumps, state.older, known, guesses)
    when = changing(known, before)
    size, last = jumps.part(1.0 / len(when)), when[-1]
    x = changed(work.filter.relinearised(state.older), kept=new.now.kept)
    x, status = _filtered_all(work, x, known[:last], when, size)
    start = work.filter.inflated(x, size, work.jumping)
    if last < len(known):
        # Rows without a time are samples that this member did not assimilate.
        taken = np.flatnonzero(np.isfinite(state.log[0, row:, 0]))
        restart, outcome = _reassimilated(work, new, start, row + int(taken[last]), known[last:])
        status = outcome.status if status.ok else status
    else:
        restart = restarted(work, start, new)
    if status.ok:
        new = restart
    else:
        now = work.filter.relinearised(new.now)
        new = new_window(work, work.filter.inflated(now, jumps.size, work.jumping), new)
    since = float(len(known) - when.start)
    return new, report.updated(Diagnostics(jump=1.0, jump_samples=since))
