"""Sums and products of lists of PETSc vectors, and vectors in an order that no rank changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from livepde.linalg import Array, IntArray
from livepde.petsc.model import petsc_module

__all__ = [
    "combined",
    "definite_solver",
    "gathered",
    "inner",
    "multigrid",
    "random_vector",
    "zeros",
]


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
    counts = small.comm.tompi4py().allgather(small.getArray(readonly=True).copy())
    return np.concatenate(counts)


def free_mask(x: Any, fixed: IntArray) -> Any:
    """Return a vector like x with ones, and zeros at owned global numbers."""
    mask = x.duplicate()
    mask.set(1.0)
    mask.getArray()[fixed - x.getOwnershipRange()[0]] = 0.0
    return mask


def random_vector(like: Any, numbers: IntArray, seed: int) -> Any:
    """Return a vector of values in (-1, 1) that depend on `numbers` and the seed alone.

    The mixing function is SplitMix64 (Steele, Lea and Flood 2014): no generator has to run through
    the values of other ranks.
    """
    z = (np.asarray(numbers, dtype=np.uint64) + np.uint64(seed << 40)) * np.uint64(
        0x9E3779B97F4A7C15
    )
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    vector = like.duplicate()
    vector.getArray()[:] = (z >> np.uint64(11)).astype(float) * 2.0**-52 - 1.0
    return vector


def zeros(like: Any) -> Any:
    """Return a zero vector like another one."""
    vector = like.duplicate()
    vector.set(0.0)
    return vector


def definite_solver(matrix: Any, accuracy: float) -> Any:
    """Return a solver for a symmetric positive definite matrix, to a relative accuracy."""
    solver = petsc_module().KSP().create(matrix.comm)
    solver.setOperators(matrix)
    solver.setType("cg")
    solver.getPC().setType(multigrid())
    solver.setTolerances(rtol=accuracy)
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
