"""A u0 made from readings has their uncertainty, also if their noise is estimated."""

from typing import Any

import numpy as np
import pytest

import livepde as lp

NOISE, PLACES = 0.1, {"a": 0.1, "b": 0.5, "c": 0.9}
PRIOR = lp.Normal(0.0, std=2.0)
TIMES = np.linspace(0.0, 1.0, 60)


def model(unknown: Any) -> lp.Model:
    """Return an insulated rod with a source s: u' = s - u/10 everywhere."""
    mesh = lp.interval(0.0, 1.0, 12)
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh)),
        {"s": unknown},
        lambda q, _, v, x: -q.s * v,
        B=lambda u, v, x: 0.2 * lp.dot(lp.grad(u), lp.grad(v)) + 0.1 * u * v,
    )


def run(seed: int, guess: float, noise: str | None, unknown: Any) -> lp.Estimate:
    rng = np.random.default_rng(seed)
    gained = (1.0 - np.exp(-0.1 * TIMES)) / 0.1
    z = (np.exp(-0.1 * TIMES) + 0.5 * gained)[:, None] + NOISE * rng.standard_normal((60, 3))
    identifier = lp.Identifier(
        model(unknown),
        lp.Points(PLACES, noise=guess),
        lp.SensitivityLaw(noise=noise),
        u0=float(z[0].mean()),
        u0_from=dict.fromkeys(PLACES, 1.0 / 3.0),
    )
    last = identifier.run(list(zip(TIMES.tolist(), z, strict=True))).last
    return last


@pytest.mark.slow
@pytest.mark.parametrize(
    "unknown",
    [
        pytest.param(PRIOR, id="constant"),
        pytest.param(lp.Scalar(PRIOR, evolution=lp.RandomWalk(0.01)), id="moving"),
    ],
)
def test_the_first_guess_of_the_noise_does_not_say_how_certain_u0_is(unknown: Any):
    value, std = run(0, NOISE, None, unknown).parameters["s"]
    found, own = run(0, 0.1 * NOISE, "auto", unknown).parameters["s"]
    assert own == pytest.approx(std, rel=0.15)
    assert found == pytest.approx(value, abs=0.3 * std)
