"""Time-varying unknowns between sparse samples agree with the exact filter and smoother."""

from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
from benchmarks.silent.exact_walk import Exact
from livepde.laws.noise_rows import MOST, grades

WALK, REVERTING = {"rate": 0.3, "std": 2.0}, {"time": 3.0, "std": 1.0}
KINDS: dict[str, dict[str, float]] = {"walk": WALK, "reverting": REVERTING}
SPACE = lp.Field(lp.interval(0.0, 1.0, 2), ElementLineP1())


def identifier(exact: Exact, **options: Any) -> lp.Identifier:
    """Return an identifier of a state that is the same everywhere, u' = s - decay u."""
    moves = lp.RandomWalk(exact.rate) if exact.rate else lp.MeanReverting(exact.time)
    model = lp.Model(
        SPACE,
        {"s": lp.Scalar(lp.Normal(0.0, std=exact.std), evolution=moves)},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)) + exact.decay * u * v,
    )
    law = lp.SensitivityLaw(shadows=None, verdict=False, gate=np.inf, **options)
    return lp.Identifier(model, lp.Points({"a": 0.3}, noise=exact.noise), law, u0=0.0)


def spread(who: lp.Identifier, exact: Exact) -> float:
    """Return the standard deviation of s that the filter itself has."""
    return float(np.linalg.norm(who._state.now.C[0, :, 0])) * exact.std


def exact_of(kind: str, decay: float, share: float) -> Exact:
    """Return a process whose readings have a noise in proportion to what s does to them."""
    return Exact(decay=decay, noise=0.3 * share / max(decay, 0.3), **KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("decay", [0.0, 1.0, 20.0])
def test_standard_deviations_are_those_of_the_exact_filter(kind: str, decay: float):
    for h in (0.05 * 3.0, 0.5 * 3.0, 2.0 * 3.0):
        for share in (0.01, 0.2):
            exact = exact_of(kind, decay, share)
            who, count = identifier(exact, refit=None), 12
            _, P = exact.filtered(h, np.zeros(count))
            for k in range(count):
                who.step(k * h, {"a": 0.0})
                assert spread(who, exact) == pytest.approx(np.sqrt(P[k, 1, 1]), rel=0.01)


# Ten parts at most left deviations 7 % too large, or 40 % too small.
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("decay", [300.0, 1e4, 1e5])
def test_states_that_follow_at_once_have_exact_deviations(kind: str, decay: float):
    exact, h, count = exact_of(kind, decay, 0.01), 6.0, 6
    who, (_, P) = identifier(exact, refit=None), exact.filtered(h, np.zeros(count))
    for k in range(count):
        who.step(k * h, {"a": 0.0})
        assert spread(who, exact) == pytest.approx(np.sqrt(P[k, 1, 1]), rel=0.01)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("decay", [0.0, 20.0])
def test_empty_rows_between_samples_change_nothing(kind: str, decay: float):
    exact, h = exact_of(kind, decay, 0.1), 2.0
    rng = np.random.default_rng(0)
    z = exact.read(exact.drawn(h, 8, rng), rng)
    plain, filled = identifier(exact, refit=None), identifier(exact, refit=None)
    for k, value in enumerate(z):
        for j in range(1, 12) if k else ():
            filled.step((k - 1 + j / 12) * h, {})
        one, other = (who.step(k * h, {"a": value}) for who in (plain, filled))
        std = spread(filled, exact)
        assert spread(plain, exact) == pytest.approx(std, rel=0.01)
        assert float(one["s"].mean) == pytest.approx(float(other["s"].mean), abs=0.05 * std)


@pytest.mark.parametrize("kind", KINDS)
def test_the_smoother_is_the_exact_one(kind: str):
    exact, h = exact_of(kind, 0.0, 0.1), 2.0
    rng = np.random.default_rng(1)
    z = exact.read(exact.drawn(h, 15, rng), rng)
    who = identifier(exact, refit=None)
    result = who.run([(k * h, {"a": value}) for k, value in enumerate(z)])
    mean, P = exact.smoothed(h, z)
    smoothed, std = result.smoothed(), np.sqrt(P[:, 1, 1])
    np.testing.assert_allclose(smoothed.s_std, std, rtol=0.02)
    assert np.abs((smoothed.s - mean[:, 1]) / std).max() < 0.02
    last = result.last["s"]
    assert float(smoothed.s[-1]) == pytest.approx(float(last.mean), rel=1e-6)


def test_steps_have_a_bounded_number_of_parts():
    rates = np.array([0.0, 1e-3, 1.0, 1e30, np.inf])
    assert grades(rates, 1.0).tolist() == [1, 1, 3, MOST, MOST]
