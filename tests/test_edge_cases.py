"""Edge cases of models, samples and checkpoints, each by its smallest example."""

import math
from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import pytest
import scipy.sparse as sp
import xarray as xr
from factories import diffusion, laplace, line, observe, product, truth
from skfem import ElementLineP1

import livepde as lp
from livepde.diagnostics import check_model

ZERO = {"boundary": 0.0}


def conduction(prior=1.0, **options):
    return lp.Model(
        lp.Field(line(20), ElementLineP1(), dirichlet=ZERO),
        lp.Normal(prior),
        A=diffusion,
        f=lambda x, t: 10 * (1 + np.sin(3 * t)) + 0 * x[0],
        **options,
    )


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.3, 1.0, 1.3])
def test_an_unknown_in_the_principal_part_is_found_from_partial_data(start):
    """Lagged sweeps held A(w) q whole: the iteration went to q = 0 and called it ok."""
    model = conduction()
    times = 0.1 * np.arange(60)
    states = truth(model, np.array([1.3]), 0.0, times)
    omega = lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))
    ident = lp.Identifier(model, omega, lp.GradientLaw(gain=10.0), q0=start)
    for t, u in zip(times[1:], states[1:], strict=True):
        estimate = ident.step(t, ident.observed.G @ u)
        assert estimate.status.ok
        assert estimate.steps == 1
    assert estimate.q[0] == pytest.approx(1.3, abs=1e-3)


@pytest.mark.parametrize("sensors", [lp.Full(), lp.Points([0.2, 0.6])])
def test_a_sample_without_any_value_is_a_step_of_the_model(sensors):
    ident = lp.Identifier(conduction(), sensors, lp.GradientLaw())
    estimate = ident.step(0.1, np.full(ident.observed.size, np.nan))
    assert estimate.status.ok
    np.testing.assert_allclose(
        estimate.u, truth(conduction(), np.array([1.0]), 0.0, [0.0, 0.1])[-1]
    )


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, 0.5])
def test_a_parameter_of_zero_is_no_failure(start):
    """q is nothing but rounding errors then, and has no relative accuracy."""
    model = lp.Model(
        lp.Field(line(10), ElementLineP1(), dirichlet=ZERO),
        lp.Normal(0.0),
        A=product,
        B=laplace,
        f=1.0,
    )
    states = truth(model, np.array([0.0]), 0.0, 0.5 * np.arange(40))
    G = observe(model, lp.Full()).G
    ident = lp.Identifier(model, lp.Full(), lp.GradientLaw(gain=1e3), q0=start, u0=states[-1])
    for k in range(1, 200):
        assert ident.step(0.1 * k, G @ states[-1]).status.ok
    assert abs(ident.estimate().q[0]) < 1e-6


def test_unknowns_of_very_different_units():
    model = lp.Model(
        lp.Field(line(8), ElementLineP1(), dirichlet=ZERO),
        {"D": lp.Normal(5e-7, 1e-7), "T": lp.Normal(10.0, 10.0)},
        A=lambda q, u, v, x: 1e7 * q.D * lp.dot(lp.grad(u), lp.grad(v)) - q.T * v,
    )
    check_model(model, u=1.0).raise_if_failed()


def test_a_form_that_is_affine_at_times_is_not_affine():
    def solve(bend):
        model = lp.Model(
            lp.Field(line(4), ElementLineP1()),
            lp.Normal(0.0),
            A=product,
            B=lambda u, v, x: (np.maximum(x.t - 1, 0) * u**3 + bend * u**2) * v,
        )
        return truth(model, np.array([0.0]), 10.0, [0.0, 1.0, 2.0, 3.0])[-1]

    np.testing.assert_allclose(solve(0.0), solve(1e-12), rtol=1e-6)


def test_a_singular_stage_is_a_status():
    model = lp.Model(lp.Field(line(4), ElementLineP1()), lp.Normal(-1.0), A=product)
    law = lp.SensitivityLaw(noise=0.1)
    ident = lp.Identifier(model, lp.Points([0.5]), law, u0=1.0)
    assert ident.step(1.0, [2.0]).status.code in ("ok", "singular")


