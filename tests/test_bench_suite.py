"""The benchmark suite on a tiny problem: truth, offline fit, scores, rows that cannot run."""

from dataclasses import replace

import numpy as np
import pytest
from factories import driven_rod, line

import livepde as lp
from benchmarks.offline import Trajectory, fit
from benchmarks.peers.augmented import Augmented
from benchmarks.problems import PROBLEMS, Data, Problem, Process

pytestmark = pytest.mark.study

TIMES = np.linspace(0.0, 1.0, 21)


def rod(seed: int, evolution: lp.RandomWalk | None = None) -> Process:
    moves = {} if evolution is None else {"evolution": evolution}
    unknown = lp.Scalar(lp.LogNormal(0.3, 0.1), **moves)
    model = driven_rod({"a": unknown}, lambda t: np.sin(4 * t), line(12))
    points = lp.Points([0.3, 0.6])
    q = np.array([0.3 * np.exp(np.random.default_rng(seed).normal() / 3)])
    G = points.matrix(model.state_space)
    run = lp.simulate(model, np.log(q), 0.0, TIMES.tolist(), lp.Advance(lp.ImplicitEuler()))
    exact = np.array([G @ u for _, u in run])
    q_true = np.tile(q, (len(TIMES), 1))
    return Process(model=model, observation=points, times=TIMES, exact=exact, q_true=q_true, u0=0.0)


ROD = Problem(name="rod", summary="one number", make=rod)
WALK = Problem(
    name="walk", summary="it may move", make=lambda s: rod(s, lp.RandomWalk(0.2)), varying=True
)


@pytest.fixture(scope="module")
def data() -> Data:
    return ROD.data(0.01, 0)


@pytest.mark.parametrize("problem", [ROD, WALK])
def test_sensitivities_of_the_offline_fit_are_exact(problem):
    trajectory = Trajectory(problem.data(0.01, 0))
    rng = np.random.default_rng(0)
    a, d = 0.3 * rng.standard_normal((2, trajectory.size))
    J, h = trajectory.jacobian(a) @ d, 1e-5
    difference = (trajectory.residual(a + h * d) - trajectory.residual(a - h * d)) / (2 * h)
    np.testing.assert_allclose(J, difference, rtol=1e-5, atol=1e-5 * np.abs(J).max())


def test_offline_fit_finds_the_parameter_within_its_deviation(data):
    found = fit(data)
    assert found.converged
    true, std = np.log(data.process.q_true[0, 0]), abs(found.factor(-1)[0, 0])
    assert std < 0.1
    assert abs(found.q[-1, 0] - true) < 3 * std


def test_fits_of_the_data_so_far_do_not_know_the_future():
    data = WALK.data(0.01, 0)
    short = fit(data.until(10))
    long = replace(data, z=np.vstack([data.z[:11], data.z[11:] + 1.0]))
    np.testing.assert_array_equal(fit(long.until(10)).q, short.q)
    assert len(short.q) == 11
    again = fit(data.until(12), start=short.coordinates)
    np.testing.assert_allclose(again.q, fit(data.until(12)).q, atol=1e-4)


def test_peers_are_given_our_forward_model(data):
    augmented = Augmented(data)
    a = np.log(data.process.q_true[0] / 0.3) * 3.0
    x = np.concatenate([augmented.start, a])
    for at in range(1, len(TIMES)):
        x = augmented.forecast(x, at)
        np.testing.assert_allclose(augmented.output(x, at), data.process.exact[at], atol=1e-12)


@pytest.mark.parametrize("name", [n for n, p in PROBLEMS.items() if None not in p.levels])
def test_the_estimators_model_explains_the_exact_data_to_the_stated_floor(name):
    problem = PROBLEMS[name]
    data = problem.data(0.0, 0)
    process, trajectory = data.process, Trajectory(data)
    latent = process.model.latent
    trajectory.latent = lambda a, at: latent.inverse(process.q_true[at])
    shown, _, _ = trajectory.run(np.zeros(trajectory.size), sensitivities=False)
    missed = ((shown - process.exact) / process.size)[2:]
    assert np.sqrt(np.mean(missed**2)) <= 2 * problem.floor
