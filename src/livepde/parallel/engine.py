"""PETSc engine, and the context manager that activates it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from livepde.linalg import Pattern, Solver, using
from livepde.model import Model
from livepde.parallel.shares import SharedModel
from livepde.parallel.solver import PetscSolver, direct
from livepde.parallel.team import Handle, Team, world

__all__ = ["PetscEngine", "petsc"]


class PetscEngine:
    """Engine that solves on all ranks of a team; a `livepde.linalg.Engine`.

    Attributes
    ----------
    team
        The ranks.
    """

    def __init__(self, team: Team) -> None:
        self.team = team
        self._recipes: dict[int, tuple[Model, Callable[..., Model], tuple[Any, ...]]] = {}
        self._models: dict[int, Handle] = {}

    def build(
        self, function: Callable[..., Model], *args: Any, known: Model | None = None
    ) -> Model:
        """Return the model `function(*args)`; the other ranks may build it, too.

        The other ranks then evaluate its forms together with rank 0, each on its own cells. They
        must be able to import the function, and the arguments are sent to them.

        Parameters
        ----------
        known
            The model, if rank 0 has built it already.
        """
        model = function(*args) if known is None else known
        self._recipes[id(model)] = model, function, args
        return model

    def shared(self, model: Model) -> Handle | None:
        """Return the handle of a shared model; None if the other ranks cannot build it."""
        if id(model) not in self._recipes:
            return None
        if id(model) not in self._models:
            _, function, args = self._recipes[id(model)]
            self._models[id(model)] = self.team.share(SharedModel, function, args, here=(model,))
        return self._models[id(model)]

    @property
    def reason(self) -> str:
        """Reason of its choice, for `livepde.linalg.Choice`."""
        return f"PETSc on {self.team.size} rank{'s' * (self.team.size > 1)}"

    def solver(self, pattern: Pattern, *, symmetric: bool) -> Solver | None:
        """Return PETSc's solver; None if it has none for nonsymmetric matrices."""
        if not symmetric and direct() is None:
            return None
        return PetscSolver(self.team, pattern, symmetric)


@contextmanager
def petsc() -> Iterator[PetscEngine | None]:
    """Solve large systems by PETSc on all processes started by mpirun.

    Yields
    ------
    engine
        The engine on rank 0, where the program runs. None on every other rank, after rank 0 has
        left the block.

    Examples
    --------
    ::

        with petsc() as engine:
            if engine:
                model = engine.build(make_model, 300)
                ...  # an ordinary program
    """
    team = world()
    if team.rank:
        team.serve()
        yield None
        return
    engine = PetscEngine(team)
    try:
        with using(engine):
            yield engine
    finally:
        team.stop()
