"""Processes of MPI as a team: rank 0 leads, the others carry out with it what it calls.

Only rank 0 runs the program: it reads data, keeps the journal, prints. What is shared are objects
of which every rank holds a part; a call of one of their methods is broadcast, and all ranks run it
together. So control flow cannot diverge: there is only one.

Arguments of a call are broadcast. What only rank 0 has (`here`: large arrays, which the method
scatters itself) others see as None.
"""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

import numpy as np

from livepde.errors import ConfigurationError, LinearAlgebraError, LivepdeError
from livepde.linalg import Array, IntArray

__all__ = ["MISSING", "Handle", "Team", "world"]

MISSING = (
    "The engine 'petsc' needs petsc4py and mpi4py (the extra 'petsc'); deploy/petsc.sh sets up an "
    "environment with Debian's, as docs/parallel.md says."
)


class Team:
    """The ranks of a communicator.

    Attributes
    ----------
    rank, size
        As of MPI.
    sent
        Bytes and messages between rank 0 and the others so far, as this rank counts them.
    """

    def __init__(self, comm: Any) -> None:
        self.comm = comm
        self.rank = int(comm.rank)
        self.size = int(comm.size)
        self.sent = [0, 0]
        self._objects: dict[int, Any] = {}
        self._count = 0
        self._left: list[int] = []

    # --- the leader ------------------------------------------------------------------------------

    def share(self, kind: Callable[..., Any], *sent: Any, here: tuple[Any, ...] = ()) -> Handle:
        """Make `kind(team, *sent, *here)` on every rank; only rank 0 calls this."""
        self._count += 1
        return Handle(self, self._count, self._call(self._count, kind, sent, here))

    def call(self, key: int, method: str, sent: tuple[Any, ...], here: tuple[Any, ...]) -> Any:
        """Call a method of a shared object on every rank; only rank 0 calls this."""
        return self._call(key, method, sent, here)

    def leave(self, key: int) -> None:
        """Take note that an object is no longer needed: it goes with the next call."""
        self._left.append(key)

    def part(self, key: int) -> Any:
        """Return this rank's part of a shared object."""
        return self._objects[key]

    def stop(self) -> None:
        """Send the other ranks home."""
        self.comm.bcast(None)

    def _call(self, key: int, what: Any, sent: tuple[Any, ...], here: tuple[Any, ...]) -> Any:
        left, self._left = self._left, []
        with _AllOrNone(self.comm):
            self.comm.bcast((left, key, what, sent, len(here)))
            return self._together(left, key, what, sent, here)

    # --- the others ------------------------------------------------------------------------------

    def serve(self) -> None:
        """Carry out what rank 0 calls until it has done: what every other rank does.

        Signals are left to rank 0: it ends the run in order, and then these ranks.
        """
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        while (order := self.comm.bcast(None)) is not None:
            left, key, what, sent, missing = order
            with suppress(LinearAlgebraError), _AllOrNone(self.comm):  # rank 0 deals with it
                self._together(left, key, what, sent, (None,) * missing)

    def _together(
        self, left: list[int], key: int, what: Any, sent: tuple[Any, ...], here: tuple[Any, ...]
    ) -> Any:
        for old in left:
            if old in self._objects:  # else its making failed
                self._objects.pop(old).close()
        if isinstance(what, str):
            return getattr(self._objects[key], what)(*sent, *here)
        self._objects[key] = made = what(self, *sent, *here)
        return made

    # --- arrays between rank 0 and the others ----------------------------------------------------

    def scatter(self, pieces: list[Array] | list[IntArray] | None, mine: Any) -> None:
        """Fill the array `mine` of every rank with its piece of what rank 0 has."""
        requests = []
        if pieces is not None:
            for rank, piece in enumerate(pieces):
                if rank == 0:
                    mine[...] = piece
                else:
                    requests.append(self.comm.Isend(np.ascontiguousarray(piece), dest=rank))
                    self._counted(piece.nbytes)
        else:
            self.comm.Recv(mine, source=0)
        for request in requests:
            request.Wait()

    def gather(self, mine: Array, sizes: IntArray) -> list[Array] | None:
        """Return the arrays of all ranks, of these lengths, on rank 0."""
        if self.rank:
            self.comm.Send(np.ascontiguousarray(mine), dest=0)
            return None
        pieces = [mine]
        for rank in range(1, self.size):
            pieces.append(np.empty((int(sizes[rank]), *mine.shape[1:])))
            self.comm.Recv(pieces[rank], source=rank)
            self._counted(pieces[rank].nbytes)
        return pieces

    def _counted(self, size: int) -> None:
        self.sent[0] += size
        self.sent[1] += 1


class Handle:
    """What rank 0 holds of a shared object."""

    def __init__(self, team: Team, key: int, local: Any) -> None:
        self.team = team
        self.key = key
        self.local = local

    def __call__(self, method: str, *sent: Any, here: tuple[Any, ...] = ()) -> Any:
        """Call a method on every rank, and return what it gives on rank 0."""
        return self.team.call(self.key, method, sent, here)

    def __del__(self) -> None:
        self.team.leave(self.key)


class _AllOrNone:
    """A failure within ends the processes of all ranks: the others wait for this one.

    `LinearAlgebraError` is raised by all ranks alike, and passes.
    """

    def __init__(self, comm: Any) -> None:
        self.comm = comm

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None or issubclass(kind, LinearAlgebraError):
            return
        if not issubclass(kind, LivepdeError):
            traceback.print_exception(kind, error, trace)
        sys.stderr.write(
            f"Error: rank {self.comm.rank} of {self.comm.size} failed, which ends all of them: "
            f"{kind.__name__}: {error}\n"
        )
        sys.stderr.flush()
        if self.comm.size > 1:
            self.comm.Abort(1)


def world() -> Team:
    """Return all processes that mpirun has started, as a team; starts MPI and PETSc.

    Raises
    ------
    ConfigurationError
        petsc4py or mpi4py is missing.
    """
    try:
        import petsc4py

        petsc4py.init([])
        from petsc4py import PETSc

        return Team(PETSc.COMM_WORLD.tompi4py())
    except ImportError as error:
        raise ConfigurationError(f"{MISSING} ({error})") from error
