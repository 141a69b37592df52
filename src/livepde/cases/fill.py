"""Values filled into the text of a case, whose comments stay."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from livepde.cases.read import apply, is_blank, key_path, read_toml, spec_of, toml_line
from livepde.errors import CaseError

__all__ = ["Blank", "blanks", "filled", "with_channel"]


@dataclass(frozen=True)
class Blank:
    """A value of a case that is still to be filled in.

    Attributes
    ----------
    path
        Its keys, as ("channels", "T_1", "at").
    value
        The placeholder: "? m", or a list that holds one.
    comment
        The comment of its line.
    """

    path: tuple[str, ...]
    value: Any
    comment: str

    @property
    def key(self) -> str:
        """The keys as `--set` takes them."""
        return ".".join(self.path)

    @property
    def unit(self) -> str:
        """The unit that stands beside the question mark; empty if there is none."""
        marks = self.value if isinstance(self.value, list) else [self.value]
        return next((mark.partition(" ")[2] for mark in marks if is_blank(mark)), "")


@dataclass(frozen=True)
class _Line:
    """A line of a case that gives a value: keys with those of its table, value and comment."""

    number: int
    path: tuple[str, ...]
    value: Any
    comment: str


def blanks(text: str) -> list[Blank]:
    """Return the blanks in the text of a case, line by line."""
    found = []
    for line in _values(text):
        given = line.value if isinstance(line.value, Mapping) else {"": line.value}
        for name, value in given.items():
            if is_blank(value):
                path = (*line.path, name) if name else line.path
                found.append(Blank(path, value, line.comment))
    return found


def filled(text: str, settings: Mapping[str, Any], where: str) -> str:
    """Return the text of a case with other values: `settings.apply`, and the comments stay.

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
            raise CaseError(f"{where}: {key}: cannot be set here; edit the file in its place.")
    if settings:
        spec_of(read_toml(text, where), where)
    return text


def with_channel(text: str, name: str, given: Mapping[str, Any]) -> str:
    """Return the text of a case with one more channel."""
    return _with(text, ("channels", name), given)


def _without_empty(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document without its empty tables, which are there with a head of their own only."""
    return {name: value for name, value in document.items() if value != {}}


def _with(text: str, path: tuple[str, ...], value: Any) -> str:
    """Return a case with another value of a key, in the line that has it or in one of its own."""
    lines = text.splitlines()
    for line in _values(text):
        inside = isinstance(line.value, dict) and path[: len(line.path)] == line.path
        if line.path == path:
            new = value
        elif inside and len(path) == len(line.path) + 1:
            new = {**line.value, path[-1]: value}
            new = {name: item for name, item in new.items() if item is not None}
        else:
            continue
        # A key with dots is written as it was: the keys before the value of the same line.
        key, shown = lines[line.number].partition(" = ")[0], toml_line("x", new)
        comment = f"  {line.comment}" if line.comment else ""
        replaced = [] if new is None else [f"{key} = {shown.partition(' = ')[2]}{comment}"]
        lines[line.number : line.number + 1] = replaced
        return "\n".join(lines) + "\n"
    if value is not None:
        _insert(lines, list(_values(text)), path, value)
        return "\n".join(lines) + "\n"
    return text


def _insert(lines: list[str], values: list[_Line], path: tuple[str, ...], value: Any) -> None:
    """Insert a line for a key that has none: below the head of its table, beside its neighbours."""
    *table, name = path
    heads = [k for k, line in enumerate(lines) if _table(line) == tuple(table)]
    others = [line for line in values if line.path[:-1] == tuple(table)]
    if heads:
        lines.insert(heads[0] + 1, toml_line(name, value))
    elif table and others:  # options.H = ... has no head
        key = lines[others[-1].number].partition(" = ")[0].rpartition(".")[0]
        lines.insert(others[-1].number + 1, f"{key}.{toml_line(name, value)}")
    elif table:
        lines += ["", f"[{'.'.join(toml_line(part, 0)[:-4] for part in table)}]"]
        lines.append(toml_line(name, value))
    else:
        lines.insert(_begin(lines), toml_line(name, value))


def _begin(lines: list[str]) -> int:
    """Return where the first key of a case stands."""
    return next((k for k, line in enumerate(lines) if line and not line.startswith("#")), 0)


def _values(text: str) -> Iterator[_Line]:
    """Yield the lines that give a value; one that goes on over several lines is left out."""
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines()):
        head = _table(line)
        if head is not None:
            table = head
            continue
        body, comment = _split(line)
        here: Any = _parsed(body)
        path = table
        # An inline table is the value of its line: only the keys before the sign are followed.
        depth = len(_parsed_path(body.partition(" = ")[0]))
        for _ in range(depth):
            if isinstance(here, dict) and len(here) == 1:
                ((name, here),) = here.items()
                path = (*path, name)
        if depth and path != table:
            yield _Line(number, path, here, comment)


def _parsed_path(key: str) -> tuple[str, ...]:
    try:
        return key_path(key, "")
    except CaseError:
        return ()


def _table(line: str) -> tuple[str, ...] | None:
    """Return the keys of the head of a table; None for another line."""
    if not line.startswith("["):
        return None
    here: Any = _parsed(_split(line)[0])
    path: tuple[str, ...] = ()
    while isinstance(here, dict) and len(here) == 1:
        ((name, here),) = here.items()
        path = (*path, name)
    return path


def _split(line: str) -> tuple[str, str]:
    """Return a line without its comment, and the comment."""
    # A # within quotes begins no comment: what stands before it is not TOML by itself.
    for k, letter in enumerate(line):
        if letter == "#" and _parsed(line[:k]) is not None:
            return line[:k].rstrip(), line[k:]
    return line.rstrip(), ""


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(line)
    except tomllib.TOMLDecodeError:
        return None
