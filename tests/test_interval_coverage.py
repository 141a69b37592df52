"""The benchmark of interval coverage."""

import numpy as np
import pytest

from benchmarks import coverage
from benchmarks.coverage import PROBLEMS

pytestmark = pytest.mark.study


def test_true_values_are_drawn_from_the_prior_and_move_as_it_says():
    problem, times = PROBLEMS["random walk"], np.linspace(0.0, 4.0, 41)
    model, rng = problem.model(), np.random.default_rng(0)
    paths = np.array([coverage._path(model, times, rng)[:, 0] for _ in range(400)])
    latent = problem.unknowns["a"].prior.latent_std
    assert paths[:, 0].mean() == pytest.approx(np.log(0.3), abs=0.04)
    assert paths[:, 0].std() == pytest.approx(latent, rel=0.1)
    assert (paths[:, -1] - paths[:, 0]).std() == pytest.approx(0.1 * np.sqrt(4.0), rel=0.1)
    field = PROBLEMS["field"].model()
    draws = np.array([coverage._path(field, times[:2], rng)[0] for _ in range(400)])
    expected = np.sqrt(np.diag(np.linalg.inv(field.Q.gram.toarray())))
    assert draws.std(axis=0) == pytest.approx(expected, rel=0.2)
