"""Notebooks run from their folder, and agree with the tool that the field uses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[1] / "examples" / "notebooks"
NAMES = ("pumping_test", "wall")


def cells(name: str) -> list[dict[str, Any]]:
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def executed(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the variables after all cells, without the magic of IPython."""
    monkeypatch.chdir(FOLDER)
    found: dict[str, Any] = {}
    for cell in cells(name):
        if cell["cell_type"] == "code":
            lines = [line for line in cell["source"] if not line.startswith("%")]
            exec(compile("".join(lines), f"{name}.ipynb", "exec"), found)
    return found


def test_every_notebook_is_executed_and_kept_without_outputs():
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == sorted(NAMES)
    for name in NAMES:
        assert all(not cell.get("outputs") for cell in cells(name)), name
        assert all(cell.get("execution_count") is None for cell in cells(name)), name


@pytest.mark.long
def test_the_wall_is_known_where_the_average_method_is_not(monkeypatch):
    pytest.importorskip("matplotlib")
    found = executed("wall", monkeypatch)
    truth = found["truth"]
    assert found["identified"] == pytest.approx(truth, rel=3e-3)
    one_day, three_days = (
        found["comparison"][name] / truth - 1.0 for name in ("one day", "three days")
    )
    for errors in (one_day, three_days):
        assert abs(errors["identification"]) < 0.01
        assert errors["average method"] > 0.05  # the wall warms up after a cold front
    assert abs(found["changes"]["first and last two thirds"]) > 0.05  # ISO 9869 asks for more days


@pytest.mark.long
def test_the_pumping_test_agrees_with_the_theis_equation(monkeypatch):
    pytest.importorskip("matplotlib")
    found = executed("pumping_test", monkeypatch)
    ours, theirs, truth = found["identified"], found["by_theis"], found["truth"]
    for other in (theirs["value"], truth):
        assert (abs(ours["value"] - other) < 2.0 * ours["std"]).all()
    assert (ours["std"] / theirs["std"]).between(0.7, 3.0).all()
