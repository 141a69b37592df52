"""The published and stated experiments show the numbers they must."""

from __future__ import annotations

import json

import numpy as np
import pytest

import livepde as lp
from livepde import progress
from livepde.reproduce import EXPERIMENTS, seed, seed_excited
from livepde.reproduce.experiment import track
from livepde.runs import Outcome
from livepde.streams import RelativeNoise

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


def test_seed_figures_have_the_lines_of_the_paper(discrete: Outcome) -> None:
    parameter = discrete.figures["parameter"]()
    for ax in parameter.axes:
        assert len(ax.lines) == 7  # six estimates and the exact parameter
        marked = [line for line in ax.lines if line.get_marker() not in ("None", "")]
        assert len(marked) == 6
        assert all(len(line.get_xdata()) == seed.N for line in marked)
        assert np.allclose(ax.lines[-1].get_ydata(), seed.q_true([np.linspace(0, 1, 31)]))
    labels = [text.get_text() for text in parameter.axes[-1].get_legend().get_texts()]
    assert labels[1:-1] == [f"t = {t:g}" for t in (0, 6, 15, 30, 45, 60)]
    state = discrete.figures["state"]()
    for ax in state.axes:
        curves = [line for line in ax.lines if len(line.get_xdata())]
        assert len(curves) == 12  # an estimate and the exact state for each time
        for exact, estimate in zip(curves[::2], curves[1::2], strict=True):
            assert np.abs(exact.get_ydata() - estimate.get_ydata()).max() < 0.1
    error = discrete.figures["error"]()
    assert len(error.axes[0].lines) == len(seed.EXPECTED) + 1
    for figure in (parameter, state, error):
        figure.canvas.draw()


def test_seed_dataset_is_the_run_with_the_highest_gain(discrete: Outcome) -> None:
    data = discrete.dataset
    assert data is not None
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


def test_unknown_truth() -> None:
    with pytest.raises(
        lp.errors.ConfigurationError, match="expected one of discrete, analytic, fine"
    ):
        EXPERIMENTS["seed"].run("real")


def test_progress_shows_a_bar_for_every_run(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []
    watched = progress.watched

    def spy(stream: object, total: int, what: str) -> object:
        shown.append(what)
        return watched(stream, total, what)  # type: ignore[arg-type]

    monkeypatch.setattr("livepde.reproduce.experiment.watched", spy)
    EXPERIMENTS["seed"].run(progress=True)
    cases = [seed._label(*case) for case in seed.EXPECTED]
    assert shown == [*cases, *cases, "gradient, auto"]
    assert shown[-2] == "gain 1e4, c1 = 1"


def test_track_counts_failed_and_divided_steps() -> None:
    stream = seed.twin_of(times=seed.TIMES[:6], noise=RelativeNoise(0.01))
    model, omega = stream.model, stream.observation
    divided = lp.Identifier(model, omega, lp.GradientLaw(), u0=seed.start, dt_max=0.3)
    assert track(divided, stream, "").divided == 5
    never = lp.stepping.Newton(tolerance=0.0, iterations=1)
    failing = lp.Identifier(model, omega, lp.GradientLaw(newton=never), u0=1.0)
    found = track(failing, stream, "")
    assert np.isnan(found.errors[1:]).all()
    assert found.last.status.code == "not_converged"
