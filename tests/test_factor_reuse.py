"""Reuse of a factorised matrix over several steps."""

from dataclasses import replace

import numpy as np
import pytest
from factories import usual

import livepde as lp
from benchmarks.step import problem
from livepde.laws.coupled.stage_solvers import BilinearSolver
from livepde.linalg import SuperLUSolver

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def plate():
    """A plate whose coupled matrix is too wide for a banded factor, and samples of it."""
    given = problem(1600)
    G = given.omega.matrix(given.model.state_space)
    return given, [(t, G @ u) for t, u in given.forward(given.q_true)]


@pytest.mark.long
def test_a_kept_factor_changes_no_number(plate, monkeypatch):
    given, samples = plate
    law = lp.GradientLaw(
        1.0, lp.laws.ResidualDamping(0.1), newton=lp.stepping.Newton(tolerance=1e-9, share=0.0)
    )
    made = []
    factorise = SuperLUSolver.factorise

    def counted(self, data):
        made.append(len(data))
        return factorise(self, data)

    def run():
        made.clear()
        identifier = lp.Identifier(given.model, given.omega, law, q0=0.0, u0=given.u0)
        estimates = [identifier.step(*sample) for sample in samples[1:]]
        return estimates, len(made)

    monkeypatch.setattr(SuperLUSolver, "factorise", counted)
    kept, few = run()
    monkeypatch.setattr(BilinearSolver, "keeps", False)
    fresh, many = run()
    assert few < many
    for one, other in zip(kept, fresh, strict=True):
        assert one.u == pytest.approx(other.u, rel=0, abs=1e-7 * np.abs(other.u).max())
        assert one.q == pytest.approx(other.q, rel=0, abs=1e-6 * np.abs(other.q).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    usual([lp.GradientLaw(1.0, lp.laws.ResidualDamping(0.1)), lp.GradientLaw("auto")]),
    ids=["1", "auto"],
)
def test_a_kept_factor_is_made_again_after_a_restart(law, plate, tmp_path):
    given, samples = plate

    def fresh():
        return lp.Identifier(given.model, given.omega, law, q0=0.0, u0=given.u0)

    whole, half = fresh(), fresh()
    for sample in samples[1:8]:
        whole.step(*sample)
        half.step(*sample)
    assert len(whole._state.kept.y)
    half.save(tmp_path / "half.bin")
    again = fresh()
    again.load(tmp_path / "half.bin")
    for sample in samples[8:14]:
        one, other = whole.step(*sample), again.step(*sample)
        assert np.array_equal(one.u, other.u)
        assert np.array_equal(one.q, other.q)


ROD = problem(31)
EXACT = lp.stepping.Newton(share=0.0, tolerance=1e-10)


def rod(newton, scheme=None, gain=1e4, given=ROD):
    """Return estimates and updates of each step of the paper's example."""
    G = ROD.omega.matrix(ROD.model.state_space)
    law = lp.GradientLaw(gain, lp.laws.ResidualDamping(0.1), newton=newton)
    identifier = lp.Identifier(ROD.model, ROD.omega, law, q0=0.0, u0=ROD.u0, scheme=scheme)
    estimates, updates = [], []
    with pytest.MonkeyPatch.context() as patch:
        solved = []

        def counted(self, *args, solve=lp.stepping.Newton.solve):
            solved.append(solve(self, *args))
            return solved[-1]

        patch.setattr(lp.stepping.Newton, "solve", counted)
        for t, u in given.forward(given.q_true):
            if t > 0.0:
                solved.clear()
                estimates.append(identifier.step(t, G @ u))
                updates.append(sum(one.updates for one in solved))
    return estimates, np.array(updates)


def test_one_update_or_two_are_enough():
    few, updates = rod(lp.stepping.Newton())
    exact, more = rod(EXACT)
    assert updates[10:].mean() < 1.6 < 2.5 < more[10:].mean()
    assert np.mean(updates[10:] == 1) > 0.5
    for one, other in zip(few[10:], exact[10:], strict=True):
        assert np.linalg.norm(one.q - other.q) < 4e-4 * np.linalg.norm(other.q)
        assert np.linalg.norm(one.u - other.u) < 1e-5 * np.linalg.norm(other.u)


def test_a_start_that_suddenly_misses_more_is_followed_further():
    """A factor of another theta serves badly then: theta has turned."""
    given = replace(ROD, width=0.55)
    few, _ = rod(lp.stepping.Newton(), gain=1e2, given=given)
    exact, _ = rod(EXACT, gain=1e2, given=given)
    for one, other in zip(few, exact, strict=True):
        assert np.linalg.norm(one.u - other.u) < 0.01 * np.linalg.norm(other.u)


def test_a_scheme_of_second_order_solves_its_stages_to_the_end():
    one, other = (
        rod(newton, lp.Alexander2())
        for newton in (lp.stepping.Newton(), lp.stepping.Newton(share=0.0))
    )
    assert np.array_equal(one[1], other[1])
    assert all(np.array_equal(a.q, b.q) for a, b in zip(one[0], other[0], strict=True))
