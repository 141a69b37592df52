"""The reproduced experiments give the published and stated numbers."""

import json

import numpy as np
import pytest

import livepde as lp
from livepde.reproduce import EXPERIMENTS, seed, seed_excited
from livepde.reproduce.experiment import track
from livepde.runs import Outcome

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def discrete() -> Outcome:
    return EXPERIMENTS["seed"].run()


@pytest.fixture(scope="module")
def analytic() -> Outcome:
    return EXPERIMENTS["seed"].run("analytic")


@pytest.fixture(scope="module")
def excited() -> Outcome:
    return EXPERIMENTS["seed-excited"].run("discrete")


def values(outcome: Outcome) -> dict[str, float]:
    assert len({check.name for check in outcome.checks}) == len(outcome.checks)
    return {check.name: check.value for check in outcome.checks}


def test_seed_shows_the_table_of_the_design(discrete: Outcome) -> None:
    assert discrete.ok, [check for check in discrete.checks if not check.ok]
    paper, (*kept, auto) = (
        [dict(zip(table.columns, row, strict=True)) for row in table.rows]
        for table in discrete.tables
    )
    assert auto["gain"] == "auto"
    assert auto["t = 60"] == values(discrete)["error of q at t = 60, gradient, auto"]
    for rows, expected in ((paper, seed.EXPECTED), (kept, seed.WITH_SLOPES)):
        assert [(row["gain"], row["c1"]) for row in rows] == list(expected)
        for row in rows:
            assert row["q = 0"] == pytest.approx(1.0)
            assert row["expected"] == expected[row["gain"], row["c1"]]
            assert row["t = 60"] == pytest.approx(row["expected"], rel=0.005)
            assert row["divided steps"] == 0
    assert values(discrete)["largest error of q at t = 60, gain 1e4"] <= 0.071
    json.dumps(discrete.to_dict(), allow_nan=False)


def test_seed_with_exact_data_says_that_truncation_hides_q(analytic: Outcome) -> None:
    assert analytic.ok
    errors = [row[analytic.tables[0].columns.index("t = 6")] for row in analytic.tables[0].rows]
    assert min(errors) > 2.0
    (note,) = analytic.notes
    assert "truncation error" in note
    assert "hides q" in note
    assert f"{min(errors):.1f} to {max(errors):.1f}" in note
    assert "0.06%" in note  # what q* changes of u at most
    json.dumps(analytic.to_dict(), allow_nan=False)


def test_seed_with_a_fine_truth_says_the_same() -> None:
    outcome = EXPERIMENTS["seed"].run("fine")
    assert outcome.ok
    assert "20 times smaller steps" in outcome.notes[0]


def test_seed_dataset_is_the_run_with_the_highest_gain(discrete: Outcome) -> None:
    data = discrete.dataset
    assert data.sizes["time"] == 101
    exact = seed.q_true([data["x"].values])
    last = data["q"].values[-1]
    assert np.linalg.norm(last - exact) < 0.07 * np.linalg.norm(exact)
    assert not any("true" in str(name) for name in data)  # a run never holds the truth


def test_source_belongs_to_the_exact_solution() -> None:
    # u_t - u_xx + q u = f by central differences, for both experiments
    x, t, d = np.linspace(0.1, 0.9, 9), 1.3, 1e-4
    for case in (seed, seed_excited):
        rate = (case.u_true([x], t + d) - case.u_true([x], t - d)) / (2 * d)
        bend = (case.u_true([x + d], t) - 2 * case.u_true([x], t) + case.u_true([x - d], t)) / d**2
        source = rate - case.D * bend + case.q_true([x]) * case.u_true([x], t)
        assert np.allclose(source, case.f([x], t), atol=1e-5)


def test_seed_excited_reaches_its_bounds(excited: Outcome) -> None:
    assert excited.ok, [check for check in excited.checks if not check.ok]
    assert {check.bound for check in excited.checks} == {0.005, 0.001}
    assert "exact" in excited.notes[0]
    assert f"{seed_excited.NOISE_LEVEL:g}" in excited.notes[0]
    for draw in excited.figures.values():
        draw().canvas.draw()
    json.dumps(excited.to_dict(), allow_nan=False)


@pytest.mark.parametrize("level", [1e-2, 1e-5])
def test_no_noise_level_told_to_the_filter_does_harm(level: float) -> None:
    twin, law = seed_excited.twin_of(), lp.SensitivityLaw(modes=12, noise=level)
    options = {"u0": seed_excited.start, "scheme": twin.scheme}
    identifier = lp.Identifier(twin.model, twin.observation, law, **options)
    assert track(identifier, twin, "").error(60.0) < 3.6e-4


def test_seed_excited_with_exact_data_checks_nothing() -> None:
    outcome = EXPERIMENTS["seed-excited"].run("analytic")
    assert not outcome.checks
    assert "truncation error" in outcome.notes[0]
