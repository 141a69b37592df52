"""Periodic fields: nothing is lost at the seam, and nothing shows where it is."""

import numpy as np
import pytest
from skfem import (
    ElementLineHermite,
    ElementLineP0,
    ElementLineP1,
    ElementLineP2,
    ElementQuad1,
    ElementQuad2,
    ElementQuadBFS,
    ElementTriMorley,
    ElementTriP1,
    ElementTriP2,
    MeshTri,
)

import livepde as lp
from livepde.fem import FunctionSpace
from livepde.stepping import Advance, Alexander2, simulate

RING = (("left", "right"),)
TORUS = (("left", "right"), ("bottom", "top"))
LINES = [ElementLineP1, ElementLineP2, ElementLineHermite]


def ring(element, cells=24, **options):
    return lp.Field(lp.interval(0.0, 1.0, cells), element, periodic=RING, **options)


def square(element, kind="quad"):
    mesh = lp.rectangle((0.0, 1.0), (0.0, 2.0), (6, 5))
    if kind == "tri":
        mesh = MeshTri.init_tensor(np.linspace(0, 1, 7), np.linspace(0, 2, 6))
        mesh = mesh.with_boundaries(
            {
                "left": lambda x: np.isclose(x[0], 0),
                "right": lambda x: np.isclose(x[0], 1),
                "bottom": lambda x: np.isclose(x[1], 0),
                "top": lambda x: np.isclose(x[1], 2),
            }
        )
    return lp.Field(mesh, element, periodic=TORUS)


def advection(field, speed=1.0):
    return lp.Model(
        field, {"b": lp.Normal(speed, 1.0)}, A=lambda q, u, v, x: q.b * lp.grad(u)[0] * v
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "size"),
    [
        (ring(ElementLineP1()), 24),
        (ring(ElementLineP2()), 48),
        (ring(ElementLineHermite()), 48),
        (square(ElementQuad1()), 30),
        (square(ElementQuad2()), 120),
        (square(ElementQuadBFS()), 120),
        (square(ElementTriP1(), "tri"), 30),
        (square(ElementTriP2(), "tri"), 120),
    ],
    ids=lambda value: str(value) if isinstance(value, int) else "",
)
def test_both_sides_are_one(field, size):
    space = FunctionSpace.of(field, "u")
    block, _ = space.component()
    assert block.size == size == block.doflocs.shape[1]
    assert not len(block.fixed)
    wave = (
        (lambda x: np.sin(2 * np.pi * x[0]))
        if len(field.mesh.p) == 1
        else (lambda x: np.sin(2 * np.pi * x[0]) * np.cos(np.pi * x[1]))
    )
    u = space.interpolate(wave)
    ends = np.array([[0.0, 1.0]]) if len(field.mesh.p) == 1 else np.array([[0.0, 1.0], [0.7, 0.7]])
    left, right = space.probe(ends) @ u
    assert left == pytest.approx(right, abs=1e-11)  # BFS inverts a matrix
    assert np.abs(block.at_vertices @ u - wave(field.mesh.p)).max() < 0.3
    assert np.allclose(block.at_vertices @ space.interpolate(3.0), 3.0)


@pytest.mark.parametrize("element", LINES)
def test_translation_by_a_cell_commutes_with_the_operators(element):
    """A shifted function has the shifted image: the seam is like every other vertex."""
    model = lp.Model(
        ring(element()),
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
        B=lambda u, v, x: lp.grad(u)[0] * v,
    )
    f = lambda x: np.exp(np.sin(2 * np.pi * x[0]) + np.cos(4 * np.pi * x[0]))  # noqa: E731
    x, h = np.linspace(0.0, 0.9, 37), 1 / 24
    u, shifted = model.initial(f), model.initial(lambda x: f(x - h))
    one = np.ones(1)
    for image in (
        lambda u: model.X.riesz(model.B(u)),
        lambda u: model.X.riesz(model.A(u).matrix @ one),
    ):
        a = model.state_space.probe(x[None] + h) @ image(shifted)
        b = model.state_space.probe(x[None]) @ image(u)
        assert np.abs(a - b).max() < 1e-8 * np.abs(b).max()


