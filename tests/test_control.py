"""Reduced models agree with full models; filters, controllers and control loops that use them."""

from dataclasses import replace
from datetime import datetime, timedelta
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
import livepde.control as ct
from livepde.stepping import ForwardStage
from livepde.verdict import Finding, Verdict

PERIOD, ROOM = 60.0, 20.0
SENSORS = lp.Points({"T_5": 0.05, "T_10": 0.10}, noise=0.2)
OUTPUTS = lp.Points({"face": 0.0, "tip": 0.15})
needs_mpc = pytest.mark.skipif(find_spec("do_mpc") is None, reason="do-mpc is not installed")


def rod(cells: int = 20, **options: Any) -> lp.Model:
    """Return a rod with a heat flux at the left and a cooled boundary at the right."""
    mesh = lp.interval(0.0, 0.15, cells)
    given = {
        "A": lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        "B": lambda u, v, x: 2000.0 * u * v,
        "f": [
            lambda x, _: 2000.0 * x.inputs["room"],
            lp.On("left", lambda x, _: 60e3 * x.inputs["heater"]),
        ],
        **options,
    }
    return lp.Model(
        state=lp.Field(mesh, ElementLineP1()),
        parameter={"k": lp.LogNormal(20.0, std=10.0)},
        M=lambda u, v, x: 3.6e6 * u * v,
        time_unit="s",
        **{"inputs": ["heater", "room"], **given},
    )


def reduced(**options: Any) -> ct.ReducedModel:
    return ct.reduce(rod(), OUTPUTS, ["heater"], sensors=SENSORS, u=ROOM, **options)


GOAL = ct.Goal(track={"tip": 1.0}, move={"heater": 500.0}, inputs={"heater": (0.0, 1.0)})


def identifier(**options: Any) -> lp.Identifier:
    given = {
        "law": lp.SensitivityLaw(refit=lp.laws.Refit(start=4), shadows=None),
        "between": {"heater": "next", "room": "next"},
        "scheme": lp.Alexander2(),
        **options,
    }
    return lp.Identifier(rod(), SENSORS, u0=ROOM, **given)


class Plant:
    """Simulated rod with a different conductivity."""

    def __init__(self, k: float = 26.0) -> None:
        self.model, self.q = rod(), np.log([k])
        self.u, self.t = self.model.initial(ROOM), 0.0
        self.rng = np.random.default_rng(0)

    def run(self, heater: float) -> None:
        times = [self.t, self.t + PERIOD]
        control = lp.Advance(lp.Alexander2(), PERIOD / 4)
        held = {"heater": heater, "room": ROOM}
        *_, (self.t, self.u) = lp.simulate(
            self.model, self.q, self.u, times, control, lambda t: held
        )

    def measure(self) -> Any:
        exact = np.interp([0.05, 0.10], self.model.mesh.p[0], self.u)
        return exact + self.rng.normal(0.0, 0.2, 2)


def drive(loop: ct.Loop, plant: Plant, count: int) -> list[ct.Action]:
    found = []
    for _ in range(count):
        z = plant.measure()
        found.append(loop.step(plant.t, z, {"room": ROOM}, reference={"tip": 45.0}))
        plant.run(found[-1].inputs["heater"])
    return found


# --- reduced model -------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [8.0, 20.0, 50.0])
def test_one_reduced_model_serves_all_conductivities(k):
    """Seven coordinates replace 21 nodes; the conductivity remains a parameter."""
    model = reduced(modes=2)
    assert model.size <= 8
    assert max(model.error({"k": k}, h=PERIOD).values()) < 0.01
    rebuilt = model.about(q=np.array([k]))
    for one, other in zip(model.system(np.array([k])), rebuilt.system(np.array([k])), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_steady_states_at_the_prior_are_exact():
    model, q = reduced(), np.array([20.0])
    K, E, f = model.system(q)
    x = np.linalg.solve(K, E @ [0.4, ROOM] + f)
    full, u = rod(), rod().initial(ROOM)
    times = np.linspace(0.0, 1e6, 200).tolist()
    held = {"heater": 0.4, "room": ROOM}
    control = lp.Advance(lp.ImplicitEuler())
    *_, (_, u) = lp.simulate(full, np.log(q), u, times, control, lambda t: held)
    np.testing.assert_allclose(model.lift(x, held), u, rtol=1e-4)
    np.testing.assert_allclose(model.project(u), x, atol=1e-4 * np.abs(x).max())


def test_a_boundary_value_may_be_a_control_that_jumps():
    """Boundary values enter without their time derivative."""
    mesh = lp.interval(0.0, 1.0, 16)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Channel("hot"), "right": 1.0}),
        {"a": lp.Normal(0.5, 0.2)},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
    )
    small = ct.reduce(model, lp.Points({"middle": 0.5, "end": 0.0}), ["hot"], modes=13)
    x = small.project(model.impose(np.ones(17), lp.fem.Moment(0.0, {"hot": 1.0})))
    step, q = small.matrices(np.array([0.7]), 0.05), np.array([0.7])
    forward, scheme = ForwardStage(model), lp.Alexander2()
    u = model.impose(np.ones(17), lp.fem.Moment(0.0, {"hot": 1.0}))
    for k in range(8):
        hot = 3.0 if k < 4 else -1.0
        held = {"hot": hot}

        def stage(c: Any, t: float, h: float, moment: Any = lp.fem.Moment(0.0, held)) -> Any:  # noqa: B008
            return forward.solve(c, q, h, moment)

        for _ in range(100):
            u = scheme.advance(stage, u, 0.0, 0.0005)
        x = step(x, np.array([hot]))
        seen = small.outputs(x, np.array([hot]))
        np.testing.assert_allclose(seen[0], u[8], atol=1e-4)
        assert seen[1] == pytest.approx(hot, abs=0.2)
        np.testing.assert_allclose(small.lift(x, held)[[0, 16]], [hot, 1.0], atol=1e-9)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"f": lambda x, t: 1.0 + np.sin(t)}, "reads the time"),
        ({"B": lambda u, v, x: x.inputs["heater"] * u * v}, "multiplies the state"),
        ({"f": lambda x, _: x.inputs["heater"] ** 2}, "not linear in its input channels"),
        (
            {"A": lambda q, u, v, x: (q.k + q.k**2) * lp.dot(lp.grad(u), lp.grad(v))},
            "not linear in its unknown numbers",
        ),
    ],
)
def test_models_without_a_reduced_model_are_refused(options, says):
    with pytest.raises(lp.errors.ModelError, match=says):
        ct.reduce(rod(**options), OUTPUTS, ["heater"])


