"""Soil and stream beds as measured: what their cases promise."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from benchmarks.cases import jobs_of, run_job

pytestmark = pytest.mark.study

CASES = Path(__file__).parents[1] / "cases"


@pytest.fixture(scope="module")
def run(data_dir):
    """Return the numbers of a case or of one of its variants; each is run once."""

    @cache
    def numbers(name, variant=""):
        (job,) = [job for job in jobs_of(CASES / f"{name}.toml") if job.variant == variant]
        found = run_job(job)
        assert not found.error
        assert found.numbers["failed_steps"] == 0
        return found.numbers

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIVEPDE_DATA", str(data_dir))
        yield numbers


@pytest.mark.parametrize("month", ["", "June"])
def test_soil_with_offsets_meets_the_validation_sensor(run, month):
    found = run("soil_offsets", month)
    assert found["rmse.validation"] <= 0.25
    assert found["innovation_ratio"] <= 4


def test_uniform_soil_is_visibly_worse(run):
    found = run("soil_uniform")
    assert found["rmse.validation"] >= 0.28
    assert found["rmse"] >= 1.5 * run("soil_offsets")["rmse"]


def test_uniform_stream_bed_does_not_explain_its_data(run):
    uniform = run("streambed_035_uniform")
    assert uniform["innovation_ratio"] >= 4
    layers = run("streambed_035_layers")
    assert layers["innovation_ratio"] <= 4
    assert layers["rmse"] <= 0.6 * uniform["rmse"]


def test_spikes_are_refused(run):
    found = run("streambed_047")
    assert found["rmse.T_10"] <= 0.05
    assert found["innovation_ratio"] <= 1
    assert found["rmse.T_20"] >= 0.3  # scored with its spikes: nothing is hidden
