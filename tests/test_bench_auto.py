"""`python -m benchmarks auto` checks the self-tuning law, here on the smallest square."""

import numpy as np
import pytest

from benchmarks import auto as bench
from livepde.laws import GradientLaw

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def square():
    return bench.Square.of(64)


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
