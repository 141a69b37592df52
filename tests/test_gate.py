"""The gate of the sensitivity law is on by default, and harmless for correct runs."""

from functools import cache

import numpy as np
import pytest

import livepde as lp
from livepde.models import heat

NOISE = 0.05


def rod(law):
    model = heat(lp.interval(0.0, 1.0, 12), lp.Normal(0.05, 0.03))
    start = lambda x: 10.0 * np.sin(np.pi * x[0])  # noqa: E731
    return lp.Identifier(model, lp.Points([0.3, 0.7], noise=NOISE), law, u0=start)


def readings(count=200, seed=0, noise=NOISE):
    """The first mode of a rod whose ends are insulated decays: with its mean it is a cosine."""
    rng, at, alpha = np.random.default_rng(seed), np.array([0.3, 0.7]), 0.06
    k = 2 * np.arange(1, 40)
    weights = -40.0 / np.pi / (k**2 - 1)
    for t in 0.01 * np.arange(1, count + 1):
        modes = weights * np.exp(-alpha * (k * np.pi) ** 2 * t)
        z = 20.0 / np.pi + (modes[:, None] * np.cos(np.pi * np.outer(k, at))).sum(axis=0)
        yield t, z + noise * rng.standard_normal(2)


def spoiled(samples, at, value):
    return [(t, np.array([value, z[1]])) if k in at else (t, z) for k, (t, z) in enumerate(samples)]


@cache
def clean():
    return rod(lp.SensitivityLaw()).run(readings(100)).last.parameters["alpha"]


# Among the first ones, before the last refit of the start, and after it.
@pytest.mark.parametrize("at", [3, 20, 80])
@pytest.mark.long
def test_one_bad_value_changes_next_to_nothing(at):
    spiked = rod(lp.SensitivityLaw()).run(spoiled(readings(100), {at}, 9999.0)).last
    (value, std), (expected, wanted) = spiked.parameters["alpha"], clean()
    assert abs(value - expected) < 0.5 * wanted
    assert std < 1.5 * wanted


@pytest.mark.slow
def test_without_the_gate_one_bad_value_spoils_all():
    law = lp.SensitivityLaw(gate=np.inf, guards=None, refit=None, shadows=None)
    value, _ = rod(law).run(spoiled(readings(), {150}, 9999.0)).last.parameters["alpha"]
    assert value == pytest.approx(0.05 - 10 * 0.03)  # as far as latent values go


@pytest.mark.long
def test_nothing_is_refused_where_nothing_is_wrong():
    for seed in range(4):
        data = rod(lp.SensitivityLaw()).run(readings(seed=seed)).to_xarray()
        assert float(data["refused"].sum()) == 0.0


@pytest.mark.long
def test_a_noise_that_is_stated_too_small_does_not_close_the_gate():
    result = rod(lp.SensitivityLaw()).run(readings(400, noise=20 * NOISE))
    refused = result.to_xarray()["refused"].values
    assert refused[100:].sum() <= 0.02 * 600
    value, std = result.last.parameters["alpha"]
    assert abs(value - 0.06) < 3 * std < 0.06


def lasting(changed, constant=False):
    """Readings that are far off from sample 100 on, of some sensors."""
    for k, (t, z) in enumerate(readings()):
        off = np.where(changed, 3.0 if not constant else 40.0 - z, 0.0) if k >= 100 else 0.0
        yield t, z + off


@pytest.mark.long
def test_what_lasts_is_believed_if_most_sensors_show_it():
    identifier = rod(lp.SensitivityLaw(gate_patience=5, jumps=None))
    found = [identifier.step(t, z) for t, z in lasting([True, True])]
    assert [estimate.diagnostics.refused for estimate in found[100:105]] == [2.0] * 5
    # The state follows the readings, so that these fit again, and the unknowns are kept till then.
    assert found[115].diagnostics.refused == 0.0
    before, after = (found[k].parameters["alpha"] for k in (99, 105))
    assert after[0] == before[0]
    assert after[1] == pytest.approx(before[1], rel=0.01)
