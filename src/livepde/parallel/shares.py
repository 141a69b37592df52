"""Domain decomposition of a model: cells by PETSc's partitioner, and their coefficients.

A coefficient belongs to the lowest rank that owns a cell in the support of its shape function. A
rank evaluates forms on every cell with a coefficient of its own, one overlap layer beyond its
cells, so that its matrix rows are complete without any exchange of matrix entries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.fem.measure import Measure
from livepde.linalg import IntArray
from livepde.model import Model
from livepde.parallel.team import Team

__all__ = ["Share", "SharedModel"]

PARTITIONERS = ("ptscotch", "parmetis")


@dataclass(frozen=True, eq=False)
class Share:
    """Distribution of the coefficients of one space, u or q, over the ranks.

    Attributes
    ----------
    number
        PETSc's number of each coefficient, shape (n,): those of one rank are contiguous.
    rows
        Coefficients owned by this rank, in that order.
    reach
        All coefficients on its cells, in ascending order.
    sizes, reaches
        Number of owned coefficients of every rank; on rank 0 also the reached coefficients of every
        rank.
    order
        Coefficients of all ranks in PETSc's order, shape (n,).
    """

    number: IntArray
    rows: IntArray
    reach: IntArray
    sizes: IntArray
    reaches: list[IntArray]
    order: IntArray

    @property
    def dim(self) -> int:
        """Number of coefficients of all ranks."""
        return len(self.number)


class SharedModel:
    """A model built on every rank, with the distribution of cells and coefficients.

    Rank 0 passes its model; the others call `build(*args)`, and keep only the forms on their cells.

    Attributes
    ----------
    u, q
        Distributions of the coefficients of state and parameter.
    cells
        Cells with a coefficient owned by this rank.
    A, B
        Forms on these cells.
    """

    def __init__(self, team: Team, build: Any, args: tuple[Any, ...], model: Model | None) -> None:
        self.team = team
        if model is None:
            model = build(*args)
        owner = _cell_owners(team, model.mesh)
        everywhere = Measure(model.mesh, model.order)
        spaces = {"u": model.state_space, "q": model.parameter_space}
        whose = {name: space.dofs_on(everywhere) for name, space in spaces.items()}
        owners = {
            name: _lowest(dofs, owner, spaces[name].dim, team.size) for name, dofs in whose.items()
        }
        touched = [(owners[name][dofs] == team.rank).any(axis=0) for name, dofs in whose.items()]
        self.cells: IntArray = np.flatnonzero(np.logical_or.reduce(touched))
        self.u, self.q = (self._share(owners[name], whose[name]) for name in ("u", "q"))
        self.A, self.B = model.form_A.on(self.cells), model.form_B.on(self.cells)

    def close(self) -> None:
        """Do nothing: no PETSc object is held."""

    def _share(self, owner: IntArray, dofs: IntArray) -> Share:
        team = self.team
        order = np.argsort(owner, kind="stable")
        number = np.empty(len(owner), dtype=np.int64)
        number[order] = np.arange(len(owner))
        reach = np.unique(dofs[:, self.cells])
        reaches = team.comm.gather(reach)
        sizes = np.bincount(owner, minlength=team.size)
        rows = np.flatnonzero(owner == team.rank)
        return Share(number, rows, reach, sizes, reaches or [], order)


def _lowest(dofs: IntArray, owner: IntArray, size: int, ranks: int) -> IntArray:
    """Return the lowest rank with each coefficient on its cells."""
    # Written from the highest rank to the lowest, so that the lowest remains.
    found = np.full(size, ranks - 1)
    for rank in range(ranks - 1, -1, -1):
        found[dofs[:, owner == rank]] = rank
    return found


def _cell_owners(team: Team, mesh: Any) -> IntArray:
    """Return the owner rank of each cell by PETSc's partitioner: equal, compact shares."""
    from petsc4py import PETSc

    owner = np.zeros(mesh.nelements, dtype=np.int32)
    if team.size == 1:
        return owner
    corners = mesh.t[: mesh.elem.refdom.nnodes].T
    # Only rank 0 passes cells to PETSc: every rank has the whole mesh, and the cells would be
    # counted several times.
    cells = corners if team.rank == 0 else corners[:0]
    points = mesh.p.T if team.rank == 0 else mesh.p.T[:0]
    plex = PETSc.DMPlex().createFromCellList(
        mesh.dim(),
        np.ascontiguousarray(cells, dtype=PETSc.IntType),
        np.ascontiguousarray(points),
        interpolate=False,
        comm=team.comm,
    )
    kinds = [name for name in PARTITIONERS if PETSc.Sys.hasExternalPackage(name)]
    plex.getPartitioner().setType(kinds[0] if kinds else "simple")
    moved = plex.distribute()
    low, high = plex.getHeightStratum(0)
    _, local, remote = moved.getGraph()
    local = np.arange(len(remote)) if local is None else local
    mine = np.asarray(remote)[(local >= low) & (local < high), 1].astype(np.int64)
    moved.destroy()
    plex.destroy()
    for rank, members in enumerate(team.comm.allgather(mine)):
        owner[members] = rank
    return owner
