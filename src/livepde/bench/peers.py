"""The same data and the same model in the packages that users take today.

Each peer is given the reduced coordinates, the prior, the noise level and the initial state that
our laws are given, and steps of our forward model. Where it has a knob, the setting that does best
*with the truth* on the very data set is reported, which favours it. A package that is not installed
is a row that says so: `pip install livepde[peers]`.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from livepde.bench import accuracy
from livepde.bench.offline import Trajectory
from livepde.bench.problems import PROBLEMS, Data, Problem
from livepde.bench.scoring import (
    Contender,
    Found,
    Judge,
    Known,
    Score,
    error_ratio,
    measured,
    scored,
    step_ratio,
    table_of,
)
from livepde.errors import LivepdeError
from livepde.fem import Moment
from livepde.linalg import Array
from livepde.progress import watched
from livepde.reproduce import seed_excited
from livepde.runs.outcome import Check, Outcome
from livepde.stepping import ForwardStage, Interval, StepFailed, advance

__all__ = ["PEERS", "Peer", "peers"]

INFLATIONS = (1.0, 1.02)  # of the ensemble, after each update
NUGGETS = (1e-6, 1e-4)  # process noise of the state in the unscented filter, relative to the data
ALPHAS = (0.1, 1.0)  # spread of its sigma points
ARRIVALS = (1.0, 10.0, 100.0)  # weight of the parameters' last estimate in the moving horizon
HORIZON = 10
EPOCHS = 10_000  # of the network; in each, other collocation points and values
COLLOCATION = 500
BATCH = 500
WEIGHTS = (10.0, 100.0)  # of the data, that of the equation being 1
RATE = 3e-3  # of learning; halved three times
WAVES = 16  # sines and cosines of time among its inputs
LAYERS = (32, 32, 32)
LARGEST = 100  # coordinates of state and parameters that the unscented filter is asked to carry


@dataclass(frozen=True)
class Peer:
    """Another package's estimator.

    Attributes
    ----------
    packages
        What has to be installed: names to import.
    run
        Its contender.
    """

    packages: tuple[str, ...]
    run: Contender

    @property
    def missing(self) -> tuple[str, ...]:
        """Packages that are not installed."""
        return tuple(name for name in self.packages if find_spec(name) is None)


class Augmented:
    """Our forward model as peers want it: x = (free coefficients of u, reduced coordinates a)."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.trajectory = Trajectory(data)
        self.model = self.trajectory.model
        self.forward = ForwardStage(self.model)
        self.free = np.flatnonzero(self.model.X.free)
        self.n, self.k = len(self.free), self.trajectory.Phi.shape[1]
        self.times = data.process.times.tolist()

    @cached_property
    def moments(self) -> list[Moment]:
        """Time and inputs of each sample."""
        return [Moment(t, self.trajectory.inputs(k)) for k, t in enumerate(self.times)]

    @cached_property
    def start(self) -> Array:
        """The known initial state, free coefficients."""
        start: Array = self.model.initial(self.data.process.u0, self.moments[0])[self.free]
        return start

    def latent(self, a: Array) -> Array:
        """Return the latent coefficients."""
        q: Array = self.model.latent.prior + self.trajectory.Phi @ a
        return q

    def full(self, x: Array, at: int) -> Array:
        """Return all coefficients of the state at a time."""
        u = np.zeros(self.model.X.dim)
        u[self.free] = x[: self.n]
        return self.model.impose(u, self.moments[at])

    def forecast(self, x: Array, at: int) -> Array:
        """Return x at the sample with this number from that at the one before."""
        q, none = self.latent(x[self.n :]), np.zeros(0)
        before, now = self.moments[at - 1], self.moments[at]
        interval = Interval(before.t, now.t, before.inputs, now.inputs, none, none)

        def stage(c: Array, t: float, h: float) -> Array:
            return self.forward.solve(c, q, h, interval.at(t))

        u, _, failure = advance(self.trajectory.control, stage, self.full(x, at - 1), interval)
        if failure is not None:
            raise failure
        return np.concatenate([u[self.free], x[self.n :]])

    def output(self, x: Array, at: int) -> Array:
        """Return what the sensors show."""
        q = self.model.latent.value(self.latent(x[self.n :]))
        return self.data.observed.predict(self.full(x, at), q, self.moments[at])

    def growth(self, at: int) -> Array:
        """Return the deviation that each reduced coordinate gains up to this sample, (k,)."""
        gained = np.zeros(self.k)
        gained[self.trajectory.moving] = self.trajectory.growth[at - 1]
        return gained

    def known(self, mean: Array, root: Array | None) -> Known:
        """Return latent coefficients and their factor for those of a; raises `StepFailed`."""
        if not np.isfinite(mean).all():
            raise StepFailed("not_finite", "the estimate is not finite")
        return self.latent(mean), None if root is None else self.trajectory.Phi @ root


