"""Mutations that turn a valid row into a malformed one."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any, TypeAlias

import numpy as np

from benchmarks.faults.rod import Row

LONG_ONES = 0.02  # share of the drawn lines of 2 MB that are written

Break: TypeAlias = Callable[[Row, Callable[[Row], bytes], np.random.Generator], bytes]


def broken_line(
    breaks: Mapping[str, Break],
    row: Row,
    write: Callable[[Row], bytes],
    rng: np.random.Generator,
) -> tuple[str, bytes]:
    """Draw a kind of mutation; return it with a mutated line, never blank and rarely very long."""
    kind = one_of([*breaks])(rng)
    if kind == "very long" and rng.random() > LONG_ONES:
        kind = "truncated"
    line = breaks[kind](row, write, rng).replace(b"\n", b"?")
    return kind, line if line.strip() else b"?"


def json_line(row: Row) -> bytes:
    """Return a row as a line of JSON."""
    return json.dumps(dict(row)).encode()


def csv_line(row: Row) -> bytes:
    """Return a row as a line of CSV."""
    return ",".join(map(str, row.values())).encode()


def one_of(options: Sequence[Any]) -> Callable[[np.random.Generator], Any]:
    """Return a function that draws one of `options`."""
    return lambda rng: options[int(rng.integers(len(options)))]


def _value(*options: Any) -> Break:
    """Return a mutation that replaces the numbers in one column or all by one of `options`."""
    choose = one_of(options)

    def broken(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
        _, *names = row
        chosen = names if rng.random() < 0.3 else [one_of(names)(rng)]
        return write({**row, **{name: choose(rng) for name in chosen}})

    return broken


def _time(*options: Any) -> Break:
    """Return a mutation that replaces the time by one of `options`."""
    choose = one_of(options)

    def broken(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
        return write({**row, next(iter(row)): choose(rng)})

    return broken


def _ahead(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    """Move the time ahead by a hundred to some thousand years."""
    name = next(iter(row))
    moment = datetime.fromisoformat(row[name])
    years = float(10.0 ** rng.uniform(2.0, 3.8))
    return write({**row, name: str(moment + timedelta(days=365.0 * years))})


def _truncated(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    text = write(row)
    return text[: int(rng.integers(1, len(text)))]


def _spoilt(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    """Insert invalid UTF-8 at a random place."""
    text = write(row)
    k = int(rng.integers(0, len(text)))
    wrong: bytes = one_of((b"\xff", b"\xc3\x28", b"\xed\xa0\x80", b"\xfe"))(rng)
    return text[:k] + wrong + text[k:]


def _noise(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(1, 300)))


def _long(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    return write({**row, [*row][-1]: "9" * 2_000_000})


BYTES: dict[str, Break] = {
    "truncated": _truncated,
    "invalid UTF-8": _spoilt,
    "binary": _noise,
    "very long": _long,
    "text": _value("warm", "?", "nan K", "1,5", "--", "None of it", "0x1F", "1e", "[]"),
    "unit": _value("12.5 K", "3 m/s", "20 degC", "1e-3bar"),
    "infinite": _value("inf", "-Infinity", "1e400", "9" * 400),
    "time": _time("", "?", "now", "2026-13-45 00:00", "25:61", "nan", "inf", "2026-01-01T"),
    "far ahead": _ahead,
    "long ago": _time("1970-01-01", "0001-01-01 00:00:00", "1999-12-31 23:59:59+14:00"),
}
CSV: dict[str, Break] = {
    "too many fields": lambda row, write, rng: write(row) + b"," * int(rng.integers(1, 50)) + b"1",
    "other separator": lambda row, write, rng: write(row).replace(b",", b";"),
    "quotes": lambda row, write, rng: write(row).replace(b",", b',"', int(rng.integers(1, 4))),
    "zero bytes": lambda row, write, rng: write(row).replace(b",", b"\0,"),
    "nested": _value('"{""a"": [1, {""b"": 2}]}"'),
}
JSON: dict[str, Break] = {
    "types": _value([], {}, True, False, [1.5], {"value": 1.5}, [[[]]]),
    "huge": _value(10**400, -(10**4000), int("9" * 4200)),
    "time types": _time(None, True, [], {}, 1e300, -5.0, 10**400, ["2026-01-01"]),
    "no time": lambda row, write, rng: write(dict([*row.items()][1:])),
    "no values": lambda row, write, rng: write(dict([*row.items()][:1])),
    "not finite": lambda row, write, rng: write(row).replace(b": ", b': -Infinity, "x": ', 9),
    "duplicate keys": lambda row, write, rng: write(row)[:-1] + b", " + write(row)[1:],
    "nested object": lambda row, write, rng: write({"row": dict(row)}),
    "deep": lambda row, write, rng: one_of((b"[", b'{"a":'))(rng) * int(rng.integers(1, 5000)),
    "no object": lambda row, write, rng: one_of((b"[]", b"1", b"null", b'"a"', b"{}", b"NaN"))(rng),
    "surrogates": lambda row, write, rng: write({**row, [*row][-1]: "\ud800", "\udfff": 1}),
}
