"""Every example runs and finds what it says; every Python block of README and docs runs."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


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
    }


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("ten_lines", {"k": 0.8, "s": 1.5}),
        ("own_pde", {"D": 0.6, "r": 1.4}),
        ("nonlinear_sensor", {"k": 0.8, "s": 1.5}),
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


def test_sensors_that_blur_need_a_regularised_inverse():
    found = load("smoothing_sensor").main()
    inverse, *regularised = found.values()
    assert inverse[0] > 10  # alpha = 0: the reconstructed state is noise
    assert inverse[1] > 10
    for state, q in regularised:
        assert state < 0.02
        assert q < 0.2


def test_a_new_pde_takes_forty_lines():
    lines = (ROOT / "examples" / "own_pde.py").read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("def fisher_kpp"))
    stop = next(k for k, line in enumerate(lines) if line.startswith("def main"))
    assert stop - start <= 40


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_of_the_pages_run(page):
    """The blocks of a page share one namespace, as a reader types them one after the other."""
    namespace = {}
    for block in BLOCK.findall(page.read_text()):
        exec(compile(block, str(page), "exec"), namespace)


def test_the_readme_has_python_to_run():
    assert BLOCK.findall((ROOT / "README.md").read_text())
