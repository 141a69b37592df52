"""Meshes: regions, the size of cells, and files with named groups."""

import numpy as np
import pytest
from skfem import ElementLineP1, ElementTriP1, MeshQuad, MeshTri

import livepde as lp
from livepde.errors import SpaceError
from livepde.fem import box, grid, linear

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
    """Write two squares with groups in another format than Gmsh's."""
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
    assert mesh.p.max() == 2.0  # the node of no cell is gone
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


def test_clear_errors(tmp_path, gmsh, monkeypatch):
    with pytest.raises(lp.errors.SpaceError, match="there is no file"):
        lp.read_mesh(tmp_path / "nothing.msh")
    with pytest.raises(lp.errors.SpaceError, match="scale must be a positive number; got -1"):
        lp.read_mesh(gmsh, scale=-1)
    for name in ("broken.msh", "notes.txt"):
        (tmp_path / name).write_text("hello")
        with pytest.raises(lp.errors.SpaceError, match="cannot be read"):
            lp.read_mesh(tmp_path / name)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1.0], [2, 0, 0], [2, 1, 0]])
    meshio.Mesh(points, [("triangle", [[0, 1, 2], [1, 2, 3]])]).write(tmp_path / "bent.vtk")
    with pytest.raises(lp.errors.SpaceError, match="dimension 2 but bend in space"):
        lp.read_mesh(tmp_path / "bent.vtk")
    cells = [("triangle", [[0, 1, 2]]), ("quad", [[1, 4, 5, 3]])]
    meshio.Mesh(points * [1, 1, 0], cells).write(tmp_path / "mixed.vtk")
    with pytest.raises(lp.errors.SpaceError, match="several kinds"):
        lp.read_mesh(tmp_path / "mixed.vtk")
    meshio.Mesh(points, [("vertex", [[0]])]).write(tmp_path / "points.vtk")
    with pytest.raises(lp.errors.SpaceError, match="contains no mesh"):
        lp.read_mesh(tmp_path / "points.vtk")
    monkeypatch.setitem(__import__("sys").modules, "meshio", None)
    with pytest.raises(lp.errors.SpaceError, match=r"pip install 'livepde\[mesh\]'"):
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
    """x.h on cells, on a subdomain, and on a boundary the size of the cell behind it."""
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


@pytest.mark.slow
def test_a_penalty_imposes_an_unknown_boundary_value():
    """Weakly: beta (u - q) v with beta = 100 k/h, identified from one sensor inside."""
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
    assert {name: len(facets) for name, facets in mesh.boundaries.items()} == {
        "left": 2,
        "right": 2,
        "bottom": 3,
        "top": 3,
    }
    with pytest.raises(SpaceError, match="two increasing nodes"):
        grid([0.0, 1.0, 1.0], [0.0, 1.0])
