"""The verdict of a run finds and names faults, and does not overstate them."""

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from factories import driven_rod, observe

import livepde as lp
from livepde.errors import LawError
from livepde.laws import Fit
from livepde.laws.verdict import after_fit
from livepde.runs import doubts, drive, verdict
from livepde.verdict import (
    Cause,
    Dictionary,
    Finding,
    Shifts,
    ValidationLedger,
    Verdict,
    discretised,
)
from livepde.verdict.assess import FACTOR, LONGEST, _possible
from livepde.verdict.directions import (
    AVERAGED,
    GAIN,
    LAG,
    LONGEST_AVERAGE,
    ScoreDirection,
    sensor_averages,
)
from livepde.verdict.findings import flat
from livepde.verdict.ledger import Ledger, summed

TIMES = np.linspace(0.0, 8.0, 161)
NOISE = 0.02
PLACES = {"A": 0.25, "B": 0.5, "C": 0.75}
ENDS = {"left": lp.Channel("T_left"), "right": 0.0}


def rod(loss: float = 0.0) -> lp.Model:
    """Return heat conduction with unknown k between a measured end and an end at zero."""
    mesh = lp.interval(0.0, 1.0, 24)
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet=ENDS),
        {"k": lp.LogNormal(0.1, std=0.03)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        B=lambda u, v, x: loss * u * v,
    )


def driven(t: Any) -> Any:
    return np.sin(2.1 * t) + 0.3 * np.sin(7.0 * t)


@cache
def shown(
    k: float = 0.13,
    loss: float = 0.0,
    places: tuple[float, ...] = (0.25, 0.5, 0.75),
    count: int = len(TIMES),
) -> Any:
    """Simulate sensors by the method of lines on a finer grid with the matrix exponential.

    A code of its own: central differences on 160 cells, and the input as a staircase of 20 steps
    for each sample.
    """
    from scipy.linalg import expm

    cells, parts = 160, 20
    h, dt = 1.0 / cells, (TIMES[1] - TIMES[0]) / parts
    n = cells - 1
    D = k / h**2 * (np.diag(np.ones(n - 1), -1) - 2 * np.eye(n) + np.diag(np.ones(n - 1), 1))
    D -= loss * np.eye(n)
    source = np.zeros(n)
    source[0] = k / h**2
    E = expm(D * dt)
    once = np.linalg.solve(D, E @ source - source)
    u, rows = np.zeros(n), []
    at = [round(p * cells) - 1 for p in places]
    for t in (TIMES[1] * np.arange(count)).tolist():
        rows.append(u[at])
        for part in range(parts):
            u = E @ u + once * driven(t + (part + 0.5) * dt)
    return np.array(rows)


def errors(seed: int = 1) -> Any:
    return NOISE * np.random.default_rng(seed).standard_normal((len(TIMES), len(PLACES)))


def run(
    z: Any,
    *,
    stated: float = 1.0,
    law: Any = None,
    places: Any = None,
    validation: Any = None,
    u0: float | None = 0.0,
) -> tuple[lp.Identifier, lp.Estimate]:
    """Run an identifier on readings; return it and the last estimate."""
    sensors = lp.Points(places or PLACES, noise=NOISE * stated, unit="degC")
    law = law or lp.SensitivityLaw()
    identifier = lp.Identifier(rod(), sensors, law, u0=u0, validation=validation)
    estimate: Any = None
    for k, t in enumerate(TIMES.tolist()):
        readings = z[k] if not isinstance(z, dict) else {name: z[name][k] for name in z}
        estimate = identifier.step(t, readings, {"T_left": driven(t)})
    return identifier, estimate


def judged(law: Any = None, **options: Any) -> lp.Identifier:
    sensors = lp.Points(PLACES, noise=NOISE, unit="degC")
    return lp.Identifier(rod(), sensors, law or lp.SensitivityLaw(), u0=0.0, **options)


def samples(z: Any) -> list[lp.Sample]:
    each = zip(TIMES.tolist(), z, strict=False)
    return [lp.Sample(t, row, {"T_left": driven(t)}) for t, row in each]


