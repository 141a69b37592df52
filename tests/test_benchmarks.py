"""The asv suite gives the numbers of `python -m benchmarks`, here at small sizes."""

import importlib
import json
import shutil
import sys
from pathlib import Path

import pytest
from commands import bench
from typer.main import get_command

from benchmarks.__main__ import app

pytestmark = pytest.mark.study

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def costs(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("suite", "suite.costs"):
        sys.modules.pop(name, None)
    return importlib.import_module("suite.costs")


def test_steps_are_ratios(costs, monkeypatch):
    monkeypatch.setattr(costs.Step, "params", ((12,), costs.LAWS))
    monkeypatch.setattr(costs, "MODES", 2)
    suite = costs.Step()
    found = suite.setup_cache()
    ratios = [suite.track_ratio(found, 12, law) for law in costs.LAWS]
    assert all(ratio > 0.0 for ratio in ratios)


# --- commands ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", get_command(app).commands)
def test_a_quick_run_ends_with_its_checks(name, data_dir, monkeypatch):
    """Small sizes miss some bounds: the exit code says whether all hold."""
    if name == "petsc" and shutil.which("mpirun") is None:
        pytest.skip("needs several ranks")
    monkeypatch.setenv("LIVEPDE_DATA", str(data_dir))
    code, output = bench(name, "--quick", "--json")
    content = json.loads(output.splitlines()[-1])
    assert content["command"] == f"python -m benchmarks {name} --quick"
    assert content["tables"]
    assert content["checks"]
    assert code == (not all(check["ok"] for check in content["checks"]))


# --- the page of costs ---------------------------------------------------------------------------


@pytest.fixture
def page(monkeypatch):
    pytest.importorskip("matplotlib", reason="the extra 'plots' is not installed")
    monkeypatch.syspath_prepend(str(FOLDER.parent / "docs"))
    sys.modules.pop("performance", None)
    return importlib.import_module("performance")


def output(ratio: float, *, nodes: int, ok: bool = True) -> str:
    """Return what `python -m benchmarks step --json` prints."""
    law = "gradient, gain 1, c1 0.1"
    check = {"name": f"{nodes}", "value": ratio, "bound": 3.0, "sense": "<=", "ok": ok}
    table = {
        "title": "Steps",
        "columns": ["nodes", "law", "min", "median", "max", "bound"],
        "rows": [
            [nodes, law, ratio, ratio, ratio, 3.0],
            [nodes, "sensitivity", 1.0, 2.0, 3.0, None],
        ],
    }
    content = {
        "commit": "0123abcd",
        "command": "python -m benchmarks step",
        "checks": [check],
        "tables": [table],
        "notes": [],
    }
    return json.dumps(content)


def test_the_page_of_costs_shows_all_stored_outputs(page, tmp_path):
    folder = tmp_path / "performance"
    folder.mkdir()
    (folder / "step.json").write_text(output(4.25, nodes=31))
    (folder / "step-again.json").write_text(output(2.75, nodes=31))
    (folder / "step-large.json").write_text(output(2.5, nodes=1_000))
    table = {"title": "Memory", "columns": ["nodes", "kB per unknown"], "rows": [[1_000, 1.5]]}
    found = {"commit": "4567cdef", "command": "python -m benchmarks scale", "checks": []}
    found |= {"tables": [table], "notes": []}
    (folder / "scale.json").write_text(json.dumps(found))
    page.write(tmp_path)
    text = (folder / "costs.md").read_text()
    assert "| 31 | gradient, gain 1, c1 0.1 | 2.75 | 2.75 | 2.75 | 3 |" in text
    assert "| 1000 | sensitivity | 1 | 2 | 3 | – |" in text
    assert "4.25" not in text  # measured again
    assert text.count("python -m benchmarks step\n") == 2  # title and command
    assert text.count("Recorded at commit 0123abcd.\n") == 1
    assert {"step.png", "memory.png"} <= {file.name for file in folder.iterdir()}
    assert page.memory_lines({"scale": found}) == {"scale": [(1_000, 1.5)]}
