"""The room behind the wall, the battery particle, and do-mpc's moving horizon in the loop."""

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

import livepde.control as ct
from benchmarks.control import battery as cell
from benchmarks.control import wall as house
from benchmarks.control.battery import battery
from benchmarks.control.horizon import MovingHorizon, Setting
from benchmarks.control.problem import Problem, Simulated
from benchmarks.control.wall import wall
from livepde.errors import ConfigurationError

pytestmark = pytest.mark.study

needs_mpc = pytest.mark.skipif(find_spec("do_mpc") is None, reason="do-mpc is not installed")


@pytest.fixture
def mild(monkeypatch):
    """Weather without a record: a winter day, again and again."""
    day = 2.0 + 5.0 * np.sin(2 * np.pi * (np.arange(24 * 7 * 20) - 9.0) / 24.0)
    monkeypatch.setattr(house, "weather", lambda: day)


# --- the room --------------------------------------------------------------------------------


def test_the_room_ends_where_its_heat_balance_says(mild):
    """With a constant heater the air is warmer than outside by v/(airing + 1/resistance)."""
    problem, factors = wall(), {"masonry": 1.7, "insulation": 0.6, "render": 1.2}
    true = {f"k[{name}]": value for name, value in factors.items()}
    starts = {"masonry": 0.03, "insulation": 0.23, "render": 0.28}
    resistance = 0.01 / 0.08 + 1.0 / house.OUTSIDE
    for name, factor in factors.items():
        end, conductivity, *_ = house.WALL[name]
        resistance += (end - starts[name]) / (conductivity * factor)
    plant = plant_of(problem, true, start=8.0)
    for k in range(1, 60):
        plant.advance(k * house.DAY, {"heater": 20.0, "outside": 5.0})
    air = plant.outputs()[0]
    assert air == pytest.approx(5.0 + 20.0 / (house.AIRING + 1.0 / resistance), abs=0.02)
    # The reduced model ends there, too: its static responses are exact at the prior.
    c = problem.reduced.values({"heater": 20.0, "outside": 5.0})
    step = problem.reduced.matrices(np.ones(3), 60 * house.DAY)
    at_prior = step(problem.reduced.project(np.full(problem.reduced.frame.V.shape[0], 8.0)), c)
    assert problem.reduced.outputs(at_prior, c)[0] == pytest.approx(
        5.0 + 20.0 / (house.AIRING + 1.0 / (0.175 + 0.25 + 0.05 / 0.06 + 0.08 / 0.9)), abs=0.01
    )


def plant_of(problem: Problem, truth: Any, start: float, seed: int = 0) -> Simulated:
    """Return the plant of a problem with another truth."""
    plant = problem.plant(seed)
    plant.truth = lambda t: truth
    assert plant.outputs()[0] == pytest.approx(start)
    return plant


def test_without_its_record_the_wall_says_what_to_set(monkeypatch):
    monkeypatch.delenv("LIVEPDE_DATA", raising=False)
    house.weather.cache_clear()
    with pytest.raises(ConfigurationError, match="LIVEPDE_DATA is not set; set it to the folder"):
        wall()


# --- the battery -----------------------------------------------------------------------------


def test_the_charge_that_flows_is_the_mean_filling():
    problem = battery()
    plant = problem.plant(0)
    for k in range(1, 21):
        plant.advance(30.0 * k, {"I": -2.0 * cell.ONE})
    mean, surface = plant.outputs()
    assert mean == pytest.approx(cell.LOW + 2.0 * 600.0 / 3600.0, abs=1e-4)
    assert surface > mean + 0.05


def test_the_reduced_particle_misses_little():
    problem = battery()
    for factor in (0.4, 1.0, 2.5):
        missed = problem.reduced.error({"D": factor * cell.D}, h=problem.period)
        assert missed["mean"] < 1e-5
        assert missed["surface"] < 2e-3


# --- the moving horizon ----------------------------------------------------------------------


def driven(problem: Problem, estimator: Any, samples: int, begin: int = 0) -> list[ct.Known]:
    """Return what an estimator says while a current goes in and out."""
    plant, found = problem.plant(0), []
    for k in range(samples):
        inputs = {"I": (-2.0 if k % 20 <= 10 else 1.0) * cell.ONE}
        if k:
            plant.advance(problem.period * k, inputs)
        z = plant.measure()
        if k >= begin:
            found.append(estimator.step(problem.period * k, z, inputs))
    return found


@needs_mpc
@pytest.mark.parametrize("full", [False, True])
def test_the_moving_horizon_finds_the_diffusivity(full):
    problem = battery(1)  # far from the prior
    estimator = MovingHorizon(problem, Setting(12, 1.0, 0.1, full))
    model = problem.reduced
    assert estimator.coordinates.model.size == (len(model.frame.V) if full else model.size)
    known = driven(problem, estimator, 40)
    assert [one.source for one in known[:13]] == 12 * ["fallback"] + ["estimate"]
    assert "window of 12 samples is not full" in known[0].why
    truth = problem.truth(39 * problem.period)["D"]
    assert abs(truth / cell.D - 1.0) > 0.5
    assert known[-1].q[0] == pytest.approx(truth, rel=0.15)
    assert known[-1].factor.shape == (1, 0)
    fillings = problem.reduced.outputs(known[-1].x, np.zeros(1))
    plant = problem.plant(0)
    for k in range(1, 40):
        plant.advance(problem.period * k, {"I": (-2.0 if k % 20 <= 10 else 1.0) * cell.ONE})
    assert fillings == pytest.approx(plant.outputs(), abs=0.02)


@needs_mpc
def test_the_moving_horizon_goes_on_from_what_it_dumped():
    problem, setting = battery(1), Setting(8, 1.0, 1.0)
    whole = driven(problem, MovingHorizon(problem, setting), 24)
    first = MovingHorizon(problem, setting)
    driven(problem, first, 16)
    second = MovingHorizon(problem, setting)
    second.restore(first.dump())
    rest = driven(problem, second, 24, begin=16)
    for one, other in zip(whole[16:], rest, strict=True):
        assert np.array_equal(one.q, other.q)
        assert np.array_equal(one.x, other.x)
