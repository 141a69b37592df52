"""Sudden changes are detected early with few false alarms, and estimated without a restart."""

from dataclasses import replace
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from factories import driven_rod, filter_alone, line, readings

import livepde as lp
from benchmarks import soak
from livepde.hindsight import Hindsight
from livepde.laws import Status
from livepde.laws.policies import Jumps
from livepde.laws.step_diagnostics import Diagnostics
from livepde.stepping import End, Interval

pytestmark = pytest.mark.slow

POINTS = [0.25, 0.5, 0.75]
NOISE = 0.01


def rod() -> lp.Model:
    return driven_rod({"a": lp.Normal(0.2, 0.2)}, lambda t: np.sin(3 * t), line(16))


def samples(
    a: Any, count: int, seed: int, noise: float = NOISE, **options: Any
) -> list[tuple[float, Any]]:
    times = 0.05 * np.arange(count + 1)
    return readings(rod(), lp.Points(POINTS), a, times, noise, seed, **options)


def run(law: lp.SensitivityLaw, stream: Any, guess: float = NOISE, **options: Any) -> Any:
    identifier = lp.Identifier(rod(), lp.Points(POINTS, noise=guess), law, u0=0.0, **options)
    found = [identifier.step(t, z) for t, z in stream]
    assert all(estimate.status.ok for estimate in found)
    return found


# Every two of refit, change and seed once.
@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "refit", "change"),
    [(0, None, 0.8), (0, lp.Refit(), 1.2), (1, None, 1.2), (1, lp.Refit(), 0.8)],
)
def test_a_jump_of_a_fifth_is_flagged_and_learned(refit: Any, change: float, seed: int):
    def a(t: float) -> float:
        return 0.3 if t < 7.5 else 0.3 * change

    law = lp.SensitivityLaw(jumps=Jumps(), refit=refit)
    found = run(law, samples(a, 350, seed))
    alarms = [k for k, estimate in enumerate(found) if estimate.diagnostics.jump > 0.0]
    late = [k for k in alarms if k >= 149]
    assert late
    assert late[0] - 149 <= 30
    value, std = found[-1].parameters["a"]
    assert abs(value - 0.3 * change) < 5 * std < 0.02


@pytest.mark.long
@pytest.mark.parametrize("refit", [None, lp.Refit()])
@pytest.mark.parametrize("seed", [1, 5, 7])
def test_after_an_alarm_the_samples_since_the_jump_are_taken_again(refit: Any, seed: int):
    """What the state has gone astray by in the meantime is not taken for a still larger jump."""
    # The samples have the error of the same steps, which need no division.
    options = {"jumps": Jumps(), "refit": refit, "shadows": lp.laws.Shadows(parts=1)}
    law, scheme = lp.SensitivityLaw(**options), lp.ImplicitEuler()
    stream = samples(lambda t: 0.3 if t < 15.0 else 0.24, 340, seed, scheme=scheme)
    found = run(law, stream, scheme=scheme)
    values = [estimate.parameters["a"][0] for estimate in found[299:]]
    assert min(values) > 0.18
    assert max(values) < 0.31
    assert values[-1] == pytest.approx(0.24, abs=0.01)


@pytest.mark.long
def test_a_sample_without_a_measurement_is_no_evidence():
    """What the last measured sample showed does not count again in those after it."""
    nothing = np.full(len(POINTS), np.nan)
    stream = samples(lambda t: 0.3, 600, 0)
    mixed = [(t, nothing if k % 5 else z) for k, (t, z) in enumerate(stream)]
    t, z = stream[500]
    mixed[500] = (t, z + 2.5 * NOISE)  # by chance: once is no alarm
    found = run(lp.SensitivityLaw(jumps=Jumps()), mixed)
    assert not any(estimate.diagnostics.jump > 0.0 for estimate in found)


@pytest.mark.parametrize("refit", [None, lp.Refit()])
def test_samples_without_a_measurement_are_taken_again_with_those_since_the_jump(refit: Any):
    """The interval that leads to sample 200 is the first with the new value; it has no reading."""
    nothing = np.full(len(POINTS), np.nan)
    stream = samples(lambda t: 0.3 if t < 10.0 else 0.24, 220, 0)
    law = filter_alone(jumps=Jumps(settle=20), refit=refit)
    found = run(law, [(t, z if k % 2 else nothing) for k, (t, z) in enumerate(stream)])
    alarms = [k for k, one in enumerate(found) if one.diagnostics.jump > 0.0 and k > 199]
    assert alarms[0] - found[alarms[0]].diagnostics.jump_samples + 1 == 200


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_a_jump_while_nothing_is_read_has_no_known_time(seed: int):
    """Any time between readings is as likely: one of them would be a wrong state afterwards."""
    nothing = np.full(len(POINTS), np.nan)
    stream = samples(lambda t: 0.3 if t < 10.3 else 0.45, 260, seed)
    stream = [(t, nothing if 200 < k < 212 else z) for k, (t, z) in enumerate(stream)]
    law = filter_alone(jumps=Jumps(settle=20))
    result = lp.Identifier(rod(), lp.Points(POINTS, noise=NOISE), law, u0=0.0).run(stream)
    value, std = result.last.parameters["a"]
    assert abs(value - 0.45) < 2.0 * std < 0.01
    smoothed = result.smoothed()
    assert smoothed["a"].values[-1] == pytest.approx(value, abs=0.1 * std)
    assert smoothed["a_std"].values[-1] == pytest.approx(std, rel=0.02)
    assert smoothed["a"].values[206] == pytest.approx(0.375, abs=0.05)  # halfway through the gap


