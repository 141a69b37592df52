"""Causes of a misfit are only those that equation and sensor can have."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from factories import driven_rod, observe

import livepde as lp
from livepde.laws import Fit
from livepde.laws.verdict import after_fit
from livepde.verdict import Cause, Dictionary, Finding, Verdict
from livepde.verdict.assess import FACTOR, LONGEST, _possible
from livepde.verdict.directions import GAIN, LAG, ScoreDirection


def possible(direction: ScoreDirection, size: float, samples: int = 100) -> bool:
    evidence = SimpleNamespace(size=np.array([[size]]))
    ledger = SimpleNamespace(times=np.array([0.0, 1.0]), seen=samples)
    at = SimpleNamespace(ledger=ledger, noise=np.array([0.1]), sensors=["T"])
    return _possible(direction, 0, 0, evidence, at)


def test_an_equation_without_a_loss_has_none_that_is_too_large():
    assert possible(ScoreDirection("loss"), 1.0)
    assert not possible(ScoreDirection("loss"), -1.0)
    assert possible(ScoreDirection("source"), -1.0)  # a sink


@pytest.mark.parametrize("kind", ["gain", "channel"])
def test_a_scale_is_wrong_by_a_factor_of_two_at_most(kind):
    direction = ScoreDirection(kind, "T", GAIN)
    sign = 1.0 if kind == "gain" else -1.0
    assert possible(direction, sign * 0.99 * (FACTOR - 1.0) / GAIN)
    assert not possible(direction, sign * 1.01 * (FACTOR - 1.0) / GAIN)
    assert possible(direction, -sign * 0.99 * (1.0 - 1.0 / FACTOR) / GAIN)
    assert not possible(direction, -sign * 1.01 * (1.0 - 1.0 / FACTOR) / GAIN)


def test_a_sensor_is_late_by_a_part_of_the_run():
    direction = ScoreDirection("lag", "T")
    assert possible(direction, 0.99 * LONGEST * 100 / LAG)
    assert not possible(direction, 1.01 * LONGEST * 100 / LAG)


def test_a_sensor_is_inside_the_body_and_not_beyond_the_next_one():
    model = driven_rod({"a": lp.Normal(1.0, 0.5)}, lambda t: t, lp.interval(0.0, 1.0, 20))
    observed = observe(model, lp.Points({"a": 0.1, "b": 0.4, "c": 0.5}, noise=0.1))
    noise = np.full(3, 0.1)
    found = Dictionary(model, observed, noise, [], dearer=False, windows=2).directions
    places = {one.subject: one for one in found if one.kind == "position"}
    reach = {name: (one.least, one.most) for name, one in places.items()}
    assert reach["a"] == pytest.approx((-0.1, 0.3))
    assert reach["b"] == pytest.approx((-0.1, 0.1))
    assert reach["c"] == pytest.approx((-0.1, 0.1))
    step = places["c"].size
    assert possible(places["c"], 0.09 / step)
    assert not possible(places["c"], 0.11 / step)
    assert not possible(places["c"], -0.11 / step)


@pytest.mark.parametrize(("converged", "kept"), [(True, 1), (False, 2)])
def test_refusals_count_no_longer_once_a_fit_of_all_readings_has_converged(converged, kept):
    fit = Fit(samples=50, cost=1.0, passes=2.0, readings=100, refused=0, converged=converged)
    other = Finding("stuck", "do not trust", "It is stuck.")
    verdict = Verdict.of([Finding("refused", "caution", "Many were refused."), other])
    found = after_fit(verdict, fit)
    assert len(found.findings) == kept
    assert found.level == "do not trust"


def test_below_half_of_the_misfit_no_single_cause_is_named():
    causes = (Cause("gain", "T", "T may be large", 0.36), Cause("lag", "T", "T may be late", 0.2))
    found = Finding("misfit", "caution", "It misfits.", causes=causes).sentence
    assert found == (
        "It misfits. No single cause explains this. Candidates: T may be large (36 %); T may be "
        "late (20 %)."
    )
    likely = (Cause("gain", "T", "T may be large", 0.6), *causes[1:])
    found = Finding("misfit", "caution", "It misfits.", causes=likely).sentence
    assert found == (
        "It misfits. T may be large (explains 60 %). Alternatively, T may be late (20 %)."
    )
