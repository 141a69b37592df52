"""Small versions of the fault and soak benchmarks detect faults, and pass without them."""

import shutil
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import livepde as lp
from benchmarks import faults, soak
from benchmarks.faults import broken, clocks, damage, hostile, plants, rod
from livepde import cases
from livepde.records import Record

MQTT = pytest.mark.skipif(
    shutil.which("mosquitto", path=f"/usr/bin:{plants.BROKER}") is None,
    reason="needs the broker mosquitto",
)


def failed(outcome) -> list[str]:
    return [check.name for check in outcome.checks if not check.ok]


@pytest.mark.broker
@MQTT
def test_broken_messages_reach_the_real_command():
    pytest.importorskip("paho.mqtt")
    assert not failed(faults.faults(samples=100, malformed=1000, only=["messages"]))


@pytest.mark.process
def test_damaged_journals_are_reported():
    outcome = faults.faults(samples=100, flips=10, only=["journals"], seed=1)
    assert not failed(outcome)
    ((flips, detected, plain, different),) = outcome.tables[0].rows
    assert (flips, different) == (10, 0)
    assert 0 < detected <= flips
    assert plain == flips - detected


def test_harmful_clock_faults_fail_the_checks():
    rows = rod.rod_rows(clocks.COUNT)
    fault = clocks.FAULTS["one row 10 years ahead"]
    right = clocks._right(fault, rows)
    well = {"ok": True, "ailment": ""}
    doubt = {"ok": False, "ailment": "clock"}
    estimates = {60.0 * k: (2e-5, 1e-7) for k in range(clocks.COUNT)}
    seen = clocks._Seen(right, {}, doubt, well, "trusted", estimates)
    tally = clocks._Tally()
    tally.add("none", seen, fault, rows)
    assert all(check.ok for check in tally.checks())
    lost = {key: value for key, value in right.items() if key != (600.0, "left")}
    moved = {t: (2.1e-5, half) for t, (_, half) in estimates.items()}
    tally.add(
        "harm", clocks._Seen(lost | {(1e9, "T_3"): 20.0}, {}, well, doubt, "", moved), fault, rows
    )
    never = clocks.FAULTS["back by 3.5 steps every 30 rows"]
    tally.add("trusted", replace(seen, after=doubt, values=clocks._right(never, rows)), never, rows)
    assert [check.value for check in tally.checks()] == [1, 1, pytest.approx(10.0), 1, 1, 1]


@pytest.mark.process
def test_hostile_cases_are_refused_with_one_sentence(monkeypatch):
    few = ("unit, powers of powers", "1e12 cells")
    monkeypatch.setattr(hostile, "HOSTILE", {name: hostile.HOSTILE[name] for name in few})
    monkeypatch.setattr(hostile, "SOONEST", 60.0)  # the duration is not tested
    outcome = faults.faults(only=["cases"])
    assert not failed(outcome)
    assert [row[0] for row in outcome.tables[0].rows] == [*few]
    crash = "Traceback (most recent call last):\nRecursionError"
    monkeypatch.setattr(hostile, "_checked", lambda path: (1, crash, 0.1, 1.0))
    assert failed(faults.faults(only=["cases"])) == ["hostile cases without one sentence"]


def record(t: float, value: float = 1.0) -> Record:
    nothing = np.zeros(0)
    return Record(
        t=t,
        numbers=np.array([value]),
        innovation=nothing,
        validation_error=nothing,
        status=0,
        steps=1,
        notes={},
    )


def found(*records: Record, state: bytes = b"x") -> damage.Found:
    return damage.Found(records, len(records), state, Counter(), Counter())


@pytest.mark.parametrize(
    ("other", "lost", "doubled", "different"),
    [
        (found(record(0.0), record(1.0)), 0, 0, 0),
        (found(record(0.0)), 2, 0, 0),  # neither accepted nor estimated
        (found(record(0.0), record(1.0), record(1.0)), 0, 2, 0),
        (found(record(0.0), record(1.0, np.nextafter(1.0, 2.0))), 0, 0, 1),
        (found(record(0.0), record(1.0), state=b"y"), 0, 0, 1),
    ],
)
def test_lost_doubled_and_different_samples_are_counted(other, lost, doubled, different):
    counted = damage.Damage()
    counted.compare(other, found(record(0.0), record(1.0)))
    assert (counted.lost, counted.doubled, counted.different) == (lost, doubled, different)
    assert all(check.ok for check in counted.checks("x")) == (lost + doubled + different == 0)


