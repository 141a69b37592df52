"""The walks of docs/first-hour.md: what the page shows is what runs, and it finds the truth.

The page itself is run by tests/test_pages.py, word for word.
"""

from __future__ import annotations

import re
import tomllib

import numpy as np
import pytest
from scipy.special import exp1

from benchmarks import ROOT
from benchmarks.first_hour import FOLDER, WALKS, WELLS, WRITTEN, aquifer, write

PAGE = (ROOT / "docs" / "first-hour.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "name", ["furnace.toml", "borehole.toml", "pumping.toml", "wall.toml", "plate.py"]
)
def test_the_page_shows_the_files(name: str) -> None:
    shown = (FOLDER / name).read_text(encoding="utf-8")
    assert shown in PAGE
    limit = 15 if name.endswith(".toml") else 26  # twenty lines of code
    assert len(shown.splitlines()) <= limit


@pytest.mark.long
@pytest.mark.parametrize("walk", WALKS)
def test_the_tables_are_those_of_another_code(walk: str, tmp_path) -> None:
    write(tmp_path, walk, WRITTEN)
    for file in tmp_path.iterdir():
        assert file.read_text() == (FOLDER / file.name).read_text()


@pytest.mark.parametrize("walk", ["furnace", "borehole", "pumping", "wall"])
def test_the_page_tells_the_truths(walk: str, tmp_path) -> None:
    for name, truth in write(tmp_path, walk, WRITTEN).items():
        told = re.findall(rf"\b{name} = ([\d.]+)", PAGE)
        assert any(float(value) == pytest.approx(truth, rel=1e-3) for value in told)


def test_the_truth_of_the_pumping_test_is_that_of_theis() -> None:
    T, S, Q, seconds = 4e-3, 3e-4, 1e-2, 60.0 * np.arange(200.0)
    shown = aquifer(T, S, seconds, np.full(len(seconds), Q))
    for r, drawdown in zip(WELLS, shown.T, strict=True):
        exact = Q / (4 * np.pi * T) * exp1(r**2 * S / (4 * T * seconds[1:]))
        np.testing.assert_allclose(drawdown[1:], exact, atol=1e-4)


def test_each_case_is_one_file_without_a_law() -> None:
    for name in ("furnace.toml", "borehole.toml", "pumping.toml", "wall.toml"):
        case = tomllib.loads((FOLDER / name).read_text(encoding="utf-8"))
        assert not {"law", "steps", "intake"} & set(case)