def _best(data: Data, settings: Mapping[str, Contender]) -> Score:
    """Return the score with the least error, noted with its setting."""
    scores = []
    for setting, contender in settings.items():
        score = scored(contender, data)
        if score is not None:
            scores.append(replace(score, note="; ".join(filter(None, (setting, score.note)))))
    return min(scores, key=lambda score: math.inf if math.isnan(score.error) else score.error)


# --- ensemble Kalman filter ----------------------------------------------------------------------


def _ensemble(members: int, data: Data) -> Score:
    """Run DAPPER's square-root filter on the augmented state."""
    return _best(data, {f"inflation {x:g}": partial(_ensemble_run, members, x) for x in INFLATIONS})


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


# --- unscented filter ----------------------------------------------------------------------------


def _unscented(data: Data) -> Score:
    """Run filterpy's unscented filter on the augmented state."""
    augmented = Augmented(data)
    size = augmented.n + augmented.k
    if size > LARGEST:
        return Score(note=f"not run: {2 * size + 1} forward steps for each sample")
    return _best(
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


# --- moving horizon ------------------------------------------------------------------------------


def _moving_horizon(data: Data) -> Score | None:
    """Run do-mpc's moving-horizon estimator; on the paper's example only."""
    if data.problem.name != "seed":
        return None
    return _best(
        data,
        {
            f"horizon {HORIZON}, arrival weight {weight:g}": partial(_horizon_run, weight)
            for weight in ARRIVALS
        },
    )


def _horizon_run(arrival: float, data: Data) -> Score:
    import casadi
    import do_mpc

    augmented = Augmented(data)
    model, free = augmented.model, augmented.free
    n, k, times = augmented.n, augmented.k, augmented.times
    # Coefficients of unit mass and measurements of unit noise: Ipopt fails on values and slopes as
    # they are.
    scale = 1.0 / np.sqrt(model.mass.diagonal()[free])
    eye = np.eye(model.X.dim)[:, free] * scale
    M = scale[:, None] * model.mass[free][:, free].toarray() * scale
    K = scale[:, None] * np.column_stack([model.B(e) for e in eye.T])[free]
    # A(u) q is bilinear: one sparse matrix for each mode.
    A = np.array([model.A(e).matrix @ augmented.trajectory.Phi for e in eye.T])[:, free]
    A *= scale[:, None]
    H = data.observed.G[:, free].toarray() * scale / data.noise[:, None]
    F = np.array([scale * model.F(moment)[free] for moment in augmented.moments])

    process = do_mpc.model.Model("continuous")
    u = process.set_variable("_x", "u", (n, 1))
    rate = process.set_variable("_z", "rate", (n, 1))
    a = process.set_variable("_p", "a", (k, 1))
    source = process.set_variable("_tvp", "source", (n, 1))
    process.set_meas("z", casadi.DM(H) @ u, meas_noise=True)
    process.set_rhs("u", rate)
    flux = casadi.DM(K) @ u
    for mode in range(k):
        matrix = A[:, :, mode].T
        matrix[np.abs(matrix) < 1e-14 * np.abs(matrix).max()] = 0.0
        flux += a[mode] * (casadi.sparsify(casadi.DM(matrix)) @ u)
    process.set_alg("balance", casadi.sparsify(casadi.DM(M)) @ rate + flux - source)
    process.setup()

    horizon = do_mpc.estimator.MHE(process, ["a"])
    horizon.set_param(
        n_horizon=HORIZON,
        t_step=times[1] - times[0],
        meas_from_data=False,
        store_full_solution=False,
        state_discretization="collocation",
        collocation_type="radau",  # of degree 1: implicit Euler, as the data
        collocation_deg=1,
        collocation_ni=1,
        nlpsol_opts={
            "ipopt.max_iter": 100,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "print_time": 0,
        },
    )
    sources, readings = horizon.get_tvp_template(), horizon.get_y_template()
    now = 0

    def window(template: Any, name: str, rows: Array) -> Any:
        # Measurements and sources at the ends of the intervals, the last of them now.
        for j in range(HORIZON):
            template[name, j] = rows[now - HORIZON + 1 + j]
        return template

    horizon.set_tvp_fun(lambda _: window(sources, "_tvp", F))
    horizon.set_y_fun(lambda _: window(readings, "y_meas", data.z / data.noise))
    horizon.set_default_objective(
        P_x=casadi.DM(np.diag((scale / data.noise.min()) ** 2)),
        P_v=casadi.DM(np.eye(len(data.noise))),
        P_p=casadi.DM(np.eye(k) * arrival),
    )
    p_template = horizon.get_p_template()
    horizon.set_p_fun(lambda now: p_template)
    horizon.setup()
    horizon.x0 = augmented.start / scale
    horizon.p_est0 = np.zeros(k)
    horizon.set_initial_guess()

    def step(at: int) -> None:
        nonlocal now
        now = at
        if at >= HORIZON:  # before, it would take the first sample for older ones
            horizon.make_step((data.z[at] / data.noise).reshape(-1, 1))

    def known() -> Known:
        return augmented.known(np.asarray(horizon.p_est0.cat).ravel(), None)

    return measured(data, step, known)


# --- physics-informed network --------------------------------------------------------------------


def _network(data: Data) -> Score | None:
    """Train DeepXDE's network for u and the reduced coordinates; on `seed-excited` only."""
    if data.problem.name != "seed-excited":
        return None
    return _best(
        data,
        {
            f"{EPOCHS} epochs, {COLLOCATION} collocation points and {BATCH} values each, weight of "
            f"the data {weight:g}": partial(_network_run, weight)
            for weight in WEIGHTS
        },
    )


def _network_run(weight: float, data: Data) -> Score:
    import deepxde
    import torch

    deepxde.config.set_random_seed(0)
    augmented, model, times = Augmented(data), data.process.model, data.process.times
    last = float(times[-1])

    # Of the coefficients it is given the values at the nodes; their slopes are mostly noise.
    nodes = np.linspace(0.0, 1.0, seed_excited.N)[1:-1]
    values = model.state_space.probe(nodes[None]).toarray()
    exact_start = values @ model.initial(data.process.u0, augmented.moments[0])
    seen = data.z[1:] @ data.observed.G.toarray() @ values.T

    grid = np.linspace(0.0, 1.0, 401)
    at_grid = model.parameter_space.probe(grid[None]).toarray()
    table = np.column_stack([at_grid @ model.latent.prior, at_grid @ augmented.trajectory.Phi])
    shapes = torch.as_tensor(table, dtype=torch.float32)
    a = deepxde.Variable([0.0] * augmented.k)

    def q(x: Any) -> Any:
        place = x[:, 0].detach() * (len(grid) - 1)
        left = place.long().clamp(0, len(grid) - 2)
        share = (place - left)[:, None]
        here = (1 - share) * shapes[left] + share * shapes[left + 1]
        return here[:, :1] + here[:, 1:] @ a[:, None]

    def residual(x: Any, u: Any) -> Any:
        rate = deepxde.grad.jacobian(u, x, i=0, j=1)
        curvature = deepxde.grad.hessian(u, x, i=0, j=0)
        place = x.detach().numpy().astype(float)
        source = seed_excited.f(place.T[:1], place[:, 1])
        force = torch.as_tensor(source[:, None], dtype=torch.float32)
        return rate - seed_excited.D * curvature + q(x) * u - force

    t, x = np.meshgrid(times[1:], nodes, indexing="ij")
    conditions = [
        deepxde.icbc.PointSetBC(
            np.column_stack([x.ravel(), t.ravel()]), seen.reshape(-1, 1), batch_size=BATCH
        ),
        deepxde.icbc.PointSetBC(np.column_stack([nodes, 0 * nodes]), exact_start[:, None]),
    ]
    domain = deepxde.geometry.GeometryXTime(
        deepxde.geometry.Interval(0.0, 1.0), deepxde.geometry.TimeDomain(0.0, last)
    )
    task = deepxde.data.TimePDE(domain, residual, conditions, num_domain=COLLOCATION)
    waves = 2 * np.pi / last * torch.arange(1, WAVES + 1)
    net = deepxde.nn.FNN([2 + 2 * WAVES, *LAYERS, 1], "tanh", "Glorot normal")

    def features(x: Any) -> Any:
        t = x[:, 1:]
        return torch.cat([x[:, :1], t / last, torch.sin(waves * t), torch.cos(waves * t)], 1)

    net.apply_feature_transform(features)
    net.apply_output_transform(lambda x, u: 4 * x[:, :1] * (1 - x[:, :1]) * u)
    network = deepxde.Model(task, net)
    network.compile(
        "adam",
        lr=RATE,
        loss_weights=[1.0, weight, weight],
        decay=("step", EPOCHS // 4, 0.5),
        external_trainable_variables=[a],
        verbose=0,
    )
    resampled = deepxde.callbacks.PDEPointResampler(period=1, bc_points=True)
    start = process_time()
    network.train(iterations=EPOCHS, display_every=EPOCHS, callbacks=[resampled], verbose=0)
    seconds = process_time() - start
    judge = Judge(data)
    q_found, _ = augmented.known(a.detach().numpy().astype(float), None)
    error, _ = judge.judged([(len(data) - 1, q_found, None)])
    return Score(error, step=seconds / len(data) / data.forward)


PEERS: dict[str, Peer] = {
    **{
        f"DAPPER: EnKF, {members} members": Peer(("dapper",), partial(_ensemble, members))
        for members in (20, 50, 100)
    },
    "filterpy: unscented filter": Peer(("filterpy",), _unscented),
    "do-mpc: moving horizon": Peer(("do_mpc", "casadi"), _moving_horizon),
    "DeepXDE: network": Peer(("deepxde", "torch"), _network),
}
"""Row -> peer."""

OURS = (
    "prior",
    "sensitivity",
    "sensitivity, replay",
    "sensitivity, auto",
    accuracy.ALL_DATA,
    accuracy.EACH_SAMPLE,
)
LEVEL = 0.01
MINE = "sensitivity"  # the row of which the promises below are checked
LEAST_WORK = {"DAPPER: EnKF, 50 members": 20.0, "do-mpc: moving horizon": 50.0}
"""Peer -> how many times the work of our step it takes."""


# --- the table -----------------------------------------------------------------------------------


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what packages print and warn of at import to themselves."""
    os.environ.setdefault("MPLBACKEND", "agg")
    os.environ.setdefault("DDE_BACKEND", "pytorch")
    nowhere = io.StringIO()
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        warnings.simplefilter("ignore")
        yield


def _peak(reset: bool = False) -> float:
    """Return the largest memory of this process so far in MB, or since a reset; NaN if unknown."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    return next((int(row.split()[1]) / 1024 for row in lines if row.startswith("VmHWM")), math.nan)


def run_row(problem: Problem, level: float | None, seed: int, row: str) -> Score | None:
    """Run one row on one data set, in the process that calls."""
    peer = PEERS.get(row)
    if peer is not None and peer.missing:
        return Score(note=f"not installed: {', '.join(peer.missing)}")
    data = problem.data(level, seed)
    data.forward  # noqa: B018 (what it needs is not the contender's memory)
    with _quiet():
        for package in peer.packages if peer is not None else ():
            __import__(package)
        before = _peak(reset=True)
        score = scored(accuracy.ROWS[row] if peer is None else peer.run, data)
    return None if score is None else replace(score, megabytes=_peak() - before)


def _job(name: str, level: float | None, seed: int, row: str) -> Score | None:
    return run_row(PROBLEMS[name], level, seed, row)


def peers(
    only: Sequence[str] = (),
    seeds: int = 1,
    *,
    levels: Sequence[float] = (LEVEL,),
    rows: Sequence[str] = (*OURS, *PEERS),
    progress: bool = False,
) -> Outcome:
    """Run our sensitivity law and the peers on the same data, each row in a fresh process.

    Parameters
    ----------
    only
        Names of problems; default all that have a known truth.
    seeds
        Data sets for each noise level.
    levels
        Noise levels.
    rows
        Names of `PEERS`, and of rows of `accuracy`.
    progress
        Show a bar on standard error.
    """
    names = list(only) or [name for name, item in PROBLEMS.items() if None not in item.levels]
    jobs = [
        (name, level, seed, row)
        for name in names
        for level in PROBLEMS[name].chosen(levels)
        for seed in range(seeds)
        for row in rows
    ]
    found: Found = {}
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        waiting = [pool.submit(_job, *job) for job in jobs]
        pairs = list(zip(jobs, waiting, strict=True))
        for (name, level, _, row), future in (
            watched(pairs, len(pairs), "runs") if progress else pairs
        ):
            try:
                score = future.result()
            except (LivepdeError, ArithmeticError, RuntimeError, ValueError) as error:
                score = Score(note=f"{type(error).__name__}: {error}")
            if score is not None:
                found.setdefault((name, level, row), []).append(score)
    tables = table_of(found, limit=accuracy.EACH_SAMPLE, memory=True)
    return Outcome(tables=tables, checks=_checks(found), notes=NOTES)


def _checks(found: Found) -> list[Check]:
    """Return the promises: less work than the peers, at equal or better accuracy."""
    checks = []
    for problem, level, peer in found:
        work = step_ratio(found, (problem, level), peer, MINE)
        if peer not in LEAST_WORK or math.isnan(work):
            continue
        error = error_ratio(found, (problem, level), MINE, peer)
        at = problem if level is None else f"{problem}, {level:.0%} noise"
        checks.append(Check(f"{at}: error of '{MINE}' over '{peer}'", error, 1.0, "<="))
        checks.append(Check(f"{at}: work of '{peer}' over '{MINE}'", work, LEAST_WORK[peer], ">="))
    return checks


NOTES = (
    "Same model, samples, prior, reduced coordinates and noise level for all; knobs of peers are "
    "set to the best of those tried, with the truth of the very data set (see note).",
    "step: processor time of a step over that of a forward step with the matrix kept, at the best "
    "setting. MB: memory needed on top of what data and imported packages take.",
    "The ensemble filters use DAPPER's analysis in a plain loop, without its statistics.",
)