def test_a_prediction_that_is_not_a_number_is_not_accepted():
    model = lp.Model(
        lp.Field(line(4), ElementLineP1()),
        lp.Normal(0.0),
        A=product,
        f=lambda x, t: np.nan if abs(t - 0.2) < 1e-9 else 1.0,
    )
    law = lp.SensitivityLaw(noise=0.1)
    ident = lp.Identifier(model, lp.Points([0.5]), law, halvings=0)
    assert ident.step(0.1, [0.1]).status.ok
    assert ident.step(0.2, [np.nan]).status.code == "not_finite"
    assert ident.step(0.3, [0.3]).status.ok


@pytest.mark.slow
def test_a_checkpoint_of_other_options_is_refused_and_changes_nothing(tmp_path):
    mesh = line(8)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet=ZERO),
        lp.Field(mesh, ElementLineP1(), inner="H1"),
        A=product,
        B=laplace,
        f=1.0,
    )
    few, many = (
        lp.Identifier(model, lp.Points([0.5]), lp.SensitivityLaw(modes=k, noise=0.1))
        for k in (3, 5)
    )
    few.step(0.1, [0.1])
    few.save(tmp_path / "few.bin")
    many.step(0.05, [0.1])
    before = many.t, many._state
    with pytest.raises(lp.errors.RunError, match="saved with another option of the law"):
        many.load(tmp_path / "few.bin")
    assert (many.t, many._state) == before


@pytest.mark.slow
def test_a_checkpoint_from_before_the_start_starts_again(tmp_path):
    one, two = (lp.Identifier(conduction(), lp.Full(), lp.GradientLaw()) for _ in range(2))
    z = np.full(one.observed.size, 0.1)
    one.save(tmp_path / "fresh.bin")
    two.step(0.1, z)
    two.load(tmp_path / "fresh.bin")
    np.testing.assert_array_equal(two.step(0.1, z).u, one.step(0.1, z).u)


def test_notes_of_a_law_never_hide_an_unknown():
    model = lp.Model(
        lp.Field(line(10), ElementLineP1(), dirichlet=ZERO),
        {"residual": lp.Normal(2.0)},
        A=lambda q, u, v, x: q.residual * u * v,
        B=laplace,
    )
    ident = lp.Identifier(model, lp.Full(), lp.GradientLaw())
    result = ident.run([(0.1, np.zeros(ident.observed.size))])
    assert float(result.to_xarray()["residual"][-1]) == result.last.parameters["residual"][0]


def test_the_users_matrix_is_his_own():
    model = conduction()
    G = sp.csr_array(np.eye(3, model.X.dim) + 1e-18)
    before = G.nnz
    observed = observe(model, lp.observation.Matrix(G))
    assert G.nnz == before
    G.data[:] = 7.0
    assert abs(observed.G).max() == 1.0


def test_text_and_nothing_are_no_numbers():
    ident = lp.Identifier(conduction(), lp.Points([0.5]), lp.GradientLaw())
    with pytest.raises(lp.errors.SampleError, match="not an array of numbers"):
        ident.step(0.1, ["1.5"])
    with pytest.raises(lp.errors.ModelError, match="not finite"):
        lp.Identifier(conduction(), lp.Points([0.5]), lp.GradientLaw(), q0=np.nan)


def test_a_direct_sensor_that_reads_an_input_is_refused_by_its_law():
    model = conduction(inputs=("Q",))
    sensors = lp.Points({"a": 0.5}, direct={"a": lambda q, x: q * x.inputs["Q"]})
    with pytest.raises(lp.errors.LawError, match="SensitivityLaw"):
        lp.Identifier(model, sensors, lp.GradientLaw())


