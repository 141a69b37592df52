"""A factor that is kept from step to step."""

from __future__ import annotations

import numpy as np
import pytest

import livepde as lp
from livepde.bench.step import problem
from livepde.laws.coupled import CoupledStage
from livepde.linalg import SuperLUSolver


@pytest.fixture(scope="module")
def plate():
    """A plate whose coupled matrix is too wide for a banded factor, and samples of it."""
    given = problem(1600)
    G = given.omega.matrix(given.model.state_space)
    return given, [(t, G @ u) for t, u in given.forward(given.q_true)]


def test_a_kept_factor_changes_no_number(plate, monkeypatch):
    given, samples = plate
    law = lp.GradientLaw(1.0, lp.ResidualDamping(0.1), newton=lp.Newton(share=0.0))
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
    monkeypatch.setattr(CoupledStage, "keeps", False)
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
