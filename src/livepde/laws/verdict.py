"""Verdict on a filter: judge, additional findings, errors of the model, and failed steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from livepde.laws.columns import Columns, likely_columns
from livepde.laws.filter import Filter, reported_factors
from livepde.laws.filter_state import PAUSE, SETTLED, FilterState, ShadowState
from livepde.laws.law import Fit, Problem, Status
from livepde.laws.model_errors import errors_of_innovations, model_errors
from livepde.laws.noise_rows import input_rank
from livepde.laws.reduction import Reduction
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.laws.shadow_kinds import ALLOWED
from livepde.laws.shadows import ShadowSet
from livepde.laws.stored_samples import StoredSamples
from livepde.linalg import Array, IntArray, nonfinite_allowed
from livepde.linalg.member_arrays import changed
from livepde.records import STATUS_CODES
from livepde.stepping import MOST_SUBSTEPS
from livepde.verdict import (
    NOT_JUDGED,
    REFUSED,
    Cause,
    Dictionary,
    Finding,
    Judge,
    ModelErrors,
    Position,
    Severity,
    Verdict,
    assess,
    too_few,
)
from livepde.verdict.sentences import FINDINGS, percent

COARSE = 10.0  # error of a step over its tolerance, above which the finding is a caution
LARGER = 1.5  # noise over its initial guess, above which the first samples had too much weight
LARGE = 1.0  # misfit over noise that a column must explain if no test has found a misfit
COUNTS = len(STATUS_CODES) + 1  # number of counts of a `StepLedger`

CAUTION_SHARE = 0.02  # share of failed steps above which the finding is a caution
SERIOUS_SHARE = 0.5  # share of failed steps above which the result is not to be trusted
PLACES = {code: place for place, code in enumerate(STATUS_CODES)}
FAILURES = ("departed", "not_converged", "not_finite", "singular")  # each code has a finding


def judge_of(
    problem: Problem,
    reduction: Reduction,
    noise: Array,
    verdict: bool | str,
    rank: int,
    *,
    kept: bool,
) -> Judge | None:
    """Return the judge of a filter; None if `verdict` is False."""
    if not verdict:
        return None
    still = kept and not (reduction.moves or problem.input_noise)
    model = problem.model
    dictionary = Dictionary(model, problem.observed, noise, reduction.stay, dearer=verdict is True)
    sizes = problem.observed.size, reduction.size, model.X.dim
    # Noise of inputs and errors of the start add rows before a compression.
    rows = rank + input_rank(problem) + problem.initial_rank
    return Judge(dictionary, *sizes, rows, still=still)


def judged(filter_: Filter, x: FilterState, kept: FilterState) -> Callable[[], Verdict]:
    """Return a function for the verdict on one member, which references only the data it uses.

    `kept`: result of `kept_for_estimates` for the filter state.
    """
    judge, ledger, causes = filter_.judge, x.ledger, x.causes
    if judge is None:
        return lambda: Verdict.of((), ("innovations: verdict = False",), judged=False)
    if not ledger.seen[0]:
        return lambda: Verdict.of((), (too_few("innovations", 0),), judged=False)
    # Responses of the process have the size of u, and no finding uses them.
    if ledger.process.size:
        ledger = changed(ledger, process=ledger.process[:, :0, :0].copy())

    def assessed() -> Verdict:
        w, settled = judge.summed_up(ledger, causes)
        with nonfinite_allowed():
            at = _position(filter_, changed(kept, causes=w, ledger=settled))
            return assess(judge.dictionary, at)

    return assessed


def with_fit(verdict: Verdict, fit: Fit | None) -> Verdict:
    """Return a verdict with findings if the last fit did not converge or refused many readings."""
    if fit is None:
        return verdict
    findings = []
    if not fit.converged:
        text, remedy = FINDINGS["fit, not converged"].filled(samples=fit.samples)
        findings.append(Finding("fit", "do not trust", text, remedy=remedy))
    share = fit.refused / max(fit.readings, 1)
    if share > REFUSED:
        text, remedy = FINDINGS["fit, refused"].filled(
            samples=fit.samples, share=percent(share, 1), count=fit.refused
        )
        findings.append(Finding("fit", "caution", text, evidence=share, remedy=remedy))
    return verdict.with_findings(findings) if findings else verdict


def with_noise(verdict: Verdict, work: SensitivityWork, level: float) -> Verdict:
    """Return a verdict with a finding if the first samples used a noise much too small.

    `level`: noise variance over its initial guess. With a refit, all samples use the same level.
    """
    ratio = math.sqrt(level)
    if work.refit is not None or not work.options.adaptive or not ratio > LARGER:
        return verdict
    text, remedy = FINDINGS["noise, found"].filled(ratio=ratio)
    more = Finding("noise", "caution", text, "", ratio, remedy=remedy)
    return verdict.with_findings([more])


def after_fit(verdict: Verdict, fit: Fit | None) -> Verdict:
    """Return a verdict at the end of a run without refusals by the gate, if its fit converged.

    A converged fit of all samples decides on all readings again.
    """
    if fit is None or not fit.converged:
        return verdict
    kept = [finding for finding in verdict.findings if finding.what != "refused"]
    return Verdict.of(kept, verdict.untested, verdict.unseen, judged=verdict.judged)


def with_discretisation(verdict: Verdict, shadows: ShadowSet | None, s: ShadowState) -> Verdict:
    """Return a verdict with findings on discretisation errors that are large or not estimated."""
    missing = "the discretisation: shadows = None" if shadows is None else shadows.unfollowed
    if shadows is not None and s.coarse[0]:
        worst = float(s.coarsest[0])
        text, remedy = FINDINGS["step"].filled(
            count=int(s.coarse[0]),
            steps=int(s.count[0]),
            size=ALLOWED * worst,
            allowed=ALLOWED,
            parts=shadows.most,
        )
        # For such large errors, the estimated shift has few correct digits.
        severity: Severity = "caution" if worst > COARSE else "note"
        finding = Finding("step", severity, text, "time step", worst, remedy=remedy)
        verdict = verdict.with_findings([finding])
    if not missing or not verdict.judged:
        return verdict
    text, _ = FINDINGS["untested"].filled(what=missing)
    more = Finding("untested", "note", text, "discretisation")
    return verdict.with_untested(missing).with_findings([more])


def with_assumed_start(verdict: Verdict) -> Verdict:
    """Return a verdict whose findings include the default initial state of zero as a suspect."""
    if verdict.level == "trusted" or not verdict.findings:
        return verdict
    text, remedy = FINDINGS["start, assumed"].filled()
    return verdict.with_findings([Finding("start", "note", text, "u0", remedy=remedy)])


def with_columns(verdict: Verdict, columns: Columns | str) -> Verdict:
    """Return a verdict with the data columns that may explain a misfit."""
    doubted = any(finding.severity != "note" for finding in verdict.findings)
    if verdict.level == "trusted" or not (verdict.judged or doubted):
        return verdict
    if isinstance(columns, str):
        return verdict.with_untested(f"errors of single columns: {columns}")
    # Slow noise is a misfit too, and a column may explain a part of it by chance.
    known = any(finding.what == "misfit" for finding in verdict.findings)
    return verdict.with_causes(likely_columns(columns, 0.0 if known else LARGE))


def with_errors(verdict: Verdict, work: SensitivityWork, state: SensitivityState) -> Verdict:
    """Return a verdict whose level follows from the misfit and its effects, if available."""
    if verdict.level == NOT_JUDGED:
        return verdict
    found = _errors(work, state)
    if isinstance(found, str):
        return verdict.with_untested(f"intervals that allow for errors of the model: {found}")
    errors, causes = found
    if any(finding.what == "misfit" for finding in verdict.findings):
        verdict = verdict.with_causes(causes)
    return verdict.with_errors(errors)


def _errors(
    work: SensitivityWork, state: SensitivityState
) -> tuple[ModelErrors, list[Cause]] | str:
    """Return misfit, effects and causes for one member, or the reason why there are none."""
    filter_, x = work.filter, state.now
    Phi, (_, C) = filter_.reduction.Phi, reported_factors(filter_, x)
    shift = np.zeros(len(Phi))
    if filter_.shadows is not None:
        shift = Phi @ filter_.shadows.widening(x)[1][0, 0]
    std = np.linalg.norm(Phi @ C[0].T, axis=1)
    # In a later window, the information of earlier samples would count as exact.
    if work.refit is None or work.unstored(state) or state.window[0]:
        errors = errors_of_innovations(filter_, x, state.scale.ranges[0], std, shift)
        return errors if isinstance(errors, str) else (errors, [])
    return model_errors(StoredSamples.of(work, state), work.refit, std, shift)


def _position(filter_: Filter, x: FilterState) -> Position:
    problem, reduction = filter_.problem, filter_.reduction
    latent = problem.model.latent
    _, C = reported_factors(filter_, x)
    std = np.linalg.norm(reduction.Phi @ C[0].T, axis=1)
    std = np.where(std > 0.0, std, np.inf)
    # C^T w is truth minus estimate for a cause of amplitude 1: see `livepde.verdict.judge`.
    moved = (reduction.Phi @ (x.C[0].T @ x.causes[0])) / std[:, None]  # (m, columns)
    shape = (len(x.ledger.age[0]), -1)
    by_label: dict[str, Array] = {}
    for name, item in latent.parts.items():
        rows = moved[item.part.start : item.part.start + item.size]
        labels = item.block.labels(name)
        if len(labels) == len(rows):
            pairs = zip(labels, rows, strict=True)
            by_label |= {label: row.reshape(shape) for label, row in pairs}
        else:
            by_label[name] = np.sqrt((rows**2).mean(axis=0)).reshape(shape)
    a = reduction.reduced(filter_.estimate(x) - latent.prior)[0]
    names = [""] * reduction.size
    for label, place in reduction.stay:
        names[place] = label
    sensors, screened = problem.observed.names, x.screened
    since, deviation = screened.since[0].tolist(), screened.deviation[0].tolist()
    excluded = np.flatnonzero(screened.excluded[0]).tolist()
    return Position(
        ledger=x.ledger.of_member(0),
        moved=by_label,
        distance=_distance(reduction, x, a),
        sensors=sensors,
        noise=np.sqrt(x.level[0]) * filter_.noise,
        unit=problem.observed.unit,
        time_unit=problem.model.time_unit,
        unknowns=names,
        moving=reduction.moves,
        excluded={sensors[i]: (since[i], deviation[i]) for i in excluded},
        state_only=int(screened.state_only[0].sum()),
        strain=int(screened.strain[0].max()),
        start_uncertain=len(problem.initial_errors) > 0,
    )


def _distance(reduction: Reduction, x: FilterState, a: Array) -> tuple[float, int]:
    """Return the squared distance of an estimate from its prior, and its degrees of freedom.

    Only directions in which the data have halved the prior variance count. There the estimate has
    the distribution N(0, 1 - P), with the prior covariance 1 and the posterior covariance P.
    """
    if reduction.moves:
        return 0.0, 0
    variances, axes = np.linalg.eigh(x.C[0].T @ x.C[0])
    known = variances < 0.5
    along = axes.T @ a
    squared = float((along[known] ** 2 / (1.0 - variances[known])).sum())
    return squared, int(known.sum())


class StepLedger(NamedTuple):
    """Numbers of samples by the status of their step, in the order of `STATUS_CODES`.

    The last count is the number of intervals whose substeps were longer than `dt_max`.
    """

    counts: IntArray
    lengths: Array  # length of the first interval, from t0 on, and sum of the others, shape (2,)

    @classmethod
    def start(cls) -> StepLedger:
        return cls(np.zeros(COUNTS, dtype=np.int64), np.zeros(2))

    def add(self, code: str, length: float, stretched: bool) -> StepLedger:
        """Return the ledger after a step with the status `code`."""
        counts, lengths = self.counts.copy(), self.lengths.copy()
        lengths[int(counts[:-1].sum() > 0)] += length
        counts[PLACES[code]] += 1
        counts[-1] += stretched
        return StepLedger(counts, lengths)

    @property
    def _late(self) -> float:
        """Length of the first interval over the mean of the others; 0 for few samples."""
        first, later = self.lengths.tolist()
        count = int(self.counts[:-1].sum()) - 1
        return first * count / later if count >= SETTLED and later > 0.0 else 0.0

    @property
    def irregular(self) -> bool:
        """True if a step was not ok or had too long substeps, or if the first sample was late."""
        counts = self.counts.tolist()
        return bool(sum(counts) > counts[PLACES["ok"]]) or self._late > PAUSE

    def findings(self) -> Iterator[Finding]:
        """Yield a finding for each kind of failed step, for a late start and for long substeps."""
        *counts, stretched = self.counts.tolist()
        yield from step_findings(dict(zip(STATUS_CODES, counts, strict=True)))
        if self._late > PAUSE:
            text, remedy = FINDINGS["start, late"].filled(count=self._late)
            yield Finding("start", "note", text, "t0", self._late, remedy=remedy)
        if stretched:
            text, remedy = FINDINGS["steps, long"].filled(count=stretched, most=MOST_SUBSTEPS)
            yield Finding("steps", "note", text, "dt_max", float(stretched), remedy=remedy)


def step_findings(counts: Mapping[str, int]) -> Iterator[Finding]:
    """Yield a finding for each kind of failed step, from the number of samples by status."""
    samples = sum(counts.values())
    for code in FAILURES:
        count = counts.get(code, 0)
        if not count:
            continue
        text, _ = FINDINGS[code].filled(count=count, samples=samples)
        share, departed = count / samples, code == "departed"
        # With a right model, one in a million cases departs: any departure is significant.
        severity: Severity = "caution" if departed or share > CAUTION_SHARE else "note"
        if share > (CAUTION_SHARE if departed else SERIOUS_SHARE):
            severity = "do not trust"
        yield Finding("steps", severity, text, code, float(count), remedy=Status(code).remedy)