def named(found: Verdict) -> list[tuple[str, str]]:
    """Return kind and subject of the first two causes."""
    return [(c.kind, c.subject) for f in found.findings for c in f.causes[:2]]


@pytest.mark.slow
@pytest.mark.parametrize(("stated", "seed"), [(1.0, 1), (3.0, 2), (1 / 3, 1)])
def test_a_correct_model_is_trusted_for_any_stated_noise(stated: float, seed: int):
    _, estimate = run(shown() + errors(seed), stated=stated)
    assert estimate.verdict.level == "trusted"
    said = [finding.what for finding in estimate.verdict.findings]
    assert said == ([] if stated == 1.0 else ["noise"])


@pytest.mark.slow
def test_the_filter_gives_equal_numbers_for_any_verdict_option():
    z = shown() + errors()
    _, judged = run(z)
    _, cheap = run(z, law=lp.SensitivityLaw(verdict="cheap"))
    _, bare = run(z, law=lp.SensitivityLaw(verdict=False))
    for other in (cheap, bare):
        assert np.array_equal(judged.q, other.q)
        assert np.array_equal(judged.q_std, other.q_std)
        assert np.array_equal(judged.u, other.u)
    assert any("missing sources" in text for text in cheap.verdict.untested)
    assert bare.verdict.untested == ("innovations: verdict = False",)
    assert bare.verdict.level == "not judged"
    with pytest.raises(LawError, match="verdict must be"):
        lp.SensitivityLaw(verdict="dear")


@pytest.mark.slow
def test_an_offset_is_named_with_its_size_also_in_json_and_in_the_dataset():
    z = shown() + errors()
    z[:, 1] += 0.08
    result = judged().run(samples(z))
    found, data = result.verdict, result.to_xarray()
    assert Verdict.from_dict(json.loads(json.dumps(found.to_dict()))).to_dict() == found.to_dict()
    assert verdict(data).level == found.level != "trusted"
    assert doubts(data)[0] == found.sentences[0]
    assert named(found)[0] == ("offset", "B")
    finding = next(one for one in found.findings if one.causes)
    text = finding.causes[0].text
    assert float(text.split("read ")[1].split()[0]) == pytest.approx(0.08, rel=0.15)
    assert "add `offset = " in finding.sentence


@pytest.mark.slow
def test_a_lag_is_named_with_its_size_and_what_it_does_to_the_estimate():
    z = shown().copy()
    lag = 4 * (TIMES[1] - TIMES[0])
    z[:, 2] = np.interp(TIMES - lag, TIMES, z[:, 2])
    z += errors()
    estimate = run(z)[1]
    found = estimate.verdict
    assert named(found)[0] == ("lag", "C")
    size = float(found.findings[0].causes[0].text.split("be ")[1].split()[0])
    assert size == pytest.approx(lag, rel=0.25)
    off = (estimate.parameters["k"][0] - 0.13) / estimate.parameters["k"][1]
    assert found.findings[0].shift["k"] == pytest.approx(-off, abs=2.0)
    assert abs(off) > 3.0
    assert found.level == "do not trust"


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["none", "lag", "late offset"])
def test_a_wrong_initial_state_hides_no_other_fault(fault: str):
    z = shown().copy()
    if fault == "lag":
        z[:, 2] = np.interp(TIMES - 4 * (TIMES[1] - TIMES[0]), TIMES, z[:, 2])
    elif fault == "late offset":
        z[len(z) // 2 :, 0] += 2.5 * NOISE
    found = run(z + errors(), u0=0.08 if fault == "lag" else 0.14)[1].verdict
    kinds = {cause.kind for finding in found.findings for cause in finding.causes}
    assert "initial" in kinds
    if fault == "none":
        assert (found.level, [finding.what for finding in found.findings]) == ("trusted", ["start"])
    else:
        assert found.level != "trusted"
        assert fault.split()[-1] in kinds


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.0, 20.0])
def test_a_default_initial_state_is_a_possible_cause(level: float):
    _, estimate = run(level + shown() + errors(), u0=None)
    remedies = [one.remedy for one in estimate.verdict.findings if one.what == "start"]
    assert any("Give `u0`" in remedy for remedy in remedies) == (level > 0.0)


