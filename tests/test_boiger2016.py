"""Both figures of the paper: reduced runs; `livepde reproduce boiger2016` makes all of them."""

import numpy as np
import pytest

from livepde import plots
from livepde.reproduce import boiger2016, seed, seed_excited
from livepde.reproduce.boiger2016 import LEVELS, PAPER, Ensemble

pytestmark = pytest.mark.study

SEEDS = (0, 1)


@pytest.fixture(scope="module")
def excited() -> boiger2016.Runs:
    return boiger2016.excited_noise(seeds=SEEDS, kinds=("band",))[0]


@pytest.fixture(scope="module")
def paper() -> tuple[boiger2016.Runs, dict[float, float]]:
    runs, table, alone = boiger2016.paper_noise(seeds=SEEDS)
    assert len(table.rows) == len(PAPER) * len(LEVELS)
    assert all(len(row) == len(table.columns) for row in table.rows)
    return runs, alone


def test_first_figure() -> None:
    runs, table = boiger2016.first()
    checks = boiger2016.first_checks(runs)
    assert all(check.ok for check in checks), [c.name for c in checks if not c.ok]
    assert [row[0] for row in table.rows] == list(seed.SHOWN)
    assert not any(np.isnan(run.errors).any() for run in runs.values())
    drawn = boiger2016._first(runs[0.0])
    assert [ax.get_ylabel() for ax in drawn.axes] == ["q", "u"]


def test_semiconvergence(excited: boiger2016.Runs) -> None:
    """The least error comes earlier for more noise, and it rises for good at 10 %."""
    checks = boiger2016.semiconvergence(excited, LEVELS)
    assert all(check.ok for check in checks), [c.name for c in checks if not c.ok]
    assert not any(found.failed for found in excited.values())


def test_noise_hides_the_papers_parameter(
    paper: tuple[boiger2016.Runs, dict[float, float]],
) -> None:
    checks = boiger2016._hidden(*paper)
    assert all(check.ok for check in checks), [c.name for c in checks if not c.ok]


def test_second_figure(excited: boiger2016.Runs) -> None:
    drawn = boiger2016._second(excited, "band, mu = 1", seed_excited, None)
    assert len(drawn.axes) == 2 * len(LEVELS)
    assert drawn.axes[3].get_yscale() == "log"


def test_ensemble_figure() -> None:
    t = np.linspace(0.0, 1.0, 5)
    ax = plots.ensemble(t, np.array([[3.0, 2, 1, 2, 3], [3.0, 1, 2, 3, 4]]), levels={"q = 0": 3.0})
    assert len(ax.lines) == 5
    mean = np.array([3.0, 1.5, 1.5, 2.5, 3.5])
    runs = Ensemble(t, np.array([mean, mean]), np.array([mean]), mean[None], None, 0)  # type: ignore[arg-type]
    assert np.allclose(runs.turning, 0.25)
    assert np.allclose(runs.mean, mean)
