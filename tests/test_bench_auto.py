"""`python -m benchmarks auto`: promises of the law that tunes itself, on the smallest square."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import auto as bench
from benchmarks.__main__ import app
from livepde.laws import GradientLaw

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def square():
    return bench.Square.of(64)


def test_its_promises_hold_on_the_smallest_square():
    outcome = bench.auto(bench.SIZES[:1], seeds=1, costs=())
    assert len(outcome.tables[0].rows) == len(bench.LEVELS)
    assert len(outcome.checks) == len(bench.LEVELS) + 1
    assert all(check.ok for check in outcome.checks), outcome.checks


def test_noise_is_relative_to_the_readings(square):
    noisy = square.noisy(0.01, seed=3)
    exact = np.array([z for _, z in square.samples])
    error = np.array([z for _, z in noisy]) - exact
    assert error.std() == pytest.approx(0.01 * np.sqrt(np.mean(exact**2)), rel=0.05)
    assert square.noisy(0.0, seed=3) is square.samples


def test_a_gain_that_is_too_large_for_the_noise_is_seen(square):
    """The worst error counts on every sample, and q = 0 has the error 1."""
    assert square.error(np.zeros(square.model.Q.dim)) == 1.0
    course = square.follow(GradientLaw(1e6, gate=None), square.noisy(0.01, seed=0))
    assert course.worst > bench.WORST


def test_the_command_prints_every_check(monkeypatch):
    monkeypatch.setattr(bench, "SAMPLES", 5)
    monkeypatch.setattr(bench, "LEVELS", (0.0,))
    monkeypatch.setattr(bench, "GAINS", (1.0,))
    monkeypatch.setattr(bench.partial, "GAINS", (1e4,))
    monkeypatch.setattr(bench.partial, "END", 1.0)
    found = CliRunner().invoke(app, ["auto", "--quick", "--json"])
    content = json.loads(found.stdout)
    assert content["command"] == "python -m benchmarks auto --quick"
    names = [check["name"] for check in content["checks"]]
    assert [name.split(":")[-1].strip() for name in names] == [
        "largest error with status ok",
        "error / best constant gain",
        "step / forward step, median",
        "error / best constant gain",
        "error at the end / at half of the time",
        "largest error with status ok",
        "operators of 28 refused or accepted wrongly",
    ]
