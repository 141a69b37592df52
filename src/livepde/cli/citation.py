"""Citation of livepde and of the paper, as text for a bibliography."""

from __future__ import annotations

import re
from enum import StrEnum
from importlib.resources import files
from typing import Annotated

import typer

from livepde import __version__
from livepde.cli.printing import terminal

# The facts are those of CITATION.cff, as a test checks; the year is that of the release.
BIBTEX = """\
@misc{{livepde{year},
  author = {{{{The livepde authors}}}},
  title = {{{{livepde}}}},
{year_line}\
  note = {{Computer software, version {version}}},
}}

@article{{Boiger2016,
  author = {{Boiger, R. and Kaltenbacher, B.}},
  title = {{{{An online parameter identification method for time dependent partial \
differential equations}}}},
  journal = {{Inverse Problems}},
  volume = {{32}},
  pages = {{045006}},
  year = {{2016}},
  doi = {{10.1088/0266-5611/32/4/045006}},
}}"""
APA = """\
The livepde authors. ({year}). livepde (Version {version}) [Computer software].

Boiger, R., & Kaltenbacher, B. (2016). An online parameter identification method for time \
dependent partial differential equations. Inverse Problems, 32, Article 045006. \
https://doi.org/10.1088/0266-5611/32/4/045006"""


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
    released = re.search(r"^date-released: (\d{4})", text, re.MULTILINE)
    year = released[1] if released else ""
    if form is CitationForm.bibtex:
        year_line = f"  year = {{{year}}},\n" if year else ""
        text = BIBTEX.format(year=year, year_line=year_line, version=__version__)
    elif form is CitationForm.apa:
        text = APA.format(year=year or "n.d.", version=__version__)
    terminal().print(text.rstrip(), markup=False, highlight=False, soft_wrap=True)