def test_a_last_fit_that_was_skipped_is_no_damage():
    """The last estimates are compared unless exactly one run reports an unfinished fit."""
    other = found(record(0.0), record(1.0, 2.0))
    counted = damage.Damage()
    counted.compare(replace(other, events=Counter(unfinished=1)), found(record(0.0), record(1.0)))
    assert counted.different == 0
    counted.compare(other, found(record(0.0), record(1.0)))
    assert counted.different == 1


@pytest.mark.slow
def test_malformed_rows_are_counted_by_reason(tmp_path, monkeypatch):
    (tmp_path / "case.toml").write_text(rod.case_text())
    monkeypatch.setattr(broken, "JSON", {"right": lambda row, write, rng: write(dict(row))})
    monkeypatch.setattr(broken, "BYTES", {})
    case, rows = cases.load(tmp_path / "case.toml"), rod.rod_rows(20)
    fed = broken.fed(case, rows, tmp_path / "rows.jsonl", 20, np.random.default_rng(0))
    assert fed.reasons == {"repeated": 20}
    monkeypatch.setattr(
        broken, "JSON", {"new": lambda row, write, rng: write({**row, "time": "2027-01-01"})}
    )
    fed = broken.fed(case, rows, tmp_path / "rows.jsonl", 2, np.random.default_rng(0))
    assert fed.reasons["leap"] == 2


@pytest.mark.slow
def test_a_short_soak_counts_its_faults_and_keeps_all_samples(monkeypatch):
    law = partial(lp.SensitivityLaw, refit=None)  # refits take most of the time
    law.scheme = lp.SensitivityLaw.scheme
    monkeypatch.setattr(soak, "SensitivityLaw", law)
    monkeypatch.setattr(soak, "WARM", 300)
    monkeypatch.setattr(soak, "BLOCK", 100)
    # All faults fit into 700 rows, with a few rows each.
    few = {
        name: (60 + 40 * k, min(count, 8), change)
        for k, (name, (_, count, change)) in enumerate(soak.FAULTS.items())
    }
    monkeypatch.setattr(soak, "FAULTS", few)
    outcome = soak.soak(700)
    counts = {(kind, channel): number for kind, channel, number in outcome.tables[1].rows}
    assert counts["repeated", ""] >= 60
    assert counts["leap", ""] == 1 + 8 + 8
    assert counts["malformed", ""] == counts["malformed", "a"] == 5
    assert counts["missing", "b"] == counts["missing", "left"] == 8
    checks = {check.name.split(":")[0]: check for check in outcome.checks}
    assert checks["memory"].ok
    assert checks["steps that failed"].ok
    assert checks["estimates that a reader does not find"].ok
    assert checks["samples lost or doubled"].ok
    with pytest.raises(lp.errors.RunError, match="at least 600"):
        soak.soak(100)


def test_a_soak_whose_costs_grow_fails_its_checks():
    steps = range(soak.WARM, 3 * soak.WARM, soak.BLOCK)
    meter = soak.Meter(None, lambda: 1e-3)
    flat = soak.Reading(0, 1e-3, 1e-3, 1e8, 2e8, 5e6, 4e6)
    meter.readings = [replace(flat, steps=k) for k in steps]
    assert not failed(soak._outcome(meter, 30_000, 0, 0.0, record=640.0))
    meter.readings = [
        soak.Reading(k, 1e-3 * k / soak.WARM, 1e-3, 1e8 + 1e3 * k, 2e8, 100.0 * k, 1e4 * k)
        for k in steps
    ]
    meter.failed = 1
    assert len(failed(soak._outcome(meter, 30_000, 1, 0.1, record=640.0, lost=1))) == 8
