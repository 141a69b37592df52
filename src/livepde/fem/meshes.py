"""Meshes and elements for those who have no wishes of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from skfem import (
    Mesh,
    MeshHex,
    MeshLine,
    MeshQuad,
    MeshTet,
    MeshTri,
)
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

from livepde.errors import SpaceError

__all__ = ["box", "hermite", "line", "linear", "quadratic", "rectangle", "smooth"]

LINEAR: dict[Any, Any] = {
    MeshLine: ElementLineP1,
    MeshTri: ElementTriP1,
    MeshQuad: ElementQuad1,
    MeshTet: ElementTetP1,
    MeshHex: ElementHex1,
}

QUADRATIC: dict[Any, Any] = {
    MeshLine: ElementLineP2,
    MeshTri: ElementTriP2,
    MeshQuad: ElementQuad2,
    MeshTet: ElementTetP2,
    MeshHex: ElementHex2,
}


def linear(mesh: Mesh) -> Element:
    """Return the continuous element of first order for a mesh of any dimension."""
    return _of(LINEAR, mesh, "first")


def quadratic(mesh: Mesh) -> Element:
    """Return the continuous element of second order for a mesh of any dimension."""
    return _of(QUADRATIC, mesh, "second")


def _of(elements: dict[Any, Any], mesh: Mesh, order: str) -> Element:
    for kind, element in elements.items():
        if isinstance(mesh, kind):
            return element()
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
    """Return cubic Hermite on a line, the element of first order elsewhere."""
    return ElementLineHermite() if isinstance(mesh, MeshLine) else linear(mesh)


def line(nodes: Sequence[float]) -> MeshLine:
    """Return a mesh of an interval with the given nodes and boundaries "left" and "right"."""
    x = np.asarray(nodes, dtype=float)
    if x.ndim != 1 or len(x) < 2 or not (np.diff(x) > 0).all():
        raise SpaceError(f"line: needs at least two increasing nodes; got {x.tolist()}.")
    return MeshLine(x).with_boundaries(
        {"left": lambda p: np.isclose(p[0], x[0]), "right": lambda p: np.isclose(p[0], x[-1])}
    )


def rectangle(x: tuple[float, float], y: tuple[float, float], cells: tuple[int, int]) -> MeshQuad:
    """Return a mesh of [x0, x1] x [y0, y1] with boundaries "left", "right", "bottom", "top"."""
    if not (x[1] > x[0] and y[1] > y[0] and min(cells) >= 1):
        raise SpaceError(
            f"rectangle({x}, {y}, {cells}): needs increasing coordinates and cells >= 1."
        )
    mesh = MeshQuad.init_tensor(np.linspace(*x, cells[0] + 1), np.linspace(*y, cells[1] + 1))
    return mesh.with_boundaries(
        {
            "left": lambda p: np.isclose(p[0], x[0]),
            "right": lambda p: np.isclose(p[0], x[1]),
            "bottom": lambda p: np.isclose(p[1], y[0]),
            "top": lambda p: np.isclose(p[1], y[1]),
        }
    )


def box(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    cells: tuple[int, int, int],
) -> MeshTet:
    """Return a mesh of tetrahedra of [x0, x1] x [y0, y1] x [z0, z1].

    Its boundaries are "left" and "right" (x), "front" and "back" (y), "bottom" and "top" (z).
    """
    sides = (x, y, z)
    if not (all(b > a for a, b in sides) and min(cells) >= 1):
        raise SpaceError(
            f"box({x}, {y}, {z}, {cells}): needs increasing coordinates and cells >= 1."
        )
    mesh = MeshTet.init_tensor(
        *(np.linspace(*side, n + 1) for side, n in zip(sides, cells, strict=True))
    )
    names = (("left", "right"), ("front", "back"), ("bottom", "top"))
    return mesh.with_boundaries(
        {
            name: lambda p, axis=axis, end=end: np.isclose(p[axis], end)
            for axis in range(3)
            for name, end in zip(names[axis], sides[axis], strict=True)
        }
    )