def test_a_displaced_sensor_is_named():
    found = run(shown() + errors(), places={**PLACES, "B": 0.56})[1].verdict
    assert ("position", "B") in named(found)
    assert "B may be" in found.findings[0].sentence
    assert "closer to x = 0 than configured" in found.findings[0].sentence


@pytest.mark.slow
def test_a_missing_loss_is_named():
    found = run(shown(loss=0.6) + errors())[1].verdict
    assert ("loss", "") in named(found)


@pytest.mark.slow
def test_a_jump_is_named_and_changes_the_verdict_early():
    half = len(TIMES) // 2
    z = np.concatenate([shown()[:half], shown(k=0.2)[half:]]) + errors()
    identifier = judged()
    turned = None
    for k, t in enumerate(TIMES.tolist()):
        estimate = identifier.step(t, z[k], {"T_left": driven(t)})
        level = estimate.verdict.level if k >= 20 else "trusted"
        assert k >= half or level == "trusted"
        turned = k if turned is None and level != "trusted" else turned
    assert turned is not None
    assert turned - half <= 30
    assert ("jump", "k") in named(estimate.verdict)


def test_each_share_of_a_shift_is_named_with_its_own_remedy():
    sizes = {"step": -4.0, "mesh": 2.5, "input": 0.4}
    shifts = Shifts(3.0, sizes, {("k", "step"): -0.2, ("k", "mesh"): 0.1, ("k", "input"): 0.0})
    (found,) = discretised(shifts)
    step, mesh = "the time step by 4.0 (k by -0.2)", "the mesh by 2.5 (k by +0.1)"
    assert f"by 3.0 standard deviations: {step}, {mesh}. " in found.text
    assert "steps.dt_max" in found.remedy
    assert "mesh.cells" in found.remedy
    assert "channels" not in found.sentence
    assert "Refine the mesh" in found.sentence
    small = Shifts(2.2, {"step": 0.9, "mesh": 0.8, "input": 0.5})
    (found,) = discretised(small)
    assert "the time step by 0.9." in found.text
    assert list(discretised(replace(shifts, largest=1.9))) == []
    assert list(discretised(Shifts())) == []


@pytest.mark.slow
@pytest.mark.parametrize(("offset", "level"), [(0.0, "INFO"), (0.08, "WARNING")])
def test_a_verdict_is_a_warning_in_the_log_unless_the_run_is_trusted(caplog, offset, level):
    """A correct run, which is not judged at first, logs no warning."""
    caplog.set_level("INFO", "livepde.run")
    z = shown()[:60] + errors()[:60]
    z[:, 1] += offset
    identifier = judged()
    drive(identifier, iter(samples(z)))
    (told,) = (one for one in caplog.records if one.kind == "verdict")
    assert told.levelname == level
    assert told.getMessage().startswith("verdict: trusted") == (level == "INFO")


@pytest.mark.slow
def test_correlated_errors_have_no_named_cause():
    rng = np.random.default_rng(3)
    e = rng.standard_normal((len(TIMES), 3))
    for k in range(1, len(e)):
        e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.81) * e[k]
    found = run(shown() + NOISE * e)[1].verdict
    assert [finding.what for finding in found.findings if finding.severity != "note"] == [
        "following"
    ]
    assert found.level == "caution"


@pytest.mark.slow
@pytest.mark.parametrize(("sensors", "kinds"), [(40, ["gain", "drift"]), (120, ["offset", "lag"])])
def test_with_many_sensors_some_kinds_of_causes_are_omitted(sensors: int, kinds: list[str]):
    places = {f"s{k}": (k + 0.5) / sensors for k in range(sensors)}
    points = lp.Points(places, noise=NOISE)
    identifier = lp.Identifier(rod(), points, lp.SensitivityLaw(), u0=0.0)
    for t in TIMES[:40].tolist():
        estimate = identifier.step(t, np.zeros(sensors), {"T_left": driven(t)})
    told = [text for text in estimate.verdict.untested if text.endswith(f"there are {sensors}")]
    assert all(any(text.startswith(kind) for text in told) for kind in kinds)
    assert estimate.verdict.level == "do not trust"


