"""Checkpoints: header and arrays in one buffer, without pickle, with a checksum.

The buffer consists of MAGIC, the length of a text, a digest of all that follows, the text, and the
bytes of the arrays, each at a multiple of ALIGNED. The text is JSON: the header, and the name, type
in NumPy's notation ("<f8") and shape of each array.

A checkpoint contains the fingerprint of its problem. Digests of matrices would differ between
machines, whose sums round differently. Therefore the fingerprint consists of a few numbers for each
part: model, priors and sensors are evaluated at fixed states, parameters and times, and the results
are summed with fixed weights. Two builds of one problem agree to rounding, different problems
differ.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from livepde.atomic_write import write_bytes
from livepde.errors import RunError
from livepde.fem import Inputs, Moment
from livepde.laws import AnyLaw, Problem
from livepde.linalg import Array, nonfinite_allowed
from livepde.model import Model
from livepde.observation import Observed

MAGIC = b"livepde1"
DIGEST = 16  # bytes
START = struct.Struct(f"<8sQ{DIGEST}s")
ALIGNED = 16  # bytes
MOST = 1 << 40  # values in one array
FEW = 4  # cached descriptions, of about 200 KiB each; those of growing states differ
PLAIN = "biufcU"  # kinds of NumPy types that are numbers or text


def flatten(value: Any, prefix: str = "state") -> dict[str, Any]:
    """Return the leaves of nested dataclasses and tuples of arrays, keyed by dotted path."""
    parts: dict[Any, Any] = {}
    kind: Any = type(value)
    if isinstance(value, tuple):
        parts = dict(enumerate(value))
    elif (names := _field_rules(kind)) is not None:
        parts = {name: getattr(value, name) for name, _, _ in names}
    else:
        return {prefix: value}
    leaves: dict[str, Any] = {}
    for name, part in parts.items():
        leaves |= flatten(part, f"{prefix}.{name}")
    return leaves


@lru_cache(maxsize=256)
def _field_rules(kind: type) -> tuple[tuple[str, int, bool], ...] | None:
    """Return the name, growing axis and `begins_anew` of each field of a dataclass, or None."""
    if not is_dataclass(kind):
        return None
    return tuple(
        (item.name, item.metadata.get("grows", 0), bool(item.metadata.get("begins_anew")))
        for item in fields(kind)
    )


def rebuild(
    template: Any, leaves: Mapping[str, Array], prefix: str = "state", grows: int = 0
) -> Any:
    """Return a value with the structure of `template` and the given leaves.

    The length of the first axis of an array may differ (stored samples, active members), and so may
    the axis declared in the metadata of its field, as in field(metadata={"grows": 1}). If a field
    with the metadata "begins_anew" does not fit, as a ledger stored by a run without a verdict, the
    value of the template is used, or zeros of the stored length.
    """
    if isinstance(template, tuple):
        return tuple(
            rebuild(item, leaves, f"{prefix}.{k}", grows) for k, item in enumerate(template)
        )
    kind: Any = type(template)
    rules = _field_rules(kind)
    if rules is not None:
        values = {}
        for name, axis, lenient in rules:
            restore = _or_template if lenient else rebuild
            values[name] = restore(getattr(template, name), leaves, f"{prefix}.{name}", axis)
        return kind(**values)
    array = leaves[prefix]
    if not isinstance(template, np.ndarray):
        return kind(array.item())
    if array.dtype != template.dtype:
        raise ValueError(f"{prefix} is of type {array.dtype}, needs {template.dtype}")
    if array.shape != template.shape and _fixed_axes(array, grows) != _fixed_axes(template, grows):
        raise ValueError(f"{prefix} has shape {array.shape}, needs {template.shape}")
    return array


def _or_template(template: Any, leaves: Mapping[str, Array], prefix: str, grows: int) -> Any:
    try:
        return rebuild(template, leaves, prefix, grows)
    except ValueError:
        if not isinstance(template, np.ndarray):
            return template
        shape = list(template.shape)
        shape[grows] = leaves[prefix].shape[grows]
        return np.zeros(shape)


def _fixed_axes(array: Array, axis: int) -> list[int]:
    """Return the lengths of all axes except the first and `axis`."""
    return [length for k, length in enumerate(array.shape) if k not in (0, axis)]


def packed(header: Mapping[str, Any], leaves: Mapping[str, Any]) -> bytes:
    """Return a buffer that contains header and leaves."""
    arrays = [np.asarray(leaf, order="C") for leaf in leaves.values()]
    layouts = zip(leaves, (a.dtype.str for a in arrays), (a.shape for a in arrays), strict=True)
    text = _text(json.dumps(dict(header)), tuple(layouts))
    # -n % ALIGNED bytes pad n bytes to the next multiple.
    chunks: list[Any] = [text, bytes(-len(text) % ALIGNED)]
    for array in arrays:
        chunks += [array, bytes(-array.nbytes % ALIGNED)]
    # A single join avoids copies of the states of a shard, which are large.
    return b"".join([START.pack(MAGIC, len(text), _digest(*chunks)), *chunks])


def unpacked(content: bytes, where: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return header and leaves of a buffer; `where` names it in messages.

    Raises `RunError`: the buffer is not a checkpoint, or it is damaged.
    """
    try:
        magic, length, digest = START.unpack_from(content)
        body = memoryview(content)[START.size :]
        if magic != MAGIC or digest != _digest(body):
            raise ValueError("it begins or adds up otherwise")
        text = bytes(body[:length])
        header, layouts = _read(text)
        # All arrays are views of one copy, since `content` is read-only.
        data = bytearray(body[length + -length % ALIGNED :])
        leaves, offset = {}, 0
        for name, kind, shape in layouts:
            array = np.ndarray(shape, kind, data, offset)
            leaves[name] = array
            offset += array.nbytes + -array.nbytes % ALIGNED
    except (struct.error, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise RunError(
            f"{where} is not a checkpoint of this version of livepde, or it is damaged: {error}."
        ) from error
    return dict(header), leaves


def _digest(*parts: Any) -> bytes:
    digest = hashlib.blake2b(digest_size=DIGEST)
    for chunk in parts:
        digest.update(chunk)
    return digest.digest()


@lru_cache(maxsize=FEW)
def _text(header: str, layouts: tuple[tuple[str, str, tuple[int, ...]], ...]) -> bytes:
    """Return header and array descriptions as text, cached since successive states repeat them."""
    for name, kind, _ in layouts:
        if np.dtype(kind).kind not in PLAIN:
            raise TypeError(f"{name}: a checkpoint holds arrays of numbers and texts, not {kind}.")
    return f"[{header}, {json.dumps(layouts)}]".encode()


@lru_cache(maxsize=FEW)
def _read(text: bytes) -> tuple[dict[str, Any], list[tuple[str, np.dtype[Any], tuple[int, ...]]]]:
    """Return header and array descriptions from a text of `_text`, after validating types."""
    header, layouts = json.loads(text)
    validated = []
    for name, kind, shape in layouts:
        dtype, lengths = np.dtype(str(kind)), tuple(int(length) for length in shape)
        if dtype.kind not in PLAIN or min(lengths, default=0) < 0 or math.prod(lengths) > MOST:
            raise ValueError(f"'{name}' is not an array of numbers")
        validated.append((str(name), dtype, lengths))
    return dict(header), validated


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


Place: TypeAlias = tuple[Array, Array, Moment]  # latent parameter, state and time
ROUNDING = 1e-8  # relative tolerance: far above effects of summation order, far below real changes
TIMES = (0.37, 1.91)
SUMS = 2  # number of weighted sums of each vector
PREFIX = "built."  # prefix of the leaves of the fingerprint

NAMES = {
    "law": "option of the law",
    "steps": "scheme, dt_max, halvings, between or input_noise",
    "unknowns": "prior, evolution or bounds of an unknown",
    "start": "u0 or q0",
    "model": "model: its equation, mesh, source or boundary values",
    "sensors": "sensor: its place, function or noise",
}
# Model and sensors are evaluated at the start and near it: they are only comparable if the start is
# the same.
EVALUATED = ("model", "sensors")


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """Texts and numbers that identify each part of a problem.

    `texts`: options of each part, with a placeholder for each number. `numbers`: the numbers of
    each part and the magnitudes of their terms, shape (numbers, 2).
    """

    texts: Mapping[str, str]
    numbers: Mapping[str, Array]

    @property
    def leaves(self) -> dict[str, Any]:
        """Leaves for a checkpoint."""
        texts = {f"{PREFIX}{part}.text": np.array(text) for part, text in self.texts.items()}
        return texts | {f"{PREFIX}{part}": values for part, values in self.numbers.items()}

    def differing(self, leaves: Mapping[str, Array]) -> str:
        """Return a description of the differences from a checkpoint; empty if there are none."""
        differ = [part for part in NAMES if not self._unchanged(part, leaves)]
        if {"unknowns", "start"} & set(differ):
            differ = [part for part in differ if part not in EVALUATED]
        return ", and another ".join(NAMES[part] for part in differ)

    def of_members(
        self, q0: Sequence[Array], u0: Sequence[Array], errors: Sequence[Array]
    ) -> Fingerprint:
        """Return the fingerprint of a fleet, from initial parameters and states of its members.

        `errors`: errors of each initial state, shape (errors, n) each.
        """
        stacked = [np.concatenate([np.ravel(array) for array in part]) for part in (q0, u0, errors)]
        start = np.concatenate(_start_sums(*stacked))
        return replace(self, numbers={**self.numbers, "start": start})

    def _unchanged(self, part: str, leaves: Mapping[str, Array]) -> bool:
        text, numbers = leaves.get(f"{PREFIX}{part}.text"), leaves.get(f"{PREFIX}{part}")
        if text is None or numbers is None or str(text) != self.texts[part]:
            return False
        return _equal_sums(self.numbers[part], numbers)


def _equal_sums(first: Array, second: Array) -> bool:
    """Return whether sums agree to rounding of their terms, and the same sums are not finite."""
    if first.shape != second.shape:
        return False
    finite = np.isfinite(first).all(axis=1)
    if not np.array_equal(finite, np.isfinite(second).all(axis=1)):
        return False
    a, b = first[finite], second[finite]
    size = np.maximum(a[:, 1], b[:, 1])
    return bool((np.abs(a - b) <= ROUNDING * size[:, None]).all())


@nonfinite_allowed()  # the test states may be unphysical
def fingerprint(
    law: AnyLaw, problem: Problem, validation: Observed | None, q0: Array, u0: Array
) -> Fingerprint:
    """Return the fingerprint of an identifier.

    `q0`, `u0`: latent parameters and state at the start, without boundary values.
    """
    model, places = problem.model, _places(problem, q0, u0)
    physical_places = [(model.latent.value(q), u, at) for q, u, at in places]
    control = replace(problem.control, start=math.nan)
    sensors = [problem.observed] if validation is None else [problem.observed, validation]
    process = [_sums(model.mass @ _weights(model.X.dim)), _sums(model.X.free.astype(float))]
    sensor_sums: list[Array] = []
    for observed in sensors:
        noise = _sums(np.zeros(0) if observed.noise is None else observed.noise)
        sensor_sums += [noise, *_function_sums(OF_SENSORS, observed, physical_places)]
    options = [
        (part.name, part.size, part.unknown.prior, part.evolution)
        for part in model.latent.parts.values()
    ]
    identifying: dict[str, tuple[Any, Iterable[Array]]] = {
        "model": ((model.channels, model.X.dim), process + _function_sums(OF_MODEL, model, places)),
        "unknowns": (options, _prior_sums(model)),
        "sensors": ([observed.names for observed in sensors], sensor_sums),
        "law": (law, ()),
        "steps": ((control, problem.input_noise), ()),
        "start": ((), _start_sums(q0, u0, problem.initial_errors)),
    }
    texts, numbers = {}, {}
    for part, (stated_options, sums) in identifying.items():
        values: list[float] = []
        texts[part] = _described(stated_options, values)
        value_rows = np.array([(value, abs(value)) for value in values]).reshape(-1, 2)
        numbers[part] = np.concatenate([value_rows, *sums])
    return Fingerprint(texts, numbers)


def _start_sums(q0: Array, u0: Array, errors: Array) -> list[Array]:
    """Return sums of q0, of u0 and, if there are any, of the errors of u0."""
    return [_sums(q0), _sums(u0), *([_sums(errors.ravel())] if errors.size else [])]


def _sums(values: Any) -> Array:
    """Return weighted sums of each column of an array and their magnitudes, shape (sums, 2)."""
    rows = np.asarray(values, dtype=float)
    rows = rows.reshape(len(rows), -1).T if rows.ndim > 1 else rows[None]
    weights = _weights(rows.shape[1])
    return np.stack([rows @ weights, np.abs(rows) @ np.abs(weights)], axis=-1).reshape(-1, 2)


def _weights(size: int) -> Array:
    """Return fixed, pairwise different weights, shape (size, SUMS)."""
    return np.cos(np.outer(1.0 + np.arange(size), np.sqrt([2.0, 3.0])[:SUMS]))


def _places(problem: Problem, q0: Array, u0: Array) -> list[Place]:
    """Return two points of evaluation: the start, and parameters and state near it."""
    inputs = Inputs({name: 1.0 + 0.3 * k for k, name in enumerate(problem.channels)})
    moment1, moment2 = (Moment(t, inputs) for t in TIMES)
    u = u0 + 0.1 * max(1.0, float(np.abs(u0).max(initial=0.0))) * _weights(len(u0))[:, 0]
    q = q0.copy()
    for part in problem.model.latent.parts.values():
        q[part.part] += 0.3 * part.unknown.prior.latent_std
    return [(q0, u0, moment1), (q, u, moment2)]


OF_MODEL: tuple[Callable[..., Any], ...] = (
    lambda model, q, u, at: model.initial_state(q, at),
    lambda model, q, u, at: model.impose(np.zeros_like(u), at),
    lambda model, q, u, at: model.B(u, at),
    lambda model, q, u, at: model.form_F.vector("v", at),
    lambda model, q, u, at: model.form_A.vector("v", at, u=u, q=q),
    lambda model, q, u, at: model.A(u, at, q).matrix @ _weights(len(q)),
)
OF_SENSORS: tuple[Callable[..., Any], ...] = (
    lambda sensors, q, u, at: sensors.predict(u, q, at),
    lambda sensors, q, u, at: sensors.jacobian(u, q, at)[0] @ _weights(len(u)),
)


def _function_sums(
    functions: Iterable[Callable[..., Any]], subject: Model | Observed, places: Iterable[Place]
) -> list[Array]:
    """Return sums of the functions of a model or of sensors at each place."""
    return [_sums_or_nan(function, subject, *place) for place in places for function in functions]


def _prior_sums(model: Model) -> Iterator[Array]:
    """Iterate over sums of the priors of the unknowns."""
    latent = model.latent
    yield _sums(latent.prior)
    yield _sums(model.Q.dual(_weights(len(latent.prior))[:, 0]))
    for bound in latent.bounds:
        yield _sums(np.isfinite(bound).astype(float))
        yield _sums(np.where(np.isfinite(bound), bound, 0.0))


def _sums_or_nan(function: Callable[..., Any], *arguments: Any) -> Array:
    """Return the sums of the values of a function; NaN if it raises an error."""
    try:
        return _sums(function(*arguments))
    except Exception:  # noqa: BLE001  a form may raise any error; it is the same in each build
        return np.full((1, 2), np.nan)


def _described(value: Any, numbers: list[float]) -> str:
    """Return options as text with a placeholder for each number, and append it to `numbers`.

    Functions are not part of the text: the numbers of their part contain their values.
    """
    if isinstance(value, bool | str | None):
        return repr(value)
    if isinstance(value, int | float | np.number):
        numbers.append(float(value))
        return "#"
    if isinstance(value, np.ndarray):
        numbers.extend(np.asarray(value, dtype=float).ravel().tolist())
        return f"#{value.shape}"
    if isinstance(value, Mapping):
        parts = [f"{name}: {_described(item, numbers)}" for name, item in value.items()]
    elif isinstance(value, Sequence):
        parts = [_described(item, numbers) for item in value]
    else:
        parts = [f"{name}={_described(item, numbers)}" for name, item in _options(value)]
    return f"{type(value).__name__}({', '.join(parts)})"


def _options(value: Any) -> list[tuple[str, Any]]:
    """Return names and values of the options of a dataclass, without `begins_anew` fields."""
    if is_dataclass(value):
        settings = [item for item in fields(value) if not item.metadata.get("begins_anew")]
        return [(item.name, getattr(value, item.name)) for item in settings if item.init]
    return []
