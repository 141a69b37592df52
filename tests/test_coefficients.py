"""Forms that are linear in coefficients computed from the unknowns equal their plain forms."""

import pickle

import numpy as np
import pytest
from factories import reaction

import livepde as lp
from livepde.errors import ConfigurationError, ModelError
from livepde.fem import Moment
from livepde.models import mobile_immobile, pumping_test
from livepde.stepping import BandedStage, member_stage

UNKNOWNS = {"k": lp.LogNormal(1.0, std=0.5), "C": lp.LogNormal(2.0, std=0.5)}
LINE = lp.interval(0.0, 1.0, 12)


def per_capacity(q):
    return {"diffusivity": q.k / q.C, "per_capacity": 1 / q.C}


def rod(named: bool, unknowns=UNKNOWNS, **options):
    state = lp.Field(LINE, lp.linear(LINE), dirichlet={"right": 0.0})
    if named:
        A = [
            lambda q, u, v, x: q.diffusivity * lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("left", lambda q, _, v, x: -x.inputs["Q"] * q.per_capacity * v),
        ]
        options.setdefault("coefficients", per_capacity)
    else:
        A = [
            lambda q, u, v, x: q.k / q.C * lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("left", lambda q, _, v, x: -x.inputs["Q"] / q.C * v),
        ]
    return lp.Model(state, unknowns, A, inputs=["Q"], **options)


def estimates(model):
    sensors = lp.Points({"T_1": 0.2, "T_2": 0.6}, noise=0.01)
    identifier = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=0.0)
    rng = np.random.default_rng(3)
    for k in range(1, 21):
        t = 0.05 * k
        z = {"T_1": 0.4 * (1 - np.exp(-2 * t)), "T_2": 0.2 * (1 - np.exp(-t)), "Q": 1.0 + (k > 9)}
        estimate = identifier.step(t, z | {"T_1": z["T_1"] + 0.01 * rng.standard_normal()})
    return estimate


@pytest.mark.slow
def test_estimates_are_those_of_the_form_in_the_unknowns():
    plain, named = rod(named=False), rod(named=True)
    assert isinstance(member_stage(named), BandedStage)
    assert not isinstance(member_stage(plain), BandedStage)
    found, expected = estimates(named), estimates(plain)
    for name in UNKNOWNS:
        assert found[name].mean == pytest.approx(expected[name].mean, rel=1e-6)
        assert found[name].std == pytest.approx(expected[name].std, rel=1e-5)


@pytest.mark.slow
def test_members_of_a_fleet_are_single_runs():
    model = rod(named=True)
    sensors = lp.Points({"T_1": 0.2, "T_2": 0.6}, noise=0.01)
    starts = [np.array([1.0, 2.0]), np.array([0.5, 3.0])]
    fleet = lp.Fleet(model, sensors, lp.SensitivityLaw(), 2, q0=starts, u0=0.0)
    alone = [lp.Identifier(model, sensors, lp.SensitivityLaw(), q0=q0, u0=0.0) for q0 in starts]
    rng = np.random.default_rng(5)
    for k in range(1, 11):
        z, Q = rng.normal(0.2, 0.05, (2, 2)), np.array([1.0, 2.0])
        together = fleet.step(0.05 * k, z, {"Q": Q})
        each = [one.step(0.05 * k, z[m], {"Q": Q[m]}) for m, one in enumerate(alone)]
    for k, expected in enumerate(each):
        found = together.member(k)
        np.testing.assert_allclose(found.q, expected.q, rtol=1e-9)
        np.testing.assert_allclose(found.q_std, expected.q_std, rtol=1e-9)


def test_fluxes_and_errors_of_sensors_may_be_added():
    more = rod(named=True).with_unknowns({"o": lp.Normal(0.0, std=1.0)})
    more = more.with_terms(A=[lp.On("left", lambda q, u, v, x: q.o * u * v)])
    assert isinstance(member_stage(more), BandedStage)
    q = np.array([0.5, 2.0, 3.0])
    np.testing.assert_allclose(more.coefficients.value(q), [*q, 0.25, 0.5])
    by_hand = [[0.5, -0.125, 0.0], [0.0, -0.25, 0.0]]
    np.testing.assert_allclose(more.coefficients.slopes(q), [*np.eye(3), *by_hand])


