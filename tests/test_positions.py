"""Point sensors: uncertain positions, components of vectors."""

from pathlib import Path

import numpy as np
import pytest
from factories import ROD_CASE, observe
from skfem import ElementLineP1, ElementQuad1, ElementQuad2, ElementVector, MeshTri

import livepde as lp
from livepde import cases
from livepde.errors import CaseError, ObservationError
from livepde.models import heat

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
        belief = one._latent_belief()
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
    assert one.model.parameter_space.labels.keys() == {"k", *(f"position[{name}]" for name in AT)}
    assert inside >= 9
    assert shifts_inside >= 26


def test_a_shift_moves_the_reading_along_the_state():
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


@pytest.mark.parametrize("shift", [-0.2, -0.03, 0.15, 0.28])
def test_a_far_shift_reads_the_state_where_the_sensor_is(shift):
    """Of a profile that no quadratic follows; a found shift of half a deviation biased others."""
    points = lp.Points({"T": 0.5}, position_std=0.1, noise=0.1)
    observed = observe(rod().with_unknowns(points.unknowns), points)
    u = observed.state.interpolate(lambda x: np.tanh(8.0 * (x[0] - 0.4)))
    q, there = np.array([0.1, shift]), np.tanh(8.0 * (0.1 + shift))
    assert observed.predict(u, q, None) == pytest.approx([there], abs=3e-3)
    assert observed.jacobian(u, q, None)[1][0, 1] == pytest.approx(8.0 * (1.0 - there**2), abs=0.1)


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
def test_a_constant_added_to_all_temperatures_changes_no_interval():
    """In a uniform initial state, a shift of a sensor has an effect of rounding errors alone."""
    found = []
    for level in (0.0, 20.0, 293.15):
        model = heat(
            lp.interval(0.0, 1.0, 10), lp.LogNormal(0.1, std=0.05), {"left": lp.Channel("g")}
        )
        sensors = lp.Points({"a": 0.2, "b": 0.6}, noise=0.01, position_std=0.03)
        who, rng = lp.Identifier(model, sensors, u0=level), np.random.default_rng(1)
        for t in 0.1 * np.arange(8):
            z = np.array([0.8, 0.3]) * (1.0 - np.exp(-t)) + 0.03 * rng.standard_normal(2)
            estimate = who.step(t, level + z, {"g": level + 1.0 - np.exp(-2.0 * t)})
        found.append([*estimate.parameters["alpha"], estimate.diagnostics.innovation_ratio])
    np.testing.assert_allclose(found[1:], found[:1] * 2, rtol=1e-6)


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
    with pytest.raises(ObservationError, match=text):
        lp.Points(AT, position_std=std)


def test_what_does_not_go_together_is_refused():
    base = lp.Points(AT, position_std=0.1)
    with pytest.raises(ObservationError, match="write the function into Calibrated"):
        lp.observation.Transformed(base, lambda y: y**2)
    with pytest.raises(ObservationError, match="two parts have the unknown 'position'"):
        lp.Identifier(
            rod(),
            lp.Combined([base, lp.Points({"z": 0.1}, position_std=0.1)], noise=0.1),
            lp.SensitivityLaw(),
        )
    model = rod()
    with pytest.raises(ObservationError, match="no unknown 'position"):
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
    _, factor = identifier._latent_belief().q_factor
    assert 0.0 < np.linalg.norm(factor) < 0.01


def test_at_std_belongs_to_a_position(tmp_path):
    with pytest.raises(CaseError, match="at_std requires at"):
        case(tmp_path, 'over = "left", at_std = "1 cm"')
    with pytest.raises(CaseError, match="at_std: got '0 cm'"):
        case(tmp_path, 'at = "30 cm", at_std = "0 cm"')


MESH = lp.rectangle((0.0, 1.0), (0.0, 1.0), (5, 5))
PI = np.pi
K = 0.05


