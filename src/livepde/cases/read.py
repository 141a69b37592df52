"""Reader of case files: from TOML text and settings to a checked specification."""

from __future__ import annotations

import copy
import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tomlkit
from pydantic import BaseModel, ValidationError
from tomlkit.items import InlineTable

from livepde.cases.schema import CaseSpec
from livepde.errors import CaseError
from livepde.units import LARGEST

BLANK = "?"  # prefix of a value that is still to be filled in
LONGEST = 1_000_000  # largest size of a case file in bytes
DATA = (".csv", ".txt", ".jsonl", ".parquet", ".xlsx")  # extensions of data files
SHOWN = 60  # characters of a line in a message
LONGEST_SHOWN = 200  # characters of a value in a message

NAMED = ("unknowns", "channels")  # tables whose keys are names that the case chooses
DEPTH = 32  # largest depth of nested tables and lists, and number of parts of a key
COUNTS = {  # keys that determine memory or computing time -> largest number
    "every": 1_000_000,
    "fields_every": 1_000_000_000,
    "harmonics": 100,
    "iterations": 1000,
    "modes": 10_000,
    "past": 10_000,
    "queue": 10_000_000,
    "seeds": 10_000,
    "temperings": 100,
    "thin": 1_000_000_000,
    "window": 100_000,
}
OTHER = 1_000_000_000  # largest whole number of other keys
FREE = ("data.missing",)  # keys whose numbers are only markers and have no limit
NAMES = 10_000  # largest number of keys in a table
LONG_KEY = 200  # largest number of characters of a name
NAME = re.compile(r"[\w\"'-]+")
DOTTED = re.compile(r"(?:a\s?\.\s?){" + str(DEPTH) + "}")
DIGITS = re.compile(r"[0-9_]{400}")

# Type of pydantic's error -> expected value in the message.
EXPECTED = {
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "string_type": "text in quotes",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "tuple_type": "a list",
    "sequence_str": "a list",
    "is_instance_of": "a list",
    "too_short": "at least one entry",
    "string_too_short": "a name",
}
CLASS = re.compile(r"[A-Z][a-z]\w*: ")  # prefix of a message about options of a law
UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")  # for models, for dataclasses


def read_text(path: Path) -> str:
    """Return the text of a case file; raises `CaseError`."""
    if path.suffix in DATA:
        raise CaseError(
            f"{path}: is data, not a case. 'livepde init DIR --data {path}' begins one."
        )
    try:
        with path.open("rb") as file:
            content = file.read(LONGEST + 1)
        if len(content) > LONGEST:
            raise CaseError(f"{path}: is longer than {LONGEST} bytes. Put data into a data file.")
        return content.decode("utf-8").replace("\r\n", "\n")
    except FileNotFoundError:
        near = _nearest(path.parent, path.name)
        raise CaseError(f"{path}: there is no such case file; {near}") from None
    except IsADirectoryError:
        near = _nearest(path, "case.toml")
        raise CaseError(f"{path}: is a folder, not a case file; {near}") from None
    except UnicodeDecodeError as error:
        row = error.object.count(b"\n", 0, error.start) + 1
        raise CaseError(f"{path}: row {row} is not UTF-8 text; save it as UTF-8.") from error
    except OSError as error:
        raise CaseError(f"{path}: cannot be read ({error.strerror or error}).") from error


def _nearest(folder: Path, name: str) -> str:
    """Return a hint to a similarly named case file in a folder or below, or to the only one."""
    known = [*folder.glob("*.toml"), *folder.glob("*/*.toml")]
    names = difflib.get_close_matches(name, [item.name for item in known], n=1, cutoff=0.75)
    near = [item for item in known if item.name in names] or known[: len(known) == 1]
    return f"did you mean '{near[0]}'?" if near else "'livepde init DIR' writes one."


def read_toml(text: str, where: str) -> dict[str, Any]:
    """Return the document of a case file; raises `CaseError`."""
    # Documents that would take long to parse are refused before parsing.
    if DOTTED.search(NAME.sub("a", text)):
        raise CaseError(f"{where}: a key has more than {DEPTH} parts; a case needs few.")
    if DIGITS.search(text):
        raise CaseError(f"{where}: a number has 400 digits or more; write it shorter, as 2.5e9.")
    try:
        document = tomllib.loads(text)
    except (RecursionError, ValueError) as error:  # also numbers and dates beyond Python's range
        line = _line(text, str(error)) if isinstance(error, tomllib.TOMLDecodeError) else ""
        raise CaseError(f"{where}: is not valid TOML: {error}{line}.") from None
    _check_document(document, where)
    return document


