"""Inputs between two readings: linear, held, or means over the interval."""

import json
import math
from collections import deque
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_rod import CLOCK

import livepde as lp
from livepde import cases
from livepde.cases.live_case import LiveCase
from livepde.cases.measured import measured
from livepde.cases.member_blocks import MemberBlock
from livepde.cases.new_case import files_for
from livepde.errors import ConfigurationError, DataError, RunError
from livepde.laws import shadow_kinds
from livepde.models import EQUATIONS
from livepde.streams import FillGaps
from livepde.streams.clock import Clock
from livepde.streams.csvfile import read_csv
from livepde.streams.gaps import fill_table, find_spikes
from livepde.streams.intake import Habit, Intake, Policy
from livepde.streams.join import join_tables
from livepde.streams.oddities import sentinels, switches
from livepde.streams.sources import Rows
from livepde.streams.table import Column, JsonLines, tabulated
from livepde.streams.thinned import Thinned

REPORTS = Path(__file__).parent / "reports"
NAN = math.nan
PERIOD = 0.1
TIMES = PERIOD * np.arange(1, 25)
CHANNELS = ("T_0", "Q")


def rod() -> lp.Model:
    mesh = lp.interval(0.0, 1.0, 12)
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T_0")}),
        {"k": lp.Scalar(lp.LogNormal(0.4, std=0.2))},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, _: x.inputs["Q"] + 0.0 * x[0],
        inputs=["Q"],
    )


SENSORS = lp.Points({"a": 0.4, "b": 0.9}, noise=0.02)
LAWS = {
    "kalman": lp.SensitivityLaw(shadows=None, verdict=False),
    "refit": lp.SensitivityLaw(refit=lp.laws.Refit(start=8), shadows=None, verdict=False),
    "gradient": lp.GradientLaw(gain=20.0),
}


def identifier(law: Any = LAWS["kalman"], **options: Any) -> lp.Identifier:
    given: dict[str, Any] = {"u0": 0.0, "scheme": lp.ImplicitEuler(), "dt_max": 0.025, **options}
    return lp.Identifier(rod(), SENSORS, law, **given)


