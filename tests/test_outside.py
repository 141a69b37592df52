"""The study outside the observed part: data match the sensors, and all laws run."""

import numpy as np
import pytest

from experiments import outside


@pytest.mark.long
@pytest.mark.parametrize("process", outside.PROCESSES)
def test_all_laws_run_on_the_data_of_the_study(process, monkeypatch):
    monkeypatch.setattr(outside, "TIMES", outside.TIMES[:6])
    data = outside.draw(outside.PROCESSES[process], 0)
    found = outside.rows(data)
    # A diffusivity is refused by the law that tunes itself, a reaction is not.
    assert ("gradient, auto" in found) == (process == "reaction")
    assert all(np.isfinite(score.error).all() for score in found.values())
    assert outside.STEPS.failed == 0
