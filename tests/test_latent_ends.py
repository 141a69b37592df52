"""Latent values stay within a number of prior standard deviations; the filter stays linear."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
from livepde import cases
from livepde.runs.run_verdict import doubts

MESH = lp.interval(0.0, 1.0, 8)
NOISE = 0.01


def decay(unknown: Any) -> lp.Model:
    state = lp.Field(MESH, ElementLineP1())
    return lp.Model(state, {"k": unknown}, lambda q, u, v, x: q.k * u * v)


def source(unknown: Any) -> lp.Model:
    """State and sensors are linear in the unknown: so is the filter, wherever it is linearised."""
    state = lp.Field(MESH, ElementLineP1())
    return lp.Model(state, {"v": unknown}, lambda q, u, v, x: (u - q.v) * v)


def run(model: lp.Model, stream: Any, law: Any = None, u0: float = 1.0) -> lp.Result:
    points = lp.Points([0.3, 0.7], noise=NOISE)
    return lp.Identifier(model, points, law or lp.SensitivityLaw(), u0=u0).run(stream)


def stream(values: Any) -> list[tuple[float, Any]]:
    return [(0.1 * (k + 1), np.full(2, value)) for k, value in enumerate(values)]


SPIKE = [np.exp(-0.05 * (k + 1)) for k in range(30)]
SPIKE[12] = 9999.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prior", "law"),
    [
        (lp.LogNormal(0.4, 0.1), lp.SensitivityLaw(guards=None)),
        (lp.LogitNormal(0.4, 0.1, (0.0, 1.0)), lp.SensitivityLaw()),
    ],
)
def test_a_spike_does_not_take_a_latent_value_beyond_its_ends(prior: Any, law: Any):
    unknown = lp.Scalar(prior, within=4.0)
    least, largest = (
        float(prior.transform.value(np.array(prior.latent_mean + s * 4.0 * prior.latent_std)))
        for s in (-1.0, 1.0)
    )
    result = run(decay(unknown), stream(SPIKE), law)
    data = result.to_xarray()
    for name in ("k", "k_low", "k_high"):
        values = data[name].values
        assert (values >= least * (1 - 1e-12)).all()
        assert (values <= largest * (1 + 1e-12)).all()
    assert np.isfinite(data["k_std"].values).all()


@pytest.mark.slow
def test_what_is_reached_is_told():
    unknown = lp.LogNormal(0.5, 0.01)
    far = [np.exp(-2.0 * (k + 1) * 0.1) for k in range(24)]  # four times the prior: 139 deviations
    result = run(decay(unknown), stream(far))
    data = result.to_xarray()
    assert "held" in [finding.what for finding in result.verdict.findings]
    assert data["k"].values[-1] == pytest.approx(0.5 * np.exp(10 * 0.02))
    assert data["bounded"].values[-1] == 1.0
    assert any("the prior is much too narrow" in text for text in doubts(data))
    # Of a last fit that has converged it counts where that has ended, not what was on the way.
    assert data.attrs["bounded_at_end"] == 1.0
    data.attrs["bounded_at_end"] = 0.0
    assert not any("were held at that distance" in text for text in doubts(data))
    fair = run(decay(lp.LogNormal(0.5, 0.5)), stream(far)).to_xarray()
    assert fair.attrs["bounded_at_end"] == 0.0
    assert "bounded" not in fair
    assert fair["k"].values[-1] == pytest.approx(2.0, rel=0.2)
    assert not any("held" in text for text in doubts(fair))


@pytest.mark.long
def test_a_stated_number_counts_and_infinity_is_no_end():
    far = [np.exp(-2.0 * (k + 1) * 0.1) for k in range(40)]
    narrow = lp.LogNormal(0.5, 0.01)
    law = lp.SensitivityLaw(gate=np.inf)
    near = run(decay(lp.Scalar(narrow, within=3.0)), stream(far), law).to_xarray()
    assert near["k"].values[-1] == pytest.approx(0.5 * np.exp(3 * 0.02))
    free = run(decay(lp.Scalar(narrow, within=np.inf)), stream(far), law).to_xarray()
    assert free["k"].values[-1] > 1.5
    assert "bounded" not in free


@pytest.mark.long
def test_the_filter_stays_linear_so_that_nothing_is_lost():
    """While the estimate is held, the filter learns as ever: afterwards it is where it would be."""
    values = [5.0] * 3 + [0.0] * 60
    law = lp.SensitivityLaw(guards=None, gate=np.inf, shadows=None)
    held, free = (
        run(source(lp.Scalar(lp.Normal(0.0, 0.2), within=within)), stream(values), law, 0.0)
        for within in (2.0, np.inf)
    )
    a, b = held.to_xarray(), free.to_xarray()
    assert b["v"].values.max() > 1.0
    assert a["v"].values.max() == pytest.approx(0.4)
    inside = np.abs(b["v"].values) < 0.4
    assert inside[-1]
    np.testing.assert_allclose(a["v"].values[inside], b["v"].values[inside], atol=1e-9)
    np.testing.assert_allclose(a["v_std"].values, b["v_std"].values, rtol=1e-9)
    np.testing.assert_allclose(a["innovation"].values, b["innovation"].values, atol=1e-9)


@pytest.mark.long
def test_a_walk_has_no_end():
    walk = lp.Scalar(lp.Normal(0.0, 0.1), evolution=lp.RandomWalk(1.0))
    # No gate: nothing but the end would keep it from where these readings are.
    law = lp.SensitivityLaw(gate=np.inf)
    data = run(source(walk), stream([5.0] * 30), law, u0=0.0).to_xarray()
    assert data["v"].values[-1] > 2.0
    assert "bounded" not in data


@pytest.mark.slow
@pytest.mark.parametrize("pointwise", [True, False])
def test_a_field_stays_within_its_ends(pointwise: bool):
    inner = lp.Sobolev(1, 0.3).pointwise(1) if pointwise else lp.Sobolev(1, 0.3)
    field = lp.Field(
        MESH, ElementLineP1(), inner=inner, prior=lp.LogNormal(0.5, std=0.1), within=3.0
    )
    model = decay(field)
    law = lp.SensitivityLaw(gate=np.inf)
    identifier = lp.Identifier(model, lp.Points([0.3, 0.7], noise=NOISE), law)
    lower, upper = identifier._work.filter.reduction.ends
    assert (upper > lower).all()
    far = [np.exp(-4.0 * (k + 1) * 0.1) for k in range(12)]
    data = run(model, stream(far), law).to_xarray()
    assert data["k"].values.max() <= np.exp(upper).max() * (1 + 1e-12)
    assert data["bounded"].values.max() >= 1.0
    if pointwise:
        most = 0.5 * np.exp(3.0 * np.sqrt(2.0) * 0.2)
        assert data["k_high"].values.max() <= most * (1 + 1e-12)


def test_the_gradient_law_knows_no_such_ends():
    """They belong to a covariance: the paper's law has none, and keeps to bounds alone."""
    model = decay(lp.Scalar(lp.Normal(0.5, 0.01), within=1.0))
    assert np.isinf(model.latent.bounds[1]).all()