def _line(text: str, reason: str) -> str:
    """Return the line to which an error message of TOML refers, with the usual causes."""
    number = re.search(r"at line (\d+)", reason)
    line = re.split(r"\s+#", text.splitlines()[int(number[1]) - 1])[0].strip() if number else ""
    if not line:
        return ""
    return f": {line[:SHOWN]}; text needs quotes at both ends, decimals a point"


def read_spec(raw: Mapping[str, Any], where: str) -> CaseSpec:
    """Return the checked content of a case's document; raises `CaseError`."""
    blanks = [
        f"{where}: {key} = {toml_value(value)}: replace '?' by a "
        f"{'unit' if key.endswith('unit') else 'value'}."
        for key, value in blanks_in(raw).items()
    ]
    if blanks:
        raise CaseError("\n".join(blanks))
    return spec_of(raw, where)


def spec_of(raw: Mapping[str, Any], where: str) -> CaseSpec:
    """Return the checked content of a document that may contain blanks; raises `CaseError`."""
    try:
        return CaseSpec.model_validate(raw)
    except ValidationError as error:
        raise CaseError(f"{where}: {_sentence(error, raw)}") from None


def is_blank(value: Any) -> bool:
    """Return whether a value is still to be filled in: '?', '? m', or a list with such a value."""
    if isinstance(value, list):
        return any(map(is_blank, value))
    return isinstance(value, str) and value.split(" ")[0] == BLANK


def blanks_in(document: Mapping[str, Any], table: str = "") -> dict[str, Any]:
    """Return key -> value of all blanks, such as '? m', that `livepde init --data` has written."""
    found: dict[str, Any] = {}
    for name, value in document.items():
        key = f"{table}.{name}" if table else name
        if isinstance(value, Mapping):
            found |= blanks_in(value, key)
        elif is_blank(value):
            found[key] = value
    return found


def beside(path: Path, folder: Path) -> Path:
    """Return the path of a file relative to a folder; absolute if it is on another drive."""
    try:  # links are resolved, since '..' after a link is the parent of its target
        return Path(os.path.relpath(path.parent.resolve() / path.name, folder.resolve()))
    except ValueError:
        return path.absolute()


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a remedy for a name that is not one of `known`."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"expected one of {', '.join(names)}." if names else "leave it out."


def _sentence(error: ValidationError, raw: Mapping[str, Any]) -> str:
    # A misspelt key causes two errors, an unknown and a missing key: the first is more useful. If
    # booleans, lists and tables are allowed, a table is not wrong because it is not a boolean.
    def rank(item: Any) -> tuple[bool, bool]:
        table = item["type"] in ("bool_type", "tuple_type") and isinstance(item["input"], dict)
        return item["type"] not in UNKNOWN_KEY, table

    found = min(error.errors(), key=rank)
    kind, got = found["type"], found["input"]
    path = _path(found["loc"], raw, kind == "missing")
    key = ".".join(path)
    if kind in UNKNOWN_KEY:
        return f"there is no key '{key}'; {did_you_mean(path[-1], _keys(path[:-1], raw))}"
    if kind == "missing" and isinstance(found["loc"][-1], int):
        return f"{'.'.join(path[:-1])}: got {_short(got)}; expected more entries."
    if kind == "missing":
        return f"the key '{key}' is missing."
    context = found.get("ctx", {})
    if kind == "union_tag_invalid":
        tag = str(context["tag"])
        return f"{key}.kind: got '{tag}'; {did_you_mean(tag, _choices(context['expected_tags']))}"
    if kind == "literal_error":
        return f"{key}: got {_short(got)}; {did_you_mean(str(got), _choices(context['expected']))}"
    if kind == "value_error":
        # Options of a law check their values: "Guards: reach must be a positive number."
        message = CLASS.sub("", str(context["error"]), count=1).removesuffix(".")
        shown = "" if isinstance(got, dict) else f"got {_short(got)}; "
        return f"{key}: {shown}{message}."
    message = str(found["msg"]).removeprefix("Input should be ").removeprefix("Value should be ")
    expected = EXPECTED.get(kind, message)
    if kind == "greater_than":
        expected = f"a number greater than {context['gt']}"
    return f"{key}: got {_short(got)}; expected {expected}."


def _choices(expected: str) -> list[str]:
    """Return the quoted words in a message of pydantic."""
    return re.findall(r"'([^']*)'", expected)


