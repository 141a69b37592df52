"""The factor on standard deviations is 1 for white innovations, else the theoretical value."""

import numpy as np
import pytest

from livepde.laws.innovations import Innovations
from livepde.linalg import Array


def inflations(
    samples: int, *, sensors: int = 2, rho: float = 0.0, size: float = 1.0, repeats: int = 60
) -> Array:
    """Return the factors for innovations that follow a first-order autoregression."""
    rng, shape = np.random.default_rng(1), (repeats, sensors)
    value, e = Innovations.start(sensors, repeats), rng.standard_normal(shape)
    for _ in range(samples):
        value = value.add(size * e)
        e = rho * e + np.sqrt(1 - rho**2) * rng.standard_normal(shape)
    return value.inflation


@pytest.mark.parametrize("samples", [10, 50, 300])
def test_white_innovations_of_the_stated_size_leave_the_deviations(samples: int):
    found = inflations(samples)
    assert np.median(found) == 1.0
    assert found.mean() < 1.08
    assert np.quantile(found, 0.9) < 1.2


@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_correlated_innovations_count_as_often_as_they_are_independent(rho: float):
    expected = np.sqrt((1 + rho) / (1 - rho))
    assert inflations(400, rho=rho).mean() == pytest.approx(expected, rel=0.1)


def test_innovations_that_are_too_large_count_by_their_size():
    assert inflations(400, size=2.0).mean() == pytest.approx(2.0, rel=0.1)


def test_an_error_below_the_noise_that_does_not_average_out_is_found():
    rng = np.random.default_rng(0)
    value = Innovations.start(2)
    for _ in range(500):
        value = value.add(rng.standard_normal((1, 2)) + 0.4)
    # Averages over 50 samples have the mean 0.4 beside a variance of 1/99.
    assert value.inflation == pytest.approx(np.sqrt(1 + 99 * 0.16), rel=0.2)


def test_the_expected_size_of_averages_holds_from_the_first_sample():
    rng = np.random.default_rng(0)
    for samples in (1, 5, 20):
        value = Innovations.start(1, 400)
        for e in rng.standard_normal((samples, 400, 1)):
            value = value.add(e)
        assert value.persistence.mean() == pytest.approx(1.0, abs=0.2)


def test_nothing_measured_says_nothing():
    value = Innovations.start(2)
    assert value.inflation == value.add(np.full((1, 2), np.nan)).inflation == 1.0
