"""Checkpoints: header and arrays in one buffer, without pickle, with a checksum.

The buffer is MAGIC, the length of a text, a digest of all that follows, the text, and the bytes of
the arrays one after the other, each begun at a multiple of ALIGNED. The text is JSON: the header,
and for each array its name, its type as NumPy writes it ("<f8"), and its shape.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from livepde.atomic_write import write_bytes
from livepde.errors import RunError
from livepde.linalg import Array

MAGIC = b"livepde1"
DIGEST = 16  # bytes
START = struct.Struct(f"<8sQ{DIGEST}s")
ALIGNED = 16  # bytes
MOST = 1 << 40  # values in one array
PLAIN = "biufcU"  # kinds of arrays that are plain numbers or text


def flatten(value: Any, prefix: str = "state") -> dict[str, Any]:
    """Return the leaves of nested dataclasses and tuples of arrays, keyed by dotted path."""
    leaves: dict[str, Any] = {}
    _gather(value, prefix, leaves)
    return leaves


def _gather(value: Any, prefix: str, leaves: dict[str, Any]) -> None:
    if isinstance(value, tuple):
        for k, item in enumerate(value):
            _gather(item, f"{prefix}.{k}", leaves)
        return
    kind: Any = type(value)
    parts = _parts(kind)
    if parts is None:
        leaves[prefix] = value
        return
    for name, _, _ in parts:
        _gather(getattr(value, name), f"{prefix}.{name}", leaves)


@lru_cache(maxsize=256)
def _parts(kind: type) -> tuple[tuple[str, int, bool], ...] | None:
    """Return name, axis that grows, and whether it restarts, of each field of a dataclass."""
    if not is_dataclass(kind):
        return None
    return tuple(
        (item.name, item.metadata.get("grows", 0), bool(item.metadata.get("begins_anew")))
        for item in fields(kind)
    )


def rebuild(
    template: Any, leaves: Mapping[str, Array], prefix: str = "state", grows: int = 0
) -> Any:
    """Return a value of the structure of `template`, with the given leaves.

    The first axis of an array may have another length (stored samples, active members), and so may
    the axis declared in the metadata of its field, as in field(metadata={"grows": 1}). A field with
    the metadata "begins_anew" is as in the template, with the length that may differ, if it was
    stored by something else: a verdict by a run that has kept none.
    """
    if isinstance(template, tuple):
        return tuple(
            rebuild(item, leaves, f"{prefix}.{k}", grows) for k, item in enumerate(template)
        )
    kind: Any = type(template)
    parts = _parts(kind)
    if parts is not None:
        found = {}
        for name, axis, anew in parts:
            part = _anew if anew else rebuild
            found[name] = part(getattr(template, name), leaves, f"{prefix}.{name}", axis)
        return kind(**found)
    array = leaves[prefix]
    if not isinstance(template, np.ndarray):
        return kind(array.item())
    if array.dtype != template.dtype:
        raise ValueError(f"{prefix} is of type {array.dtype}, needs {template.dtype}")
    if array.shape != template.shape and _others(array, grows) != _others(template, grows):
        raise ValueError(f"{prefix} has shape {array.shape}, needs {template.shape}")
    return array


def _anew(template: Any, leaves: Mapping[str, Array], prefix: str, grows: int) -> Any:
    try:
        return rebuild(template, leaves, prefix, grows)
    except ValueError:
        if not isinstance(template, np.ndarray):
            return template
        shape = list(template.shape)
        shape[grows] = leaves[prefix].shape[grows]
        return np.zeros(shape)


def _others(array: Array, axis: int) -> list[int]:
    """Return the lengths of all axes but the first and one more."""
    return [length for k, length in enumerate(array.shape) if k not in (0, axis)]


def packed(header: Mapping[str, Any], leaves: Mapping[str, Any]) -> bytes:
    """Return header and leaves as one buffer."""
    arrays = [np.asarray(leaf, order="C") for leaf in leaves.values()]
    described = zip(leaves, (a.dtype.str for a in arrays), (a.shape for a in arrays), strict=True)
    text = _text(json.dumps(dict(header)), tuple(described))
    # -n % ALIGNED bytes fill n up to the next multiple.
    parts: list[Any] = [text, bytes(-len(text) % ALIGNED)]
    for array in arrays:
        parts += [array, bytes(-array.nbytes % ALIGNED)]
    # Joined once: the states of a shard are large, and each copy would count in its memory.
    return b"".join([START.pack(MAGIC, len(text), _digest(*parts)), *parts])


def unpacked(content: bytes, where: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return header and leaves of a buffer; `where` names it in messages.

    Raises `RunError`: it is no checkpoint, or damaged.
    """
    try:
        magic, length, digest = START.unpack_from(content)
        body = memoryview(content)[START.size :]
        if magic != MAGIC or digest != _digest(body):
            raise ValueError("it begins or adds up otherwise")
        text = bytes(body[:length])
        header, described = _read(text)
        # One copy, since `content` cannot be written to: all arrays are views of it.
        numbers = bytearray(body[length + -length % ALIGNED :])
        leaves, at = {}, 0
        for name, kind, shape in described:
            array = np.ndarray(shape, kind, numbers, at)
            leaves[name] = array
            at += array.nbytes + -array.nbytes % ALIGNED
    except (struct.error, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise RunError(
            f"{where} is not a checkpoint of this version of livepde, or it is damaged: {error}."
        ) from error
    return dict(header), leaves


def _digest(*parts: Any) -> bytes:
    found = hashlib.blake2b(digest_size=DIGEST)
    for part in parts:
        found.update(part)
    return found.digest()


@lru_cache(maxsize=64)
def _text(header: str, described: tuple[tuple[str, str, tuple[int, ...]], ...]) -> bytes:
    """Return header and descriptions as text, cached: those of successive states repeat."""
    for name, kind, _ in described:
        if np.dtype(kind).kind not in PLAIN:
            raise TypeError(f"{name}: a checkpoint holds arrays of numbers and texts, not {kind}.")
    return f"[{header}, {json.dumps(described)}]".encode()


@lru_cache(maxsize=64)
def _read(text: bytes) -> tuple[dict[str, Any], list[tuple[str, np.dtype[Any], tuple[int, ...]]]]:
    """Return what `_text` has written, its types checked."""
    header, described = json.loads(text)
    found = []
    for name, kind, shape in described:
        dtype, lengths = np.dtype(str(kind)), tuple(int(length) for length in shape)
        if dtype.kind not in PLAIN or min(lengths, default=0) < 0 or math.prod(lengths) > MOST:
            raise ValueError(f"'{name}' is not an array of numbers")
        found.append((str(name), dtype, lengths))
    return dict(header), found


def write(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a checkpoint atomically: the file appears complete or not at all."""
    target = Path(path)
    try:
        write_bytes(target, content, sync=True)
    except OSError as error:
        raise RunError(
            f"Cannot write the checkpoint {target}: {error.strerror or error}; free disk space "
            "or check the folder."
        ) from error


def read(path: str | os.PathLike[str]) -> bytes:
    """Return the contents of a checkpoint file."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise RunError(
            f"{path} is not a checkpoint that can be read: {error.strerror or error}."
        ) from error
