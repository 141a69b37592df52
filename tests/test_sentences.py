"""Sentences that users read: plain terms of the field, and no more digits than six."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from string import Formatter
from types import SimpleNamespace

import numpy as np
import pytest

import livepde
from livepde.verdict.assess import _words
from livepde.verdict.directions import FIXED, ScoreDirection
from livepde.verdict.sentences import FINDINGS, LIKELY, Sentence

SOURCE = Path(livepde.__file__).parent
DEVIATION = re.compile(r"(?<!standard )\bdeviations?\b", re.IGNORECASE)
DIGITS = re.compile(r"\.(\d+)[efgEG]$")
LEVEL_OF_A_FORMAT = 6
"""Digits that a sentence has at most."""


@cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a file, which several tests look at."""
    return ast.parse(path.read_text(encoding="utf-8"))


def docstrings(tree: ast.AST) -> set[int]:
    """Return the strings that are documentation, by identity."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found.add(id(node.value))
    return found


@cache
def sentences(path: Path) -> list[tuple[int, str]]:
    """Return line and text of the strings with more than one word; numbers in them are 'N'."""
    found = []
    tree = parsed(path)
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
            found.append((node.lineno, text))
    return found


def formats(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of the formats of numbers within sentences."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.FormattedValue) and isinstance(node.format_spec, ast.JoinedStr):
            parts = node.format_spec.values
            if all(isinstance(part, ast.Constant) for part in parts):
                yield node.lineno, "".join(part.value for part in parts)


FILES = sorted(SOURCE.rglob("*.py"))


@pytest.mark.slow
def test_sentences_say_standard_deviation():
    wrong = [
        f"{path.name}:{line}: {text}"
        for path in FILES
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


PHRASES = {
    r"\b(tells?|told|says?|said|speaks?|spoke)\b": "report, show, return, indicate",
    r"\b(goes?|going|gone|went) on\b": "continue, resume",
    r"\bstands?\b": "is, contains, is defined",
    r"\bof (its|their|your) own\b": "its own",
    r"\b(in|out)side of\b": "inside, outside",
    r"\bin the place of\b": "instead of",
    r"\b(hardly|anew|at hand|for ever|aside|well again)\b": "barely, again, available, skipped",
    r"\bmend(s|ed|ing)?\b": "fix, correct, repair",
    r"\b(unwell|visitors?|strangers?)\b": "unhealthy, client",
    r"\bbeside\b": "next to, online, in addition to",
    r"\bbelongs? to\b": "requires, is part of",
    r"(?<!there )(?<!\bit )\bis no\b": "is not a",
    r"\bheard\b": "received",
}
"""Phrase that sentences do not use -> what they use instead."""
EXEMPT = {
    "reproduce": "sentences that the gallery quotes",
    "journal.py": "names of columns of the database",
}
"""File or folder whose sentences are not looked at -> why."""


@pytest.mark.slow
def test_sentences_are_plain_english():
    phrases = {re.compile(form, re.IGNORECASE): advice for form, advice in PHRASES.items()}
    wrong = [
        f"{path.name}:{line}: {found[0]!r}, better: {advice}"
        for path in FILES
        if not EXEMPT.keys() & {path.name, path.parent.name}
        for line, text in sentences(path)
        for form, advice in phrases.items()
        if (found := form.search(text))
    ]
    assert not wrong


def test_the_scan_sees_what_it_looks_for(tmp_path):
    path = tmp_path / "one.py"
    path.write_text('"""A deviation."""\nraise ValueError(f"the deviation is {x:.9g}")\n')
    assert [text for _, text in sentences(path)] == ["the deviation is N"]
    assert [form for _, form in formats(path)] == [".9g"]


# --- sentences of findings -----------------------------------------------------------------------

MOST_WORDS = 25  # of a sentence


def placeholders(sentence: Sentence) -> set[str]:
    """Return the names of the values that a sentence needs."""
    parts = Formatter().parse("".join(sentence))
    return {name for _, name, _, _ in parts if name is not None}


def filled() -> Iterator[tuple[str, str, set[str]]]:
    """Yield place, key and the values that the source fills in, for each key in a literal."""
    for path in FILES:
        for node in ast.walk(parsed(path)):
            match node:
                case ast.Call(
                    func=ast.Attribute(
                        attr="filled",
                        value=ast.Subscript(value=ast.Name("FINDINGS" | "LIKELY" as table)) as key,
                    ),
                    keywords=keywords,
                ) if all(one.arg for one in keywords):
                    values = {one.arg for one in keywords}
                    for part in ast.walk(key.slice):
                        if isinstance(part, ast.Constant) and isinstance(part.value, str):
                            yield f"{table} {path.name}:{node.lineno}", part.value, values


@pytest.mark.slow
def test_sentences_of_findings_get_the_values_that_they_need():
    tables = {"FINDINGS": FINDINGS, "LIKELY": LIKELY}
    found = list(filled())
    assert len(found) > 30
    for place, key, values in found:
        needed = placeholders(tables[place.split()[0]][key])
        assert needed <= values, (place, key, needed - values)


@pytest.mark.slow
def test_every_sentence_of_a_finding_is_used():
    constants = {
        node.value
        for path in FILES
        if path.name != "sentences.py"
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert not {*FINDINGS, *LIKELY} - constants


def test_sentences_of_findings_are_short():
    texts = [text for one in [*FINDINGS.values(), *LIKELY.values()] for text in one]
    each = [part for text in texts for part in re.split(r"(?<=[.!?:;]) ", text)]
    assert not [part for part in each if len(part.split()) > MOST_WORDS]


@pytest.mark.parametrize("uncertain", [True, False])
@pytest.mark.parametrize("size", [1.0, -1.0])
@pytest.mark.parametrize(
    "kind",
    [
        "offset",
        "drift",
        "gain",
        "lag",
        "position",
        "jump",
        "boundary",
        "source",
        "loss",
        "flux",
        "channel",
        "initial",
    ],
)
def test_every_cause_is_a_clause_with_a_remedy(kind: str, size: float, uncertain: bool):
    at = SimpleNamespace(
        ledger=SimpleNamespace(times=np.array([0.0, 1.0])),
        noise=np.array([0.1]),
        sensors=["T"],
        unit="degC",
        time_unit="s",
        start_uncertain=uncertain,
    )
    direction = ScoreDirection(kind, "T", 0.01, "m" if kind == "position" else "degC", at=0.5)
    text, remedy = _words(direction, size, at)
    assert " may " in text
    assert not text.endswith(".")
    assert remedy.endswith(".")
    assert not {"{", "degC"} & {*text.split(), *text}
    if kind == "boundary":
        text, _ = _words(ScoreDirection(kind, FIXED), size, at)
        assert text.startswith("a constant boundary value may be")


@pytest.mark.parametrize(
    ("place", "amount", "words"),
    [
        (0.1, -0.01, "T may be 1 cm closer to x = 0 than configured"),
        (0.1, 0.01, "T may be 1 cm farther from x = 0 than configured"),
        (-0.1, 0.01, "T may be 1 cm closer to x = 0 than configured"),
        (0.0, 0.01, "T may be 1 cm farther from x = 0 than configured"),
        (0.01, -0.02, "T may be 2 cm displaced towards smaller x"),
    ],
)
def test_a_displaced_sensor_is_on_one_side_of_its_place(place, amount, words):
    at = SimpleNamespace(ledger=SimpleNamespace(times=np.array([0.0, 1.0])), noise=np.ones(1))
    direction = ScoreDirection("position", "T", 0.01, "m", at=place)
    text, remedy = _words(direction, amount / 0.01, at)
    assert text == words
    width = f"{2.0 * abs(amount):.2g} m"
    assert remedy == (
        f'To test this, estimate its position: add `at_std = "{width}"` to `[channels.T]`.'
    )
