"""The suite that asv runs: it finds the numbers of `livepde bench`, here at quick sizes."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

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
    assert all(ratio > 1.0 for ratio in ratios)  # a step simulates, too


def test_memory_is_that_of_a_process_of_its_own(costs):
    found = [costs.Memory().track_memory(1_600, law) for law in costs.LAWS]
    assert all(0.0 < each < 1000.0 for each in found)


def test_a_fleet_is_held_against_separate_runs(costs, monkeypatch):
    monkeypatch.setattr(costs.Fleet, "members", 2)
    monkeypatch.setattr(costs.Fleet, "runs", 2)
    suite = costs.Fleet()
    found = suite.setup_cache()
    assert suite.track_step(found) > 0.0
    assert suite.track_command(found) > 0.0