@pytest.mark.parametrize("within", [0.0, -1.0, np.nan])
def test_a_number_that_is_not_positive_is_refused(within: float):
    with pytest.raises(lp.errors.SpaceError, match="Scalar: within must be a positive number"):
        lp.Scalar(lp.Normal(), within=within)


def test_a_case_states_it(tmp_path: Path):
    path = tmp_path / "case.toml"
    path.write_text(
        """
equation = "heat"
mesh = { from = 0, to = 1, cells = 8 }
data = { file = "data.csv", time = "t" }
unknowns.alpha = { prior = 1, std = 0.1, within = 4 }
unknowns.source = { prior = 1, std = 0.1 }
channels.left = { role = "boundary", column = "left", at = "left" }
channels.T = { role = "sensor", column = "T", at = 0.5, noise = 0.1 }
law.kind = "sensitivity"
""",
        encoding="utf-8",
    )
    unknowns = cases.load(path).model.parameter_space.unknowns
    assert [unknowns[name].within for name in ("alpha", "source")] == [4.0, 10.0]


def test_an_interval_at_a_bound_is_the_half_within():
    rng = np.random.default_rng(1)
    given = [(t, z + NOISE * rng.standard_normal(2)) for t, z in stream(np.linspace(0.5, 3.0, 40))]
    last = run(source(lp.Scalar(lp.Normal(0.0, 0.1), within=5.0)), given, u0=0.0).last
    assert last is not None and last.verdict.errors is not None  # noqa: PT018  for the types
    one = last.verdict.errors["v"]
    assert one.value == one.high == pytest.approx(0.5)
    assert one.low < one.plain_low < one.high
