"""Pauses longer than the allowed substeps, long steps, and samples that are processed again."""

import threading
from dataclasses import replace
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest
from live_rod import OPENED, identifier, live, rows, same, write
from test_pauses import ALPHA, CASE, rod

import livepde as lp
from livepde.cases import load
from livepde.fleet import Fleet
from livepde.runs import drive
from livepde.runs import live_loop as loop
from livepde.runs.journal import Journal
from livepde.runs.monitor import Metrics, Monitor
from livepde.runs.web import Address
from livepde.stepping import LONG_SUBSTEPS, Advance, ImplicitEuler, interruptible
from livepde.streams.sources import Rows


@pytest.fixture(autouse=True)
def closed():
    yield
    while OPENED:
        OPENED.pop().close()


# --- pauses --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_pause_of_a_hundred_million_substeps_ends_and_moves_nothing(tmp_path: Path) -> None:
    """The rod comes to rest in it; after it, it is heated as before."""
    times, values = rod()
    times, values = times[:90], values[:90]
    table = np.column_stack(
        [np.concatenate([times, times + 1e8]), np.concatenate([values, values])]
    )
    header = "t,hot,cold,T_1,T_2,T_3"
    np.savetxt(tmp_path / "rod.csv", table, "%.12g", ",", header=header, comments="")
    (tmp_path / "case.toml").write_text(
        CASE.replace("[channels]", 'steps.dt_max = "1 s"\n[channels]')
    )
    prepared = load(tmp_path / "case.toml").prepare()
    driven = drive(prepared.identifier, prepared.stream)
    last = driven.result.last
    assert len(driven.result) == len(table)
    (event,) = [one for one in driven.journal.events if one.kind == "pause"]
    assert f"{LONG_SUBSTEPS} substeps longer than dt_max = 1" in event.message
    assert any("longer" in sentence for sentence in last.verdict.every_sentence)
    alpha = last["alpha"]
    assert abs(alpha.mean - ALPHA) < 2.0 * alpha.std < 0.05 * ALPHA
    # Readings after the pause are explained as those before it are.
    late = driven.result.to_xarray()["innovation"].values[-60:]
    assert np.sqrt(np.nanmean(late**2)) < 1.3 * 0.05


@pytest.mark.slow
def test_a_live_run_takes_all_samples_after_a_pause_and_a_resume(tmp_path: Path) -> None:
    mixed = list(rows(60))
    for row in mixed[20:]:
        row["t"] += 1e9
    for part in (40, 60):
        run = live(tmp_path, Rows(mixed[:part]))
        control = Advance(ImplicitEuler(), 0.1)
        run.identifier.problem = replace(run.identifier.problem, control=control)
        run.resume()
        run.run()
        assert run.journal.last == mixed[part - 1]["t"]
        assert run.health["ok"]
        run.journal.close()
    assert len(Journal.open(tmp_path / "journal.sqlite")) == 60


@pytest.mark.slow
def test_a_fleet_counts_intervals_that_are_too_long() -> None:
    who = identifier()
    sensors = lp.Points({"a": 0.3, "b": 0.6}, noise=0.01)
    fleet = Fleet(who.model, sensors, who.law, members=2, dt_max=0.01)
    single = lp.Identifier(who.model, sensors, who.law, dt_max=0.01)
    for t in (0.0, 0.1, 1e6):
        sample = {"a": 0.7, "b": 0.4}, {"left": 1.0}
        assert fleet.step(t, *sample).ok.all()
        estimate = single.step(t, *sample)
    sentence = "1 intervals between samples need more than 10000 substeps"
    assert any(sentence in text for text in estimate.verdict.every_sentence)
    assert any(sentence in text for text in fleet.identifier(1).estimate().verdict.every_sentence)


# --- signals -------------------------------------------------------------------------------------


def stopped_in_a_step(run: loop.Live, at: int) -> None:
    """Set `stopping` at the first safe point of the step of a sample."""
    step = run.identifier.step

    def stepped(t, z, inputs=None):
        if run.journal.accepted >= at:
            run.stopping.set()
        return step(t, z, inputs)

    run.identifier.step = stepped


