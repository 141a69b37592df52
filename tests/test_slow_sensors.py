"""Slow sensors agree with independent finite differences and closed forms."""

import math
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy
from factories import ROD_CASE, filter_alone

import livepde as lp
from livepde import cases
from livepde.cases.proposals import proposed
from livepde.cases.read import parse
from livepde.cases.remedies import freed, held, with_settings
from livepde.cases.variants import Variant, VariantRun
from livepde.errors import CaseError, ConfigurationError, LawError, ModelError, ObservationError
from livepde.models import heat
from livepde.observation import Averages, Moving, Slow
from livepde.stepping import Advance, Alexander2, ForwardStage
from livepde.verdict import Cause, Finding, Verdict

ALPHA, TAU, NOISE = 0.1, 0.5, 0.01
CELLS = 80  # of the truth
TIMES = np.linspace(0.0, 10.0, 201)


def driven(t):
    return np.sin(2.0 * np.pi * t / 5.0)


@cache
def truth():
    """Return the readings of a slow sensor at 0.3 and of an exact one at 0.6, (samples, 2).

    By finite differences for u_t = alpha u_xx, insulated on the right, and the exponential of the
    whole system, in which the driving sine is a state.
    """
    h, w = 1.0 / CELLS, 2.0 * np.pi / 5.0
    n = CELLS + 1
    K = np.zeros((n + 3, n + 3))  # u, the sensor, and sine and cosine
    for i in range(1, CELLS):
        K[i, [i - 1, i, i + 1]] = np.array([1.0, -2.0, 1.0]) * ALPHA / h**2
    K[CELLS, [CELLS - 1, CELLS]] = np.array([2.0, -2.0]) * ALPHA / h**2
    K[n, [round(0.3 / h), n]] = 1.0 / TAU, -1.0 / TAU
    K[0, n + 2], K[n + 1, n + 2], K[n + 2, n + 1] = w, w, -w
    step, x = scipy.linalg.expm(K * (TIMES[1] - TIMES[0])), np.zeros(n + 3)
    x[n + 2], found = 1.0, []
    for _ in TIMES:
        found.append([x[n], x[round(0.6 / h)]])
        x = step @ x
    noise = np.random.default_rng(0).standard_normal((len(TIMES), 2))
    return np.array(found) + NOISE * noise


def rod():
    field = {"left": lp.Channel("g")}
    return heat(lp.interval(0.0, 1.0, 40), lp.LogNormal(0.07, std=0.05), field)


def sensors(time_constant):
    slow = Slow(lp.Points({"a": 0.3}), time_constant)
    return lp.Combined([slow, lp.Points({"b": 0.6})], noise=NOISE)


PRIOR = lp.LogNormal(0.3, std=0.3)


def run(who, rows=None):
    for k in rows or range(len(TIMES)):
        a, b = truth()[k]
        estimate = who.step(TIMES[k], {"a": a, "b": b}, {"g": driven(TIMES[k])})
    return estimate


@pytest.mark.parametrize("time_constant", [TAU, PRIOR])
def test_a_slow_sensor_is_no_error_where_its_time_constant_is_stated(time_constant):
    who = lp.Identifier(rod(), sensors(time_constant), u0=0.0)
    found = who._settled(run(who), columns=False)
    low, high = found["alpha"].interval()
    assert low < ALPHA < high
    assert high - low < 0.03 * ALPHA
    assert found.verdict.level == "trusted"
    if time_constant is PRIOR:
        low, high = found["time_constant[a]"].interval()
        assert low < TAU < high
        assert high - low < 0.06 * TAU
        # An error of a sensor: it does not count in the level.
        errors = {one.label: one for one in found.verdict.errors.unknowns}
        assert errors["time_constant[a]"].of_sensor
        assert not errors["alpha"].of_sensor


def test_a_slow_sensor_that_counts_as_fast_is_doubted():
    exact = lp.Points({"a": 0.3, "b": 0.6}, noise=NOISE)
    assert run(lp.Identifier(rod(), exact, u0=0.0)).verdict.level != "trusted"


def test_gaps_and_irregular_intervals():
    """A sensor responds in gaps of its readings, too."""
    rng, who = np.random.default_rng(4), lp.Identifier(rod(), sensors(PRIOR), u0=0.0)
    kept = np.flatnonzero(rng.random(len(TIMES)) < 0.6)
    for k in kept:
        a, b = np.where(rng.random(2) < 0.8, truth()[k], np.nan)
        found = who.step(TIMES[k], {"a": a, "b": b}, {"g": driven(TIMES[k])})
    for label, value in {"alpha": ALPHA, "time_constant[a]": TAU}.items():
        assert abs(found[label].mean - value) < 3.0 * found[label].std


