"""The sensitivity law agrees with closed forms, with refits, bounds, drift and modes."""

import numpy as np
import pytest
from factories import excited, excited_q, excited_u, laplace, line, observe, truth
from skfem import ElementLineP1, ElementLineP2

import livepde as lp


def source_model(**options):
    """Two unknown source amplitudes: the output is linear in the parameter."""
    return lp.Model(
        lp.Field(line(16), ElementLineP2(), dirichlet={"boundary": 0.0}),
        {"a": lp.Normal(0.5, std=2.0), "b": lp.Normal(-1.0, std=0.5)},
        A=lambda q, _, v, x: -q.a * v - q.b * x[0] * np.sin(x.t) * v,
        B=laplace,
        **options,
    )


SCHEME = lp.SensitivityLaw.scheme
SENSORS = lp.Points([0.2, 0.5, 0.9], noise=[0.01, 0.02, 0.05])


def noisy(model, q_true, times, seed=0, u0=0.0):
    rng = np.random.default_rng(seed)
    G = observe(model, SENSORS).G
    states = truth(model, np.array(q_true), u0, times, SCHEME)
    sizes = np.array(SENSORS.noise)
    return [(t, G @ u + sizes * rng.standard_normal(3)) for t, u in zip(times, states, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("refit", [None, lp.Refit()])
def test_equals_the_bayesian_estimate_of_a_linear_problem(refit):
    """One batch least squares with the prior, by forward runs for each amplitude."""
    model = source_model()
    times = 0.1 * np.arange(21)
    data = noisy(model, [1.7, -0.4], times)
    G = SENSORS.matrix(model.state_space)
    units = [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]
    runs = [truth(model, np.array(q), 0.0, times, SCHEME) for q in units]
    zero, one, two = (np.concatenate([G @ u for u in run[1:]]) for run in runs)
    H = np.column_stack([one - zero, two - zero])
    z = np.concatenate([z for _, z in data[1:]])
    weights = 1 / np.tile(np.array(SENSORS.noise) ** 2, 20)
    prior, precision = np.array([0.5, -1.0]), np.diag([1 / 4.0, 1 / 0.25])
    covariance = np.linalg.inv(precision + H.T @ (weights[:, None] * H))
    batch = prior + covariance @ (H.T @ (weights * (z - zero - H @ prior)))

    law = lp.SensitivityLaw(refit=refit, shadows=None)
    estimate = lp.Identifier(model, SENSORS, law, halvings=0).run(data[1:]).last
    np.testing.assert_allclose(estimate.q, batch, rtol=1e-8)
    factor = estimate.belief.q_factor
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=1e-8)
    state = truth(model, batch, 0.0, times, SCHEME)[-1]
    np.testing.assert_allclose(estimate.u, state, atol=1e-9)


def conductivity(prior=1.0, bounds=(0.05, 10.0)):
    return lp.Model(
        lp.Field(line(16), ElementLineP2(), dirichlet={"left": 0.0, "right": lp.Channel("T")}),
        lp.Normal(prior, std=1.0, bounds=bounds),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
        f=1.0,
    )


def warm(t):
    return {"T": np.sin(3 * t)}


def stream(model, k, times, noise=0.0, seed=0):
    sensors = lp.Points({"T_1": 0.3, "T_2": 0.7}, noise=0.01)
    G = sensors.matrix(model.state_space)
    rng = np.random.default_rng(seed)
    states = truth(model, np.array([k]), 0.0, times, SCHEME, inputs=warm)
    samples = [
        (t, G @ u + noise * rng.standard_normal(2), warm(t))
        for t, u in zip(times, states, strict=True)
    ]
    return sensors, samples


@pytest.mark.slow
def test_a_full_window_goes_on_from_the_estimate():
    model = conductivity()
    sensors, samples = stream(model, 2.0, 0.05 * np.arange(121), noise=0.01)
    law = lp.SensitivityLaw(refit=lp.Refit(start=5, window=20))
    ident = lp.Identifier(model, sensors, law)
    stored = []
    for t, z, inputs in samples:
        estimate = ident.step(t, z, inputs)
        state = ident._state
        stored.append(state.log.shape[1] - int(state.window[0]))
    assert max(stored) <= 20
    assert estimate.q[0] == pytest.approx(2.0, abs=0.03)


@pytest.mark.slow
def test_bounds_are_never_left():
    model = conductivity(bounds=(0.05, 1.5))
    sensors, samples = stream(conductivity(), 3.0, 0.05 * np.arange(61), noise=0.01)
    for refit in (None, lp.Refit()):
        ident = lp.Identifier(model, sensors, lp.SensitivityLaw(refit=refit))
        found = [ident.step(*sample).q[0] for sample in samples]
        found.append(ident.refit().q[0])
        assert max(found) == found[-1] == 1.5
        assert min(found) >= 0.05


@pytest.mark.long
def test_drift_and_memory_follow_a_jump():
    model = conductivity()
    times = 0.05 * np.arange(161)
    sensors, first = stream(model, 1.0, times)
    _, second = stream(model, 2.0, times)
    samples = [a if a[0] < 4.0 else b for a, b in zip(first, second, strict=True)]
    constant = lp.Identifier(model, sensors, lp.SensitivityLaw()).run(samples).last
    law = lp.SensitivityLaw(drift=0.05, memory=0.5)
    tracking = lp.Identifier(model, sensors, law).run(samples).last
    assert tracking.q[0] == pytest.approx(2.0, abs=0.05)
    assert abs(constant.q[0] - 2.0) > abs(tracking.q[0] - 2.0)
    assert tracking.q_std[0] > 0


@pytest.mark.slow
def test_uncertainty_returns_to_the_prior_with_drift_and_without_data():
    model = conductivity()
    sensors, samples = stream(model, 1.0, 0.1 * np.arange(101))
    ident = lp.Identifier(model, sensors, lp.SensitivityLaw(drift=0.5, shadows=None))
    seen = [ident.step(*sample).q_std[0] for sample in samples[:11]]
    stds = [ident.step(t, [np.nan, np.nan], inputs).q_std[0] for t, _, inputs in samples[11:]]
    # By a dense Kalman filter about the truth, with 64 cells and steps of 1/640.
    assert seen[-1] == pytest.approx(0.118, rel=0.01)
    assert np.all(np.diff(stds) > 0)
    # dV/dt = 0.5 (1 - V) from the variance after the last sample
    expected = 1.0 - (1.0 - seen[-1] ** 2) * np.exp(-0.05 * np.arange(1, 91))
    assert np.square(stds) == pytest.approx(expected)


def test_a_long_gap_leaves_no_more_uncertainty_than_the_prior():
    model = conductivity()
    sensors, samples = stream(model, 1.0, 0.1 * np.arange(11))
    ident = lp.Identifier(model, sensors, lp.SensitivityLaw(drift=0.5, shadows=None))
    for sample in samples:
        ident.step(*sample)
    t, _, inputs = samples[-1]
    assert ident.step(t + 100.0, [np.nan, np.nan], inputs).q_std[0] == pytest.approx(1.0)


@pytest.mark.slow
def test_a_field_by_modes_of_its_prior():
    """DESIGN.md, fact 5, a short run on clean data."""
    model = excited(16)
    times = 0.05 * np.arange(200)
    q_true = model.initial_parameter(excited_q)
    states = truth(model, q_true, lambda x: excited_u(x, 0.0), times, SCHEME)
    law = lp.SensitivityLaw(modes=8, noise=1e-3, shadows=None, verdict=False)
    ident = lp.Identifier(model, lp.Full(), law, q0=0.0, u0=lambda x: excited_u(x, 0.0))
    for t, u in zip(times[1:], states[1:], strict=True):
        estimate = ident.step(t, ident.observed.G @ u)
    mass = model.parameter_mass
    error = estimate.q - q_true
    assert np.sqrt(error @ mass @ error / (q_true @ mass @ q_true)) < 0.005
    assert estimate.q_std.shape == q_true.shape
    assert estimate.u_std.shape == estimate.u.shape


@pytest.mark.slow
def test_a_field_beside_a_number():
    mesh = line(12)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"boundary": 0.0}),
        {"c": lp.Normal(0.0), "s": lp.Field(mesh, ElementLineP1(), inner="H1")},
        A=lambda q, u, v, x: q.c * u * v - q.s * v,
        B=laplace,
    )
    q_true = model.initial_parameter({"c": 1.0, "s": lambda x: 1 + x[0]})
    times = 0.05 * np.arange(101)
    states = truth(model, q_true, 0.0, times, SCHEME)
    law = lp.SensitivityLaw(modes={"s": 6}, noise=1e-3)
    ident = lp.Identifier(model, lp.Full(), law)
    for t, u in zip(times[1:], states[1:], strict=True):
        estimate = ident.step(t, ident.observed.G @ u)
    assert ident._work.filter.reduction.Phi.shape == (14, 7)
    predicted = truth(model, estimate.q, 0.0, times, SCHEME)[-1]
    np.testing.assert_allclose(predicted, states[-1], atol=2e-3)


