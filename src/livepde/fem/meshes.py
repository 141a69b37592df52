"""Meshes and elements for common cases, mesh files, and periodic boundaries."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
import scipy
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from skfem import Mesh, MeshHex, MeshLine, MeshQuad, MeshTet, MeshTri
from skfem.element import (
    Element,
    ElementHex1,
    ElementHex2,
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementQuad1,
    ElementQuad2,
    ElementQuadBFS,
    ElementTetP1,
    ElementTetP2,
    ElementTriP1,
    ElementTriP2,
)
from skfem.element.element_global import ElementGlobal

from livepde.errors import SpaceError, optional, require_positive
from livepde.fem.fields import Field, Predicate, with_sides
from livepde.linalg import Array, IntArray

# Continuous elements of first and second order.
ELEMENTS: dict[Any, tuple[Any, Any]] = {
    MeshLine: (ElementLineP1, ElementLineP2),
    MeshTri: (ElementTriP1, ElementTriP2),
    MeshQuad: (ElementQuad1, ElementQuad2),
    MeshTet: (ElementTetP1, ElementTetP2),
    MeshHex: (ElementHex1, ElementHex2),
}


def linear(mesh: Mesh) -> Element:
    """Return the continuous element of first order for a mesh of any dimension.

    Examples
    --------
    >>> import livepde as lp
    >>> type(lp.linear(lp.interval(0.0, 1.0, 8))).__name__
    'ElementLineP1'
    """
    return _continuous(mesh, 0)


def quadratic(mesh: Mesh) -> Element:
    """Return the continuous element of second order for a mesh of any dimension."""
    return _continuous(mesh, 1)


def _continuous(mesh: Mesh, which: int) -> Element:
    for kind, elements in ELEMENTS.items():
        if isinstance(mesh, kind):
            return elements[which]()
    order = ("first", "second")[which]
    raise SpaceError(f"no element of {order} order for a mesh of type {type(mesh).__name__}.")


def smooth(mesh: Mesh) -> Element:
    """Return an element of class C^1: cubic Hermite on lines, Bogner-Fox-Schmit on rectangles."""
    if isinstance(mesh, MeshLine):
        return ElementLineHermite()
    if isinstance(mesh, MeshQuad):
        return ElementQuadBFS()
    raise SpaceError(
        f"no element of class C^1 for a mesh of type {type(mesh).__name__}; take `linear` or "
        "`quadratic`, and Sobolev(2) as inner product."
    )


def hermite(mesh: Mesh) -> Element:
    """Return the cubic Hermite element on an interval, otherwise the element of first order."""
    return ElementLineHermite() if isinstance(mesh, MeshLine) else linear(mesh)


def rectangle(
    x: tuple[float, float],
    y: tuple[float, float],
    cells: tuple[int, int],
    *,
    regions: Mapping[str, Predicate] | None = None,
) -> MeshQuad:
    """Return a mesh of [x0, x1] x [y0, y1] with boundaries "left", "right", "bottom", "top".

    `regions` are named subdomains, each a predicate on the midpoints of the elements.

    Examples
    --------
    >>> import livepde as lp
    >>> lp.rectangle((0.0, 2.0), (0.0, 1.0), (20, 10)).nelements
    200
    """
    if not (x[1] > x[0] and y[1] > y[0] and min(cells) >= 1):
        raise SpaceError(
            f"rectangle({x}, {y}, {cells}): needs increasing coordinates and cells >= 1."
        )
    return grid(np.linspace(*x, cells[0] + 1), np.linspace(*y, cells[1] + 1), regions=regions)


def grid(
    x: Sequence[float] | Array,
    y: Sequence[float] | Array,
    *,
    regions: Mapping[str, Predicate] | None = None,
) -> MeshQuad:
    """Return a rectangle with a node at every (x, y) of two increasing lists.

    Use it for graded meshes. See `rectangle` for boundaries and regions.

    >>> grid([-100, -10, 0, 10, 100], [0, 1, 4]).nelements
    8
    """
    if not all(len(side) > 1 and (np.diff(side) > 0).all() for side in (x, y)):
        raise SpaceError("grid: needs at least two increasing nodes in x and in y.")
    return with_sides(MeshQuad.init_tensor(np.array(x), np.array(y)), regions)


def box(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    cells: tuple[int, int, int],
    *,
    regions: Mapping[str, Predicate] | None = None,
) -> MeshTet:
    """Return a mesh of [x0, x1] x [y0, y1] x [z0, z1] with tetrahedra.

    Its boundaries are "left" and "right" (x), "front" and "back" (y), "bottom" and "top" (z).
    `regions` are named subdomains, each a predicate on the midpoints of the elements.
    """
    sides = (x, y, z)
    if not (all(b > a for a, b in sides) and min(cells) >= 1):
        raise SpaceError(
            f"box({x}, {y}, {z}, {cells}): needs increasing coordinates and cells >= 1."
        )
    nodes = [np.linspace(*side, n + 1) for side, n in zip(sides, cells, strict=True)]
    return with_sides(MeshTet.init_tensor(*nodes), regions)


def halved(mesh: Mesh) -> Mesh:
    """Return the mesh with elements halved in every direction and the same subdomains.

    In scikit-fem 12, refinement of a line numbers cells and subdomains inconsistently, so the
    subdomains are recomputed.

    >>> line = MeshLine([0.0, 1.0, 2.0, 3.0]).with_subdomains({"left": lambda x: x[0] < 1.0})
    >>> finer = halved(line)
    >>> float(finer.p[0][finer.t[:, finer.subdomains["left"]]].max())
    1.0
    """
    finer = mesh.refined()
    if not (isinstance(mesh, MeshLine) and mesh.subdomains):
        return finer
    cell = mesh.element_finder()(finer.p[0][finer.t].mean(axis=0))
    return finer.with_subdomains(
        {name: np.flatnonzero(np.isin(cell, members)) for name, members in mesh.subdomains.items()}
    )


def read_mesh(path: str | Path, scale: float = 1.0) -> Mesh:
    """Return a mesh from a file in any format of meshio: Gmsh, VTK, Abaqus, XDMF, MED, ...

    Cells are lines, triangles, quadrilaterals, tetrahedra or hexahedra; the mesh consists of the
    cells of the highest dimension. Named groups (physical groups of Gmsh, sets of Abaqus) of cells
    become subdomains, and groups of sides become boundaries, for `On`, `Piecewise` and `dirichlet`.
    Requires the extra `mesh`.

    Parameters
    ----------
    path
        Path of the file; its extension determines the format.
    scale
        Unit of length of the file over that of the model: 1e-3 for a file in mm, a model in m.

    Raises
    ------
    SpaceError
        The file does not exist, cannot be read, or contains no mesh.

    Examples
    --------
    >>> import livepde as lp
    >>> mesh = lp.read_mesh("plate.msh")  # doctest: +SKIP
    """
    path = Path(path)
    require_positive("read_mesh: scale", scale, SpaceError)
    if not path.is_file():
        raise SpaceError(f"read_mesh: there is no file '{path}'.")
    with optional("mesh", "read_mesh needs meshio, which is not installed", SpaceError):
        import meshio
        from skfem.io.meshio import from_meshio
    with _quiet():
        mesh = _loaded(path, meshio, from_meshio)
    if type(mesh) in ELEMENTS:  # nodes such as centres of arcs are not part of a cell
        mesh = mesh.remove_unused_nodes()
    if scale != 1.0:
        mesh = mesh.scaled(float(scale))
    boundaries, subdomains = _groups(mesh.boundaries), _groups(mesh.subdomains)
    return replace(mesh, _boundaries=boundaries, _subdomains=subdomains)


def _groups(groups: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return named groups with members, without the internal groups "gmsh:..." of the format."""
    named = {k: v for k, v in (groups or {}).items() if k and not str(k).startswith("gmsh:")}
    return {name: members for name, members in named.items() if len(members)} or None


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the output of a reader: problems with a file are raised as errors."""
    log = logging.getLogger("skfem")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()), catch_warnings():
            simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _loaded(path: Path, meshio: Any, from_meshio: Any) -> Mesh:
    # For an unknown format, meshio raises SystemExit, which would end the user's program.
    try:
        read = meshio.read(path)
    except (Exception, SystemExit) as error:
        raise SpaceError(
            f"read_mesh: '{path}' cannot be read ({str(error) or type(error).__name__}): "
            "check that its extension matches its format, or save it as Gmsh 4.1 (.msh)."
        ) from error
    try:
        mesh: Mesh = from_meshio(read, ignore_orientation=True)
    except Exception as error:
        kinds = sorted(read.cells_dict) or "none"
        raise SpaceError(
            f"read_mesh: '{path}' contains no mesh that livepde can use; its cells are {kinds}, "
            "expected lines, triangles, quadrilaterals, tetrahedra or hexahedra."
        ) from error
    total = sum(len(block.data) for block in read.cells if block.dim == mesh.dim())
    if total != mesh.nelements:
        raise SpaceError(
            f"read_mesh: '{path}' mixes cells of several kinds, {sorted(read.cells_dict)}; livepde "
            "takes one kind: mesh it with one."
        )
    if np.ptp(read.points[:, mesh.dim() :], axis=0).any():
        raise SpaceError(
            f"read_mesh: the cells of '{path}' have dimension {mesh.dim()} but bend in space: "
            f"put the mesh into the {('x axis', 'xy plane', '')[mesh.dim() - 1]}."
        )
    return mesh


# scikit-fem and meshio number the corners of a hexahedron differently.
KINDS: dict[Any, tuple[str, list[int]]] = {
    MeshTri: ("triangle", [0, 1, 2]),
    MeshQuad: ("quad", [0, 1, 2, 3]),
    MeshTet: ("tetra", [0, 1, 2, 3]),
    MeshHex: ("hexahedron", [0, 3, 6, 2, 1, 5, 7, 4]),
}


def shares(mesh: Mesh, axis: int, x: Array) -> Array:
    """Return relative positions of coordinates along an axis of the bounding box, from 0 to 1.

    In one dimension they are measured by the number of cells instead of lengths, since a graded
    mesh is fine where the state varies.
    """
    nodes = np.sort(mesh.p[axis])
    if len(mesh.p) > 1:
        nodes = nodes[[0, -1]]
    return np.asarray(np.interp(x, nodes, np.linspace(0.0, 1.0, len(nodes))))


def lengths(mesh: Mesh, axis: int, x: Array) -> Array:
    """Return the length of the bounding box along an axis, for each of the coordinates x.

    In one dimension, it is the number of cells times the size of the cell at x.
    """
    nodes = np.sort(mesh.p[axis])
    if len(mesh.p) > 1:
        nodes = nodes[[0, -1]]
    count = len(nodes) - 1
    place = np.clip(np.searchsorted(nodes, x) - 1, 0, count - 1)
    return np.asarray(count * np.diff(nodes)[place])


def cells(mesh: Mesh) -> dict[str, Any]:
    """Return meshio's cell type -> vertices of the cells, shape (cells, corners).

    The mapping is empty for an interval, whose nodes suffice.
    """
    for kind, (name, corners) in KINDS.items():
        if isinstance(mesh, kind):
            return {name: mesh.t[corners].T}
    return {}


# Tolerance for coefficients at the same position, relative to the size of the mesh.
SLACK = 1e-6


def tied(field: Field, block: Any) -> IntArray | None:
    """Return the coefficient of each of scikit-fem's degrees of freedom; None if not periodic.

    Degrees of freedom of a pair of periodic boundaries are identified if they have the same kind
    (value, slope) and the same position up to the translation between the boundaries.

    Raises `SpaceError`: the element has no degrees of freedom on boundaries, or the boundaries do
    not match.
    """
    if not field.periodic:
        return None
    count = int(block.dofs.N)
    element = field.element
    if isinstance(element, ElementGlobal) and not isinstance(
        element, ElementLineHermite | ElementQuadBFS
    ):
        raise SpaceError(
            f"periodic: {type(element).__name__} has normal derivatives, which change their sign "
            "from one side to the other; take `linear`, `quadratic` or `smooth`."
        )
    pairs = [_matched(field, block, *pair) for pair in field.periodic]
    i, j = (np.concatenate(side) for side in zip(*pairs, strict=True))
    graph = sp.csr_array((np.ones(len(i)), (i, j)), shape=(count, count))
    # Chains of identifications, as at corners of a doubly periodic rectangle, are one coefficient.
    _, labels = connected_components(graph, directed=False)
    # Coefficients are numbered by first occurrence, which preserves the bandwidth of the mesh.
    _, first, renumbered = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return rank[renumbered]


def _matched(field: Field, block: Any, first: str, second: str) -> tuple[IntArray, IntArray]:
    names = dict.fromkeys(field.element.dofnames or [])
    sides = f"periodic: '{first}' and '{second}'"
    i, j = [], []
    for name in names:
        left, right = (block.at(side, [name]) for side in (first, second))
        if len(left) != len(right):
            raise SpaceError(
                f"{sides} have {len(left)} and {len(right)} coefficients '{name}': their meshes "
                "must match."
            )
        if not len(left):
            continue
        a, b = block.places[:, left], block.places[:, right]
        shift = (b.mean(axis=1) - a.mean(axis=1))[:, None]
        distances, nearest = scipy.spatial.cKDTree((a + shift).T).query(b.T)
        distance = float(np.max(distances))
        size = np.ptp(field.mesh.p, axis=1).max()
        if distance > SLACK * size or len(np.unique(nearest)) < len(left):
            raise SpaceError(
                f"{sides} do not match: shifted onto each other, their nodes are up to "
                f"{distance:.3g} apart. Mesh both sides alike."
            )
        i.append(left[nearest])
        j.append(right)
    if not i:
        raise SpaceError(
            f"{sides}: {type(field.element).__name__} has no coefficients there, so it cannot be "
            "periodic; take a continuous element."
        )
    return np.concatenate(i), np.concatenate(j)
