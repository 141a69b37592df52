"""z = g(G_0 u): the linearised adjoint in both laws, and the check of the derivative."""

from __future__ import annotations

import numpy as np
import pytest
from factories import excited, excited_q, excited_u, observe, reaction
from skfem import ElementLineP1

import livepde as lp
from livepde.fem import START
from livepde.streams import Twin

RADIATION = (lambda T: T**4, lambda T: 4 * T**3)
THERMISTOR = (lambda T: np.exp(1 / (1 + T)), lambda T: -np.exp(1 / (1 + T)) / (1 + T) ** 2)
WAVE = (lambda T: np.sin(3 * T), lambda T: 3 * np.cos(3 * T))  # not monotone


def bound(function, derivative=None, base=None, **options):
    model = reaction(lp.interval(0.0, 1.0, 12), ElementLineP1(), dirichlet={})
    base = base or lp.Points([0.2, 0.5, 0.9])
    return observe(model, lp.observation.Transformed(base, function, derivative, **options))


@pytest.mark.parametrize("reading", [RADIATION, THERMISTOR, WAVE])
@pytest.mark.parametrize("given", [True, False])
def test_taylor(reading, given):
    """With the derivative given, and by a complex step."""
    observed = bound(reading[0], reading[1] if given else None)
    lp.diagnostics.check_observation(observed).raise_if_failed()
    u = 1.0 + 0.1 * np.random.default_rng(0).standard_normal(13)
    H_u, H_q = observed.jacobian(u, np.zeros(13), START)
    slope = reading[1](observed.G @ u)
    np.testing.assert_allclose(H_u.toarray(), slope[:, None] * observed.G.toarray(), rtol=1e-14)
    assert H_q is None


def test_a_wrong_derivative_is_found():
    report = lp.diagnostics.check_observation(bound(lambda T: T**4, lambda T: 3 * T**3))
    assert [line.name for line in report.lines if not line.ok] == ["G'(u) by differences"]
    with pytest.raises(lp.errors.ObservationError, match="must be that of function="):
        report.raise_if_failed()


def test_newton_step_is_of_second_order():
    """u_alpha is R u* up to the square of R (u^ - u*); for a linear g exactly G^+ z."""
    rng = np.random.default_rng(2)
    exact, direction = 1.0 + 0.2 * rng.uniform(-1, 1, 13), rng.uniform(-1, 1, 13)
    observed = bound(*RADIATION, iterations=1)
    split, zero = observed.split(), np.zeros(13)
    z = observed.predict(exact, zero, START)
    errors = []
    for size in (0.08, 0.04, 0.02):
        seen = observed.linearised(z, exact + size * direction)
        errors.append(np.abs(split.reconstruct(seen, zero) - split.R @ exact).max())
    assert np.all(np.log2(np.array(errors[:-1]) / errors[1:]) > 1.8)
    repeated = bound(*RADIATION).linearised(z, exact + 0.08 * direction)
    np.testing.assert_allclose(repeated, observed.G @ exact, rtol=1e-12)
    linear = bound(lambda T: 2 * T - 1)
    z = linear.predict(exact, zero, START)
    np.testing.assert_allclose(linear.linearised(z, direction), linear.G @ exact, atol=1e-14)
    plain = observe(reaction(lp.interval(0.0, 1.0, 12), ElementLineP1()), lp.Points([0.2]))
    assert plain.linearised(z, direction) is z
    assert plain.jacobian(direction, zero, START)[0] is plain.G


def test_insensitive_and_missing_sensors_say_nothing():
    observed = bound(lambda T: (T - 1) ** 2, lambda T: 2 * (T - 1), iterations=1)
    flat = np.ones(13)
    assert np.isnan(observed.linearised(np.array([1.0, 1.0, np.nan]), flat)).all()
    seen = observed.linearised(np.array([0.25, np.nan, 0.25]), 1.4 * flat)
    np.testing.assert_allclose(seen, [1.5125, np.nan, 1.5125])


def test_reach_bounds_the_newton_step():
    observed = bound(*RADIATION, reach=0.1, iterations=1)
    seen = observed.linearised(np.ones(3), np.full(13, 0.3))
    np.testing.assert_allclose(seen, 0.4)


def test_bad_sensors():
    with pytest.raises(lp.errors.ObservationError, match="reach must be positive; got 0"):
        bound(*RADIATION, reach=0)
    with pytest.raises(lp.errors.ObservationError, match="iterations must be at least 1; got 0"):
        bound(*RADIATION, iterations=0)
    with pytest.raises(lp.errors.ObservationError, match="give noise= to it and not to its base"):
        bound(*RADIATION, base=lp.Points([0.2], noise=0.1))
    with pytest.raises(
        lp.errors.ObservationError, match=r"shape \(2,\) for values of shape \(3,\)"
    ):
        bound(lambda T: T[:2]).predict(np.ones(13), np.zeros(13), START)


@pytest.mark.slow
@pytest.mark.parametrize("reading", [(lambda T: np.exp(T / 2), None), (lambda T: T, None)])
def test_gradient_law(reading):
    """With z = exp(u/2) it finds q as well as with z = u, and with g = id it is the same law."""
    model = excited(12, ElementLineP1())
    sensors = lp.observation.Transformed(lp.Full(), *reading)
    shared = {
        "model": model,
        "q_true": excited_q,
        "u_true": excited_u,
        "times": 0.05 * np.arange(201),
    }

    def error(observation):
        twin = Twin(observation=observation, **shared)
        law = lp.GradientLaw(gain=1000.0)
        start = {"q0": 0.0, "u0": lambda x: excited_u(x, 0.0)}
        return twin.error(lp.Identifier(model, observation, law, **start).run(twin).last.q)

    plain, found = error(lp.Full()), error(sensors)
    assert plain < 0.05
    assert found < 1.5 * plain
    if reading[0](2.0) == 2.0:
        assert found == pytest.approx(plain, rel=1e-6)


@pytest.mark.slow
def test_sensitivity_law_with_a_sensor_that_sees_the_parameter():
    """z = (u + R Q)^2 with the direct part inside of g: R and k are both found."""
    model = lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 20), ElementLineP1(), dirichlet={"left": 1.0}),
        {"k": lp.Normal(0.5, std=0.3, bounds=(0.01, 5.0)), "R": lp.Normal(0.0, std=1.0)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) + 0.0 * q.R * v,
        f=1.0,
    )
    base = lp.Points({"a": 0.4, "b": 1.0}, direct={"b": lambda q, x: 2.0 * q.R})
    sensors = lp.observation.Transformed(base, lambda y: y**2, noise=1e-3)
    q_true = {"k": 0.8, "R": 0.4}
    twin = Twin(
        model=model, observation=sensors, q_true=q_true, u0=1.0, times=0.02 * np.arange(101)
    )
    last = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=1.0).run(twin).last
    for name, value in q_true.items():
        assert last.parameters[name][0] == pytest.approx(value, rel=0.02)
