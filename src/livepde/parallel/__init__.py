"""Identification on several processes: PETSc and MPI behind the protocol of `livepde.linalg`.

Nothing here starts MPI when it is imported; `petsc()` does.
"""

from __future__ import annotations

from livepde.parallel.engine import PetscEngine, petsc
from livepde.parallel.team import Team

__all__ = ["PetscEngine", "Team", "petsc"]
