"""Dirichlet data of vector fields: for all components, for each, for some, from the stream."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from factories import observe
from skfem import ElementQuad1, ElementQuad2, ElementTriRT1, ElementVector, MeshTri

import livepde as lp
from livepde.fem import START, Inputs, Moment
from livepde.stepping import ForwardStage

MESH = lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4))
ELEMENTS = {"Q1": ElementVector(ElementQuad1()), "Q2": ElementVector(ElementQuad2())}


def stress(q: Any, u: Any, v: Any, x: Any) -> Any:
    """Linear elasticity with an unknown shear modulus, lambda = 1."""
    grad, test = lp.grad(u), lp.grad(v)
    e = 0.5 * (grad + np.swapaxes(grad, 0, 1))
    divergence = grad[0, 0] + grad[1, 1]
    return 2.0 * q.mu * lp.fem.ddot(e, test) + divergence * (test[0, 0] + test[1, 1])


def elastic(dirichlet: Any, element: Any = ELEMENTS["Q1"]) -> lp.Model:
    return lp.Model(
        lp.Field(MESH, element, dirichlet=dirichlet), {"mu": lp.Normal(1.0, 0.5)}, stress
    )


def imposed(dirichlet: Any, moment: Any = START, element: Any = ELEMENTS["Q1"]) -> Any:
    """Return values at the vertices, (2, vertices), of a field that is NaN where it is free."""
    model = elastic(dirichlet, element)
    block = model.state_block
    u = model.impose(np.full(model.X.dim, np.nan), moment)
    return u[block.dofs.nodal_dofs]


LEFT, RIGHT = (np.flatnonzero(MESH.p[0] == x) for x in (0.0, 1.0))
Y = MESH.p[1]


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (2.0, (2.0 + 0 * Y, 2.0 + 0 * Y)),
        ((1.0, -2.0), (1.0 + 0 * Y, -2.0 + 0 * Y)),
        (np.array([1.0, -2.0]), (1.0 + 0 * Y, -2.0 + 0 * Y)),
        (lambda x, t: t * x[1], (3.0 * Y, 3.0 * Y)),
        (lambda x, t: (t * x[1], 5.0), (3.0 * Y, 5.0 + 0 * Y)),
        (lambda x, t: np.array([t * x[1], 1.0 + x[1]]), (3.0 * Y, 1.0 + Y)),
        ((lambda x, t: t * x[1], 4.0), (3.0 * Y, 4.0 + 0 * Y)),
        (lp.Channel("push"), (7.0 + 0 * Y, 7.0 + 0 * Y)),
        ((0.0, lp.Channel("push")), (0.0 * Y, 7.0 + 0 * Y)),
        ((None, 4.0), (np.nan * Y, 4.0 + 0 * Y)),
    ],
)
def test_each_component_gets_its_value(element: str, value: Any, expected: Any):
    found = imposed({"left": value}, Moment(3.0, Inputs({"push": 7.0})), ELEMENTS[element])
    for row, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(row[LEFT], wanted[LEFT])
        assert np.isnan(np.delete(row, LEFT)).all()


def test_channels_of_components_are_inputs_of_the_model():
    model = elastic({"left": (lp.Channel("a"), 0.0), "right": (None, lp.Channel("b"))})
    assert model.channels == ("a", "b")
    assert not model.homogeneous
    assert elastic({"left": (0.0, None)}).homogeneous
    lp.diagnostics.check_model(model, u=0.1, inputs={"a": 0.1, "b": 0.0}).raise_if_failed()


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_linear_displacement_is_exact(element: str):
    """It is in equilibrium and in the space: what the boundary says holds inside, too."""

    def exact(x: Any, t: float) -> Any:
        return 0.3 * x[0] - 0.1 * x[1], 0.2 * x[0] + 0.4 * x[1]

    model = elastic({"boundary": exact}, ELEMENTS[element])
    forward, u = ForwardStage(model), model.initial(0.0)
    for k in range(40):
        u = forward.solve(u, np.array([1.0]), 1.0, Moment(k + 1.0))
    points = np.array([[0.2, 0.55, 0.9], [0.7, 0.35, 0.1]])
    values = (model.state_block.probe(points) @ u).reshape(2, -1)
    np.testing.assert_allclose(values, exact(points, 0.0), atol=1e-9)


@pytest.mark.slow
def test_a_modulus_is_identified_from_a_boundary_that_moves():
    """Rollers on the left and below, a channel that pulls the right side, sensors on the top."""
    pulled = {"left": (0.0, None), "bottom": (None, 0.0), "right": (lp.Channel("pull"), None)}
    model, true = elastic(pulled), 1.6
    at, axes = np.repeat([[0.3, 0.9], [0.7, 0.9]], 2, axis=0), [0, 1, 0, 1]  # both components
    points = lp.Points(at, noise=1e-4, component=axes)
    observed = observe(model, points)
    forward, u, rng = ForwardStage(model), model.initial(0.0, Moment(0.0, Inputs({"pull": 0.0}))), 0
    law, scheme = lp.SensitivityLaw(), lp.ImplicitEuler()  # one stage of which makes the truth
    identifier = lp.Identifier(model, points, law, u0=0.0, scheme=scheme)
    noise = np.random.default_rng(rng)
    estimate = None
    for k in range(60):
        t = 0.1 * (k + 1)
        pull = 0.1 * np.sin(t)
        inputs = Inputs({"pull": pull})
        u = forward.solve(u, np.array([true]), 0.1, Moment(t, inputs))
        z = observed.G @ u
        z = z + 1e-4 * noise.standard_normal(len(z))
        estimate = identifier.step(t, z, {"pull": pull})
    assert estimate is not None
    mu, std = estimate.parameters["mu"]
    assert abs(mu - true) < 4.0 * std < 0.2


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((1.0, 2.0, 3.0), "'left' has 3 values; expected 2, one for each component"),
        (lambda x, t: (1.0, 2.0, 3.0), r"'left': g\(x, t\) has 3 components; expected 2"),
    ],
)
def test_a_wrong_number_of_components_is_one_sentence(value: Any, message: str):
    with pytest.raises(lp.errors.SpaceError, match=message):
        imposed({"left": value})


def test_fields_without_components_say_so():
    scalar = lp.Field(MESH, ElementQuad1(), dirichlet={"left": (1.0, 2.0)})
    with pytest.raises(lp.errors.SpaceError, match=r"a value for each component, .* not a vector"):
        lp.Model(scalar, lp.Normal(), lambda q, u, v, x: q * u * v)
    mesh = MeshTri().refined(1)
    normal = lp.Field(mesh, ElementTriRT1(), dirichlet={"boundary": lambda x, t: (1.0, x[1])})
    with pytest.raises(lp.errors.SpaceError, match="the field has no components: give a number"):
        lp.Model(normal, lp.Normal(), lambda q, u, v, x: q * lp.dot(u, v))


def test_an_unknown_component_is_refused():
    with pytest.raises(lp.errors.SpaceError, match="the value on 'left' is unknown"):
        elastic({"left": (0.0, lp.Normal())})
