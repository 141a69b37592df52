"""Points between substeps at which a long computation can be interrupted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

# A variable of the context, not of a control: a refit in its own thread is not interrupted.
CHECK: ContextVar[Callable[[], None] | None] = ContextVar("livepde_interruption", default=None)


def safe_point() -> None:
    """Call the function of `interruptible`, if there is one; called before each substep."""
    check = CHECK.get()
    if check is not None:
        check()


@contextmanager
def interruptible(check: Callable[[], None]) -> Iterator[None]:
    """Let a function be called before each substep; what it raises ends the computation."""
    token = CHECK.set(check)
    try:
        yield
    finally:
        CHECK.reset(token)
