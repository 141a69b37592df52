"""The benchmark that counts how often the truth lies in the interval."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import coverage
from benchmarks.coverage import PROBLEMS, twin

pytestmark = pytest.mark.study


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_twin_is_the_same_for_the_same_seed(name: str):
    first, again, other = (twin(PROBLEMS[name], seed) for seed in (1, 1, 2))
    assert first == again
    assert first.error != other.error
    assert set(first.inside) == {0.68, 0.95}


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


def test_intervals_hold_what_they_promise():
    several = [twin(PROBLEMS["two numbers"], seed) for seed in range(40)]
    assert np.mean([one.inside[0.95] for one in several]) > 0.87
    assert 0.5 < np.mean([one.inside[0.68] for one in several]) < 0.85
    assert not any(one.doubted for one in several)


@pytest.mark.parametrize(
    ("name", "flaw"), [("missing loss", {"loss": 1.0}), ("missing layer", {"contrast": 0.8})]
)
def test_a_wrong_model_is_doubted_or_its_interval_is_wide_enough(name: str, flaw: dict[str, float]):
    large = {key: lambda rng, value=value: value for key, value in flaw.items()}
    doubted = twin(replace(PROBLEMS[name], **large), 0)
    assert doubted.doubted
    assert doubted.white == (False, False)
    assert not PROBLEMS[name].right
    several = [twin(PROBLEMS[name], seed) for seed in range(12)]
    assert np.mean([one.doubted or one.inside[0.95] == 1.0 for one in several]) > 0.8


def test_innovations_are_white_if_the_model_is_right():
    right = PROBLEMS["short run"]
    square, correlation = np.mean([twin(right, seed).white for seed in range(40)], axis=0)
    assert min(square, correlation) > 0.8  # 0.95 less four standard errors
    lossy = replace(right, unknowns={"a": right.unknowns["a"]}, loss=lambda rng: 9.0)
    assert twin(lossy, 0).white == (False, False)


def test_a_field_seen_in_part_is_covered_outside_too():
    several = [twin(PROBLEMS["field, seen in part"], seed) for seed in range(20)]
    assert np.mean([one.inside[0.95] for one in several]) > 0.87
    assert 0.7 < np.sqrt(np.mean([one.error for one in several])) < 1.3