@pytest.mark.parametrize(
    ("outputs", "says"),
    [
        (
            lp.observation.Functionals(
                {"flux": lp.On("right", lambda q, u, x: -q.k * lp.dot(lp.grad(u), x.normal))}
            ),
            "'flux' depends on unknowns",
        ),
        (lp.Points({"T": 0.1}, direct={"T": lambda q, x: q.k}), "'T' depends on unknowns"),
        (
            lp.observation.Transformed(lp.Points({"P": 0.1}), function=lambda T: (T + 273.15) ** 4),
            "'P' is not linear in the state",
        ),
    ],
)
def test_an_output_that_would_stay_at_the_prior_or_at_zero_is_refused(outputs, says):
    with pytest.raises(lp.errors.ModelError, match=says):
        ct.reduce(rod(), outputs, ["heater"], sensors=SENSORS)


def test_a_nonlinear_output_is_linearised_at_the_stated_state():
    radiation = lp.observation.Transformed(lp.Points({"P": 0.1}), function=lambda T: T**4)
    small = ct.reduce(rod(), radiation, ["heater"], sensors=SENSORS, u=300.0)
    y = small.outputs(small.project(np.full(21, 301.0)), np.zeros(2))
    assert y[0] == pytest.approx(300.0**4 + 4 * 300.0**3, rel=1e-6)


def test_a_nonlinear_model_is_linearised_at_the_stated_state():
    model = rod(B=lambda u, v, x: 1e-5 * u**4 * v)
    small = ct.reduce(model, OUTPUTS, ["heater"], u=100.0)
    moved = small.about(u=model.initial(60.0))
    for one, u in ((small, 100.0), (moved, 60.0)):
        K, E, f = one.system(np.array([20.0]))
        x = one.project(model.initial(u))
        rate = one.outputs.C @ (-K @ x + E @ [0.0, ROOM] + f)
        assert rate[1] == pytest.approx((2000.0 * ROOM - 1e-5 * u**4) / 3.6e6, rel=0.05)


def warm_conductor() -> lp.Model:
    """Return u_t = (D0 (1 + b u) u_x)_x with u = hot at the left and 0 at the right."""
    mesh = lp.interval(0.0, 1.0, 16)
    return lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Channel("hot"), "right": 0.0}),
        {"b": lp.Normal(0.5, 0.2)},
        A=lambda q, u, v, x: 0.1 * q.b * u * lp.dot(lp.grad(u), lp.grad(v)),
        B=lambda u, v, x: 0.1 * lp.dot(lp.grad(u), lp.grad(v)),
    )


def test_a_nonlinear_model_requires_a_state_to_linearise_at():
    seen = lp.Points({"middle": 0.5})
    with pytest.raises(lp.errors.ConfigurationError, match="name that with u="):
        ct.reduce(warm_conductor(), seen, ["hot"])
    with pytest.raises(lp.errors.ModelError, match="'b' has no effect on the model linearised"):
        ct.reduce(warm_conductor(), seen, ["hot"], u=0.0)


def test_a_linearised_model_has_the_response_of_the_exact_steady_state():
    """In a steady state u + b u^2/2 is linear in x, which gives exact derivatives."""
    b, hot = 0.5, 1.0

    def steady(x: Any) -> Any:
        return (np.sqrt(1.0 + 2.0 * b * (hot + b * hot**2 / 2) * (1.0 - x[0])) - 1.0) / b

    seen = lp.Points({"middle": 0.5})
    small = ct.reduce(warm_conductor(), seen, ["hot"], u=steady, inputs={"hot": hot})

    def middle(value: float, control: float) -> float:
        K, E, f = small.system(np.array([value]))
        c = np.array([control])
        return float(small.outputs(np.linalg.solve(K, E @ c + f), c)[0])

    u = float(steady([0.5]))
    by_hot = 0.5 * (1.0 + b * hot) / (1.0 + b * u)
    by_b = (hot**2 / 4.0 - u**2 / 2.0) / (1.0 + b * u)
    assert middle(b, hot) == pytest.approx(u, rel=1e-3)
    assert middle(b, hot + 0.1) - middle(b, hot) == pytest.approx(0.1 * by_hot, rel=1e-2)
    assert middle(b + 1e-3, hot) - middle(b, hot) == pytest.approx(1e-3 * by_b, rel=1e-2)


def test_the_error_is_relative_to_the_largest_response_to_any_control():
    """Within five seconds a weak heater does not affect the tip, but the room temperature does."""
    sources = [
        lambda x, _: 2000.0 * x.inputs["room"],
        lp.On("left", lambda x, _: 0.06 * x.inputs["heater"]),
    ]
    missed = [
        ct.reduce(rod(f=sources), OUTPUTS, controls, modes=1).error(h=1.0, samples=5)["tip"]
        for controls in (["heater"], ["room"], ["heater", "room"])
    ]
    assert missed[0] > 0.1
    assert missed[2] < 0.01


