"""The gallery shows every case and every experiment with its figure, its table and its command."""

import importlib
import re
from pathlib import Path

import pytest
from typer.main import get_command

from experiments.__main__ import app as studies
from livepde.reproduce import EXPERIMENTS

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "gallery"
CASES = sorted(path.stem for path in (ROOT / "cases").glob("*.toml"))
SCRIPTS = sorted(
    path.stem
    for path in (ROOT / "experiments").glob("[!_]*.py")
    if '__name__ == "__main__"' in path.read_text()
)
PROGRAMS = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
LARGEST = 150_000  # bytes of a picture


@pytest.fixture(scope="module")
def maker():
    """The program that makes the page of experiments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))
        return importlib.import_module("experiments_page")


def part(page, heading):
    """Return what stands below a heading, up to the next of its rank."""
    text = (FOLDER / page).read_text(encoding="utf-8")
    found = re.search(rf"^{heading}\n(.*?)(?=^##|\Z)", text, re.MULTILINE | re.DOTALL)
    assert found, heading
    return found[1]


def pictures(text):
    """Return the pictures of a part; each is there, and small."""
    found = [FOLDER / name for name in re.findall(r"!\[[^]]*\]\((.+?\.png)\)", text)]
    assert all(path.stat().st_size < LARGEST for path in found)
    return found


@pytest.mark.parametrize("name", CASES)
def test_every_case_has_a_figure_a_table_and_its_command(name):
    text = (FOLDER / "gallery.md").read_text(encoding="utf-8")
    mine = [one for one in re.split(r"^## ", text, flags=re.MULTILINE) if f"--only {name}`" in one]
    assert len(mine) == 1
    assert [path.stem for path in pictures(mine[0])] == [name]
    assert f"\n| {name} | " in mine[0]


@pytest.mark.parametrize("name", [*EXPERIMENTS, *get_command(studies).commands])
def test_every_published_experiment_and_study_has_figures_a_table_and_its_command(name):
    text = part("experiments.md", f"### {name}")
    assert pictures(text)
    program = "livepde reproduce" if name in EXPERIMENTS else "python -m experiments"
    assert f"`{program} {name}`" in text
    assert "| number | value |" in text
    assert "FAILED" not in text


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_has_a_figure_what_it_prints_and_its_command(name, maker):
    text = part("experiments.md", f"### {name}")
    assert pictures(text)
    assert f"`python -m experiments.{name}" in text
    kept = (FOLDER / "experiments" / f"{name}.txt").read_text(encoding="utf-8")
    assert maker.drawn(name, kept) is not None
    assert f"    {maker.shown(name, kept).splitlines()[0]}" in text


@pytest.mark.parametrize("name", PROGRAMS)
def test_every_example_shows_what_it_prints(name):
    text = part("experiments.md", f"### {name}")
    assert f"`python examples/{name}.py`" in text
    assert re.search(r"^    .*\S", text, re.MULTILINE)


def test_a_table_becomes_dots(maker):
    text = "\n".join(
        ["changed   k", "nothing     2.93 ± 0.11   2.21 ± 0.46   2.56 ± 0.25      18.6 h"]
    )
    (axes,) = maker.drawn("borehole", text).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["nothing"]
    drawn = [line.get_xdata().tolist() for line in axes.lines if len(line.get_xdata())]
    assert drawn[0] == [2.93]
    assert maker.drawn("ten_lines", text) is None
    text = "single run: 1.0\n\nexample  auto\nseed   0%  0.5  0.4  1.25"
    assert maker.shown("auto_gain", text).splitlines()[0] == "example  auto"
    assert maker.shown("jumps", "row\n" * 100).endswith("... (55 lines more)")
