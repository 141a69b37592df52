"""Stages and states of several members equal those of single members."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1, ElementLineP2

import livepde as lp
from livepde.fem import Inputs, Moment
from livepde.laws.assimilation import absorb
from livepde.linalg.member_arrays import changed, take
from livepde.stepping import BandedStage, ForwardStage, KeptFactors, Moments, Span, StageOfMembers

MESH = lp.interval(0.0, 1.0, 14)


def rod(
    ends: Any,
    f: Any = 0.0,
    A: Any = None,
    element: Any = None,
    inputs: Any = (),
    B: Any = lambda u, v, x: 0.1 * u * v,
) -> lp.Model:
    return lp.Model(
        lp.Field(MESH, element or ElementLineP1(), dirichlet=ends),
        {"a": lp.Normal(0.2, 0.1), "s": lp.Normal(0.5, 0.2)},
        A=A or (lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)) - q.s * v * x[0]),
        B=B,
        f=f,
        inputs=inputs,
    )


MODELS = {
    "fixed ends": rod({"left": 0.0, "right": 2.0}),
    "channels": rod({"left": lp.Channel("T_0"), "right": lp.Channel("T_1")}),
    "ends in time": rod({"left": lambda x, t: np.sin(t) + 0.0 * x[0], "right": 0.0}),
    "no ends": rod({}),
    "source in time": rod({"left": 0.0}, lambda x, t: np.cos(3.0 * t) * x[0]),
    "curved in inputs": rod({"left": 0.0}, lambda x, _: x.inputs["T_0"] ** 2, inputs=["T_0"]),
    "unknown and input": rod(
        {"left": 0.0},
        A=[
            lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
            lambda q, u, v, x: q.s * u * v,
            lambda q, _, v, x: -q.s * x.inputs["T_0"] * v,
        ],
        inputs=["T_0"],
    ),
    "unknown flow of an input": rod(
        {"left": lp.Channel("T_0"), "right": lp.Channel("T_1")},
        A=[
            lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
            lambda q, u, v, x: q.s * (1.0 + 0.1 * x.inputs["w"]) * lp.grad(u)[0] * v,
            lambda q, _, v, x: -q.s * x.inputs["w"] * v,
        ],
        inputs=["w"],
    ),
    "known flow of an input": rod(
        {"left": 20.0, "right": lp.Channel("T_1")},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)) + q.s * (u - x.inputs["T_2"]) * v,
        B=lambda u, v, x: 0.01 * x.inputs["w"] * (lp.grad(u)[0] + u) * v,
        inputs=["w", "T_2"],
    ),
    "known parts of A": rod(
        {"left": lp.Channel("T_0"), "right": 1.0},
        A=lambda q, u, v, x: (
            (1.0 + q.a) * lp.dot(lp.grad(u), lp.grad(v))
            + (q.s + 0.01 * x.inputs["w"]) * lp.grad(u)[0] * v
            - (2.0 + x.inputs["w"] * q.s) * v
        ),
        inputs=["w"],
    ),
    "exchange at an end, by an input": rod(
        {"left": lp.Channel("T_0")},
        B=lp.On("right", lambda u, v, x: 0.01 * x.inputs["h"] * (u - 20.0) * v),
        inputs=["h"],
    ),
    "quadratic elements": rod({"left": 1.0, "right": lp.Channel("T_1")}, element=ElementLineP2()),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("many", [False, True], ids=["one moment", "inputs of each"])
def test_a_banded_stage_gives_the_state_and_tangents_of_each_member(name: str, many: bool):
    model, rng, members, r = MODELS[name], np.random.default_rng(0), 3, 4
    assert BandedStage.refuses(model) == ""
    stage, forward = BandedStage(model), ForwardStage(model)
    if many and stage.refusal:
        assert name == "curved in inputs"
        return
    channels, n = model.channels, model.X.dim
    rows = 300.0 + rng.standard_normal((members if many else 1, len(channels)))
    at = Moments(t=0.7, channels=channels, inputs=rows)
    columns = rng.standard_normal((1 + r, members, n))
    columns[1:, :, model.state_space.fixed] = 0.0  # what is given has no tangent
    q = np.array([0.2, 0.5]) + 0.05 * rng.standard_normal((members, 2))
    directions = rng.standard_normal((members, r, 2))
    off, each = np.ones(members, dtype=bool), np.arange(members)
    work = StageOfMembers(each, q, directions, 0.1, at, stage.kept(members), off, {})
    new, _ = stage.advance(columns, work)
    for k in range(members):
        row = rows[k if many else 0]
        moment = Moment(0.7, Inputs(dict(zip(channels, row.tolist(), strict=True))))
        kept = KeptFactors.none(1).member(0)
        wanted, _ = forward.advance(columns[:, k].T, q[k], directions[k].T, 0.1, moment, kept)
        np.testing.assert_allclose(new[:, k].T, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())


@pytest.mark.parametrize(
    "flow", [lambda x: abs(x.inputs["w"]), lambda x: x.t, lambda x: x.t * x.inputs["w"]]
)
def test_matrices_that_time_or_bent_inputs_change_are_not_kept(flow: Any):
    model = rod({"left": 0.0}, B=lambda u, v, x: flow(x) * lp.grad(u)[0] * v, inputs=["w"])
    assert "depend on time, or on inputs other than linearly" in BandedStage.refuses(model)


@pytest.mark.slow
def test_a_fleet_whose_validation_sensors_read_channels_of_their_own():
    model = rod({"left": lp.Channel("T_0"), "right": 0.0})
    sensors, hidden = lp.Points([0.3, 0.6], noise=0.01), lp.observation.Moving({"probe": "x_p"})
    fleet = lp.Fleet(model, sensors, lp.SensitivityLaw(), 2, validation=hidden)
    for k in range(4):
        inputs = {"T_0": 1.0, "x_p": 0.5}
        assert fleet.step(0.1 * (k + 1), [[0.5, 0.3], [0.4, 0.2]], inputs).ok.all()


def test_members_without_a_reading_step_with_the_others(monkeypatch: pytest.MonkeyPatch):
    alone: list[int] = []
    step = lp.laws.sensitivity.step_alone

    def counted(*given: Any) -> Any:
        alone.append(1)
        return step(*given)

    monkeypatch.setattr("livepde.laws.sensitivity.step_alone", counted)
    model = rod({"left": 1.0, "right": 0.0})
    law = lp.SensitivityLaw(refit=None)  # its iterations are made by each member alone
    fleet = lp.Fleet(model, lp.Points([0.3, 0.6], noise=5.0), law, 2)
    for k in range(5):
        fleet.step(0.1 * (k + 1), [[0.5, 0.3], [np.nan, np.nan]])
    assert not alone


@pytest.mark.long
def test_rows_that_a_member_has_missed_stay_out_of_its_log_after_an_alarm():
    """The log of a member that failed for some samples is that of a run of its own."""
    model = rod({"left": lp.Channel("T_0"), "right": 0.0})
    sensors = lp.Points([0.3, 0.6], noise=0.05)  # with less a diffusivity is negative, u 1e128
    # No model has these readings. A refit would find what is usual for them, and no jump.
    law = lp.SensitivityLaw(jumps=lp.Jumps(settle=5), refit=None)
    fleet = lp.Fleet(model, sensors, law, 2, u0=0.0)
    one = lp.Identifier(model, sensors, law, u0=0.0)
    rng, alarms = np.random.default_rng(0), 0
    for k in range(40):
        t, size = 0.1 * (k + 1), 1.0 if k < 22 else 3.0
        z = size * np.array([0.5, 0.3]) + 0.01 * rng.standard_normal(2)
        end = np.nan_to_num(1e308) if k in (8, 9, 10) else 1.0
        told = fleet.step(t, [z, z], {"T_0": [1.0, end]})
        mine = one.step(t, z, {"T_0": end})
        assert told.statuses[1].code == mine.status.code
        alarms += mine.diagnostics.jump > 0.0
        times = fleet._state.log[1, :, 0]
        times = times[np.isfinite(times)]
        wanted = one._state.log[0, :, 0]
        # That of a fleet is shortened sooner: its members share one length.
        times, wanted = times[times > 0.0], wanted[wanted > 0.0]
        both = min(len(times), len(wanted))
        np.testing.assert_allclose(times[-both:], wanted[-both:])
    assert alarms


def test_each_member_has_its_own_noise_level_and_is_finite_by_itself():
    law = lp.SensitivityLaw(refit=None, shadows=None, verdict=False)
    fleet = lp.Fleet(rod({"left": 0.0}), lp.Points([0.5], noise=0.1), law, 2)
    for k in range(1, 4):
        fleet.step(0.1 * k, [[0.2]] * 2)
    work, x = fleet._work, fleet._state.now

    def absorbed(x: Any, z: float, scale: float = 1.0) -> Any:
        t, values, nothing = np.full(len(x), 0.3), np.full((len(x), 1), z), np.zeros((1, 0))
        span = Span(
            t0=t, t1=0.3, channels=(), inputs0=nothing, inputs1=nothing, z0=values, z1=values
        )
        return absorb(replace(work.filter, noise=scale * work.filter.noise), x, span, work.options)

    louder, _ = absorbed(changed(x, level=np.array([1.0, 4.0])), 0.5)
    for k, scale in enumerate((1.0, 2.0)):  # of four times the variance
        alone, _ = absorbed(take(x, k), 0.5, scale)
        np.testing.assert_allclose(louder.da[k], alone.da[0], rtol=1e-12)
    unsound = changed(x, da=x.da + np.array([[0.0], [np.nan]]))
    assert absorbed(unsound, np.nan)[1].finite.tolist() == [True, False]
