"""Mesh files, periodic boundaries, and boundary values of vectors."""

from typing import Any

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
    ElementTriRT1,
    ElementVector,
    MeshQuad,
    MeshTri,
)

import livepde as lp
from livepde.errors import SpaceError
from livepde.fem import START, FunctionSpace, Inputs, Moment, box, grid, linear
from livepde.stepping import Advance, Alexander2, ForwardStage, simulate

meshio = pytest.importorskip("meshio")

SQUARE_2 = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
4
1 1 "inlet"
1 2 "wall"
2 3 "sand"
2 4 "clay"
$EndPhysicalNames
$Nodes
7
1 0 0 0
2 1000 0 0
3 2000 0 0
4 0 1000 0
5 1000 1000 0
6 2000 1000 0
7 500 5000 0
$EndNodes
$Elements
6
1 1 2 1 1 1 4
2 1 2 2 2 3 6
3 2 2 3 3 1 2 5
4 2 2 3 3 1 5 4
5 2 2 4 4 2 3 6
6 2 2 4 4 2 6 5
$EndElements
"""

SQUARE_4 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
1 1 "inlet"
2 2 "sand"
$EndPhysicalNames
$Entities
0 1 1 0
1 0 0 0 0 1 0 1 1 0
1 0 0 0 1 1 0 1 2 0
$EndEntities
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
2 3 1 3
1 1 1 1
1 1 4
2 1 2 2
2 1 2 3
3 1 3 4
$EndElements
"""


def named(tmp_path, suffix, **options):
    """Write two squares with groups in a format other than Gmsh's."""
    points = np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]], dtype=float)
    cells = [("line", [[0, 3], [2, 5]]), ("triangle", [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])]
    mesh = meshio.Mesh(points, cells, **options)
    path = tmp_path / f"squares{suffix}"
    mesh.write(path)
    return path


@pytest.fixture
def gmsh(tmp_path):
    path = tmp_path / "squares.msh"
    path.write_text(SQUARE_2)
    return path


def area(mesh, name=None):
    model = lp.Model(
        lp.Field(mesh, linear(mesh)),
        lp.Normal(),
        A=lambda q, u, v, x: q * u * v,
        f=lp.On(name, lambda x, t: 1.0) if name else lambda x, t: 1.0,
    )
    return model.F().sum()


def test_groups_of_a_gmsh_file_are_kept(gmsh, capsys):
    mesh = lp.read_mesh(gmsh, scale=1e-3)
    assert isinstance(mesh, MeshTri)
    assert set(mesh.boundaries) == {"inlet", "wall"}
    assert set(mesh.subdomains) == {"sand", "clay"}
    assert mesh.p.max() == 2.0  # nodes without a cell are removed
    assert [area(mesh, name) for name in (None, "sand", "inlet")] == pytest.approx([2.0, 1.0, 1.0])
    assert np.allclose(mesh.p[0, mesh.facets[:, mesh.boundaries["inlet"]]], 0.0)
    assert np.allclose(mesh.p[0, mesh.facets[:, mesh.boundaries["wall"]]], 2.0)
    assert capsys.readouterr().out == capsys.readouterr().err == ""


def test_groups_of_the_newer_gmsh_format(tmp_path):
    path = tmp_path / "square.msh"
    path.write_text(SQUARE_4)
    mesh = lp.read_mesh(path)
    assert set(mesh.boundaries) == {"inlet"}
    assert set(mesh.subdomains) == {"sand"}
    assert [area(mesh, name) for name in ("sand", "inlet")] == pytest.approx([1.0, 1.0])


def test_a_model_on_a_file(gmsh):
    mesh = lp.read_mesh(gmsh, scale=1e-3)
    model = lp.Model(
        lp.Field(mesh, ElementTriP1(), dirichlet={"inlet": 1.0}),
        {"k": lp.Piecewise({"upper": "sand", "lower": "clay"}, lp.Normal(1.0))},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        B=lp.On("wall", lambda u, v, x: u * v),
    )
    lp.diagnostics.check_model(model).raise_if_failed()
    assert len(model.X.fixed) == 2


def test_other_formats(tmp_path):
    mesh = lp.read_mesh(named(tmp_path, ".vtk"))
    assert area(mesh) == pytest.approx(2.0)
    sets = {"left": [[0], []], "sand": [[], [0, 1]]}
    mesh = lp.read_mesh(named(tmp_path, ".inp", cell_sets=sets))
    assert area(mesh, "sand") == pytest.approx(1.0)


BENT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1.0], [2, 0, 0], [2, 1, 0]])
FLAT = BENT * [1, 1, 0]


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        (BENT, [("triangle", [[0, 1, 2], [1, 2, 3]])], "dimension 2 but bend in space"),
        (FLAT, [("triangle", [[0, 1, 2]]), ("quad", [[1, 4, 5, 3]])], "several kinds"),
        (FLAT, [("vertex", [[0]])], "contains no mesh"),
    ],
)
def test_meshes_that_are_refused(tmp_path, points, cells, message):
    meshio.Mesh(points, cells).write(tmp_path / "mesh.vtk")
    with pytest.raises(SpaceError, match=message):
        lp.read_mesh(tmp_path / "mesh.vtk")


