"""Team of MPI processes: rank 0 leads, the other ranks execute its calls.

Only rank 0 runs the program: it reads data, keeps the journal, prints. Every rank holds a part of
each shared object; a method call is broadcast, and all ranks execute it together. Control flow
cannot diverge, because there is only one.

Arguments of a call are broadcast. Arguments in `here` stay on rank 0 (large arrays, which the
method scatters itself); the other ranks get None.
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
    """Ranks of a communicator, led by rank 0.

    Attributes
    ----------
    rank, size
        Rank and size as in MPI.
    sent
        Bytes and messages between rank 0 and the others so far, as counted by this rank.
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
        """Create `kind(team, *sent, *here)` on every rank; only rank 0 calls this."""
        self._count += 1
        return Handle(self, self._count, self._call(self._count, kind, sent, here))

    def call(self, key: int, method: str, sent: tuple[Any, ...], here: tuple[Any, ...]) -> Any:
        """Call a method of a shared object on every rank; only rank 0 calls this."""
        return self._call(key, method, sent, here)

    def leave(self, key: int) -> None:
        """Mark an object as no longer needed; it is freed with the next call."""
        self._left.append(key)

    def part(self, key: int) -> Any:
        """Return the local part of a shared object."""
        return self._objects[key]

    def stop(self) -> None:
        """End the service of the other ranks."""
        self.comm.bcast(None)

    def _call(self, key: int, what: Any, sent: tuple[Any, ...], here: tuple[Any, ...]) -> Any:
        left, self._left = self._left, []
        with _AllOrNone(self.comm):
            self.comm.bcast((left, key, what, sent, len(here)))
            return self._together(left, key, what, sent, here)

    # --- the others ------------------------------------------------------------------------------

    def serve(self) -> None:
        """Execute the calls of rank 0 until it stops: the main loop of every other rank.

        Signals are ignored here: rank 0 handles them, ends the run in order, and then stops these
        ranks.
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
        """Fill the array `mine` of every rank with its piece of the arrays on rank 0."""
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
        """Return the arrays of all ranks, with given lengths, on rank 0."""
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
    """Reference to a shared object, held by rank 0."""

    def __init__(self, team: Team, key: int, local: Any) -> None:
        self.team = team
        self.key = key
        self.local = local

    def __call__(self, method: str, *sent: Any, here: tuple[Any, ...] = ()) -> Any:
        """Call a method on every rank, and return its result on rank 0."""
        return self.team.call(self.key, method, sent, here)

    def __del__(self) -> None:
        self.team.leave(self.key)


class _AllOrNone:
    """Context that aborts all ranks on an exception, since the others would wait forever.

    `LinearAlgebraError` is raised by all ranks alike, and is passed on.
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
    """Return all processes started by mpirun as a team; starts MPI and PETSc.

    Raises
    ------
    ConfigurationError
        petsc4py or mpi4py is not installed.
    """
    try:
        import petsc4py

        petsc4py.init([])
        from petsc4py import PETSc

        return Team(PETSc.COMM_WORLD.tompi4py())
    except ImportError as error:
        raise ConfigurationError(f"{MISSING} ({error})") from error
