"""Forecasts of sensors leave the estimate unchanged; copies; a controller in the loop."""

import copy

import numpy as np
import pytest
from factories import excited, excited_u, line
from skfem import ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde.models import heat

SENSORS = lp.Points({"a": 0.3, "b": 0.6}, noise=0.01)
HIDDEN = lp.Points({"c": 0.8})
LAWS = {
    "gradient": lp.GradientLaw(gain=10.0, damping=lp.laws.ResidualDamping(c1=1.0)),
    "sensitivity": lp.SensitivityLaw(drift=0.01, jumps=lp.Jumps()),
    "refit": lp.SensitivityLaw(),
}


def rod(law, **unknown):
    model = lp.Model(
        lp.Field(line(10), ElementLineP1(), dirichlet={"left": 0.0, "right": lp.Channel("T_end")}),
        {"k": lp.Scalar(lp.Normal(0.2, std=0.05, bounds=(0.01, 5.0)), **unknown)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, _: x.inputs["heat"],
        inputs=("heat",),
    )
    return lp.Identifier(model, SENSORS, law, validation=HIDDEN)


def plate(law):
    mesh = MeshTri().refined(2).with_boundaries({"left": lambda x: x[0] == 0.0})
    model = lp.Model(
        lp.Field(mesh, ElementTriP1(), dirichlet={"left": lp.Channel("T_end")}),
        {"k": lp.Normal(0.2, std=0.05, bounds=(0.01, 5.0))},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) + 0.1 * u * q.k * v,
        f=lambda x, _: x.inputs["heat"],
        inputs=("heat",),
    )
    sensors = lp.Points({"a": (0.3, 0.4), "b": (0.6, 0.7)}, noise=0.01)
    return lp.Identifier(model, sensors, law, validation=lp.Points({"c": (0.8, 0.2)}))


PAIRS = [("gradient", rod), ("refit", rod), ("sensitivity", plate)]


def samples(count, seed=0):
    rng = np.random.default_rng(seed)
    for k in range(count):
        t = 0.1 * k
        z = {"a": np.sin(t) + 0.01 * rng.normal(), "b": np.cos(t), "c": 0.5}
        yield t, {**z, "T_end": 0.1 * np.sin(3 * t), "heat": 1.0 + 0.5 * np.sin(5 * t)}


def numbers(estimate):
    return [estimate.q, estimate.u, estimate.innovation, estimate.validation_error]


def same(one, other):
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("law", "build"), PAIRS)
def test_a_horizon_is_steps_in_which_nothing_is_measured(law, build):
    identifier = build(LAWS[law])
    for t, z in samples(12):
        identifier.step(t, z)
    times, heat_plan = identifier.t + 0.1 * np.arange(1, 6), np.linspace(0.0, 2.0, 5)
    found = identifier.forecast(times, {"heat": heat_plan})
    other = copy.deepcopy(identifier)
    for k, t in enumerate(times):
        estimate = other.step(t, {"heat": heat_plan[k], "c": 0.0})
        shown = -estimate.validation_error[0]
        assert found["c"][k] == pytest.approx(shown, rel=1e-13)
    assert found.status.ok
    assert np.array_equal(found.z[-1], other.forecast(other.t).z[0])


@pytest.mark.slow
@pytest.mark.parametrize(("law", "build"), PAIRS)
def test_nothing_is_learned_from_a_forecast_or_a_copy(law, build):
    alone, asked = build(LAWS[law]), build(LAWS[law])
    copies = []
    for k, (t, z) in enumerate(samples(8)):
        if k:
            asked.forecast([t, t + 1.0], {"heat": 7.0, "T_end": [3.0, 4.0]})
        if k == 4:
            copies = [copy.deepcopy(asked), copy.deepcopy(asked)]
        one, other = alone.step(t, z), asked.step(t, z)
        assert same(numbers(one), numbers(other))
        if copies:
            copies[0].step(t, {**z, "a": 9.0})  # learns something else, beside the others
            assert same(numbers(copies[1].step(t, z)), numbers(one))
    assert not np.array_equal(copies[0].estimate().u, asked.estimate().u)
    assert copies[0].dump() != copies[1].dump() == asked.dump()


def test_a_forecast_begins_where_nothing_was_measured_yet():
    identifier = rod(LAWS["sensitivity"])
    with pytest.raises(lp.errors.MissingInputError, match="'T_end' has no value"):
        identifier.forecast(1.0, {"heat": 1.0})
    inputs = {"T_end": 1.0, "heat": 1.0}
    found = identifier.forecast(0.5, inputs)
    assert not identifier._so_far.inputs
    with pytest.raises(lp.errors.MissingInputError):
        identifier.estimate()
    identifier.step(0.0, inputs)
    assert np.array_equal(identifier.forecast(0.5).z, found.z)


@pytest.mark.slow
def test_a_sensor_that_moves_is_where_the_last_sample_had_it():
    fixed = rod(LAWS["sensitivity"])
    moving = lp.Identifier(
        fixed.model, SENSORS, fixed.law, validation=lp.observation.Moving({"c": "x"}, noise=0.1)
    )
    for t, z in samples(5):
        moving.step(t, {**z, "x": 0.8})
        fixed.step(t, z)
    times = moving.t + np.array([0.0, 0.1, 0.2])
    now, planned = moving.forecast(times), moving.forecast(times, {"x": [np.nan, 0.8, np.nan]})
    expected = fixed.forecast(times)
    for found, known in ((now, [True, False, False]), (planned, [True, True, False])):
        for each, fixed_one in ((found.z, expected.z), (found.z_std, expected.z_std)):
            assert each[:, :2] == pytest.approx(fixed_one[:, :2], rel=1e-12)
            there = np.where(known, fixed_one[:, 2], np.nan)
            assert each[:, 2] == pytest.approx(there, rel=1e-12, nan_ok=True)
    moving.step(float(times[1]), {"T_end": 1.0, "heat": 0.0})
    assert np.isnan(moving.forecast(times[1])["c"]).all()


