"""Point sensors of a state that is a vector: each measures one component."""

from pathlib import Path

import numpy as np
import pytest
from skfem import ElementQuad2, ElementVector

import livepde as lp
from livepde import cases

MESH = lp.rectangle((0.0, 1.0), (0.0, 1.0), (5, 5))
PI = np.pi
K = 0.05


def diffusing(start: float = 0.03) -> lp.Model:
    """Return the diffusion of both components of a vector that is zero on the boundary."""
    return lp.Model(
        lp.Field(MESH, ElementVector(ElementQuad2()), dirichlet={"boundary": 0.0}),
        {"k": lp.LogNormal(start, std=0.5 * start)},
        A=lambda q, u, v, x: q.k * lp.fem.ddot(lp.grad(u), lp.grad(v)),
    )


def exact(x, t: float = 0.0):
    """Return the solution: two eigenfunctions of the Laplacian, which decay separately."""
    first = np.exp(-2.0 * PI**2 * K * t) * np.sin(PI * x[0]) * np.sin(PI * x[1])
    second = np.exp(-5.0 * PI**2 * K * t) * np.sin(PI * x[0]) * np.sin(2.0 * PI * x[1])
    return np.stack([first, second])


def bound(sensors: lp.Points, model: lp.Model):
    return sensors.bind(model.state_space, model.X, model.parameter_space)


def test_each_sensor_has_one_reading_of_its_component():
    model = diffusing()
    at = {"a": (0.3, 0.45), "b": (0.3, 0.45), "c": (0.71, 0.2)}
    u = model.state_space.interpolate(lambda x: np.stack([x[0] * x[1], x[1] ** 2 - x[0]]))
    for component, expected in (
        (0, [0.3 * 0.45, 0.3 * 0.45, 0.71 * 0.2]),
        (1, [0.45**2 - 0.3, 0.45**2 - 0.3, 0.2**2 - 0.71]),
        ([0, 1, 1], [0.3 * 0.45, 0.45**2 - 0.3, 0.2**2 - 0.71]),
    ):
        named = bound(lp.Points(at, component=component), model)
        assert named.names == ("a", "b", "c")
        np.testing.assert_allclose(named.G @ u, expected, atol=1e-14)
        listed = bound(lp.Points(list(at.values()), component=component), model)
        np.testing.assert_allclose(listed.G @ u, expected, atol=1e-14)


@pytest.mark.parametrize("law", [lp.SensitivityLaw(), lp.SensitivityLaw(refit=None)])
def test_an_unknown_is_found_from_components(law):
    at, component = {"x": (0.3, 0.4), "y": (0.3, 0.3)}, [0, 1]
    sensors = lp.Points(at, component=component, noise=1e-3)
    who = lp.Identifier(diffusing(), sensors, law, u0=exact)
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
    model = lp.Model(
        lp.Field(MESH, ElementVector(ElementQuad2())),
        {"k": lp.Normal(1.0, std=0.1)},
        A=lambda q, u, v, x: q.k * lp.fem.ddot(lp.grad(u), lp.grad(v)),
    )
    sensors = lp.Points(
        {"a": (0.3, 0.5), "b": (0.6, 0.5)},
        component=[1, 0],
        position_std={"a": 0.1},
        noise=1e-4,
    )
    model = model.with_unknowns(sensors.unknowns)
    observed = bound(sensors, model)
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
    with pytest.raises(lp.errors.ObservationError, match=named):
        bound(sensors, diffusing())


@pytest.mark.parametrize("component", [-1, 0.5, "x", [0], [0, 1, 1], True])
def test_components_are_numbers_from_zero(component):
    with pytest.raises(lp.errors.ObservationError, match="component must be the number"):
        lp.Points({"a": (0.5, 0.5), "b": (0.2, 0.5)}, component=component)


def test_a_component_of_a_number_is_refused():
    model = lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 4), lp.fem.linear(lp.interval(0.0, 1.0, 4))),
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * u * v,
    )
    with pytest.raises(lp.errors.ObservationError, match="component = 0 requires a state that is"):
        bound(lp.Points([0.5], component=0), model)


CASE = """
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

def build(mesh, unknowns, dirichlet):
    state = lp.Field(mesh, ElementVector(ElementQuad2()), dirichlet={"boundary": 0.0})
    A = lambda q, u, v, x: q.k * lp.fem.ddot(lp.grad(u), lp.grad(v))
    return lp.Model(state, unknowns, A=A)
"""


def own_case(folder: Path, text: str = CASE) -> cases.Case:
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
    with pytest.raises(lp.errors.CaseError) as error:
        own_case(tmp_path, CASE.replace(old, new))
    assert named in str(error.value)


def test_a_case_without_components_says_so_when_it_is_prepared(tmp_path: Path):
    case = own_case(tmp_path, CASE.replace(", component = 0", "").replace(", component = 1", ""))
    with pytest.raises(lp.errors.ObservationError, match="name the measured one"):
        case.prepare()
