"""Input values at the initial time without a sample, which u0 may or may not provide."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from skfem import ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde.fleet import Fleet
from livepde.linalg import Array

D = 0.3  # diffusivity


def rod(cells: int = 40) -> lp.Model:
    """Return a rod with an unknown source, an end at zero, and one at a boundary channel."""
    mesh = lp.interval(0.0, 1.0, cells)
    ends = {"left": 0.0, "right": lp.Channel("T")}
    return lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet=ends),
        {"s": lp.Normal(0.0, std=1.0)},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: D * lp.dot(lp.grad(u), lp.grad(v)),
    )


def heated() -> lp.Model:
    """Return the rod with a source besides that is an input."""
    return rod().with_terms(B=[lambda u, v, x: -x.inputs["Q"] * v], inputs=["Q"])


SENSORS = lp.Points({"a": 0.9}, noise=0.01)
LAW = lp.SensitivityLaw(shadows=None)


def identifier(u0: Any, model: lp.Model | None = None, **options: Any) -> lp.Identifier:
    return lp.Identifier(model or rod(), SENSORS, LAW, u0=u0, q0={"s": 0.0}, **options)


def differences(start: float, end: float, begin: float, duration: float) -> float:
    """Return u(0.9) of u_t = D u_xx after a time, by implicit Euler on a fine grid.

    u is `begin` x at first, and u(1) goes from `start` to `end` in a straight line.
    """
    cells, steps = 400, 1000
    x = np.linspace(0.0, 1.0, cells + 1)
    r = D * duration / steps * cells**2
    bands = np.zeros((3, cells + 1))
    bands[1], bands[0, 2:], bands[2, :-2] = 1.0 + 2.0 * r, -r, -r
    bands[1, [0, cells]] = 1.0
    u = begin * x
    for k in range(steps):
        u[0], u[cells] = 0.0, start + (end - start) * (k + 1) / steps
        u = scipy.linalg.solve_banded((1, 1), bands, u)
    return float(u[360])


def seen(who: lp.Identifier, t: float, z: dict[str, float]) -> float:
    """Return the reading at 0.9 that is predicted for the end of a step."""
    estimate = who.step(t, z)
    moment = lp.fem.Moment(t, who._so_far.inputs)
    return float(who.observed.predict(estimate.u, estimate.q, moment)[0])


@pytest.mark.parametrize("begin", [0.0, 0.5, 2.0])
def test_a_boundary_begins_with_the_value_of_the_initial_state(begin: float):
    expected = differences(begin, 1.0, begin, 0.1)
    found = seen(identifier(lambda x: begin * x[0]), 0.1, {"T": 1.0})
    assert found == pytest.approx(expected, abs=0.003)


def test_that_equals_a_run_with_a_sample_at_the_initial_time():
    given, stated = identifier(lambda x: 0.5 * x[0]), identifier(lambda x: 0.5 * x[0])
    given.step(0.0, {"T": 0.5})
    for t, z, T in ((0.1, 0.3, 1.0), (0.3, np.nan, 0.7), (0.4, 0.6, 0.2)):
        one, other = (who.step(t, {"a": z, "T": T}) for who in (given, stated))
        np.testing.assert_allclose(one.u, other.u, atol=1e-13)
        np.testing.assert_allclose(one.q, other.q, atol=1e-13)
        assert one.held == other.held == ()
        assert one.verdict.findings == other.verdict.findings


def test_a_sample_at_the_initial_time_counts_more_than_the_initial_state():
    who = identifier(0.0)
    who.step(0.0, {"T": 1.0})
    expected = differences(1.0, 1.0, 0.0, 0.1)
    assert seen(who, 0.1, {"T": 1.0}) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("ahead", [0.1, 0.4])
def test_a_forecast_before_the_first_sample_begins_there_too(ahead: float):
    who = identifier(lambda x: 0.5 * x[0])
    forecast = who.forecast([ahead], {"T": 1.0})["a"]
    assert forecast[0] == pytest.approx(seen(who, ahead, {"T": 1.0}), abs=1e-12)


def test_a_fleet_begins_as_its_members():
    u0s = [0.0, lambda x: 0.5 * x[0], None]
    fleet = Fleet(rod(), SENSORS, LAW, members=3, u0=u0s, q0={"s": 0.0})
    assert fleet.together
    found = fleet.step(0.1, {"a": [0.3, 0.4, 0.5], "T": [1.0, 0.8, 0.6]})
    for k, (u0, T) in enumerate(zip(u0s, (1.0, 0.8, 0.6), strict=True)):
        alone = identifier(u0).step(0.1, {"a": 0.3 + 0.1 * k, "T": T})
        np.testing.assert_allclose(found.u[k], alone.u, atol=1e-12)
        np.testing.assert_allclose(found.q[k], alone.q, atol=1e-12)
        assert found.member(k).held == alone.held
    again = fleet.step(0.2, {"a": [0.3, 0.4, 0.5], "T": [1.0, np.nan, 0.6]})
    assert [again.member(k).held for k in range(3)] == [(), ("T",), ()]


def notes(estimate: lp.Estimate) -> list[str]:
    return [item.text for item in estimate.verdict.findings if item.what == "input"]


UNSTATED = "had no value at the initial time, so its first value was used for the first interval."


def test_inputs_that_no_state_has_are_named():
    who = identifier(0.0, heated())
    first = who.step(0.1, {"a": 0.1, "T": 1.0, "Q": 2.0})
    assert first.held == ("Q",)
    assert notes(first) == [f"Input Q {UNSTATED}"]
    second = who.step(0.2, {"a": 0.1, "T": 1.0, "Q": 2.0})
    assert second.held == ()
    assert notes(second) == [f"Input Q {UNSTATED}"]
    assert {item.severity for item in second.verdict.findings if item.what == "input"} == {"note"}
    begun = identifier(0.0, heated())
    begun.step(0.0, {"T": 1.0, "Q": 2.0})
    told = begun.step(0.1, {"a": 0.1, "T": 1.0, "Q": 2.0})
    assert told.held == ()
    assert notes(told) == []


@pytest.mark.parametrize("u0", [None, 0.0])
def test_an_initial_state_that_is_left_out_states_no_boundary_value(u0: Any):
    """Zero is the default state. It says nothing of a boundary: its first value is held."""
    who = identifier(u0)
    start, names = (0.0, []) if u0 == 0.0 else (1.0, [f"Input T {UNSTATED}"])
    expected = differences(start, 1.0, 0.0, 0.1)
    assert seen(who, 0.1, {"T": 1.0}) == pytest.approx(expected, abs=0.02)
    assert notes(who.estimate()) == names


def test_the_note_survives_a_restart(tmp_path: Path):
    first, second = identifier(0.0, heated()), identifier(0.0, heated())
    first.step(0.1, {"a": 0.1, "T": 1.0, "Q": 2.0})
    first.save(tmp_path / "state.bin")
    second.load(tmp_path / "state.bin")
    one, other = (who.step(0.2, {"a": 0.1, "T": 1.0, "Q": 2.0}) for who in (first, second))
    assert notes(one) == notes(other) == [f"Input Q {UNSTATED}"]
    np.testing.assert_array_equal(one.q, other.q)


def plate(dirichlet: Any) -> lp.Model:
    mesh = MeshTri.init_tensor(*[np.linspace(0.0, 1.0, 9)] * 2).with_defaults()
    return lp.Model(
        lp.Field(mesh, ElementTriP1(), dirichlet=dirichlet),
        {"k": lp.Normal(1.0, std=0.1)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )


def _corner(x: Array) -> Array:
    """Return 3 on the left side but for its corners, which belong to sides at zero."""
    return 3.0 * ((x[0] == 0.0) & (x[1] > 0.0) & (x[1] < 1.0))


@pytest.mark.parametrize(
    ("dirichlet", "u0", "stated"),
    [
        ({"left": lp.Channel("T")}, lambda x: 2.0 + x[0] * x[1], {"T": 2.0}),
        ({"left": lp.Channel("T")}, lambda x: 2.0 + x[1], {}),
        ({"left": lp.Channel("T")}, lambda x: 2.0 + 5.0 * x[0] + 1e-4 * x[1], {"T": 2.00005}),
        ({"left": lp.Channel("T"), "right": lp.Channel("T")}, lambda x: 2.0 + x[0], {}),
        ({"left": lp.Channel("T"), "right": lp.Channel("T")}, 20.0, {"T": 20.0}),
        ({"left": lp.Channel("T"), "top": 0.0, "bottom": 0.0}, _corner, {"T": 3.0}),
        ({"left": lp.Channel("T"), "right": lp.Channel("R")}, lambda x: x[0], {"T": 0.0, "R": 1.0}),
        ({"left": lp.Channel("T")}, None, {}),
    ],
)
def test_a_state_states_a_boundary_value_where_it_is_one_number(
    dirichlet: Any, u0: Any, stated: dict[str, float]
):
    assert plate(dirichlet).boundary_readings(u0) == pytest.approx(stated, abs=1e-12)


def test_a_component_that_is_left_out_states_nothing():
    mesh = lp.interval(0.0, 1.0, 5)
    fields = {
        name: lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Channel(name.upper())})
        for name in ("a", "b")
    }
    model = lp.Model(fields, {"k": lp.Normal(1.0)}, A=lambda q, u, v, x: q.k * (u.a * v.a))
    assert model.boundary_readings({"a": 3.0}) == {"A": 3.0}
    assert model.boundary_readings({"a": 3.0, "b": 1.0}) == {"A": 3.0, "B": 1.0}
