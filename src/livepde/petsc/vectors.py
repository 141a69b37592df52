"""Sums and products of lists of PETSc vectors, and vectors in an order that no rank changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from livepde.linalg import Array, IntArray
from livepde.petsc.petsc_model import petsc_module

RIESZ = "livepde_riesz_"  # prefix of PETSc's options


def combined(weights: Array, vectors: Sequence[Any], onto: Any = None) -> Any:
    """Return the weighted sum of vectors, plus `onto`, as a new vector."""
    total = zeros(vectors[0]) if onto is None else onto.copy()
    total.maxpy(weights, list(vectors))
    return total


def inner(x: Any, vectors: Sequence[Any]) -> Array:
    """Return the inner products of x with several vectors, by one reduction, on every rank."""
    own = x.getArray(readonly=True)
    local = np.array([one.getArray(readonly=True) @ own for one in vectors])
    total: Array = x.comm.tompi4py().allreduce(local)
    return total


def gathered(small: Any) -> Array:
    """Return all values of a small vector, such as readings, on every rank."""
    return np.concatenate(small.comm.tompi4py().allgather(small.getArray(readonly=True).copy()))


def free_mask(x: Any, fixed: IntArray) -> Any:
    """Return a vector like x with ones, and zeros at owned global numbers."""
    mask = x.duplicate()
    mask.set(1.0)
    mask.getArray()[fixed - x.getOwnershipRange()[0]] = 0.0
    return mask


def random_vector(like: Any, numbers: IntArray, seed: int) -> Any:
    """Return a vector of values in (-1, 1) that depend on `numbers` and the seed alone."""
    vector = like.duplicate()
    # The fractional part of a large sine: a hash as shaders use, equal on all ranks.
    hashed = 43758.5453 * np.sin(12.9898 * (np.asarray(numbers) + 1.0) + 78.233 * seed)
    vector.getArray()[:] = 2.0 * (hashed - np.floor(hashed)) - 1.0
    return vector


def zeros(like: Any) -> Any:
    """Return a zero vector like another one."""
    vector = like.duplicate()
    vector.set(0.0)
    return vector


def linear_solver(matrix: Any, accuracy: float, kind: str = "cg", prefix: str = RIESZ) -> Any:
    """Return a solver with algebraic multigrid, which PETSc's options with the prefix change."""
    solver = petsc_module().KSP().create(matrix.comm)
    solver.setOptionsPrefix(prefix)
    solver.setOperators(matrix)
    solver.setType(kind)
    solver.getPC().setType(multigrid())
    solver.setTolerances(rtol=accuracy, atol=0.0, max_it=500)
    solver.setFromOptions()
    return solver


def multigrid() -> str:
    """Return the algebraic multigrid of this PETSc: BoomerAMG if it was built with hypre."""
    return "hypre" if petsc_module().Sys.hasExternalPackage("hypre") else "gamg"


def standard_vector(comm: Any, local: int) -> Any:
    """Return a zero vector of PETSc's standard type with so many owned values."""
    vector = petsc_module().Vec().create(comm)
    vector.setSizes((local, None))
    vector.setType("standard")
    vector.set(0.0)
    return vector
