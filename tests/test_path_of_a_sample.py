"""The path of one sample in CONTRIBUTING.md is the one that a profiler sees."""

import cProfile
import pstats
import re
from pathlib import Path

import numpy as np
import pytest

import livepde as lp
from livepde.models import heat

PAGE = Path(__file__).parent.parent / "CONTRIBUTING.md"
SOURCE = Path(lp.__file__).parent


def documented() -> list[tuple[str, list[str]]]:
    """Return functions of the path, and the files that the page gives for each."""
    table = PAGE.read_text().split("### The path of one sample")[1].split("\n### ")[0]
    found = []
    for line in table.splitlines():
        if not line.startswith("| `"):
            continue
        _, what, where, _ = line.split("|")
        named = what.split(":")[0]
        files = list(re.findall(r"`([\w/]+\.py)`", where))
        found += [(name, files) for name in re.findall(r"`([\w.]+)`", named)]
    return found


@pytest.fixture(scope="module")
def called() -> set[tuple[str, str]]:
    """File and name of each function of the package that one usual sample passes."""
    model = heat(lp.interval(0.0, 1.0, 30), lp.Normal(0.1, std=0.05))
    sensors = lp.Points({"a": 0.3, "b": 0.6}, noise=0.05)
    rod = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=lambda x: np.cos(np.pi * x[0]))
    for k in range(1, 40):
        rod.step(0.1 * k, [0.5, -0.2])
    profile = cProfile.Profile()
    with profile:
        rod.step(4.0, [0.5, -0.2]).belief  # noqa: B018
    return {
        (str(Path(file).relative_to(SOURCE)), name)
        for file, _, name in pstats.Stats(profile).stats
        if file.startswith(str(SOURCE))
    }


def test_the_path_names_ten_functions():
    assert len(documented()) >= 10


@pytest.mark.parametrize(("name", "files"), documented(), ids=lambda one: str(one))
def test_a_profiler_sees_each_of_them(name: str, files: list[str], called: set[tuple[str, str]]):
    method = name.rpartition(".")[2]
    assert files
    if method[0].isupper():  # a class: one of its methods runs
        assert {file for file, _ in called} & set(files)
    else:
        assert {(file, method) for file in files} & called