def test_time_constants_do_not_jump():
    """If they did, an onset that was a sample off moved them by 2.5 standard deviations."""
    runs = []
    for names in (None, ("alpha",)):
        law = filter_alone(jumps=lp.Jumps(settle=10, unknowns=names))
        who = lp.Identifier(rod(), sensors(PRIOR), law, u0=0.0)
        for k in range(60):  # the readings jump
            a, b = truth()[k] * (1.0 if k < 40 else 1.3)
            estimate = who.step(TIMES[k], {"a": a, "b": b}, {"g": driven(TIMES[k])})
            runs.append((estimate.diagnostics.jump, *estimate.q))
    assert runs[:60] == runs[60:]
    assert any(jump > 0.0 for jump, *_ in runs)


@pytest.mark.parametrize("unknown", [False, True])
def test_the_response_to_a_ramp_is_that_of_the_closed_form(unknown):
    """y = t - tau (1 - exp(-t/tau)), of second order in the step."""
    mesh = lp.interval(0.0, 1.0, 4)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh)),
        {"k": lp.Normal(1.0, std=0.1)},
        lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        f=1.0,
    )
    slow = Slow(Averages({"whole": lambda x: x[0] > 0.5}), PRIOR if unknown else TAU)
    model = model.with_unknowns(slow.unknowns).with_sensors(slow.states)
    q = model.initial_parameter({"k": 1.0, **({"time_constant": TAU} if unknown else {})})
    errors = []
    for count in (10, 20, 40):
        times = np.linspace(0.0, 1.0, count + 1)
        states = lp.simulate(model, q, 0.0, times, Advance(Alexander2()))
        u = [u for _, u in states][-1]
        np.testing.assert_allclose(u[:-1], 1.0, rtol=1e-9)  # no sensor changes the process
        errors.append(abs(u[-1] - (1.0 - TAU * (1.0 - np.exp(-1.0 / TAU)))))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (rates > 1.8).all()
    assert errors[-1] < 1e-4


def test_tangents_are_derivatives_of_the_state():
    model = rod().with_unknowns(sensors(PRIOR).unknowns).with_sensors(sensors(PRIOR).states)
    report = lp.diagnostics.check_model(model, inputs={"g": 0.3})
    report.raise_if_failed()
    observed = sensors(PRIOR)
    lp.diagnostics.check_observation(observed, model, inputs={"g": 0.3}).raise_if_failed()
    assert not ForwardStage(model).symmetric


def test_a_start_is_that_of_what_the_sensor_sees():
    model = rod().with_sensors(sensors(TAU).states)
    space = model.state_space
    for start in (2.0, lambda x: 2.0 + x[0], {"u": lambda x: 3.0 * x[0]}):
        u = space.interpolate(start)
        assert u[-1] == pytest.approx(space.probe(np.array([[0.3]])) @ u)
    stated = np.arange(float(space.dim))
    np.testing.assert_array_equal(space.interpolate(stated), stated)  # coefficients of a run
    np.testing.assert_array_equal(space.interpolate(stated[:-1])[:-1], stated[:-1])


def test_members_of_a_fleet_and_resumed_runs_are_single_runs(tmp_path):
    fleet = lp.Fleet(rod(), sensors(PRIOR), lp.SensitivityLaw(), 2, u0=0.0)
    single = [lp.Identifier(rod(), sensors(PRIOR), u0=0.0) for _ in range(2)]
    for k in range(12):
        Z = truth()[k] + [[0.0, 0.0], [0.02 * np.sin(k), 0.0]]
        both = fleet.step(TIMES[k], Z, {"g": driven(TIMES[k])})
        pairs = zip(single, Z, strict=True)
        each = [who.step(TIMES[k], z, {"g": driven(TIMES[k])}) for who, z in pairs]
    for member, one in enumerate(each):
        for label in ("alpha", "time_constant[a]"):
            assert both.member(member)[label].mean == pytest.approx(one[label].mean, rel=1e-7)
    first = single[0]
    first.save(tmp_path / "checkpoint")
    again = lp.Identifier(rod(), sensors(PRIOR), u0=0.0)
    again.load(tmp_path / "checkpoint")
    both = [run(who, range(12, 18))["time_constant[a]"].mean for who in (first, again)]
    assert both[0] == both[1]
    assert run(deepcopy(first), range(18, 20)).status.ok


