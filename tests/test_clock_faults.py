"""Clocks that jump, go back or repeat an hour: times are never changed, faults are reported.

The correct samples follow from a definition: an arriving row is used once, at its stated time, if
this time is later than the times of all used rows.
"""

import math
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from factories import usual
from live_rod import COLUMNS, OPENED, live, rows
from test_logger_files import local

from livepde.runs import clock_findings
from livepde.runs.feeds import Gathered
from livepde.runs.live_loop import Live
from livepde.streams import read_csv
from livepde.streams.clock import Clock
from livepde.streams.intake import Habit, Intake, Policy
from livepde.streams.sources import Follow, Rows

DAY = 86400.0


@pytest.fixture(autouse=True)
def closed():
    yield
    while OPENED:
        OPENED.pop().close()


class AtOnce(Rows):
    """Source of many rows in one poll, as a file, so that rows wait in the queue of the run."""

    def poll(self, wait):
        return [row for _ in range(100) for row in super(AtOnce, self).poll(wait)]


def run_of(folder, given, policy=None, source=Rows) -> Live:
    """Run the given rows, and return the run."""
    run = live(folder, source(given), verdict=False)  # the rows are not those of a rod
    run.feed.intake.policy = policy or Policy(leap=30 * DAY)
    return run


def right(count: int, start: int = 0):
    return [*rows(count)][start:]


def moved(given, by):
    return [{**row, "t": row["t"] + by} for row in given]


def told(run: Live) -> list[str]:
    kinds = [event.kind for event in run.journal.events]
    return [kind for kind in kinds if kind != "verdict"]


def times(run: Live) -> list[float]:
    return [record.t for record in run.journal]


def used(given) -> list[dict]:
    """Return the rows that are later than all rows before them."""
    found, newest = [], -math.inf
    for row in given:
        if row["t"] > newest:
            found.append(row)
            newest = row["t"]
    return found


def numbers(run: Live) -> list[np.ndarray]:
    return [record.numbers for record in run.journal]


def same_run(run: Live, given, folder) -> None:
    """Assert that a run equals the run of the given rows alone, to the bit."""
    folder.mkdir()
    alone = run_of(folder, given)
    alone.run()
    assert times(run) == times(alone) == [row["t"] for row in given]
    np.testing.assert_array_equal(numbers(run), numbers(alone))
    assert run.identifier.dump() == alone.identifier.dump()


# --- repeated rows -------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("source", [Rows, AtOnce])
def test_a_repeated_block_is_used_once(tmp_path, source):
    """The block may be in the journal already, or wait in the queue of the run."""
    given = right(200)
    run = run_of(tmp_path, [*given[:100], *given[60:100], *given[100:]], source=source)
    run.run()
    assert run.journal.counts == {("repeated", ""): 40}
    assert run.health["ok"]
    assert told(run) == ["repeated"]
    same_run(run, given, tmp_path / "alone")


@pytest.mark.slow
def test_a_repeated_block_with_new_rows(tmp_path):
    """New rows at its end are used; a new row within it is late."""
    given = right(120)
    lost = {**given[70], "t": given[70]["t"] + 0.05}
    block = [*given[60:71], lost, *given[71:110]]
    run = run_of(tmp_path, [*given[:100], *block, *given[110:]], source=AtOnce)
    run.run()
    assert run.journal.counts == {("repeated", ""): 40, **{("late", name): 1 for name in COLUMNS}}
    same_run(run, given, tmp_path / "alone")


@pytest.mark.slow
def test_other_values_for_a_known_time_are_a_conflict_and_the_first_stay(tmp_path):
    given = right(100)
    other = [{**row, "a": row["a"] + 1.0} for row in given[60:90]]
    run = run_of(tmp_path, [*given, *other], source=AtOnce)
    run.run()
    assert run.journal.counts == {("conflict", "a"): 30, ("clock", ""): 1}
    assert "went back" in run.health["why"]
    same_run(run, given, tmp_path / "alone")


@pytest.mark.slow
def test_a_block_comes_twice_after_a_resume(tmp_path):
    """Rows accepted before the run ended are recognised after the resume."""
    given = right(120)
    first = run_of(tmp_path, given[:80])
    first.run()
    first.journal.close()
    run = run_of(tmp_path, [*given[40:80], *given[40:100], *given[100:]], source=AtOnce)
    run.resume()
    run.run()
    assert run.journal.counts == {("repeated", ""): 80}
    same_run(run, given, tmp_path / "alone")


