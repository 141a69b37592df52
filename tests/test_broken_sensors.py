"""Broken sensors and disturbed processes do not spoil what was estimated before."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from broken_rod import ALPHA, AT, LENGTH, NOISE, STEP, case_text, left, readings, table
from commands import call
from factories import usual
from typer.testing import CliRunner

import livepde as lp
from livepde import cases, runs
from livepde.cli import app
from livepde.laws.gate import Gate, Screened
from livepde.models import heat
from livepde.runs.summary import channel_errors, tables
from livepde.streams.oddities import sentinels, wild_first_rows

FIRST = 100  # row of the first broken reading
NAMES = ("T_1", "T_2", "T_3")


def model():
    ends = {"left": lp.Channel("T_left"), "right": 20.0}
    return heat(lp.interval(0.0, LENGTH, 16), lp.Normal(5e-5, std=3e-5), ends)


def rod(law=None, which=(0, 1, 2)):
    points = lp.Points({NAMES[k]: AT[k] for k in which}, noise=NOISE)
    return lp.Identifier(model(), points, law or lp.SensitivityLaw(shadows=None), u0=20.0)


def run(z, who=None, first=0):
    who = who or rod()
    rows = enumerate(z.tolist(), first)
    return [who.step(k * STEP, row, {"T_left": left(k * STEP)}) for k, row in rows]


@cache
def missing(rows, count, sensors):
    """The estimate where the broken readings are missing instead."""
    z = broken(count, np.nan, sensors, rows)
    return run(z)[-1].parameters["alpha"]


def broken(count, value, sensors=(1,), rows=None):
    """Readings with so many broken ones from row FIRST on, and then 50 good ones."""
    z = readings(rows or FIRST + count + 50)
    z[FIRST : FIRST + count, sensors] = value
    return z


def near(estimate, reference):
    """Value within the interval, at most 1.2 times as wide as without the broken readings."""
    (value, std), (expected, usual) = estimate.parameters["alpha"], reference
    assert std < 1.2 * usual
    assert abs(value - expected) < usual
    # The mesh of 16 cells shifts alpha by less than a part in a hundred.
    assert abs(value - ALPHA) < 0.01 * ALPHA


BROKEN = {
    "-127, 50 rows": (50, -127.0, (1,)),
    "all sensors disturbed": (60, 28.0 + 3.0 * np.sin(np.arange(60.0))[:, None], (0, 1, 2)),
    "stuck in its range": (60, 21.5, (1,)),
    "two sensors, one varies": (
        40,
        np.stack([np.full(40, -127.0), 40.0 + np.sin(np.arange(40.0))], axis=1),
        (0, 1),
    ),
    "-127, 8 rows": (8, -127.0, (1,)),
    "-9999, 20 rows": (20, -9999.0, (0,)),
    "varies outside": (30, np.resize([-127.0, 85.0, 300.0], (30, 1)), (1,)),
    "two sensors stuck": (40, -127.0, (0, 2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", usual(BROKEN, often=4))
def test_what_was_learned_stays(name):
    z = broken(*BROKEN[name])
    found = run(z)
    count, _, sensors = BROKEN[name]
    near(found[-1], missing(len(z), count, sensors))
    bad = [found[k].diagnostics.refused for k in range(FIRST, len(z) - 50)]
    assert min(bad) >= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("value", [-127.0, -9999.0])
def test_the_only_sensor_is_not_believed_either(value):
    z = broken(30, value, (0,))[:, :1]
    found = run(z, rod(which=(0,)))
    z[FIRST : FIRST + 30] = np.nan
    near(found[-1], run(z, rod(which=(0,)))[-1].parameters["alpha"])
    assert [e.diagnostics.refused for e in found[FIRST : FIRST + 30]] == [1.0] * 30


@pytest.mark.slow
def test_a_sensor_that_is_set_aside_is_named_until_it_fits_again():
    z = broken(40, -127.0)
    found = run(z)
    for k, expected in ((FIRST + 5, []), (FIRST + 20, ["T_2"]), (len(z) - 1, [])):
        findings = found[k].verdict.findings
        assert [one.subject for one in findings if one.what == "aside"] == expected
    (aside,) = (one for one in found[FIRST + 20].verdict.findings if one.what == "aside")
    assert f"t = {FIRST * STEP:g} s" in aside.sentence
    assert "missing" in aside.sentence
    # After `gate_patience` fitting readings in a row it is used again.
    used = [e.diagnostics.refused == 0.0 for e in found[FIRST + 40 :]]
    assert used == [False] * 9 + [True] * 41


@pytest.mark.long
def test_a_change_that_most_sensors_show_is_followed():
    """Unknowns that may jump are learned anew, and constants are not trusted meanwhile."""
    z = readings(FIRST + 150, change=2.0, after=FIRST)
    law = lp.SensitivityLaw(jumps=lp.Jumps(), shadows=None)
    value, std = run(z, rod(law))[-1].parameters["alpha"]
    assert abs(value - 2 * ALPHA) < max(4 * std, 0.01 * ALPHA)
    # A constant is kept as long as the disturbance may pass, and followed then.
    found = run(readings(FIRST + 220, change=0.5, after=FIRST))
    for k in (FIRST + 40, FIRST + 100):
        assert found[k].verdict.level == "do not trust"
        assert "changed" in [one.what for one in found[k].verdict.findings]
        assert found[k].parameters["alpha"][0] == pytest.approx(ALPHA, rel=0.01)
    value, std = found[-1].parameters["alpha"]
    assert value < 0.95 * ALPHA
    assert abs(value - 0.5 * ALPHA) < 3 * std


@pytest.mark.slow
def test_a_broken_sensor_is_no_jump():
    found = run(broken(40, -127.0), rod(lp.SensitivityLaw(jumps=lp.Jumps(), shadows=None)))
    assert not any(estimate.diagnostics.jump > 0.0 for estimate in found)


@pytest.mark.slow
def test_after_a_pause_the_state_is_anchored_and_the_unknown_kept():
    """In the pause the left end was somewhere else, which no sample says."""
    z, pause = readings(FIRST + 130), 40
    who = rod()
    run(z[:FIRST], who)
    before = who.estimate().parameters["alpha"]
    after = run(z[FIRST + pause :], who, FIRST + pause)
    value, std = after[50].parameters["alpha"]
    assert abs(value - before[0]) < before[1]
    assert std < 1.2 * before[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["-127, 50 rows", "all sensors disturbed"])
def test_a_member_of_a_fleet_and_a_restored_run_are_the_run(name):
    count, *more = BROKEN[name]
    z = broken(count, *more)
    points = lp.Points(dict(zip(NAMES, AT, strict=True)), noise=NOISE)
    fleet = lp.Fleet(model(), points, lp.SensitivityLaw(shadows=None), 2, u0=20.0)
    other, one, again = readings(len(z), seed=3), rod(), rod()
    for k in range(len(z)):
        t, inputs = k * STEP, {"T_left": left(k * STEP)}
        expected = one.step(t, z[k], inputs)
        each = {name: np.full(2, value) for name, value in inputs.items()}
        found = fleet.step(t, np.stack([other[k], z[k]]), each)
        if k == FIRST + count // 2:
            again.restore(one.dump())
        elif k > FIRST + count // 2:
            repeated = again.step(t, z[k], inputs)
            assert np.array_equal(repeated.q, expected.q)
            assert np.array_equal(repeated.u, expected.u)
            assert np.array_equal(repeated.q_std, expected.q_std)
    np.testing.assert_allclose(found.q[1], expected.q, rtol=1e-9)
    near(expected, missing(len(z), count, more[1]))


def test_most_of_those_that_can_be_believed_decide():
    """By definition: three sensors, a patience of two, ranges of ten times the noise."""
    gate, x = Gate(6.0, 2), Screened.start(3)
    ones, no = np.ones((1, 3)), np.zeros((1, 3), dtype=bool)
    for k in range(30):
        x = x.fitted(np.array([[k, k + 0.5, k + 0.7]]), ~no)

    def after(x, z, far):
        return gate(
            x, np.array([z]), np.array([z]) - 30.0, ones, np.array([far]), ~no, 1.0, no[:, 0]
        )

    for z, far, used in (
        ([35.0, 36.0, 31.0], [True, True, False], [True, True, True]),  # two of three
        ([35.0, 31.0, 31.0], [True, False, False], [False, True, True]),  # one of three
        ([-127.0, -127.0, 31.0], [True, True, False], [False, False, True]),  # two constants
        ([-127.0, 36.0, 31.0], [True, True, False], [False, False, True]),  # one of two
        ([35.0, 36.0, 500.0], [True, True, True], [True, True, False]),  # one is absurd
    ):
        now = x
        for k in range(3):
            varied = [v + 0.1 * k if v > 0.0 else v for v in z]
            found = after(now, varied, far)
            now = found.state
        assert found.kept[0].tolist() == used


@pytest.mark.slow
def test_errors_leave_refused_readings_out_and_count_them():
    z = broken(12, -127.0)
    result = rod().run(
        (k * STEP, row, {"T_left": left(k * STEP)}) for k, row in enumerate(z.tolist())
    )
    data = result.to_xarray()
    errors = channel_errors(data)
    refused = {name: item.refused for name, item in errors.items()}
    # 12 broken ones, and the 9 after them by which the sensor shows that it is whole again.
    assert refused == {"T_1": 0, "T_2": 21, "T_3": 0}
    assert all(np.sqrt((item.errors**2).mean()) < 0.5 for item in errors.values())
    (table_,) = (one for one in tables(data) if "refused" in one.columns)
    rows = {row[0]: row[list(table_.columns).index("refused")] for row in table_.rows}
    assert rows == refused
    summary = result.table()
    assert summary["innovation:T_2"]["refused"] == 21.0
    assert summary["innovation:T_2"]["rmse"] < 0.5
    quiet = run_table(readings(60))
    assert "refused" not in quiet.columns


def run_table(z):
    data = (
        rod()
        .run((k * STEP, row, {"T_left": left(k * STEP)}) for k, row in enumerate(z.tolist()))
        .to_xarray()
    )
    return next(one for one in tables(data) if "RMSE" in one.columns)


# First rows.


def driven(folder: Path, z, text=None, **cells):
    folder.mkdir(exist_ok=True)
    (folder / "rod.csv").write_text(table(z, **cells))
    (folder / "case.toml").write_text(text or case_text())
    prepared = cases.load(folder / "case.toml").prepare()
    return prepared, runs.drive(prepared.identifier, prepared.stream).result.last


@pytest.mark.slow
@pytest.mark.parametrize("place", usual(["sensor", "boundary", "all sensors"], often=2))
def test_a_wild_first_row_does_not_make_the_start(tmp_path, place):
    z = readings(120)
    _, expected = driven(tmp_path / "a", z)
    wild, cells = z.copy(), {}
    if place == "boundary":
        cells = {"left_cells": {0: 9999.0}}
    else:
        wild[0, 1 if place == "sensor" else slice(None)] = 85.0
    prepared, found = driven(tmp_path / "b", wild, **cells)
    (value, std), (without, usual) = (e.parameters["alpha"] for e in (found, expected))
    assert abs(value - ALPHA) < 0.01 * ALPHA
    assert abs(value - without) < 2 * usual
    assert std < 1.2 * usual
    counts = {name for (kind, name) in prepared.stream.remarks if kind == "start"}
    assert counts == {"sensor": {"T_2"}, "boundary": {"T_left"}, "all sensors": set(NAMES)}[place]


def test_starts_that_may_be_are_left_alone():
    t, rng = np.arange(40.0), np.random.default_rng(0)
    still = 20.0 + 0.05 * rng.standard_normal(40)
    decays = 20.0 + 60.0 * np.exp(-t / 3.0)
    switched = np.where(t > 0.0, 80.0, 20.0) + 0.05 * rng.standard_normal(40)
    both = np.stack([still, decays, switched], axis=1)
    assert not wild_first_rows(t, both, [[0, 1, 2]]).any()
    # A long first interval may bring a large step, and few rows show nothing.
    late = np.concatenate([[0.0], 5000.0 + t[1:]])
    moved = np.stack([still, np.where(t > 0.0, 50.0 + t, 20.0)], axis=1)
    assert not wild_first_rows(late, moved, [[0, 1]]).any()
    assert not wild_first_rows(t[:3], np.array([[85.0], [20.0], [20.1]]), [[0]]).any()
    hot = np.where(t < 2.0, 85.0, still)
    (rows, columns) = wild_first_rows(t, np.stack([still, hot], axis=1), [[0, 1]]).nonzero()
    assert (rows.tolist(), columns.tolist()) == ([0, 1], [1, 1])


@pytest.mark.parametrize("others", [[], [1.0, -1.0]])
@pytest.mark.parametrize("signs", [[1], [-1], [1, -1], [-1, 1, -1]])
@pytest.mark.parametrize(("at", "is_wild"), [(0, True), (12, False)])
def test_first_rows_as_large_as_numbers_are_judged_as_large_ones(others, signs, at, is_wild):
    """Only the size of what is wild differs, by which no answer depends on it."""
    t = 60.0 * np.arange(25)
    calm = 20.0 + np.sin(np.arange(25.0))
    for size in (1e100, 1.5e308):
        values = np.stack([calm, calm + 0.5], axis=1)
        values[at : at + len(signs), 0] = size * np.array(signs)
        values[5 : 5 + len(others), 1] = size * np.array(others)
        expected = np.zeros(values.shape, dtype=bool)
        expected[at : at + len(signs), 0] = is_wild
        np.testing.assert_array_equal(wild_first_rows(t, values, [[0, 1]]), expected)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["sensor", "boundary"])
def test_a_live_run_waits_for_rows_that_show_a_wild_first_one(tmp_path, place):
    z, cells = readings(60), {}
    if place == "sensor":
        z[0, 1] = 85.0
    else:
        cells = {"left_cells": {0: 9999.0}}
    (tmp_path / "rod.csv").write_text(table(z, **cells))
    (tmp_path / "case.toml").write_text(case_text())
    command = ["run", str(tmp_path / "case.toml"), "--realtime", "--speed", "inf"]
    done = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    opened = runs.open(tmp_path / "run")
    name = {"sensor": "T_2", "boundary": "T_left"}[place]
    with runs.Journal.open(tmp_path / "run" / runs.JOURNAL) as journal:
        assert journal.counts["start", name] == 1
    first = opened.dataset["time"].values[0]
    assert first == (0.0 if place == "sensor" else STEP)


# Sentinels.


def test_values_that_stand_for_no_reading_are_recognised():
    x = 20.0 + 5.0 * np.sin(np.arange(100.0))
    assert sentinels(x) == []
    for value in (-127.0, 85.0, -9999.0, 9999.0, 999.9):
        y = x.copy()
        y[40] = value
        (found,) = sentinels(y)
        assert (found.value, found.times) == (value, 1)
        assert found.high == x.max() if found.value < 0 else True
    y = x.copy()
    y[[3, 40]], y[60] = -127.0, 85.0
    assert {one.value for one in sentinels(y)} == {-127.0, 85.0}
    y = x.copy()
    y[[3, 40, 50]] = -17.78  # an unknown constant counts where it is repeated
    assert [one.value for one in sentinels(y)] == [-17.78]
    y[50] = 20.0
    assert sentinels(y) == []
    assert sentinels(np.linspace(60.0, 110.0, 51)) == []  # 85 among others is a reading


def test_init_and_check_propose_them(tmp_path):
    z = readings(60)
    z[[10, 30], 1] = -127.0
    (tmp_path / "rod.csv").write_text(table(z))
    (tmp_path / "case.toml").write_text(case_text())
    done = CliRunner().invoke(app, ["check", str(tmp_path / "case.toml")])
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "T_2: -127 occurs 2 times" in said
    assert "`data.missing`" in said
    out = tmp_path / "new"
    done = CliRunner().invoke(app, ["init", str(out), "--data", str(tmp_path / "rod.csv")])
    assert done.exit_code == 0, done.output
    assert "missing = [-127" in (out / "case.toml").read_text()


def test_a_placeholder_of_the_table_is_refused_with_an_empty_setting(tmp_path):
    # -9999 of a table in which it may be a reading, as the user states.
    rows = [f"{t},{20 + t % 7}.5" for t in range(20)]
    (tmp_path / "own.csv").write_text("\n".join(["time_s,T_5cm", *rows, "20,-9999"]))
    for settings, kept in (((), True), (("--set", "data.missing="), False)):
        folder = tmp_path / f"mine{len(settings)}"
        assert call("init", folder, "--data", tmp_path / "own.csv", *settings)[0] == 0
        assert ("missing = [-9999.0]" in (folder / "case.toml").read_text()) == kept