def drives(times: np.ndarray) -> np.ndarray:
    """Return values of T_0 and Q with occasional switches between levels."""
    k = np.rint(times / PERIOD).astype(int)
    return np.column_stack([1.0 + 0.5 * (k // 5 % 2), 2.0 * (k // 3 % 2)])


@cache
def readings() -> np.ndarray:
    """Return readings of a rod with k = 0.5 and inputs held until the next reading."""
    truth = identifier(q0={"k": 0.5}, between=dict.fromkeys(CHANNELS, "hold"))
    truth.step(0.0, np.full(2, NAN), row(drives(np.zeros(1))[0]))
    planned = dict(zip(CHANNELS, drives(TIMES).T, strict=True))
    clean = truth.forecast(TIMES, planned).z
    return clean + 0.02 * np.random.default_rng(4).standard_normal(clean.shape)


def row(values: np.ndarray) -> dict[str, float]:
    return dict(zip(CHANNELS, values.tolist(), strict=True))


def close(one: lp.Estimate, other: lp.Estimate, rtol: float = 1e-9) -> None:
    for a, b in ((one.q, other.q), (one.u, other.u), (one.q_std, other.q_std)):
        if a is not None and b is not None:
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


# --- in the steps of an identifier -------------------------------------------------------------


@pytest.mark.parametrize("law", ["kalman", "refit"])
def test_held_inputs_equal_dense_rows_that_repeat_the_value(law: str) -> None:
    """The dense table has input rows at every substep, so that lines are steps."""
    between = dict.fromkeys(CHANNELS, "hold")
    sparse, dense = identifier(LAWS[law], between=between), identifier(LAWS[law], between=between)
    z, values, last = readings(), drives(TIMES), drives(np.zeros(1))[0]
    nothing = np.full(2, NAN)
    for who in (sparse, dense):
        who.step(0.0, nothing, row(last))
    for k, t in enumerate(TIMES.tolist()):
        for part in (1, 2, 3):
            dense.step(t - PERIOD + part * 0.025, nothing, row(last))
        found = dense.step(t, z[k], row(values[k]))
        last = values[k]
        expected = sparse.step(t, z[k], row(values[k]))
        close(expected, found)
    low, high = found["k"].interval()
    assert low < 0.5 < high


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_next_equals_hold_of_the_shifted_column(law: str) -> None:
    held = identifier(LAWS[law], between=dict.fromkeys(CHANNELS, "hold"))
    means = identifier(LAWS[law], between=dict.fromkeys(CHANNELS, "next"))
    z, values = readings(), drives(np.append(0.0, TIMES))
    held.step(0.0, np.full(2, NAN), row(values[0]))
    means.step(0.0, np.full(2, NAN), row(values[0]))
    for k, t in enumerate(TIMES.tolist()):
        # The value held since the last reading is in the row that ends the interval.
        close(held.step(t, z[k], row(values[k + 1])), means.step(t, z[k], row(values[k])))


def test_a_mean_needs_no_reading_before_its_interval() -> None:
    """The first row after the start has the mean of the first interval; nothing is extrapolated."""
    z, values = readings(), drives(TIMES)
    for between, held in (("next", ()), ("line", ("Q",)), ("hold", ("Q",))):
        who = identifier(between={"Q": between})
        assert who.step(TIMES[0], z[0], row(values[0])).held == held


def test_a_missing_held_value_is_not_a_gap() -> None:
    dense, sparse = (identifier(between=dict.fromkeys(CHANNELS, "hold")) for _ in range(2))
    z, values, last = readings(), drives(TIMES), {}
    for k, t in enumerate(TIMES.tolist()):
        new = {name: x for name, x in row(values[k]).items() if last.get(name) != x}
        last |= new
        found = sparse.step(t, z[k], new)
        close(dense.step(t, z[k], row(values[k])), found)
        assert not k or found.held == ()
    between = dict.fromkeys(CHANNELS, "next")
    mean = identifier(between=between)
    mean.step(TIMES[0], z[0], row(values[0]))
    assert mean.step(TIMES[1], z[1], {"T_0": 1.0}).held == ("Q",)
    fleet = lp.Fleet(rod(), SENSORS, LAWS["kalman"], 2, u0=0.0, between=between)
    first = fleet.step(TIMES[0], [z[0], z[0]], row(values[0]))  # means require no value at t0
    assert [first.member(k).held for k in range(2)] == [(), ()]


def test_a_sensor_reads_the_input_of_its_row() -> None:
    """A voltage drop is proportional to the current, which switches at a sample."""
    sensor = lp.observation.Calibrated(
        lp.Points({"V": 0.9}), lambda c, q, x: c + 10.0 * x.inputs["Q"], inputs=("Q",), noise=0.1
    )
    for between in ("hold", "next", "line"):
        who = lp.Identifier(rod(), sensor, LAWS["kalman"], u0=0.0, between={"Q": between})
        who.step(0.0, [NAN], {"T_0": 0.0, "Q": 0.0})
        found = who.forecast([1e-6], {"T_0": [0.0], "Q": [3.0]})
        assert found["V"][0] == pytest.approx(30.0, abs=1e-3)


def test_a_forecast_holds_the_value_until_the_next_time() -> None:
    for between, rises in (("hold", False), ("next", True), ("line", True)):
        who = identifier(between={"Q": between})
        who.step(0.0, np.full(2, NAN), {"T_0": 0.0, "Q": 0.0})
        found = who.forecast([0.5, 1.0], {"T_0": 0.0, "Q": [2.0, 2.0]})
        assert (found["b"][0] > 0.1) == rises
        assert found["b"][1] > 0.1


def test_a_checkpoint_continues_the_same_behaviour_and_no_other() -> None:
    between = {"T_0": "hold", "Q": "next"}
    who, z, values = identifier(between=between), readings(), drives(TIMES)
    for k in range(10):
        who.step(TIMES[k], z[k], row(values[k]))
    again, other = identifier(between=between), identifier(between={"T_0": "hold"})
    again.restore(who.dump())
    for k in range(10, 20):
        expected = who.step(TIMES[k], z[k], row(values[k]))
        found = again.step(TIMES[k], z[k], row(values[k]))
        np.testing.assert_array_equal(found.q, expected.q)
    with pytest.raises(RunError, match="another scheme, dt_max, halvings, between"):
        other.restore(who.dump())


def test_invalid_behaviours_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="'heat' is not an input of this model"):
        identifier(between={"heat": "hold"})
    with pytest.raises(ConfigurationError, match="got 'step'; expected 'line', 'hold' or 'next'"):
        identifier(between={"Q": "step"})
    with pytest.raises(ConfigurationError, match="expected a mapping from input channel"):
        identifier(between="hold")
    with pytest.raises(TypeError, match="unexpected keyword argument 'hold'"):
        identifier(hold=True)
    with pytest.raises(ConfigurationError, match="'a' is not an input"):
        identifier(between={"a": "hold"})


# --- the error of straight lines ---------------------------------------------------------------


def shifted(times: np.ndarray, values: np.ndarray, between: str) -> dict[str, float]:
    """Return the shifts of k in standard deviations after the given rows of an input."""
    law = lp.SensitivityLaw(shadows=lp.laws.Shadows(step=False, mesh=False))
    who = identifier(law, between={"Q": between}, dt_max=np.inf)
    truth = identifier(q0={"k": 0.5}, between={"Q": "hold"})
    truth.step(0.0, np.full(2, NAN), {"T_0": 0.0, "Q": values[0]})
    z = truth.forecast(times[1:], {"T_0": 0.0, "Q": values[1:]}).z
    estimate = who.step(0.0, np.full(2, NAN), {"T_0": 0.0, "Q": values[0]})
    for t, shown, q in zip(times[1:].tolist(), z, values[1:].tolist(), strict=True):
        estimate = who.step(t, shown, {"T_0": 0.0, "Q": q})
    return {kind: abs(size) for kind, size in estimate.diagnostics.shifts.sizes.items()}


def test_a_step_in_two_rows_has_no_curvature(monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.arange(0.0, 4.0, PERIOD)
    whole, before = 5.0 * (times > 2.0), 2.1 - 1e-3
    k = int(np.searchsorted(times, before))
    rows = np.insert(times, k, before), np.insert(whole, k, 0.0)
    assert shifted(*rows, "line")["input"] < 0.02
    monkeypatch.setattr(shadow_kinds, "SHORT", 0.0)
    assert shifted(*rows, "line")["input"] > 1.0  # as for a curve with this slope


@pytest.mark.slow
def test_held_inputs_have_no_curvature() -> None:
    times = np.arange(0.0, 4.0, PERIOD)
    for between in ("hold", "next"):
        sizes = shifted(times, 5.0 * (times > 2.0), between)
        # T_0 is linear and constant.
        assert sizes["input"] == 0.0
        assert sizes["hold"] == 0.0


# --- spikes and gaps ---------------------------------------------------------------------------


def two_rows() -> tuple[np.ndarray, np.ndarray]:
    """Return a rate that switches every 20 min, with the old rate repeated one second before."""
    t = 60.0 * np.arange(200)
    x = np.array([0.0, 8.0, 12.0, 15.5])[np.arange(200) // 20 % 4]
    at = np.flatnonzero(np.diff(x)) + 1
    return np.insert(t, at, t[at] - 1.0), np.insert(x, at, x[at - 1])


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_step_in_two_rows_is_not_a_spike_but_an_adjacent_spike_is(noise: float) -> None:
    t, x = two_rows()
    x = x + noise * np.random.default_rng(1).standard_normal(len(x))
    assert not find_spikes(t, x).any()
    wild = 70
    x[wild] += 50.0
    assert np.flatnonzero(find_spikes(t, x)).tolist() == [wild]


def test_noise_at_a_step_of_another_channel_is_not_a_spike() -> None:
    """If a channel is sampled at switches of another, the cubic fit once took noise for slopes."""
    t, _ = two_rows()
    for seed in range(20):
        noise = 0.1 * np.random.default_rng(seed).standard_normal(len(t))
        assert not find_spikes(t, 10.0 + 3.0 * np.sin(t / 4000.0) + noise).any()


def test_a_value_between_two_near_rows_that_does_not_stay_is_a_spike() -> None:
    t = np.sort(np.append(60.0 * np.arange(60), 1801.0))
    x = np.sin(t / 600.0)
    k = int(np.searchsorted(t, 1801.0))
    assert not find_spikes(t, x).any()
    x[k] += 30.0
    assert np.flatnonzero(find_spikes(t, x)).tolist() == [k]


HELD = {"hold": Column(("h",), between="hold"), "mean": Column(("m",), between="next")}
COLUMNS = {"a": Column(("a",)), **HELD}


def test_held_channels_are_not_screened_for_spikes_and_gaps() -> None:
    t = np.arange(40.0)
    h, m = np.full(40, 1.0), np.full(40, 2.0)
    h[20], m[20], h[10:13], m[10:13] = 90.0, 90.0, NAN, NAN
    m[13] = 5.0
    table = tabulated(t, {"a": t, "h": h, "m": m}, COLUMNS, Clock("t"))
    filled = fill_table(table, ["mean"], [], means=["mean"])
    np.testing.assert_array_equal(filled.values[:, 1], h)
    np.testing.assert_array_equal(filled.values[9:15, 2], [2.0, 5.0, 5.0, 5.0, 5.0, 2.0])
    assert filled.values[20, 2] == 90.0
    assert dict(filled.remarks) == {("interpolated", "mean"): 3}
    stage = FillGaps(["hold", "mean"], between={"hold": "hold", "mean": "next"})
    rows = [(sample.t, dict(sample.z)) for sample in table]
    found = np.array([[s.z["hold"], s.z["mean"]] for s in stage(rows)])
    np.testing.assert_array_equal(found, filled.values[:, 1:])
    with pytest.raises(ConfigurationError, match="expected 'line', 'hold' or 'next'"):
        FillGaps(["hold"], between={"hold": "linear"})  # type: ignore[dict-item]


def test_omitted_rows_keep_switches_and_means() -> None:
    t = np.arange(12.0)
    h = np.array([1.0, NAN, NAN, NAN, 0.0, NAN, NAN, 1.0, NAN, NAN, NAN, NAN])
    m = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, NAN, 7.0, 8.0, 9.0, 10.0, 11.0])
    columns = {"a": t, "h": h, "m": m}
    table = tabulated(t, columns, COLUMNS, Clock("t"), every=5)
    np.testing.assert_array_equal(table.t, [0.0, 4.0, 5.0, 7.0, 10.0])
    np.testing.assert_array_equal(table.values[:, 0], [0.0, NAN, 5.0, NAN, 10.0])
    np.testing.assert_array_equal(table.values[:, 1], [1.0, 0.0, NAN, 1.0, NAN])
    # Means since the last remaining row: of 1 to 4, 5, twice 7 (one was missing), 8 to 10.
    np.testing.assert_array_equal(table.values[:, 2], [0.0, 2.5, 5.0, 7.0, 9.0])
    lines = [
        json.dumps({"t": s, "a": s, "h": None if x != x else x, "m": None if y != y else y})
        for s, x, y in zip(t.tolist(), h.tolist(), m.tolist(), strict=True)
    ]
    each = list(JsonLines(lines, COLUMNS, Clock("t"), every=5))
    np.testing.assert_array_equal([one.t for one in each], table.t)
    np.testing.assert_array_equal([list(one.z.values()) for one in each], table.values)
    plain = {name: Column(column.names) for name, column in COLUMNS.items()}
    assert len(tabulated(t, columns, plain, Clock("t"), every=5)) == 3


def test_every_nth_row_keeps_the_input_integral(tmp_path: Path) -> None:
    """A thinned table has the input integral of the whole table, however `every` is written."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.5, 1.5, 200))
    x = rng.integers(0, 2, 200).astype(float)
    for between in ("hold", "next"):
        rows, integral = Thinned([between]), 0.0
        last_t, last = NAN, NAN
        for k in range(200):
            chosen = k % 7 == 0 or k == 199
            found = rows.take(float(t[k]), x[k : k + 1], chosen=chosen, whole=True)
            if found is None:
                continue
            if k:
                integral += (t[k] - last_t) * (last if between == "hold" else found[0])
            last_t, last = float(t[k]), float(found[0])
        held = x[:-1] if between == "hold" else x[1:]
        assert integral == pytest.approx(float(np.diff(t) @ held), rel=1e-12)


def test_a_row_without_a_needed_sensor_keeps_its_switch() -> None:
    needed = {"a": Column(("a",), needed=True), "h": Column(("h",), between="hold")}
    t, a = np.arange(6.0), np.array([NAN, 1.0, NAN, 1.0, 1.0, NAN])
    h = np.array([5.0, NAN, 7.0, NAN, NAN, NAN])
    table = tabulated(t, {"a": a, "h": h}, needed, Clock("t"))
    np.testing.assert_array_equal(table.t, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(table.values[:, 1], [5.0, 7.0, NAN, NAN])
    assert dict(table.remarks) == {("skipped", "a"): 3}
    late = tabulated(t, {"a": a, "h": h}, needed, Clock("t", start=2.5))
    np.testing.assert_array_equal(late.values[:, 1], [7.0, NAN])  # the value before the start


def test_a_value_that_is_repeated_keeps_no_row_without_a_needed_channel() -> None:
    columns = {
        "s": Column(("s",)),
        "a": Column(("a",), needed=True),
        "h": Column(("h",), between="hold"),
    }
    t = np.arange(6.0)
    known = {"s": t, "a": [1.0, NAN, NAN, NAN, 1.0, 1.0], "h": [5.0, 5.0, 5.0, 7.0, 7.0, 7.0]}
    expected = [0.0, 3.0, 4.0, 5.0]
    assert tabulated(t, known, columns, CLOCK).t.tolist() == expected
    rows = [{"t": s} | {n: x[k] for n, x in known.items()} for k, s in enumerate(t.tolist())]
    lines = [json.dumps(row).replace("NaN", "null") for row in rows]
    assert [one.t for one in JsonLines(lines, columns, CLOCK)] == expected
    sink = Intake(columns, CLOCK, Policy(channels={"h": Habit(0.0, None, False, False, "hold")}))
    outcomes = [sink.take(row, row["t"]) for row in rows] + [sink.flush()]
    assert [one.t for outcome in outcomes for one in outcome.ready] == expected
    parts = [{n: replace(columns[n], needed=False)} for n in columns]
    tables = [tabulated(t, known, part, CLOCK) for part in parts]
    joined = join_tables(tables, 1.0, ["s"], ["a"], "data", {"h": "hold"}, together=True)
    assert joined.t.tolist() == expected


def test_what_held_before_the_start_of_the_data_holds_in_each_kind_of_source() -> None:
    rows = [{"t": 0.0, "h": 7.0, "a": 0.0}, *({"t": float(k), "a": float(k)} for k in range(1, 6))]
    rows.append({"t": 6.0, "h": 9.0, "a": 6.0})  # after the switch, while the first samples wait
    columns = {"a": Column(("a",)), "h": Column(("h",), between="hold")}
    clock = Clock("t", start=3, stop=5)
    known = {n: [one.get(n, NAN) for one in rows] for n in ("a", "h")}
    table = tabulated([one["t"] for one in rows], known, columns, clock)
    lines = [*JsonLines([json.dumps(one) for one in rows], columns, clock)]
    habits = {"h": Habit(0.0, None, False, False, "hold")}
    sink = Intake(columns, clock, Policy(wait=9.0, channels=habits))
    outcomes = [sink.take(one, one["t"]) for one in rows] + [sink.flush()]
    live = [one for outcome in outcomes for one in outcome.ready]
    np.testing.assert_array_equal(table.t, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(table.values[:, 1], [7.0, NAN, NAN])
    np.testing.assert_array_equal([one.z["h"] for one in lines], table.values[:, 1])
    assert [one.t for one in live] == table.t.tolist()
    assert [one.values.get("h") for one in live] == [7.0, None, None]


def test_a_live_intake_has_the_samples_of_the_table() -> None:
    """A controller logs its heater only at changes, between the rows of the sensor."""
    rng = np.random.default_rng(8)
    rows: list[dict[str, float]] = [{"t": float(k), "a": float(k)} for k in range(60)]
    rows[0] |= {"h": 0.0, "m": 0.0}
    state = 0.0
    for at in np.sort(rng.uniform(0.0, 58.0, 7)):
        state = 1.0 - state
        rows.append({"t": float(at), "h": state})
    rows[-1]["m"] = 4.0
    rows.sort(key=lambda one: one["t"])
    rows[-1]["m"] = 6.0
    habits = {
        "hold": Habit(0.0, None, False, False, "hold"),
        "mean": Habit(100.0, None, True, False, "next"),
    }
    sink = Intake(COLUMNS, CLOCK, Policy(channels=habits))
    outcomes = [sink.take(one, one["t"]) for one in rows] + [sink.flush()]
    ready = [one for outcome in outcomes for one in outcome.ready]
    kinds = {(r.kind, r.channel) for outcome in outcomes for r in outcome.remarks}
    columns = {n: [one.get(n, NAN) for one in rows] for n in ("a", "h", "m")}
    table = tabulated([one["t"] for one in rows], columns, COLUMNS, CLOCK)
    filled = fill_table(table, ["mean"], [], means=["mean"])
    assert [one.t for one in ready] == filled.t.tolist()
    live = [[one.values.get(name, NAN) for name in COLUMNS] for one in ready]
    np.testing.assert_array_equal(live, filled.values)
    assert ("missing", "hold") not in kinds
    assert ("interpolated", "mean") in kinds


def test_a_log_of_changes_is_joined_with_what_held_before() -> None:
    sensors = tabulated(10.0 + np.arange(6.0), {"a": np.arange(6.0)}, {"a": COLUMNS["a"]}, CLOCK)
    log = {"h": np.array([1.0, 0.0, 1.0]), "m": np.array([3.0, 4.0, 5.0])}
    changes = tabulated(np.array([2.0, 12.5, 20.0]), log, HELD, CLOCK)
    between = {"hold": "hold", "mean": "next"}
    found = join_tables([sensors, changes], 1.0, ["a"], ["a"], "here", between, together=True)  # type: ignore[arg-type]
    np.testing.assert_array_equal(found.t, [10.0, 11.0, 12.0, 12.5, 13.0, 14.0, 15.0, 20.0])
    k = [found.names.index(name) for name in ("a", "hold", "mean")]
    np.testing.assert_array_equal(found.values[0, k], [0.0, 1.0, 4.0])
    # The row of the log has no reading of the required sensor, but its inputs are used.
    np.testing.assert_array_equal(found.values[3, k], [NAN, 0.0, 4.0])
    np.testing.assert_array_equal(found.values[-1, k], [NAN, 1.0, 5.0])


def test_a_log_whose_last_change_was_before_the_sensors_is_joined() -> None:
    sensors = tabulated(10.0 + np.arange(3.0), {"a": np.arange(3.0)}, {"a": COLUMNS["a"]}, CLOCK)
    hold = {"hold": HELD["hold"]}
    log = tabulated(np.array([2.0, 5.0]), {"h": np.array([1.0, 7.0])}, hold, CLOCK)
    found = join_tables([sensors, log], 1.0, ["a"], [], "here", {"hold": "hold"}, together=True)
    np.testing.assert_array_equal(found.t, sensors.t)
    assert found.values[0, found.names.index("hold")] == 7.0
    with pytest.raises(DataError, match="no time in common"):  # lines end at the last reading
        join_tables([sensors, log], 1.0, ["a"], [], "here", together=True)


@pytest.mark.parametrize("together", [True, False])
def test_readings_before_another_file_of_sensors_are_used_or_counted(together: bool) -> None:
    """An initial profile needs all sensors; a pumping test begins with readings of one sensor."""
    first = tabulated(np.arange(6.0), {"a": np.arange(6.0)}, {"a": COLUMNS["a"]}, CLOCK)
    other = {"b": Column(("b",))}
    later = tabulated(2.0 + np.arange(4.0), {"b": np.arange(4.0)}, other, CLOCK)
    found = join_tables([first, later], 1.0, ["a", "b"], [], "here", together=together)
    assert len(found.t) == (4 if together else 6)
    assert found.remarks.get(("early", "a"), 0) == (2 if together else 0)
    assert np.isfinite(found.values).all() == together


def test_a_live_intake_remembers_what_held_before_its_first_sample() -> None:
    """The heater is logged once, before the first reading of the required sensor."""
    needed = {"a": Column(("a",), needed=True), "h": Column(("h",), between="hold")}
    habits = {"h": Habit(0.0, None, False, False, "hold")}
    sink = Intake(needed, CLOCK, Policy(channels=habits))
    rows = [{"t": 0.0, "h": 800.0}, {"t": 1.0, "a": 1.0}, {"t": 2.0, "a": 2.0}]
    outcomes = [sink.take(one, one["t"]) for one in rows] + [sink.flush()]
    first, *others = [one for outcome in outcomes for one in outcome.ready]
    assert (first.t, first.values) == (1.0, {"a": 1.0, "h": 800.0})
    assert all("h" not in one.values for one in others)


# --- in cases ----------------------------------------------------------------------------------


def test_switched_inputs_are_recognised_and_measured_values_are_not() -> None:
    t, rng = np.arange(200.0), np.random.default_rng(2)
    pump = np.array([0.0, 8.0, 12.0, 15.5])[np.arange(200) // 20 % 4]
    heater = 500.0 * (np.arange(200) // 11 % 2)
    once = np.where(np.arange(200) % 40 == 0, np.arange(200) // 40 % 2, NAN)
    only_changes = np.where(np.diff(heater, prepend=-1.0) != 0.0, heater, NAN)
    coarse = np.round(20.0 + 3.0 * np.sin(t / 30.0), 1)
    for values, expected in (
        (pump, True),
        (heater, True),
        (only_changes, True),
        (once, True),  # logged at five changes
        (coarse, False),
        (pump + 0.01 * rng.standard_normal(200), False),
        (np.full(200, 7.0), False),
        (np.full(200, NAN), False),
    ):
        assert switches(t, values) == expected
    assert not switches(*two_rows())  # the rows state the steps
    assert sentinels(pump) == []  # a pump level is not a code for missing readings
    assert [one.value for one in sentinels(np.append(pump, 9999.0))] == [9999.0]


def test_init_proposes_the_behaviour_that_the_table_shows(tmp_path: Path) -> None:
    text = (REPORTS / "pumping_steps.csv").read_text().replace("pump rate [L/s]", "Q [L/s]")
    (tmp_path / "well.csv").write_text(text)
    equation = EQUATIONS["pumping_test"]
    table = measured(tmp_path / "well.csv", equation.time_unit)
    case = files_for(table, tmp_path / "new", equation)["case.toml"]
    assert 'column = "Q [L/s]", unit = "L/s", between = "hold" }' in case
    assert "missing = [9999.0]" in case


def pumping(tmp_path: Path, more: str = "", data: str = "pumping_steps.csv") -> Path:
    text = (REPORTS / "pumping_steps.toml").read_text()
    text = text.replace('unit = "L/s"', f'unit = "L/s"{more}').replace("pumping_steps.csv", data)
    path = tmp_path / "case.toml"
    path.write_text(text)
    for file in REPORTS.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return path


def switched(tmp_path: Path, name: str = "case.toml", factor: float = 1.0) -> Path:
    """Write a case of a column whose inlet is logged only at changes."""
    lines = (REPORTS / "column_pulse.csv").read_text().splitlines()
    rows, last = lines[:1], ""
    for line in lines[1:]:
        t, c, inlet = line.split(",")
        c = str(factor * float(c)) if c else ""
        rows.append(f"{t},{c},{inlet if inlet != last else ''}")
        last = inlet
    data = tmp_path / name.replace(".toml", ".csv")
    data.write_text("\n".join(rows) + "\n")
    text = (REPORTS / "column_pulse.toml").read_text().replace("column_pulse.csv", data.name)
    text = text.replace('"c_in" }', '"c_in", between = "hold" }').replace(
        "cells = 100", "cells = 30"
    )
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.slow
def test_a_live_run_of_a_log_of_changes_is_the_batch_run(tmp_path: Path) -> None:
    path = switched(tmp_path)
    # Rows without values split a step of the batch run, so both runs need equal steps.
    stated = "noise = 0.01, shadows = { parts = 1 } }"
    path.write_text(path.read_text().replace("noise = 0.01 }", stated))
    prepared = cases.load(path).prepare()
    (expected,) = deque(
        (prepared.identifier.step(one.t, one.z, one.inputs) for one in prepared.stream), maxlen=1
    )
    header, *lines = (tmp_path / "case.csv").read_text().splitlines()
    cells = [zip(header.split(","), line.split(","), strict=True) for line in lines]
    rows = [{name: float(cell) for name, cell in row if cell} for row in cells]
    with LiveCase(cases.load(path), Rows(rows), path=tmp_path / "journal.sqlite") as wiring:
        live = wiring.live()
        live.run()
        found = live.identifier.estimate()
    assert found.t == expected.t
    np.testing.assert_allclose(found.q, expected.q, rtol=1e-9)
    assert not any(finding.what == "input" for finding in expected.verdict.findings)


@pytest.mark.slow
def test_a_block_of_members_has_the_behaviour_of_the_case(tmp_path: Path) -> None:
    paths = {name: switched(tmp_path, f"{name}.toml", x) for name, x in (("a", 1.0), ("b", 1.01))}
    block = MemberBlock({name: cases.load(path).prepare() for name, path in paths.items()})
    singles = {name: cases.load(path).prepare().identifier for name, path in paths.items()}
    tables = {name: cases.load(path).prepare().stream for name, path in paths.items()}
    for one, other in zip(*tables.values(), strict=True):
        z = {name: [one.z[name], other.z[name]] for name in one.z}
        found = block.fleet.step(one.t, z)
        each = [singles["a"].step(one.t, one.z), singles["b"].step(other.t, other.z)]
        for k, expected in enumerate(each):
            np.testing.assert_allclose(found.q[k], expected.q, rtol=1e-6)


# --- cases that users reported -----------------------------------------------------------------


def run(path: Path, **settings: Any) -> lp.Estimate:
    prepared = cases.load(path, settings=settings).prepare() if settings else None
    prepared = prepared or cases.load(path).prepare()
    result = prepared.identifier.run(prepared.stream)
    return result.last


def holds(estimate: lp.Estimate, **truths: float) -> None:
    assert estimate.verdict.level == "trusted"
    for name, truth in truths.items():
        low, high = estimate[name].interval()
        assert low <= truth <= high, (name, low, high)
        assert high - low < 0.15 * truth, (name, low, high)


def with_two_rows(source: Path, target: Path) -> None:
    """Write the table with the old rate in a row one second before each step, as a user did."""
    header, *lines = source.read_text().splitlines()
    rows, before = [], None
    for line in lines:
        date, rate, s1, s2 = line.split(",")
        if before is not None and rate != before:
            day, clock = date.split()
            hour, minute = map(int, clock.split(":"))
            hour, minute = (hour, minute - 1) if minute else (hour - 1, 59)
            rows.append(f"{day} {hour:02d}:{minute:02d}:59,{before},,")
        rows.append(f"{date}:00,{rate},{s1},{s2}")
        before = rate
    target.write_text("\n".join([header, *rows]) + "\n")


@pytest.mark.long
@pytest.mark.parametrize("table", ["held", "two rows"])
def test_a_pumping_test_with_rate_steps_finds_its_truth(tmp_path: Path, table: str) -> None:
    """Data from finite volumes with Theis: true T 4.2e-3 m^2/s, S 3.1e-4; b = 1 m."""
    path = pumping(tmp_path, ', between = "hold"' if table == "held" else "")
    if table != "held":
        source = tmp_path / "pumping_steps.csv"
        with_two_rows(source, source)
        path.write_text(path.read_text().replace("%H:%M", "%H:%M:%S"))
    holds(run(path), k=4.2e-3, Ss=3.1e-4)


@pytest.mark.long
@pytest.mark.parametrize("between", ["line", "hold"])
def test_a_tracer_pulse_through_a_column_finds_its_truth(tmp_path: Path, between: str) -> None:
    """Data from the analytic solution: true v 27 cm/h, D 16.2 cm^2/h."""
    text = (REPORTS / "column_pulse.toml").read_text()
    path = tmp_path / "case.toml"
    path.write_text(text.replace('"c_in" }', f'"c_in", between = "{between}" }}'))
    (tmp_path / "column_pulse.csv").write_bytes((REPORTS / "column_pulse.csv").read_bytes())
    estimate = run(path)
    holds(estimate, v=27.0, D=16.2)
    low, high = estimate["v"].interval()
    assert high - low < 0.5  # the data allow ±0.19


def test_a_table_of_two_rows_is_read_unchanged(tmp_path: Path) -> None:
    with_two_rows(REPORTS / "pumping_steps.csv", tmp_path / "well.csv")
    columns = {"Q": Column(("pump rate [L/s]",))}
    table = read_csv(tmp_path / "well.csv", columns, Clock("date", format="%d/%m/%Y %H:%M:%S"))
    assert len(table) == 1415
    filled = fill_table(table, ["Q"], ["Q"])
    assert filled.remarks == table.remarks  # nothing is refused
    np.testing.assert_array_equal(filled.values, table.values)


def test_an_input_that_is_off_is_not_missing(tmp_path: Path) -> None:
    # In a thermal response test, the power fluctuates while on, and is zero during the recovery.
    rng = np.random.default_rng(1)
    hours = np.arange(60.0)
    on = hours < 40.0
    power = np.where(on, 7.2 + 0.01 * rng.standard_normal(60), 0.0).round(3)
    fluid = np.where(hours == 50.0, -127.0, 12.0 + on * np.log1p(hours)).round(2)
    rows = np.column_stack([hours, power, fluid])
    table = tmp_path / "trt.csv"
    np.savetxt(table, rows, "%g", ",", header="t [h],P [kW],T_f", comments="")
    equation = EQUATIONS["borehole"]
    found = measured(table, equation.time_unit)
    text = files_for(found, tmp_path / "mine", equation)["case.toml"]
    assert "missing = [-127.0]" in text
    assert 'between = "hold"' in text
    assert switches(hours, power, off=True)
    assert not switches(hours, power + 0.01 * rng.standard_normal(60), off=True)
