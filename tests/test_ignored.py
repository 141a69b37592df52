"""Validation sensors affect the verdict of a run; ignored sensors do not."""

import pandas as pd
import pytest
from commands import call
from factories import short_rod

import livepde as lp
from livepde import cases, runs
from livepde.errors import ConfigurationError


@pytest.fixture
def faulty(tmp_path, monkeypatch):
    """Return the case of `livepde init` whose validation sensor reads too much."""
    monkeypatch.chdir(tmp_path)
    path = short_rod(tmp_path / "rod", 61)
    table = pd.read_csv(path.parent / "rod.csv")
    table["T_20"] += 2.0
    table.to_csv(path.parent / "rod.csv", index=False)
    return path


def outcome(path, settings, folder):
    code, output = call("run", path, "--out", folder, *settings)
    assert code == 0, output
    data = runs.open(folder).dataset
    return runs.verdict(data), runs.measures(data), output


@pytest.mark.long
def test_a_faulty_sensor_counts_only_while_it_is_validation(faulty):
    found, numbers, _ = outcome(faulty, [], "validation")
    assert found.level == "do not trust"
    assert numbers["rmse.validation"] > 1.5
    (finding,) = (one for one in found.findings if one.what == "validation")
    assert 'role = "ignored"' in finding.sentence
    assert not any(cause.setting for cause in finding.causes)  # assimilating it mends nothing
    ignored = ["--set", "channels.T_20.role=ignored"]
    found, numbers, output = outcome(faulty, ignored, "ignored")
    assert found.level == "trusted"
    assert not {name for name in numbers if name in ("rmse.validation",)}
    assert numbers["rmse.T_20"] > 1.5  # it is shown
    assert numbers["rmse"] < 0.2
    assert "ignored" in output


def test_an_ignored_sensor_keeps_its_keys(faulty):
    settings = {"channels.T_10.offset": "0.2 K", "channels.T_10.noise": "0.1 K"}
    settings |= {"channels.T_20.role": "sensor", "channels.T_20.noise": "0.1 K"}
    freed = cases.load(faulty, settings=settings)
    assert "offset[T_10]" in freed.model.parameter_space.labels
    case = cases.load(faulty, settings={**settings, "channels.T_10.role": "ignored"})
    assert case.ignored == ("T_10",)
    assert "offset[T_10]" not in case.model.parameter_space.labels
    assert case.prepare().identifier.ignored == ("T_10",)


def test_only_validation_sensors_can_be_ignored(faulty):
    case = cases.load(faulty)
    with pytest.raises(ConfigurationError, match="none of the sensors in validation"):
        lp.Identifier(
            case.model, case.observation, case.law, validation=case.validation, ignored=["T_10"]
        )
