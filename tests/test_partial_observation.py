"""An unobserved part of a field is estimated if the dynamics allow, else its interval is wide."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import livepde as lp
from livepde.linalg import Array
from livepde.stepping import Advance, simulate

pytestmark = pytest.mark.slow

TIMES = 0.05 * np.arange(201)
CELLS, FINE = 30, 60
SENSORS = np.linspace(0.5, 0.9, 13)
NOISE = 0.01


def reaction(cells: int) -> lp.Model:
    """Return u_t - u_xx + q u = f."""
    mesh = lp.interval(0.0, 1.0, cells)
    smooth = lp.Sobolev(1.0, length=0.1).pointwise(1)
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
        {"q": lp.Field(mesh, lp.linear(mesh), inner=smooth, prior=lp.Normal(3.0, std=3.0))},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: 0.1 * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: 5 + 2 * np.sin(t) + 3 * np.cos(0.7 * t) * np.sin(2 * np.pi * x[0]),
    )


@dataclass(frozen=True)
class Found:
    x: Array
    true: Array
    q: Array
    hit: Array
    width: Array

    def error(self, part: Array) -> float:
        return float(np.linalg.norm((self.q - self.true)[part]))


def found(seed: int, law: lp.SensitivityLaw) -> Found:
    rng = np.random.default_rng(seed)
    model, fine = reaction(CELLS), reaction(FINE)
    root = np.linalg.inv(np.linalg.cholesky(model.Q.gram.toarray())).T
    true = model.latent.prior + root @ rng.standard_normal(model.latent.dim)
    q = np.interp(fine.mesh.p[0], model.mesh.p[0], true)
    points = lp.Points(SENSORS.tolist(), noise=NOISE)
    G = points.matrix(fine.state_space)
    run = simulate(fine, q, 0.0, TIMES.tolist(), Advance(lp.Alexander2(), dt_max=0.025))
    z = np.array([G @ u for _, u in run])
    z += NOISE * rng.standard_normal(z.shape)
    identifier = lp.Identifier(model, points, law, u0=0.0, scheme=lp.Alexander2())
    for t, row in zip(TIMES, z, strict=True):
        estimate = identifier.step(float(t), row)
    estimate = identifier._settled(estimate)
    low, high = estimate["q"].interval()
    prior = 2 * 1.959964 * np.sqrt(model.Q.variance)
    return Found(
        model.mesh.p[0], true, estimate.q, (low <= true) & (true <= high), (high - low) / prior
    )


def together(several: list[Found], low: float, high: float) -> tuple[float, float, float]:
    """Return error over that of the prior, share inside, and width between two places."""
    x = several[0].x
    part = (x >= low - 1e-9) & (x <= high + 1e-9)
    before = np.sqrt(sum(np.sum((one.true - 3.0)[part] ** 2) for one in several))
    after = np.sqrt(sum(one.error(part) ** 2 for one in several))
    hit = float(np.mean([one.hit[part] for one in several]))
    return float(after / before), hit, float(np.mean([one.width[part] for one in several]))


@pytest.mark.long
def test_a_field_is_found_as_far_as_the_dynamics_carry_and_its_interval_tells_how_far():
    law = lp.SensitivityLaw(shadows=None)
    several = [found(seed, law) for seed in range(5)]
    seen, hit, narrow = together(several, 0.5, 0.9)
    assert seen < 0.25
    assert hit > 0.8
    near, _, wider = together(several, 0.4, 0.49)
    assert near < 0.75
    outside, hit, _ = together(several, 0.0, 0.49)
    assert outside < 0.85
    assert hit > 0.85
    _, _, widest = together(several, 0.0, 0.02)
    assert narrow < 0.2 < wider < 0.6
    assert 0.85 < widest < 1.15


@pytest.mark.long
def test_modes_that_are_too_few_mislead_where_nothing_is_seen():
    laws = (lp.SensitivityLaw(modes=m, shadows=None) for m in (6, "auto"))
    few, enough = (together([found(seed, law) for seed in (0, 1)], 0, 0.3) for law in laws)
    assert few[0] > 1.5 * enough[0]
    assert few[1] < enough[1]


def test_what_modes_leave_out_stays_as_the_prior_has_it():
    model = reaction(CELLS)
    prior = np.sqrt(np.diag(np.linalg.inv(model.Q.gram.toarray())))
    for modes in (1, 6, 31, "auto"):
        points = lp.Points([0.5], noise=1.0)
        law = lp.SensitivityLaw(modes=modes)
        identifier = lp.Identifier(model, points, law, u0=0.0)
        estimate = identifier.estimate()
        assert estimate.q_std == pytest.approx(prior)
        low, high = estimate["q"].interval()
        assert high - low == pytest.approx(2 * 1.959964 * prior)
        data = identifier.run([(0.1, [0.1])]).to_xarray()
        assert (data["q_std"][-1] > 0.9 * prior).all()


def test_what_modes_leave_out_moves_like_the_rest():
    mesh = lp.interval(0.0, 1.0, 10)
    points, state = lp.Points([0.5], noise=1e3), lp.Field(mesh, lp.linear(mesh))

    def deviation(modes: int, evolution: Any, prior: lp.fem.Prior) -> Array:
        q = lp.Field(mesh, lp.linear(mesh), inner="H1", prior=prior, evolution=evolution)
        model = lp.Model(state, {"q": q}, A=lambda q, u, v, x: q.q * u * v)
        identifier = lp.Identifier(model, points, lp.SensitivityLaw(modes=modes), u0=0.0)
        for t in (0.5, 1.0, 3.0):
            identifier.step(t, [0.0])
        return np.asarray(identifier.estimate().q_std)

    normal = lp.Normal(0.0, 2.0)
    for evolution in (lp.RandomWalk(0.7), lp.MeanReverting(2.0), lp.fem.Periodic(4.0)):
        few, all_ = deviation(3, evolution, normal), deviation(11, evolution, normal)
        assert few == pytest.approx(all_, rel=1e-3)
    log = lp.LogNormal(1.0, 2.0)
    few, all_ = (deviation(n, lp.RandomWalk(0.7), log) for n in (3, 11))
    assert few == pytest.approx(all_, rel=1e-2)


def test_auto_takes_as_many_modes_as_a_field_needs():
    def count(inner: Any) -> int:
        mesh = lp.interval(0.0, 1.0, 100)
        q = lp.Field(mesh, lp.linear(mesh), inner=inner)
        model = lp.Model(
            lp.Field(mesh, lp.linear(mesh)), {"q": q}, A=lambda q, u, v, x: q.q * u * v
        )
        identifier = lp.Identifier(model, lp.Points([0.5], noise=1.0), lp.SensitivityLaw(), u0=0.0)
        return int(np.asarray(identifier._latent_belief().prior_factor).shape[1])

    long, short = (count(lp.Sobolev(2, length)) for length in (1.0, 0.2))
    assert 3 <= long < 12 < short < 60
    assert count("L2") == 60
    with pytest.raises(lp.errors.LawError, match=r"modes must be a number, 'auto'"):
        lp.Identifier(
            reaction(CELLS), lp.Points([0.5], noise=1.0), lp.SensitivityLaw(modes="all"), u0=0.0
        )
