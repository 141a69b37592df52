"""Replace comments in pages by generated text while MkDocs builds the site.

<!-- command line -->             the help of all commands
<!-- benchmarks -->               the help of all benchmarks
<!-- experiments -->              the help of all studies
<!-- keys of a case -->           tables of all keys of a case file
<!-- members of livepde.NAME -->  the exports of a package that livepde itself does not export
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import livepde
from livepde.cases.new_case import case_schema

Schema = Mapping[str, Any]

PROJECT = Path(__file__).resolve().parents[1]

DEFINED = "#/$defs/"
BOUND = '`[low, high]`, `"<= number"` or `">= number"`'  # forms that `expect` accepts


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the comments in a page; MkDocs calls this hook for each page."""
    for comment, write in WRITERS.items():
        if comment in markdown:
            markdown = markdown.replace(comment, write())
    return re.sub(r"<!-- members of (\S+) -->", lambda match: members(match[1]), markdown)


def command_line(module: str = "livepde.cli", name: str = "livepde") -> str:
    """Return the help of all commands of a program in the Markdown that Typer writes."""
    command = [sys.executable, "-m", "typer", module, "utils", "docs", "--name", name]
    done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True)
    text = done.stdout
    # Drop the lists of commands, whose help Typer truncates, and the options of every command.
    text = re.sub(r"^\*\*Commands\*\*:\n\n(\*.*\n)+\n?", "", text, flags=re.MULTILINE)
    text = text.replace("* `--help`: Show this message and exit.\n", "")
    text = text.replace("**Options**:\n\n\n", "").split("\n\n", 1)[1]
    # Typer writes examples as running text: set each on its own line, as code.
    example = r"^(.*?)(Example|Your own|Replay|Service): +(\S.*)$"
    return re.sub(example, r"\1\n\n\2: `\3`", text, flags=re.MULTILINE)


def commands() -> str:
    """Return the help of all commands of livepde, as sections below a heading."""
    return below(command_line())


def below(text: str) -> str:
    """Return text with its headings one level deeper."""
    return re.sub(r"^##", "###", text, flags=re.MULTILINE)


def benchmarks() -> str:
    """Return the help of all benchmarks."""
    return command_line("benchmarks.__main__", "python -m benchmarks")


def experiments() -> str:
    """Return the help of all studies."""
    return command_line("experiments.__main__", "python -m experiments")


def members(package: str) -> str:
    """Return a mkdocstrings directive for the exports of a package that livepde lacks."""
    names = [name for name in import_module(package).__all__ if name not in livepde.__all__]
    hidden = {"show_root_heading": False, "show_root_toc_entry": False}
    options = {"heading_level": 3, "members": names, **hidden}
    return f"::: {package}\n    options: {json.dumps(options)}\n"


def keys_of_a_case() -> str:
    """Return tables of all keys of a case file, from the models that validate it."""
    schema = case_schema()
    return below("\n".join(_section("", schema, schema["$defs"])))


def _section(path: str, model: Schema, models: Schema) -> Iterator[str]:
    """Yield the section of one table, then the sections of its subtables."""
    title = f"`[{path}]`" if path else "At the top"
    kind = model["properties"].get("kind", {}).get("const")
    if kind:
        title += f", `kind = {json.dumps(kind)}`"
    columns = ["key", "value", "default", "meaning"]
    yield f"## {title}\n\n{model['description']}\n"
    yield f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|"
    needed = model.get("required", ())
    inner: list[tuple[str, str]] = []
    for key, value in model["properties"].items():
        name = f"{path}.{key}" if path else key
        default = json.dumps(value.get("default"), ensure_ascii=False)
        default = (
            "" if default in ("null", "[]", '""') or "default" not in value else f"`{default}`"
        )
        words = f"a table: name = {BOUND}" if key == "expect" else _alternatives(value)
        cells = [f"`{key}`", words, "required" if key in needed else default, value["description"]]
        yield f"| {' | '.join(cells)} |"
        inner += _tables(name, value)
    yield ""
    for subpath, name in inner:
        yield from _section(subpath, models[name], models)


def _alternatives(value: Schema) -> str:
    """Describe the values that a key accepts."""
    return " or ".join(dict.fromkeys(_words(value)))


def _words(value: Schema) -> Iterator[str]:
    choices = value.get("anyOf") or value.get("oneOf")
    if choices:
        kinds = [choice.get("type") for choice in choices if "const" not in choice]
        quantity = "number" in kinds and "string" in kinds
        if quantity:
            dates = any("format" in choice for choice in choices)
            yield "a date or a time" if dates else "a quantity"
        for choice in choices:
            free = "const" not in choice and choice.get("type") in ("number", "string")
            if choice.get("type") != "null" and not (quantity and free):
                yield from _words(choice)
    elif "enum" in value or "const" in value:
        for item in value.get("enum", [value.get("const")]):
            yield f"`{json.dumps(item)}`"
    elif value.get("type") == "array" and "prefixItems" in value:
        yield f"[{', '.join(map(_alternatives, value['prefixItems']))}]"
    elif value.get("type") == "array":
        yield f"[{_alternatives(value['items'])}, ...]"
    elif value.get("type") == "object":
        yield f"a table: name = {_alternatives(_values(value))}"
    else:
        yield "a table" if "$ref" in value else SIMPLE[value.get("type", "")]


def _values(value: Schema) -> Schema:
    """Return the schema of the values in a table whose keys are free names."""
    patterns = list(value.get("patternProperties", {}).values())
    schema = value.get("additionalProperties") or (patterns or [{}])[0]
    return schema if isinstance(schema, dict) else {}


def _tables(path: str, value: Schema) -> Iterator[tuple[str, str]]:
    """Yield path and model name of each table inside a value."""
    if "$ref" in value:
        yield path, value["$ref"].removeprefix(DEFINED)
    for choice in value.get("anyOf", value.get("oneOf", ())):
        yield from _tables(path, choice)
    if value.get("type") == "object":
        yield from _tables(f"{path}.NAME", _values(value))
    if value.get("type") == "array" and "items" in value:
        yield from _tables(f"[{path}]", value["items"])


SIMPLE = {
    "": "anything",
    "boolean": "true or false",
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
}
WRITERS = {
    "<!-- command line -->": commands,
    "<!-- benchmarks -->": benchmarks,
    "<!-- experiments -->": experiments,
    "<!-- keys of a case -->": keys_of_a_case,
}
