"""Notebooks run from their folder, and agree with the established tool of the field."""

import json
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[1] / "examples" / "notebooks"
NAMES = ("battery", "pumping_test", "stream_bed", "thermal_response", "wall")


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


@pytest.mark.pages
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


@pytest.mark.pages
def test_the_pumping_test_agrees_with_the_theis_equation(monkeypatch):
    pytest.importorskip("matplotlib")
    found = executed("pumping_test", monkeypatch)
    ours, theirs, truth = found["identified"], found["by_theis"], found["truth"]
    for other in (theirs["value"], truth):
        assert (abs(ours["value"] - other) < 2.0 * ours["std"]).all()
    assert (ours["std"] / theirs["std"]).between(0.7, 3.0).all()


@pytest.mark.pages
def test_the_stream_bed_is_followed_where_a_window_of_waves_mixes_two_flows(monkeypatch):
    pytest.importorskip("matplotlib")
    found = executed("stream_bed", monkeypatch)
    table, kappas = found["comparison"], found["kappas"]
    error = (table[["identification", "amplitude and phase"]].sub(table["truth"], axis=0)).abs()
    assert (error["identification"] < 2.5 * table["std"]).all()
    steady = [4.0, 7.0, 8.0]  # days on which no window contains the change of the flow
    assert (error.loc[steady, "amplitude and phase"] < 0.5e-6).all()
    assert (error.loc[[5.0, 5.5, 6.0], "amplitude and phase"] > 0.5e-6).all()
    assert kappas.to_numpy() == pytest.approx(kappas["truth"], rel=0.03)


@pytest.mark.pages
def test_the_thermal_response_agrees_with_superposed_sources(monkeypatch):
    pytest.importorskip("matplotlib")
    found = executed("thermal_response", monkeypatch)
    ours, theirs, truth = found["identified"], found["by_superposition"], found["truth"]
    assert ((ours["value"] - theirs["value"]).abs() < 2.0 * ours["std"]).all()
    for one in (ours, theirs):
        assert ((one["value"] - truth).abs() < 3.0 * one["std"]).all()
    assert (ours["std"] / theirs["std"]).between(0.7, 3.0).all()
    assert abs(found["by_line"]["k"] - truth["k"]) < 2.0 * found["std_line"]
    assert found["std_line"] > 10.0 * ours.loc["k", "std"]  # it takes the power for noise


@pytest.mark.pages
def test_the_battery_agrees_with_a_least_squares_fit(monkeypatch):
    pytest.importorskip("matplotlib")
    found = executed("battery", monkeypatch)
    ours, theirs = (found["comparison"].loc[name] for name in ("identification", "least squares"))
    assert abs(ours["value"] - theirs["value"]) < 0.5 * theirs["std"]
    assert abs(ours["value"] - found["truth"]) < 2.0 * ours["std"]
    assert ours["std"] / theirs["std"] == pytest.approx(1.0, abs=0.3)