@pytest.mark.slow
def test_a_step_is_left_between_substeps_and_taken_by_the_next_session(tmp_path, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder in (whole, parts):
        folder.mkdir()
        write(folder, 30)
    expected = live(whole)
    expected.resume()
    expected.run()
    monkeypatch.setattr(loop, "GRACE", 0.0)
    for k in range(loop.TRIES + 3):  # which is more often than a sample that ends the process
        run = live(parts)
        stopped_in_a_step(run, 17)
        run.resume()
        run.run()
        assert (run.journal.accepted, run.journal.pending) == (17, 1), k
        assert run.journal.estimated == 16
        run.journal.close()
    monkeypatch.undo()
    run = live(parts)
    assert run.resume() == 1
    run.run()
    same(run.journal, expected.journal)
    assert not [one for one in run.journal.events if one.kind == "aside"]


def test_a_step_that_ends_soon_after_a_signal_is_kept(tmp_path):
    write(tmp_path, 30)
    run = live(tmp_path)
    stopped_in_a_step(run, 17)
    run.run()
    assert (run.journal.accepted, run.journal.pending) == (17, 0)


def test_nothing_is_interrupted_in_another_thread():
    """A refit in its own thread goes on."""
    control, calls = Advance(ImplicitEuler(), 0.1), []

    def refuse() -> None:
        calls.append(0)
        raise KeyboardInterrupt

    def steps() -> None:
        from livepde.stepping import advance

        advance(control, lambda c, t, h: c, np.zeros(1), 0.0, 1.0)

    with interruptible(refuse):
        thread = threading.Thread(target=steps)
        thread.start()
        thread.join()
        assert not calls
        with pytest.raises(KeyboardInterrupt):
            steps()
    steps()


# --- samples taken again -------------------------------------------------------------------------


class Killed(BaseException):
    """The end of a process."""


def killed_after(run: loop.Live, steps: int) -> None:
    """Kill a run when so many steps have ended in its session."""
    step, taken = run.identifier.step, [0]

    def stepped(t, z, inputs=None):
        if taken[0] == steps:
            raise Killed
        taken[0] += 1
        return step(t, z, inputs)

    run.identifier.step = stepped
    run._conclude = lambda: None


@pytest.mark.slow
def test_a_run_that_is_killed_every_few_steps_makes_progress(tmp_path, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder in (whole, parts):
        folder.mkdir()
        write(folder, 40)
    expected = live(whole)
    expected.run()
    monkeypatch.setattr(loop, "APART", 0.0)  # as if each step took a second
    monkeypatch.setattr(loop, "COST", 1e9)
    before, lives = -1, 0
    while True:
        run = live(parts)
        killed_after(run, 4)
        try:
            run.resume()
            run.run()
            break
        except Killed:
            lives += 1
        assert run.journal.accepted > before
        before = run.journal.accepted
        run.journal.close()
    assert lives >= 9
    run.journal.checkpoint(run.identifier.dump())
    assert len(run.journal) == 40
    for mine, theirs in zip(run.journal, expected.journal, strict=True):
        assert np.array_equal(mine.numbers, theirs.numbers)


@pytest.mark.slow
def test_checkpoints_cost_a_small_share_of_the_steps(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "APART", 0.0)
    write(tmp_path, 40)
    run, kept = live(tmp_path), []
    checkpoint = run.journal.checkpoint
    run.journal.checkpoint = lambda state: (kept.append(run._seconds), checkpoint(state))
    run.run()
    del run.journal.checkpoint
    assert 1 <= len(kept) <= 1 + run._seconds * loop.COST / min(run._cost, 1e-4)


@pytest.mark.slow
def test_samples_are_taken_again_in_parts_if_a_signal_comes(tmp_path):
    write(tmp_path, 40)
    run = live(tmp_path)
    run._conclude = lambda: None
    run.run()
    run.journal.commit()
    assert run.journal.estimated == 40
    run.journal.close()
    left = []
    for stop in (10, 25, 99):
        before = 40 - sum(left)
        run = live(tmp_path)
        answers: dict[str, tuple[int, str]] = {}
        left.append(resumed_until(run, stop, answers))
        assert not run.replaying
        if stop < 99:
            text = f"replaying 4 of {before} since the checkpoint"
            assert answers["/readyz"] == (503, text + "\n")
            code, content = answers["/health"]
            assert code == 200
            assert f'"replaying": "{text}"' in content
            run.run()
        run.journal.close()
    assert left == [10, 25, 5]


def resumed_until(run: loop.Live, stop: int, answers: dict[str, tuple[int, str]]) -> int:
    """Resume a run with a signal in the step of a sample; ask its monitor before, in the fifth."""
    monitor = Monitor(Address.read("0", 0, ""), lambda: run.health, Metrics("ab"))
    step, taken = run.identifier.step, []

    def stepped(t, z, inputs=None):
        taken.append(t)
        if len(taken) == stop:
            run.stopping.set()
        if len(taken) == 5:
            answers.update({path: answer(monitor, path) for path in ("/readyz", "/health")})
        return step(t, z, inputs)

    run.identifier.step = stepped
    try:
        return run.resume()
    finally:
        monitor.close()


def answer(monitor: Monitor, path: str) -> tuple[int, str]:
    try:
        with urlopen(monitor.url + path) as found:
            return found.status, found.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()