def test_mesh_errors_state_a_remedy(tmp_path, gmsh, monkeypatch):
    with pytest.raises(SpaceError, match="there is no file"):
        lp.read_mesh(tmp_path / "nothing.msh")
    with pytest.raises(SpaceError, match="scale must be a positive number; got -1"):
        lp.read_mesh(gmsh, scale=-1)
    for name in ("broken.msh", "notes.txt"):
        (tmp_path / name).write_text("hello")
        with pytest.raises(SpaceError, match="cannot be read"):
            lp.read_mesh(tmp_path / name)
    monkeypatch.setitem(__import__("sys").modules, "meshio", None)
    with pytest.raises(SpaceError, match=r"pip install 'livepde\[mesh\]'"):
        lp.read_mesh(gmsh)


def test_regions():
    lower = {"lower": lambda x: x[-1] < 0.5}
    plate = lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4), regions=lower)
    block = box((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), (2, 2, 2), regions=lower)
    assert isinstance(plate, MeshQuad)
    for mesh in (plate, block):
        assert area(mesh, "lower") == pytest.approx(0.5)
        assert area(mesh, "top") == pytest.approx(1.0)


def test_the_size_of_cells():
    """x.h is the cell size on cells and subdomains, and of the adjacent cell on a boundary."""
    mesh = lp.interval(1.0, 16.0, 4, geometric=True, regions={"far": lambda x: x[0] > 8.0})
    field = lp.Field(mesh, ElementLineP1())
    for where, expected in ((None, 1 + 4 + 16 + 64), ("far", 64), ("left", 1.0), ("right", 8.0)):
        density = lambda x, t: x.h  # noqa: E731
        f = lp.On(where, density) if where else density
        model = lp.Model(field, lp.Normal(), A=lambda q, u, v, x: q * u * v, f=f)
        assert model.F().sum() == pytest.approx(expected)
    plate = lp.rectangle((0.0, 4.0), (0.0, 3.0), (1, 1))
    model = lp.Model(
        lp.Field(plate, linear(plate)),
        lp.Normal(),
        A=lambda q, u, v, x: q * u * v / x.h,
        f=lambda x, t: x.h,
    )
    assert model.F().sum() == pytest.approx(5.0 * 12.0)
    with pytest.raises(AttributeError, match=r"x\.h exists where"):
        _ = lp.fem.Place(np.zeros((0,)), None, lp.fem.Moment()).h


def counted(mesh):
    """Return the number of facets of each boundary."""
    return {name: len(facets) for name, facets in mesh.boundaries.items()}


@pytest.mark.parametrize(("start", "length"), [(5e5, 4.0), (-3e6, 1.0), (0.0, 1e-8), (1e3, 1e-3)])
def test_sides_are_the_same_wherever_the_mesh_is_and_however_large(start: float, length: float):
    x, y, z = (start, start + length), (-start, -start + length), (start, start + 2 * length)
    assert counted(lp.interval(*x, 20)) == {"left": 1, "right": 1}
    sheet = counted(lp.rectangle(x, y, (20, 5)))
    assert sheet == {"left": 5, "right": 5, "bottom": 20, "top": 20}
    faces = {"left": 24, "right": 24, "front": 16, "back": 16, "bottom": 12, "top": 12}
    assert counted(lp.fem.box(x, y, z, (2, 3, 4))) == faces


@pytest.mark.slow
def test_a_penalty_imposes_an_unknown_boundary_value():
    """The penalty beta (u - q) v with beta = 100 k/h is identified from one inner sensor."""
    mesh = lp.interval(0.0, 1.0, 20)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"right": 0.0}),
        {"T0": lp.Normal(1.0, 2.0)},
        A=lp.On("left", lambda q, u, v, x: -100.0 / x.h * q.T0 * v),
        B=[
            lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("left", lambda u, v, x: 100.0 / x.h * u * v),
        ],
    )
    ident = lp.Identifier(model, lp.Points([0.5], noise=1e-3), lp.SensitivityLaw())
    for t in np.arange(0.1, 3.0, 0.1):
        last = ident.step(t, [1.5 if t > 1.0 else np.nan])
    assert last.parameters["T0"][0] == pytest.approx(3.0, rel=5e-3)


def test_a_grid_has_the_nodes_it_is_given():
    mesh = grid([-9.0, -1.0, 0.0, 2.0], [0.0, 0.5, 3.0])
    assert mesh.nelements == 6
    assert set(mesh.p[0]) == {-9.0, -1.0, 0.0, 2.0}
    assert counted(mesh) == {"left": 2, "right": 2, "bottom": 3, "top": 3}
    with pytest.raises(SpaceError, match="two increasing nodes"):
        grid([0.0, 1.0, 1.0], [0.0, 1.0])


