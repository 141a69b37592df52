"""A refit that ends without a minimum: the verdict reports it, and the estimate is kept."""

import numpy as np
import pytest
from factories import driven_rod, line, readings

import livepde as lp
from livepde.laws.stored_samples import StoredSamples
from livepde.stepping.newton import StepFailed

TIMES = np.arange(0.0, 4.05, 0.1)


def run(passes: int) -> lp.Estimate:
    """Return the last estimate of a run: log a is 0.3, and the prior far too high."""
    model = driven_rod({"a": lp.LogNormal(3.6, 3.6)}, lambda t: np.sin(3 * t), line(12))
    sensors = lp.Points([0.3, 0.6], noise=0.01)
    law = lp.SensitivityLaw(refit=lp.Refit(start=0, passes=passes), guards=None, shadows=None)
    stream = readings(model, sensors, lambda t: 0.3, TIMES, 0.01)
    last = lp.Identifier(model, sensors, law, u0=0.0).run(stream).last
    return last


@pytest.mark.slow
def test_a_last_fit_that_fails_leaves_the_run_with_its_estimates(monkeypatch):
    def fails(*_: object) -> None:
        raise StepFailed("singular", "the matrix is singular")

    monkeypatch.setattr(StoredSamples, "log_evidence", fails)
    found = run(40)
    assert not found.fit.converged
    assert found.verdict.level == "do not trust"