@pytest.mark.slow
def test_a_sensor_that_sees_a_parameter():
    model = lp.Model(
        lp.Field(line(10), ElementLineP1(), dirichlet={"boundary": 0.0}),
        {"s": lp.Normal(0.0, std=2.0), "offset": lp.Normal(0.0, std=1.0)},
        A=lambda q, _, v, x: -q.s * np.sin(x.t) * v,
        B=laplace,
    )
    sensors = lp.Points(
        {"plain": 0.3, "shifted": 0.6}, direct={"shifted": lambda q, x: q.offset}, noise=0.001
    )
    times = 0.1 * np.arange(41)
    q_true = np.array([1.5, 0.4])
    ident = lp.Identifier(model, sensors, lp.SensitivityLaw())
    for t, u in zip(times[1:], truth(model, q_true, 0.0, times, SCHEME)[1:], strict=True):
        moment = lp.fem.Moment(t)
        estimate = ident.step(t, ident.observed.predict(u, q_true, moment))
    assert estimate.parameters["offset"][0] == pytest.approx(0.4, abs=1e-3)
    assert estimate.parameters["s"][0] == pytest.approx(1.5, abs=1e-2)
    np.testing.assert_allclose(estimate.innovation, 0.0, atol=1e-3)


def test_a_refit_that_fails_keeps_the_estimate_of_the_filter(monkeypatch):
    """It is reported; the stream continues, and the samples are fitted again when doubled."""
    model = conductivity()
    sensors, samples = stream(model, 2.0, 0.1 * np.arange(12))
    plain = lp.Identifier(model, sensors, lp.SensitivityLaw(refit=None))
    ident = lp.Identifier(model, sensors, lp.SensitivityLaw())
    monkeypatch.setattr("livepde.laws.stored_samples.StoredSamples._followed", lambda *_: iter(()))
    for sample in samples:
        expected, estimate = plain.step(*sample), ident.step(*sample)
        assert estimate.status.ok
        np.testing.assert_array_equal(estimate.q, expected.q)
    assert (estimate.fit.samples, estimate.fit.converged) == (8, False)
    assert "did not converge" in str(estimate.verdict)
    assert estimate.q[0] == pytest.approx(2.0, abs=0.5)


