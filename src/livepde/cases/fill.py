"""Values filled into the text of a case, whose comments stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import tomlkit
from tomlkit.items import InlineTable

from livepde.cases.read import apply, key_path, read_toml, spec_of, toml_key, toml_line
from livepde.errors import CaseError


def filled(text: str, settings: Mapping[str, Any], where: str) -> str:
    """Return the text of a case with other values: `read.apply`, and the comments stay.

    Parameters
    ----------
    settings
        Key -> value; None takes the key away.
    where
        For messages.

    Raises
    ------
    CaseError
        A key that cannot be set.
    """
    for key, value in settings.items():
        expected = apply(read_toml(text, where), {key: value}, where)
        text = _with(text, key_path(key, where), value)
        if _without_empty(read_toml(text, where)) != _without_empty(expected):
            raise CaseError(f"{where}: {key}: cannot be set here; edit the file instead.")
    if settings:
        spec_of(read_toml(text, where), where)
    return text


def _without_empty(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document without its empty tables, which consist of a head only."""
    return {name: value for name, value in document.items() if value != {}}


def _with(text: str, path: Sequence[str], value: Any) -> str:
    """Return a case with another value of a key, whose comment stays; None takes the key away."""
    document = tomlkit.parse(text)
    here: Any = document
    *tables, name = path
    for k, part in enumerate(tables):
        inner = here.get(part, {})
        if isinstance(inner, InlineTable):  # written anew as a whole, evenly spaced
            rest = ".".join(map(toml_key, path[k + 1 :]))
            name, value = part, apply(inner.unwrap(), {rest: value}, "")
            break
        if not isinstance(inner, Mapping) or part not in here:
            here[part] = tomlkit.table()
        here = here[part]
    if value is None:
        here.pop(name, None)
    else:
        here[name] = tomlkit.parse(toml_line("x", value))["x"]
    return tomlkit.dumps(document)
