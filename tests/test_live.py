"""Live runs: journal, resume after a kill, rows out of order, faults of the source."""

import json
import math
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from live_rod import CLOCK, COLUMNS, OPENED, identifier, journal, live, rows, same, write
from patience import PATIENCE

import livepde as lp
from livepde.runs.ailments import Ailments
from livepde.runs.backlog import Backlog
from livepde.runs.journal import Event, Journal
from livepde.runs.live_loop import Live
from livepde.runs.looks import JUDGED
from livepde.runs.monitor import Metrics, Monitor
from livepde.runs.web import Address
from livepde.stepping import Advance, ImplicitEuler
from livepde.streams.intake import Habit, Intake, Policy
from livepde.streams.sources import Follow, Row, Rows, json_row
from livepde.streams.table import Column
from livepde.verdict import Finding, Verdict


@pytest.fixture(autouse=True)
def closed():
    yield
    while OPENED:
        OPENED.pop().close()


CHILD = """
import signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from live_rod import live

class Fuse:
    left = int(sys.argv[3])
    def put(self, estimate):
        self.left -= 1
        if self.left <= 0:
            self.put = lambda estimate: None
            self.burn()
    def burn(self):
        signal.setitimer(signal.ITIMER_PROF, float(sys.argv[4]))  # nobody hears it: it kills

fuse = Fuse()
if not fuse.left:
    fuse.burn()
run = live(Path(sys.argv[1]), sinks=[fuse])
run.resume()
run.run()
run.journal.close()
"""


