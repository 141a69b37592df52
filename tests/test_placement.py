"""The predicted benefit of an additional sensor is correct."""

from pathlib import Path
from typing import Any

import pytest
from factories import short_rod
from typer.testing import CliRunner

import livepde as lp
from livepde import cases
from livepde.cases.preview import Advice, advise, preview
from livepde.cli import app

pytestmark = pytest.mark.slow

START = {"initial": "20 degC"}
LAYERS = {
    "unknowns.alpha.regions.near": ["0 cm", "20 cm"],
    "unknowns.alpha.regions.far": ["20 cm", "40 cm"],
}
FIELD = {
    "unknowns.alpha.field": True,
    "unknowns.alpha.length": "20 cm",
    "unknowns.alpha.transform": "logit",
}
SENSOR = "channels.T_20"  # for validation in the template: now a third sensor, somewhere


@pytest.fixture
def rod(tmp_path: Path) -> Path:
    return short_rod(tmp_path / "rod", 91)


def prepared(path: Path, *settings: dict[str, Any]) -> cases.Prepared:
    changed = {key: value for some in (START, *settings) for key, value in some.items()}
    return cases.load(path, settings=changed).prepare()


def advice(path: Path, *settings: dict[str, Any]) -> Advice:
    found = prepared(path, *settings)
    return advise(found, found.stream)


def test_the_sensor_does_what_was_promised(rod: Path):
    found = advice(rod, LAYERS)
    assert found.candidates == 41
    at = f"{100 * found.position[0]} cm"
    new = {SENSOR: {"role": "sensor", "column": "T_20", "at": at, "noise": "0.05 K"}}
    for settings, left in ((LAYERS, found.now), (LAYERS | new, found.then)):
        case = prepared(rod, settings)
        told = {item.name: item.left for item in preview(case, case.stream).unknowns}
        assert told == pytest.approx(dict(left), rel=2e-2)


@pytest.mark.long
def test_no_other_vertex_is_better(rod: Path):
    def mean(at: float) -> float:
        new = {SENSOR: {"role": "sensor", "column": "T_20", "at": f"{at} m", "noise": "0.05 K"}}
        case = prepared(rod, LAYERS, new)
        return sum(item.left**2 for item in preview(case, case.stream).unknowns)

    best = float(advice(rod, LAYERS).position[0])
    assert all(mean(best) <= 1.01 * mean(at) for at in (0.05, 0.25, 0.35))


def test_a_field_counts_with_its_mean_over_the_domain(rod: Path):
    found = advice(rod, FIELD)
    assert set(found.now) == {"alpha"}
    assert 0 < found.then["alpha"] < found.now["alpha"] < 1


WALK = {"unknowns.alpha.evolution": {"kind": "random-walk", "rate": "1e-6 m^2/s/s^0.5"}}


@pytest.mark.long
def test_of_unknowns_that_move_it_keeps_its_promise_too(rod: Path):
    found = advice(rod, LAYERS, WALK)
    assert found.candidates == 41
    at = f"{100 * found.position[0]} cm"
    new = {SENSOR: {"role": "sensor", "column": "T_20", "at": at, "noise": "0.05 K"}}
    for settings, left in ((LAYERS, found.now), (LAYERS | new, found.then)):
        case = prepared(rod, settings, WALK)
        told = {item.name: item.left for item in preview(case, case.stream).unknowns}
        assert told == pytest.approx(dict(left), rel=2e-2)
    assert sum(s**2 for s in found.then.values()) < sum(s**2 for s in found.now.values())


def test_what_it_cannot_say(rod: Path):
    rod.write_text(rod.read_text().replace('"sensitivity"', '"gradient"'))
    with pytest.raises(lp.errors.ConfigurationError, match="needs a law with a covariance"):
        advice(rod)


def test_the_command_shows_it_when_asked(rod: Path):
    runner = CliRunner()
    asked = runner.invoke(app, ["check", str(rod), "--advise"])
    assert asked.exit_code == 0
    assert "One more sensor helps most at" in asked.stdout
    assert "Best of 41 vertices" in asked.stdout
    assert "One more sensor" not in runner.invoke(app, ["check", str(rod)]).stdout
