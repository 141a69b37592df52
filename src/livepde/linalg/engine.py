"""Multi-process engine that takes precedence over the solvers of `choose`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

from livepde.linalg.pattern import Pattern
from livepde.linalg.protocol import Solver

__all__ = ["Engine", "in_use", "using"]


class Engine(Protocol):
    """Provider of solvers for large patterns while it is in use; see `livepde.parallel`."""

    @property
    def reason(self) -> str:
        """Reason of its choice, for `Choice`."""
        ...

    def solver(self, pattern: Pattern, *, symmetric: bool) -> Solver | None:
        """Return a solver for a pattern of large bandwidth; None defers to the rule of `choose`."""
        ...

    def build(self, function: Callable[..., Any], *args: Any, known: Any = None) -> Any:
        """Return the model `function(*args)`, or `known`; other processes may build it, too."""
        ...


_ENGINE: ContextVar[Engine | None] = ContextVar("engine", default=None)


@contextmanager
def using(engine: Engine) -> Iterator[None]:
    """Let `choose` ask this engine, in this thread and until the block ends."""
    token = _ENGINE.set(engine)
    try:
        yield
    finally:
        _ENGINE.reset(token)


def in_use() -> Engine | None:
    """Return the engine in use, if there is one."""
    return _ENGINE.get()
