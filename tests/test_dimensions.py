"""One, two and three dimensions: orders of convergence, boundary values g(t, x), any omega."""

import json

import numpy as np
import pytest
from factories import BODIES
from skfem import ElementLineHermite, ElementQuadBFS, ElementTriP2, MeshTri

import livepde as lp
from experiments import dimensions
from livepde.fem import Moment, box, linear, quadratic, smooth
from livepde.runs import Outcome


@pytest.fixture(scope="module", params=["discrete", "analytic"])
def outcome(request) -> Outcome:
    return dimensions.dimensions(request.param)


@pytest.mark.study
def test_orders_of_convergence(outcome):
    """First order elements: 2 for u; second order: 3; Bogner-Fox-Schmit: 4 (measured 3.6)."""
    assert outcome.ok, [check for check in outcome.checks if not check.ok]
    names = {check.name for check in outcome.checks}
    assert {"order of q, 2D P1", "order of q, 2D Bogner-Fox-Schmit", "order of q, 3D P1"} <= names
    json.dumps(outcome.to_dict(), allow_nan=False)
    outcome.figures["convergence"]().canvas.draw()


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_source_belongs_to_the_exact_solution(d):
    x, t, step = np.random.default_rng(d).uniform(0.1, 0.9, (d, 7)), 0.7, 1e-4
    u = dimensions.u_true
    rate = (u(x, t + step) - u(x, t - step)) / (2 * step)
    laplace = 0.0
    for k in range(d):
        e = np.zeros((d, 1))
        e[k] = step
        laplace += (u(x + e, t) - 2 * u(x, t) + u(x - e, t)) / step**2
    expected = rate - laplace + dimensions.q_true(x) * u(x, t)
    np.testing.assert_allclose(dimensions.source(d)(x, t), expected, atol=1e-5)


def test_boundary_values_move_with_time():
    """The estimate has the values g(t, x) on the boundary, to rounding at the vertices."""
    model, sensors = dimensions.build(dimensions.SETTINGS["2D P1"], 4)
    law = lp.GradientLaw()
    identifier = lp.Identifier(model, sensors, law, u0=lambda x: dimensions.u_true(x, 0.0))
    estimate = identifier.step(0.4, np.full(identifier.observed.size, np.nan))
    edge = model.X.fixed
    x = model.state_block.basis.doflocs[:, edge]
    np.testing.assert_allclose(estimate.u[edge], dimensions.u_true(x, 0.4), atol=1e-14)
    assert np.ptp(estimate.u[edge]) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("side", ["boundary", "left", "top"])
def test_bogner_fox_schmit_on_the_boundary(side):
    """Values and slopes along the side are fixed: g of degree 3 is taken on exactly."""
    mesh = lp.rectangle((0.0, 2.0), (0.0, 1.5), (3, 4))

    def g(x, t):
        return (1 + t) * (x[0] ** 3 - x[0] * x[1] ** 2 + 2 * x[1] ** 3 - x[0] ** 3 * x[1] ** 3)

    field = lp.Field(mesh, ElementQuadBFS(), dirichlet={side: g})
    model = lp.Model(field, lp.Normal(), A=lambda q, u, v, x: q * u * v)
    u = model.impose(np.random.default_rng(0).standard_normal(model.X.dim), Moment(0.5))
    s = np.linspace(0.0, 1.0, 30)
    sides = {"left": (0 * s, 1.5 * s), "top": (2.0 * s, 0 * s + 1.5)}
    for points in map(np.array, sides.values() if side == "boundary" else [sides[side]]):
        values = model.state_block.probe(points) @ u
        np.testing.assert_allclose(values, g(points, 0.5), atol=1e-9)
    vertices = {"boundary": 14, "left": 5, "top": 4}[side]
    corners = 4 if side == "boundary" else 0  # both slopes
    assert len(model.X.fixed) == 2 * vertices + corners


@pytest.mark.slow
def test_bogner_fox_schmit_with_zero_values_and_channels():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (3, 3))
    field = lp.Field(mesh, ElementQuadBFS(), dirichlet={"left": lp.Channel("T"), "right": 1.0})
    model = lp.Model(field, lp.Normal(), A=lambda q, u, v, x: q * u * v)
    u = model.impose(np.random.default_rng(0).standard_normal(model.X.dim), Moment(0.0, {"T": 3.0}))
    s = np.linspace(0.0, 1.0, 30)
    for x, value in ((0.0, 3.0), (1.0, 1.0)):
        np.testing.assert_allclose(
            model.state_block.probe(np.array([0 * s + x, s])) @ u, value, atol=1e-12
        )


def test_meshes_and_elements():
    mesh = box((0.0, 1.0), (0.0, 2.0), (0.0, 3.0), (1, 2, 3))
    assert mesh.nvertices == 2 * 3 * 4
    for name, axis, value in (("left", 0, 0.0), ("back", 1, 2.0), ("top", 2, 3.0)):
        ends = mesh.p[axis, mesh.facets[:, mesh.boundaries[name]]]
        np.testing.assert_array_equal(ends, value)
    with pytest.raises(lp.errors.SpaceError, match="needs increasing coordinates and cells >= 1"):
        box((0.0, 1.0), (0.0, 0.0), (0.0, 1.0), (1, 1, 1))
    assert isinstance(quadratic(MeshTri()), ElementTriP2)
    for body in BODIES.values():
        assert linear(body()).maxdeg < quadratic(body()).maxdeg
    assert isinstance(smooth(lp.interval(0, 1, 3)), ElementLineHermite)
    assert isinstance(smooth(lp.rectangle((0, 1), (0, 1), (1, 1))), ElementQuadBFS)
    with pytest.raises(lp.errors.SpaceError, match=r"class C\^1 for a mesh of type MeshTri1"):
        smooth(MeshTri())
