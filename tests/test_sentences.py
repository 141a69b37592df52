"""Sentences that users read: plain terms of the field, and no more digits than six."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import livepde

SOURCE = Path(livepde.__file__).parent
DEVIATION = re.compile(r"(?<!standard )\bdeviations?\b", re.IGNORECASE)
DIGITS = re.compile(r"\.(\d+)[efgEG]$")
LEVEL_OF_A_FORMAT = 6
"""Digits that a sentence has at most."""


def docstrings(tree: ast.AST) -> set[int]:
    """Return the strings that are documentation, by identity."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found.add(id(node.value))
    return found


def sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of the strings with more than one word; numbers in them are 'N'."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left_out = docstrings(tree)
    inside = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = "".join(
                part.value if isinstance(part, ast.Constant) else "N" for part in node.values
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if id(node) in left_out or id(node) in inside:
                continue
            text = node.value
        else:
            continue
        if " " in text.strip():
            yield node.lineno, text


def formats(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of the formats of numbers within sentences."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FormattedValue) and isinstance(node.format_spec, ast.JoinedStr):
            parts = node.format_spec.values
            if all(isinstance(part, ast.Constant) for part in parts):
                yield node.lineno, "".join(part.value for part in parts)


FILES = sorted(SOURCE.rglob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=lambda p: p.name)
def test_sentences_say_standard_deviation(folder):
    wrong = [
        f"{path.name}:{line}: {text}"
        for path in FILES
        if path.parent == folder
        for line, text in sentences(path)
        if DEVIATION.search(text)
    ]
    assert not wrong


@pytest.mark.slow
def test_no_number_has_more_than_six_digits():
    wrong = [
        f"{path.name}:{line}: {form}"
        for path in FILES
        for line, form in formats(path)
        if (found := DIGITS.search(form)) and int(found[1]) > LEVEL_OF_A_FORMAT
    ]
    assert not wrong


def test_the_scan_sees_what_it_looks_for(tmp_path):
    path = tmp_path / "one.py"
    path.write_text('"""A deviation."""\nraise ValueError(f"the deviation is {x:.9g}")\n')
    assert [text for _, text in sentences(path)] == ["the deviation is N"]
    assert [form for _, form in formats(path)] == [".9g"]
