"""Checkpoints of both laws by MPI-IO, in an order that is independent of the number of ranks.

A checkpoint consists of a small JSON file PATH with the numbers of the state, and a file next to it
with its vectors in PETSc's binary format, of which each rank writes and reads a contiguous part.
PATH is replaced when the vectors are complete, so that a killed run has its last checkpoint.
"""

from __future__ import annotations

import json
import secrets
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from livepde.atomic_write import write_bytes
from livepde.errors import RunError
from livepde.laws.equation_tests import ExcitationLevel
from livepde.linalg import IntArray
from livepde.petsc.observer import ObserverState
from livepde.petsc.petsc_filter import PetscFilterState
from livepde.petsc.petsc_model import PetscModel, petsc_module, zeros

OF_Q = ("q", "rate_q", "modes")  # fields of a state with vectors of Q
OF_U = ("u", "U", "u_alpha", "rate_u")  # fields of a state with vectors of X


def save_state(
    path: Path | str, model: PetscModel, state: PetscFilterState | ObserverState
) -> None:
    """Write a state of `PetscFilter` or `PetscObserver`; all ranks call it."""
    path, comm = Path(path), state.u.comm.tompi4py()
    beside = Path(f"{path}.{comm.bcast(secrets.token_hex(4))}.vectors")
    numbers: dict[str, Any] = {"vectors": beside.name, "kind": type(state).__name__}
    numbers["sizes"] = _sizes(model)
    viewer = petsc_module().Viewer().createMPIIO(str(beside), "w", comm=comm)
    for name, value in vars(state).items():
        if name in OF_Q + OF_U:
            parts = value if isinstance(value, tuple) else [] if value is None else [value]
            order = model.numbers_q if name in OF_Q else model.numbers_u
            for vector in parts:
                _ordered(vector, order).view(viewer)
            numbers[name] = len(parts)
        else:
            numbers[name] = _encoded(value)
    viewer.destroy()
    # One rank replaces the file, then removes the vectors of the old checkpoint.
    if comm.rank == 0:
        old = path.parent / _read(path)["vectors"] if path.exists() else None
        write_bytes(path, json.dumps(numbers).encode(), sync=True)
        if old is not None:
            old.unlink(missing_ok=True)
            Path(f"{old}.info").unlink(missing_ok=True)
    comm.barrier()


def load_state(path: Path | str, model: PetscModel) -> Any:
    """Load a state written by `save_state`, on any number of ranks; all ranks call it.

    Raises `RunError` if the checkpoint cannot be read, or if the model has a different size.
    """
    path = Path(path)
    numbers = _read(path)
    if numbers["sizes"] != _sizes(model):
        raise RunError(
            f"{path}: written for u and q with {numbers['sizes']} coefficients; this model has "
            f"{_sizes(model)}: take the mesh of before."
        )
    kind: Any = PetscFilterState if numbers["kind"] == "PetscFilterState" else ObserverState
    u, q = model.mass.createVecRight(), model.gram.createVecRight()
    beside = str(path.parent / numbers["vectors"])
    viewer, found = petsc_module().Viewer().createMPIIO(beside, "r", comm=u.comm), {}
    for name, value in ((one.name, numbers[one.name]) for one in fields(kind)):
        if name in OF_Q + OF_U:
            given = (q, model.numbers_q) if name in OF_Q else (u, model.numbers_u)
            parts = tuple(_loaded(*given, viewer) for _ in range(value))
            found[name] = parts if name in ("U", "modes") else parts[0] if parts else None
        else:
            found[name] = _decoded(value)
    viewer.destroy()
    return kind(**found)


def _sizes(model: PetscModel) -> list[int]:
    return [model.mass.getSize()[0], model.gram.getSize()[0]]


def _encoded(value: Any) -> Any:
    """Return the JSON value of a number, an array or an excitation level."""
    if isinstance(value, ExcitationLevel):
        return {key: _encoded(item) for key, item in asdict(value).items()}
    return np.asarray(value).tolist()


def _decoded(value: Any) -> Any:
    if isinstance(value, dict):
        return ExcitationLevel(**{k: _decoded(v) for k, v in value.items()})
    return np.array(value) if isinstance(value, list) else value


def _read(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: no checkpoint that can be read: {error}") from error
    return found


def _scatter(vector: Any, order: IntArray, ordered: Any) -> Any:
    PETSc = petsc_module()
    to = PETSc.IS().createGeneral(order.astype(PETSc.IntType), comm=vector.comm)
    start, end = vector.getOwnershipRange()
    own = PETSc.IS().createStride(end - start, first=start, step=1, comm=vector.comm)
    return PETSc.Scatter().create(vector, own, ordered, to)


def _ordered(vector: Any, order: IntArray) -> Any:
    """Return the values in the order of the numbers, evenly distributed over the ranks."""
    ordered = petsc_module().Vec().create(vector.comm)
    ordered.setSizes(vector.getSize())
    ordered.setType("standard")
    _scatter(vector, order, ordered).scatter(vector, ordered)
    return ordered


def _loaded(like: Any, order: IntArray, viewer: Any) -> Any:
    vector = zeros(like)
    ordered = _ordered(vector, order)
    ordered.load(viewer)
    # In reverse: from the common order to the order of the coefficients on these ranks.
    _scatter(vector, order, ordered).scatter(ordered, vector, mode=True)
    return vector
