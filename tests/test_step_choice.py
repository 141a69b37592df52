"""Substeps are divided if the error of the time step is large relative to the noise.

The data come from `benchmarks.first_hour.moved`, with cells that move with the water; it shares
neither scheme nor mesh with the package.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import livepde as lp
from benchmarks.first_hour import moved
from livepde.laws import Shadows

REPORTS = Path(__file__).parent / "reports"
LENGTH, PLACES = 400.0, (130.0, 270.0, 400.0)
AREA, WATER, SOIL = 7.854e-3, 4.1e6, 9.0
K, D, FLOW, NOISE = 1.0, 0.08, 10.0, 0.05
COUNT = 40
SENSORS = lp.Points(list(PLACES), noise=NOISE)


def supply(t: float) -> float:
    """Return a front that is 3 minutes long, as the readings and lines between them show it."""
    return float(np.interp(t, [0.0, 300.0, 480.0], [70.0, 70.0, 80.0]))


@cache
def rows(seed: int = 0) -> tuple[tuple[float, Any, dict[str, float]], ...]:
    read = 60.0 * np.arange(COUNT)
    times, shown = moved(K, D, lambda t: FLOW, supply, float(read[-1]))
    z = np.column_stack([np.interp(read, times, column) for column in shown.T])
    z += NOISE * np.random.default_rng(seed).standard_normal(z.shape)
    return tuple((float(t), row, {"T": supply(float(t))}) for t, row in zip(read, z, strict=True))


@cache
def pipe(d: float = 0.2) -> lp.Model:
    mesh = lp.interval(0.0, LENGTH, 200)
    speed = FLOW / 3600.0 / AREA
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T")}),
        {"K": lp.LogNormal(0.5, std=0.5), "D": lp.LogNormal(d, std=d)},
        A=lambda q, u, v, x: (
            q.D * lp.dot(lp.grad(u), lp.grad(v))
            + q.K / (WATER * AREA) * (u - SOIL) * v
            + speed * lp.grad(u)[0] * v
        ),
    )


def begun(x: Any) -> Any:
    decay = np.exp(-K * x[0] / (WATER * FLOW / 3600.0))
    return SOIL + (70.0 - SOIL) * decay


def identifier(law: Any = None, **k: Any) -> lp.Identifier:
    return lp.Identifier(pipe(), SENSORS, law or lp.SensitivityLaw(), u0=begun, **k)


def ran(given: lp.Identifier, taken: Any = None) -> lp.Estimate:
    for t, z, inputs in taken or rows():
        estimate = given.step(t, z, inputs)
    return given._settled(estimate)


def parts_of(given: lp.Identifier) -> np.ndarray[Any, Any]:
    """Return in how many parts the substeps of each sample were divided."""
    found: np.ndarray[Any, Any] = given._state.log[0, 1:, -1].astype(int)
    return found


STATED = lp.SensitivityLaw(shadows=Shadows(parts=1))


@pytest.mark.long
def test_a_front_is_stepped_as_finely_as_the_unknowns_need() -> None:
    exact = ran(identifier(STATED, dt_max=2.5))
    coarse, chosen = ran(identifier(STATED)), ran(given := identifier())
    off = abs(coarse["D"].mean - exact["D"].mean) / exact["D"].std
    assert off > 4.0  # a stated step of a sample interval
    assert abs(chosen["D"].mean - exact["D"].mean) < 0.3 * exact["D"].std
    assert abs(chosen["K"].mean - exact["K"].mean) < 0.3 * exact["K"].std
    low, high = chosen["D"].interval()
    assert low <= D <= high
    # Only the steps of the front are short, and they are so before it is seen.
    parts = parts_of(given)
    assert parts[:4].max() == 1
    assert parts[5:12].max() >= 4
    assert parts[-4:].max() <= parts[5:12].max() // 2


@pytest.mark.slow
def test_a_stated_dt_max_is_an_upper_bound() -> None:
    given = identifier(dt_max=20.0)
    estimate = [given.step(*row) for row in rows()][9]
    assert estimate.steps >= 6
    assert estimate.steps % 3 == 0


OTHERS = [pytest.param(stop, marks=pytest.mark.long) for stop in (9, 25)]


@pytest.mark.long
@pytest.mark.parametrize("stop", [6, *OTHERS])
def test_a_run_that_is_resumed_takes_the_same_steps(stop: int) -> None:
    whole, first = identifier(), identifier()
    ends = [whole.step(*row) for row in rows()]
    for row in rows()[:stop]:
        first.step(*row)
    second = identifier()
    second.restore(first.dump())
    again = [second.step(*row) for row in rows()[stop:]]
    for one, other in zip(again, ends[stop:], strict=True):
        assert one.steps == other.steps
        np.testing.assert_array_equal(one.q, other.q)
        np.testing.assert_array_equal(one.q_std, other.q_std)


@pytest.mark.slow
def test_the_noise_of_a_reading_counts_as_that_of_its_sensor() -> None:
    """The same noise, stated for the sensors or with each reading."""
    rough = lp.Points(list(PLACES), noise=50.0 * NOISE)
    stated, own = identifier(), lp.Identifier(pipe(), rough, lp.SensitivityLaw(), u0=begun)
    for t, z, inputs in rows()[:12]:
        stated.step(t, z, inputs)
        readings = {name: (float(x), NOISE) for name, x in zip(own.observed.names, z, strict=True)}
        own.step(t, readings, inputs)
    assert parts_of(stated).max() > 1
    assert parts_of(own).tolist() == parts_of(stated).tolist()


@pytest.mark.slow
def test_members_of_a_fleet_choose_their_own_steps() -> None:
    """One member sees a front, the other does not."""
    law, taken = lp.SensitivityLaw(refit=None, guards=None), rows()[:20]
    calm = [(t, z[:], {"T": 70.0}) for t, z, _ in taken]
    singles = []
    for one in (taken, calm):
        given = identifier(law)
        singles.append([given.step(*row) for row in one])
    fleet = lp.Fleet(pipe(), SENSORS, law, members=2, u0=begun)
    for k, ((t, z, inputs), (_, other, _)) in enumerate(zip(taken, calm, strict=True)):
        both = {"T": np.array([inputs["T"], 70.0])}
        estimate = fleet.step(t, np.array([z, other]), both)
        for member in range(2):
            single = singles[member][k]
            assert estimate.steps[member] == single.steps
            np.testing.assert_allclose(estimate.q[member], single.q, rtol=1e-9)
    assert singles[0][10].steps > singles[1][10].steps


@pytest.mark.long
@pytest.mark.parametrize("evolution", [None, lp.RandomWalk(1e-4)])
def test_a_smoother_takes_the_same_steps(evolution: Any) -> None:
    """Undivided steps end at 0.32, nine standard deviations away."""
    model = pipe()
    if evolution is not None:
        unknowns: dict[str, Any] = {
            "K": lp.LogNormal(0.5, std=0.5),
            "D": lp.Scalar(lp.LogNormal(0.2, std=0.2), evolution=evolution),
        }
        model = lp.Model(model.state, unknowns, **model._parts)
    given = lp.Identifier(model, SENSORS, lp.SensitivityLaw(), u0=begun)
    samples = [lp.Sample(t=t, z=z, inputs=inputs) for t, z, inputs in rows()]
    result = given.run(samples)
    smoothed = result.smoothed()
    last = result.last
    for name in ("K", "D"):
        # About another trajectory, the unknowns differ by their nonlinearity.
        assert abs(float(smoothed[name][-1]) - last[name].mean) < 0.4 * last[name].std


@pytest.mark.slow
def test_a_state_that_hardly_changes_is_not_divided() -> None:
    given = identifier()
    for t, z, _ in rows()[:5]:
        assert given.step(t, z, {"T": 70.0}).steps <= 8  # graded at the start, and no more
    assert parts_of(given).max() == 1


def test_the_parts_of_a_step_are_a_number() -> None:
    for parts in (0, 2.5, "many"):
        with pytest.raises(lp.errors.LawError, match="parts must be a whole number"):
            Shadows(parts=parts)  # type: ignore[arg-type]


@pytest.mark.study
def test_the_report_of_a_pipe_is_not_shifted_by_its_steps() -> None:
    """`init` writes dt_max = 60 s; the best fit of the data is 0.122 for steps and mesh to zero.

    That number is of an own finite-element code with SciPy's least squares. At 60 s its best fit is
    0.25, and the run ended with 0.312 ± 0.028.
    """
    from livepde.cases import load

    prepared = load(REPORTS / "pipe_dispersion.toml", allow_code=True).prepare()
    for sample in prepared.stream:
        estimate = prepared.identifier.step(sample.t, sample.z, sample.inputs)
    low, high = estimate["D"].interval()
    assert low < 0.122 < high
    assert high < 0.25
    assert abs(estimate.diagnostics.shifts.sizes["step"]) < 0.3
