"""Kalman filters of the augmented state: DAPPER's ensemble filter, filterpy's unscented filter."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.peers.augmented import Augmented, best
from benchmarks.problems import Data
from benchmarks.scoring import Known, Score, measured

INFLATIONS = (1.0, 1.02)  # factors on the ensemble after each update
NUGGETS = (1e-6, 1e-4)  # process noise of the state in the unscented filter, relative to the data
ALPHAS = (0.1, 1.0)  # spread of its sigma points
LARGEST = 100  # largest dimension of the augmented state for the unscented filter


def ensemble(members: int, data: Data) -> Score:
    """Run DAPPER's square-root filter on the augmented state."""
    return best(data, {f"inflation {x:g}": partial(_ensemble_run, members, x) for x in INFLATIONS})


def _ensemble_run(members: int, inflation: float, data: Data) -> Score:
    from dapper.da_methods.ensemble import EnKF_analysis, post_process
    from dapper.tools.randvars import GaussRV

    augmented = Augmented(data)
    n, k = augmented.n, augmented.k
    rng = np.random.default_rng(members)
    drawn = rng.standard_normal((members, k))
    E = np.hstack([np.tile(augmented.start, (members, 1)), drawn - drawn.mean(axis=0)])
    noise = GaussRV(mu=np.zeros(len(data.noise)), C=data.noise**2)

    def step(at: int) -> None:
        nonlocal E
        E = np.array([augmented.forecast(x, at) for x in E])
        E[:, n:] += augmented.growth(at) * rng.standard_normal((members, k))
        seen = np.array([augmented.output(x, at) for x in E])
        E = post_process(EnKF_analysis(E, seen, noise, data.z[at], "Sqrt"), inflation, False)

    def known() -> Known:
        a = E[:, n:]
        mean = a.mean(axis=0)
        return augmented.known(mean, (a - mean).T / np.sqrt(members - 1))

    return measured(data, step, known)


def unscented(data: Data) -> Score:
    """Run filterpy's unscented filter on the augmented state."""
    augmented = Augmented(data)
    size = augmented.n + augmented.k
    if size > LARGEST:
        return Score(note=f"not run: requires {2 * size + 1} forward steps for each sample")
    return best(
        data,
        {
            f"alpha {alpha:g}, process noise {nugget:g}": partial(_unscented_run, alpha, nugget)
            for alpha in ALPHAS
            for nugget in NUGGETS
        },
    )


def _unscented_run(alpha: float, nugget: float, data: Data) -> Score:
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    augmented = Augmented(data)
    n, k = augmented.n, augmented.k
    points = MerweScaledSigmaPoints(n + k, alpha=alpha, beta=2.0, kappa=0.0)
    kalman = UnscentedKalmanFilter(
        n + k,
        data.z.shape[1],
        dt=1.0,
        hx=lambda x, at: augmented.output(x, at),
        fx=lambda x, dt, at: augmented.forecast(x, at),
        points=points,
    )
    small = (nugget * np.sqrt(np.mean(data.z**2))) ** 2
    kalman.x = np.concatenate([augmented.start, np.zeros(k)])
    kalman.P = np.diag(np.concatenate([np.full(n, small), np.ones(k)]))
    kalman.R = np.diag(data.noise**2)

    def step(at: int) -> None:
        kalman.Q = np.diag(np.concatenate([np.full(n, small), augmented.growth(at) ** 2]))
        kalman.predict(at=at)
        kalman.update(data.z[at], at=at)

    def known() -> Known:
        return augmented.known(kalman.x[n:], np.linalg.cholesky(kalman.P[n:, n:]))

    return measured(data, step, known)
