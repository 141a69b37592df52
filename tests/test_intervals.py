"""Intervals of unknowns are transformed quantiles within the bounds."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
from livepde import plots
from livepde.runs import tables

MESH = lp.interval(0.0, 1.0, 8)
TIMES = 0.1 * np.arange(1, 11)


def identifier(law: lp.laws.AnyLaw | None = None, **unknowns: Any) -> lp.Identifier:
    model = lp.Model(
        lp.Field(MESH, ElementLineP1(), dirichlet={"boundary": 0.0}),
        unknowns,
        A=lambda q, u, v, x: next(iter(vars(q).values())) * lp.dot(lp.grad(u), lp.grad(v)),
    )
    law = law or lp.SensitivityLaw(noise=0.1)
    observation = lp.Points([0.5]) if isinstance(law, lp.SensitivityLaw) else lp.Full()
    return lp.Identifier(model, observation, law, u0=lambda x: np.sin(np.pi * x[0]))


def run(ident: lp.Identifier) -> tuple[Any, Any]:
    """Return the last estimate and the dataset."""
    size = ident.observed.size
    result = ident.run([(t, np.full(size, np.exp(-3 * t))) for t in TIMES])
    return result.last, result.to_xarray()


def test_a_plain_number_has_value_and_deviations():
    estimate, data = run(identifier(a=lp.Normal(0.3, 0.1)))
    value, std = estimate.parameters["a"]
    assert estimate["a"].interval() == pytest.approx(
        (value - 1.959964 * std, value + 1.959964 * std)
    )
    assert estimate["a"].interval(0.6826895) == pytest.approx((value - std, value + std))
    # In a dataset the same variables as those of other priors.
    assert float(data["a_low"][-1]) == pytest.approx(value - 1.959964 * std)
    assert float(data["a_high"][-1]) == pytest.approx(value + 1.959964 * std)


def test_a_logarithm_has_quantiles_of_a_log_normal_number():
    estimate, data = run(identifier(a=lp.LogNormal(0.3, 0.3)))
    value, std = estimate.parameters["a"]
    low, high = estimate["a"].interval()
    assert low > 0
    assert low * high == pytest.approx(value**2)
    assert np.log(high / value) == pytest.approx(1.959964 * std / value)
    assert (data["a_low"][-1], data["a_high"][-1]) == (low, high)
    (ends,) = (row[3] for row in tables(data)[0].rows)
    assert ends.split(" to ")[0].startswith(f"{low:.2g}")


@pytest.mark.slow
def test_bounds_cut_an_interval_off():
    estimate, _ = run(identifier(a=lp.Normal(0.3, 0.1, bounds=(0.28, 0.33))))
    low, high = estimate["a"].interval(0.9999)
    assert (low, high) == (0.28, 0.33)
    inside = identifier(a=lp.LogitNormal(0.3, 0.1, bounds=(0.1, 0.6)))
    low, high = run(inside)[0]["a"].interval(0.999999)
    assert 0.1 < low < high < 0.6


def test_where_rounding_hides_the_latent_value_the_interval_is_open():
    share = lp.Scalar(lp.LogitNormal(0.3, 0.1, bounds=(0.0, 1.0)), within=np.inf)
    assert share.interval(1.0, 0.0) == (0.0, 1.0)
    positive = lp.Scalar(lp.LogNormal(0.3, 0.1), within=np.inf)
    assert positive.interval(0.0, 0.0) == (0.0, np.inf)


def test_an_interval_ends_where_latent_values_do():
    positive = lp.Scalar(lp.LogNormal(0.3, 0.1), within=4.0)
    ends = (0.3 * np.exp(-4 / 3), 0.3 * np.exp(4 / 3))
    assert positive.interval(0.3, 1e6) == pytest.approx(ends)
    assert positive.interval(0.0, 0.0) == pytest.approx((0.0, ends[1]))  # it holds the value


@pytest.mark.slow
def test_fields_have_an_interval_for_each_coefficient():
    field = lp.Field(MESH, ElementLineP1(), inner="H1", prior=lp.LogNormal(0.3, std=0.2))
    estimate, data = run(identifier(a=field))
    low, high = estimate["a"].interval()
    assert low.shape == estimate.q.shape
    assert (low > 0).all()
    assert (low * high) == pytest.approx(estimate.q**2)
    assert data["a_low"].dims == data["a"].dims
    assert data["a_low"].values[-1] == pytest.approx(low)
    drawn = plots.profiles(data, "a").collections[0].get_paths()[0].vertices[:, 1]
    assert (drawn.min(), drawn.max()) == pytest.approx((low.min(), high.max()))


def test_without_covariance_there_is_no_interval():
    estimate, data = run(identifier(lp.GradientLaw(), a=lp.Normal(0.3, 0.1, bounds=(0.0, 1.0))))
    assert np.isnan(estimate["a"].interval()).all()
    assert tables(data)[0].rows[0][3] == "–"


@pytest.mark.slow
def test_an_unknown_is_read_by_its_label():
    estimate, _ = run(identifier(a=lp.Normal(0.3, 0.1)))
    value, std = estimate.parameters["a"]
    assert (estimate["a"].mean, estimate["a"].std) == (value, std)
    assert str(estimate["a"]) == f"{value:.4g} ± {std:.2g}"
    field = lp.Field(MESH, ElementLineP1(), inner="H1", prior=lp.Normal(0.2, std=0.1))
    estimate, _ = run(identifier(a=field))
    assert estimate["a"].mean.shape == estimate["a"].std.shape == (9,)
    low, high = estimate["a"].interval()
    assert (low < estimate["a"].mean).all()
    assert (estimate["a"].mean < high).all()


@pytest.mark.parametrize("spread", [0.01, 0.3, 1.5])
@pytest.mark.parametrize("lower", [0.0, -2.0])
def test_moments_of_a_log_normal_are_the_closed_form(spread: float, lower: float):
    """Those of exp(N(log m, s^2)), as in any textbook, about a lower bound."""
    prior = lp.LogNormal(1.0, std=0.5, bounds=(lower, np.inf))
    above = 0.7
    mean, std = prior.moments(lower + above, spread * above)
    assert mean == pytest.approx(lower + above * np.exp(spread**2 / 2), rel=1e-13)
    expected = above * np.exp(spread**2 / 2) * np.sqrt(np.exp(spread**2) - 1)
    assert std == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("spread", [0.05, 1.0, 6.0])
def test_moments_under_a_transform_are_those_of_samples(spread: float):
    latent = 0.4 + spread * np.random.default_rng(0).standard_normal(400_000)
    share = 1.0 / (1.0 + np.exp(-latent))
    prior = lp.LogitNormal(0.5, std=0.2, bounds=(-1.0, 3.0))
    median = 1.0 / (1.0 + np.exp(-0.4))
    found = prior.moments(-1.0 + 4.0 * median, spread * 4.0 * median * (1.0 - median))
    expected = -1.0 + 4.0 * share.mean(), 4.0 * share.std()
    assert found == pytest.approx(expected, abs=5.0 * 4.0 * share.std() / 400_000**0.5)


def test_moments_at_the_end_of_a_range_are_that_end():
    for prior, end in (
        (lp.LogNormal(1.0, std=0.5), 0.0),
        (lp.LogitNormal(0.5, std=0.2, bounds=(0.0, 1.0)), 1.0),
    ):
        assert prior.moments(end, 0.0) == (end, 0.0)
        assert np.isnan(prior.moments(0.5, np.nan)[1])


@pytest.mark.slow
def test_what_is_reported_under_a_transform_says_what_it_is():
    estimate, data = run(identifier(a=lp.LogNormal(0.3, 0.1)))
    value, first_order = estimate.parameters["a"]
    marginal, spread = estimate["a"], first_order / value
    assert (marginal.median, marginal.deviation) == (value, first_order)
    assert marginal.mean == pytest.approx(value * np.exp(spread**2 / 2), rel=1e-12)
    assert marginal.std > first_order
    low, high = marginal.interval()
    assert str(marginal) == f"{value:.4g} (95 %: {low:.4g} to {high:.4g})"
    assert data["a"].attrs["comment"] == "the median"
    assert data["a_std"].attrs["comment"].startswith("to first order")
    assert tables(data)[0].title == "Estimates (median, std. dev. to first order)"
    field = lp.Field(MESH, ElementLineP1(), inner="H1", prior=lp.LogNormal(0.3, std=0.2))
    estimate, data = run(identifier(a=field))
    spread = estimate["a"].deviation / estimate["a"].median
    assert estimate["a"].mean == pytest.approx(estimate.q * np.exp(spread**2 / 2))
    assert data["a"].attrs["comment"] == "the median"
    assert data["a_std"].attrs["comment"].startswith("to first order")
    _, data = run(identifier(a=lp.Normal(0.3, 0.1)))
    assert tables(data)[0].title == "Estimates"
    assert "comment" not in data["a"].attrs


def test_bad_questions():
    estimate, _ = run(identifier(a=lp.Normal(0.3, 0.1)))
    with pytest.raises(lp.errors.ConfigurationError, match=r"there are \['a', 'u'\]"):
        estimate["b"].interval()
    with pytest.raises(lp.errors.SpaceError, match="level must lie between 0 and 1"):
        estimate["a"].interval(95)
    belief = estimate.belief
    replaced = replace(estimate, belief=replace(belief, q_factor=2.0 * belief.q_factor))
    assert np.diff(replaced["a"].interval()) == pytest.approx(2 * np.diff(estimate["a"].interval()))