def diffusing(**dirichlet: float) -> lp.Model:
    """Return the diffusion of both components of a vector."""
    return lp.Model(
        lp.Field(MESH, ElementVector(ElementQuad2()), dirichlet=dirichlet),
        {"k": lp.LogNormal(0.03, std=0.015)},
        A=lambda q, u, v, x: q.k * lp.fem.ddot(lp.grad(u), lp.grad(v)),
    )


def exact(x, t: float = 0.0):
    """Return the solution: two eigenfunctions of the Laplacian, which decay separately."""
    first = np.exp(-2.0 * PI**2 * K * t) * np.sin(PI * x[0]) * np.sin(PI * x[1])
    second = np.exp(-5.0 * PI**2 * K * t) * np.sin(PI * x[0]) * np.sin(2.0 * PI * x[1])
    return np.stack([first, second])


def test_each_sensor_has_one_reading_of_its_component():
    model = diffusing()
    at = {"a": (0.3, 0.45), "b": (0.3, 0.45), "c": (0.71, 0.2)}
    u = model.state_space.interpolate(lambda x: np.stack([x[0] * x[1], x[1] ** 2 - x[0]]))
    for component, expected in (
        (0, [0.3 * 0.45, 0.3 * 0.45, 0.71 * 0.2]),
        (1, [0.45**2 - 0.3, 0.45**2 - 0.3, 0.2**2 - 0.71]),
        ([0, 1, 1], [0.3 * 0.45, 0.45**2 - 0.3, 0.2**2 - 0.71]),
    ):
        named = observe(model, lp.Points(at, component=component))
        assert named.names == ("a", "b", "c")
        np.testing.assert_allclose(named.G @ u, expected, atol=1e-14)
        listed = observe(model, lp.Points(list(at.values()), component=component))
        np.testing.assert_allclose(listed.G @ u, expected, atol=1e-14)


@pytest.mark.parametrize("law", [lp.SensitivityLaw(), lp.SensitivityLaw(refit=None)])
def test_an_unknown_is_found_from_components(law):
    at, component = {"x": (0.3, 0.4), "y": (0.3, 0.3)}, [0, 1]
    sensors = lp.Points(at, component=component, noise=1e-3)
    who = lp.Identifier(diffusing(boundary=0.0), sensors, law, u0=exact)
    stream = []
    for t in np.linspace(0.05, 1.0, 20):
        z = {name: exact(p, t)[c] for (name, p), c in zip(at.items(), component, strict=True)}
        stream.append((t, z))
    result = who.run(stream)
    value, std = result.last.parameters["k"]
    assert abs(value - K) < 0.005 * K
    assert std < 0.01 * K
    assert result.verdict.level == "trusted"
    assert list(result.to_xarray().sensor.values) == ["x", "y"]


def test_a_position_of_a_component_may_be_uncertain():
    """The state is x: a sensor that is said to be at 0.3 and is 0.1 farther reads 0.4."""
    at = {"a": (0.3, 0.5), "b": (0.6, 0.5)}
    sensors = lp.Points(at, component=[1, 0], position_std={"a": 0.1}, noise=1e-4)
    model = diffusing().with_unknowns(sensors.unknowns)
    observed = observe(model, sensors)
    u = model.state_space.interpolate(lambda x: np.stack([0.0 * x[0] + 7.0, x[0]]))
    q = model.parameter_space.interpolate({"k": 1.0, "position": [0.1, 0.0]})
    np.testing.assert_allclose(observed.predict(u, q, lp.fem.Moment(0.0)), [0.4, 7.0], atol=1e-12)


@pytest.mark.parametrize(
    ("sensors", "named"),
    [
        (lp.Points({"a": (0.5, 0.5)}), "vector of 2 components.*name the measured one"),
        (lp.Points([(0.5, 0.5)], component=2), "no component 2: the state has 2"),
        (lp.observation.Averages({"a": lambda x: x[0] < 0.5}), "Averages requires a state that"),
        (lp.observation.LineIntegrals({"a": ((0.1, 0.1), (0.2, 0.2))}), "LineIntegrals requires"),
        (lp.observation.Moving({"a": ("x", "y")}), "Moving requires a state that is one number"),
    ],
)
def test_sensors_that_do_not_fit_a_vector_are_refused(sensors, named):
    with pytest.raises(ObservationError, match=named):
        observe(diffusing(), sensors)