RADII = lp.interval(0.1, 100.0, 10, geometric=True)
SHARE = lp.LogitNormal(0.5, std=0.1, bounds=(0.0, 1.0))


@pytest.mark.parametrize(
    ("model", "q"),
    [
        (
            pumping_test(RADII, lp.LogNormal(1e-3, 1e-3), lp.LogNormal(1e-4, 1e-4), b=3.0),
            [2e-3, 3e-4],
        ),
        (
            mobile_immobile(LINE, UNKNOWNS["k"], UNKNOWNS["C"], SHARE, UNKNOWNS["k"]),
            [2.0, 4.0, 0.3, 0.2],
        ),
    ],
)
def test_both_forms_of_a_ready_made_equation_agree(model, q):
    rng = np.random.default_rng(0)
    u, q = rng.standard_normal(model.X.dim), np.array(q)
    moment = Moment(0.0, dict.fromkeys(model.channels, 2.0))
    at = {"u": u, "moment": moment}
    p = model.coefficients.value(q)
    found = model.linear_A.vector("v", q=p, **at)
    np.testing.assert_allclose(found, model.physical_A.vector("v", q=q, **at), rtol=1e-12)
    slopes = model.linear_A.matrix("v", "q", q=p, **at) @ model.coefficients.slopes(q)
    np.testing.assert_allclose(
        slopes, model.physical_A.matrix("v", "q", q=q, **at).toarray(), rtol=1e-11, atol=1e-13
    )


@pytest.mark.slow
def test_an_unknown_that_varies_in_space_is_evaluated_at_each_step():
    k = lp.Piecewise({"in": lambda x: x[0] < 0.5, "out": lambda x: x[0] >= 0.5}, UNKNOWNS["k"])
    models = [rod(named, unknowns={"k": k, "C": UNKNOWNS["C"]}) for named in (True, False)]
    assert not any(isinstance(member_stage(model), BandedStage) for model in models)
    found, expected = map(estimates, models)
    np.testing.assert_allclose(found.q, expected.q, rtol=1e-10)  # 1/C Q and Q/C round differently


def test_numbers_computed_beside_regions_with_their_own_priors():
    own = {"soil": lp.Scalar(lp.LogNormal(0.5, std=0.1))}
    layers = {"soil": lambda x: x[0] < 0.5, "rock": lambda x: x[0] >= 0.5}
    unknowns = UNKNOWNS | {"k": lp.Piecewise(layers, lp.LogNormal(1.0, std=0.5), own=own)}
    state = lp.Field(LINE, lp.linear(LINE), dirichlet={"right": 0.0})

    def A(inverse):
        return lambda q, u, v, x: q.k * inverse(q) * lp.dot(lp.grad(u), lp.grad(v))

    plain = lp.Model(state, unknowns, A(lambda q: 1 / q.C))
    named = lp.Model(
        state, unknowns, A(lambda q: q.inverse), coefficients=lambda q: {"inverse": 1 / q.C}
    )
    u = np.random.default_rng(0).standard_normal(plain.X.dim)
    found, expected = (model.A(u).matrix.toarray() for model in (named, plain))
    assert found == pytest.approx(expected, rel=1e-12)


def test_a_name_is_that_of_one_coefficient():
    with pytest.raises(ModelError, match="'k' is an unknown"):
        rod(named=True, coefficients=lambda q: {"k": q.k / q.C})


def test_what_does_not_fit_is_refused():
    with pytest.raises(ModelError, match="named unknowns"):
        reaction(LINE, lp.linear(LINE), coefficients=lambda q: {"double": 2 * q})
    with pytest.raises(ModelError, match="no dA"):
        rod(named=True, dA=lambda q, u, du, v, x: q.k * du * v)


def test_a_model_with_numbers_is_pickled_with_its_functions():
    with pytest.raises(ConfigurationError, match="lambda"):
        pickle.dumps(rod(named=True))