def test_a_mesh_of_few_cells_is_reduced_to_itself():
    mesh = lp.interval(0.0, 1.0, 2)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Channel("hot"), "right": 1.0}),
        {"a": lp.Normal(0.5, 0.2)},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
    )
    small = ct.reduce(model, lp.Points({"middle": 0.5}), ["hot"])
    assert small.size == 1
    assert small.error({"a": 0.9}, h=0.05)["middle"] < 1e-3


def kalman(**options: Any) -> ct.Kalman:
    return ct.Kalman(reduced(modes=1), **{"period": PERIOD, "drive": {}, **options})


def reduction(**options: Any) -> ct.ReducedModel:
    return ct.reduce(rod(), OUTPUTS, **{"controls": ["heater"], **options})


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: reduction(controls=["heater", "heater"]), "each once"),
        (lambda: reduction(controls="heater"), r"controls='heater'.*give a list"),
        (lambda: reduction(controls=["valve"]), r"controls=\['valve'\]; the channels"),
        (lambda: reduction(inputs={"wind": 1.0}), "inputs names 'wind'"),
        (lambda: reduction(inputs={"room": np.nan}), r"inputs\['room'\] must be a finite number"),
        (lambda: reduction(modes=2.5), "modes must be a whole number"),
        (lambda: reduction(rates=(-1.0,)), "rates must be positive"),
        (lambda: reduction(u=np.nan), "u is not finite"),
        (lambda: reduced().error({"c": 1.0}, h=PERIOD), r"q names 'c'; the unknown numbers are"),
        (lambda: reduced().error(h=-1.0), "h must be positive"),
        (lambda: replace(GOAL, inputs={"heater": (0.0, 1.0, 2.0)}), "least < largest"),
        (lambda: replace(GOAL, inputs={"heater": (None, 1.0)}), "least < largest"),
        (lambda: replace(GOAL, price={"heater": np.nan}), r"price\['heater'\] must be a number"),
        (lambda: replace(GOAL, penalty=-1.0), "penalty must be at least 0"),
        (lambda: replace(GOAL, track={"tip": "much"}), r"track\['tip'\] must be a positive number"),
        (lambda: replace(GOAL, track=["tip"]), "track must be a mapping"),
        (lambda: kalman(q={"c": 1.0}), "q names 'c'"),
        (lambda: kalman(q={"k": -1.0}), r"q\['k'\] must be a number from 0 to inf"),
        (lambda: kalman(period=0.0), "period must be a positive number"),
        (lambda: kalman(drive={"heater": np.nan}), "deviation of 'heater' must be a number"),
        (lambda: kalman(x=[1.0]), "x has shape"),
        (lambda: ct.Trust(spread=np.nan), "Trust: spread must be"),
        (lambda: ct.Trust(misfit=0.0), "Trust: misfit must be"),
        (lambda: ct.Trust(patience=1.5), "Trust: patience must be"),
        (lambda: ct.LQ(reduced(), replace(GOAL, track={"end": 1.0}), PERIOD), "track names 'end'"),
        (
            lambda: ct.LQ(reduced(), replace(GOAL, track={}, price={"heater": 1.0}), PERIOD),
            "no positive weight",
        ),
        (
            lambda: ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD), before={"valve": 1.0}),
            "before names 'valve'",
        ),
    ],
)
def test_invalid_arguments_are_refused(build, says):
    with pytest.raises(lp.errors.ConfigurationError, match=says):
        build()


@pytest.mark.slow
@needs_mpc
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"horizon": 2.5}, "horizon must be a whole number"),
        ({"kappa": np.inf}, "kappa must be a number"),
        ({"period": 0.0}, "period must be a positive number"),
    ],
)
def test_invalid_settings_of_mpc_are_refused(options, says):
    with pytest.raises(lp.errors.ConfigurationError, match=says):
        ct.MPC(reduced(modes=2), GOAL, **{"period": PERIOD, **options})


# --- filter --------------------------------------------------------------------------------------


def test_the_filter_equals_the_kalman_filter():
    """Compare with the textbook recursion, with the gain from the information form."""
    model = reduced(modes=1)
    q, rng = np.array([20.0]), np.random.default_rng(0)
    found = ct.Kalman(model, PERIOD, drive={"heater": 0.1})
    step, C, R = model.matrices(q, PERIOD), model.sensors.C, 0.04 * np.eye(2)
    gained = 0.01 * np.outer(step.B[:, 0], step.B[:, 0])
    gained += 1e-12 * np.trace(gained) * np.eye(model.size)
    x, P = model.start, gained
    inputs = {"heater": 0.3, "room": ROOM}
    for k in range(20):
        z = np.array([30.0, 25.0]) + rng.normal(0.0, 0.2, 2)
        if k:
            x, P = step(x, np.array([0.3, ROOM])), step.A @ P @ step.A.T + gained
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        x, P = x + gain @ (z - model.sensors(x, np.array([0.3, ROOM]))), P - gain @ C @ P
        known = found.step(k * PERIOD, z, inputs)
        np.testing.assert_allclose(known.x, x, rtol=1e-5, atol=1e-4 * np.abs(x).max())


def test_a_late_sample_is_predicted_over_its_whole_interval():
    model, inputs = reduced(modes=1), {"heater": 0.3, "room": ROOM}
    nothing, ends = np.full(2, np.nan), []
    for times in ([0.0, 60.0, 120.0, 180.0], [0.0, 180.0]):
        one = ct.Kalman(model, PERIOD, drive={"heater": 0.1}, offset={"room": 0.1})
        ends.append([one.step(t, nothing, inputs).x for t in times][-1])
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-9)
    with pytest.raises(lp.errors.TimeOrderError, match="not later"):
        one.step(180.0, nothing, inputs)