@pytest.mark.slow
def test_the_deviation_is_that_of_the_unknown_times_the_derivative():
    """What is known of u0 is exact: all that the sensors may deviate by comes from k."""
    inputs, h = {"T_end": 1.0, "heat": 1.0}, 1e-4
    law = lp.SensitivityLaw(shadows=None)  # whose steps are those of the times
    shown = [
        lp.Identifier(i.model, SENSORS, i.law, validation=HIDDEN, q0={"k": k})
        .forecast([0.1, 0.3], inputs)
        .z
        for i in [rod(law)]
        for k in (0.2 - h, 0.2 + h)
    ]
    found = rod(law).forecast([0.1, 0.3], inputs)
    assert found.z_std == pytest.approx(0.05 * abs(shown[1] - shown[0]) / (2 * h), rel=1e-4)
    assert np.isnan(rod(LAWS["gradient"]).forecast(0.1, inputs).z_std).all()


@pytest.mark.slow
def test_deviations_grow_as_an_unknown_moves():
    """In steps that are not long: in one long step a second-order scheme is not monotone."""
    still, moving = rod(lp.SensitivityLaw()), rod(lp.SensitivityLaw(), evolution=lp.RandomWalk(0.1))
    inputs, times = {"T_end": 1.0, "heat": 1.0}, 0.05 * np.arange(1, 41)
    one, other = (each.forecast(times, inputs).z_std[9:] for each in (still, moving))
    assert (other > 1.1 * one).all()


@pytest.mark.parametrize(
    ("times", "inputs", "error", "words"),
    [
        ([], {}, lp.errors.TimeOrderError, "must increase"),
        ([-1.0], {}, lp.errors.TimeOrderError, "last sample at t = 0.5"),
        ([1.0, 1.0], {}, lp.errors.TimeOrderError, "must increase"),
        ([[1.0]], {}, lp.errors.SampleError, "finite numbers"),
        (np.nan, {}, lp.errors.SampleError, "finite numbers"),
        ("soon", {}, lp.errors.SampleError, "not a number"),
        ([1.0, 2.0], {"heat": [1.0, 2.0, 3.0]}, lp.errors.SampleError, r"'heat' has shape \(3,\)"),
        (1.0, {"heat": np.inf}, lp.errors.SampleError, "'heat': got inf"),
        (1.0, {"cold": 1.0}, lp.errors.SampleError, "unknown input 'cold'"),
    ],
)
def test_a_bad_forecast_is_one_sentence(times, inputs, error, words):
    identifier = rod(LAWS["sensitivity"])
    identifier.step(0.5, {"T_end": 1.0, "heat": 1.0})
    with pytest.raises(error, match=words):
        identifier.forecast(times, inputs)


def test_a_forecast_too_far_away_says_so():
    model = heat(line(10), lp.Normal(0.1, std=0.05))
    identifier = lp.Identifier(model, SENSORS, lp.GradientLaw(), dt_max=1e-3)
    with pytest.raises(lp.errors.SampleError, match="substeps"):
        identifier.forecast(1e6)


def test_a_sensor_that_does_not_exist_is_told():
    model = heat(line(10), lp.Normal(0.1, std=0.05))
    found = lp.Identifier(model, SENSORS, lp.GradientLaw()).forecast(1.0)
    with pytest.raises(lp.errors.SampleError, match="no sensor is called 'T_99'; there are"):
        found["T_99"]


@pytest.mark.slow
def test_a_step_that_fails_is_the_status_of_the_forecast():
    model = lp.Model(
        lp.Field(line(10), ElementLineP1()),
        {"k": lp.Normal(1.0, std=0.5)},
        A=lambda q, u, v, x: q.k * u * v,
        B=lambda u, v, x: -10 * np.exp(u) * v,  # infinite soon after t = 0.01
    )
    identifier = lp.Identifier(model, SENSORS, lp.SensitivityLaw(), u0=2.0)
    found = identifier.forecast([0.001, 1.0, 2.0])
    assert not found.status.ok
    assert np.isfinite(found.z[0]).all()
    assert np.isnan(found.z[1:]).all()
    assert np.isnan(found.z_std[1:]).all()


@pytest.mark.slow
def test_a_controller_acts_on_each_estimate_before_the_next_sample():
    """The plant answers to what the controller did with the estimate of the sample before."""
    model = excited()
    identifier = lp.Identifier(
        model, SENSORS, lp.SensitivityLaw(modes=3), u0=lambda x: excited_u(x, 0.0)
    )
    done = []

    def plant():
        for t in (0.05, 0.1, 0.15):
            done.append(("plant", t))
            yield t, [1.0, 0.5]

    result = identifier.run(plant(), on_estimate=lambda estimate: done.append(("act", estimate.t)))
    assert done == [(who, t) for t in (0.05, 0.1, 0.15) for who in ("plant", "act")]
    assert len(result) == 3


def test_a_controller_ends_a_run_by_raising():
    class Enough(Exception):
        pass

    def controller(estimate):
        if estimate.t > 0.15:
            raise Enough

    identifier = rod(LAWS["sensitivity"])
    with pytest.raises(Enough):
        identifier.run(samples(10), on_estimate=controller)
    assert identifier.t == pytest.approx(0.2)
