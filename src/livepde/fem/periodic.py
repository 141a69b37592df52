"""Periodic functions: identification of coefficients on pairs of boundaries."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from skfem.element import ElementLineHermite, ElementQuadBFS
from skfem.element.element_global import ElementGlobal

from livepde.errors import SpaceError
from livepde.fem.fields import Field
from livepde.linalg import IntArray

# Distance of two coefficients that count as the same place, relative to the size of the mesh.
SLACK = 1e-6


def tied(field: Field, block: Any) -> IntArray | None:
    """Return the representative of each of scikit-fem's degrees of freedom; None: no ties.

    Coefficients of a pair of periodic boundaries are identified if they are of the same kind
    (value, slope) and at the same place up to the translation of one boundary to the other.

    Raises
    ------
    SpaceError
        The element has no coefficients on its sides, or those of two boundaries do not match.
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
    # Chains of ties, as at the corners of a doubly periodic rectangle, form one coefficient each.
    _, labels = connected_components(graph, directed=False)
    # Coefficients are numbered by first occurrence, which keeps the bandwidth of the mesh.
    _, first, renumbered = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    tie: IntArray = rank[renumbered]
    return tie


def _matched(field: Field, block: Any, one: str, other: str) -> tuple[IntArray, IntArray]:
    names = dict.fromkeys(field.element.dofnames or [])
    what = f"periodic: '{one}' and '{other}'"
    i, j = [], []
    for name in names:
        left, right = (block.at(side, [name]) for side in (one, other))
        if len(left) != len(right):
            raise SpaceError(
                f"{what} have {len(left)} and {len(right)} coefficients '{name}': their meshes "
                "must match."
            )
        if not len(left):
            continue
        a, b = block.places[:, left], block.places[:, right]
        shift = (b.mean(axis=1) - a.mean(axis=1))[:, None]
        found, nearest = scipy.spatial.cKDTree((a + shift).T).query(b.T)
        distance = float(np.max(found))
        size = np.ptp(field.mesh.p, axis=1).max()
        if distance > SLACK * size or len(np.unique(nearest)) < len(left):
            raise SpaceError(
                f"{what} do not match: shifted onto each other, their nodes are up to "
                f"{distance:.3g} apart. Mesh both sides alike."
            )
        i.append(left[nearest])
        j.append(right)
    if not i:
        raise SpaceError(
            f"{what}: {type(field.element).__name__} has no coefficients there, so it cannot be "
            "periodic; take a continuous element."
        )
    return np.concatenate(i), np.concatenate(j)