def test_readings_with_their_noise_have_the_same_effect_in_each_form():
    """The identifier once accepted such samples by name, while the filter refused them."""
    inputs, (one, two) = {"heater": 0.3, "room": ROOM}, SENSORS.names(2)
    forms = [
        lambda a, b: [[a, 0.5], [b, np.nan]],
        lambda a, b: {one: (a, 0.5), two: b},
        lambda a, b: {one: a, two: b, f"noise of {one}": 0.5},
    ]
    found = []
    for form in forms:
        nominal = ct.Kalman(reduced(), PERIOD, drive={"heater": 0.1})
        learned, alone = ct.Learned(identifier(), nominal), ct.Kalman(reduced(), PERIOD, drive={})
        for k in range(3):
            z = form(20.0 + k, 20.0)
            last = learned.step(PERIOD * k, z, inputs).x, alone.step(PERIOD * k, z, inputs).x
        found.append(np.concatenate([*last, learned.estimate.q]))
    np.testing.assert_array_equal(found, found[:1] * 3)


def test_samples_of_the_filter_are_checked():
    one, inputs = ct.Kalman(reduced(), PERIOD, drive={}), {"heater": 0.3, "room": ROOM}
    with pytest.raises(lp.errors.SampleError, match="unknown channel 'T_6'"):
        one.step(0.0, {"T_6": 20.0}, inputs)
    for z in ([1.0, 2.0, 3.0], ["hot", 1.0]):
        with pytest.raises(lp.errors.SampleError, match="z"):
            one.step(0.0, z, inputs)
    by_name = one.step(0.0, {"T_10": 20.0}, inputs).x
    other = ct.Kalman(reduced(), PERIOD, drive={})
    assert other.step(0.0, [np.nan, 20.0], inputs).x.tolist() == by_name.tolist()


@pytest.mark.long
def test_an_offset_removes_the_lasting_error_at_a_sensor():
    model, plant = reduced(), Plant(40.0)
    plain = ct.Kalman(model, PERIOD, drive={"heater": 0.001})
    free = ct.Kalman(model, PERIOD, drive={"heater": 0.001}, offset={"heater": 0.01})
    inputs, missed = {"heater": 0.3, "room": ROOM}, []
    for _ in range(200):
        plant.run(0.3)
        z = plant.measure()
        missed.append([e.step(plant.t, z, inputs).x for e in (plain, free)])
    late = np.array([[z_of(model, x) for x in pair] for pair in missed[-50:]]).mean(axis=0)
    exact = np.interp(0.05, plant.model.mesh.p[0], plant.u)
    assert abs(late[0] - exact) > 5 * abs(late[1] - exact)


def z_of(model: ct.ReducedModel, x: Any) -> float:
    return float(model.sensors(x, np.array([0.3, ROOM]))[0])


# --- controllers ---------------------------------------------------------------------------------


def optimum(
    model: ct.ReducedModel, goal: ct.Goal, x: Any, q: Any, before: float, count: int
) -> float:
    """Return the first of the optimal moves without bounds, by one least-squares fit."""
    step, rows, targets = model.matrices(q, PERIOD), [], []
    C, weight = model.outputs.C[1], np.sqrt(goal.move["heater"])
    changes = np.tri(count)  # maps changes to values

    def tip(values: Any) -> Any:
        seen, at = [], x
        for value in values:
            at = step(at, np.array([value, ROOM]))
            seen.append(C @ at)
        return np.array(seen)

    base = tip(np.full(count, before))
    for k in range(count):
        rows.append(tip(before + changes[:, k]) - base)
        targets.append(45.0 - base[k])
    A = np.vstack([np.array(rows).T, weight * np.eye(count)])
    moves = np.linalg.lstsq(A, np.concatenate([targets, np.zeros(count)]), rcond=None)[0]
    return float(before + moves[0])


def known(model: ct.ReducedModel, deviation: float = 0.0) -> ct.Known:
    x = model.project(rod().initial(40.0))
    return ct.Known(x, np.array([20.0]), np.array([[deviation]]))


def plan(count: int, limits: int = 0) -> ct.Plan:
    far = np.full((count, limits), np.inf)
    return ct.Plan(np.full((count, 1), 45.0), np.full((count, 1), ROOM), -far, far)


@pytest.mark.slow
def test_the_linear_quadratic_controller_is_optimal():
    model = reduced()
    free = replace(GOAL, inputs={})
    controller = ct.LQ(model, free, PERIOD)
    found = controller.decide(known(model), plan(1), np.array([0.2]), controller.start())
    expected = optimum(model, free, known(model).x, np.array([20.0]), 0.2, 300)
    assert found.inputs[0] == pytest.approx(expected, abs=1e-3)
    assert abs(expected - 0.2) > 0.02


def test_a_state_that_is_not_finite_holds_the_inputs():
    model = reduced()
    controller = ct.LQ(model, GOAL, PERIOD)
    lost = replace(known(model), x=np.full(model.size, np.nan))
    found = controller.decide(lost, plan(1), np.array([0.37]), controller.start())
    assert found.inputs.tolist() == [0.37]
    assert "held" in found.status


def test_the_target_meets_the_reference_or_stays_within_the_range():
    model = reduced()
    controller = ct.LQ(model, GOAL, PERIOD)
    step = model.matrices(np.array([20.0]), PERIOD)
    for reference in (45.0, 1000.0):
        x, v = controller.target(step, np.array([reference]), np.array([ROOM]))
        np.testing.assert_allclose(step(x, np.array([v[0], ROOM])), x, rtol=1e-6)
        tip = model.outputs(x, np.array([v[0], ROOM]))[1]
        assert tip == pytest.approx(reference) if reference < 100.0 else v[0] == 1.0