def rod_with_inputs(**options):
    model = lp.models.heat(
        lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": lp.Channel("left")}
    )
    return lp.Identifier(model, lp.Points({"T": 0.5}, noise=0.1), **options)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("assimilate_from", math.nan, "must be a number"),  # nothing would be assimilated
        ("assimilate_from", datetime(2025, 1, 1), "must be a number"),
        ("t0", datetime(2025, 1, 1), "must be a number"),
        ("dt_max", "1 s", "must be a number"),
        ("dt_max", timedelta(seconds=1), "must be a number"),
        ("input_noise", {"left": "0.1"}, "must be a positive number"),
        ("scheme", lp.Alexander2, "expected a time scheme"),
        ("validation", ["T"], "expected an observation"),
        ("u0", lambda x: np.zeros(3), "expected one real number for each point"),
        ("u0", lambda x: x[0] + 1j, "expected one real number for each point"),
    ],
)
def test_options_of_an_identifier_are_checked(option, value, said):
    with pytest.raises(lp.LivepdeError, match=said):
        rod_with_inputs(**{option: value})


@pytest.mark.parametrize("value", [lambda x: 1.0 + x[0], lambda t: t])
def test_a_boundary_value_of_one_argument_is_told(value):
    model = lp.models.heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": value})
    with pytest.raises(lp.errors.SpaceError, match=r"Expected a function g\(x, t\)"):
        lp.Identifier(model, lp.Points({"T": 0.5}, noise=0.1)).step(1.0, [0.0])


def test_an_input_with_two_values_is_refused():
    rod = rod_with_inputs()
    with pytest.raises(lp.errors.SampleError, match="'left' is 1 among the readings and 2 among"):
        rod.step(1.0, {"T": 0.0, "left": 1.0}, {"left": 2.0})
    samples = (
        ({"T": 0.0, "left": 1.0}, {"left": math.nan}),
        ({"T": 0.0, "left": math.nan}, {"left": 1.0}),
        ({"T": 0.0, "left": 1.0}, {"left": 1.0}),
        ({"T": 0.0}, pd.Series({"left": 1.0})),
        ({"T": 0.0, "left": 1.0}, None),
    )
    states = []
    for z, inputs in samples:
        rod = rod_with_inputs()
        states.append(rod.step(1.0, z, inputs).u.tolist())
    assert all(state == states[0] for state in states)
    ahead = [
        rod.forecast([2.0, 3.0], g) for g in ({"left": [1, 2]}, pd.DataFrame({"left": [1, 2]}))
    ]
    assert ahead[0].z.tolist() == ahead[1].z.tolist()
    with pytest.raises(lp.errors.SampleError, match="expected a mapping from names"):
        rod.step(3.0, [0.0], [1.0])


def test_options_of_a_result_are_checked():
    empty = rod_with_inputs().run([])
    with pytest.raises(lp.errors.ConfigurationError, match="contains no samples"):
        empty.plot.estimates()
    with pytest.raises(lp.errors.ConfigurationError, match="fields_every must be"):
        rod_with_inputs().run([], fields_every=0)
    result = rod_with_inputs().run([(1.0, [0.1], {"left": 0.0})])
    for n in (0, -1, 2.5):
        with pytest.raises(lp.errors.ConfigurationError, match="sample: n must be"):
            result.sample(n)


def test_names_and_masks_of_arrays_count():
    """They were dropped: a masked reading counted as measured, another sensor's as one's own."""
    sensors = lp.Points({"a": 0.2, "b": 0.6}, noise=0.1)
    for given in (
        np.ma.masked_array([0.7, 99.0], [False, True]),
        {"a": 0.7, "b": pd.NA},
        pd.Series({"b": pd.NA, "a": 0.7}),
        xr.DataArray([np.nan, 0.7], {"sensor": ["b", "a"]}),
    ):
        estimate = lp.Identifier(conduction(), sensors).step(0.1, given)
        assert np.isnan(estimate.innovation).tolist() == [False, True]
        other = lp.Identifier(conduction(), sensors).step(0.1, [0.7, np.nan])
        assert estimate.q[0] == other.q[0]
    with pytest.raises(lp.errors.SampleError, match="not a number"):
        lp.Identifier(conduction(), sensors).step(0.1, np.array([0.7 + 1j, 0.2]))