@pytest.mark.slow
def test_rows_in_the_journal_are_not_kept_in_memory(tmp_path, monkeypatch):
    """The memory of the intake is bounded; older rows are looked up in the journal."""
    monkeypatch.setattr("livepde.streams.intake.REMEMBERED", 10)
    given = right(150)
    run = run_of(tmp_path, [*given[:100], *given[:100], *given[100:]])
    run.run()
    assert len(run.feed.intake._accepted) <= 22
    assert run.journal.counts == {("repeated", ""): 100}


def test_a_repeated_row_with_a_bridged_spike_is_recognised():
    """The sample then differs from its row, which is recognised by its other values."""
    policy = Policy(wait=2.5, channels={"left": Habit(interpolated=True, screened=True)})
    intake = Intake(COLUMNS, Clock("t"), policy, last=-1.0)
    given = [{"t": float(k), "a": 0.1 * k, "b": 0.0, "left": math.sin(0.1 * k)} for k in range(40)]
    given[20]["left"] = 50.0
    kinds = [remark.kind for row in given for remark in intake.take(row).remarks]
    assert "spike" in kinds
    again = [remark for row in given for remark in intake.take(row).remarks]
    assert [(one.kind, one.channel) for one in again] == [("repeated", "")] * 40


def test_another_value_of_a_bridged_channel_is_a_conflict():
    """Rows are remembered as received, also for channels with bridged gaps and spikes."""
    habit = Habit(interpolated=True, screened=True)
    intake = Intake(COLUMNS, Clock("t"), Policy(channels={"left": habit}), last=-1.0)
    row = {"a": 0.1, "b": 0.0, "left": 1.0}
    for k in range(20):
        intake.take({"t": float(k), **row})
    (remark,) = intake.take({"t": 10.0, **row, "left": 2.0}).remarks
    assert (remark.kind, remark.channel) == ("conflict", "left")


# --- clocks that go back -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("by", usual([5.05, 1000.0, 5.0], often=2))
def test_a_clock_that_was_set_back_makes_rows_late_until_they_are_new(tmp_path, by):
    given = right(200)
    given[100:] = moved(given[100:], -by)
    run = run_of(tmp_path, given)
    run.run()
    assert times(run) == [row["t"] for row in used(given)]
    late = 200 - len(used(given))
    counts = run.journal.counts
    assert counts["clock", ""] == 1
    assert sum(number for (_, name), number in counts.items() if name == "a") == late
    # Health is false while rows are late, with reason and remedy, and true when rows are new again.
    assert run.health["ok"] == (by < 1000.0)
    assert by < 1000.0 or "intake.shift" in run.health["why"]
    assert told(run).count("unwell") == 1
    same_run(run, used(given), tmp_path / "alone")


