"""Clocks that leap, are set back, or show an hour twice: told, and no run is silenced by them."""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from live_rod import COLUMNS, OPENED, live, rows

from livepde.runs.feeds import Gathered, shifted
from livepde.runs.live_loop import Live
from livepde.streams.clock import Clock
from livepde.streams.intake import AGREE, INSIST, Intake, Policy
from livepde.streams.sources import Follow, Rows

DAY = 86400.0


@pytest.fixture(autouse=True)
def closed():
    yield
    while OPENED:
        OPENED.pop().close()


def run_of(folder, given, policy=None) -> Live:
    """Return a run of rows whose intake knows what was taken."""
    run = live(folder, Rows(given), verdict=False)  # of rows that are no rod's
    run.feed.intake.policy = policy or Policy(leap=30 * DAY)
    run.feed.intake.past = run.journal
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


@pytest.mark.slow
def test_a_row_days_ahead_of_fast_ones_is_refused(tmp_path):
    given = right(60)
    given.insert(30, {**given[30], "t": 29 * DAY})
    run = run_of(tmp_path, given)
    run.run()
    assert times(run) == [row["t"] for row in right(60)]
    assert run.journal.counts == {("leap", ""): 1}
    assert run.health["ok"]


@pytest.fixture(scope="module")
def fifty(tmp_path_factory) -> Live:
    """A run of fifty right rows, finished."""
    run = run_of(tmp_path_factory.mktemp("fifty"), right(50))
    run.run()
    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "step"), [(1, 0.1), (2, 0.1), (2, 1000.0), (AGREE, 0.1), (AGREE, 1000.0)]
)
def test_rows_far_ahead_that_agree_are_taken_back(tmp_path, fifty, wrong, step):
    """As if they had never come: the estimates are those of the right rows, bit by bit."""
    given = right(50)
    ahead = moved(given[30 : 30 + wrong], 3650 * DAY)
    ahead = [{**row, "t": row["t"] + step * k} for k, row in enumerate(ahead)]
    run = run_of(tmp_path, [*given[:30], *ahead, *given[30:]])
    run.run()
    assert times(run) == times(fifty)
    for one, other in zip(run.journal, fifty.journal, strict=True):
        np.testing.assert_array_equal(one.numbers, other.numbers)
    assert run.identifier.dump() == fifty.identifier.dump()
    assert ("clock" in told(run)) == (wrong > 1)
    assert run.health["ok"]


@pytest.mark.slow
def test_a_gap_that_the_next_row_confirms_loses_nothing(tmp_path):
    given = [*right(40), *moved(right(80, 40), 5000.0)]
    run = run_of(tmp_path, given)
    run.run()
    assert times(run) == [row["t"] for row in given]
    assert run.journal.counts == {}


@pytest.mark.slow
def test_a_clock_that_was_set_back_is_told_and_time_goes_on(tmp_path):
    given = right(200)
    given[100:] = moved(given[100:], -5.0)
    run = run_of(tmp_path, given)
    run.run()
    assert len(run.journal) == 200
    np.testing.assert_allclose(np.diff(times(run)), 0.1, atol=1e-9)
    assert told(run) == ["clock"]
    assert any("set back" in event.message for event in run.journal.events)
    assert run.health["ok"]


@pytest.mark.slow
def test_a_clock_that_was_ahead_for_long_comes_back(tmp_path):
    """Nobody can tell which time is right: times go on, and a shift is told."""
    given = right(60 + INSIST)
    run = run_of(tmp_path, [*given[:20], *moved(given[20:50], 4000.0), *given[50:]])
    run.run()
    assert len(run.journal) == 60 + INSIST
    assert told(run) == ["clock"]


@pytest.mark.slow
def test_rows_that_come_again_are_known(tmp_path):
    """A broker or a logger that repeats itself is no clock that was set back."""
    given = right(100)
    run = run_of(tmp_path, [*given, *given[40:], *right(120, 100)])
    run.run()
    assert times(run) == [row["t"] for row in right(120)]
    assert run.journal.counts == {("repeated", ""): 60}


@pytest.mark.slow
def test_the_backlog_of_a_logger_is_late(tmp_path):
    """Rows of a time in which none has been taken, between rows of now."""
    given = right(200)
    live_rows, backlog = given[60:], given[20:60]
    mixed = [row for pair in zip(live_rows[:40], backlog, strict=True) for row in pair]
    run = run_of(tmp_path, [*given[:20], *mixed, *live_rows[40:]], Policy(leap=DAY))
    run.run()
    assert times(run) == [row["t"] for row in [*given[:20], *live_rows]]
    assert run.journal.counts == {("late", name): 40 for name in COLUMNS}


@pytest.mark.slow
def test_a_shift_survives_a_restart(tmp_path):
    """Times go on with it, and rows are read again with that of their place."""
    path = tmp_path / "data.csv"
    given = right(200)
    given[100:] = moved(given[100:], -5.0)
    lines = ["t,a,b,left", *(",".join(map(repr, row.values())) for row in given)]

    def gone_on(count: int) -> Live:
        path.write_text("\n".join(lines[:count]) + "\n")
        run = live(tmp_path, Rows(()), verdict=False)
        shift, place = shifted(run.journal.position)
        source = Follow(path, position=place)
        OPENED.append(source)
        intake = Intake(COLUMNS, Clock("t"), origin=0.0, last=run.journal.last, shift=shift)
        intake.past = run.journal
        run.feed = Gathered(source, intake)
        run.resume()
        run.run()
        return run

    for count in (90, 103, 150, 201):
        run = gone_on(count)
        found = times(run)
        run.journal.close()
    # The two rows that waited for others when the file ended for the second time were refused.
    assert len(found) == 198
    assert np.diff(found).max() < 0.31
    assert np.diff(found).min() > 0.09


def test_the_hour_that_clocks_show_twice(tmp_path):
    """Local times without a zone of their own, in the zone of the case."""
    zone = ZoneInfo("Europe/Berlin")
    start = datetime(2026, 10, 24, 23, tzinfo=ZoneInfo("UTC"))
    moments = [start + timedelta(minutes=k) for k in range(240)]
    texts = [str(moment.astimezone(zone).replace(tzinfo=None)) for moment in moments]
    assert len(set(texts)) == 180
    columns = {name: COLUMNS[name] for name in ("a", "b", "left")}
    intake = Intake(columns, Clock("t", zone=zone))
    found = []
    for k, (text, row) in enumerate(zip(texts, rows(240), strict=True)):
        outcome = intake.take({**row, "t": text}, (k, None))
        assert not outcome.remarks
        found += [ready.t for ready in outcome.ready]
    assert found == [60.0 * k for k in range(240)]


@pytest.mark.slow
def test_the_hour_twice_without_a_zone_is_a_clock_set_back(tmp_path):
    given = right(200)
    given[100:] = moved(given[100:], -10.0)
    run = run_of(tmp_path, given)
    run.run()
    assert len(run.journal) == 200
    assert told(run) == ["clock"]


@pytest.mark.slow
@pytest.mark.parametrize("leap", [math.inf, 30 * DAY])
def test_rows_of_several_channels_are_no_leaps(tmp_path, leap):
    """Three channels a moment apart, and a long time between: each is taken."""
    given = []
    for row in rows(40):
        t = 100.0 * row["t"]
        parts = ({"t": t + 0.01 * k, name: row[name]} for k, name in enumerate(COLUMNS))
        given += parts
    run = run_of(tmp_path, given, Policy(leap=leap, tolerance=0.05, wait=1.0))
    run.run()
    assert len(run.journal) == 40
    assert run.journal.counts == {}
