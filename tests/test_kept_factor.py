"""A factor that is kept from step to step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from livepde.laws.bilinear import Bilinear, BilinearEquation
from livepde.laws.gains import Gains
from livepde.laws.warm import Misses
from problems import Cubic

import livepde as lp
from livepde.bench.step import problem
from livepde.laws.coupled import CoupledStage
from livepde.linalg import SuperLUSolver
from livepde.stepping import Near


@pytest.fixture(scope="module")
def plate():
    """A plate whose coupled matrix is too wide for a banded factor, and samples of it."""
    given = problem(1600)
    G = given.omega.matrix(given.model.state_space)
    return given, [(t, G @ u) for t, u in given.forward(given.q_true)]


def test_a_kept_factor_changes_no_number(plate, monkeypatch):
    given, samples = plate
    law = lp.GradientLaw(1.0, lp.ResidualDamping(0.1), newton=lp.Newton(tolerance=1e-9, share=0.0))
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
    monkeypatch.setattr(Bilinear, "keeps", False)
    fresh, many = run()
    assert few < many
    for one, other in zip(kept, fresh, strict=True):
        assert one.u == pytest.approx(other.u, rel=0, abs=1e-7 * np.abs(other.u).max())
        assert one.q == pytest.approx(other.q, rel=0, abs=1e-6 * np.abs(other.q).max())


def test_a_kept_factor_is_made_again_after_a_restart(plate, tmp_path):
    given, samples = plate
    law = lp.GradientLaw(1.0, lp.ResidualDamping(0.1))

    def fresh():
        return lp.Identifier(given.model, given.omega, law, q0=0.0, u0=given.u0)

    whole, half = fresh(), fresh()
    for sample in samples[1:8]:
        whole.step(*sample)
        half.step(*sample)
    assert len(whole._state.warm.kept.y)
    half.save(tmp_path / "half.npz")
    again = fresh()
    again.load(tmp_path / "half.npz")
    for sample in samples[8:]:
        one, other = whole.step(*sample), again.step(*sample)
        assert np.array_equal(one.u, other.u)
        assert np.array_equal(one.q, other.q)


ROD = problem(31)


def rod(newton, scheme=None, gain=1e4, given=ROD):
    """Return estimates and updates of each step of the paper's example."""
    G = ROD.omega.matrix(ROD.model.state_space)
    law = lp.GradientLaw(gain, lp.ResidualDamping(0.1), newton=newton)
    identifier = lp.Identifier(ROD.model, ROD.omega, law, q0=0.0, u0=ROD.u0, scheme=scheme)
    estimates, updates = [], []
    with pytest.MonkeyPatch.context() as patch:
        count = [0]

        def counted(self, y, residual=BilinearEquation.residual):
            count[0] += 1
            return residual(self, y)

        patch.setattr(BilinearEquation, "residual", counted)
        for t, u in given.forward(given.q_true):
            if t > 0.0:
                count[0] = 0
                estimates.append(identifier.step(t, G @ u))
                updates.append(count[0])
    return estimates, np.array(updates)


def test_one_update_is_enough_in_most_steps():
    few, updates = rod(lp.Newton())
    exact, more = rod(lp.Newton(share=0.0, tolerance=1e-10))
    assert updates[10:].mean() < 1.3 < 2.5 < more[10:].mean()
    assert np.mean(updates[10:] == 1) > 0.7
    for one, other in zip(few[10:], exact[10:], strict=True):
        assert np.linalg.norm(one.q - other.q) < 2e-4 * np.linalg.norm(other.q)
        assert np.linalg.norm(one.u - other.u) < 1e-5 * np.linalg.norm(other.u)


def test_a_start_that_suddenly_misses_more_is_followed_further():
    """What the factor left of errors before says little then: theta has turned."""
    given = replace(ROD, width=0.55)
    few, _ = rod(lp.Newton(), gain=1e2, given=given)
    exact, _ = rod(lp.Newton(share=0.0, tolerance=1e-10), gain=1e2, given=given)
    for one, other in zip(few, exact, strict=True):
        assert np.linalg.norm(one.u - other.u) < 0.01 * np.linalg.norm(other.u)


def test_a_scheme_of_second_order_solves_its_stages_to_the_end():
    one, other = (rod(newton, lp.Alexander2()) for newton in (lp.Newton(), lp.Newton(share=0.0)))
    assert np.array_equal(one[1], other[1])
    assert all(np.array_equal(a.q, b.q) for a, b in zip(one[0], other[0], strict=True))


def test_noise_is_no_error_of_the_time_step():
    """With it the starts miss something new in each step, and stages are solved further."""
    misses = Misses(np.ones(2), np.array([0.0, 1.0]), 1.0, size=3)
    assert misses.shares(np.array([0.9, -0.4, 0.3])) == (0.9, 0.0, 0.3)
    near, start = np.array([6.01]), np.array([5.6])
    cubic = Cubic()
    found = lp.Newton().solve(cubic, start, lagged=True, near=Near(near, shares=(0.0,)))
    assert abs(found.y[0] - 6.0) < 1e-6
    rough = lp.Newton().solve(cubic, start, lagged=True, near=Near(near))
    assert rough.updates < found.updates


def test_misses_that_follow_each_other_show_in_each_part():
    stage = CoupledStage(
        ROD.model,
        ROD.omega.bind(ROD.model.state_space, ROD.model.X, ROD.model.parameter_space).split(),
        Gains(1.0, lp.ResidualDamping(), 0.0, 0.0, ROD.model.mass, ROD.model.mass),
        lp.Newton(),
    )
    before, misses = np.random.default_rng(0).standard_normal(stage.size), stage.misses
    factors = np.array([0.5, -0.25, 3.0])
    trend = misses.trend(before * misses.spread(factors), before)
    np.testing.assert_allclose(trend, [0.5, -0.25, 1.0])
    np.testing.assert_array_equal(misses.trend(before, 0.0 * before), 0.0)
