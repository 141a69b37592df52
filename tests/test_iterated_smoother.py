"""The iterated start is exact for linear problems, and improves nonlinear ones."""

from dataclasses import replace

import numpy as np
import pytest
from factories import truth
from skfem import ElementLineP1

import livepde as lp
from livepde.laws import iterated_smoother
from livepde.models import heat

SENSORS = lp.Points([0.2, 0.5, 0.8], noise=0.02)
TIMES = 0.1 * np.arange(41)
# Constant unknowns are fitted instead, unless a memory fades, however slowly.
FADING = {"memory": 1e9}


def sourced(evolution=None):
    """Return a rod with an unknown source: linear in u and in what is unknown."""
    strength = (
        lp.Scalar(lp.Normal(0.0, 2.0), evolution=evolution) if evolution else lp.Normal(0.0, 2.0)
    )
    return lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 12), ElementLineP1(), dirichlet={"left": 0.0}),
        {"s": strength},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: 0.3 * lp.dot(lp.grad(u), lp.grad(v)),
    )


def readings(model, q, u0=0.0, seed=0):
    rng, G = np.random.default_rng(seed), SENSORS.matrix(model.state_space)
    states = truth(model, np.asarray(q), u0, TIMES, lp.SensitivityLaw.scheme)
    for t, u in zip(TIMES[1:], states[1:], strict=True):
        yield t, G @ u + 0.02 * rng.standard_normal(3)


def ends(model, law, samples, u0=0.0):
    identifier = lp.Identifier(model, SENSORS, law, u0=u0)
    return [identifier.step(*sample) for sample in samples]


@pytest.mark.slow
@pytest.mark.parametrize("evolution", [None, lp.RandomWalk(0.5), lp.MeanReverting(2.0)])
def test_nothing_changes_where_all_is_linear(evolution):
    model = sourced(evolution)
    samples = list(readings(model, [1.5]))
    plain = ends(model, lp.SensitivityLaw(**FADING, refit=None, shadows=None), samples)
    iterated = ends(model, lp.SensitivityLaw(**FADING, shadows=None), samples)
    assert any(not np.isnan(estimate.diagnostics.smoother_moved) for estimate in iterated)
    for one, other in zip(plain, iterated, strict=True):
        np.testing.assert_allclose(other.q, one.q, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(other.q_std, one.q_std, rtol=1e-8)
        np.testing.assert_allclose(other.u, one.u, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_a_moving_unknown_is_smoothed_as_by_the_filter_of_all_samples():
    """The smoothed trajectory of a linear problem is the least squares solution."""
    model = sourced(lp.RandomWalk(0.5))
    samples = list(readings(model, [1.5]))[:8]
    identifier = lp.Identifier(model, SENSORS, lp.SensitivityLaw(gate=np.inf), u0=0.0)
    for sample in samples:
        identifier.step(*sample)
    work, state = identifier._work, identifier._state
    log = state.log
    taken = iterated_smoother._Samples(
        work=work,
        state=state,
        opening=iterated_smoother.first_interval(log, ()),
        intervals=iterated_smoother.intervals_since(log, ()),
    )
    found = taken.about(np.zeros((9, 1))).smoothed[:, 0]

    # Readings are linear in the source of each interval: superposition gives the matrix.
    points = model.latent.prior
    G, control = SENSORS.matrix(model.state_space), lp.Advance(lp.SensitivityLaw.scheme)
    prior_std, growth = 2.0, 0.5 * np.sqrt(0.1)
    columns = []
    for on in range(1, 9):
        u, column = np.zeros(model.X.dim), []
        for k in range(1, 9):
            q = points + (1.0 if k == on else 0.0) * prior_std
            (_, _), (_, u) = lp.simulate(model, q, u, [TIMES[k - 1], TIMES[k]], control)
            column.append(G @ u)
        columns.append(np.concatenate(column))
    A = np.array(columns).T / 0.02
    z = np.concatenate([reading for _, reading in samples]) / 0.02
    increments = (np.eye(8) - np.eye(8, k=-1)) * prior_std / growth
    first = np.zeros((1, 8))
    first[0, 0] = 1.0 / np.sqrt(1.0 + (growth / prior_std) ** 2)
    increments[0] = first
    exact = np.linalg.lstsq(
        np.vstack([A, increments]), np.concatenate([z, np.zeros(8)]), rcond=None
    )
    # Within an interval the scheme sees part of the growth: the two differ by that.
    np.testing.assert_allclose(found[1:], exact[0], atol=0.1 * growth / prior_std + 0.02)


def lost(samples):
    one = samples.about(None)
    return replace(one, smoothed=one.smoothed + 1e3)


@pytest.mark.slow
@pytest.mark.parametrize("search", [lambda samples: None, lost], ids=["none", "far away"])
def test_a_trajectory_that_cannot_be_followed_leaves_the_plain_filter(monkeypatch, search):
    monkeypatch.setattr(iterated_smoother, "iterated_smoother", search)
    model = sourced()
    samples = list(readings(model, [1.5]))
    plain = ends(model, lp.SensitivityLaw(**FADING, refit=None), samples)[-1]
    found = ends(model, lp.SensitivityLaw(**FADING), samples)
    assert found[0].diagnostics.smoother_moved == np.inf
    np.testing.assert_array_equal(found[-1].q, plain.q)


@pytest.mark.slow
def test_a_settled_run_iterates_no_more():
    model = sourced()
    found = ends(
        model, lp.SensitivityLaw(**FADING, refit=lp.laws.Refit(start=8)), readings(model, [1.5])
    )
    moved = [not np.isnan(estimate.diagnostics.smoother_moved) for estimate in found]
    assert any(moved[:16])
    assert not any(moved[32:])


@pytest.mark.slow
def test_a_direction_that_is_not_told_keeps_the_start_open():
    model = sourced()
    law = lp.SensitivityLaw(**FADING, refit=lp.laws.Refit(start=16))
    identifier = lp.Identifier(model, SENSORS, law, u0=0.0)
    for t in TIMES[1:]:
        identifier.step(t, np.full(3, np.nan) if t < 2.0 else np.zeros(3))
    assert identifier._state.due[0] == iterated_smoother.NEVER
    silent = lp.Identifier(model, lp.Points([0.5], noise=1e3), law, u0=0.0)
    for t in TIMES[1:]:
        silent.step(t, np.zeros(1))
    assert silent._state.due[0] < iterated_smoother.NEVER


@pytest.mark.slow
def test_a_search_that_hardly_moves_the_unknowns_corrects_the_state():
    """The insulated rod never forgets an error of its mean, which no covariance says."""
    model = heat(lp.interval(0.0, 1.0, 16), lp.Normal(0.1, 0.05))
    start = lambda x: 1.0 + np.cos(np.pi * x[0])  # noqa: E731
    samples = list(readings(model, [0.12], start))[:24]
    bare = {"shadows": None, "verdict": False}
    whole = ends(model, lp.SensitivityLaw(**FADING), samples, start)
    alone = ends(model, lp.SensitivityLaw(**FADING, **bare), samples, start)
    plain = ends(model, lp.SensitivityLaw(**FADING, refit=None, **bare), samples, start)
    moved = [one.diagnostics.smoother_moved for one in whole]
    assert 0.0 < np.nanmax(moved) <= iterated_smoother.HOLDS
    for one, other in zip(whole, alone, strict=True):
        np.testing.assert_allclose(one.u, other.u, rtol=1e-10)
        np.testing.assert_allclose(one.q, other.q, rtol=1e-10)
    assert np.abs(whole[-1].u - plain[-1].u).max() > 1e-9
    assert whole[-1].verdict.level == "trusted"
