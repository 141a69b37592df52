"""Both laws on PETSc vectors, for a process that is distributed over MPI ranks.

The process is defined by a finite-element package with a distributed mesh, which implements the
protocol `PetscModel`; `DolfinxModel` does so for UFL. PETSc and MPI start with the first model.
"""

from __future__ import annotations

from livepde.petsc.dolfinx import DolfinxModel
from livepde.petsc.mpi_io import load_state, save_state
from livepde.petsc.observer import PetscObserver
from livepde.petsc.petsc_filter import PetscFilter, leading_modes, number_modes
from livepde.petsc.petsc_model import ImplicitStep, PetscModel, check_petsc_model

__all__ = [
    "DolfinxModel",
    "ImplicitStep",
    "PetscFilter",
    "PetscModel",
    "PetscObserver",
    "check_petsc_model",
    "leading_modes",
    "load_state",
    "number_modes",
    "save_state",
]
