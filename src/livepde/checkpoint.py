"""Checkpoint files: a NumPy archive of plain arrays, without pickle, written atomically."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from livepde.atomic_write import write_bytes
from livepde.errors import RunError
from livepde.linalg import Array

__all__ = ["flatten", "packed", "read", "rebuild", "unpacked", "write"]

# Exceptions of reading a file that is no archive, is damaged, or was crafted to do harm.
DAMAGE = (
    EOFError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    OverflowError,
    RecursionError,
    SyntaxError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
)


def flatten(value: Any, prefix: str = "state") -> dict[str, Any]:
    """Return the leaves of nested dataclasses and tuples of arrays, keyed by dotted path."""
    if isinstance(value, tuple):
        parts = [flatten(item, f"{prefix}.{k}") for k, item in enumerate(value)]
        return {path: leaf for part in parts for path, leaf in part.items()}
    if not is_dataclass(value) or isinstance(value, type):
        return {prefix: value}
    leaves: dict[str, Any] = {}
    for item in fields(value):
        leaves |= flatten(getattr(value, item.name), f"{prefix}.{item.name}")
    return leaves


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
    if is_dataclass(template) and not isinstance(template, type):
        parts = {
            item.name: _part(item, getattr(template, item.name), leaves, f"{prefix}.{item.name}")
            for item in fields(template)
        }
        return type(template)(**parts)
    array = leaves[prefix]
    if not isinstance(template, np.ndarray):
        return type(template)(array.item())
    if _others(array, grows) != _others(template, grows):
        raise ValueError(f"{prefix} has shape {array.shape}, needs {template.shape}")
    return array


def _part(item: Field[Any], template: Any, leaves: Mapping[str, Array], prefix: str) -> Any:
    grows = item.metadata.get("grows", 0)
    if not item.metadata.get("begins_anew"):
        return rebuild(template, leaves, prefix, grows)
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
    """Return an archive of header and leaves as bytes."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", allowZip64=True) as members:
        for name, leaf in {"header": json.dumps(dict(header)), **leaves}.items():
            array = np.asarray(leaf, order="C")
            content = _array_header(array.dtype.str, array.shape) + array.tobytes()
            members.writestr(zipfile.ZipInfo(f"{name}.npy"), content)
    return archive.getvalue()


@lru_cache(maxsize=4096)
def _array_header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """Return the header of an array in NumPy's format, cached: most arrays of a state repeat it."""
    header = io.BytesIO()
    about = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, about)
    return header.getvalue()


def unpacked(content: bytes, where: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return header and leaves of an archive; `where` names it in messages."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            _refuse_bombs(archive.zip.infolist(), len(content))
            leaves = {name: archive[name] for name in archive.files}
        header: dict[str, Any] = dict(json.loads(str(leaves.pop("header"))))
    except DAMAGE as error:
        raise RunError(
            f"{where} is not a checkpoint of livepde, or it is damaged: {error}."
        ) from error
    return header, leaves


def _refuse_bombs(members: Iterable[zipfile.ZipInfo], size: int) -> None:
    """Reject an archive that expands beyond its size (zip bomb): `packed` never compresses."""
    for member in members:
        if member.compress_type != zipfile.ZIP_STORED or member.file_size > size:
            raise ValueError(f"{member.filename} is compressed")


def write(path: str | os.PathLike[str], content: bytes) -> None:
    """Write an archive atomically: the file appears complete or not at all."""
    target = Path(path)
    try:
        write_bytes(target, content, sync=True)
    except OSError as error:
        raise RunError(
            f"Cannot write the checkpoint {target}: {error.strerror or error}; make room or mend "
            "the folder."
        ) from error


def read(path: str | os.PathLike[str]) -> bytes:
    """Return the contents of an archive file."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise RunError(
            f"{path} is not a checkpoint that can be read: {error.strerror or error}."
        ) from error
