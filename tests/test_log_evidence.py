"""`Result.log_evidence` counts a refused reading as one at the limit of the gate."""

import math

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp

NOISE = 0.02


def readings() -> list[lp.Sample]:
    """Return the readings of a decay u = exp(-0.5 t) with white noise."""
    rng = np.random.default_rng(3)
    times = np.linspace(0.1, 4.0, 40)
    z = np.exp(-0.5 * times) + NOISE * rng.standard_normal(40)
    return [lp.Sample(t=t, z={"a": v}) for t, v in zip(times.tolist(), z.tolist(), strict=True)]


def run(samples: list[lp.Sample], law: lp.SensitivityLaw) -> lp.Result:
    field = lp.Field(lp.interval(0.0, 1.0, 4), ElementLineP1())
    model = lp.Model(field, {"k": lp.Normal(0.4, 0.2)}, A=lambda q, u, v, x: q.k * u * v)
    sensors = lp.Points({"a": 0.5}, noise=NOISE)
    return lp.Identifier(model, sensors, law, u0=1.0).run(samples)


@pytest.mark.parametrize("refit", [lp.laws.Refit(), None])
def test_a_reading_that_is_refused_counts_as_one_at_the_limit_of_the_gate(refit):
    law = lp.SensitivityLaw(refit=refit, gate=6.0, shadows=None, verdict=False)
    samples = readings()
    # Halfway, where the innovations before have shown how large they usually are.
    wild, missing = list(samples), list(samples)
    wild[20] = lp.Sample(t=samples[20].t, z={"a": 5.0})
    missing[20] = lp.Sample(t=samples[20].t, z={"a": np.nan})
    refused, without = run(wild, law), run(missing, law)
    gained = refused.log_evidence - without.log_evidence
    constant = math.log(NOISE) + 0.5 * math.log(2.0 * math.pi)
    # Innovations may be somewhat larger than their noise, and the gate with them.
    assert -constant - 0.5 * 1.6 * 6.0**2 <= gained <= -constant - 0.5 * 6.0**2 + 1e-6
    assert refused.to_xarray().attrs["log_evidence"] == refused.log_evidence


def test_the_readings_of_a_sensor_that_is_set_aside_count_after_a_refit_too():
    law = lp.SensitivityLaw(gate=6.0, shadows=None)
    broken, missing = (
        [lp.Sample(t=one.t, z={"a": value}) if one.t > 1.6 else one for one in readings()]
        for value in (-127.0, math.nan)
    )
    found, without = run(broken, law), run(missing, law)
    assert [one.what for one in found.verdict.findings if one.what == "aside"] == ["aside"]
    each = math.log(NOISE) + 0.5 * math.log(2.0 * math.pi) + 0.5 * 6.0**2
    lost = without.log_evidence - found.log_evidence
    assert lost == pytest.approx(sum(one.t > 1.6 for one in broken) * each, rel=0.01)


def test_a_law_without_covariance_has_no_evidence():
    law = lp.GradientLaw()
    assert math.isnan(run(readings(), law).log_evidence)
