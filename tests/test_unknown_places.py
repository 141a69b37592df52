"""A number anywhere in process or sensor can be estimated, with a realistic uncertainty."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from factories import advanced
from skfem import ElementLineP1

import livepde as lp
from livepde.diagnostics import check_model
from livepde.stepping import ForwardStage

pytestmark = pytest.mark.slow

NOISE = 0.01
MESH = lp.interval(0.0, 1.0, 24)
TIMES = 0.05 * np.arange(101)
D = 0.2


def conduction(u: Any, v: Any) -> Any:
    return D * lp.dot(lp.grad(u), lp.grad(v))


def swing(x: Any) -> Any:
    return 2.0 + np.sin(2.0 * x.t)


# name -> (prior, std, truth, terms (q, u, v, x) beside the conduction, initial state)
PLACES: dict[str, tuple[float, float, float, list[Any], Any]] = {
    "diffusion": (
        0.2, 0.2, 0.35,
        [lambda q, u, v, x: (q.a - D) * lp.dot(lp.grad(u), lp.grad(v)),
         lp.On("left", lambda q, u, v, x: -swing(x) * v)],
        None,
    ),
    "advection": (
        0.0, 0.5, 0.4,
        [lambda q, u, v, x: q.a * lp.grad(u)[0] * v,
         lp.On("left", lambda q, u, v, x: -swing(x) * v)],
        None,
    ),
    "reaction": (
        0.0, 1.0, 0.7,
        [lambda q, u, v, x: q.a * u * v, lp.On("left", lambda q, u, v, x: -swing(x) * v)],
        None,
    ),
    "exponent of a reaction": (
        1.5, 0.5, 2.0,
        [lambda q, u, v, x: lp.fem.absolute(u + 0.1) ** q.a * v,
         lp.On("left", lambda q, u, v, x: -swing(x) * v)],
        None,
    ),
    "source in a region": (0.0, 1.0, 1.3, [lambda q, u, v, x: -q.a * (x[0] > 0.5) * v], None),
    "boundary value": (
        0.0, 2.0, 1.5,
        [lp.On("left", lambda q, u, v, x: 100 * D / x.h * (u - q.a) * v)],
        None,
    ),
    "boundary flux": (0.0, 1.0, -0.6, [lp.On("right", lambda q, u, v, x: -q.a * v)], None),
    "heat-transfer coefficient": (
        1.0, 0.5, 1.6,
        [lp.On("right", lambda q, u, v, x: q.a * (u - swing(x)) * v)],
        None,
    ),
    "storage": (
        1.0, 0.5, 1.7,
        [lambda q, u, v, x: (1 / q.a - 1) * conduction(u, v),
         lp.On("left", lambda q, u, v, x: -swing(x) / q.a * v)],
        None,
    ),
    "initial state": (
        0.0, 1.0, 0.8,
        [lambda q, u, v, x: 0.0 * q.a * v],
        lambda q, v, x: q.a * np.cos(np.pi * x[0]) * v,
    ),
}  # fmt: skip


def model_of(place: str) -> lp.Model:
    prior, std, _, terms, initial = PLACES[place]
    base = [lambda q, u, v, x: conduction(u, v) + 0.0 * q.a * u * v]
    state = lp.Field(MESH, ElementLineP1())
    return lp.Model(state, {"a": lp.Normal(prior, std)}, A=[*base, *terms], initial=initial)


def found(
    model: lp.Model, sensors: lp.observation.Observation, truth: Any, **law: Any
) -> lp.Estimate:
    """Return the last estimate from noisy data of the model itself."""
    rng = np.random.default_rng(0)
    filtering = lp.SensitivityLaw(shadows=None, verdict=False, **law)
    identifier = lp.Identifier(model, sensors, filtering)
    exact = model.initial_parameter(truth)
    physical, forward = model.latent.value(exact), ForwardStage(model)
    u = model.initial_state(exact)

    def sample(t: float) -> Any:
        z = identifier.observed.predict(u, physical, lp.fem.Moment(t))
        return z + NOISE * rng.standard_normal(len(z))

    estimate = identifier.step(0.0, sample(0.0))
    for t0, t1 in pairwise(TIMES.tolist()):
        u = advanced(forward, u, exact, t0, t1)
        estimate = identifier.step(t1, sample(t1))
        assert estimate.status.ok
    return estimate


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
def test_an_unknown_is_found_wherever_it_stands(place: str):
    model, truth = model_of(place), PLACES[place][2]
    check_model(model, u=1.0, spread=0.1).raise_if_failed()
    estimate = found(model, lp.Points([0.1, 0.4, 0.8], noise=NOISE), {"a": truth})
    value, std = estimate.parameters["a"]
    assert abs(value - truth) < 4 * std
    assert std < 0.1 * PLACES[place][1]


@pytest.mark.long
@pytest.mark.parametrize("what", ["offset", "gain", "contact resistance"])
def test_an_unknown_in_a_sensor_is_found_with_one_in_the_process(what: str):
    reaction = PLACES["reaction"][3]
    base = [lambda q, u, v, x: conduction(u, v), *reaction]
    unknowns: dict[str, Any] = {"a": lp.Normal(0.0, 1.0)}
    truth: dict[str, Any] = {"a": 0.7}
    points = lp.Points({"A": 0.1, "B": 0.4, "C": 0.8}, noise=None)
    if what == "offset":
        unknowns["offset"] = lp.Scalars(("A", "C"), lp.Normal(0.0, 0.5))
        truth["offset"] = [0.3, -0.2]
        direct = {name: lambda q, x, name=name: q.offset[name] for name in ("A", "C")}
        sensors: lp.observation.Observation = lp.Points(
            dict(points.points), direct=direct, noise=NOISE
        )
    elif what == "gain":
        unknowns["gain"] = lp.Scalars(("A", "B"), lp.Normal(1.0, 0.2))
        truth["gain"] = [1.1, 0.9]
        sensors = lp.observation.Calibrated(
            points, lambda y, q, x: y * np.array([q.gain["A"], q.gain["B"], 1.0]), noise=NOISE
        )
    else:
        unknowns["R"] = lp.Normal(0.1, 0.1)
        truth["R"] = 0.25
        sensors = lp.observation.Calibrated(
            points, lambda y, q, x: y + np.array([q.R, 0.0, 0.0]) * swing(x), noise=NOISE
        )
    model = lp.Model(lp.Field(MESH, ElementLineP1()), unknowns, A=base)
    estimate = found(model, sensors, truth)
    exact = model.parameter_space.interpolate(truth)
    for k, (label, (value, std)) in enumerate(estimate.parameters.items()):
        assert abs(value - exact[k]) < 4 * std, label
        assert std < 0.1, label