@pytest.mark.slow
def test_a_stored_verdict_has_no_responses_of_the_process():
    identifier, _ = run(shown() + errors())
    cells = identifier.law.deferred(identifier._work, identifier._state).verdict.__closure__ or ()
    (x,) = (cell.cell_contents for cell in cells if hasattr(cell.cell_contents, "ledger"))
    assert identifier._state.now.ledger.process.size
    assert x.ledger.process.size == 0
    assert x.ledger.process.base is None or x.ledger.process.base.size == 0


@pytest.mark.slow
def test_directions_predict_the_shift_of_the_estimate():
    """With an unknown source, model and filter are linear, so the shift by an offset is exact."""
    mesh = lp.interval(0.0, 1.0, 20)

    def estimated(offset: float) -> tuple[lp.Identifier, lp.Estimate]:
        model = lp.Model(
            lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
            {"s": lp.Normal(0.0, std=1.0)},
            A=lambda q, u, v, x: -q.s * v,
            B=lambda u, v, x: 0.1 * lp.dot(lp.grad(u), lp.grad(v)),
        )
        sensors = lp.Points(PLACES, noise=NOISE)
        law = lp.SensitivityLaw(refit=None)
        identifier = lp.Identifier(model, sensors, law, u0=0.0)
        for k, t in enumerate(TIMES[1:71].tolist()):
            estimate = identifier.step(t, errors()[k] + np.array([0.0, offset, 0.0]))
        return identifier, estimate

    identifier, plain = estimated(0.0)
    judge, x = identifier._work.filter.judge, identifier._state.now
    w, _ = judge.summed_up(x.ledger, x.causes)
    kinds = [(d.kind, d.subject) for d in judge.dictionary.directions]
    moved = float(x.C[0].T[0] @ w[0][:, kinds.index(("offset", "B"))])
    _, off = estimated(3.0 * NOISE)
    # An offset moves the estimate away from the truth by minus what would mend it.
    assert off.q[0] - plain.q[0] == pytest.approx(-moved, rel=1e-6)


def fed(inputs: Any, *, between: str = "line") -> lp.Estimate:
    """Return the last estimate of a run with given values of one channel."""
    identifier = judged(between={"T_left": between})
    z = shown() + errors()
    for k, t in enumerate(TIMES.tolist()):
        estimate = identifier.step(t, z[k], {"T_left": inputs[k]})
    return estimate


@pytest.mark.long
@pytest.mark.parametrize("between", ["hold", "next"])
def test_smooth_readings_held_as_settings_are_reported(between: str):
    straight, held = fed(driven(TIMES)), fed(driven(TIMES), between=between)
    (found,) = [f for f in held.verdict.findings if f.what == "hold"]
    assert found.severity == "caution"
    shift = held.q[0] - straight.q[0]
    assert held.diagnostics.shifts.by("hold")["k"] == pytest.approx(shift, rel=0.3)
    assert found.evidence == pytest.approx(abs(shift) / held.q_std[0], rel=0.4)
    assert "hold" not in straight.diagnostics.shifts.sizes
    steps = np.repeat(driven(TIMES[::10]), 10)[: len(TIMES)]  # steps like those of an actuator
    assert fed(steps, between=between).diagnostics.shifts.sizes["hold"] == 0.0