@pytest.mark.parametrize("component", [-1, 0.5, "x", [0], [0, 1, 1], True])
def test_components_are_numbers_from_zero(component):
    with pytest.raises(ObservationError, match="component must be the number"):
        lp.Points({"a": (0.5, 0.5), "b": (0.2, 0.5)}, component=component)


def test_a_component_of_a_number_is_refused():
    with pytest.raises(ObservationError, match="component = 0 requires a state that is"):
        observe(rod(), lp.Points([0.5], component=0))


VECTOR_CASE = """
equation = "own.py:build"
initial = 0.0
mesh = { x = [0, 1], y = [0, 1], cells = [4, 4] }
data = { file = "data.csv", time = "t" }
unknowns.k = { prior = 0.03, std = 0.015 }
law = { kind = "sensitivity", noise = 0.1 }
channels.a = { role = "sensor", column = "a", at = [0.3, 0.4], component = 1 }
channels.b = { role = "sensor", column = "b", at = [0.3, 0.4], component = 0 }
"""
OWN = """
from skfem import ElementQuad2, ElementVector
import livepde as lp
from livepde.models import heat

def build(mesh, unknowns, dirichlet):
    state = lp.Field(mesh, ElementVector(ElementQuad2()), dirichlet={"boundary": 0.0})
    A = lambda q, u, v, x: q.k * lp.fem.ddot(lp.grad(u), lp.grad(v))
    return lp.Model(state, unknowns, A=A)
"""


def own_case(folder: Path, text: str = VECTOR_CASE) -> cases.Case:
    (folder / "own.py").write_text(OWN)
    (folder / "data.csv").write_text("t,a,b\n0.0,0.0,0.0\n0.1,0.0,0.0\n")
    (folder / "case.toml").write_text(text)
    return cases.load(folder / "case.toml", allow_code=True)


def test_channels_of_a_case_name_their_component(tmp_path: Path):
    observed = own_case(tmp_path).prepare().identifier.observed
    u = observed.state.interpolate(lambda x: np.stack([x[0] + 0.0, x[1] + 0.0]))
    assert observed.names == ("a", "b")
    np.testing.assert_allclose(observed.G @ u, [0.4, 0.3], atol=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (", component = 0", "", "channels.b.component is missing: the component of the vector"),
        ("component = 0", "component = -1", "channels.b.component: got -1"),
        ("at = [0.3, 0.4], component = 0", 'over = "left", component = 0', "component requires"),
    ],
)
def test_components_of_a_case_that_are_refused(tmp_path: Path, old: str, new: str, named: str):
    with pytest.raises(CaseError) as error:
        own_case(tmp_path, VECTOR_CASE.replace(old, new))
    assert named in str(error.value)


def test_a_case_without_components_says_so_when_it_is_prepared(tmp_path: Path):
    case = own_case(
        tmp_path, VECTOR_CASE.replace(", component = 0", "").replace(", component = 1", "")
    )
    with pytest.raises(ObservationError, match="name the measured one"):
        case.prepare()


def test_a_position_that_has_no_room_along_an_axis_keeps_its_prior_there():
    """At the top of a disc there is no room to either side."""
    mesh = MeshTri.init_circle(2)
    at = tuple(mesh.p[:, np.argmax(mesh.p[1])].tolist())
    points = lp.Points({"top": at, "mid": (0.3, 0.2)}, noise=0.01, position_std=0.02)
    found = lp.Identifier(heat(mesh, lp.LogNormal(0.1, std=0.05)), points, u0=lambda x: x[0] + x[1])
    for t in (0.1, 0.2):
        estimate = found.step(t, {"top": 0.9, "mid": 0.4})
    assert estimate.parameters["position[top.x]"] == pytest.approx((0.0, 0.02))