class TestRefusals:
    def test_options(self):
        with pytest.raises(lp.errors.LawError, match="drift"):
            lp.SensitivityLaw(drift=-1.0)
        with pytest.raises(lp.errors.LawError, match="memory"):
            lp.SensitivityLaw(memory=0.0)
        with pytest.raises(lp.errors.LawError, match="noise"):
            lp.SensitivityLaw(noise=0.0)
        for name, value in (("start", -1), ("window", 1), ("passes", 0)):
            with pytest.raises(lp.errors.LawError, match=f"Refit: {name} must be at least"):
                lp.Refit(**{name: value})

    def test_no_noise_level(self):
        with pytest.raises(lp.errors.LawError, match="noise="):
            lp.Identifier(conductivity(), lp.Points([0.5]), lp.SensitivityLaw())

    def test_modes_of_an_unknown_field(self):
        with pytest.raises(lp.errors.LawError, match="modes"):
            lp.Identifier(
                excited(4), lp.Points([0.5], noise=0.1), lp.SensitivityLaw(modes={"p": 3})
            )


@pytest.mark.parametrize("name", ["refit", "jumps", "guards"])
def test_a_switch_is_no_option(name: str):
    with pytest.raises(lp.errors.LawError, match=f"{name} must be a {name.title()}, or None"):
        lp.SensitivityLaw(**{name: True})


@pytest.mark.parametrize("modes", [0, -1, 2.5])
def test_modes_are_counted(modes: float):
    with pytest.raises(lp.errors.LawError, match="modes must be whole numbers of at least 1"):
        lp.Identifier(excited(4), lp.Points([0.5], noise=0.1), lp.SensitivityLaw(modes=modes))