def test_a_control_replaces_another_control_at_its_bound():
    """Compare with the best steady state within the ranges, from an exhaustive search."""
    sources = [
        lambda x, _: 2000.0 * x.inputs["room"],
        lp.On("left", lambda x, _: 60e3 * x.inputs["heater"]),
        lp.On("right", lambda x, _: 60e3 * x.inputs["second"]),
    ]
    model = rod(f=sources, inputs=["heater", "second", "room"])
    small = ct.reduce(model, OUTPUTS, ["heater", "second"], sensors=SENSORS, u=ROOM)
    goal = ct.Goal(
        track={"tip": 1.0, "face": 1.0},
        move={"heater": 1.0, "second": 1.0},
        inputs={"heater": (0.0, 1.0), "second": (0.0, 0.04)},
    )
    step, wanted = small.matrices(np.array([20.0]), PERIOD), np.array([50.0, 50.0])
    x, v = ct.LQ(small, goal, PERIOD).target(step, wanted, np.array([ROOM]))

    def missed(v: Any) -> float:
        c = np.array([*v, ROOM])
        steady = np.linalg.solve(np.eye(small.size) - step.A, step.B @ c + step.f)
        return float(np.sum((small.outputs(steady, c) - 50.0) ** 2))

    tried = [(a, b) for a in np.linspace(0.0, 1.0, 201) for b in np.linspace(0.0, 0.04, 5)]
    assert missed(v) <= min(missed(pair) for pair in tried)
    assert v[1] == 0.04
    assert 0.0 < v[0] < 1.0
    np.testing.assert_allclose(step(x, np.array([*v, ROOM])), x, rtol=1e-6)


@pytest.mark.slow
@needs_mpc
def test_the_predictive_controller_is_optimal_without_active_bounds():
    model = reduced(modes=2)
    controller = ct.MPC(
        model, replace(GOAL, inputs={"heater": (-9.0, 9.0)}), PERIOD, horizon=25, kappa=0.0
    )
    found = controller.decide(known(model), plan(25), np.array([0.2]), controller.start())
    expected = optimum(model, GOAL, known(model).x, np.array([20.0]), 0.2, 25)
    assert found.status == "ok"
    assert found.inputs[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
@needs_mpc
def test_limits_are_kept_for_all_likely_conductivities():
    """A larger uncertainty makes the controller more cautious; infeasible limits are relaxed."""
    model = reduced(modes=2)
    limited = replace(GOAL, limits={"face": (-np.inf, 75.0)}, move={"heater": 1.0})
    controller = ct.MPC(model, limited, PERIOD, horizon=10)
    ahead = replace(plan(10), low=np.full((10, 1), -np.inf), high=np.full((10, 1), 75.0))
    inputs = []
    for deviation in (0.0, 4.0):
        now = known(model, deviation)
        found = controller.decide(now, ahead, np.array([0.0]), controller.start())
        inputs.append(found.inputs[0])
        for q in now.scenarios(2.0, 1):
            k = model.shifted(now.q, q - now.q)
            after = model.matrices(k, PERIOD)(now.x, np.array([found.inputs[0], ROOM]))
            assert model.outputs(after, np.array([found.inputs[0], ROOM]))[0] < 75.01
    assert 0.0 < inputs[1] < inputs[0] - 0.02
    beyond = replace(ahead, high=np.full((10, 1), 30.0))
    found = controller.decide(known(model), beyond, np.array([0.5]), controller.start())
    assert found.status == "ok"
    assert found.inputs[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
@needs_mpc
def test_scenarios_have_positive_conductivities():
    """Two standard deviations of 30 below 20 would be a negative conductivity."""
    model = reduced(modes=2)
    controller = ct.MPC(model, GOAL, PERIOD, horizon=5)
    found = controller.decide(known(model, 30.0), plan(5), np.array([0.2]), controller.start())
    k = np.array(controller.problem.uncertain.master).reshape(3, -1)
    least = model.matrices(np.array([2.0]), PERIOD).A
    np.testing.assert_allclose(k[2, : model.size**2], least.ravel("F"))
    assert found.status == "ok"


@pytest.mark.slow
@needs_mpc
def test_scenarios_are_deviations_of_the_gaussian_coordinate():
    """For the logarithm, a standard deviation of 12 at 20 is a factor of exp(0.6)."""
    model = reduced(modes=2)
    controller = ct.MPC(model, GOAL, PERIOD, horizon=5)
    controller.decide(known(model, 12.0), plan(5), np.array([0.2]), controller.start())
    rows = np.array(controller.problem.uncertain.master).reshape(3, -1)[:, : model.size**2]
    for k in 20.0 * np.exp([0.0, 1.2, -1.2]):
        expected = model.matrices(np.array([k]), PERIOD).A.ravel("F")
        assert np.abs(rows - expected).max(axis=1).min() < 1e-9


@pytest.mark.slow
@needs_mpc
def test_a_failed_optimisation_holds_the_inputs_and_reports_it():
    model = reduced(modes=2)
    controller = ct.MPC(model, GOAL, PERIOD, horizon=5)
    lost = replace(known(model), x=np.full(model.size, np.nan))
    found = controller.decide(lost, plan(5), np.array([0.37]), controller.start())
    assert found.inputs.tolist() == [0.37]
    assert "Ipopt" in found.status
    assert "held" in found.status
    again = controller.decide(known(model), plan(5), np.array([0.37]), found.memory)
    assert again.status == "ok"


def test_a_missing_do_mpc_is_reported(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "do_mpc", None)
    with pytest.raises(lp.errors.ConfigurationError, match=r"pip install 'livepde\[control\]'"):
        ct.MPC(reduced(), GOAL, PERIOD)


# --- trust ---------------------------------------------------------------------------------------


def estimate_for_trust(**changes: Any) -> Any:
    """Return an estimate with the attributes that `Trust` reads."""
    given = {
        "status": lp.laws.Status(),
        "diagnostics": lp.laws.Diagnostics(innovation_ratio=1.2),
        "q": np.array([26.0]),
        "q_std": np.array([1.0]),
        "verdict": Verdict.of(()),
        **changes,
    }
    return SimpleNamespace(**given)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({}, ""),
        ({"status": lp.laws.Status("singular", "no way")}, "the step failed"),
        (
            {"diagnostics": lp.laws.Diagnostics(innovation_ratio=9.0)},
            "innovations are 3.0 times as large as expected; check `dt_max`",
        ),
        ({"q_std": np.array([20.0])}, "known to 20 only"),
        ({"q_std": np.array([np.nan])}, "only"),
        ({"q_std": None}, "no covariance"),
        ({"q": np.array([0.0]), "q_std": np.array([0.0])}, "lies at its bound"),
        ({"verdict": Verdict.of([Finding("flat", "caution", "f")])}, ""),
        ({"verdict": Verdict.unjudged()}, ""),  # with few samples, the innovations are the test
        (
            {"verdict": Verdict.unjudged(), "diagnostics": lp.laws.Diagnostics()},
            "Not judged: the model was not tested",
        ),
    ],
)
def test_an_estimate_is_trusted_only_where_all_tests_pass(changes, says):
    doubt = ct.Trust().doubt(estimate_for_trust(**changes), reduced())
    assert says in doubt
    assert bool(doubt) == bool(says)


