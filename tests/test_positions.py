"""Point sensors whose positions are uncertain: shifts are unknowns, estimated with the rest."""

from __future__ import annotations

import numpy as np
import pytest
from factories import ROD_CASE, observe
from skfem import ElementLineP1, ElementQuad1

import livepde as lp
from livepde import cases

AT = {"T_1": 0.2, "T_2": 0.45, "T_3": 0.7}


def rod() -> lp.Model:
    return lp.Model(
        state=lp.Field(
            lp.interval(0.0, 1.0, 40),
            ElementLineP1(),
            dirichlet={"left": lp.Channel("left"), "right": 0.0},
        ),
        parameter={"k": lp.Normal(0.1, std=0.03)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )


def samples(k: float, shifts, seed: int, count: int = 120):
    """Return what sensors at shifted places show of a rod."""
    rng = np.random.default_rng(seed)
    where = {name: x + d for (name, x), d in zip(AT.items(), shifts, strict=True)}
    points = lp.Points(where, noise=1.0)
    one = lp.Identifier(rod(), points, lp.SensitivityLaw(), u0=0.0, q0={"k": k})
    found = []
    for j in range(count):
        left = 1.0 + np.sin(0.1 * j)
        one.step(0.05 * j, {"left": left})
        belief = one.latent_belief()
        z = one.observed.predict(belief.u, belief.q, None) + 0.005 * rng.standard_normal(3)
        found.append((0.05 * j, {**dict(zip(AT, z.tolist(), strict=True)), "left": left}))
    return found


def estimated(found, std):
    points = lp.Points(AT, position_std=std, noise=0.005)
    one = lp.Identifier(rod(), points, lp.SensitivityLaw(), u0=0.0)
    return one, one.run(found).last.belief


@pytest.mark.study
def test_shifts_are_found_and_what_they_cost_is_in_the_interval():
    inside, shifts_inside = 0, 0
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        k = 0.1 + 0.03 * float(np.clip(rng.standard_normal(), -2.0, 2.0))
        shifts = 0.02 * rng.standard_normal(3)
        found = samples(k, shifts, seed)
        one, belief = estimated(found, 0.02)
        std = belief.q_std
        inside += abs(belief.q[0] - k) < 1.96 * std[0]
        shifts_inside += int((np.abs(belief.q[1:] - shifts) < 1.96 * std[1:]).sum())
    assert one.model.parameter_space.labels.keys() == {
        "k",
        *(f"position[{name}]" for name in AT),
    }
    assert inside >= 9
    assert shifts_inside >= 26


def test_it_is_a_quadratic_in_the_shift():
    model = rod().with_unknowns(lp.Points(AT, position_std=0.02).unknowns)
    points = lp.Points(AT, position_std=0.02, noise=0.005)
    observed = observe(model, points)
    u = model.state_space.interpolate(lambda x: np.sin(3.0 * x[0]))
    q = np.array([0.1, 0.01, -0.02, 0.0])
    at = np.array(list(AT.values())) + q[1:]
    assert not observed.linear
    assert observed.predict(u, q, None) == pytest.approx(np.sin(3.0 * at), abs=1e-3)
    G, H_q = observed.jacobian(u, q, None)
    assert G @ u == pytest.approx(observed.predict(u, q, None))
    assert np.diag(H_q[:, 1:]) == pytest.approx(3.0 * np.cos(3.0 * at), abs=0.06)
    assert np.count_nonzero(H_q) == 3


@pytest.mark.parametrize(("at", "shift"), [(0.99, 0.03), (1.0, -0.03), (0.0, 0.02), (0.5, 0.1)])
def test_a_sensor_may_lie_near_or_on_the_end_of_the_mesh(at, shift):
    points = lp.Points({"T": at}, position_std=0.05, noise=0.1)
    model = rod().with_unknowns(points.unknowns)
    observed = observe(model, points)
    u = model.state_space.interpolate(lambda x: 2.0 * x[0])
    q = np.array([0.1, shift])
    assert observed.predict(u, q, None) == pytest.approx([2.0 * (at + shift)])
    assert observed.jacobian(u, q, None)[1][0, 1] == pytest.approx(2.0)


@pytest.mark.slow
def test_in_two_dimensions_each_coordinate_has_a_shift():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (6, 6))
    model = lp.Model(
        state=lp.Field(mesh, ElementQuad1(), dirichlet={"left": 0.0}),
        parameter={"k": lp.Normal(1.0, std=0.3)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        f=1.0,
    )
    points = lp.Points({"a": (0.3, 0.4), "b": (0.6, 0.5)}, position_std={"a": 0.01}, noise=0.01)
    one = lp.Identifier(model, points, lp.SensitivityLaw(), u0=0.0)
    assert list(one.model.parameter_space.labels) == ["k", "position[a.x]", "position[a.y]"]
    assert one.step(0.1, {"a": 0.05, "b": 0.06}).status.ok
    u = one.model.state_space.interpolate(lambda x: 2.0 * x[0] + 3.0 * x[1])
    _, H_q = one.observed.jacobian(u, np.array([1.0, 0.0, 0.0]), None)
    assert H_q[0, 1:] == pytest.approx([2.0, 3.0])
    assert not H_q[1].any()


def test_calibrated_sensors_keep_their_positions():
    base = lp.Points(AT, position_std=0.02)
    model = lp.Model(
        state=rod().state,
        parameter={"k": lp.Normal(0.1, std=0.03), "gain": lp.Normal(1.0, std=0.1)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    shown = lp.observation.Calibrated(base, lambda y, q, x: q.gain * y, noise=0.005)
    one = lp.Identifier(model, lp.Combined([shown]), lp.SensitivityLaw(), u0=0.0)
    assert "position[T_2]" in one.model.parameter_space.labels
    lp.diagnostics.check_observation(one.observed, inputs={"left": 1.0}).raise_if_failed()


@pytest.mark.parametrize(
    ("std", "text"),
    [
        (0.0, "one positive number"),
        (float("nan"), "one positive number"),
        ({"T_1": 0.1, "T_2": 0.2}, "have in common"),
        ({"T_9": 0.1}, "no sensor is called 'T_9'"),
    ],
)
def test_a_deviation_that_makes_no_sense(std, text):
    with pytest.raises(lp.errors.ObservationError, match=text):
        lp.Points(AT, position_std=std)


def test_what_does_not_go_together_is_refused():
    base = lp.Points(AT, position_std=0.1)
    with pytest.raises(lp.errors.ObservationError, match="write the function into Calibrated"):
        lp.observation.Transformed(base, lambda y: y**2)
    with pytest.raises(lp.errors.ObservationError, match="two parts have the unknown 'position'"):
        lp.Identifier(
            rod(),
            lp.Combined([base, lp.Points({"z": 0.1}, position_std=0.1)], noise=0.1),
            lp.SensitivityLaw(),
        )
    model = rod()
    with pytest.raises(lp.errors.ObservationError, match="no unknown 'position"):
        observe(model, base)


LEFT = '[boundary]\nleft = "30 degC"'
CASE = f"""{ROD_CASE.replace("[boundary]", LEFT)}
shadows = false
[channels]
T = {{{{ role = "sensor", column = "T", {{place}}, unit = "degC", noise = "0.1 K" }}}}
"""


def case(folder, place: str):
    rows = [f"{300 * k},{20 + 0.1 * k}" for k in range(5)]
    (folder / "rows.csv").write_text("\n".join(["t,T", *rows, ""]))
    (folder / "case.toml").write_text(CASE.format(place=place))
    return cases.load(folder / "case.toml")


@pytest.mark.slow
def test_a_case_states_it(tmp_path):
    prepared = case(tmp_path, 'at = "30 cm", at_std = "1 cm"').prepare()
    unknown = prepared.case.model.parameter_space.unknowns["position"]
    assert (list(unknown.names), unknown.prior.std, unknown.unit) == (
        ["T"],
        pytest.approx(0.01),
        "m",
    )
    identifier = prepared.identifier
    assert "position[T]_std" in identifier.run(prepared.stream).to_xarray()
    _, factor = identifier.latent_belief().q_factor
    assert 0.0 < np.linalg.norm(factor) < 0.01


def test_at_std_belongs_to_a_position(tmp_path):
    with pytest.raises(lp.errors.CaseError, match="at_std requires at"):
        case(tmp_path, 'over = "left", at_std = "1 cm"')
    with pytest.raises(lp.errors.CaseError, match="at_std: got '0 cm'"):
        case(tmp_path, 'at = "30 cm", at_std = "0 cm"')