RING = (("left", "right"),)
TORUS = (("left", "right"), ("bottom", "top"))
LINES = [ElementLineP1, ElementLineP2, ElementLineHermite]


def ring(element, cells=24, **options):
    return lp.Field(lp.interval(0.0, 1.0, cells), element, periodic=RING, **options)


def square(element, kind="quad"):
    mesh = lp.rectangle((0.0, 1.0), (0.0, 2.0), (6, 5))
    return lp.Field(mesh.to_meshtri() if kind == "tri" else mesh, element, periodic=TORUS)


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
def test_both_sides_share_their_unknowns(field, size):
    space = FunctionSpace.of(field, "u")
    block, _ = space.component()
    assert block.size == size == block.doflocs.shape[1]
    assert not len(block.fixed)
    wave = lambda x: np.sin(2 * np.pi * x[0]) * np.cos(np.pi * sum(x[1:]))  # noqa: E731
    u = space.interpolate(wave)
    ends = np.array([[0.0, 1.0], [0.7, 0.7]])[: len(field.mesh.p)]
    left, right = space.probe(ends) @ u
    assert left == pytest.approx(right, abs=1e-11)  # BFS inverts a matrix
    assert np.abs(block.at_vertices @ u - wave(field.mesh.p)).max() < 0.3
    assert np.allclose(block.at_vertices @ space.interpolate(3.0), 3.0)


@pytest.mark.parametrize("element", LINES)
def test_translation_by_a_cell_commutes_with_the_operators(element):
    """Operators map shifted functions to shifted images, so the seam is like any other vertex."""
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


def uneven():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4))
    p = mesh.p.copy()
    p[1, (p[0] == 1.0) & (p[1] == 0.5)] = 0.55
    return type(mesh)(p, mesh.t).with_boundaries(mesh.boundaries)


def sides(mesh, *pair):
    return lp.Field(mesh, lp.linear(mesh), periodic=(pair,))


@pytest.mark.parametrize(
    ("message", "build"),
    [
        ("no boundary 'top'", lambda: sides(lp.interval(0, 1, 4), "left", "top")),
        ("'left' is periodic and has", lambda: ring(ElementLineP1(), dirichlet={"left": 0.0})),
        ("ElementLineP0 has no coefficients there", lambda: ring(ElementLineP0())),
        ("normal derivatives", lambda: square(ElementTriMorley(), "tri")),
        (r"do not match.*0\.0[345]", lambda: sides(uneven(), "left", "right")),
        ("have 7 and 6 coefficients", lambda: sides(square(ElementQuad1()).mesh, "bottom", "left")),
    ],
)
def test_sides_that_do_not_match_are_refused(message, build):
    with pytest.raises(SpaceError, match=message):
        _ = FunctionSpace.of(build(), "u").dim


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
    """It is in equilibrium and in the space, so the boundary values determine the interior."""

    def exact(x: Any, t: float) -> Any:
        return 0.3 * x[0] - 0.1 * x[1], 0.2 * x[0] + 0.4 * x[1]

    model = elastic({"boundary": exact}, ELEMENTS[element])
    forward, u = ForwardStage(model), model.initial(0.0)
    for k in range(40):
        u = forward.solve(u, np.array([1.0]), 1.0, Moment(k + 1.0))
    points = np.array([[0.2, 0.55, 0.9], [0.7, 0.35, 0.1]])
    values = (model.state_block.probe(points) @ u).reshape(2, -1)
    np.testing.assert_allclose(values, exact(points, 0.0), atol=1e-9)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((1.0, 2.0, 3.0), "'left' has 3 values; expected 2, one for each component"),
        (lambda x, t: (1.0, 2.0, 3.0), r"'left': g\(x, t\) has 3 components; expected 2"),
    ],
)
def test_a_wrong_number_of_components_is_refused(value: Any, message: str):
    with pytest.raises(SpaceError, match=message):
        imposed({"left": value})


def test_fields_without_components_are_reported():
    scalar = lp.Field(MESH, ElementQuad1(), dirichlet={"left": (1.0, 2.0)})
    with pytest.raises(SpaceError, match=r"a value for each component, .* not a vector"):
        lp.Model(scalar, lp.Normal(), lambda q, u, v, x: q * u * v)
    mesh = MeshTri().refined(1)
    normal = lp.Field(mesh, ElementTriRT1(), dirichlet={"boundary": lambda x, t: (1.0, x[1])})
    with pytest.raises(SpaceError, match="the field has no components: give a number"):
        lp.Model(normal, lp.Normal(), lambda q, u, v, x: q * lp.dot(u, v))


def test_an_unknown_component_is_refused():
    with pytest.raises(SpaceError, match="the value on 'left' is unknown"):
        elastic({"left": (0.0, lp.Normal())})
