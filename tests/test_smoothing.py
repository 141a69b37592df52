"""Causal smoothers: exactness, lag, noise, missing values."""

import numpy as np
import pytest

import livepde as lp
from livepde.streams import Exponential, LocalPolynomial, WindowAverage

STAGES = [
    WindowAverage(0.5),
    LocalPolynomial(0.5),
    LocalPolynomial(0.5, degree=2),
    Exponential(0.3),
]


def irregular(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.2, count))


def smooth(stage, times, values):
    stream = stage(list(zip(times, np.reshape(values, (len(times), -1)), strict=True)))
    return np.array([sample.z for sample in stream])


@pytest.mark.parametrize("stage", STAGES, ids=repr)
def test_constants_pass(stage):
    found = smooth(stage, irregular(60), np.full((60, 2), [3.0, -1.0]))
    np.testing.assert_allclose(found, np.full((60, 2), [3.0, -1.0]), rtol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_local_polynomials_are_exact_for_their_degree_at_any_spacing(degree):
    times = irregular(80)
    values = (times - 2.0) ** degree
    found = smooth(LocalPolynomial(0.7, degree=degree), times, values)
    np.testing.assert_allclose(found[:, 0], values, atol=1e-8)
    rough = smooth(LocalPolynomial(0.7, degree=degree - 1), times, values)
    assert np.abs(rough[20:, 0] - values[20:]).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("degree", [1, 2])
def test_what_a_local_polynomial_misses_falls_with_its_order(degree):
    times = 0.01 * np.arange(400)
    errors = [
        np.abs(
            smooth(LocalPolynomial(w, degree=degree), times, np.sin(times))[100:, 0]
            - np.sin(times[100:])
        ).max()
        for w in (0.4, 0.2)
    ]
    assert np.log2(errors[0] / errors[1]) > degree + 0.8


def test_lag_is_as_stated():
    h, times = 0.1, 0.1 * np.arange(200)
    late = times - smooth(WindowAverage(0.5), times, times)[:, 0]
    np.testing.assert_allclose(late[10:], 2 * h, rtol=1e-9)
    a = 1 - np.exp(-h / 0.3)
    late = times - smooth(Exponential(0.3), times, times)[:, 0]
    np.testing.assert_allclose(late[-1], h * (1 - a) / a, rtol=1e-9)


@pytest.mark.parametrize("stage", STAGES, ids=repr)
def test_smoothers_are_causal(stage):
    times, rng = irregular(50), np.random.default_rng(1)
    values = rng.standard_normal(50)
    other = values.copy()
    other[30:] += 1.0
    first, second = smooth(stage, times, values), smooth(stage, times, other)
    np.testing.assert_array_equal(first[:30], second[:30])
    assert np.all(first[30] != second[30])


@pytest.mark.long
@pytest.mark.parametrize("stage", STAGES, ids=repr)
def test_std_and_d_rate_are_those_of_the_smoothed_noise(stage):
    """Over 4000 independent channels, at the last of 40 irregular times."""
    times, sigma = irregular(40), 0.3
    noise = sigma * np.random.default_rng(2).standard_normal((40, 4000))
    stream = type(stage)(**{**vars(stage), "noise": sigma})(list(zip(times, noise, strict=True)))
    found = np.array([sample.z for sample in stream])
    rate = (found[-1] - found[-2]) / (times[-1] - times[-2])
    assert np.std(found[-1]) == pytest.approx(stream.std[0], rel=0.05)
    assert np.std(rate) == pytest.approx(stream.d_rate[0], rel=0.05)
    assert stream.norm_d_rate() == pytest.approx(np.sqrt(4000) * stream.d_rate[0])
    assert stream.norm_d_rate(4 * np.eye(4000)) == pytest.approx(2 * stream.norm_d_rate())


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES, ids=repr)
def test_sigma_is_learned_from_the_data(stage):
    times = 0.02 * np.arange(1000)
    noise = np.random.default_rng(3).standard_normal((1000, 2)) * [0.1, 0.4]
    stream = stage(list(zip(times, np.sin(times)[:, None] + noise, strict=True)))
    for _ in stream:
        pass
    np.testing.assert_allclose(stream.sigma, [0.1, 0.4], rtol=0.1)


@pytest.mark.parametrize("stage", STAGES, ids=repr)
def test_missing_values_stay_missing_and_change_nothing_else(stage):
    times, rng = irregular(40), np.random.default_rng(4)
    values = rng.standard_normal((40, 2))
    gaps = values.copy()
    gaps[rng.random(40) < 0.3, 1] = np.nan
    gaps[0, 1] = np.nan
    stream = stage(list(zip(times, gaps, strict=True)))
    found = np.array([sample.z for sample in stream])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(gaps))
    np.testing.assert_allclose(found[:, 0], smooth(stage, times, values[:, 0])[:, 0], rtol=1e-9)
    alone = np.isfinite(gaps[:, 1])
    np.testing.assert_allclose(
        found[alone, 1], smooth(stage, times[alone], gaps[alone, 1])[:, 0], rtol=1e-9
    )


def test_samples_by_name_keep_inputs_and_other_channels():
    samples = [
        lp.Sample(float(k), {"T": float(k), "P": 10.0 * k}, {"Q": float(k)}) for k in range(5)
    ]
    found = list(WindowAverage(2.0, channels=["T"])(samples))
    assert found[4].z == {"T": 3.5, "P": 40.0}
    assert found[4].inputs == {"Q": 4.0}
    both = list(WindowAverage(2.0)(samples))
    assert both[4].z == {"T": 3.5, "P": 35.0}
    gap = [samples[0], lp.Sample(1.0, {"P": 10.0}), samples[2]]
    assert list(WindowAverage(2.0)(gap))[1].z == {"P": 5.0}


def test_a_smoothed_stream_can_be_read_again_and_knows_its_length():
    stream = WindowAverage(1.0)([(0.0, [1.0]), (0.5, [2.0])])
    assert len(stream) == 2
    assert [float(s.z[0]) for s in stream] == [float(s.z[0]) for s in stream] == [1.0, 1.5]
    with pytest.raises(TypeError, match="no length"):
        len(WindowAverage(1.0)(iter(())))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: WindowAverage(0.0), "width must be a positive"),
        (lambda: Exponential(-1.0), "time must be a positive"),
        (lambda: LocalPolynomial(1.0, degree=-1), "degree must be >= 0"),
        (lambda: WindowAverage(1.0, noise=[1.0, -1.0]), "noise must be a positive"),
        (lambda: WindowAverage(1.0).noise_factor(0.0), "h must be a positive"),
    ],
)
def test_wrong_settings(make, words):
    with pytest.raises(lp.errors.ConfigurationError, match=words):
        make()


@pytest.mark.parametrize("stage", STAGES, ids=repr)
def test_wrong_samples(stage):
    with pytest.raises(lp.errors.SampleError, match="not later"):
        list(stage([(1.0, [0.0]), (1.0, [0.0])]))
    with pytest.raises(lp.errors.SampleError, match="shape"):
        list(stage([(1.0, [0.0]), (2.0, [0.0, 1.0])]))
    wrong = type(stage)(**{**vars(stage), "noise": [1.0, 2.0]})
    with pytest.raises(lp.errors.ConfigurationError, match="2 values of noise for 1 channels"):
        list(wrong([(1.0, [0.0])]))