def test_the_uncertainty_of_a_signed_unknown_is_relative_to_its_prior():
    """A source of 0.01 ± 0.1 is well determined if its prior standard deviation is 1."""
    mesh = lp.interval(0.0, 1.0, 8)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Channel("hot")}),
        {"s": lp.Normal(0.0, std=1.0)},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    small = ct.reduce(model, lp.Points({"middle": 0.5}), ["hot"])
    for std, doubt in ((0.1, ""), (0.4, "s = 0.01 is known to 0.4 only")):
        estimate = estimate_for_trust(q=np.array([0.01]), q_std=np.array([std]))
        assert ct.Trust().doubt(estimate, small) == doubt


@pytest.mark.slow
def test_without_trust_the_loop_acts_as_the_nominal_model_would():
    model = reduced()
    controller = ct.LQ(model, GOAL, PERIOD)
    never = ct.Loop(identifier(), controller, ct.Trust(spread=1e-9), drive={"heater": 0.1})
    fixed = ct.Loop(ct.Kalman(model, PERIOD, drive={"heater": 0.1}), controller)
    mine, theirs = (drive(loop, Plant(), 12) for loop in (never, fixed))
    assert [a.inputs for a in mine] == [a.inputs for a in theirs]
    assert all(a.source == "fallback" and "known to" in a.why for a in mine)
    assert mine[-1].estimate.parameters["k"][0] == pytest.approx(26.0, rel=0.1)


@pytest.mark.slow
def test_estimates_are_used_after_some_good_samples():
    loop = ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD), ct.Trust(patience=4))
    found = drive(loop, Plant(), 60)
    first = [a.source for a in found].index("estimate")
    assert all(a.source == "estimate" and not a.why for a in found[first:])
    assert "4 good samples" in found[first - 1].why
    assert found[-1].known.q[0] == pytest.approx(26.0, rel=0.03)
    assert found[-1].outputs["tip"] == pytest.approx(45.0, abs=0.3)
    assert all(0.0 <= a.inputs["heater"] <= 1.0 for a in found)


# --- loop ----------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("kind", ["LQ", pytest.param("MPC", marks=needs_mpc)])
def test_a_loop_resumes_from_its_saved_state(kind, tmp_path):
    def loop() -> ct.Loop:
        model = reduced(modes=2)
        controller = (
            ct.LQ(model, GOAL, PERIOD) if kind == "LQ" else ct.MPC(model, GOAL, PERIOD, horizon=8)
        )
        return ct.Loop(identifier(law=lp.SensitivityLaw(jumps=lp.Jumps())), controller)

    whole, plant = loop(), Plant()
    drive(whole, plant, 7)
    whole.save(tmp_path / "loop")
    other = loop()
    other.load(tmp_path / "loop")
    twin = Plant()
    twin.u, twin.t, twin.rng = plant.u, plant.t, np.random.default_rng(1)
    plant.rng = np.random.default_rng(1)
    expected, found = drive(whole, plant, 6), drive(other, twin, 6)
    assert [a.inputs for a in found] == [a.inputs for a in expected]
    assert [a.known.q.tolist() for a in found] == [a.known.q.tolist() for a in expected]
    smaller = ct.Loop(identifier(), ct.LQ(reduced(modes=1), GOAL, PERIOD))
    with pytest.raises(lp.errors.RunError, match="another"):
        smaller.load(tmp_path / "loop")


def test_the_loop_uses_the_inputs_that_were_really_applied():
    model = reduced()
    loop = ct.Loop(ct.Kalman(model, PERIOD, drive={"heater": 1e-6}), ct.LQ(model, GOAL, PERIOD))
    first = loop.step(0.0, [ROOM, ROOM], {"room": ROOM}, reference={"tip": 45.0})
    stuck = loop.step(PERIOD, [np.nan] * 2, {"heater": 0.0}, reference={"tip": 45.0})
    assert first.inputs["heater"] > 0.5
    assert stuck.outputs["face"] == pytest.approx(ROOM, abs=0.1)


@pytest.mark.slow
def test_an_input_that_is_not_a_number_is_missing():
    """A missing disturbance keeps its last value, a missing control its requested value."""
    ends = []
    for later in ({}, {"room": np.nan, "heater": np.nan}):
        loop = ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD))
        loop.step(0.0, [ROOM] * 2, {"room": 15.0}, reference={"tip": 45.0})
        action = loop.step(PERIOD, [21.0, ROOM], later, reference={"tip": 45.0})
        ends.append((action.inputs["heater"], action.outputs))
    assert ends[0] == ends[1]
    assert np.isfinite(ends[1][0])
    with pytest.raises(lp.errors.SampleError, match="input 'room': got inf"):
        loop.step(2 * PERIOD, [ROOM] * 2, {"room": np.inf}, reference={"tip": 45.0})


