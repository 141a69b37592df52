"""The examples of docs/first-hour.md run as shown, and find the truth.

The page itself is run by tests/test_pages.py, word for word.
"""

import re
import tomllib

import numpy as np
import pytest
from scipy.special import exp1

from benchmarks import ROOT, first_hour
from benchmarks.first_hour import FOLDER, WALKS, WELLS, WRITTEN, aquifer, write
from benchmarks.honest.linear import fine_times

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


@pytest.mark.slow
def test_noise_of_the_inputs_of_the_wall_spreads_as_draws_do() -> None:
    k, C, rows = 0.8, 1.5e6, 60
    rng, times = np.random.default_rng(0), first_hour.WALL_STEP * np.arange(rows)
    fine, faces = fine_times(times), first_hour._faces(k, C)
    noise = rng.standard_normal((1600, rows, 2)) * [first_hour.WALL_FLUX, first_hour.WALL_KELVIN]
    noise[:, 0] = 0.0  # the covariance has triangles of two intervals only
    drawn = [
        faces.respond(
            np.column_stack([np.interp(fine, times, c) for c in one.T]), first_hour.WALL_STEP
        )[:, 0]
        for one in noise
    ]
    found = first_hour.wall_noise({"k": k, "C": C}, rows - 1)
    np.testing.assert_allclose(np.cov(np.array(drawn)[:, 1:].T), found, atol=0.2 * found.max())