@pytest.mark.parametrize("seed", [0, 3, 7])
def test_a_jump_between_two_samples_is_one_jump(seed: int):
    """A state that jumped half an interval early or late looks like another jump later."""
    mesh, unknowns = line(2), {"s": lp.Normal(0.0, 1.0)}
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh)),
        unknowns,
        A=lambda q, _, v, x: -q.s * v,
        B=lambda u, v, x: 0.1 * lp.dot(lp.grad(u), lp.grad(v)) + 0.1 * u * v,
    )
    t = 0.1 * np.arange(141)
    since = np.maximum(t - 8.05, 0.0)
    exact = 5.0 * (1.0 - np.exp(-0.1 * t)) + 20.0 * (1.0 - np.exp(-0.1 * since))
    z = exact[:, None] + 0.02 * np.random.default_rng(seed).standard_normal((141, 2))
    law = filter_alone(jumps=Jumps(settle=20))
    identifier = lp.Identifier(model, lp.Points([0.2, 0.8], noise=0.02), law, u0=0.0)
    found = [identifier.step(*sample) for sample in zip(t, z, strict=True)]
    assert sum(one.diagnostics.jump > 0.0 for one in found) == 1
    value, std = found[-1].parameters["s"]
    assert abs(value - 2.5) < 2.5 * std < 0.01


def test_values_that_the_gate_refuses_at_first_do_not_hide_a_later_jump():
    """They would make a usual size beside which any jump is small."""
    stream = samples(lambda t: 0.3 if t < 7.5 else 0.15, 180, 0)
    for k in (15, 16):
        stream[k][1][0] = -9999.0
    found = run(filter_alone(jumps=Jumps()), stream)
    assert sum(one.diagnostics.refused for one in found) == 2.0
    assert any(one.diagnostics.jump > 0.0 for one in found[149:])


def test_the_onset_of_a_jump_is_where_the_innovations_became_too_large():
    rng, jumps, hits = np.random.default_rng(0), Jumps(), 0
    for length in (1, 3, 10, 30):
        for _ in range(20):
            watch = jumps.start(2)
            for k in range(60):
                e = rng.standard_normal((1, 2)) * (5.0 if k >= 60 - length else 1.0)
                e[rng.random((1, 2)) < 0.1] = np.nan
                if k < 59:
                    watch = replace(watch.add(e, np.zeros(1, bool)), usual=watch.usual)
            hits += abs(jumps.onsets(watch, e)[0] - length) <= 2
    assert hits >= 72  # of 80


def test_large_readings_by_chance_do_not_date_a_later_jump():
    """The samples since decide between onsets that the innovations make almost as likely."""
    stream = samples(lambda t: 0.3 if t < 10.0 else 0.45, 206, 1)
    for k, size in ((184, 4.0), (186, 2.5), (187, 3.0)):
        stream[k][1][1] += size * NOISE
    found = run(filter_alone(jumps=Jumps(settle=20, probability=1e-7)), stream)
    alarms = [k for k, one in enumerate(found) if one.diagnostics.jump > 0.0]
    assert alarms[0] - found[alarms[0]].diagnostics.jump_samples + 1 == 200


@pytest.mark.parametrize("options", [{"probability": 0.0}, {"window": 3}, {"size": 0.0}])
def test_settings_that_cannot_be_meant_are_refused(options: Any):
    with pytest.raises(lp.errors.LawError, match=next(iter(options))):
        Jumps(**options)


@pytest.mark.long
@pytest.mark.parametrize("guess", [1e-3, 1e-1, 1.0])
def test_the_noise_is_found_from_any_first_guess(guess: float):
    law = lp.SensitivityLaw(noise="auto", shadows=None)
    found = run(law, samples(lambda t: 0.3, 250, 0), guess)
    assert found[-1].diagnostics.noise_level * guess == pytest.approx(NOISE, rel=0.2)
    value, std = found[-1].parameters["a"]
    assert abs(value - 0.3) < 4 * std < 0.01


