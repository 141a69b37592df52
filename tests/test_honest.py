"""Honest twins agree with closed forms and refined runs of livepde; their scores are correct."""

import numpy as np
import pytest
from factories import observe

import livepde as lp
from benchmarks.honest import PROBLEMS
from benchmarks.honest.batch import Batch
from benchmarks.honest.linear import Chebyshev
from benchmarks.honest.problems.fisher import CELLS, Population
from benchmarks.honest.problems.flux import NonlinearFlux, RodFlux
from benchmarks.honest.problems.warm import WarmRod
from livepde.fem import Inputs, Moment

SMALL = 0.15  # of the noise, root mean square: that much truth and refined livepde may differ


# --- truths against closed forms -----------------------------------------------------------------


def test_collocation_decays_as_the_first_sine():
    space, k = Chebyshev(24), 0.1
    ends, none = np.eye(25)[[0, -1]], np.zeros((25, 1))
    system = space.system(k * space.D2, ends, np.zeros((2, 1)), none, [0.3])
    times = np.linspace(0.0, 2.0, 9)
    start = np.sin(np.pi * space.x[1:-1])
    found = system.respond(np.zeros((65, 1)), 0.25, start)[:, 0]
    exact = np.exp(-k * np.pi**2 * times) * np.sin(0.3 * np.pi)
    np.testing.assert_allclose(found, exact, atol=1e-11)


def test_a_population_without_differences_grows_logistically_with_its_tangent():
    r, times = 1.3, np.linspace(0.0, 4.0, 41)
    start = np.full(CELLS + 1, 0.1)
    y, Y = Population(0.02, r).solve(start, times, tangents=True)
    growth = 0.1 * np.exp(r * times)
    exact = growth / (0.9 + growth)
    np.testing.assert_allclose(y[:, 7], exact, atol=2e-5)
    np.testing.assert_allclose(Y[:, 7, 0], 0.0, atol=1e-12)
    by_r = times * exact * (1.0 - exact) * r * 0.3  # in standard deviations of log r
    np.testing.assert_allclose(Y[:, 7, 1], by_r, atol=2e-5)


# --- truths against livepde, refined -------------------------------------------------------------


def simulated(problem, theta, refine, substeps):
    """Return what the sensors show in livepde, with second order and inputs at each substep."""
    model = problem.model(refine)
    sensors = lp.Points(dict(problem.points), direct=dict(problem.direct))
    observed = observe(model, sensors)
    space = model.parameter_space
    q = np.zeros(space.dim)
    for label, latent in problem.latents.items():
        if label in space.labels:
            value = latent.value(theta, 0).item()
            q[space.labels[label]] = np.exp(value) if latent.log else value
        else:
            x = problem.mesh(refine).p
            shape = getattr(problem, "reaction", None) or problem.conductivity
            q[space.part(label)] = shape(theta, *x)

    def inputs(t):
        return {name: float(signal(np.array(t))) for name, signal in problem.channels.items()}

    times = np.linspace(0.0, problem.length, substeps * problem.intervals + 1).tolist()
    control = lp.Advance(lp.Alexander2())
    run = lp.simulate(model, model.latent.inverse(q), problem.u0, times, control, inputs)
    return np.array(
        [
            observed.predict(u, q, Moment(t, Inputs(inputs(t))))
            for n, (t, u) in enumerate(run)
            if n % substeps == 0
        ]
    )


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.long
def test_truths_agree_with_livepde_refined(name):
    problem = PROBLEMS[name]
    theta = 0.7 * np.random.default_rng(5).standard_normal(problem.coordinates)
    if name in ("flux", "warm-flux"):
        theta[2:] = 0.0  # the flux stays as it is, so that `simulate` knows it
    nonlinear = name in ("warm-flux", "warm-rod", "fisher")
    refined = simulated(problem, theta, 2, 1 if nonlinear or name in ("plate", "reaction") else 2)
    difference = (refined - problem.predict(theta)) / problem.noise
    assert np.sqrt(np.mean(difference**2)) < SMALL
    assert np.ptp(refined) > 10 * problem.noise


# --- priors and derivatives ----------------------------------------------------------------------


@pytest.mark.parametrize("name", PROBLEMS)
def test_truths_are_drawn_from_the_prior_of_the_estimator(name):
    problem = PROBLEMS[name]
    model = problem.model()
    covariance = np.linalg.inv(model.Q.gram.toarray())
    space = model.parameter_space
    for label, latent in problem.latents.items():
        part = space.labels[label] if label in space.labels else space.part(label)
        indices = np.atleast_1d(np.arange(space.dim)[part])
        D = latent.directions(0)
        np.testing.assert_allclose(latent.mean, model.latent.prior[indices], rtol=1e-12)
        exact, drawn = np.diag(covariance)[indices], (D**2).sum(axis=1)
        # The field's cosines end where less than a hundredth of the variance is left.
        np.testing.assert_allclose(drawn, exact, rtol=1e-12 if len(indices) == 1 else 0.03)


def differences(problem, theta, columns):
    found = []
    for k in columns:
        step = np.zeros(problem.coordinates)
        step[k] = 1e-4
        found.append((problem.predict(theta + step) - problem.predict(theta - step)) / 2e-4)
    return np.stack(found, axis=-1)


class ShortWarmRod(WarmRod):
    length, intervals = 2.0, 40


class ShortFlux(RodFlux):
    length, intervals = 2.0, 40


class ShortNonlinearFlux(NonlinearFlux):
    length, intervals = 2.0, 20


@pytest.mark.long
@pytest.mark.parametrize("kind", [ShortWarmRod, ShortFlux, ShortNonlinearFlux])
def test_derivatives_of_the_truth(kind):
    problem = kind()
    theta = 0.5 * np.random.default_rng(2).standard_normal(problem.coordinates)
    columns = [k for k in (0, 1, 2, 9) if k < problem.coordinates]
    exact = problem.jacobian(theta)[..., columns]
    expected = differences(problem, theta, columns)
    np.testing.assert_allclose(exact, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.long
def test_the_flux_of_the_truth_walks_as_the_estimator_believes():
    problem = ShortFlux()
    rng = np.random.default_rng(3)
    ends = np.array([problem.latents["J"].value(problem.draw(rng)[0], 40) for _ in range(400)])
    model = problem.model()
    (walk,) = [p for p in model.latent.parts.values() if p.evolution.moves]
    gained = walk.evolution.growth(problem.length, walk.unknown.prior.latent_std)[0]
    expected = walk.unknown.prior.latent_std * np.sqrt(1.0 + gained)
    assert ends.std() == pytest.approx(expected, rel=0.1)
    assert np.linalg.norm(problem.latents["J"].directions(40)) == pytest.approx(expected)


# --- batch and scores ----------------------------------------------------------------------------


@pytest.mark.long
def test_the_batch_posterior_holds_its_truths():
    """Errors of the batch fit in its own standard deviations are standard normal."""
    problem, errors = PROBLEMS["column"], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        theta, shown = problem.draw(rng)
        batch = Batch.of(problem, theta)
        fit = batch.fit(shown + problem.noise * rng.standard_normal(shown.shape))
        for latent in problem.latents.values():
            std = batch.std(latent, problem.intervals)
            errors.append(((latent.value(fit, 0) - latent.value(theta, 0)) / std).item())
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.25)
