"""The suite that asv runs: it finds the numbers of `python -m benchmarks`, here at quick sizes."""

from __future__ import annotations

import importlib
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from commands import bench
from typer.main import get_command

from benchmarks.__main__ import app
from livepde.runs import Outcome

pytestmark = pytest.mark.study

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def costs(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("suite", "suite.costs"):
        sys.modules.pop(name, None)
    return importlib.import_module("suite.costs")


def test_the_configuration_names_the_suite():
    found = json.loads((FOLDER / "asv.conf.json").read_text())
    assert (FOLDER / found["benchmark_dir"] / "costs.py").is_file()
    assert (FOLDER / found["repo"] / "pyproject.toml").is_file()


def test_steps_are_ratios(costs, monkeypatch):
    monkeypatch.setattr(costs.Step, "params", ((12,), costs.LAWS))
    monkeypatch.setattr(costs, "MODES", 2)
    suite = costs.Step()
    found = suite.setup_cache()
    ratios = [suite.track_ratio(found, 12, law) for law in costs.LAWS]
    assert all(ratio > 0.0 for ratio in ratios)


def test_memory_is_that_of_a_process_of_its_own(costs):
    found = [costs.Memory().track_memory(10_000, law) for law in costs.LAWS]
    assert all(0.1 < each < 100.0 for each in found)  # a matrix of its own needs more


def test_a_fleet_is_held_against_separate_runs(costs, monkeypatch):
    monkeypatch.setattr(costs.Fleet, "members", 2)
    monkeypatch.setattr(costs.Fleet, "runs", 2)
    monkeypatch.setattr(sys.modules["benchmarks.fleet"], "SAMPLES", 100)
    suite = costs.Fleet()
    found = suite.setup_cache()
    assert suite.track_step(found) > 0.0
    assert suite.track_command(found) > 0.0


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


@pytest.mark.parametrize(
    ("words", "seeds", "told"),
    [
        ("", 5, " --seeds 5"),
        ("--quick", 1, " --quick"),
        ("--quick --seeds 3", 3, " --seeds 3 --quick"),
    ],
)
def test_what_is_given_wins_over_quick(words, seeds, told, monkeypatch):
    taken = []

    def alarms(number, **options):
        taken.append((number, options["few"]))
        return Outcome()

    monkeypatch.setattr("benchmarks.alarms.alarms", alarms)
    code, output = bench("alarms", *words.split(), "--json")
    assert (code, taken) == (0, [(seeds, "--quick" in words)])
    assert json.loads(output)["command"] == f"python -m benchmarks alarms{told}"


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


def test_the_page_of_costs_shows_all_that_was_measured(page, tmp_path):
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
    assert page.remembered({"scale": found}) == {"scale": [(1_000, 1.5)]}


def test_what_a_benchmark_prints_is_kept(page, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MEASURED", tmp_path / "performance")
    page.measure(["step"], [12])
    found = json.loads((tmp_path / "performance" / "step.json").read_text())
    assert re.fullmatch("[0-9a-f]{8}", found["commit"])
    assert {row["nodes"] for row in page.rows_of(found)} == {12}
    assert len({row["law"] for row in page.rows_of(found)}) > 3
    with pytest.raises(SystemExit, match="no JSON"):
        page.measure(["nonsense"], [])


# --- the page of peers ---------------------------------------------------------------------------


def test_the_page_of_peers_shows_all_that_was_measured(page, tmp_path):
    del page  # its folder is on the path
    sys.modules.pop("peers", None)
    peers = importlib.import_module("peers")
    folder = tmp_path / "peers"
    folder.mkdir()
    columns = ["noise", "estimator", "error", "mean"]
    check = {"name": "cost", "value": 1.5, "bound": 1.0, "sense": "<=", "ok": False}
    for name, cost in (("rod", 4.25), ("wall", 2.5)):
        table = {
            "title": f"{name}, 1 seed",
            "columns": columns,
            "rows": [["1%", "lean", 0.5, cost]],
        }
        content = {"commit": "0123abcd", "command": f"python -m benchmarks peers --only {name}"}
        (folder / f"{name}.json").write_text(
            json.dumps(content | {"checks": [check], "tables": [table], "notes": ["a note"]})
        )
    peers.write(tmp_path)
    text = (folder / "results.md").read_text()
    assert text.startswith("# Comparison with peers")
    assert text.index("## rod") < text.index("| 1% | lean | 0.5 | 4.25 |") < text.index("## wall")
    assert text.count("python -m benchmarks peers --only wall") == 1
    assert text.count("FAILED") == 2
    assert "a note" not in text


def test_the_page_of_peers_knows_the_problems_of_the_benchmark(page):
    del page
    peers = importlib.import_module("peers")
    assert set(peers.PROBLEMS) == set(importlib.import_module("benchmarks.peers").PROBLEMS)


def test_what_the_benchmark_of_peers_prints_is_kept(page, tmp_path, monkeypatch):
    del page
    peers = importlib.import_module("peers")
    monkeypatch.setattr(peers, "MEASURED", tmp_path / "peers")
    monkeypatch.setattr(peers, "printed", lambda words: {"command": " ".join(words)})
    peers.measure(["rod", "wall"])
    found = json.loads((tmp_path / "peers" / "rod.json").read_text())
    assert found["command"] == "peers --only rod --seeds 16 --json"
    assert (tmp_path / "peers" / "wall.json").is_file()
