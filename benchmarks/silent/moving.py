"""Time-varying unknowns between sparse samples: standard deviations, coverage and empty rows.

A spatially constant state, u' = s - decay u, is measured with noise at equidistant samples; s is a
random walk or mean-reverting. The correct estimates are those of a Kalman filter of (u, s) with
exact transition and process noise between samples (`exact_walk`); the correct coverage is 0.95.

The time scale of s is its relaxation time, or the time in which the walk gains its prior variance.
Each member has its own path, readings and initial value drawn from the prior. Samples of one member
are correlated, but members are independent. So the standard error of a coverage is computed from
the mean over members, and checked separately.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

import livepde as lp
from benchmarks.silent.exact_walk import Exact
from livepde.diagnostics.check_report import Check
from livepde.linalg import Array

SCALE, STD = 3.0, 1.0  # time scale and prior standard deviation of s
SPACINGS = (0.05, 0.3, 1.0, 2.0)  # of samples, in time scales
KINDS = {
    "walk": Exact(decay=0.0, std=STD, noise=0.1, rate=STD / SCALE**0.5),
    "walk, fast state": Exact(decay=20.0, std=STD, noise=0.0015, rate=STD / SCALE**0.5),
    "mean-reverting": Exact(decay=0.0, std=STD, noise=0.1, time=SCALE),
    "mean-reverting, fast state": Exact(decay=20.0, std=STD, noise=0.0015, time=SCALE),
}
# The first reported case had standard deviations of 0.97, 0.82 and 0.31 times the exact ones.
REPORTED, REPORTED_SPACINGS = Exact(decay=0.0, std=2.0, noise=0.05, rate=0.3), (0.1, 0.5, 2.0)
MEMBERS, SAMPLES = 100, 32
EMPTY, FEW = 11, 10  # empty rows between two samples, and members of these runs
# The filter alone, because safeguards, gate and refits have no effect here and cost time.
LAW = lp.SensitivityLaw(shadows=None, guards=None, gate=np.inf, refit=None, verdict=False)


def checks() -> list[Check]:
    """Return the checks of all processes."""
    found = [check for name, exact in KINDS.items() for check in _sparse(name, exact)]
    runs = [_run(REPORTED, h) for h in REPORTED_SPACINGS]
    found.append(_narrowest("walk of the first report", [run.ratio.min() for run in runs]))
    return [*found, *(check for name, exact in KINDS.items() for check in _empty(name, exact))]


class _Run(NamedTuple):
    """Comparison of a fleet with the exact filter.

    Attributes
    ----------
    ratio
        Smallest standard deviation of s over the members, over the exact one, shape (samples,).
    error
        Largest difference between an estimate and the exact one, in standard deviations.
    covered
        Share of samples of each member whose interval contains the truth, shape (members,).
    """

    ratio: Array
    error: float
    covered: Array


def _fleet(exact: Exact, members: int) -> lp.Fleet:
    moves = lp.RandomWalk(exact.rate) if exact.rate else lp.MeanReverting(exact.time)
    mesh = lp.interval(0.0, 1.0, 1)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh)),
        {"s": lp.Scalar(lp.Normal(0.0, std=exact.std), evolution=moves)},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)) + exact.decay * u * v,
    )
    return lp.Fleet(model, lp.Points({"a": 0.3}, noise=exact.noise), LAW, members, u0=0.0)


def _drawn(exact: Exact, h: float, members: int) -> tuple[Array, Array]:
    """Return s and the readings of all members, shapes (members, samples)."""
    rng = np.random.default_rng(36)
    paths = [exact.drawn(h, SAMPLES, rng) for _ in range(members)]
    return np.array(paths)[..., 1], np.array([exact.read(path, rng) for path in paths])


def _run(exact: Exact, h: float) -> _Run:
    fleet, (truth, z) = _fleet(exact, MEMBERS), _drawn(exact, h, MEMBERS)
    means = np.array([exact.filtered(h, row)[0][:, 1] for row in z])
    std = np.sqrt(exact.filtered(h, z[0])[1][:, 1, 1])
    ratio, error, inside = [], 0.0, []
    for k in range(SAMPLES):
        s, s_std = fleet.step(k * h, z[:, k : k + 1]).parameters["s"]
        # Innovations that are correlated by chance widen the intervals of some members; the
        # narrowest intervals are those of the filter itself.
        ratio.append(float(s_std.min()) / std[k])
        error = max(error, float(np.abs(s - means[:, k]).max()) / std[k])
        inside.append(np.abs(s - truth[:, k]) <= 1.96 * s_std)
    return _Run(ratio=np.array(ratio), error=error, covered=np.mean(inside, axis=0))


def _narrowest(name: str, ratios: list[float]) -> Check:
    return Check(f"{name}: standard deviation over exact, smallest", min(ratios), 0.98, ">=")


def _sparse(name: str, exact: Exact) -> Iterator[Check]:
    """Yield the checks of a process, each for its worst spacing."""
    runs = [_run(exact, share * SCALE) for share in SPACINGS]
    shares = [float(run.covered.mean()) for run in runs]
    errors = [float(run.covered.std(ddof=1)) / MEMBERS**0.5 for run in runs]
    widest = max(float(run.ratio.max()) for run in runs)
    yield _narrowest(name, [float(run.ratio.min()) for run in runs])
    yield Check(f"{name}: standard deviation over exact, largest", widest, 1.02, "<=")
    error = max(run.error for run in runs)
    yield Check(f"{name}: standard deviations off the exact estimate", error, 0.1, "<=")
    yield Check(f"{name}: coverage of 95 % intervals, lowest", min(shares), 0.93, ">=")
    yield Check(f"{name}: coverage of 95 % intervals, highest", max(shares), 0.97, "<=")
    text = f"{name}: three standard errors of a coverage, largest"
    yield Check(text, 3.0 * max(errors), 0.015, "<=")


def _empty(name: str, exact: Exact) -> Iterator[Check]:
    """Yield the checks that rows without a reading change nothing, at the widest spacing."""
    h, nothing = SPACINGS[-1] * SCALE, np.full((FEW, 1), np.nan)
    plain, filled, z = _fleet(exact, FEW), _fleet(exact, FEW), _drawn(exact, h, FEW)[1]
    wider, moved = 0.0, 0.0
    for k in range(SAMPLES // 4):
        for j in range(1, EMPTY + 1) if k else ():
            filled.step((k - 1 + j / (EMPTY + 1)) * h, nothing)
        s, std = plain.step(k * h, z[:, k : k + 1]).parameters["s"]
        s_filled, std_filled = filled.step(k * h, z[:, k : k + 1]).parameters["s"]
        wider = max(wider, abs(float(std_filled.min()) / float(std.min()) - 1.0))
        moved = max(moved, float(np.abs(s - s_filled).max()) / float(std.min()))
    yield Check(f"{name}: share by which empty rows change a deviation", wider, 0.01, "<=")
    yield Check(f"{name}: deviations by which they move an estimate", moved, 0.01, "<=")
