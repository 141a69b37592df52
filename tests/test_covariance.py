"""The robust covariance is exact for a correct model, and never wider than the prior."""

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
from livepde.laws.filter import robust_factors
from livepde.linalg.member_arrays import changed


def learned(evolution=None, readings=60, size=1.0, noise=0.05):
    """Return the law's work and state after readings that scatter `size` times more than stated."""
    unknowns = {
        "alpha": lp.Normal(0.05, 0.03),
        "far": lp.Scalar(lp.Normal(0.0, 2.0), evolution=evolution)
        if evolution
        else lp.Normal(0.0, 2.0),
    }
    model = lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 12), ElementLineP1(), dirichlet={"left": 1.0}),
        unknowns,
        A=lambda q, u, v, x: q.alpha * lp.dot(lp.grad(u), lp.grad(v)) + 0.0 * q.far * v,
    )
    identifier = lp.Identifier(model, lp.Points([0.2, 0.6], noise=noise), lp.SensitivityLaw())
    rng = np.random.default_rng(1)
    for k in range(1, readings + 1):
        mean = identifier.forecast([0.1 * k]).z[0]
        identifier.step(0.1 * k, mean + size * noise * rng.standard_normal(2))
    return identifier._work, identifier._state.now


def covariance(rows):
    return rows[0].T @ rows[0]


def inflated(x, factor):
    """Return a filter whose innovations scatter by a factor more than it expects."""
    one = x.innovations
    sums = np.array([[1000.0, 1000.0, 1000.0 * factor**2, 1000.0, 0.0, 1000.0, 1000.0]])
    return changed(x, innovations=changed(one, sums=sums))


@pytest.mark.slow
def test_nothing_changes_where_innovations_are_as_expected():
    work, x = learned()
    assert x.innovations.inflation == 1.0
    U, C = robust_factors(work.filter.reduction, x)
    assert U is x.U
    assert C is x.C


@pytest.mark.slow
def test_the_sandwich_of_a_known_direction():
    work, x = learned()
    wide = inflated(x, 3.0)
    scale = float(wide.innovations.inflation[0])
    assert scale > 2.5
    P = covariance(x.C)
    V = covariance(robust_factors(work.filter.reduction, wide)[1])
    F = np.linalg.inv(P) - np.eye(2)
    np.testing.assert_allclose(V, P @ (np.eye(2) + scale**2 * F) @ P, rtol=1e-8, atol=1e-12)


@pytest.mark.slow
def test_what_no_sensor_sees_keeps_its_prior():
    work, x = learned()
    for scale in (2.0, 30.0, 1e6):
        V = covariance(robust_factors(work.filter.reduction, inflated(x, scale))[1])
        assert V[1, 1] == pytest.approx(1.0, rel=1e-10)
        assert np.linalg.eigvalsh(V).max() <= 1.0 + 1e-10


@pytest.mark.slow
def test_a_walk_is_no_wider_than_its_prior_of_now():
    work, x = learned(lp.RandomWalk(2.0))
    age = float(x.age[0])
    V = covariance(robust_factors(work.filter.reduction, inflated(x, 100.0))[1])
    F = work.filter.reduction.transition(age)
    gained = work.filter.reduction.gained(age, np.ones((1, 2)), np.zeros(1))[0]
    prior = F @ F.T + np.diag(gained)
    assert V[1, 1] == pytest.approx(prior[1, 1], rel=1e-6)
    assert prior[1, 1] > 2.0


@pytest.mark.slow
def test_a_factor_that_is_not_finite_stays_as_it_is():
    work, x = learned()
    broken = changed(inflated(x, 3.0), C=np.full_like(x.C, np.nan))
    _, C = robust_factors(work.filter.reduction, broken)
    assert np.isnan(C).all()