@pytest.mark.slow
def test_a_run_killed_at_any_moment_resumes_bit_by_bit(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
        write(folder, 150)
    undisturbed = live(whole)
    undisturbed.run()
    here = str(Path(__file__).parent)
    rng, kills = np.random.default_rng(1), 0
    for samples in (0, 50):
        fuse = str(samples), f"{rng.uniform(0.001, 0.012)}"  # and processor seconds
        child = subprocess.run([sys.executable, "-c", CHILD, str(killed), here, *fuse], check=False)
        assert child.returncode in (0, -signal.SIGPROF)
        kills += child.returncode != 0
    rest = live(killed)
    rest.resume()
    rest.run()
    assert kills == 2
    same(rest.journal, undisturbed.journal)
    assert rest.journal.accepted == 150


def test_a_session_without_samples_ends_as_the_one_before_it(tmp_path):
    """The session before may have been killed at the end of its data, before writing results."""
    write(tmp_path, 27)
    found = []
    for _ in range(2):
        run = live(tmp_path)
        run.resume()
        run.run()
        found.append(run.result.dataset())
        run.journal.close()
    assert json.loads(found[0].attrs["verdict"])["judged"]
    assert found[0].identical(found[1])


@pytest.mark.slow
def test_one_writer_many_readers(tmp_path):
    write(tmp_path, 20)
    run = live(tmp_path)
    run.run()
    path = tmp_path / "journal.sqlite"
    for write_it in (lambda: Journal.open(path, write=True), lambda: journal(path)):
        with pytest.raises(lp.errors.RunError, match="written by another process"):
            write_it()
    with Journal.open(path) as reader:
        assert len(reader) == 20
        with pytest.raises(lp.errors.RunError, match="readonly"):
            reader.note(Event(0.0, "x", "", ""))
    run.journal.close()
    Journal.open(path, write=True).close()


def test_rows_out_of_order_are_put_in_order_within_the_wait():
    intake = Intake(COLUMNS, CLOCK, Policy(wait=1.0))
    order = [0.0, 0.4, 0.2, 0.6, 2.0, 0.5, 3.5]
    found, remarks, spent = [], [], []
    for t in order:
        outcome = intake.take({"t": t, "a": t, "b": 0, "left": 0}, token=t)
        found += [sample.t for sample in outcome.ready]
        remarks += [(remark.kind, remark.channel) for remark in outcome.remarks]
        spent += outcome.spent
    found += [sample.t for sample in intake.flush().ready]
    assert found == [0.0, 0.2, 0.4, 0.6, 2.0, 3.5]
    assert remarks == [("disordered", ""), *(("late", name) for name in COLUMNS)]
    assert spent == [0.5]


def test_channels_that_come_one_by_one_make_one_sample():
    intake = Intake(COLUMNS, CLOCK, Policy(tolerance=0.05))
    taken = []
    for k in range(3):
        for shift, name in ((0.0, "a"), (0.01, "b"), (0.02, "left")):
            outcome = intake.take({"t": k + shift, name: float(k)})
            taken += outcome.ready
            assert not outcome.remarks
    assert [(s.t, len(s.values)) for s in taken] == [(0.0, 3), (1.0, 3), (2.0, 3)]


@pytest.mark.parametrize(("repeated", "value"), [("first", 1.0), ("last", 2.0)])
def test_a_second_value_of_a_reading_is_counted(repeated, value):
    intake = Intake(COLUMNS, CLOCK, Policy(repeated=repeated), last=-1.0)
    intake.take({"t": 0.0, "a": 1.0})
    (remark,) = intake.take({"t": 0.0, "a": 2.0}).remarks
    assert (remark.kind, remark.channel) == ("conflict", "a")
    (sample,) = intake.flush().ready
    assert sample.values == {"a": value}


def test_each_channel_has_its_own_rules():
    columns = {
        "a": Column(("a",), valid=(0.0, 1.0)),
        "b": Column(("b",)),
        "left": Column(("left",), needed=True),
    }
    intake = Intake(columns, CLOCK, Policy(channels={"b": Habit(wait=5.0)}))
    found, kinds = [], []
    for row in (
        {"t": 0.0, "a": 2.0, "b": 0.1, "left": 1.0},  # invalid
        {"t": 1.0, "a": 0.5, "left": 1.0},  # b comes later
        {"t": 2.0, "a": 0.5, "b": 0.2, "left": None},  # missing
        {"t": 1.0, "b": 0.3},
        {"t": 3.0, "a": 0.5, "left": 1.0},  # b never comes
        {"t": 9.0, "a": 0.5, "b": 0.4, "left": 1.0},
    ):
        outcome = intake.take(row, row["t"])
        found += [(sample.t, sample.values.get("b")) for sample in outcome.ready]
        kinds += [(remark.kind, remark.channel) for remark in outcome.remarks]
    assert found == [(0.0, 0.1), (1.0, 0.3), (3.0, None), (9.0, 0.4)]
    assert kinds == [
        ("invalid", "a"),
        ("missing", "a"),
        ("disordered", ""),
        ("missing", "left"),
        ("skipped", "left"),
        ("missing", "b"),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("overflow", ["merge", "drop"])
def test_rows_that_arrive_too_fast_are_merged_or_dropped_and_counted(tmp_path, overflow):
    write(tmp_path, 100)
    run = live(tmp_path, backlog=Backlog(overflow, 10))
    run.run()
    assert run.journal.counts[(overflow, "")] == 90
    assert len(run.journal) == 10


@pytest.mark.slow
def test_broken_rows_are_counted_and_the_rest_arrives(tmp_path):
    good = list(rows(80))
    mixed = []
    for k, row in enumerate(good):
        mixed.append(row)
        mixed.append([{"t": "x"}, {"a": 1.0}, {"t": math.inf}, {"t": row["t"], "a": "?"}][k % 4])
    run = live(tmp_path, Rows(mixed), verdict=False)
    run.run()
    assert len(run.journal) == 80
    assert run.journal.counts == {("malformed", ""): 60, ("malformed", "a"): 20}
    kinds = [event.kind for event in run.journal.events]
    assert [kind for kind in kinds if kind not in ("verdict", "unwell", "well")] == [
        "malformed",
        "malformed",
    ]


@pytest.mark.parametrize("text", ["", "{", "[1]", "nan", "1" * 2_000_000, "[" * 100_000])
def test_lines_that_are_not_rows_are_counted(text):
    assert json_row(text).broken


@pytest.mark.slow
@pytest.mark.parametrize("wrong_rows", [1, 40])
def test_a_clock_that_is_wrong_for_long_does_not_delay_a_run(tmp_path, wrong_rows):
    """Even if its rows continue so long that the clock is accepted, the step is short."""
    mixed = list(rows(20))
    wrong = {"a": 0.7, "b": 0.4, "left": 1.0}
    mixed[8:8] = [{"t": 1e12 + k, **wrong} for k in range(wrong_rows)]
    run = live(tmp_path, Rows(mixed))
    run.identifier.problem = replace(run.identifier.problem, control=Advance(ImplicitEuler(), 0.1))
    run.run()
    if wrong_rows == 1:
        assert run.journal.counts == {("leap", ""): 1}
        assert run.journal.last == mixed[-1]["t"]
        assert run.health["ok"]
    else:
        (event,) = [event for event in run.journal.events if event.kind == "pause"]
        assert "longer than dt_max = 0.1" in event.message
        assert len(run.journal) == 48
        # The correct rows are late now, and the message states the remedy.
        assert run.journal.counts["late", "a"] == 12
        assert "specify its correction with `intake.shift`" in run.health["why"]


@pytest.mark.slow
def test_after_a_refused_sample_known_rows_are_not_used_again(tmp_path):
    mixed = list(rows(20))
    mixed[1:1] = [{"t": 0.05, "a": 0.7, "b": 0.4, "left": None}]  # at the refused time
    mixed[10:10] = mixed[3:7]  # follows the refusal
    run = live(tmp_path, Batch(mixed))
    step = run.identifier.step

    def refusing(t, z):
        if t == 0.05:
            raise lp.errors.SampleError("refused")
        return step(t, z)

    run.identifier.step = refusing
    run.run()
    kinds = [event.kind for event in run.journal.events]
    assert kinds.count("refused") == 1
    assert run.journal.counts[("repeated", "")] == 4
    assert len(run.journal) == 20


class Batch(Rows):
    """Source that provides several rows at once, as a file does."""

    def poll(self, wait):
        return [row for _ in range(5) for row in super(Batch, self).poll(wait)]


@pytest.mark.long
def test_irregular_rows_are_counted_once_whenever_a_run_is_killed(tmp_path):
    write(tmp_path, 30)
    path = tmp_path / "data.csv"
    lines = path.read_text().splitlines()
    for k in (25, 12, 5):
        lines[k:k] = ["broken", lines[k - 2]]
    path.write_text("\n".join([*lines, "broken", "broken"]) + "\n")
    whole = live(tmp_path)
    whole.run()
    expected = whole.journal.counts
    whole.journal.close()
    assert expected == {("malformed", ""): 5, ("repeated", ""): 3}
    (tmp_path / "journal.sqlite").unlink()
    stops = iter([3, 1, 7, 1, 1, 9, 4, 30, 30])
    for stop in stops:
        run = live(tmp_path, sinks=[Stop(stop)])
        with suppress(Killed):
            run.resume()
            run._run()
        run.journal._db.rollback()  # uncommitted rows are lost
        run.journal.close()
        OPENED.pop().close()
    with Journal.open(tmp_path / "journal.sqlite") as kept:
        assert kept.counts == expected
        assert len(kept) == 30


class Killed(Exception):
    pass


class Stop:
    """Sink that ends a run at its n-th estimate, as a kill would."""

    def __init__(self, n: int) -> None:
        self.left = n

    def put(self, estimate) -> None:
        self.left -= 1
        if self.left == 0:
            raise Killed

    def close(self) -> None:
        pass


def followed(source: Follow) -> list[float]:
    found = []
    while rows := source.poll(0.0):
        found += [float(row.values["t"]) for row in rows if not row.broken]
    return found


def test_a_file_that_is_rotated_is_read_to_its_end(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,a\n0,1\n1,1\n")
    source = Follow(path, follow=True)
    assert followed(source) == [0.0, 1.0]
    with path.open("a") as file:
        file.write("2,1\n3,1")  # the last line is incomplete
    path.rename(tmp_path / "log.1.csv")
    assert followed(source) == [2.0]
    path.write_text("\nt,a\n\n4,1\n")
    assert followed(source) == [4.0]
    path.write_text("t,a\n5,1\n")  # truncated
    told, row = [*source.poll(0.0), *source.poll(0.0)]
    assert told.kind == "rewritten"
    assert row.values == {"t": "5", "a": "1"}
    source.close()


def test_a_position_is_of_one_file(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,a\n0,1\n1,1\n")
    source = Follow(path, follow=True)
    tokens = [row.token for row in source.poll(0.0)]
    here, before = source.position([]), source.position(tokens[1:])
    source.close()
    with path.open("a") as file:
        file.write("2,1\n")
    for position, times in ((here, [2.0]), (before, [1.0, 2.0]), ("", [0.0, 1.0, 2.0])):
        assert followed(Follow(path, position=position)) == times
    path.write_text("t,a\n7,1\n8,1\n9,1\n")  # another file of the same name
    assert followed(Follow(path, position=here)) == [7.0, 8.0, 9.0]


def test_blank_lines_do_not_end_a_file(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("\n" * 500 + "t,a\n" + "\n" * 500 + "0,1\n")
    assert followed(Follow(path)) == [0.0]


@pytest.mark.slow
def test_silence_is_noticed(tmp_path):
    class Silent(Rows):
        def poll(self, wait):
            now[0] += 1.0
            if now[0] > 20.0:
                run.stopping.set()
            count = {1.0: 3, 12.0: 1}.get(now[0], 0)  # the first rows wait for further rows
            return [row for _ in range(count) for row in super(Silent, self).poll(wait)]

    now = [0.0]
    run = live(tmp_path, Silent(rows(5)), silence=5.0, clock=lambda: now[0])
    run.run()
    assert [event.kind for event in run.journal.events] == ["silent", "heard", "silent"]


@pytest.mark.slow
def test_a_dead_source_is_reported_as_silent_by_default(tmp_path):
    """Silence means ten usual steps, at least a minute, and more than the usual silence."""

    class Bursts(Rows):
        def poll(self, wait):
            now[0] += 20.0
            if now[0] > 8000.0:
                run.stopping.set()
            count = {20.0: 30, 1000.0: 1, 1060.0: 1, 3100.0: 1}.get(now[0], 0)
            return [row for _ in range(count) for row in super(Bursts, self).poll(wait)]

    now = [0.0]
    given = [{**row, "t": 120.0 * row["t"]} for row in rows(40)]  # 12 s apart
    run = live(tmp_path, Bursts(given), clock=lambda: now[0])
    assert run.ailments.silence == math.inf
    run.run()
    found = [(event.kind, event.message) for event in run.journal.events]
    assert [kind for kind, _ in found if kind in ("silent", "heard")] == ["silent", "heard"] * 2 + [
        "silent"
    ]
    waits = [float(text.split()[-2]) for kind, text in found if kind == "silent"]
    assert waits == [120.0, 1960.0, 4080.0]
    assert run.health["ailment"] == "silent"


class Sequence_(Rows):
    """Source with one row per poll, None for no row, which advances the clock."""

    def __init__(self, rows_, now):
        super().__init__(())
        self._each, self._now = iter(rows_), now

    def poll(self, wait):
        self._now[0] += 1.0
        try:
            row = next(self._each)
        except StopIteration:
            self._ended = True
            return []
        return [] if row is None else [Row(row)]


def resumed(run: Live) -> None:
    run.resume()
    run.run()


def health_of(run: Live) -> list[tuple[str, str]]:
    return [(e.kind, e.message) for e in run.journal.events if e.kind in ("unwell", "well")]


@pytest.mark.slow
def test_a_run_whose_rows_are_all_refused_is_unhealthy(tmp_path):
    now, right = [0.0], [*rows(45)]  # too few rows for a verdict
    old = [{**right[0], "t": -1.0 - k} for k in range(10)]
    source = Sequence_([*right[:5], *old, *right[5:]], now)
    run = live(tmp_path, source, silence=5.0, clock=lambda: now[0])
    run.run()
    (kind, why), *rest = health_of(run)
    assert kind == "unwell"
    assert re.match(
        "rows arrive, but none is accepted; the last one: late: t = -[0-9]+ is not later", why
    )
    assert [kind for kind, _ in rest] == ["well"]
    assert run.health["ok"]
    assert run.journal.health == ""


def looked(run: Live, number: int, level: str) -> str:
    """Show a run a verdict of a given level, and return the level that it reports."""
    run.result._count = 1000 + JUDGED * number
    findings = [Finding("x", level, "It is off.")] if level != "trusted" else []
    run._judge(SimpleNamespace(verdict=Verdict.of(findings)))
    return run.health["verdict"]


def test_checks_that_alternate_between_two_worse_levels_are_not_trusted(tmp_path):
    run = live(tmp_path, Rows(rows(3)))
    run.run()
    each = ["trusted", "caution", "do not trust", "caution", "do not trust"]
    found = [looked(run, number, level) for number, level in enumerate(each)]
    assert found == ["trusted", "trusted", "do not trust", "do not trust", "do not trust"]


@pytest.mark.slow
def test_a_run_with_a_wrong_model_is_healthy_and_reports_it_once(tmp_path):
    biased = ({**row, "b": row["b"] + 0.2} for row in rows(201))
    run = live(tmp_path, Rows(biased))
    run.run()
    levels = [e.message.partition(":")[0] for e in run.journal.events if e.kind == "verdict"]
    assert levels[-1] in ("caution", "do not trust")
    assert len(set(levels)) == len(levels)
    assert run.health["ok"]
    assert not health_of(run)
    # The only verdict is the verdict of the last fit.
    assert run.health["verdict"] == run.result.verdict.level
    assert run.health["verdict"] == json.loads(run.journal.verdict)["level"]
    assert run.health["findings"]


def test_a_level_is_reported_after_two_equal_checks(tmp_path):
    run = live(tmp_path, Rows(rows(3)))
    run.run()
    told = len([e for e in run.journal.events if e.kind == "verdict"])
    found = []
    each = ["trusted", "trusted", "caution", "trusted", "caution", "caution"]
    for number, level in enumerate(each):
        looked(run, number, level)
        found.append(looked(run, number, "trusted"))  # a repeated sample is not checked again
    assert found == ["trusted"] * 5 + ["caution"]
    events = [e.message for e in run.journal.events if e.kind == "verdict"][told:]
    assert [text.partition(":")[0] for text in events] == ["trusted", "caution"]
    # A resumed run knows the last check, so that its next check is the second.
    looked(run, 6, "trusted")
    run.journal.close()
    assert looked(live(tmp_path, Rows([])), 7, "trusted") == "trusted"


@pytest.mark.slow
def test_refused_rows_are_reported_without_a_limit_of_silence(tmp_path):
    right = [*rows(10)]
    run = live(tmp_path, Rows([*right, *({**right[0], "t": -1.0 - k} for k in range(9))]))
    run.run()
    assert not run.health["ok"]
    assert run.health["why"] == run.ailments.ill[1]
    assert "late" in run.ailments.ill[1]


@pytest.mark.slow
def test_a_run_without_its_directory_is_unhealthy(tmp_path):
    class Vanishing(Rows):
        def poll(self, wait):
            if run.journal.accepted == 5:
                (tmp_path / "journal.sqlite").unlink(missing_ok=True)
            return super().poll(wait)

    run = live(tmp_path, Vanishing(rows(10)))
    run.run()
    assert not run.health["ok"]
    assert run.ailments.ill[1].startswith("the journal in the run directory was replaced")
    assert run.journal.health == run.ailments.ill[1]
    (tmp_path / "journal.sqlite").write_text("another")
    assert not run.health["ok"]


@pytest.mark.slow
def test_failed_steps_are_unhealthy_and_the_stream_continues(tmp_path):
    class Fails(type(identifier())):
        def step(self, t, z, inputs=None):
            if 0.35 < t < 0.65:
                raise error
            return super().step(t, z, inputs)

    for error in (np.linalg.LinAlgError("SVD did not converge"), KeyError("k")):
        here = tmp_path / type(error).__name__
        here.mkdir()
        run = live(here, Rows(rows(10)))
        run.identifier.__class__ = Fails
        run.run()
        assert [record.t for record in run.journal] == pytest.approx(
            [0.0, 0.1, 0.2, 0.3, 0.7, 0.8, 0.9]
        )
        assert run.journal.counts == {("aside", ""): 3}
        told = [e.message for e in run.journal.events if e.kind == "aside"]
        assert len(told) == 3
        assert type(error).__name__ in told[0]
        assert health_of(run)[0][1].startswith(
            "the last steps failed; the last one: the sample at t = 0.5 was skipped"
        )
        assert run.health["ok"]


@pytest.mark.slow
@pytest.mark.parametrize("deaths", [2, 3])
def test_a_sample_that_repeatedly_crashes_the_process_is_skipped(tmp_path, deaths):
    """The journal counts the attempts; a process that was killed once or twice loses nothing."""

    class Killed(BaseException):
        pass

    class Deadly(type(identifier())):
        def step(self, t, z, inputs=None):
            if 0.55 < t < 0.65:
                raise Killed
            return super().step(t, z, inputs)

    write(tmp_path, 20)
    for _ in range(deaths):
        run = live(tmp_path)
        run.identifier.__class__ = Deadly
        with pytest.raises(Killed):
            resumed(run)
        run.journal.close()
    run = live(tmp_path)
    resumed(run)
    aside = deaths == 3
    assert len(run.journal) == 20 - aside
    assert run.journal.counts == ({("aside", ""): 1} if aside else {})
    assert [e.kind for e in run.journal.events] == ["aside"] * aside
    run.journal.close()
    with Journal.open(tmp_path / "journal.sqlite") as kept:
        assert len(list(kept)) == 20 - aside


DEADLY = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from live_rod import identifier, live

class Deadly(type(identifier())):
    def step(self, t, z, inputs=None):
        if 8.95 < t < 9.05:
            os._exit(7)
        return super().step(t, z, inputs)

run = live(Path(sys.argv[1]))
run.identifier.__class__ = Deadly
run.resume()
run.run()
"""


@pytest.mark.process
@pytest.mark.parametrize("deaths", [3, 4])
def test_a_crashing_sample_among_available_ones_is_skipped(tmp_path, deaths):
    """It is not committed before the first crash, and is committed alone from the second on."""
    write(tmp_path, 100)
    child = [sys.executable, "-c", DEADLY, str(tmp_path), str(Path(__file__).parent)]
    accepted = []
    for _ in range(deaths):
        assert subprocess.run(child, check=False).returncode == 7
        with Journal.open(tmp_path / "journal.sqlite") as kept:
            accepted.append(kept.accepted)
    assert accepted[0] < 91
    assert accepted[1:] == [91] * (deaths - 1)
    run = live(tmp_path)
    resumed(run)
    assert len(run.journal) == 100 - (deaths == 4)
    assert run.journal.counts == ({("aside", ""): 1} if deaths == 4 else {})


@pytest.mark.slow
def test_health_and_metrics(tmp_path):
    def ask(path):
        with urllib.request.urlopen(
            f"http://127.0.0.1:{monitor.port}{path}", timeout=PATIENCE
        ) as answer:
            return answer.read().decode()

    metrics = Metrics(["a", "b"])
    late = {"t": 0.0, "a": 0.0, "b": 0.0, "left": 0.0}
    wrong = [{**row, "a": 0.7 * row["left"], "b": 0.4 * row["left"]} for row in rows(5)]
    run = live(tmp_path, Rows([*wrong, late]), sinks=[metrics])
    monitor = Monitor(Address(), lambda: run.health, metrics)
    run.run()
    health = json.loads(ask("/health"))
    assert health.pop("seconds") > 0.0
    assert health.pop("findings")[0] == (
        "Not judged: the model was not tested (innovations: 4 samples, at least 20 required)."
    )
    assert health == {
        "ok": True,
        "why": "",
        "ailment": "",
        "t": 0.4,
        "samples": 5,
        "waiting": 0,
        "silent": False,
        "status": "ok",
        "replaying": "",
        "counts": [["conflict", "a", 1], ["conflict", "b", 1], ["conflict", "left", 1]],
        "verdict": "do not trust",  # k is held at ten prior standard deviations
    }
    value = run.result.last.parameters["k"][0]
    assert f'livepde_estimate{{unknown="k"}} {value!r}' in ask("/metrics")
    told = ask("/metrics")
    assert 'livepde_remarks_total{channel="a",kind="conflict"} 1.0' in told
    assert "livepde_waiting_samples 0.0" in told
    assert "livepde_model_time_seconds 0.4" in told
    assert f'livepde_build_info{{version="{lp.__version__}"}} 1.0' in told
    assert 'livepde_unknown_info{unit="",unknown="k"} 1.0' in told
    (stamp,) = re.findall("^livepde_last_sample_timestamp_seconds (.*)$", told, re.MULTILINE)
    assert 0.0 <= time.time() - float(stamp) < PATIENCE
    assert "livepde_verdict 2.0" in told
    assert "livepde_silent 0.0" in told
    assert f"livepde_step_seconds_total {run.health['seconds']!r}" in told
    assert ask("/livez") == ask("/readyz") == "ok\n"
    run.ailments.silent = True
    assert "livepde_silent 1.0" in ask("/metrics")
    assert "livepde_ok 0.0" in ask("/metrics")
    assert 'livepde_unwell{why="silent"} 1.0' in ask("/metrics")
    assert run.ailments.ill[1] not in ask("/metrics")
    with pytest.raises(urllib.error.HTTPError, match="503"):
        ask("/health")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        ask("/")
    with pytest.raises(lp.errors.RunError, match="choose another port"):
        Monitor(Address(port=monitor.port), dict, metrics)
    monitor.close()


def test_two_columns_of_one_name_are_reported(tmp_path):
    """The message names the duplicate, instead of a missing column."""
    path = tmp_path / "log.csv"
    path.write_text("t,a,a,,\n0,1,2,,\n1,1,2,,\n")
    source = Follow(path)
    first, *rest = source.poll(0.0)
    source.close()
    assert first.broken == "two columns are called 'a', and neither is used: rename one"
    assert [row.values["t"] for row in rest] == ["0", "1"]
    assert all("a" not in row.values for row in rest)


def test_a_followed_file_in_utf_16_is_named(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,a\n0,1\n1,2\n", encoding="utf-16")
    source = Follow(path)
    found = source.poll(0.0)
    source.close()
    assert found
    assert all("UTF-16" in row.broken for row in found if row.broken)
    assert found[0].broken == "the file is in UTF-16, not to be followed: write UTF-8"


def test_a_full_disk_in_a_silence_is_reported_as_what_it_is():
    """It was once an event of kind "silent", and its end had no event."""
    now = [0.0]
    feed = SimpleNamespace(interval=1.0, doubt="", done=False)
    journal = SimpleNamespace(in_place=True)
    ailments = Ailments(feed, journal, lambda: None, 10.0, lambda: now[0])
    assert ailments.look() is None
    now[0] = 20.0
    assert not ailments.listen(heard=False)
    ailments.unwritten = "no space"
    assert ailments.look() == ("unwell", "no space")
    assert ailments.look() is None
    ailments.unwritten = ""
    assert ailments.look() == ("silent", "no data from the source for more than 10 s")
    assert ailments.listen(heard=True) == "data source reconnected after 20 s"
    ailments.stepped(SimpleNamespace(status=SimpleNamespace(taken=True, ok=True)))
    assert ailments.look() == ("well", "")  # the end of a silence has been reported