@pytest.mark.long
def test_gaps_of_a_channel_are_reported_and_widen_the_interval():
    whole, off, shifts = fed(driven(TIMES)), [], []
    for seed in range(5, 9):
        values = driven(TIMES)
        values[1:][np.random.default_rng(seed).random(len(TIMES) - 1) < 0.3] = np.nan
        gaps = fed(values)
        (found,) = [f for f in gaps.verdict.findings if f.what == "input"]
        assert (found.severity, found.subject) == ("caution", "T_left")
        assert found.evidence == pytest.approx(np.isnan(values).mean())
        off.append(gaps.q[0] - whole.q[0])
        shifts.append(gaps.diagnostics.shifts.by("input")["k"])
        assert abs(off[-1]) > 3.0 * whole.q_std[0]
        assert abs(off[-1]) < 3.0 * gaps.q_std[0]
    assert abs(np.mean(off) - np.mean(shifts)) < 0.5 * abs(np.mean(off))


@pytest.mark.slow
def test_a_resumed_run_is_judged_from_its_resume():
    one, z = judged(lp.SensitivityLaw(verdict=False)), shown() + errors()
    for k, t in enumerate(TIMES[:60].tolist()):
        before = one.step(t, z[k], {"T_left": driven(t)})
    other = judged()
    other.restore(one.dump())
    z[60:, 1] += 6.0 * NOISE
    for k, t in enumerate(TIMES[60:120].tolist(), 60):
        after = other.step(t, z[k], {"T_left": driven(t)})
    assert before.verdict.untested == ("innovations: verdict = False",)
    assert ("offset", "B") in named(after.verdict)
    one.restore(other.dump())
    assert one.estimate().q[0] == after.q[0]


@pytest.mark.slow
def test_a_census_accounts_for_effects_absorbed_by_unknowns():
    from benchmarks.census import FAULTS
    from benchmarks.census.run import scene_of
    from benchmarks.census.trace import VISIBLE, trace
    from benchmarks.honest.problems import PROBLEMS as TRUTHS

    traces = {}
    for name in ("rod", "borehole"):
        problem, rng = TRUTHS[name], np.random.default_rng(0)
        sound = scene_of(problem, *problem.draw(rng), problem.noise, rng)
        traces[name] = trace(sound), trace(FAULTS["offset"].change(sound))
    assert max(sound for sound, _ in traces.values()) < 1.0
    assert traces["borehole"][1] < VISIBLE < traces["rod"][1]


@pytest.mark.slow
def test_validation_sensors_are_compared_with_predictions():
    clean = shown(places=(0.25, 0.75, 0.5)) + errors()
    z = {"A": clean[:, 0], "C": clean[:, 1], "W": clean[:, 2]}
    places = {"A": 0.25, "C": 0.75}
    validation = lp.Points({"W": 0.5}, noise=NOISE)
    assert run(z, places=places, validation=validation)[1].verdict.level == "trusted"
    slow = {**z, "W": np.where(np.arange(len(TIMES)) % 2, z["W"], np.nan)}
    assert run(slow, places=places, validation=validation)[1].verdict.level == "trusted"
    fahrenheit = {**z, "W": 32.0 + 1.8 * z["W"]}
    found = run(fahrenheit, places=places, validation=validation)[1].verdict
    assert ("unit", "W") in named(found)
    assert "W may be in degF" in found.sentences[0]


def test_a_validation_sensor_with_few_values_is_not_judged():
    ledger = ValidationLedger.start(1)
    for _ in range(10):
        ledger = ledger.add(np.array([9.0]), np.zeros(1), np.zeros(1))
    assert list(ledger.findings(["W"])) == []


def test_sums_of_a_sensor_do_not_depend_on_samples_without_it():
    """If sensors have different gaps, the sums of each sensor only use its own values."""
    windows, directions, rows = 2, 3, 12
    start = Ledger.start(2, directions, 0, 0, 0, windows, 1, rows, 1)
    rng = np.random.default_rng(2)
    used = rng.random((1, rows, 2)) < 0.5
    due = np.zeros((1, windows), dtype=bool)
    whitened = rng.standard_normal((1, rows, 2, 1 + windows * directions)) * used[..., None]
    found = start
    for part in (slice(0, 5), slice(5, 6), slice(6, rows)):
        batch = summed(found, due, whitened[:, part], used[:, part].astype(float))
        found = replace(found, **batch)
    for sensor in range(2):
        own = whitened[:, used[0, :, sensor]]
        alone = summed(start, due, own, np.ones(own.shape[:3]))
        for name in ("sums", "noise"):
            expected = alone[name][..., sensor]
            np.testing.assert_allclose(getattr(found, name)[..., sensor], expected, atol=1e-12)
        assert expected[0, 4, 0] == used[..., sensor].sum() - 1  # pairs


