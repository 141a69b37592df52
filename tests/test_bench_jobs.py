"""The reference fits that livepde is timed against find the truths of independent codes."""

import numpy as np
import pytest

from benchmarks.user_jobs.data import JOBS
from benchmarks.user_jobs.fits import JOBS as FITS

PRECISE = {"rod": 1e-3, "soil": 0.08, "column": 5e-3}


@pytest.mark.long
@pytest.mark.parametrize("job", [job for job in JOBS if job.name in PRECISE], ids=lambda j: j.name)
def test_a_fit_finds_the_truth(job):
    found = FITS[job.name](job.table(np.random.default_rng(11)))
    assert found == pytest.approx(job.truth, rel=PRECISE[job.name])
