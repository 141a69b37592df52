"""`livepde explain`: causes that a verdict names, and runs with one of them free."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from commands import bad, call
from factories import short_rod

OFFSET = 0.5  # K


@pytest.fixture
def biased(tmp_path, monkeypatch):
    """Return a run of the case of `livepde init` whose sensor reads too much."""
    monkeypatch.chdir(tmp_path)
    path = short_rod(tmp_path / "rod", 121)
    table = pd.read_csv(path.parent / "rod.csv")
    table["T_10"] += OFFSET
    table.to_csv(path.parent / "rod.csv", index=False)
    code, output = call("run", "rod/case.toml", "--out", "run")
    assert code == 0, output
    return "run"


@pytest.mark.long
def test_the_causes_of_a_verdict_are_listed_and_tested(biased):
    code, output = call("explain", biased)
    assert code == 0
    assert "T_10 reads" in output
    assert "channels.T_10.offset=" in output
    code, output = call("explain", biased, "1", "--json", "--data", "rod/rod.csv")
    assert code == 0
    tables = json.loads(output)["tables"]
    rows = {row[0]: row for row in tables[0]["rows"]}
    assert rows["verdict"][1] != "trusted"
    assert rows["verdict"][2] == "trusted"
    value, _, std = rows["offset[T_10]"][2].partition(" ± ")
    assert abs(float(value) - OFFSET) < 4 * float(std)
    errors = {row[0]: row for row in tables[1]["rows"]}
    assert float(errors["T_10"][2]) < 0.5 * float(errors["T_10"][1])


@pytest.mark.long
def test_a_cause_that_is_none_is_refused(biased):
    assert "lists them" in bad("explain", biased, "9")


@pytest.mark.long
def test_without_a_suspect_there_is_nothing_to_test(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short_rod(tmp_path / "rod")
    call("run", "rod/case.toml", "--out", "run")
    code, output = call("explain", "run")
    assert code == 0
    assert "no cause" in " ".join(output.split())


@pytest.mark.long
def test_what_a_cause_frees_is_a_setting_of_a_case(biased):
    from livepde import cases, runs
    from livepde.cases.read import parse

    findings = runs.verdict(runs.open(biased).dataset).findings
    settings = {cause.setting for item in findings for cause in item.causes if cause.setting}
    assert settings
    for setting in settings:
        assert np.isfinite(cases.load("rod/case.toml", settings=parse([setting])).model.Q.dim)
