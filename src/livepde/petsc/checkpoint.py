"""Checkpoints of both laws by MPI-IO, in an order that does not depend on the number of ranks.

A checkpoint is a small file PATH, JSON with the numbers of the state, and a file beside it with its
vectors, in PETSc's binary format. Each rank writes and reads a contiguous part: nothing is
gathered. PATH is replaced when the vectors are complete, so that a run that is killed meanwhile
goes on from the checkpoint before.
"""

from __future__ import annotations

import json
import secrets
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from livepde.atomic_write import write_bytes
from livepde.errors import RunError
from livepde.laws.excitation import ExcitationLevel
from livepde.linalg import IntArray
from livepde.petsc.filter import FilterState
from livepde.petsc.model import PetscModel, petsc_module
from livepde.petsc.observer import ObserverState
from livepde.petsc.vectors import zeros

__all__ = ["load_state", "save_state"]

OBSERVED = ("u", "q", "u_alpha", "rate_u", "rate_q")  # vectors of an observer's state


def save_state(path: Path | str, model: PetscModel, state: FilterState | ObserverState) -> None:
    """Write a state of `PetscFilter` or `PetscObserver`; all ranks call it."""
    path, comm = Path(path), state.u.comm.tompi4py()
    vectors = Path(f"{path}.{comm.bcast(secrets.token_hex(4))}.vectors")
    fields, numbers = _numbers(state)
    viewer = petsc_module().Viewer().createMPIIO(str(vectors), "w", comm=comm)
    for name, vector in fields:
        order = model.numbers_q if _is_parameter(name) else model.numbers_u
        _ordered(vector, order).view(viewer)
    viewer.destroy()
    if comm.rank == 0:
        old = _read(path)["vectors"] if path.exists() else None
        numbers |= {"vectors": vectors.name, "names": [name for name, _ in fields]}
        numbers["sizes"] = [model.mass.getSize()[0], model.gram.getSize()[0]]
        write_bytes(path, json.dumps(numbers).encode(), sync=True)
        if old is not None:
            (path.parent / old).unlink(missing_ok=True)
            (path.parent / f"{old}.info").unlink(missing_ok=True)
    comm.barrier()


def load_state(path: Path | str, model: PetscModel) -> Any:
    """Return a state that `save_state` wrote, on any number of ranks; all ranks call it.

    Raises
    ------
    RunError
        There is no checkpoint, it is damaged, or it is that of a model of another size.
    """
    path = Path(path)
    numbers = _read(path)
    sizes = [model.mass.getSize()[0], model.gram.getSize()[0]]
    if numbers["sizes"] != sizes:
        raise RunError(
            f"{path}: written for u and q with {numbers['sizes']} coefficients; this model has "
            f"{sizes}: take the mesh of before."
        )
    u, q = model.mass.createVecRight(), model.gram.createVecRight()
    beside = str(path.parent / numbers["vectors"])
    viewer = petsc_module().Viewer().createMPIIO(beside, "r", comm=u.comm)
    vectors = []
    for name in numbers["names"]:
        like, order = (q, model.numbers_q) if _is_parameter(name) else (u, model.numbers_u)
        vectors.append(_loaded(like, order, viewer))
    viewer.destroy()
    return _state(numbers, dict(zip(numbers["names"], vectors, strict=True)))


def _numbers(state: FilterState | ObserverState) -> tuple[list[tuple[str, Any]], dict[str, Any]]:
    """Return the vectors of a state with their names, and the rest of it for JSON."""
    if isinstance(state, FilterState):
        fields = [("u", state.u), *((f"U{k}", row) for k, row in enumerate(state.U))]
        fields += [(f"q{k}", mode) for k, mode in enumerate(state.modes)]
        small = {"a": state.a.tolist(), "C": state.C.tolist(), "refused": state.refused.tolist()}
        return fields, {"kind": "filter", "t": state.t, **small}
    found = [(name, getattr(state, name)) for name in OBSERVED]
    level = {k: np.asarray(v).tolist() for k, v in asdict(state.excitation).items()}
    numbers = {"kind": "observer", "t": state.t, "excitation": level}
    return [pair for pair in found if pair[1] is not None], numbers


def _state(numbers: dict[str, Any], vectors: dict[str, Any]) -> FilterState | ObserverState:
    if numbers["kind"] == "filter":
        rows = tuple(vectors[f"U{k}"] for k in range(len(numbers["a"])))
        a, C = np.array(numbers["a"]), np.array(numbers["C"])
        refused = np.array(numbers["refused"], dtype=int)
        modes = tuple(vectors[f"q{k}"] for k in range(len(a)))
        return FilterState(numbers["t"], vectors["u"], rows, a, C, refused, modes)
    level: dict[str, Any] = numbers["excitation"]
    level |= {k: np.array(v) for k, v in level.items() if isinstance(v, list)}
    found = {name: vectors.get(name) for name in OBSERVED}
    return ObserverState(t=numbers["t"], excitation=ExcitationLevel(**level), **found)


def _is_parameter(name: str) -> bool:
    """Return whether a vector of a state is one of Q."""
    return name.startswith(("q", "rate_q"))


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
    """Return the values in the order of the numbers, shared out evenly."""
    ordered = petsc_module().Vec().create(vector.comm)
    ordered.setSizes(vector.getSize())
    ordered.setType("standard")
    _scatter(vector, order, ordered).scatter(vector, ordered)
    return ordered


def _loaded(like: Any, order: IntArray, viewer: Any) -> Any:
    vector = zeros(like)
    ordered = _ordered(vector, order)
    ordered.load(viewer)
    _scatter(vector, order, ordered).scatter(ordered, vector, mode=True)
    return vector
