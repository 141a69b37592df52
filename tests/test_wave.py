"""Waves: their speed, their energy, and the speed from a few point sensors."""

import numpy as np
import pytest
from skfem import ElementLineP1, ElementLineP2

import livepde as lp
from livepde.models import wave
from livepde.stepping import Advance, Alexander2, simulate
from livepde.streams import AbsoluteNoise, Twin

FIXED = {"left": 0.0, "right": 0.0}
STRING = lp.interval(0.0, 1.0, 40)
TIMES = np.arange(0.0, 2.01, 0.02)


def pluck(x):
    return np.exp(-(((x[0] - 0.3) / 0.1) ** 2))


def energy(model, u, c2=1.0):
    K = model.bilinear(lambda u, v, x: lp.dot(lp.grad(u.w), lp.grad(v.w)) * c2 + u.p * v.p)
    return 0.5 * u @ (K @ u)


def test_a_standing_wave_has_its_period():
    model = wave(STRING, lp.Normal(4.0), dirichlet=FIXED, element=ElementLineP2())
    start = {"w": lambda x: np.sin(np.pi * x[0]), "p": 0.0}
    run = simulate(model, np.array([4.0]), start, [0.0, 0.25, 1.0], Advance(Alexander2(), 0.01))
    first, quarter, last = (u for _, u in run)
    w = model.state_space.part("w")
    assert np.abs(last[w] - first[w]).max() < 5e-3
    assert np.abs(quarter[w]).max() < 5e-3


@pytest.mark.parametrize("d", [0.0, 0.8])
def test_the_energy_decays_only_by_damping(d):
    model = wave(STRING, lp.Normal(1.0), d, FIXED)
    start = {"w": lambda x: np.sin(np.pi * x[0]), "p": 0.0}
    run = simulate(model, np.ones(1), start, np.linspace(0, 2, 21), Advance(Alexander2(), 0.01))
    energies = np.array([energy(model, u) for _, u in run])
    assert np.all(np.diff(energies) < 1e-9)
    ratio = energies[-1] / energies[0]
    if d == 0.0:
        assert ratio == pytest.approx(1.0, abs=2e-3)
    else:  # w = exp(-d t/2) (cos(s t) + d/(2 s) sin(s t)) sin(pi x), s^2 = pi^2 - d^2/4
        s = np.sqrt(np.pi**2 - d**2 / 4)
        c, n = np.cos(2 * s), np.sin(2 * s)
        w, p = c + d / (2 * s) * n, -(s + d**2 / (4 * s)) * n
        exact = np.exp(-2 * d) * (np.pi**2 * w**2 + p**2) / np.pi**2
        assert ratio == pytest.approx(exact, rel=5e-3)


def test_a_moving_end_needs_its_velocity():
    moving = {"left": lambda x, t: np.sin(t)}
    with pytest.raises(lp.errors.ModelError, match="give its time derivative"):
        wave(STRING, lp.Normal(1.0), dirichlet=moving)
    speed = {"left": lambda x, t: np.cos(t)}
    model = wave(STRING, lp.Normal(1.0), dirichlet=moving, velocity=speed)
    u0 = {"w": 0.0, "p": lambda x: np.exp(-((x[0] / 0.1) ** 2))}
    *_, (_, u) = simulate(model, np.ones(1), u0, [0.0, 0.5], Advance(Alexander2(), 0.01))
    assert model.state_space.probe(np.array([[0.0]]), of="w") @ u == pytest.approx(np.sin(0.5))


@pytest.mark.slow
def test_speed_and_damping_from_two_points():
    model = wave(STRING, lp.Normal(1.3, 0.3), lp.Normal(0.2, 0.3), FIXED)
    sensors = lp.Points([0.45, 0.8], of="w", noise=0.01)
    twin = Twin(
        model=model,
        observation=sensors,
        q_true={"c2": 1.0, "d": 0.5},
        u0={"w": pluck, "p": 0.0},
        times=TIMES,
        scheme=Alexander2(),
        noise=AbsoluteNoise(0.01),
    )
    # The truth has the steps of the samples, too.
    law = lp.SensitivityLaw(shadows=lp.laws.Shadows(parts=1))
    ident = lp.Identifier(model, sensors, law, u0={"w": pluck, "p": 0.0}, scheme=Alexander2())
    (c2, c2_std), (d, d_std) = ident.run(twin).last.parameters.values()
    assert c2 == pytest.approx(1.0, abs=0.01)
    assert d == pytest.approx(0.5, abs=0.05)
    assert abs(c2 - 1.0) < 4 * c2_std
    assert abs(d - 0.5) < 4 * d_std


@pytest.mark.long
def test_the_speed_as_a_field():
    field = lp.Field(STRING, ElementLineP1(), inner="H1", prior=lp.Normal(1.0, std=0.3))
    model = wave(STRING, field, 0.1, FIXED)
    sensors = lp.Points([0.2, 0.4, 0.6, 0.8], of="w", noise=0.005)
    exact = lambda x: 1.0 + 0.3 * np.sin(2 * np.pi * x[0])  # noqa: E731
    twin = Twin(
        model=model,
        observation=sensors,
        q_true={"c2": exact},
        u0={"w": pluck, "p": 0.0},
        times=TIMES,
        scheme=Alexander2(),
        noise=AbsoluteNoise(0.005),
    )
    law = lp.SensitivityLaw(modes=8)
    ident = lp.Identifier(model, sensors, law, u0={"w": pluck, "p": 0.0}, scheme=Alexander2())
    result = ident.run(twin)
    assert twin.error(result.last.q) < 0.25 * twin.baseline()
    assert twin.error(result.last.q) < 0.05