@pytest.mark.slow
def test_a_clock_that_goes_back_again_and_again(tmp_path):
    """The clock goes back by 3.5 steps every 30 rows."""
    given = [{**row, "t": row["t"] - 0.35 * (k // 30)} for k, row in enumerate(right(300))]
    run = run_of(tmp_path, given, source=AtOnce)
    run.run()
    assert run.journal.counts["clock", ""] == 9
    assert run.journal.counts["late", "a"] == 300 - len(used(given)) == 27
    assert run.journal.counts["shifted", ""] == 9
    assert "goes back again and again" in run.health["why"]
    (finding,) = clock_findings(run.journal)
    assert finding.severity == "do not trust"
    assert "The clock stayed set back 9 times" in finding.text
    same_run(run, used(given), tmp_path / "alone")


@pytest.mark.slow
def test_a_clock_that_is_wrong_for_some_rows_again_and_again(tmp_path):
    """Later intervals are correct; health is false until the clock is steady for a while."""
    given = [
        {**row, "t": row["t"] - 0.35 * (k % 30 < 3 and 30 <= k < 160)}
        for k, row in enumerate(right(250))
    ]
    run = run_of(tmp_path, given, source=AtOnce)
    run.run()
    assert run.journal.counts["clock", ""] == 5
    assert ("shifted", "") not in run.journal.counts
    (finding,) = clock_findings(run.journal)
    assert finding.severity == "caution"
    assert run.health["ok"]
    assert any("goes back again and again" in one.message for one in run.journal.events)


@pytest.mark.slow
def test_a_stated_shift_corrects_a_clock(tmp_path):
    given = right(200)
    back = moved(given[100:], -5.0)
    first = run_of(tmp_path, [*given[:100], *back[:10]])
    first.run()
    assert not first.health["ok"]
    first.journal.close()
    run = run_of(tmp_path, back[10:], Policy(shift=5.0))
    run.resume()
    run.run()
    assert run.health["ok"]
    np.testing.assert_allclose(times(run), [row["t"] for row in [*given[:100], *given[110:]]])


def test_a_shift_of_dates_moves_start_and_t0():
    intake = Intake(COLUMNS, Clock("t", start="2026-01-01 01:00"), Policy(shift=3600.0))
    row = {"a": 0.0, "b": 0.0, "left": 0.0}
    stated = ["2025-12-31 23:59", *(f"2026-01-01 00:{k:02d}" for k in range(4))]
    kinds = [one.kind for t in stated for one in intake.take({"t": t, **row}).remarks]
    assert kinds == ["outside"]
    assert str(intake.start) == "2026-01-01 01:00:00"
    assert intake.flush().ready == []


@pytest.mark.slow
def test_one_channel_whose_clock_went_back_is_named(tmp_path):
    """Two loggers send rows with one channel each."""
    given = [
        {"t": row["t"] - (5.0 if name == "b" and k >= 40 else 0.0), name: row[name]}
        for k, row in enumerate(right(60))
        for name in COLUMNS
    ]
    run = run_of(tmp_path, given, Policy(wait=0.15))
    run.run()
    assert "times of b went back" in run.health["why"]
    assert run.journal.counts["clock", ""] == 1
    assert max(times(run)) < 6.0


@pytest.mark.slow
def test_the_backlog_of_a_logger_is_late(tmp_path):
    """Current rows are mixed with rows from a time without samples."""
    given = right(200)
    live_rows, backlog = given[29:], given[20:29]
    mixed = [row for pair in zip(live_rows[:9], backlog, strict=True) for row in pair]
    run = run_of(tmp_path, [*given[:20], *mixed, *live_rows[9:]], Policy(leap=DAY))
    run.run()
    assert times(run) == [row["t"] for row in [*given[:20], *live_rows]]
    assert run.journal.counts == {("late", name): 9 for name in COLUMNS}
    assert run.health["ok"]


@pytest.mark.slow
def test_a_clock_that_went_back_survives_restarts(tmp_path):
    """With a growing file, the used rows do not depend on where the run ended."""
    path = tmp_path / "data.csv"
    given = right(200)
    given[100:] = moved(given[100:], -5.0)
    lines = ["t,a,b,left", *(",".join(map(repr, row.values())) for row in given)]
    for count in (90, 103, 150, 201):
        path.write_text("\n".join(lines[:count]) + "\n")
        run = live(tmp_path, Rows(()), verdict=False)
        source = Follow(path, position=run.journal.position)
        OPENED.append(source)
        intake = Intake(COLUMNS, Clock("t"), origin=0.0, last=run.journal.last)
        intake.past = run.journal
        run.feed = Gathered(source, intake)
        run.resume()
        run.run()
        found = times(run)
        run.journal.close()
    assert found == [row["t"] for row in used(given)]


# --- clocks that are ahead -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "wrong", "ahead"),
    [(0, 1, 60.0), (0, 1, 1e9), (3, 8, 1e9), (30, 2, 3600.0), (30, 8, 29 * DAY)],
)
def test_rows_far_ahead_cost_nothing(tmp_path, at, wrong, ahead):
    """Up to eight such rows, also the first row, change no bit of the results."""
    given = right(60)
    mixed = [*given[:at], *moved(given[at : at + wrong], ahead), *given[at:]]
    run = run_of(tmp_path, mixed)
    run.run()
    assert run.journal.counts == {("leap", ""): wrong}
    assert run.health["ok"]
    same_run(run, given, tmp_path / "alone")


@pytest.mark.slow
def test_one_reading_of_one_channel_far_ahead(tmp_path):
    """With one channel per row, other channels lose nothing."""
    given = [
        {"t": row["t"] + 0.001 * n, name: row[name]}
        for k, row in enumerate(right(60))
        for n, name in enumerate(COLUMNS)
    ]
    wrong = [*given[:91], {"t": 12.0, "b": 0.4}, *given[91:]]
    policy = Policy(leap=30 * DAY, tolerance=0.01)
    run = run_of(tmp_path, wrong, policy)
    run.run()
    assert run.journal.counts == {("leap", ""): 1}
    assert len(times(run)) == 60


@pytest.mark.slow
@pytest.mark.parametrize("pause", [2.0, 5000.0])
@pytest.mark.parametrize("rest", [1, 2, 40])
def test_a_pause_loses_nothing(tmp_path, pause, rest):
    """Rows after a pause wait for a while, and are used when they agree or the source ends."""
    given = [*right(40), *moved(right(40 + rest, 40), pause)]
    run = run_of(tmp_path, given)
    run.run()
    lost = 1 if rest == 1 else 0  # nothing confirms a single row at the end
    assert times(run) == [row["t"] for row in given][: len(given) - lost]
    assert run.journal.counts == ({("leap", ""): 1} if lost else {})


def test_a_pause_that_has_passed_is_not_a_jump():
    """A row may be ahead by the time that passed on this machine since the previous row."""
    intake = Intake(COLUMNS, Clock("t"), last=-1.0)
    row = {"a": 0.0, "b": 0.0, "left": 0.0}
    for k in range(20):
        assert intake.take({"t": float(k), **row}, received=100.0 + k).ready
    assert not intake.why
    (ready,) = intake.take({"t": 3619.0, **row}, received=3720.0).ready
    assert ready.t == 3619.0
    for t in (7000.0, 7001.0):
        assert not intake.take({"t": t, **row}, received=3721.0).ready
    assert "from t = 7000 on are far ahead of t = 3619" in intake.why


def test_a_row_after_a_pause_confirms_those_that_wait():
    """The pause has passed on this machine for this row, but not for the rows before."""
    intake = Intake(COLUMNS, Clock("t"), last=-1.0)
    row = {"a": 0.0, "b": 0.0, "left": 0.0}
    for k in range(20):
        intake.take({"t": float(k), **row}, received=100.0 + k)
    assert not intake.take({"t": 119.0, **row}, received=120.0).ready
    found = intake.take({"t": 219.0, **row}, received=420.0)
    assert [ready.t for ready in found.ready] == [119.0, 219.0]
    assert not found.remarks


@pytest.mark.slow
def test_a_clock_that_was_ahead_for_long_comes_back(tmp_path):
    """The correct time is unknown, so rows are late until they are new."""
    given = right(160)
    wrong = [*given[:20], *moved(given[20:50], 4.0), *given[50:]]
    run = run_of(tmp_path, wrong)
    run.run()
    assert times(run) == [row["t"] for row in used(wrong)]
    assert run.journal.counts["clock", ""] == 1
    assert run.health["ok"]


# --- repeated hours ------------------------------------------------------------------------------


@pytest.mark.parametrize("again", [(), range(100, 110), range(70, 120), range(130, 200)])
def test_the_hour_that_clocks_show_twice(again):
    """Local times without a zone use the zone of the case; also with repeated rows."""
    texts = local(1, 240)
    assert len(set(texts)) == 180
    given = [{**row, "t": text} for text, row in zip(texts, rows(240), strict=True)]
    columns = {name: COLUMNS[name] for name in ("a", "b", "left")}
    intake = Intake(columns, Clock("t", zone=ZoneInfo("Europe/Berlin")))
    end = again[-1] + 1 if again else 240
    found, remarks = [], []
    for row in [*given[:end], *(given[k] for k in again), *given[end:]]:
        outcome = intake.take(row)
        remarks += [one.kind for one in outcome.remarks]
        found += [ready.t for ready in outcome.ready]
    assert found == [60.0 * k for k in range(240)]
    assert remarks == ["repeated"] * len(again)


def test_a_reading_that_is_the_same_an_hour_later_is_no_repeated_row(tmp_path):
    """An hourly table was once refused because both rows at 02:00 had equal values."""
    hours = ["00:00", "01:00", "02:00", "02:00", "03:00", "04:00"]
    rows = "".join(f"2024-10-27 {hour},7.53\n" for hour in hours)
    (tmp_path / "t.csv").write_text(f"t,a\n{rows}")
    clock = Clock("t", zone=ZoneInfo("Europe/Berlin"))
    found = read_csv(tmp_path / "t.csv", {"a": COLUMNS["a"]}, clock)
    assert np.diff(found.t).tolist() == [3600.0] * 5


def test_a_burst_of_rows_each_minute_is_not_a_jump():
    """Twenty channels arrive shortly after each other; the pace is per channel, not per row."""
    from livepde.streams.table import Column

    names = [f"T_{k}" for k in range(20)]
    intake = Intake({name: Column((name,)) for name in names}, Clock("t"), Policy(tolerance=1.0))
    found = []
    for k in range(30):
        for n, name in enumerate(names):
            outcome = intake.take({"t": 60.0 * k + 0.01 * n, name: 1.0})
            assert not outcome.remarks
            found += [ready.t for ready in outcome.ready]
            assert k < 2 or not intake.why
    assert found == [60.0 * k for k in range(30)]


@pytest.mark.slow
def test_memory_does_not_grow_with_rows_that_wait():
    intake = Intake(COLUMNS, Clock("t"), last=-1.0)
    for k in range(20):
        intake.take({"t": float(k), "a": 0.0, "b": 0.0, "left": 0.0})
    for k in range(3000):
        intake.take({"t": 1e6, "a": float(k), "b": 0.0, "left": 0.0})
        assert len(intake.waiting) <= 1001
