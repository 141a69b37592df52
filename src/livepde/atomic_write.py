"""Files that appear whole or not at all, and never where a link leads."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["PARTIAL", "replacing", "write_bytes"]

PARTIAL = ".partial"  # how the name of a file ends that is being written


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new file of its own beside a path, which takes the name when all went well.

    Nobody else can have made it, nor a link of its name: it is made exclusively, with a random
    name. What stands at the path, a link also, is replaced itself.
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
    """Write a file; with `sync` it is on disk before it has its name."""
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        if sync:
            file.flush()
            os.fsync(file.fileno())
