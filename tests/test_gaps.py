"""Gaps and spikes of input and boundary channels are interpolated or refused, and reported."""

import math
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from factories import ROD_CASE
from live_rod import CLOCK

import livepde as lp
from livepde import cases, runs
from livepde.cases.live_case import LiveCase
from livepde.cli.run import concluded, run_batch, writer_of
from livepde.streams import DataTable, FillGaps
from livepde.streams.gaps import bridged, fill_table, filled_column, find_spikes
from livepde.streams.intake import Habit, Intake, Policy
from livepde.streams.sources import Rows
from livepde.streams.table import Column

DAY = 86400.0


def channel(seed: int, n: int = 400, noise: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values of a temperature with a daily cycle and a slow walk."""
    rng = np.random.default_rng(seed)
    t = 1800.0 * np.arange(n)
    walk = 0.02 * np.cumsum(rng.standard_normal(n))
    return t, 10.0 + 8.0 * np.sin(2.0 * np.pi * t / DAY) + walk + noise * rng.standard_normal(n)


# --- interpolation -----------------------------------------------------------------------------


def test_a_gap_is_better_interpolated_than_held_and_by_pchip_than_by_lines():
    errors = []
    for seed in range(10):
        t, x = channel(seed)
        gap = np.random.default_rng(100 + seed).random(len(t)) < 0.3
        gap[[0, -1]] = False
        known = np.flatnonzero(~gap)
        filled, interpolated, _ = filled_column(t, np.where(gap, np.nan, x))
        assert np.array_equal(interpolated, gap)
        assert np.array_equal(filled[known], x[known])
        held = x[known][np.searchsorted(known, np.arange(len(t)), side="right") - 1]
        lines = np.interp(t, t[known], x[known])
        errors.append([np.std((guess - x)[gap]) for guess in (filled, lines, held)])
    pchip, line, hold = np.mean(errors, axis=0)
    assert pchip < 0.8 * line
    assert line < 0.3 * hold


def test_what_is_not_between_known_values_stays_missing():
    t, x = np.arange(6.0), np.array([np.nan, 1.0, np.nan, 3.0, np.nan, np.nan])
    filled, gaps, _ = filled_column(t, x)
    assert np.array_equal(filled, [np.nan, 1.0, 2.0, 3.0, np.nan, np.nan], equal_nan=True)
    assert gaps.tolist() == [False, False, True, False, False, False]
    assert math.isnan(bridged(1.0, [(0.0, 1.0)], []))
    assert math.isnan(bridged(1.0, [], [(2.0, 1.0)]))


# --- spikes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [5.0, -10.0, 9999.0])
def test_single_values_far_off_are_found_and_no_others(size):
    for seed in range(10):
        t, x = channel(seed)
        assert not find_spikes(t, x).any()
        k = int(np.random.default_rng(seed).integers(2, len(t) - 2))
        x[k] += size
        assert np.flatnonzero(find_spikes(t, x)).tolist() == [k]


def test_values_of_any_size_are_screened():
    t, x = channel(0)
    x[200:] = 1e300  # a change that stays
    assert not find_spikes(t, x).any()
    x[200:] = 10.0
    x[100] = 1.7e308
    assert np.flatnonzero(find_spikes(t, x)).tolist() == [100]
    assert not find_spikes(t, np.zeros(len(t))).any()


def test_a_cubic_has_no_spike_at_irregular_times():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 10.0, 200))
    assert not find_spikes(t, t**3 - 20.0 * t**2 + 1e-6 * np.sin(50.0 * t)).any()


@pytest.mark.slow
def test_changes_that_stay_are_no_spikes():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        level = np.repeat(rng.normal(0.0, 10.0, 30), rng.integers(2, 30, 30))
        t = np.arange(len(level)) * 1.0
        assert not find_spikes(t, level).any()
        assert not find_spikes(t, level + 0.02 * rng.standard_normal(len(t))).any()


def test_a_channel_of_two_levels_keeps_its_pulses():
    x = np.zeros(200)
    x[[20, 21, 60, 100]] = 5.0
    assert not find_spikes(np.arange(200.0), x).any()


def test_two_spikes_beside_each_other_need_not_be_isolated_by_many_values():
    t, x = channel(3)
    x[[100, 104]] += 50.0
    assert np.flatnonzero(find_spikes(t, x)).tolist() == [100, 104]


# --- as a stage of a stream --------------------------------------------------------------------


def samples(t, x):
    return [
        (float(s), {"T": 1.0, "left": None if np.isnan(v) else float(v)})
        for s, v in zip(t, x, strict=True)
    ]


def test_the_stage_gives_what_a_whole_record_gives():
    t, x = channel(1, 200)
    x[50] += 40.0
    x[[80, 120, 160]] = np.nan  # two known values on each side
    expected, _, _ = filled_column(t, x)
    stage = FillGaps(["left"])(samples(t, x))
    found = [sample.z["left"] for sample in stage]
    assert np.allclose(found, expected, rtol=0.0, atol=1e-12)
    assert stage.counts == {("spike", "left"): 1, ("interpolated", "left"): 4}


def test_a_sample_waits_no_longer_than_it_is_told():
    t = np.arange(8.0)
    x = np.array([0.0, 1.0, np.nan, np.nan, np.nan, 5.0, np.nan, 7.0])
    for options in ({"wait": 1.0}, {"samples": 1}):
        stage = FillGaps(["left"], spikes=math.inf, **options)(samples(t, x))
        found = [math.nan if v is None else v for v in (s.z["left"] for s in stage)]
        assert np.array_equal(found[5:], [5.0, 6.0, 7.0])
        assert np.isnan(found[2])
        assert stage.counts["missing", "left"] in (1, 2)
        assert stage.counts["missing", "left"] + stage.counts["interpolated", "left"] == 4


def test_only_gaps_wait_where_no_spike_is_looked_for():
    came, t, x = [], np.arange(5.0), np.array([0.0, np.nan, 2.0, 3.0, np.nan])

    def stream():
        for sample in samples(t, x):
            came.append(sample[0])
            yield sample

    lag = [(sample.t, len(came)) for sample in FillGaps(["left"], spikes=math.inf)(stream())]
    assert lag == [(0.0, 1), (1.0, 3), (2.0, 3), (3.0, 4), (4.0, 5)]


def test_values_stay_where_they_stood():
    stream = [
        (0.0, [1.0], {"left": 0.0}),
        (1.0, [2.0], {"left": math.nan}),
        (2.0, [3.0], {"left": 4.0}),
    ]
    found = list(FillGaps(["left"], spikes=math.inf)(stream))
    assert [sample.inputs["left"] for sample in found] == [0.0, 2.0, 4.0]
    assert [sample.z for sample in found] == [[1.0], [2.0], [3.0]]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"channels": "left"}, "channels must be a sequence of names"),
        ({"wait": -1.0}, "wait must be a time >= 0"),
        ({"samples": -1}, "samples must be >= 0"),
        ({"spikes": 0.0}, "spikes must be positive"),
    ],
)
def test_a_stage_that_makes_no_sense_says_so(options, text):
    with pytest.raises(lp.errors.ConfigurationError, match=text):
        FillGaps(**{"channels": ["left"], **options})


def test_a_stage_needs_samples_in_order():
    with pytest.raises(lp.errors.SampleError, match="not later than the one before"):
        list(FillGaps(["left"])([(1.0, {"left": 1.0}), (1.0, {"left": 1.0})]))


def test_a_table_says_what_was_done():
    t, x = channel(2, 100)
    x[30] += 40.0
    x[[60, 99]] = np.nan
    table = DataTable(t, np.column_stack([x, x]), ("left", "T"))
    filled = fill_table(table, ["left"], ["left"])
    assert filled.remarks == {
        ("spike", "left"): 1,
        ("interpolated", "left"): 2,
        ("missing", "left"): 1,
    }
    assert np.array_equal(filled.values[:, 1], x, equal_nan=True)  # sensors are left alone
    screened = fill_table(table, [], ["left"])
    assert screened.remarks == {("spike", "left"): 1, ("missing", "left"): 3}


# --- beside a process --------------------------------------------------------------------------


def intake(wait: float = 0.0, habit: float = 0.0, recent=(), screened: bool = False) -> Intake:
    columns = {"T": Column(("T",)), "left": Column(("left",))}
    policy = Policy(wait=wait, channels={"left": Habit(habit, None, True, screened)})
    return Intake(columns, CLOCK, policy, recent=recent)


def taken(sink: Intake, rows) -> tuple[list, dict]:
    ready, counts = [], {}
    outcomes = [sink.take(row, row["t"]) for row in rows] + [sink.flush()]
    for outcome in outcomes:
        ready += outcome.ready
        for remark in outcome.remarks:
            counts[remark.kind] = counts.get(remark.kind, 0) + 1
    return [(one.t, one.values.get("left", math.nan)) for one in ready], counts


ROWS = [{"t": float(k), "T": 1.0, "left": float(k)} for k in range(8)]


@pytest.mark.parametrize("gap", [{"t": 3.0, "T": 1.0, "left": None}, {"t": 3.0, "T": 1.0}])
@pytest.mark.parametrize("options", [{"wait": 2.0}, {"habit": 2.0}])
def test_within_the_wait_a_gap_is_interpolated(gap, options):
    found, counts = taken(intake(**options), [*ROWS[:3], gap, *ROWS[4:]])
    assert found == [(float(k), pytest.approx(float(k))) for k in range(8)]
    assert counts == {"interpolated": 1}


def test_a_sample_with_a_gap_goes_on_as_soon_as_the_next_value_is_there():
    sink = intake(habit=100.0)
    assert [one.t for row in ROWS[:3] for one in sink.take(row).ready] == [0.0, 1.0, 2.0]
    assert not sink.take({"t": 3.0, "T": 1.0}).ready
    assert not sink.take({"t": 4.0, "T": 1.0}).ready
    assert [one.t for one in sink.take(ROWS[5]).ready] == [3.0, 4.0, 5.0]


def test_the_wait_ends():
    rows = [{"t": row["t"], "T": 1.0} if row["t"] >= 3.0 else row for row in ROWS]
    found, counts = taken(intake(habit=2.0), rows)
    assert [t for t, value in found if math.isnan(value)] == [3.0, 4.0, 5.0, 6.0, 7.0]
    assert counts == {"missing": 5}


def test_a_spike_is_refused_within_the_wait_and_the_same_after_a_restart():
    t, x = channel(4, 120)
    t = t / 1800.0
    x[90] += 40.0
    rows = [{"t": float(s), "T": 1.0, "left": float(v)} for s, v in zip(t, x, strict=True)]
    found, counts = taken(intake(wait=3.0, screened=True), rows)
    assert counts == {"spike": 1, "interpolated": 1}
    assert abs(found[90][1] - (x[89] + x[91]) / 2.0) < 1.0
    without, none = taken(intake(wait=0.0, screened=True), rows)
    assert without[90][1] == x[90]
    assert none == {}
    before = [(s, {"T": 1.0, "left": v}) for s, v in found[:89]]
    again, _ = taken(intake(wait=3.0, screened=True, recent=before), rows[89:])
    assert again == found[89:]


# --- cases -------------------------------------------------------------------------------------

CASE = f"""{ROD_CASE}
noise = "0.1 K"
[intake]
wait = "{{wait}} s"
[channels]
left = {{{{ role = "boundary", column = "left", at = "left", unit = "degC"{{left}} }}}}
T = {{{{ role = "sensor", column = "T", at = "0.3 m", unit = "degC"{{sensor}} }}}}
"""
SECONDS = 300.0
COUNT = 120


def plant(folder: Path, left: str = "", sensor: str = "", wait: float = 0.0, broken=()) -> Path:
    """Write a case and its data; return its path."""
    t = SECONDS * np.arange(COUNT)
    u = 20.0 + 10.0 * np.sin(2.0 * np.pi * t / (COUNT * SECONDS))
    values = {k: f"{v:.6f}" for k, v in enumerate(u)} | dict(broken)
    lines = [
        f"{s},{values[k]},{20 + 0.4 * (v - 20)}" for k, (s, v) in enumerate(zip(t, u, strict=True))
    ]
    (folder / "rows.csv").write_text("\n".join(["t,left,T", *lines, ""]))
    path = folder / "case.toml"
    path.write_text(CASE.format(left=left, sensor=sensor, wait=wait))
    return path


BROKEN = {30: "", 31: "", 60: "9999", 119: ""}


@pytest.mark.long
def test_a_finished_file_is_interpolated_and_the_run_says_so(tmp_path):
    whole = cases.load(plant(tmp_path)).prepare()
    whole_k = float(whole.identifier.run(whole.stream).to_xarray()["alpha"][-1])
    case = cases.load(plant(tmp_path, broken=BROKEN))
    prepared = case.prepare()
    folder = tmp_path / "run"

    def write():
        return writer_of(case, folder, (), False, ["test"])

    with ExitStack() as stack:
        writer, (_, driven) = run_batch(prepared, folder, write, stack, quiet=True)
        _, _, _, notes = concluded(prepared, prepared.identifier, driven, writer, draw=False)
    assert (
        "Input left: 1 spikes were rejected, 3 missing values were interpolated, 1 values were "
        "missing: the last one before them, if any, was held." in notes
    )
    found = runs.open(folder).dataset
    alpha, std = float(found["alpha"][-1]), float(found["alpha_std"][-1])
    assert abs(alpha - whole_k) < 0.5 * std


def test_a_channel_may_keep_its_gaps_and_spikes(tmp_path):
    path = plant(tmp_path, ', missing = "hold", spikes = "keep"', broken=BROKEN)
    prepared = cases.load(path).prepare()
    left = prepared.stream.values[:, 0]
    assert np.flatnonzero(np.isnan(left)).tolist() == [30, 31, 119]
    assert left[60] == 9999.0


@pytest.mark.parametrize(("wait", "known"), [(0.0, False), (3 * SECONDS, True)])
@pytest.mark.long
def test_beside_a_process_the_wait_decides(tmp_path, wait, known):
    path = plant(tmp_path, wait=wait)
    u = 20.0 + 10.0 * np.sin(2.0 * np.pi * np.arange(COUNT) / COUNT)
    rows = [{"t": SECONDS * k, "left": v, "T": 20.0} for k, v in enumerate(u.tolist())]
    del rows[50]["left"]
    journal = tmp_path / "journal.sqlite"
    with LiveCase(cases.load(path), Rows(rows), path=journal) as wiring:
        live = wiring.live()
        live.run()
    with runs.Journal.open(journal) as kept:
        value = kept.recent(COUNT)[50].values["left"]
        assert len(kept) == COUNT
        assert kept.counts == {("interpolated" if known else "missing", "left"): 1}
    assert (abs(value - u[50]) < 0.05) if known else math.isnan(value)
