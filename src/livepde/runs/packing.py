"""Encoding of the fields of a journal as bytes, and of its layout as text."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.linalg import Array
from livepde.records import Layout, Snapshot

if TYPE_CHECKING:
    from pydantic import TypeAdapter

__all__ = ["layout_from", "packed", "unpacked"]


def packed(snapshot: Snapshot) -> bytes:
    """Return a snapshot as names and sizes in JSON, a zero byte, and the numbers."""
    arrays = dict(snapshot.profiles)
    head: dict[str, Any] = {"told": snapshot.told, "left_out": snapshot.left_out}
    head["profiles"] = {name: len(values) for name, values in arrays.items()}
    body = [values.tobytes() for values in arrays.values()]
    if snapshot.correlation is not None:
        head["correlation"] = len(snapshot.correlation)
        body.append(snapshot.correlation.tobytes())
    # JSON has no zero byte, so that the first one ends it.
    return json.dumps(head).encode() + b"\0" + b"".join(body)


def unpacked(content: bytes) -> Snapshot:
    """Return the snapshot in the bytes of `packed`; raises one of many errors on other bytes."""
    text, body = content.split(b"\0", 1)
    head = json.loads(text)
    sizes = [*head["profiles"].values()]
    n = head.get("correlation")
    numbers = np.frombuffer(body)
    if len(numbers) != sum(sizes) + (n or 0) ** 2:
        raise ValueError("fields of another size than they say")
    *parts, rest = np.split(numbers, np.cumsum(sizes))
    told = {name: (float(told), int(count)) for name, (told, count) in head["told"].items()}
    correlation: Array | None = None if n is None else rest.reshape(n, n)
    left_out = {str(name): float(share) for name, share in head.get("left_out", {}).items()}
    return Snapshot(dict(zip(head["profiles"], parts, strict=True)), told, correlation, left_out)


def layout_from(text: str) -> Layout:
    """Return a layout from JSON, its types checked."""
    return _layouts().validate_json(text)


@cache
def _layouts() -> TypeAdapter[Layout]:
    from pydantic import TypeAdapter

    return TypeAdapter(Layout)