def test_what_noise_cannot_be_is_one_sentence():
    with pytest.raises(lp.errors.LawError, match="a positive number or 'auto'; got 'white'"):
        lp.SensitivityLaw(noise="white")


def test_a_sensor_that_is_stuck_is_no_jump_and_hides_none():
    stream, kept = [], np.zeros(len(POINTS))
    for k, (t, z) in enumerate(samples(lambda t: 0.3 if t < 20.0 else 0.36, 440, 1)):
        stuck = any(first <= k < first + 60 for first in (150, 300))
        z = np.where([False, stuck, False], kept, z)
        stream.append((t, z))
        kept = z
    found = run(lp.SensitivityLaw(jumps=Jumps()), stream)
    alarms = [k for k, estimate in enumerate(found) if estimate.diagnostics.jump > 0.0]
    assert len(alarms) == 1
    assert 399 <= alarms[0] < 429
    value, std = found[-1].parameters["a"]
    assert abs(value - 0.36) < 3.0 * std


def test_a_sensor_that_stays_stuck_hides_no_slow_evidence_of_the_others():
    """The sums leave out repeated readings, and keep those of the other sensors."""
    rng, jumps, alarms = np.random.default_rng(3), Jumps(settle=10), []
    watch = jumps.start(3)
    for k in range(300):
        e = rng.standard_normal((1, 3)) + (1.5 if k >= 220 else 0.0)
        run_of = max(k - 100, 0)  # of the first sensor, which then brings no reading at all
        if k >= 150:
            e[0, 0], run_of = np.nan, 50
        watch, alarm = jumps.add(watch, e, None, np.array([[run_of, 0, 0]]))
        alarms += [k] * bool(alarm[0])
    assert alarms
    assert 220 <= alarms[0] < 245


def test_an_input_that_is_not_read_is_no_jump():
    """A boundary is held for 30 samples while it moves: readings tell of it, not of unknowns."""
    model = soak._identifier().model
    law = lp.SensitivityLaw(jumps=Jumps(), refit=None)
    identifier = lp.Identifier(model, lp.Points(soak.SENSORS, noise=soak.NOISE), law)
    alarms = []
    for row in islice(soak._rows(model), 650):
        k = row["t"]
        z = {name: row[name] for name in soak.COLUMNS}
        z["left"] = None if 600 <= k < 630 else z["left"]
        estimate = identifier.step(soak.DT * k, z)
        alarms += [k] * (estimate.diagnostics.jump > 0.0)
    assert not alarms
    for name, truth in (("k", soak.K), ("loss", soak.LOSS)):
        value, std = estimate.parameters[name]
        assert abs(value - truth) < 3.0 * std < 0.2 * truth


def test_innovations_beside_an_unread_input_count_for_no_alarm():
    rng, jumps = np.random.default_rng(3), Jumps(settle=10)
    watch, alarms = jumps.start(2), []
    for k in range(200):
        far = 20.0 if 100 <= k < 109 or k == 150 else 0.0  # the input returns at 102
        e = rng.standard_normal((1, 2)) + far
        unread = np.array([100 <= k < 103]) if 100 <= k < 103 else None
        watch, alarm = jumps.add(watch, e, None, None, unread)
        alarms += [k] * bool(alarm[0])
    assert alarms == [150]


def test_a_large_jump_begins_with_its_first_sample():
    """Ratios by the usual scatter of several times are not comparable."""
    jumps, rng = lp.Jumps(), np.random.default_rng(0)
    watch = jumps.start(3)
    for size in np.repeat([1.0, 1.3], [100, 60]):
        watch, _ = jumps.add(watch, size * rng.standard_normal((1, 3)))
    assert jumps.onsets(watch, np.array([[140.0, np.nan, -3.0]]))[0] == 1


def test_the_variances_of_two_jumps_in_one_interval_add_up():
    """Each of two jumps in consecutive intervals acts at both ends of its interval."""
    hindsight = Hindsight(np.zeros(1))
    for number in range(1, 5):
        ends = [End(t=t, inputs=lp.fem.Inputs({}), z=np.ones(1)) for t in (number - 1.0, number)]
        diagnostics = Diagnostics(jump_samples=1.0) if number in (2, 3) else Diagnostics()
        estimate = SimpleNamespace(status=Status(), diagnostics=diagnostics, t=float(number))
        hindsight.add(estimate, Interval.between(*ends), np.zeros(1))
    data = hindsight.fixed_interval(1)
    assert data is not None
    assert data.jumps == {1: 0.5, 2: 1.0, 3: 0.5}