@pytest.mark.slow
def test_sensors_with_alternating_readings_show_their_noise():
    z, turn = shown() + errors(), np.arange(len(TIMES))[:, None] % 3
    verdict = run(np.where(turn == np.arange(3), z, np.nan))[1].verdict
    assert verdict.level == "trusted"
    assert verdict.findings == ()  # none that the residuals scatter more than stated


def test_a_run_with_few_samples_is_not_judged():
    identifier = judged()
    estimate = identifier.step(0.1, np.zeros(3), {"T_left": 0.0})
    assert estimate.verdict.level == "not judged"
    assert "1 samples, at least 20 required" in estimate.verdict.sentences[0]


def test_the_worst_finding_decides_and_none_is_repeated():
    notes = [Finding("noise", "note", f"n{k}") for k in range(6)]
    grave = Finding("misfit", "do not trust", "grave")
    found = Verdict.of([*notes, grave, grave])
    assert found.level == "do not trust"
    assert len(found.sentences) == 5
    assert found.sentences[0] == "grave"
    assert len(set(found.sentences)) == len(found.sentences)
    assert Verdict.of(notes).level == "trusted"
    assert found.with_findings([grave]).findings == found.findings


def test_a_run_that_was_not_judged_is_never_trusted():
    """Notes or a caution do not make it trusted; a caution would claim too much."""
    note, caution = Finding("noise", "note", "n"), Finding("flat", "caution", "f")
    grave = Finding("validation", "do not trust", "w")
    for found in ([], [note], [note, caution]):
        one = Verdict.of(found, ["innovations: none"], judged=False)
        assert one.level == "not judged"
        assert one.sentences[0] == "Not judged: the model was not tested (innovations: none)."
        again = Verdict.from_dict(json.loads(json.dumps(one.to_dict())))
        assert again.to_dict() == one.to_dict()
        assert one.with_findings([grave]).level == "do not trust"
        assert Verdict.of(found).level == ("caution" if caution in found else "trusted")


def test_a_run_names_the_discretisation_once():
    old = Finding("discretisation", "note", "The discretisation has shifted them.", evidence=3.0)
    (new,) = discretised(Shifts(3.0, {"mesh": 3.0}))
    assert Verdict.of([old]).with_findings([new]).findings == (new,)


def test_a_later_finding_replaces_an_earlier_one():
    """A page shows an earlier verdict with the current shares of the prior."""
    earlier = Verdict.of([flat("a", 0.92), flat("b", 0.95)], [], [])
    found = earlier.with_findings([flat("a", 0.94)])
    assert sorted(one.subject for one in found.findings) == ["a", "b"]
    assert any("94 %" in text for text in found.sentences)
    assert not any("92 %" in text for text in found.sentences)


# --- causes that equation and sensor can have ---------------------------------------------------


def possible(direction: ScoreDirection, size: float, samples: int = 100) -> bool:
    evidence = SimpleNamespace(size=np.array([[size]]))
    ledger = SimpleNamespace(times=np.array([0.0, 1.0]), seen=samples)
    at = SimpleNamespace(ledger=ledger, noise=np.array([0.1]), sensors=["T"])
    return _possible(direction, 0, 0, evidence, at)


def test_an_equation_without_a_loss_has_none_that_is_too_large():
    assert possible(ScoreDirection("loss"), 1.0)
    assert not possible(ScoreDirection("loss"), -1.0)
    assert possible(ScoreDirection("source"), -1.0)  # a sink


