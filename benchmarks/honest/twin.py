"""Twin experiment: a truth from the prior, data with several kinds of noise, and their scores."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import livepde as lp
from benchmarks.honest.batch import Batch
from benchmarks.honest.noise import KINDS, Data, disturbed
from benchmarks.honest.problem import Latent, Problem
from benchmarks.honest.problems import PROBLEMS
from livepde.plots import NORMAL_95, interval_95
from livepde.stepping import StepFailed
from livepde.streams import FillGaps

Array = NDArray[Any]
SHARES = (0.10, 0.25, 0.50, 0.75, 1.00)
"""Shares of the run after which intervals are scored."""


@dataclass(eq=False)
class Smoothed:
    """Scores of the smoother over all samples; arrays have the shape (unknowns,).

    Attributes
    ----------
    covered
        Share of the samples at which the 95 % interval contains the truth.
    error, fit
        Root mean square of the errors of the smoother and of the batch fit, in standard deviations
        of the prior.
    """

    covered: Array
    error: Array
    fit: Array


@dataclass(eq=False)
class Run:
    """Scores of one run; arrays have the shape (shares, unknowns).

    All scores except `covered` are in the Gaussian coordinates of the prior. A field has a value at
    each vertex of livepde's mesh.

    Attributes
    ----------
    covered
        Share of the values whose 95 % interval contains the truth.
    width
        Median width over the width of the batch posterior from the same samples.
    widest
        Largest width over the width of the prior.
    error, fit
        Root mean square errors of the estimate, and of the batch fit of all data with shape
        (unknowns,), in standard deviations of the batch posterior.
    z
        Error in standard deviations of the estimate: signed for a constant, root mean square for a
        field.
    shift
        Root mean square distance between the runs with and without the spike, in standard
        deviations of the latter; NaN before the spike and for other kinds.
    missed
        Number of samples that were not taken.
    failure
        Error that ended the run; empty without one.
    smoothed
        Scores of the smoother, for a moving unknown and undisturbed data; otherwise None.
    """

    problem: str
    kind: str
    seed: int
    covered: Array
    width: Array
    widest: Array
    error: Array
    z: Array
    fit: Array
    shift: Array
    missed: int = 0
    failure: str = ""
    smoothed: Smoothed | None = None


@dataclass(eq=False)
class _Seen:
    """Latent estimates and intervals: `values` maps (share, label) to centre, low and high.

    `smoothed` maps the label of a constant to centre, low and high at all samples.
    """

    smoothed: dict[str, tuple[Array, Array, Array]] = field(default_factory=dict)
    values: dict[tuple[int, str], tuple[Array, Array, Array]] = field(default_factory=dict)
    missed: int = 0
    failure: str = ""


def twins(name: str, seed: int, kinds: Sequence[str]) -> list[Run]:
    """Return the scores of one truth for several kinds; a seed determines all numbers."""
    problem = PROBLEMS[name]
    with threadpool_limits(1):
        rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
        theta, shown = problem.draw(rng)
        state = rng.bit_generator.state
        batch = Batch.of(problem, theta)
        runs, white = [], None
        for kind in kinds:
            if KINDS[kind].channels and not problem.channels:
                continue
            rng.bit_generator.state = state
            data = disturbed(kind, problem, shown, rng)
            smooths = bool(problem.moving) and KINDS[kind].right
            seen = _identified(problem, data, KINDS[kind].freed, smooths)
            if kind == "spike" and white is None:
                rng.bit_generator.state = state
                without = disturbed("white", problem, shown, rng)
                white = _identified(problem, without, freed=False)
            if kind == "white":
                white = seen
            fit = batch.fit(data.z) if KINDS[kind].right else batch.linear(data.right)
            run = _scored(problem, theta, batch, seen, fit)
            run.problem, run.kind, run.seed = name, kind, seed
            if seen.smoothed:
                run.smoothed = _smoothed(problem, theta, fit, seen)
            if data.spike is not None and white is not None:
                run.shift = _shift(problem, seen, white, data.spike)
            runs.append(run)
    return runs


def _identified(problem: Problem, data: Data, freed: bool, smooths: bool = False) -> _Seen:
    """Run the identifier with default options, and return its intervals after each share.

    With `smooths`, the intervals of the smoother at all samples are included.
    """
    times, seen = problem.times, _Seen()
    at = {round(share * problem.intervals): k for k, share in enumerate(SHARES)}
    moments = {float(times[n]): k for n, k in at.items()}

    def look(estimate: lp.Estimate) -> None:
        seen.missed += not estimate.status.taken
        k = moments.get(estimate.t)
        if k is None:
            return
        space = estimate.space
        for label, latent in problem.latents.items():
            part = space.labels[label] if label in space.labels else space.part(label)
            ends = (estimate.q[part], *estimate[label].interval())
            seen.values[k, label] = tuple(latent.inverse(item) for item in ends)  # type: ignore[assignment]

    names = tuple(problem.channels)
    rows = zip(times.tolist(), data.z, data.inputs.tolist(), strict=True)
    stream = ((t, z, dict(zip(names, values, strict=True))) for t, z, values in rows)
    filled = FillGaps(names)(stream) if names else stream
    identifier = problem.identifier(data.biased if freed else None)
    try:
        result = identifier.run(filled, on_estimate=look, fields_every=problem.intervals)
        if smooths:
            hindsight = result.smoothed()
            for label, latent in problem.latents.items():
                seen.smoothed[label] = _intervals(hindsight, label, latent)
    except (lp.errors.LivepdeError, StepFailed, ArithmeticError, np.linalg.LinAlgError) as error:
        seen.failure = f"{type(error).__name__}: {error}"
    return seen


def _intervals(data: Any, label: str, latent: Latent) -> tuple[Array, Array, Array]:
    """Return latent centres and intervals of a constant at all samples of a dataset."""
    low, high = interval_95(data, label)
    centre, low, high = (latent.inverse(item) for item in (data[label].values, low, high))
    return centre, low, high


def _smoothed(problem: Problem, theta: Array, fit: Array, seen: _Seen) -> Smoothed:
    covered, error, fitted = [], [], []
    for label, latent in problem.latents.items():
        samples = range(len(problem.times))
        truth, best = (np.array([latent.value(x, n)[0] for n in samples]) for x in (theta, fit))
        prior = np.array([_prior(latent, n)[0] for n in samples])
        centre, low, high = seen.smoothed[label]
        covered.append(np.mean((low <= truth) & (truth <= high)))
        error.append(_rms((centre - truth) / prior))
        fitted.append(_rms((best - truth) / prior))
    return Smoothed(np.array(covered), np.array(error), np.array(fitted))


def _scored(problem: Problem, theta: Array, batch: Batch, seen: _Seen, fit: Array) -> Run:
    shape = (len(SHARES), len(problem.latents))
    covered, width, widest = np.zeros(shape), np.full(shape, np.nan), np.full(shape, np.nan)
    error, z = np.full(shape, np.nan), np.full(shape, np.nan)
    fitted = np.zeros(shape[1])
    for j, (label, latent) in enumerate(problem.latents.items()):
        for k, share in enumerate(SHARES):
            at = round(share * problem.intervals)
            truth, std = latent.value(theta, at), batch.std(latent, at)
            if k == len(SHARES) - 1:
                fitted[j] = _rms((latent.value(fit, at) - truth) / std)
            if (k, label) not in seen.values:
                continue
            centre, low, high = seen.values[k, label]
            covered[k, j] = np.mean((low <= truth) & (truth <= high))
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                half = 0.5 * (high - low) / NORMAL_95
                width[k, j] = np.median(half / std)
                widest[k, j] = np.max(half / _prior(latent, at))
                error[k, j] = _rms((centre - truth) / std)
                score = (centre - truth) / half
                z[k, j] = score.item() if len(score) == 1 else _rms(score)
    shift = np.full(shape, np.nan)
    run = Run("", "", 0, covered, width, widest, error, z, fitted, shift)
    run.missed, run.failure = seen.missed, seen.failure
    return run


def _prior(latent: Latent, at: int) -> Array:
    std: Array = np.linalg.norm(latent.directions(at), axis=1)
    return std


def _shift(problem: Problem, seen: _Seen, white: _Seen, spike: int) -> Array:
    shift = np.full((len(SHARES), len(problem.latents)), np.nan)
    for k, share in enumerate(SHARES):
        if round(share * problem.intervals) < spike:
            continue
        for j, label in enumerate(problem.latents):
            if (k, label) not in white.values:
                continue
            centre, low, high = white.values[k, label]
            half = 0.5 * (high - low) / NORMAL_95
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                reached = seen.values[k, label][0] if (k, label) in seen.values else np.inf
                shift[k, j] = _rms((reached - centre) / half)
    return shift


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