@pytest.mark.parametrize("element", LINES)
def test_a_wave_once_around(element):
    model = advection(ring(element(), 40))
    f = lambda x: 1.0 + np.sin(2 * np.pi * x[0])  # noqa: E731
    control = Advance(Alexander2(), 0.01)
    mass = model.mass @ model.initial(1.0)
    run = [u for _, u in simulate(model, np.ones(1), f, [0.0, 0.25, 0.5, 1.0], control)]
    assert np.allclose([mass @ u for u in run], 1.0, atol=1e-11)
    assert model.X.norm(run[-1] - run[0]) < 0.01
    assert model.X.norm(run[2] - model.initial(lambda x: f(x + 0.5))) < 0.01


@pytest.mark.slow
def test_the_speed_of_a_wave_is_found():
    model = advection(ring(ElementLineHermite()), speed=0.7)
    sensors = lp.Points([0.2, 0.5], noise=0.01)
    truth = [
        (t, [np.sin(2 * np.pi * (x - t)) for x in (0.2, 0.5)]) for t in np.arange(0.0, 1.51, 0.02)
    ]
    law = lp.SensitivityLaw()
    start = lambda x: np.sin(2 * np.pi * x[0])  # noqa: E731
    ident = lp.Identifier(model, sensors, law, u0=start, scheme=Alexander2())
    for t, z in truth:
        last = ident.step(t, z)
    assert last.parameters["b"][0] == pytest.approx(1.0, abs=5e-3)


def test_a_periodic_parameter_and_the_observation_of_all():
    field = ring(ElementLineP1(), inner="H1", prior=lp.Normal(1.0))
    state = lp.Field(field.mesh, ElementLineP2(), periodic=RING)
    model = lp.Model(state, field, A=lambda q, u, v, x: q * u * v)
    assert model.Q.dim == 24
    lp.diagnostics.check_model(model).raise_if_failed()
    lp.diagnostics.check_observation(lp.Full(noise=0.1), model).raise_if_failed()
    lp.diagnostics.check_observation(
        lp.Averages({"a": lambda x: x[0] < 0.1}, noise=0.1), model
    ).raise_if_failed()


def test_clear_errors():
    with pytest.raises(lp.errors.SpaceError, match="no boundary 'top'"):
        lp.Field(lp.interval(0, 1, 4), ElementLineP1(), periodic=(("left", "top"),))
    with pytest.raises(lp.errors.SpaceError, match="'left' is periodic and has a Dirichlet value"):
        ring(ElementLineP1(), dirichlet={"left": 0.0})
    with pytest.raises(lp.errors.SpaceError, match="ElementLineP0 has no coefficients there"):
        FunctionSpace.of(ring(ElementLineP0()), "u").dim  # noqa: B018
    with pytest.raises(lp.errors.SpaceError, match="normal derivatives"):
        FunctionSpace.of(square(ElementTriMorley(), "tri"), "u").dim  # noqa: B018
    uneven = lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4))
    p = uneven.p.copy()
    p[1, (p[0] == 1.0) & (p[1] == 0.5)] = 0.55
    uneven = type(uneven)(p, uneven.t).with_boundaries(uneven.boundaries)
    with pytest.raises(lp.errors.SpaceError, match=r"do not match.*0\.0[345]"):
        FunctionSpace.of(lp.Field(uneven, ElementQuad1(), periodic=RING), "u").dim  # noqa: B018
    pair, mesh = (("bottom", "left"),), lp.rectangle((0.0, 1.0), (0.0, 2.0), (6, 5))
    with pytest.raises(lp.errors.SpaceError, match="have 7 and 6 coefficients"):
        FunctionSpace.of(lp.Field(mesh, ElementQuad1(), periodic=pair), "u").dim  # noqa: B018
