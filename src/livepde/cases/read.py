"""From a TOML file to a checked specification, or to one sentence about what is wrong."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from livepde.cases.schema import (
    AutoSpec,
    CaseSpec,
    ChannelSpec,
    CorrelatedSpec,
    DataSpec,
    EvolutionSpec,
    GradientSpec,
    MeshSpec,
    OutputSpec,
    ReplaySpec,
    SensitivitySpec,
    StepsSpec,
    UnknownSpec,
    VariantSpec,
)
from livepde.errors import CaseError

__all__ = ["did_you_mean", "read_spec", "read_text", "read_toml"]

LONGEST = 1_000_000  # bytes of a case file

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
    "too_short": "at least one entry",
    "string_too_short": "a name",
}
TABLES: dict[str, type[BaseModel]] = {
    "mesh": MeshSpec,
    "data": DataSpec,
    "steps": StepsSpec,
    "output": OutputSpec,
    "unknowns.*": UnknownSpec,
    "channels.*": ChannelSpec,
    "law.replay": ReplaySpec,
    "variants.*": VariantSpec,
    "*.evolution": EvolutionSpec,
    "*.correlated": CorrelatedSpec,
}


def read_text(path: Path) -> str:
    """Return the text of a case file."""
    try:
        with path.open("rb") as file:
            content = file.read(LONGEST + 1)
        if len(content) > LONGEST:
            raise CaseError(f"{path}: is longer than {LONGEST} bytes; data belong to a data file.")
        return content.decode("utf-8").replace("\r\n", "\n")
    except FileNotFoundError:
        near = difflib.get_close_matches(path.name, _cases_in(path.parent), n=1)
        hint = f" Did you mean '{path.parent / near[0]}'?" if near else ""
        raise CaseError(
            f"{path}: there is no such case file; 'livepde init DIR' writes one.{hint}"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise CaseError(f"{path}: cannot be read as text ({error}).") from error


def _cases_in(folder: Path) -> list[str]:
    return [file.name for file in folder.glob("*.toml")] if folder.is_dir() else []


def read_toml(text: str, where: str) -> dict[str, Any]:
    """Return the document of a case file; raises `CaseError`."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise CaseError(f"{where}: is not valid TOML: {error}.") from None


def read_spec(raw: Mapping[str, Any], where: str) -> CaseSpec:
    """Return the checked content of a case's document; raises `CaseError`."""
    try:
        return CaseSpec.model_validate(raw)
    except ValidationError as error:
        raise CaseError(f"{where}: {_sentence(error, raw)}") from None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a remedy for a name that is not one of `known`."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"expected one of {', '.join(names)}." if names else "leave it out."


def _sentence(error: ValidationError, raw: Mapping[str, Any]) -> str:
    # A misspelt key makes two errors, one extra and one missing: the extra one says it better.
    found = sorted(error.errors(), key=lambda item: item["type"] != "extra_forbidden")[0]
    path = _path(found["loc"], raw)
    key = ".".join(path)
    kind, got = found["type"], found["input"]
    if kind == "extra_forbidden":
        return f"there is no key '{key}'; {did_you_mean(path[-1], _keys(path[:-1], raw))}"
    if kind == "missing":
        return f"the key '{key}' is missing."
    context = found.get("ctx", {})
    if kind == "union_tag_not_found":
        return f"the key '{key}.kind' is missing; expected 'sensitivity' or 'gradient'."
    if kind == "union_tag_invalid":
        tag = str(context["tag"])
        return f"{key}.kind: got '{tag}'; {did_you_mean(tag, ['auto', 'sensitivity', 'gradient'])}"
    if kind == "literal_error":
        choices = str(context["expected"]).replace(" or ", ", ").replace("'", "").split(", ")
        return f"{key}: got {got!r}; {did_you_mean(str(got), choices)}"
    if kind == "value_error":
        message = str(context["error"])
        shown = "" if isinstance(got, dict) else f"got {got!r}; "
        return f"{key}: {shown}{message}."
    expected = EXPECTED.get(kind)
    if kind == "greater_than":
        expected = f"a number greater than {context['gt']}"
    if expected is None:
        message = str(found["msg"])
        expected = message.removeprefix("Input should be ").removeprefix("Value should be ")
    return f"{key}: got {got!r}; expected {expected}."


def _path(loc: tuple[int | str, ...], raw: Any) -> list[str]:
    """Return the keys of an error as the file has them, without pydantic's own tags."""
    path: list[str] = []
    here = raw
    for k, part in enumerate(loc):
        if isinstance(here, dict) and part in here:
            here = here[part]
            path.append(str(part))
        elif isinstance(here, list) and isinstance(part, int) and part < len(here):
            here = here[part]
            path[-1] += f"[{part}]"
        elif k == len(loc) - 1 and isinstance(here, dict):
            path.append(str(part))  # a missing key
    return path or [str(part) for part in loc[:1]]


def _keys(path: list[str], raw: Mapping[str, Any]) -> list[str]:
    """Return the keys that a table may have."""
    model: type[BaseModel] | None = CaseSpec
    if path == ["law"]:
        kind = raw["law"].get("kind") if isinstance(raw.get("law"), dict) else ""
        laws: dict[str, type[BaseModel]] = {"auto": AutoSpec, "gradient": GradientSpec}
        model = laws.get(str(kind), SensitivitySpec)
    elif path:
        first = path[0].partition("[")[0]  # variants[0] is one of the variants
        names = (".".join(path), f"*.{path[-1]}", f"{first}.*")
        model = next((TABLES[name] for name in names if name in TABLES), None)
    if model is None:
        return []
    return [item.alias or name for name, item in model.model_fields.items()]