@pytest.mark.slow
def test_inputs_may_be_among_the_measurements():
    """As for an identifier; inputs passed separately take precedence."""
    ends = []
    for z, given in (
        ([21.0, 20.0], {"room": 5.0}),
        ({"T_5": 21.0, "T_10": 20.0, "room": 5.0}, None),
        ({"T_5": 21.0, "T_10": 20.0, "room": 9.0}, {"room": 5.0}),
    ):
        for estimator in (identifier(), ct.Kalman(reduced(), PERIOD, drive={"heater": 0.1})):
            loop = ct.Loop(estimator, ct.LQ(reduced(), GOAL, PERIOD))
            loop.step(0.0, [ROOM] * 2, {"room": ROOM}, reference={"tip": 45.0})
            ends.append(loop.step(PERIOD, z, given, reference={"tip": 45.0}).outputs)
    assert ends[0] == ends[2] == ends[4]
    assert ends[1] == ends[3] == ends[5]


class Own:
    """Custom controller that returns or raises a given object."""

    model, goal, period, horizon = reduced(modes=1), GOAL, PERIOD, 1

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def start(self) -> Any:
        return np.zeros(0)

    def decide(self, known: ct.Known, plan: ct.Plan, before: Any, memory: Any) -> ct.Decision:
        if isinstance(self.answer, Exception):
            raise self.answer
        return ct.Decision(np.array(self.answer), "ok", memory)


@pytest.mark.parametrize(
    ("answer", "applied", "set_to", "says"),
    [
        ([0.4], 0.3, 0.4, "ok"),
        ([np.nan], 0.3, 0.3, "the inputs were held"),
        ([np.nan], 7.0, 1.0, "the inputs were held"),
        ([7.0], 0.3, 1.0, "beyond its range"),
    ],
)
def test_a_loop_applies_only_actions_that_actuators_allow(answer, applied, set_to, says):
    loop = ct.Loop(identifier(), Own(answer))
    given = {"room": ROOM, "heater": applied}
    action = loop.step(0.0, [ROOM] * 2, given, reference={"tip": 45.0})
    assert action.inputs == {"heater": set_to}
    assert says in action.status


def test_a_controller_state_that_is_not_finite_is_discarded():
    seen = []

    class Remembers(Own):
        def start(self) -> Any:
            return np.zeros(1)

        def decide(self, known: ct.Known, plan: ct.Plan, before: Any, memory: Any) -> ct.Decision:
            seen.append(memory.tolist())
            return ct.Decision(np.array(self.answer), "ok", np.array(self.answer))

    loop = ct.Loop(identifier(), Remembers([0.5]))
    for k, answer in enumerate([0.5, np.nan, 0.25, 0.25]):
        loop.controller.answer = [answer]
        loop.step(k * PERIOD, [ROOM] * 2, {"room": ROOM}, reference={"tip": 45.0})
    assert seen == [[0.0], [0.5], [0.5], [0.25]]


@pytest.mark.slow
def test_a_row_of_a_pandas_table_is_read_by_name():
    import pandas as pd

    loops = [ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD)) for _ in range(2)]
    named = {"T_10": 23.0, "T_5": 21.0, "room": ROOM}
    for k in range(3):
        one, other = (
            loop.step(k * PERIOD, z, reference={"tip": 45.0})
            for loop, z in zip(loops, (named, pd.Series(named)), strict=True)
        )
    assert one.inputs == other.inputs
    assert one.known.x.tolist() == other.known.x.tolist()


def test_times_of_a_loop_may_be_dates():
    """Dates work as for the identifier; a filter without an identifier has no unit for them."""
    begin, known = datetime(2025, 3, 1, 12), []
    for dated in (False, True):
        loop = ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD))
        for k in range(3):
            t = begin + timedelta(seconds=k * PERIOD) if dated else k * PERIOD
            action = loop.step(t, [21.0, 20.0], {"room": ROOM}, reference={"tip": 45.0})
        assert action.t == 2 * PERIOD
        known.append(action.known.x.tolist())
    assert known[0] == known[1]
    alone = ct.Loop(ct.Kalman(reduced(), PERIOD, drive={}), ct.LQ(reduced(), GOAL, PERIOD))
    with pytest.raises(lp.errors.SampleError, match="time t: got datetime"):
        alone.step(begin, [21.0, 20.0], {"room": ROOM}, reference={"tip": 45.0})


def test_a_loop_continues_after_a_controller_raises():
    loop = ct.Loop(identifier(), Own(ZeroDivisionError("bang")))
    with pytest.raises(ZeroDivisionError, match="bang"):
        loop.step(0.0, [ROOM] * 2, {"room": ROOM, "heater": 0.3}, reference={"tip": 45.0})
    loop.controller.answer = [np.nan]
    action = loop.step(PERIOD, [ROOM] * 2, reference={"tip": 45.0})
    assert action.inputs == {"heater": 0.3}
    loop.controller.answer = [0.1, 0.2]
    with pytest.raises(
        lp.errors.ConfigurationError, match=r"Own.decide returned inputs of shape \(2,\)"
    ):
        loop.step(2 * PERIOD, [ROOM] * 2, reference={"tip": 45.0})


