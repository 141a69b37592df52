"""A single reading of 9999 in a law without a covariance."""

import math
from pathlib import Path

import live_rod
import numpy as np
import pytest

import livepde as lp
from livepde.streams.sources import Rows

SENSORS = {"a": 0.3, "b": 0.6}


def identifier() -> lp.Identifier:
    mesh = lp.interval(0.0, 1.0, 10)
    model = lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("left"), "right": 0.0}),
        parameter={"k": lp.Field(mesh, lp.linear(mesh))},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    law = lp.GradientLaw(gain=1e-2)
    return lp.Identifier(model, lp.Points(SENSORS, noise=0.01), law, q0=0.05)


def run(changes: dict[int, float], count: int = 60) -> tuple[lp.Estimate, list[float]]:
    """Return the last estimate, and what was refused, with other values of a at some samples."""
    who, refused = identifier(), []
    for k, row in enumerate(live_rod.rows(count)):
        z = {"a": changes.get(k, row["a"]), "b": row["b"]}
        estimate = who.step(row["t"], z, {"left": row["left"]})
        assert estimate.status.ok
        refused.append(estimate.diagnostics.refused)
    return estimate, refused


@pytest.mark.slow
@pytest.mark.parametrize("value", [9999.0, -127.0, 1e300])
def test_one_wild_reading_is_as_a_missing_one(value: float) -> None:
    wild, refused = run({40: value})
    missing, none = run({40: math.nan})
    assert np.array_equal(wild.q, missing.q)
    assert np.array_equal(wild.u, missing.u)
    assert [k for k, number in enumerate(refused) if number == 1.0] == [40]
    assert not [number for number in none if number == 1.0]
    plain, _ = run({})
    assert np.abs(wild.q - plain.q).max() < 0.05 * np.abs(plain.q).max()


def test_readings_that_stay_far_outside_are_used_from_the_fourth_on() -> None:
    """The process has moved: what comes later is not refused any more."""
    _, refused = run(dict.fromkeys(range(40, 50), 100.0), count=50)
    assert [k for k, number in enumerate(refused) if number == 1.0] == [40, 41, 42]


def test_nothing_of_a_usual_run_is_wild() -> None:
    _, refused = run({})
    assert not [number for number in refused if number == 1.0]


def test_a_live_run_reports_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_rod, "identifier", lambda **_: identifier())
    given = list(live_rod.rows(60))
    given[40]["a"] = 9999.0
    run = live_rod.live(tmp_path, Rows(given))
    run.run()
    (event,) = [one for one in run.journal.events if one.kind == "wild"]
    assert event.message.startswith("t = 4: 1 outliers, far outside the range so far")
    while live_rod.OPENED:
        live_rod.OPENED.pop().close()
