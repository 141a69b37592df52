"""Runs of the census, and their scores."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

import livepde as lp
from benchmarks.census.faults import FAULTS, HALF, Scene, shortened
from benchmarks.census.report import outcome
from benchmarks.census.trace import trace
from benchmarks.honest.problem import Problem
from benchmarks.honest.problems import PROBLEMS as TRUTHS
from benchmarks.jobs import each
from livepde.runs import Outcome
from livepde.verdict import Finding, Verdict

PROBLEMS = ("rod", "column", "wall", "profile", "plate", "flux", "warm-rod", "borehole")
QUICK = ("rod", "column", "profile", "plate", "warm-rod")
STATED = (1.0, 3.0, 1.0 / 3.0)
"""Ratios of configured to true noise."""
LEVELS = (0.25, 1.0, 4.0)
"""Ratios of the true noise to the problem's noise, which is about 2 % of the signal."""
WEAK = 90, 2, 1.5
"""Intervals, sensors and noise level of every fourth run, which has few data."""
LOOKED = 10  # samples between two evaluations of the verdict after a fault
NAMED = 2  # number of first causes that must include the right one


@dataclass(frozen=True)
class Score:
    """Verdict and errors of one run.

    Attributes
    ----------
    problem, fault, stated, level, seed
        Identification of the run; an empty fault means no fault.
    weak
        Whether the run has few data.
    verdict
        Level of the verdict at the end.
    off
        Largest error of an unknown, in reported standard deviations.
    named
        Whether the right cause is among the first two; None if no cause is expected.
    delay
        Samples from a late fault to the first verdict other than "trusted"; -1 if there is none,
        None if the fault is not late.
    early
        Whether a run with a late fault was doubted before the fault began.
    sentence
        First sentence of the verdict.
    trace
        Norm of the residuals that no unknowns explain, over the noise; NaN for faults of noise,
        initial state and settings.
    failure
        Error that ended the run; empty without one.
    allowed
        A row for each unknown constant: whether its intervals without and with model errors contain
        the truth; ratio of their widths; its effect; and the actual error relative to the value.
    """

    problem: str
    fault: str
    stated: float
    level: float
    seed: int
    verdict: str
    off: float
    named: bool | None = None
    delay: int | None = None
    early: bool = False
    sentence: str = ""
    trace: float = np.nan
    failure: str = ""
    weak: bool = False
    allowed: tuple[tuple[bool, bool, float, float, float], ...] = ()

    @property
    def error(self) -> float:
        """Largest relative error of a constant; NaN without constants."""
        return max((row[4] for row in self.allowed), default=np.nan)


def census(
    only: Sequence[str] = (),
    faults: Sequence[str] = (),
    seeds: int = 4,
    sound: int = 40,
    *,
    workers: int | None = None,
    progress: bool = False,
) -> Outcome:
    """Run problems with all faults, and without faults.

    Parameters
    ----------
    faults
        Names in `FAULTS`; default all.
    seeds
        Runs of each fault and problem. Configured noise and noise level alternate, and every fourth
        run has few data.
    sound
        Runs of each problem without a fault.
    """
    todo = [
        (name, fault, seed)
        for name in only or PROBLEMS
        for fault in ["", *(faults or FAULTS)]
        if not fault or _fits(name, fault)
        for seed in range(seeds if fault else sound)
    ]
    done = each(scored, todo, "runs", workers=workers or os.cpu_count() or 1, progress=progress)
    scores = [score for _, score in done]
    return outcome(sorted(scores, key=lambda s: (s.fault, s.problem, s.seed)))


def _fits(name: str, fault: str) -> bool:
    about, problem = FAULTS[fault], TRUTHS[name]
    if about.only:
        return name in about.only
    single = len(problem.points) == 1
    moved = about.text.startswith("two sensors") and single
    own = about.own_state and problem.model().form_initial is not None
    return not (about.channels and not problem.channels) and not moved and not own