def test_validation_sensors_may_be_slow():
    """Their time constants are numbers."""
    parts = rod(), lp.Points({"b": 0.6}, noise=NOISE)
    who = lp.Identifier(*parts, u0=0.0, validation=Slow(lp.Points({"a": 0.3}), TAU))
    apart = []
    for k in range(100):
        a, b = truth()[k]
        found = who.step(TIMES[k], {"b": b, "a": a}, {"g": driven(TIMES[k])})
        apart.append(found.validation_error[0])
    assert np.sqrt(np.mean(np.square(apart[50:]))) < 1.3 * NOISE
    with pytest.raises(ConfigurationError, match="'a' is an unknown, which only assimilated"):
        lp.Identifier(*parts, u0=0.0, validation=Slow(lp.Points({"a": 0.3}), PRIOR))


def test_what_cannot_be_slow_says_so():
    points = lp.Points({"a": 0.3})
    for constant in (0.0, -1.0, np.nan, lp.Normal(1.0, std=1.0)):
        with pytest.raises(ObservationError, match="time_constant must be positive"):
            Slow(points, constant)
    with pytest.raises(ObservationError, match="expected Points, Averages or LineIntegrals"):
        Slow(Moving({"a": "x"}), TAU)
    with pytest.raises(ObservationError, match="Leave out position_std and direct"):
        Slow(lp.Points({"a": 0.3}, position_std=0.1), TAU)
    model = rod()
    with pytest.raises(ObservationError, match="no state for the slow sensor 'a'"):
        Slow(points, TAU).bind(model.state_space, model.X, model.parameter_space)
    with pytest.raises(ModelError, match="both called 'u'"):
        model.with_sensors(Slow(lp.Points({"u": 0.3}), TAU).states)
    with pytest.raises(LawError, match="'a' responds slowly: leave out its time constant"):
        lp.Identifier(model, Slow(points, TAU), lp.GradientLaw(), u0=0.0)


# --- case files ---------------------------------------------------------------------------------

CHANNELS = """
[channels]
left = { role = "boundary", column = "left", at = "left" }
near = { role = "sensor", column = "near", at = "30 cm", noise = "0.01 K" }
far = { role = "sensor", column = "far", at = "60 cm", noise = "0.01 K", offset = "0.1 K" }
"""


def case_file(folder):
    rows = ["t,left,near,far"]
    rows += [f"{1000 * k},{20 + k % 5},{20 + 0.1 * k},{20.0}" for k in range(30)]
    (folder / "rows.csv").write_text("\n".join(rows) + "\n")
    path = folder / "case.toml"
    path.write_text(ROD_CASE + CHANNELS)
    return path


def test_a_case_states_time_constants_and_their_priors(tmp_path):
    path, key = case_file(tmp_path), "channels.near.time_constant"
    known = cases.load(path, settings=parse([f"{key}='10 min'"]))
    assert known.model.sensors["near"].time_constant == 600.0
    assert [*known.model.parameter_space.labels] == ["alpha", "offset[far]"]
    setting = f'{key}={{ value = "10 min", std = "5 min" }}'
    unknown = cases.load(path, settings=parse([setting]))
    prior = unknown.model.parameter_space.unknown_of("time_constant[near]")
    assert (prior.prior, prior.unit) == (lp.LogNormal(600.0, std=300.0), "s")
    assert unknown.prepare().identifier.model.sensors.keys() == {"near"}
    role = "channels.near.role='validation'"
    assert cases.load(path, settings=parse([setting, role])).model.sensors["near"].time_constant
    for more, text in {
        "channels.near.at_std='1 cm'": "time_constant requires a sensor at a fixed place",
        "law={ kind = 'gradient' }": "'near' responds slowly",
        f"{key}=-3": "expected more than 0",
    }.items():
        with pytest.raises((CaseError, LawError), match=text):
            _ = cases.load(path, settings=[parse([setting]), parse([more])]).prepare().identifier


