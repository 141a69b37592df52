"""Every example runs and finds its truth; every equation has a section in the docs."""

import importlib
import importlib.util
import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import livepde as lp
from livepde.cli import app
from livepde.models import EQUATIONS

pytestmark = pytest.mark.pages

ROOT = Path(__file__).parents[1]
EXTENDING = ROOT / "docs" / "extending.md"
TOML = re.compile(r"^```toml[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
BLOCK = re.compile(r"^```python[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)


def load(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested():
    found = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert found == {
        "ten_lines",
        "own_pde",
        "own_sensor",
        "own_law",
        "nonlinear_sensor",
        "smoothing_sensor",
        "beside",
        "heated_rod",
        "room_wall",
        "battery_charge",
        "live_shards",
        "live_shards_ray",
        "petsc_heat",  # both by test_petsc.py
        "petsc_reaction",
    }


@pytest.mark.parametrize("path", sorted((ROOT / "experiments").glob("*.py")), ids=lambda p: p.stem)
def test_experiments_find_what_they_import(path):
    assert importlib.import_module(f"experiments.{path.stem}").__doc__


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("ten_lines", {"k": 0.8, "s": 1.5}),
        ("own_pde", {"k": 21.0, "eps": 0.8}),
        ("nonlinear_sensor", {"k": 0.8, "s": 1.5}),
        ("beside", {"alpha": 9.7e-5}),
        ("heated_rod", {"k": 12.0}),
    ],
)
def test_examples_find_their_truth(name, truth):
    found = load(name).main()
    for key, value in truth.items():
        estimate, std = found[key]
        assert abs(estimate - value) < 3 * std
        assert std < 0.05 * value


@pytest.mark.parametrize("name", ["own_sensor", "own_law"])
def test_examples_pass_their_checks(name):
    load(name).main().raise_if_failed()


def test_a_room_is_warm_in_time_behind_a_wall_that_nobody_knows():
    pytest.importorskip("do_mpc")
    found = load("room_wall").main(days=3)
    assert found["hours too cold"][0] <= 1.0
    assert found["k[masonry]"][0] == pytest.approx(1.4, rel=0.05)
    assert found["k[insulation]"][0] == pytest.approx(1.7, rel=0.1)


def test_a_battery_is_charged_within_its_limit_while_it_is_learned():
    pytest.importorskip("do_mpc")
    found = load("battery_charge").main()
    assert found["mean"] == pytest.approx(0.75, abs=0.005)
    assert found["highest"] < 0.855
    assert abs(found["D"] - 1) < 3 * found["std"] < 0.15


def test_sensors_that_blur_need_a_regularised_inverse():
    found = load("smoothing_sensor").main()
    inverse, *regularised = found.values()
    assert inverse[0] > 10  # alpha = 0: the reconstructed state is noise
    assert inverse[1] > 10
    for state, q in regularised:
        assert state < 0.02
        assert q < 0.2


def test_a_new_pde_takes_forty_lines_which_the_page_shows():
    """Model, data and checks together; what the docs show is the file that runs."""
    example = (ROOT / "examples" / "own_pde.py").read_text()
    assert len(example.splitlines()) <= 40
    first, *_ = BLOCK.findall(EXTENDING.read_text())
    assert first == example


def test_the_case_of_a_new_pde_finds_the_truth(tmp_path, monkeypatch):
    """The page runs it; without its channel or without permission it is one sentence."""
    example = ROOT / "examples" / "own_pde.py"
    (tmp_path / "own_pde.py").write_text(example.read_text())
    (case,) = TOML.findall(EXTENDING.read_text())
    (tmp_path / "rod.toml").write_text(case)
    (data,) = (block for block in BLOCK.findall(EXTENDING.read_text()) if "rod.csv" in block)
    monkeypatch.chdir(tmp_path)
    exec(data, vars(load("own_pde")))
    (tmp_path / "less.toml").write_text(re.sub(r"^a = .*\n", "", case, flags=re.MULTILINE))
    with pytest.raises(lp.errors.CaseError, match=r"channels\.a is missing: the equation reads it"):
        CliRunner().invoke(
            app, ["run", str(tmp_path / "less.toml"), "--allow-code"], catch_exceptions=False
        )
    command = ["run", str(tmp_path / "rod.toml"), "--json", "--out", str(tmp_path / "run")]
    with pytest.raises(lp.errors.CaseError, match="add --allow-code"):
        CliRunner().invoke(app, command, catch_exceptions=False)
    result = CliRunner().invoke(app, [*command, "--allow-code"], catch_exceptions=False)
    found = json.loads(result.output)["measures"]
    assert abs(found["k"] - 21.0) < 3 * found["k.std"] < 0.2
    assert abs(found["eps"] - 0.8) < 3 * found["eps.std"] < 0.02


@pytest.mark.parametrize("name", EQUATIONS)
def test_every_equation_has_a_line_and_an_example(name):
    """Its line in the table, and links of the page of cases, lead to a section with an example."""
    page = (ROOT / "docs" / "models.md").read_text()
    sections = {}
    for section in re.split(r"^## ", page, flags=re.MULTILINE)[1:]:
        title = section.splitlines()[0]
        sections[re.search(r"\{#(\w+)\}$", title)[1]] = (title, section)
    (anchor,) = re.findall(rf"^\| \[`{name}`\]\(#(\w+)\)", page, flags=re.MULTILINE)
    title, section = sections[anchor]
    assert f"`{name}`" in title
    assert BLOCK.search(section)
    for line in (ROOT / "docs" / "cases.md").read_text().splitlines():
        for named, to in re.findall(r"\[`(\w+)`\]\(models\.md#(\w+)\)", line):
            assert named != name or to == anchor
