"""Single values of a case set from outside: by --set, and by the variants of a case."""

from __future__ import annotations

import copy
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from datetime import date, time
from typing import Any

from livepde.cases.read import did_you_mean
from livepde.errors import CaseError

__all__ = ["apply", "key_path", "parse", "to_toml", "toml_line"]

NAMED = ("unknowns", "channels")  # tables whose members are the case's own
BARE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")


def parse(assignments: Iterable[str]) -> dict[str, Any]:
    """Return key -> value of texts such as 'law.noise=2 K'; values are TOML, or else text.

    >>> parse(["law.noise=2 K", "data.every=2", "expect="])
    {'law.noise': '2 K', 'data.every': 2, 'expect': None}
    """
    found: dict[str, Any] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not (equals and key.strip()):
            raise CaseError(f"--set {text}: expected key=value, as law.memory='3 d'.")
        if not value.strip():
            found[key.strip()] = None
            continue
        try:
            (found[key.strip()],) = tomllib.loads(f"value = {value}").values()
        except (tomllib.TOMLDecodeError, ValueError):
            found[key.strip()] = value.strip()
    return found


def apply(document: Mapping[str, Any], settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a case's document with other values.

    Parameters
    ----------
    document
        The parsed case.
    settings
        Key as the file would have it, 'law.noise' or 'unknowns.k.regions."0-1"' -> value. A table
        sets the keys in it and leaves the others; None takes the key away.
    where
        For messages.

    Raises
    ------
    CaseError
        A key that is none, or an unknown, a channel or a key to take away that the case has not.
    """
    changed = copy.deepcopy(dict(document))
    for key, given in settings.items():
        for path, value in _leaves(key_path(key, where), given):
            here = changed
            for k, part in enumerate(path[:-1]):
                if k == 1 and path[0] in NAMED and part not in here:
                    raise CaseError(
                        f"{where}: {'.'.join(path)}: the case has no '{path[0]}.{part}'; "
                        f"{did_you_mean(part, here)}"
                    )
                if not isinstance(here.get(part), dict):
                    here[part] = {}
                here = here[part]
            if value is not None:
                here[path[-1]] = value
            elif here.pop(path[-1], None) is None:
                raise CaseError(
                    f"{where}: there is no key '{'.'.join(path)}' to take away; "
                    f"{did_you_mean(path[-1], here)}"
                )
    return changed


def key_path(key: str, where: str) -> tuple[str, ...]:
    """Return the keys of 'law.noise' as `--set` takes them; raises `CaseError`."""
    try:
        here: Any = tomllib.loads(f"{key} = 0")
    except tomllib.TOMLDecodeError:
        raise CaseError(f"{where}: '{key}' is no key; expected one as 'law.noise'.") from None
    path = []
    while isinstance(here, dict):
        ((name, here),) = here.items()
        path.append(name)
    return tuple(path)


def _leaves(path: tuple[str, ...], value: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from _leaves((*path, name), item)
    else:
        yield path, value


def to_toml(document: Mapping[str, Any]) -> str:
    """Return a document as TOML.

    >>> print(to_toml({"title": "a", "mesh": {"from": 0, "x": [1.0, 2.0]}}), end="")
    title = "a"
    <BLANKLINE>
    [mesh]
    from = 0
    x = [1.0, 2.0]
    """
    plain = {key: value for key, value in document.items() if not isinstance(value, dict)}
    lines = [toml_line(key, value) for key, value in plain.items()]
    for name, table in document.items():
        if name not in plain:
            lines += ["", f"[{_key(name)}]"]
            lines += [toml_line(key, value) for key, value in table.items()]
    return "\n".join(lines) + "\n"


def toml_line(key: str, value: Any) -> str:
    """Return a key and its value as a line of TOML.

    >>> toml_line("T 1", {"role": "sensor", "at": 0.5})
    '"T 1" = { role = "sensor", at = 0.5 }'
    """
    return f"{_key(key)} = {_value(value)}"


def _key(name: str) -> str:
    return name if name and BARE.issuperset(name) else _text(name)


def _text(value: str) -> str:
    """Return a basic string of TOML, with only the characters escaped that need it."""
    escapes = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}
    shown = (escapes.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in value)
    return f'"{"".join(shown)}"'


def _value(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return _text(value)
        case date() | time():
            return value.isoformat()
        case float():
            return repr(value) if math.isfinite(value) else str(value)
        case Mapping():
            items = (toml_line(key, item) for key, item in value.items())
            return "{ " + ", ".join(items) + " }" if value else "{}"
        case list():
            return "[" + ", ".join(map(_value, value)) + "]"
    return str(value)