def test_a_late_sensor_may_be_a_slow_one(tmp_path):
    """Both are named, each with its setting, and compared."""
    prepared = cases.load(case_file(tmp_path)).prepare()
    late = Cause("lag", "near", "it is late", setting='channels.near.late="420 s"', size=420.0)
    early = Cause("lag", "far", "it is early", setting='channels.far.late="-60 s"', size=-60.0)
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(late, early))])
    once = with_settings(prepared, verdict)
    (*_, slow) = causes = once.findings[0].causes
    assert [cause.kind for cause in causes] == ["lag", "lag", "response"]
    assert slow.text == "near may respond slowly, with a time constant of 420 s"
    assert slow.setting == 'channels.near.time_constant={ value = "420 s", std = "420 s" }'
    assert with_settings(prepared, once) == once
    base = VariantRun(Variant("as stated"), verdict=once.to_dict(), log_evidence=1.0)
    names = [one.name for one in proposed(prepared, base)]
    assert names[:3] == ["lag of near", "lag of far", "time constant of near"]
    # One that is stated is not stated again, and can be left out.
    found = cases.load(prepared.case.path, settings=parse(slow.setting.split("; "))).prepare()
    assert freed(found, Cause("response", "near", "", size=60.0)) == ()
    plain = replace(base, verdict=Verdict.of([]).to_dict())
    assert "no time constants" in [one.name for one in proposed(found, plain)]


def test_an_input_that_seems_early_by_half_an_interval_may_switch(tmp_path):
    """A switch on lines between its rows was named a wrong clock, and only that was compared."""
    prepared = cases.load(case_file(tmp_path)).prepare()
    name, half = next(iter(prepared.case.roles("boundary"))), 0.5 * np.diff(prepared.raw.t)[0]
    early = Cause("lag", name, "it is early", setting=f'channels.{name}.late="-9 s"', size=-half)
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(early,))])
    verdict = with_settings(prepared, verdict)
    setting = f'channels.{name}.between="hold"'
    assert f"set `{setting}`" in verdict.findings[0].causes[0].remedy
    base = VariantRun(Variant("as stated"), verdict=verdict.to_dict(), log_evidence=1.0)
    assert proposed(prepared, base)[0].settings == (setting,)
    assert held(prepared, replace(early, size=-1.8 * half)) == ""


def test_the_evidence_of_readings_that_a_late_variant_lacks_is_no_loss():
    """That of a case which misses them moves by thousands: a late clock lost to a slow sensor."""
    case = VariantRun(
        Variant("as stated"),
        verdict=Verdict.of([]).to_dict(),
        log_evidence=-313133.0,
        readings={"a": 361, "b": 361},
    )
    late = replace(
        case,
        variant=Variant("late"),
        log_evidence=1700.0,
        readings={"a": 354, "b": 361},
        same_readings=-243056.0,
        densities={"a": 2.0, "b": math.nan},
    )
    assert late.gained(case) == pytest.approx(1700.0 + 7 * 2.0 + 313133.0)
    # Readings that the case does not miss are noise: the evidence is that of the same ones.
    sound = replace(case, log_evidence=1690.0)
    close = replace(late, same_readings=1680.0)
    assert close.gained(sound) == pytest.approx(20.0)


OTHERS = [
    lp.Full(noise=0.1),
    lp.Subdomain(lambda x: x[0] > 0.5, noise=0.1),
    lp.observation.Matrix(np.eye(1, 13, 6), noise=0.1),
    lp.observation.FluxPlates({"e": "left"}, "alpha", noise=0.1),
    lp.observation.Moving({"m": "x"}, noise=0.1),
    lp.observation.Functionals({"f": lambda q, u, x: q.alpha * u**2}, noise=0.1),
    lp.Averages({"A": lambda x: x[0] > 0.4}, noise=0.1),
]


@pytest.mark.parametrize("other", OTHERS, ids=lambda one: type(one).__name__)
def test_sensors_beside_a_slow_one_see_the_same(other):
    ends = {"left": lp.Channel("T"), "right": 0.0}
    model = heat(lp.interval(0.0, 1.0, 12), lp.LogNormal(0.1, 0.05), ends)
    predicted = []
    for sensors in (other, lp.Combined([other, Slow(lp.Points({"s": 0.3}), 0.1, noise=1e6)])):
        identifier = lp.Identifier(model, sensors, lp.SensitivityLaw(refit=None), u0=0.0)
        count = other.bind(model.state_space, model.X, model.parameter_space).size
        for k in range(6):
            inputs = {"T": 0.1 * k, "x": 0.4}
            inputs = {name: inputs[name] for name in identifier.inputs}
            readings = np.full(identifier.observed.size, 0.01 * k)
            estimate = identifier.step(0.1 * k, readings, inputs)
        value, _ = estimate.parameters["alpha"]
        predicted.append(np.append(estimate.innovation[:count], value))
    np.testing.assert_allclose(*predicted, rtol=1e-6, atol=1e-9)
