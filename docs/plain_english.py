"""Check that README and docs are plain English, with: python docs/plain_english.py [PAGE ...].

Reports phrases that have a simpler form, sentences of more than 30 words, and pages of the user
guide of more than 1500 words. Skips code, generated pages and the gallery.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 30  # words of a sentence
PAGE = 1500  # words of a page of the user guide

PHRASES = {
    r"\b(says?|said|tells?|told|speaks?|spoken)\b": "reports, shows, warns, returns",
    r"\bbeside\b": "next to, alongside",
    r"\bgo(es|ing)? on\b": "continue",
    r"\bstands?\b|\bstood\b": "is",
    r"\bof (its|their|your|his|her|our|one's) own\b": "its own X, a separate X",
    r", as (a|an|in|of|with|for) ": "such as, for example",
    r"\b(that|those) of\b": "repeat the noun",
    r"(?<!here )\b(is|are) no (?!longer\b|more\b)": "is not a",
    r"\bbelongs? to\b": "requires, is part of",
    r"\bhardly\b": "barely",
    r"\banew\b": "again",
    r"\bmend(s|ed|ing)?\b": "fix, correct",
    r"\bat hand\b": "available",
    r"\bfor ever\b": "indefinitely",
    r"\baside\b": "skipped",
    r"\bunwell\b": "unhealthy",
    r"\b(visitor|stranger)s?\b": "client, user",
    r"\b(inside|outside) of\b": "inside, outside",
    r"\bin the place of\b": "instead of",
}
GUIDE = {
    *("own-data", "first-hour", "cases", "unknowns", "sensors", "trust", "python", "mistakes"),
    *("service", "formats", "fleet"),
}
# Folder -> why its pages are skipped.
SKIPPED = {
    "gallery": "numbers and captions of runs, which commands write",
    "api": "docstrings",
    "peers": "tables that a command writes",
    "performance": "tables that a command writes",
}
# (page, phrase) -> why the phrase stays.
EXCEPTIONS: dict[tuple[str, str], str] = {}


def blocks(text: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each paragraph, list item and table cell."""
    text = re.sub(r"^```.*?^```$", lambda code: "\n" * code[0].count("\n"), text, flags=re.M | re.S)
    text = re.sub(r"^ {4}.*$", "", text, flags=re.M)  # formulas
    text = re.sub(r"^<!--.*?-->$", "", text, flags=re.M)
    start, lines = 1, list[str]()
    for number, line in enumerate([*text.splitlines(), ""], 1):
        if not line.strip() or re.match(r"\s*([-*|#!]|\d+\.) ", line):
            if lines:
                yield start, " ".join(lines)
            lines = []
        if line.startswith("|"):
            yield from ((number, cell) for cell in re.split(r"(?<!\\)\|", line))
        elif line.strip():
            start = start if lines else number
            lines.append(line.strip())


def plain(text: str) -> str:
    """Remove link targets and attributes, and replace inline code by the word X."""
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)|\{[ #:][^}]*\}", r"\1", text)
    return re.sub(r"(?<!`)(`+)(?!`).+?(?<!`)\1(?!`)", "X", text)


def problems(page: Path) -> Iterator[str]:
    """Yield each problem of a page in the form file:line: phrase -> advice."""
    name = str(page.relative_to(ROOT) if page.is_relative_to(ROOT) else page)
    count = 0
    for line, text in blocks(page.read_text(encoding="utf-8")):
        for phrase, advice in PHRASES.items():
            for found in re.finditer(phrase, plain(text), re.I):
                if (name, found[0].strip(" ,").lower()) not in EXCEPTIONS:
                    yield f"{name}:{line}: {found[0].strip(' ,')} -> {advice}"
        for sentence in re.split(r"(?<=[.!?:])\s+(?=[*\"'(]*[A-Z0-9])", plain(text)):
            words = [word for word in sentence.split() if re.search(r"\w", word)]
            count += len(words)
            if len(words) > LONGEST:
                start = " ".join(words[:6])
                yield f"{name}:{line}: {start} ... ({len(words)} words) -> at most {LONGEST}"
    if page.stem in GUIDE and count > PAGE:
        yield f"{name}:1: {count} words -> at most {PAGE}"


def pages() -> list[Path]:
    """Return the pages that are checked."""
    found = sorted((ROOT / "docs").rglob("*.md"))
    kept = (page for page in found if not SKIPPED.keys() & {*page.relative_to(ROOT).parts})
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *kept]


def main(chosen: list[str]) -> None:
    """Print the problems of the chosen pages, by default all; the exit code is 1 if any."""
    checked = [Path(name).resolve() for name in chosen] or pages()
    found = [problem for page in checked for problem in problems(page)]
    if found:
        raise SystemExit("\n".join(found))


if __name__ == "__main__":
    main(sys.argv[1:])
