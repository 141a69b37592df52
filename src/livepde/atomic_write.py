"""Atomic writes: a file appears complete or not at all, and a link at its path is not followed."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PARTIAL = ".partial"  # suffix of a file that is being written


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new temporary file next to a path, renamed to it if the block raises nothing.

    The file is created exclusively (O_EXCL) under a random name, so that neither a file nor a link
    of another process can be opened in its place. An existing file or symbolic link at the path is
    itself replaced.
    """
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise


def write_bytes(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a file atomically; with `sync` its content is flushed to disk before the rename."""
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        if sync:
            file.flush()
            os.fsync(file.fileno())