def _short(value: Any) -> str:
    """Return a value as text for a message, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def _path(loc: tuple[int | str, ...], raw: Any, missing: bool) -> list[str]:
    """Return the location of an error as keys of the file, without the tags of pydantic."""
    path: list[str] = []
    here = raw
    for k, part in enumerate(loc):
        if isinstance(here, dict) and part in here:
            here = here[part]
            path.append(str(part))
        elif isinstance(here, list) and isinstance(part, int) and part < len(here):
            here = here[part]
            path[-1] += f"[{part}]"
        elif missing and k == len(loc) - 1:
            path.append(str(part))
    return path or list(map(str, loc[:1]))


def _keys(path: Iterable[str], raw: Mapping[str, Any]) -> list[str]:
    """Return the valid keys of the table at a path."""
    here: Any = raw
    kinds: list[Any] = [CaseSpec]
    for part in path:
        key, _, number = part.partition("[")  # variants[0]: entry 0 of a list
        here = here[key][int(number[:-1])] if number else here[key]
        below = [get_args(one)[1] if _is_named(one) else _fields(one).get(key) for one in kinds]
        kinds = [inner for one in below for inner in _tables(one)]
    # If several laws are possible, `kind` of the table selects one.
    tables = map(_fields, kinds)
    kind = here.get("kind", "sensitivity")
    fits = (known for known in tables if kind in get_args(known.get("kind", Literal[kind])))
    return list(dict.fromkeys(chain.from_iterable(fits)))


def _tables(kind: Any) -> Iterator[Any]:
    """Yield the tables and the mappings from names among the types of a value."""
    if _is_named(kind) or _fields(kind):
        yield kind
    else:
        for inner in get_args(kind):
            yield from _tables(inner)


def _is_named(kind: Any) -> bool:
    return get_origin(kind) is dict


def _fields(kind: Any) -> dict[str, Any]:
    """Return key -> type of a table; empty if the type is not a table."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {item.alias or name: item.annotation for name, item in kind.model_fields.items()}
    return get_type_hints(kind) if isinstance(kind, type) and is_dataclass(kind) else {}


def parse(assignments: Iterable[str]) -> dict[str, Any]:
    """Return key -> value for texts such as 'law.noise=2 K'; values are TOML or plain text.

    >>> parse(["law.noise=2 K", "data.every=2", "expect="])
    {'law.noise': '2 K', 'data.every': 2, 'expect': None}
    """
    found: dict[str, Any] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not (equals and key.strip()):
            raise CaseError(f"--set {text}: expected key=value, such as law.memory='3 d'.")
        if not value.strip():
            found[key.strip()] = None
            continue
        try:
            (found[key.strip()],) = tomllib.loads(f"value = {value}").values()
        except (tomllib.TOMLDecodeError, ValueError):
            found[key.strip()] = value.strip()
    return found


def apply(document: Mapping[str, Any], settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a copy of a case's document with settings applied; raises `CaseError`.

    `settings`: key as in the file, 'law.noise' or 'unknowns.k.regions."0-1"' -> value. A table only
    changes its own keys; None removes the key. A table for a new unknown or channel adds it.
    """
    changed = copy.deepcopy(dict(document))
    for key, given in settings.items():
        adds = isinstance(given, Mapping) and len(key_path(key, where)) == 2
        for path, value in _leaves(key_path(key, where), given):
            here = _table_of(changed, path, where, adds=adds)
            if value is not None:
                here[path[-1]] = value
            elif here.pop(path[-1], None) is None:
                raise CaseError(
                    f"{where}: there is no key '{'.'.join(path)}' to remove; "
                    f"{did_you_mean(path[-1], here)}"
                )
    return changed


def _table_of(
    document: dict[str, Any], path: tuple[str, ...], where: str, *, adds: bool
) -> dict[str, Any]:
    """Return the table of a key in a document; missing tables are added."""
    if path[0] == "initial" and not isinstance(document.get("initial", {}), dict):
        # initial = "interpolate" is short for initial.from = "interpolate".
        document["initial"] = {"from": document["initial"]}
    here = document
    for k, part in enumerate(path[:-1]):
        if k == 1 and path[0] in NAMED and part not in here and not adds:
            raise CaseError(
                f"{where}: {'.'.join(path)}: the case has no '{path[0]}.{part}'; "
                f"{did_you_mean(part, here).removesuffix('.')} (to add it, set all of it: "
                f"{path[0]}.{part}={{ ... }})"
            )
        if not isinstance(here.get(part), dict):
            here[part] = {}
        here = here[part]
    return here


def settings_in(text: str) -> tuple[str, ...]:
    """Return the settings in a text that separates them by semicolons outside quotes.

    >>> settings_in('data.separator=";"; law.jumps=true')
    ('data.separator=";"', 'law.jumps=true')
    """
    parts = re.findall(r"""(?:"(?:\\.|[^"\\])*"|'[^']*'|[^;])+""", text)
    return tuple(part.strip() for part in parts if part.strip())


