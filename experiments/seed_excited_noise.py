"""The excited twin with noise: effect of smoothing (sections 3.2 and 3.3).

Data as in `seed-excited`, fully observed, with Gaussian noise that is white in Z = L2(omega). The
noise n of a sample is the L2 projection of white noise onto the state space, independent between
samples, with E ||n||_Z^2 = level^2 ||z||_Z^2. So values and slopes of the Hermite elements have the
size of the values and slopes of a noisy *function*. (The table also has `RelativeNoise`, which
draws each coefficient independently.)

Smoothing uses a local polynomial in time and Tikhonov regularisation in the V~ norm in space, with
alpha from the discrepancy principle. Gains, window and tau are fixed for all levels and seeds: law
and smoother know only the level, neither q*, u* nor the seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal, TypeAlias

import numpy as np

from livepde import paper, plots
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import ConfigurationError
from livepde.laws import ResidualDamping
from livepde.linalg import Array
from livepde.observation import Discrepancy, Full, Pseudoinverse, Tikhonov
from livepde.progress import watched
from livepde.reproduce import seed_excited
from livepde.reproduce.experiment import failures
from livepde.runs import Outcome
from livepde.samples import Sample
from livepde.streams import LocalPolynomial, RelativeNoise, Twin

Kind = Literal["white", "nodal"]


@dataclass(frozen=True, eq=False)
class WhiteNoise:
    """Samples of a twin with additive noise that is white in Z.

    z^delta = z + level ||z||_Z S^{-1/2} xi / sqrt(channels), where S is the Gram matrix of Z and xi
    is standard normal: E ||z^delta - z||_Z^2 = level^2 ||z||_Z^2.
    """

    twin: Twin
    level: float
    seed: int

    def __len__(self) -> int:
        return len(self.twin)

    def __iter__(self) -> Iterator[Sample]:
        rng = np.random.default_rng(self.seed)
        gram = self.twin.weights
        # E (S^{-1/2} xi)^T S (S^{-1/2} xi) = channels, hence the division by its root.
        root = np.linalg.inv(np.linalg.cholesky(gram)).T / np.sqrt(len(gram))
        for t, z in zip(self.twin.times, self.twin.exact_data, strict=True):
            size = np.sqrt(z @ gram @ z)
            noise = self.level * size * (root @ rng.standard_normal(len(z)))
            yield Sample(t=float(t), z=z + noise)


@dataclass(frozen=True, eq=False)
class NoisyRun:
    """Result of one run with noise.

    Attributes
    ----------
    times, errors
        Sample times, and relative L2 errors of q after each sample, both of shape (samples,).
    d_rate
        Largest root mean square over time of the noise part of ||d~||_Z, from the smoother's
        estimate of the noise; NaN without smoothing.
    """

    times: Array
    errors: Array
    d_rate: float

    @property
    def failed(self) -> int:
        """Number of samples with a failed step."""
        return int(np.isnan(self.errors).sum())

    @property
    def error(self) -> float:
        """Relative L2 error of q at the end."""
        return float(self.errors[-1])


Runs: TypeAlias = dict[tuple[float, Kind, bool], list[NoisyRun]]
"""(level, kind, with smoothing) -> runs of all seeds."""


@cache
def _twin() -> Twin:
    return seed_excited.twin_of()


def noisy_run(
    level: float,
    seed: int = 0,
    smoothing: bool = True,
    *,
    gain: float | None = None,
    c1: float | None = None,
    kind: Kind = "white",
    progress: bool = False,
) -> NoisyRun:
    """Run the gradient law on noisy data of the excited twin.

    Parameters
    ----------
    level
        Noise level relative to each sample in L2, 0.01 for 1 %.
    seed
        Seed of the noise.
    smoothing
        True: local polynomial in time and Tikhonov in V~; False: raw data and G^+.
    gain, c1
        Gain and c_1 of the law; default `GAIN` and `C1`.
    kind
        "white": noise white in L2; "nodal": `RelativeNoise`.
    progress
        Show a progress bar.
    """
    twin = _twin()
    stream = _stream(twin, level, seed, kind)
    full, smoothed = Full(reconstruction=Pseudoinverse()), None
    if smoothing:
        smoother = LocalPolynomial(WINDOW, DEGREE)
        # The discrepancy principle in space needs the noise level after smoothing in time.
        left = level * smoother.noise_factor(float(twin.times[1] - twin.times[0]))
        full = Full(reconstruction=Tikhonov("V", Discrepancy(TAU, level=left)))
        stream = smoothed = smoother(stream)
    identifier = paper.identifier(
        twin.model,
        full,
        gain=GAIN if gain is None else gain,
        damping=ResidualDamping(C1 if c1 is None else c1),
        D=seed_excited.D,
        u0=seed_excited.start,
    )
    label = f"{level:.0%}, seed {seed}, {'smoothed' if smoothing else 'raw'}"
    errors, rates = [], []
    for sample in watched(stream, len(twin), label) if progress else stream:
        estimate = identifier.step(sample.t, sample.z)
        errors.append(twin.error(estimate.q) if estimate.status.ok else np.nan)
        # In the first window the polynomial has fewer samples, so that its slope is noisier.
        if smoothed is not None and sample.t > WINDOW:
            rates.append(smoothed.norm_d_rate(twin.weights))
    return NoisyRun(np.asarray(twin.times), np.array(errors), max(rates, default=float("nan")))


def _stream(twin: Twin, level: float, seed: int, kind: Kind) -> Any:
    if not level > 0:
        raise ConfigurationError(f"level must be a positive number, 0.01 for 1 %; got {level}.")
    if kind == "nodal":
        return _Noisy(twin, RelativeNoise(level), seed)
    return WhiteNoise(twin, level, seed)


@dataclass(frozen=True, eq=False)
class _Noisy:
    """Samples of a twin with noise that is independent for each channel."""

    twin: Twin
    noise: RelativeNoise
    seed: int

    def __iter__(self) -> Iterator[Sample]:
        rng = np.random.default_rng(self.seed)
        for t, z in zip(self.twin.times, self.twin.exact_data, strict=True):
            std = self.noise.std(z, self.twin.weights)
            yield Sample(t=float(t), z=z + std * rng.standard_normal(len(z)))


def seed_excited_noise(*, quick: bool = False, progress: bool = False) -> Outcome:
    """Run all levels and seeds, with and without smoothing.

    Parameters
    ----------
    quick
        Run one seed of 1 % white noise, without the search for the best c1.
    progress
        Show a progress bar for every run.
    """
    cases, seeds = (WHITE[:1], SEEDS[:1]) if quick else (CASES, SEEDS)
    runs = {
        (level, kind, smoothing): [
            noisy_run(level, seed, smoothing, kind=kind, progress=progress) for seed in seeds
        ]
        for level, kind in cases
        for smoothing in (True, False)
    }
    tables = [_table(runs, len(seeds), _twin().baseline(0.0))]
    mean = {key: float(np.mean([run.error for run in seeded])) for key, seeded in runs.items()}
    worse = {
        level: mean[level, kind, False] / mean[level, kind, True]
        for level, kind in WHITE
        if (level, kind) in cases
    }
    checks = [
        Check("error of q at t = 60, 1 %, smoothing on", mean[0.01, "white", True], REACHED, "<="),
        *(
            Check(f"smoothing off over on, {level:.0%}, c1 = {C1:g} for both", factor, WORSE, ">=")
            for level, factor in worse.items()
        ),
    ]
    checks.append(failures(run for seeded in runs.values() for run in seeded))
    notes = list(NOTES)
    if not quick:
        tuned = _hindsight(progress)
        tables.append(tuned)
        name = "best c1 in hindsight, 10 %: smoothing off over on"
        checks.append(Check(name, tuned.rows[-1][-1] / tuned.rows[-2][-1], WORSE, ">="))
        notes.append(_words(tuned))
    return Outcome(
        tables=tables, checks=checks, notes=notes, figures={"error": partial(_figure, runs)}
    )


def _table(runs: Runs, seeds: int, baseline: float) -> Table:
    rows: list[list[Any]] = []
    for (level, kind, smoothing), seeded in runs.items():
        errors = np.array([run.error for run in seeded])
        rates = [run.d_rate for run in seeded]
        rows.append(
            [
                f"{level:.0%}",
                kind,
                "on" if smoothing else "off",
                baseline,
                float(errors.mean()),
                float(errors.std(ddof=1)) if seeds > 1 else None,
                float(errors.max()),
                float(np.mean(rates)) if smoothing else None,
                sum(run.failed for run in seeded),
            ]
        )
    return Table(
        f"relative L2 error of q at t = 60, {seeds} seeds, gain {GAIN:g}, c1 = {C1:g}",
        ["noise", "model", "smoothing", "q = 0", "mean", "spread", "largest", "sup |d~|", "failed"],
        rows,
    )


def _hindsight(progress: bool) -> Table:
    """Return a table of errors for each c1 of a decimal grid and one seed, with the smallest."""
    rows: list[list[Any]] = []
    for level, kind in WHITE:
        for smoothing in (True, False):
            errors = [
                noisy_run(level, SEEDS[0], smoothing, c1=c1, kind=kind, progress=progress).error
                for c1 in GRID
            ]
            rows.append([f"{level:.0%}", "on" if smoothing else "off", *errors, min(errors)])
    return Table(
        f"the same for other c1, seed {SEEDS[0]}: the last column knows the truth",
        ["noise", "smoothing", *(f"c1 = {c1:g}" for c1 in GRID), "best in hindsight"],
        rows,
    )


def _words(tuned: Table) -> str:
    best = [float(row[-1]) for row in tuned.rows]
    pairs = ", ".join(
        f"{tuned.rows[k][0]} noise: {best[k]:.2f} with, {best[k + 1]:.2f} without"
        for k in range(0, len(best), 2)
    )
    return (
        f"Error of one seed with the best c1 of the grid, chosen by the truth ({pairs}). Little "
        "noise averages out by itself where the law learns slowly, without the bias of G_alpha; "
        "more of it does not. So at 1 % smoothing is no better than a well chosen c1: "
        "what it gives is one c1 that does for all levels."
    )


def _figure(runs: Runs) -> Any:
    """Plot the mean error over time for all levels, with and without smoothing."""
    series = {
        f"{level:.0%}, {'smoothed' if smoothing else 'raw'}": (
            seeded[0].times,
            np.mean([run.errors for run in seeded], axis=0),
        )
        for (level, kind, smoothing), seeded in runs.items()
        if kind == "white"
    }
    drawn, axes = plots.figure()
    plots.history(series, ylabel="relative L2 error of q", levels={"q = 0": 1.0}, ax=axes[0])
    return drawn


# Fixed for every level and seed. No run knows the truth, but the settings were not chosen blindly.
# Gain and c1 are from the design (fact 4), measured on this twin. Window, degree and tau were
# chosen by the errors of over 200 runs on this twin with seeds 0 and 1: about ten combinations
# (windows of 0.5 to 2, degrees 1 to 3, tau 0.9 to 1.1), each over a grid of gain and c1. `SEEDS`
# were not used for that choice. For `SEEDS` at 1 %, tau = 1.1 gives 0.077 instead of 0.054, and the
# settings give 0.050 (raw 0.173) for q* = 5 - 3x and 0.143 (raw 0.154) for
# q* = 3 + 2 sin(3 pi x). So they do not suit every q*.
GAIN = 1000.0  # as with exact data
C1 = 100.0
WINDOW = 1.0  # a sixth of the shortest period of the known source f
DEGREE = 2
TAU = 1.0  # delta is a root mean square, not an upper bound
SEEDS = (100, 101, 102, 103, 104)
WHITE: tuple[tuple[float, Kind], ...] = ((0.01, "white"), (0.05, "white"), (0.10, "white"))
CASES: tuple[tuple[float, Kind], ...] = (*WHITE, (0.01, "nodal"))
GRID = (1.0, 10.0, 100.0, 1e3, 1e4)

# Bounds of the checks.
# Largest error of q. The information limit without a prior is about 0.09 (fact 5 of the design).
REACHED = 0.10
WORSE = 2.0
NOTES = [
    "Noise: Gaussian and white in L2, independent from sample to sample, of a size relative to the "
    "L2 norm of each sample. nodal: every coefficient by itself, slopes with 1/h of the standard "
    "deviation.",
    "Gain, c1, window and tau were fixed before these seeds were drawn, but found on this twin "
    "with other seeds: not tuned to this noise, yet not blind to the truth.",
    "sup |d~| is the noise part of the rate of the smoothed data's error in L2: times "
    "2 gamma_0/epsilon_0 it would bound the limit superior of ||q^ - q*||_Q "
    "(th:parameter_noisesmooth) under the link conditions (cond:link), which no data error meets "
    "that does not vanish.",
]
