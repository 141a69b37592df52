"""Meshes and elements for those who have no wishes of their own."""

from __future__ import annotations

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
    ElementLineHermite,
    ElementLineP1,
    ElementQuad1,
    ElementTetP1,
    ElementTriP1,
)

from livepde.errors import SpaceError

__all__ = ["hermite", "linear", "rectangle"]

LINEAR: dict[Any, Any] = {
    MeshLine: ElementLineP1,
    MeshTri: ElementTriP1,
    MeshQuad: ElementQuad1,
    MeshTet: ElementTetP1,
    MeshHex: ElementHex1,
}


def linear(mesh: Mesh) -> Element:
    """Return the continuous element of first order for a mesh of any dimension."""
    for kind, element in LINEAR.items():
        if isinstance(mesh, kind):
            return element()
    raise SpaceError(f"no element of first order for a mesh of type {type(mesh).__name__}.")


def hermite(mesh: Mesh) -> Element:
    """Return cubic Hermite on a line, the element of first order elsewhere."""
    return ElementLineHermite() if isinstance(mesh, MeshLine) else linear(mesh)


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