@pytest.mark.parametrize("kind", ["gain", "channel"])
def test_a_scale_is_wrong_by_a_factor_of_two_at_most(kind):
    direction = ScoreDirection(kind, "T", GAIN)
    sign = 1.0 if kind == "gain" else -1.0
    assert possible(direction, sign * 0.99 * (FACTOR - 1.0) / GAIN)
    assert not possible(direction, sign * 1.01 * (FACTOR - 1.0) / GAIN)
    assert possible(direction, -sign * 0.99 * (1.0 - 1.0 / FACTOR) / GAIN)
    assert not possible(direction, -sign * 1.01 * (1.0 - 1.0 / FACTOR) / GAIN)


def test_a_sensor_is_late_by_a_part_of_the_run():
    direction = ScoreDirection("lag", "T")
    assert possible(direction, 0.99 * LONGEST * 100 / LAG)
    assert not possible(direction, 1.01 * LONGEST * 100 / LAG)


def test_a_sensor_is_inside_the_body_and_not_beyond_the_next_one():
    model = driven_rod({"a": lp.Normal(1.0, 0.5)}, lambda t: t, lp.interval(0.0, 1.0, 20))
    observed = observe(model, lp.Points({"a": 0.1, "b": 0.4, "c": 0.5}, noise=0.1))
    noise = np.full(3, 0.1)
    found = Dictionary(model, observed, noise, [], dearer=False).directions
    places = {one.subject: one for one in found if one.kind == "position"}
    reach = {name: (one.least, one.most) for name, one in places.items()}
    assert reach["a"] == pytest.approx((-0.1, 0.3))
    assert reach["b"] == pytest.approx((-0.1, 0.1))
    assert reach["c"] == pytest.approx((-0.1, 0.1))
    step = places["c"].size
    assert possible(places["c"], 0.09 / step)
    assert not possible(places["c"], 0.11 / step)
    assert not possible(places["c"], -0.11 / step)


def test_a_sensor_averages_over_a_length_inside_the_body():
    model = driven_rod({"a": lp.Normal(1.0, 0.5)}, lambda t: t, lp.interval(0.0, 2.0, 400))
    observed = observe(model, lp.Points({"a": 0.06, "b": 1.0}, noise=0.1))
    parabola = model.state_space.interpolate(lambda x: x[0] ** 2)
    length = AVERAGED * 2.0
    np.testing.assert_allclose(
        sensor_averages(model, observed) @ parabola, length**2 / 12.0, rtol=0.05
    )
    found = Dictionary(model, observed, np.full(2, 0.1), [], dearer=False).directions
    near, middle = (one for one in found if one.kind == "averaging")
    assert (near.most, middle.most) == pytest.approx((0.12, LONGEST_AVERAGE * 2.0))
    assert possible(near, 0.9 * (0.12 / length) ** 2)
    assert not possible(near, 1.1 * (0.12 / length) ** 2)
    assert not possible(near, -0.1)


@pytest.mark.parametrize(("converged", "kept"), [(True, 1), (False, 2)])
def test_refusals_do_not_count_after_a_converged_fit_of_all_readings(converged, kept):
    fit = Fit(samples=50, cost=1.0, passes=2.0, readings=100, refused=0, converged=converged)
    other = Finding("stuck", "do not trust", "It is stuck.")
    verdict = Verdict.of([Finding("refused", "caution", "Many were refused."), other])
    found = after_fit(verdict, fit)
    assert len(found.findings) == kept
    assert found.level == "do not trust"


def test_below_half_of_the_misfit_no_single_cause_is_named():
    causes = (Cause("gain", "T", "T may be large", 0.36), Cause("lag", "T", "T may be late", 0.2))
    found = Finding("misfit", "caution", "It misfits.", causes=causes).sentence
    assert found == (
        "It misfits. No single cause explains this. Candidates: T may be large (36 %); T may be "
        "late (20 %)."
    )
    likely = (Cause("gain", "T", "T may be large", 0.6), *causes[1:])
    found = Finding("misfit", "caution", "It misfits.", causes=likely).sentence
    assert found == (
        "It misfits. T may be large (explains 60 %). Alternatively, T may be late (20 %)."
    )