def key_path(key: str, where: str) -> tuple[str, ...]:
    """Return the parts of a dotted key such as 'law.noise'; raises `CaseError`."""
    try:
        here: Any = tomllib.loads(f"{key} = 0")
    except tomllib.TOMLDecodeError:
        text = f"{where}: '{key}' is not a key; expected a key such as 'law.noise'."
        raise CaseError(text) from None
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


def toml_line(key: str, value: Any) -> str:
    """Return a key and its value as a line of TOML.

    >>> toml_line("T 1", {"role": "sensor", "at": 0.5})
    '"T 1" = { role = "sensor", at = 0.5 }'
    """
    return f"{toml_key(key)} = {toml_value(value)}"


def toml_key(name: str) -> str:
    """Return a key in TOML notation, with quotes if necessary."""
    return tomlkit.key(name).as_string()


def toml_value(value: Any) -> str:
    """Return a value in TOML notation on one line, with spaces inside the braces of tables."""
    if isinstance(value, Mapping):
        items = ", ".join(toml_line(key, item) for key, item in value.items())
        return f"{{ {items} }}" if items else "{}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    shown: str = tomlkit.item(value).as_string()
    return shown


def _check_document(document: Mapping[str, Any], where: str) -> None:
    """Refuse numbers, names and nesting depths beyond the limits of this module."""
    for key, value, depth in _values(document, where):
        if depth > DEPTH:
            text = f"more than {DEPTH} tables or lists within one another"
            raise CaseError(f"{where}: {key[:LONG_KEY]}: {text}.")
        if max(map(len, key.split("."))) > LONG_KEY:
            raise CaseError(f"{where}: {key[:LONG_KEY]}...: a name has at most {LONG_KEY} letters.")
        if key.startswith(FREE):
            continue
        name = key.rpartition(".")[2]
        if isinstance(value, int) and abs(value) > COUNTS.get(name, OTHER):
            most = COUNTS.get(name, OTHER)
            got = value if abs(value) < 10**20 else f"a number of {value.bit_length()} bits"
            raise CaseError(f"{where}: {key}: got {got}; expected at most {most}.")
        if isinstance(value, float) and LARGEST < abs(value) < float("inf"):
            raise CaseError(f"{where}: {key}: got {value:g}; expected less than {LARGEST:g}.")


def _values(value: Any, where: str) -> Iterator[tuple[str, Any, int]]:
    """Iterate over all values with keys and depths; levels deeper than `DEPTH` are not entered."""
    stack: list[tuple[str, Any, int]] = [("", value, 0)]
    while stack:
        key, value, depth = stack.pop()
        if depth > DEPTH or not isinstance(value, Mapping | list):
            yield key, value, depth
        elif isinstance(value, Mapping):
            if len(value) > NAMES:
                text = f"{key or 'the case'} has {len(value)} names; expected at most {NAMES}."
                raise CaseError(f"{where}: {text}")
            stack += [(f"{key}.{n}" if key else n, v, depth + 1) for n, v in value.items()]
        else:
            stack += [(key, item, depth + 1) for item in value]


def filled(text: str, settings: Mapping[str, Any], where: str) -> str:
    """Return the text of a case with settings applied as by `apply`, preserving comments."""
    for key, value in settings.items():
        expected = apply(read_toml(text, where), {key: value}, where)
        text = _with(text, key_path(key, where), value)
        # Empty tables are ignored: they consist of a header only.
        found, wanted = (
            {name: item for name, item in document.items() if item != {}}
            for document in (read_toml(text, where), expected)
        )
        if found != wanted:
            raise CaseError(f"{where}: {key}: cannot be set here; edit the file instead.")
    if settings:
        spec_of(read_toml(text, where), where)
    return text


def _with(text: str, path: Sequence[str], value: Any) -> str:
    """Return a case with a changed value of a key, preserving comments; None removes the key."""
    document = tomlkit.parse(text)
    here: Any = document
    *tables, name = path
    for k, part in enumerate(tables):
        inner = here.get(part, {})
        # An inline table is rewritten as a whole. A plain value is a short form of a table.
        if isinstance(inner, InlineTable) or not isinstance(inner, Mapping):
            whole: Any = apply(document.unwrap(), {".".join(map(toml_key, path)): value}, "")
            for table in tables[: k + 1]:
                whole = whole[table]
            name, value = part, whole
            break
        if part not in here:
            here[part] = tomlkit.table()
        here = here[part]
    if value is None:
        here.pop(name, None)
    else:
        # Parsed with a line end: otherwise a new key among dotted keys would have none.
        here[name] = tomlkit.parse(f"{toml_line('x', value)}\n")["x"]
    return tomlkit.dumps(document)
