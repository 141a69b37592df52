"""Citation of livepde: CITATION.cff of the package, as text for a bibliography."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from importlib.resources import files
from typing import Annotated, Any

import typer

from livepde.cli.printing import terminal

__all__ = ["CitationForm", "citation"]

Work = Mapping[str, Any]


class CitationForm(StrEnum):
    """Formats of a citation."""

    bibtex = "bibtex"
    apa = "apa"
    cff = "cff"


def citation(
    form: Annotated[
        CitationForm,
        typer.Option("--format", help="BibTeX, a line in the style of the APA, or the file."),
    ] = CitationForm.bibtex,
) -> None:
    """Print how to cite livepde, and the paper whose method it implements.

    Example:  livepde citation --format apa
    """
    text = files("livepde").joinpath("CITATION.cff").read_text(encoding="utf-8")
    if form is not CitationForm.cff:
        import yaml

        write: Callable[[Work], str] = _bibtex if form is CitationForm.bibtex else _apa
        software = yaml.safe_load(text)
        text = "\n\n".join(write(work) for work in (software, *software["references"]))
    terminal().print(text.rstrip(), markup=False, highlight=False, soft_wrap=True)


def _year(work: Work) -> str:
    return str(work.get("year") or work.get("date-released", ""))[:4]


def _people(work: Work, entity: str) -> list[str]:
    return [
        entity.format(person["name"])
        if "name" in person
        else f"{person['family-names']}, {person['given-names']}"
        for person in work["authors"]
    ]


def _bibtex(work: Work) -> str:
    key = work["authors"][0].get("family-names", work["title"]) + _year(work)
    entries = {
        "author": " and ".join(_people(work, "{{{}}}")),
        "title": f"{{{work['title']}}}",
        "journal": work.get("journal"),
        "volume": work.get("volume"),
        "pages": work.get("start"),
        "year": _year(work),
        "doi": work.get("doi"),
        "note": f"Computer software, version {work['version']}" if "version" in work else None,
    }
    lines = [f"  {name} = {{{value}}},\n" for name, value in entries.items() if value]
    kind = "article" if "journal" in work else "misc"
    return f"@{kind}{{{key},\n{''.join(lines)}}}"


def _apa(work: Work) -> str:
    *others, last = _people(work, "{}")
    names = f"{', '.join(others)}, & {last}" if others else last
    line = f"{names.rstrip('.')}. ({_year(work) or 'n.d.'}). {work['title']}"
    if "version" in work:
        line += f" (Version {work['version']}) [Computer software]"
    if "journal" in work:
        line += f". {work['journal']}, {work['volume']}, Article {work['start']}"
    return line + "." + (f" https://doi.org/{work['doi']}" if "doi" in work else "")
