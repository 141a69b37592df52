"""Passes over stored samples by small matrix products equal passes by single stages."""

from typing import Any

import numpy as np
import pytest
from skfem import ElementQuad1

import livepde as lp
from livepde.laws.stored_samples import Passed, StoredSamples
from livepde.stepping import ForwardStage, sweep

PLACES = {"a": 0.2, "b": 0.55, "c": 0.8}
ENDS = {"left": lp.Channel("T_0"), "right": lp.Channel("T_1")}


def conduction(q: Any, u: Any, v: Any, x: Any) -> Any:
    return q.k * lp.dot(lp.grad(u), lp.grad(v))


def flowing(q: Any, u: Any, v: Any, x: Any) -> Any:
    return conduction(q, u, v, x) + q.w * lp.grad(u)[0] * v - 0.3 * (q.w + 1.0) * v


def model(kind: str) -> lp.Model:
    mesh = lp.interval(0.0, 1.0, 14)
    field = lp.Field(mesh, lp.linear(mesh), dirichlet=ENDS)
    k = lp.LogNormal(0.1, std=0.05)
    if kind == "layers":
        layers = {"one": lambda x: x[0] < 0.4, "two": lambda x: x[0] > 0.4}
        return lp.Model(field, {"k": lp.Piecewise(layers, k), "w": lp.Normal(0.0, 0.3)}, A=flowing)
    more = {"off": lp.Normal(0.0, 1.0)} if kind == "offset" else {}
    return lp.Model(field, {"k": k, "w": lp.Normal(0.1, 0.3), **more}, A=flowing)


def stored(kind: str, law: lp.SensitivityLaw, t: Any, first: bool, **parts: Any) -> StoredSamples:
    rng = np.random.default_rng(4)
    noise = [0.1, 0.2, 0.1]
    sensors: lp.observation.Observation = lp.Points(PLACES, noise=noise)
    if kind == "offset":
        sensors = lp.observation.Calibrated(lp.Points(PLACES), lambda y, q, x: y + q.off, noise=0.1)
    identifier = lp.Identifier(model(kind), sensors, law, u0=10.0, **parts)
    for number, time in enumerate(([0.0] if first else []) + t.tolist()):
        row = dict(zip(PLACES, (10.0 + rng.standard_normal(3)).tolist(), strict=True))
        if number % 7 == 3:
            row["b"] = np.nan
        if number % 11 == 5:
            row = dict.fromkeys(PLACES, np.nan)
        inputs = {"T_0": 10.0 + 3.0 * np.sin(time), "T_1": 10.0 + 2.0 * (time > 1.0)}
        identifier.step(float(time), row, inputs)
    return StoredSamples.of(identifier._work, identifier._state)


EVEN = 0.05 * np.arange(1, 25)
PACES = np.cumsum(np.where(np.arange(24) < 12, 0.05, 0.125))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "t", "first", "options", "parts"),
    [
        ("plain", EVEN, True, {}, {}),
        ("plain", PACES, False, {}, {"between": {"T_0": "hold", "T_1": "next"}}),
        ("layers", EVEN, True, {}, {"dt_max": 0.02, "between": {"T_1": "hold"}}),
        ("plain", EVEN[:12], False, {}, {"dt_max": 0.001}),  # intervals of more steps than a block
        ("offset", EVEN, True, {"shadows": None}, {"scheme": lp.ImplicitEuler()}),
        ("plain", PACES, False, {}, {"u0_errors": [1.0, lambda x: x[0]]}),
    ],
)
def test_a_pass_is_that_of_the_stages_one_by_one(
    kind: str, t: Any, first: bool, options: Any, parts: Any, monkeypatch: pytest.MonkeyPatch
):
    law = lp.SensitivityLaw(refit=lp.Refit(start=2, window=100), gate=np.inf, **options)
    samples = stored(kind, law, t, first, **parts)
    r = len(samples.alive)
    points = 0.5 * np.random.default_rng(1).standard_normal((5, r)) * samples.alive
    monkeypatch.setattr(sweep, "BLOCK", 17)
    used = np.isfinite(samples.readings)

    def passed() -> tuple[Passed, Any, Any]:
        one, residuals = samples.about(points[0]), samples.residuals(points[0])
        np.testing.assert_allclose(one.residuals, residuals, rtol=1e-12, atol=1e-12)
        states = np.array([x.u[0] for x in samples.along(one)])
        return one, states, samples.costs(points, used)[0]

    swept, states, costs = passed()
    monkeypatch.setattr(sweep, "WIDEST", 0)
    each, other, others = passed()
    for name in ("residuals", "slopes"):
        np.testing.assert_allclose(getattr(swept, name), getattr(each, name), rtol=1e-9, atol=1e-9)
    for name in ("u", "U"):
        ends = (getattr(one.end, name) for one in (swept, each))
        np.testing.assert_allclose(*ends, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(states, other, rtol=1e-10)
    np.testing.assert_allclose(costs, others, rtol=1e-9)
    assert costs[0] == pytest.approx(swept.cost(used), rel=1e-10)


def test_trajectories_with_a_factor_each_are_followed_one_by_one(monkeypatch):
    """Side by side they would take turns with the one factor that is kept."""
    mesh = lp.fem.rectangle((0.0, 1.0), (0.0, 1.0), (6, 6))
    field = lp.Field(mesh, ElementQuad1(), dirichlet=ENDS)
    k = lp.LogNormal(0.1, std=0.05)
    plate = lp.Model(field, {"k": k, "w": lp.Normal(0.1, 0.3)}, A=flowing)
    sensors = lp.Points({"a": (0.3, 0.4)}, noise=0.1)
    identifier = lp.Identifier(plate, sensors, lp.SensitivityLaw(), u0=10.0)
    for time in (1.0 + 0.25 * np.arange(6)).tolist():
        identifier.step(time, {"a": 10.5}, {"T_0": 12.0, "T_1": 10.0})
    samples = StoredSamples.of(identifier._work, identifier._state)
    made, factorised = [], ForwardStage._factorise

    def noted(stage: ForwardStage, data: Any) -> Any:
        made.append(stage)
        return factorised(stage, data)

    monkeypatch.setattr(ForwardStage, "_factorise", noted)
    points = np.random.default_rng(0).standard_normal((4, len(samples.reached)))
    used = np.isfinite(samples.readings)
    alone = [samples.costs(one[None], used)[0][0] for one in points]
    each, made[:] = len(made), []
    together, _ = samples.costs(points, used)
    assert len(made) <= each
    assert together == pytest.approx(alone, rel=1e-12)