@pytest.mark.slow
def test_a_sample_that_is_refused_changes_nothing():
    loops = [ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD)) for _ in range(2)]
    for loop in loops:
        loop.step(0.0, [ROOM] * 2, {"room": ROOM}, reference={"tip": 45.0})
    for z in ([ROOM] * 3, {"T_6": ROOM}):
        with pytest.raises(lp.errors.SampleError):
            loops[0].step(PERIOD, z, reference={"tip": 45.0})
    with pytest.raises(lp.errors.TimeOrderError):
        loops[0].step(-PERIOD, [ROOM] * 2, reference={"tip": 45.0})
    mine, theirs = (one.step(PERIOD, [21.0, 20.0], reference={"tip": 45.0}) for one in loops)
    assert mine.known.x.tolist() == theirs.known.x.tolist()
    assert mine.estimate.u.tolist() == theirs.estimate.u.tolist()


def test_a_reduced_model_of_another_process_is_refused():
    swapped = lp.Points({"T_10": 0.10, "T_5": 0.05}, noise=0.2)
    other = ct.reduce(rod(), OUTPUTS, ["heater"], sensors=swapped, u=ROOM)
    with pytest.raises(lp.errors.ConfigurationError, match="the identifier has the sensors"):
        ct.Loop(identifier(), ct.LQ(other, GOAL, PERIOD))
    coarse = ct.reduce(rod(10), OUTPUTS, ["heater"], sensors=SENSORS, u=ROOM)
    with pytest.raises(lp.errors.ConfigurationError, match="21 coefficients"):
        ct.Loop(identifier(), ct.LQ(coarse, GOAL, PERIOD))


def test_a_loop_of_another_estimator_is_not_loaded(tmp_path):
    controller = ct.LQ(reduced(), GOAL, PERIOD)
    ct.Loop(ct.Kalman(reduced(), PERIOD, drive={}), controller).save(tmp_path / "loop")
    with pytest.raises(lp.errors.RunError, match="of another estimator"):
        ct.Loop(identifier(), controller).load(tmp_path / "loop")


def test_a_limit_that_the_goal_does_not_have_is_not_dropped():
    """The controller is built with the limits of the goal, so it could not use another limit."""
    limited = replace(GOAL, limits={"face": (-np.inf, 75.0)})
    loop = ct.Loop(identifier(), ct.LQ(reduced(), limited, PERIOD))
    step = {"z": [ROOM] * 2, "inputs": {"room": ROOM}, "reference": {"tip": 45.0}}
    with pytest.raises(lp.errors.SampleError, match="least value, and the goal has none"):
        loop.step(0.0, **step, limits={"face": (10.0, 75.0)})
    with pytest.raises(lp.errors.SampleError, match=r"must be \(least, largest\)"):
        loop.step(0.0, **step, limits={"face": 75.0})
    for ends in ((-np.inf, "hot"), (-np.inf, np.nan)):
        with pytest.raises(lp.errors.SampleError, match=r"limits\['face'\]"):
            loop.step(0.0, **step, limits={"face": ends})
    loop.step(0.0, **step, limits={"face": (-np.inf, np.inf)})
    held = replace(GOAL, limits={"face": (10.0, 75.0)})
    with pytest.raises(lp.errors.SampleError, match="the least value is above the largest"):
        ct.Loop(identifier(), ct.LQ(reduced(), held, PERIOD)).step(
            0.0, **step, limits={"face": (80.0, 70.0)}
        )


@pytest.mark.slow
def test_references_and_forecasts_are_checked():
    loop = ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD))
    z = [ROOM, ROOM]
    with pytest.raises(lp.errors.SampleError, match="'room' has no value yet"):
        loop.step(0.0, z, reference={"tip": 45.0})
    with pytest.raises(lp.errors.SampleError, match="'tip' has none"):
        loop.step(0.0, z, {"room": ROOM})
    with pytest.raises(lp.errors.SampleError, match="forecast names 'heater'"):
        loop.step(0.0, z, {"room": ROOM}, reference={"tip": 1.0}, forecast={"heater": 1.0})
    for given in ("hot", np.inf, [], None, [[45.0]]):
        with pytest.raises(lp.errors.SampleError, match=r"reference\['tip'\]"):
            loop.step(0.0, z, {"room": ROOM}, reference={"tip": given})
    with pytest.raises(lp.errors.SampleError, match="reference must be a mapping"):
        loop.step(0.0, z, {"room": ROOM}, reference=45.0)
    with pytest.raises(lp.errors.SampleError, match=r"forecast\['room'\]"):
        loop.step(0.0, z, {"room": ROOM}, reference={"tip": 1.0}, forecast={"room": np.inf})
    with pytest.raises(lp.errors.ConfigurationError, match=r"before\['heater'\] must be a number"):
        ct.Loop(identifier(), ct.LQ(reduced(), GOAL, PERIOD), before={"heater": np.inf})
    with pytest.raises(lp.errors.SampleError, match="unknown input 'wind'"):
        loop.step(0.0, z, {"wind": ROOM}, reference={"tip": 45.0})
    with pytest.raises(lp.errors.ConfigurationError, match=r"between=\{'room': 'next'\}"):
        ct.Loop(identifier(between={"heater": "next"}), ct.LQ(reduced(), GOAL, PERIOD))


@pytest.mark.slow
def test_held_inputs_do_not_ramp():
    """Several substeps use the input of the sample, as samples with a constant input would."""
    nothing, ends = np.full(2, np.nan), []
    for between, parts in (("next", 1), ("line", 1), ("next", 4)):
        one = identifier(
            between={"heater": between, "room": between},
            scheme=lp.ImplicitEuler(),
            dt_max=15.0 if parts == 1 else np.inf,
        )
        one.step(0.0, [ROOM, ROOM], {"heater": 0.0, "room": ROOM})
        for k in range(1, parts):
            one.step(k * 15.0, nothing, {"heater": 1.0, "room": ROOM})
        ends.append(one.step(60.0, nothing, {"heater": 1.0, "room": ROOM}).u)
    np.testing.assert_allclose(ends[0], ends[2], rtol=1e-9)
    assert ends[1][0] < ends[0][0] - 5.0
