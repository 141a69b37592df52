"""The benchmark of refits: its lean forward models, truths, priors, references and checks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

import livepde as lp
from benchmarks.refit.estimator import Fit
from benchmarks.refit.jumps import PROCESSES
from benchmarks.refit.objective import LOST, Objective
from benchmarks.refit.problems import PROBLEMS
from benchmarks.refit.process import LostError
from benchmarks.refit.reference import Reference, reference
from benchmarks.refit.report import outcome
from benchmarks.refit.trial import Trial
from livepde.fem import Inputs, Moment
from livepde.laws.reduction import Reduction

SMALL = 0.15  # of the noise, root mean square: what truth and lean model may differ by


def at_random(problem, seed=5):
    """Return an objective and coordinates away from prior and truth."""
    objective = Objective(problem, problem.priors(seed), problem.readings(seed))
    a = 0.5 * np.random.default_rng(seed).standard_normal(objective.coordinates.size)
    return objective, a


# --- the lean forward model ----------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_lean_model_is_livepde_s(name):
    problem = PROBLEMS[name].at(6)
    priors = problem.priors(5)
    identifier = problem.identifier(priors)
    model = identifier.model
    assert tuple(model.parameter_space.labels or problem.unknowns) == tuple(problem.unknowns)
    objective, a = at_random(problem)
    q = objective.coordinates.value(a)

    def moment(t):
        signals = {key: np.interp(t, problem.times, row) for key, row in problem.signals.items()}
        return Moment(t, Inputs({key: float(value) for key, value in signals.items()}))

    control = replace(identifier.problem.control, start=0.0)
    latent, times = model.latent.inverse(q), problem.times.tolist()
    run = lp.simulate(model, latent, problem.u0, times, control, lambda t: dict(moment(t).inputs))
    expected = np.array([identifier.observed.predict(u, q, moment(t)) for t, u in run])[1:]
    process = problem.process
    found = process.predicted(process.states(problem.theta(q)[0]), q)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.long
@pytest.mark.parametrize("name", PROBLEMS)
def test_derivatives_of_the_residual(name):
    objective, a = at_random(PROBLEMS[name].at(6))
    steps = 1e-5 * np.eye(len(a))
    expected = [(objective.residual(a + s) - objective.residual(a - s)) / 2e-5 for s in steps]
    tolerance = 1e-6 * np.abs(expected).max()
    np.testing.assert_allclose(objective.jacobian(a), np.transpose(expected), atol=tolerance)


def test_the_field_has_the_prior_of_livepde():
    problem = PROBLEMS["profile"]
    priors = problem.priors(3)
    identifier = problem.identifier(priors)
    expected = Reduction.of(identifier.problem, dict.fromkeys(problem.unknowns, 14)).Phi
    found = problem.coordinates(priors).Phi
    # Modes have no sign: the covariance has one.
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=1e-9)


def test_a_model_without_a_solution_is_lost_and_not_an_error():
    problem = PROBLEMS["column"]
    with pytest.raises(LostError):
        problem.process.states(np.array([np.inf, 1.0]))
    objective, _ = at_random(problem)
    far = np.array([1e4, 0.0])
    np.testing.assert_array_equal(objective.residual(far)[:-2], LOST)
    np.testing.assert_array_equal(objective.jacobian(far)[:-2], 0.0)


# --- truths and priors ---------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_lean_model_is_close_to_the_truth(name):
    """So far apart that they are no twins, so close that the noise is the larger error."""
    problem = PROBLEMS[name].at(6)
    q = problem.q_true
    shown = problem.process.predicted(problem.process.states(problem.theta(q)[0]), q)
    difference = (shown - problem.shown[1:]) / problem.noise
    if name == "layers":
        off = difference[:, 1]  # this sensor is not where it is said to be
        assert 1.0 < np.sqrt(np.mean(off**2)) < 5.0
        difference = np.delete(difference, 1, axis=1)
    assert 1e-6 < np.sqrt(np.mean(difference**2)) < SMALL


@pytest.mark.parametrize("name", PROBLEMS)
def test_priors_are_honest_and_those_of_a_seed(name):
    problem = PROBLEMS[name]
    for seed in range(2, 24):
        priors = problem.priors(seed)
        assert priors == problem.priors(seed)
        for label, unknown in problem.unknowns.items():
            centre = unknown.latent(priors[label].median)
            std = priors[label].std / unknown.slope(centre)
            off = abs(unknown.latent(unknown.truth) - centre)
            assert off <= 3.0 * std * (1 + 1e-9)
            assert unknown.kind == "normal" or off <= np.log(10.0) * (1 + 1e-9)
    np.testing.assert_array_equal(problem.readings(3), problem.readings(3))
    assert not np.array_equal(problem.readings(3)[1:], problem.readings(4)[1:])


# --- the reference -------------------------------------------------------------------------------


@pytest.mark.long
def test_no_other_method_finds_less_than_the_reference():
    problem = PROBLEMS["column"]
    priors, z = problem.priors(2), problem.readings(2)
    found = reference(problem, priors, z)
    objective = Objective(problem, priors, z)
    start = objective.coordinates.inverse(problem.q_true)
    other = minimize(objective.cost, start, method="Nelder-Mead", options={"xatol": 1e-6})
    assert found.cost == pytest.approx(other.fun, abs=1e-4)
    np.testing.assert_allclose(found.a, other.x, atol=1e-3)
    assert found.cost == pytest.approx(objective.cost(found.a))


# --- jumps ---------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", PROCESSES)
def test_truths_with_jumps_agree_with_livepde(name):
    process, levels = PROCESSES[name], np.repeat([1.0, 1.6], 30)
    model = process.model()
    observed = process_observed(process, model)
    u, q, found = model.initial(process.u0), {"k": 0.2, "D": 0.5}[process.constant], []
    control = lp.Advance(lp.Alexander2())
    for n, v in enumerate(levels.tolist()):
        t = [n * process.step, (n + 1) * process.step]
        values = np.array([q, v])
        inputs = process.inputs
        *_, (_, u) = lp.simulate(model, model.latent.inverse(values), u, t, control, inputs)
        found.append(observed.predict(u, values, Moment(t[1], Inputs(dict(inputs(t[1]))))))
    difference = (np.array(found) - process.shown(levels))[2:] / process.noise
    assert np.sqrt(np.mean(difference**2)) < 1.0


def process_observed(process, model):
    sensors = lp.Points(list(process.points), noise=process.noise)
    return lp.Identifier(model, sensors, lp.SensitivityLaw()).observed


# --- checks --------------------------------------------------------------------------------------


def trial(seed, cost, **changes):
    a = np.zeros(2)
    fit = Fit(a, cost, cost, 5.0, True, "trusted", 3.0)
    scipy = Reference(a, 40.0, {"lm": 40.0, "trf": 90.0}, {"lm": 1.0, "trf": 0.5})
    own = {name: changes.pop(name) for name in ("shifted",) if name in changes}
    return Trial("column", seed, 40.0, replace(fit, **changes), 1.5, scipy, own.get("shifted", 0.5))


def failed(trials, jumps=()):
    return {check.name.split(": ", 1)[1] for check in outcome(trials, jumps).checks if not check.ok}


@pytest.mark.parametrize(
    ("cost", "changes", "names"),
    [
        (50.0, {}, {"share that reaches the best cost", "wrong without a word"}),
        (50.0, {"level": "do not trust"}, {"share that reaches the best cost"}),
        (50.0, {"converged": False}, {"share that reaches the best cost"}),
        (40.0, {"passes": 12.0}, {"passes, median"}),
        (40.0, {"passes": 14.0}, {"passes, median", "passes, nine of ten"}),
        (40.0, {"passes": np.nan}, {"passes, median", "passes, nine of ten"}),
        (40.0, {"claimed": 41.0}, {"reported cost, relative difference"}),
        (40.0, {"seconds": 4.0}, {"processor time / SciPy, median"}),
        (40.0, {"shifted": 1.1}, {"outliers, share within one standard deviation"}),
    ],
)
def test_checks_of_bad_fits(cost, changes, names):
    assert failed([trial(0, cost, **changes)]) == names