def scored(name: str, fault: str, seed: int) -> Score:
    """Return the score of one run; the arguments determine all numbers."""
    problem = TRUTHS[name]
    rng = np.random.default_rng([zlib.crc32(f"{name} {fault}".encode()), seed])
    stated, level, weak = STATED[seed % 3], LEVELS[(seed // 3 + 1) % 3], seed % 4 == 3
    if weak:
        intervals, sensors, level = WEAK
        problem = shortened(problem, min(problem.intervals, intervals), sensors)
    with threadpool_limits(1):
        theta, shown = problem.draw(rng)
        scene = scene_of(problem, theta, shown, problem.noise * level, rng)
        if fault:
            scene = FAULTS[fault].change(scene)
        score = Score(name, fault, stated, level, seed, "", np.nan, weak=weak)
        try:
            return _judged(scene, score)
        except (lp.errors.LivepdeError, ArithmeticError, np.linalg.LinAlgError) as error:
            return replace(score, failure=repr(error))


def scene_of(
    problem: Problem, theta: np.ndarray, shown: np.ndarray, noise: float, rng: np.random.Generator
) -> Scene:
    """Return the scene of a run without a fault."""
    return Scene(
        problem=problem,
        theta=theta,
        z=shown,
        errors=rng.standard_normal(shown.shape),
        inputs=problem.inputs(problem.times),
        noise=noise,
        sensor=int(rng.integers(shown.shape[1])),
        rng=rng,
        points=dict(problem.points),
        model=problem.model,
        u0=problem.u0,
    )


def _judged(scene: Scene, score: Score) -> Score:
    problem = scene.problem
    model = scene.model()
    direct = {k: v for k, v in problem.direct.items() if k in scene.points}
    sensors = lp.Points(scene.points, noise=scene.noise * score.stated, direct=direct)
    u0 = None if model.form_initial is not None else scene.u0
    law = lp.SensitivityLaw()
    held: dict[str, lp.stepping.Between] = dict.fromkeys(problem.channels, "next")
    between = held if scene.held else None
    identifier = lp.Identifier(model, sensors, law, scheme=scene.scheme, between=between, u0=u0)
    z = scene.z + scene.noise * scene.errors
    names, half = tuple(problem.channels), int(HALF * scene.length)
    about = FAULTS.get(score.fault)
    late, delay, early = about is not None and about.late, -1, False
    estimate: lp.Estimate | None = None
    for k, t in enumerate(problem.times.tolist()):
        inputs = dict(zip(names, scene.inputs[k].tolist(), strict=True))
        estimate = identifier.step(t, z[k], inputs)
        if late and k == half - 1:
            early = estimate.verdict.level != "trusted"
        if late and k > half and (k - half) % LOOKED == 0 and delay < 0:
            delay = k - half if estimate.verdict.level != "trusted" else -1
    if estimate is None:
        raise ValueError("a run of the census has no samples.")
    estimate = identifier._settled(estimate)  # final refit, as in `Identifier.run`
    verdict = estimate.verdict
    kinds = about.kinds if about else ()
    return replace(
        score,
        verdict=verdict.level,
        off=_off(problem, scene, estimate),
        named=_names(verdict, kinds, scene.subject) if kinds else None,
        delay=delay if late else None,
        early=early,
        sentence=verdict.sentences[0] if verdict.sentences else "",
        trace=trace(scene) if about and about.traced else np.nan,
        allowed=tuple(_allowed(problem, scene, estimate)),
    )


def _allowed(
    problem: Problem, scene: Scene, estimate: lp.Estimate
) -> Iterator[tuple[bool, bool, float, float, float]]:
    """Yield the row of `Score.allowed` for each unknown constant."""
    errors = estimate.verdict.errors
    if errors is None:
        return
    for label, latent in problem.latents.items():
        if label not in estimate.space.labels:
            continue
        one = errors[label]
        truth = float(np.ravel(latent.value(scene.theta, scene.length - 1))[0])
        value, *ends = (
            float(np.ravel(latent.inverse(np.array([end])))[0])
            for end in (one.value, one.plain_low, one.plain_high, one.low, one.high)
        )
        plain, wide = ends[0] <= truth <= ends[1], ends[2] <= truth <= ends[3]
        yield plain, wide, one.wider, one.effect, abs(truth - value)


def _off(problem: Problem, scene: Scene, estimate: lp.Estimate) -> float:
    """Return the largest error of an unknown, in standard deviations; RMS over a field."""
    last, errors = scene.length - 1, [0.0]
    for label, latent in problem.latents.items():
        space = estimate.space
        if label not in space.labels and label not in space.fields:
            continue
        part = space.labels[label] if label in space.labels else space.part(label)
        centre, low, high = (
            latent.inverse(item) for item in (estimate.q[part], *estimate[label].interval())
        )
        half = 0.5 * (high - low) / 1.96
        with np.errstate(invalid="ignore", divide="ignore"):
            score = (centre - latent.value(scene.theta, last)) / half
        errors.append(float(np.sqrt(np.mean(score**2))))
    return max(np.inf if np.isnan(error) else error for error in errors)


def _names(verdict: Verdict, kinds: Sequence[str], subject: str) -> bool:
    """Return whether the right cause is among the first `NAMED` causes of a finding."""

    def right(finding: Finding) -> bool:
        return any(
            cause.kind in kinds and (cause.kind == "exchange" or _same(cause.subject, subject))
            for cause in finding.causes[:NAMED]
        )

    return any(right(finding) for finding in verdict.findings)


def _same(named: str, subject: str) -> bool:
    """Return whether a cause names the subject; an empty name or subject is the process."""
    return not subject or not named or named.split(",")[0].split("[")[0] == subject.split("[")[0]
