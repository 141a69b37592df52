"""Unknowns that are positive, bounded, named, time-varying, nonlinear or initial values."""

import itertools
from typing import Any

import numpy as np
import pytest
from factories import advanced, conduction, driven_rod, readings
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from skfem import ElementLineHermite, ElementLineP1

import livepde as lp
from livepde.diagnostics import check_model
from livepde.errors import ConfigurationError, LawError, SpaceError
from livepde.fem import FunctionSpace, Latent
from livepde.fem.priors import CONSTANT, Log, Logit
from livepde.laws.reduction import Reduction
from livepde.stepping import ForwardStage

NOISE = 0.01
SENSORS = [0.25, 0.5, 0.75]
mesh = lp.interval(0.0, 1.0, 20)


def rod(parameter: Any, A: Any = None, **options: Any) -> lp.Model:
    """Return a rod heated and cooled at its left end; the diffusivity is `a` unless A is given."""
    return driven_rod(parameter, lambda t: np.sin(3.0 * t), mesh, A or conduction, **options)


def data(a: Any, times: Any, noise: float = NOISE, seed: int = 0) -> list[tuple[float, Any]]:
    """Return noisy samples of the sensors for a diffusivity a(t)."""
    found = readings(rod({"a": lp.Normal(1.0)}), lp.Points(SENSORS), a, times, noise, seed)
    return [(float(times[0]), np.zeros(len(SENSORS))), *found]


def estimates(model: lp.Model, law: Any, samples: Any, **options: Any) -> list[lp.Estimate]:
    sensors = lp.Points(SENSORS, noise=NOISE)
    identifier = lp.Identifier(model, sensors, law, **options)
    found = [identifier.step(t, z) for t, z in samples]
    assert all(estimate.status.ok for estimate in found)
    return found


@pytest.mark.slow
@given(st.floats(-8, 8), st.floats(-5, 5), st.floats(0.1, 10))
def test_transforms_have_their_inverse_and_derivatives(latent: float, lower: float, width: float):
    a, h = np.array([latent]), 1e-6
    for transform in (Log(lower), Logit(lower, lower + width)):
        q = transform.value(a)
        assert q > lower
        np.testing.assert_allclose(transform.inverse(q), a, rtol=1e-6, atol=1e-6)
        slope = (transform.value(a + h) - transform.value(a - h)) / (2 * h)
        curvature = (transform.slope(a + h) - transform.slope(a - h)) / (2 * h)
        size = float(transform.slope(a)[0])
        np.testing.assert_allclose(transform.slope(a), slope, rtol=1e-4, atol=1e-8)
        np.testing.assert_allclose(transform.curvature(a), curvature, rtol=1e-4, atol=1e-4 * size)


@pytest.mark.parametrize(
    "evolution", [CONSTANT, lp.RandomWalk(0.3), lp.MeanReverting(2.0), lp.fem.Periodic(5.0, 3)]
)
def test_transitions_are_exponentials_and_compose(evolution: Any):
    K = evolution.generator
    np.testing.assert_allclose(evolution.transition(0.7), expm(0.7 * K), atol=1e-12)
    both = evolution.transition(0.3) @ evolution.transition(0.4)
    np.testing.assert_allclose(both, evolution.transition(0.7), atol=1e-12)
    F, once = evolution.transition(0.4), evolution.growth(0.3, 2.0)
    twice = np.diag(F @ np.diag(once) @ F.T) + evolution.growth(0.4, 2.0)
    np.testing.assert_allclose(twice, evolution.growth(0.7, 2.0), atol=1e-12)


UNKNOWNS = {
    "log": lp.LogNormal(0.4, 0.2),
    "logit": lp.LogitNormal(0.4, 0.2, bounds=(0.1, 0.9)),
    "layers": lp.Piecewise(
        {"l": lambda x: x[0] < 0.5, "r": lambda x: x[0] >= 0.5}, lp.LogNormal(0.4, 0.2)
    ),
    "field": lp.Field(mesh, ElementLineP1(), inner="H1", prior=lp.LogNormal(0.4, std=0.2)),
    "periodic": lp.Scalar(lp.Normal(0.4, 0.1), evolution=lp.fem.Periodic(5.0, 2)),
    "periodic field": lp.Field(
        mesh,
        ElementLineP1(),
        inner="H1",
        prior=lp.Normal(0.4, std=0.1),
        evolution=lp.fem.Periodic(5.0),
    ),
    "walk": lp.Scalar(lp.Normal(0.4, 0.2), evolution=lp.RandomWalk(0.1)),
    "own": lp.Piecewise(
        {"l": lambda x: x[0] < 0.5, "r": lambda x: x[0] >= 0.5},
        lp.Normal(0.4, 0.2),
        own={"r": lp.Scalar(lp.LogNormal(0.3, 0.1), evolution=lp.MeanReverting(3.0))},
    ),
}


@pytest.mark.parametrize("name", UNKNOWNS)
def test_models_in_latent_coefficients_pass_the_checks(name: str):
    check_model(rod({"a": UNKNOWNS[name]}), u=1.0).raise_if_failed()


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.floats(0.2, 3.0), st.floats(0.2, 3.0), st.integers(0, 100))
def test_residuals_nonlinear_in_q_pass_the_checks(k: float, s: float, seed: int):
    unknowns = {"k": lp.LogNormal(k, 0.3 * k), "S": lp.LogNormal(s, 0.3 * s)}

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return q.k / q.S * (1 + u**2) * lp.dot(lp.grad(u), lp.grad(v)) - x.t / q.S * v

    model = rod(unknowns, A)
    assert not model.form_A.linear_in_parameter
    check_model(model, u=1.0, seed=seed, t=1.0).raise_if_failed()


def test_latent_coefficients_round_trip_and_report_what_is_outside():
    names = {name.replace(" ", "_"): item for name, item in UNKNOWNS.items()}
    space = FunctionSpace.of({**names, "n": lp.Scalars(("x", "y"), lp.Normal(0.1))}, "q")
    latent = Latent(space)
    q = space.prior
    np.testing.assert_allclose(latent.value(latent.inverse(q)), q, atol=1e-14)
    assert latent.dim == space.dim + 4 + 2 * 21
    assert list(space.labels)[-4:] == ["own[l]", "own[r]", "n[x]", "n[y]"]
    given = {"own": np.array([0.1, 0.2]), "own[r]": 0.7, "n": 0.5}
    np.testing.assert_array_equal(space.interpolate(given)[-4:], [0.1, 0.7, 0.5, 0.5])
    q = q.copy()
    q[0] = -1.0
    with pytest.raises(
        SpaceError, match=r"'log': a value is not strictly inside the bounds \(0.0, inf\)"
    ):
        latent.inverse(q)


HALVES = {"l": lambda x: x[0] < 0.5, "r": lambda x: x[0] >= 0.5}


def halves(**own: Any) -> lp.Piecewise:
    return lp.Piecewise(HALVES, lp.Normal(), own=own)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: halves(c=lp.Normal()), "the name of a region, one of"),
        (lambda: halves(l=2.0), "and a prior or a Scalar"),
        (lambda: rod(halves(l=lp.Normal())), "needs a name"),
        (lambda: lp.LogNormal(0.0, 1.0), r"median 0.0 must .* strictly inside \(0.0, inf\)"),
        (lambda: lp.LogNormal(-1.0, 1.0), r"median -1.0 is outside its bounds \(0.0, inf\)"),
        (lambda: lp.LogNormal(1.0, 1.0, bounds=(0, 2)), "with an upper one take LogitNormal"),
        (lambda: lp.LogNormal(1.0, 1.0, bounds=(-np.inf, np.inf)), "with a finite lower one"),
        (lambda: lp.LogitNormal(1.0, 1.0, bounds=(0, np.inf)), "two finite bounds"),
        (lambda: lp.LogitNormal(1.0, 1.0, bounds=(0, 1)), r"strictly inside \(0, 1\)"),
        (lambda: lp.Normal(np.nan), r"mean nan is outside its bounds"),
        (lambda: lp.Normal(np.inf), r"mean inf must be finite"),
        (lambda: lp.Normal(1.0, 0.0), "Normal: std must be a positive number; got 0.0"),
        (lambda: lp.Scalar(0.5), r"Scalar: prior=0.5; write Normal\(0.5, std\), or LogNormal"),
        (
            lambda: lp.Field(mesh, ElementLineP1(), prior="x"),
            r"Field: prior='x'; write Normal\(mean",
        ),
        (lambda: rod({"a": 0.5}), r"got 0.5 as an unknown; write Normal\(0.5, std\), or"),
        (lambda: lp.Scalar(lp.Normal(1.0), evolution="random-walk"), "expected RandomWalk"),
        (lambda: lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Normal()}), "by a penalty"),
        (lambda: lp.Scalars(("a", "a"), lp.Normal()), "names must be given and differ"),
        (lambda: lp.Scalars((), lp.Normal()), "names must be given and differ"),
        (lambda: lp.RandomWalk(0.0), "rate must be a positive number"),
        (lambda: lp.MeanReverting(-1.0), "time must be a positive number"),
        (lambda: lp.fem.Periodic(1.0, 0), "harmonics must be at least 1"),
        (
            lambda: lp.Field(mesh, ElementLineP1(), prior=lp.Normal(bounds=(0, 1))),
            "bounds need a LogNormal or LogitNormal",
        ),
        (
            lambda: lp.Field(mesh, ElementLineHermite(), prior=lp.LogNormal(1.0, std=1.0)),
            "element of first order",
        ),
        (
            lambda: lp.Scalar(lp.LogNormal(1.0, 1.0), evolution=lp.fem.Periodic(1.0)),
            "Periodic needs a prior without bounds and transform",
        ),
    ],
)
def test_priors_that_cannot_be_meant_are_one_sentence(build: Any, words: str):
    with pytest.raises(SpaceError, match=words):
        build()


@pytest.mark.parametrize(
    ("prior", "mean", "std", "bounds"),
    [
        (lp.Normal(2.0, 0.5, bounds=(0.0, 3.0)), 2.0, 0.5, (0.0, 3.0)),
        (lp.LogNormal(2.0, 0.5), np.log(2.0), 0.25, (-np.inf, np.inf)),
        (lp.LogNormal(2.0, 0.5, bounds=(1.0, np.inf)), 0.0, 0.5, (-np.inf, np.inf)),
        (lp.LogitNormal(0.5, 0.1, bounds=(0.0, 1.0)), 0.0, 0.4, (-np.inf, np.inf)),
    ],
)
def test_priors_are_gaussian_in_their_latent_values(prior: Any, mean: Any, std: Any, bounds: Any):
    assert (prior.latent_mean, prior.latent_std) == pytest.approx((mean, std))
    assert prior.latent_bounds == bounds
    assert prior.transform.value(np.array(prior.latent_mean)) == pytest.approx(prior.centre)


@pytest.mark.slow
@pytest.mark.parametrize(
    "prior", [lp.Normal(0.5, 0.2), lp.LogNormal(0.5, 0.2), lp.LogitNormal(0.5, 0.2, (0.1, 0.9))]
)
def test_a_prior_alone_is_one_number(prior: Any):
    samples = data(lambda t: 0.3, np.linspace(0.0, 1.0, 11))
    both = [{"a": prior}, {"a": lp.Scalar(prior)}]
    alone, scalar = (estimates(rod(a), lp.SensitivityLaw(), samples)[-1] for a in both)
    np.testing.assert_array_equal(alone.q, scalar.q)
    np.testing.assert_array_equal(alone.q_std, scalar.q_std)
    assert alone["a"].interval() == scalar["a"].interval()
    assert FunctionSpace.of(prior, "q").prior == [0.5]


@pytest.mark.slow
def test_positive_unknowns_are_found_and_stay_positive():
    times = np.arange(0.0, 6.0, 0.05)
    samples = data(lambda t: 0.05, times)
    model = rod({"a": lp.LogNormal(1.0, 1.0)})
    found = estimates(model, lp.SensitivityLaw(), samples)
    values = [estimate.parameters["a"][0] for estimate in found]
    assert min(values) > 0.0
    value, std = found[-1].parameters["a"]
    assert abs(value - 0.05) < 4 * std < 0.01
    assert found[-1].q_std is not None


@pytest.mark.long
def test_the_gradient_law_learns_a_positive_field_and_a_nonlinear_unknown():
    model = rod({"a": UNKNOWNS["field"], "c": lp.Normal(2.0, 1.0)}, A=None)
    assert model.latent.dim == 22

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return (q.a + 0.1 * q.c**2) * lp.dot(lp.grad(u), lp.grad(v))

    model = rod({"a": UNKNOWNS["field"], "c": lp.Normal(1.0, 0.01)}, A)
    full = lp.Full()
    law = lp.GradientLaw(gain=100.0, damping=lp.laws.ResidualDamping(10.0))
    identifier = lp.Identifier(model, full, law)
    truth = model.initial_parameter({"a": lambda x: 0.5 + 0.2 * np.sin(3 * x[0]), "c": 1.0})
    forward, u = ForwardStage(model), model.initial(0.0)
    times = np.arange(0.0, 20.0, 0.05)
    identifier.step(0.0, identifier.observed.G @ u)
    for t0, t1 in itertools.pairwise(times):
        u = forward.solve(u, truth, t1 - t0, lp.fem.Moment(t1))
        estimate = identifier.step(t1, identifier.observed.G @ u)
        assert estimate.status.ok
    exact = model.latent.value(truth)
    inside = slice(4, 17)
    start = model.latent.value(model.initial_parameter())
    error, before = (np.abs(q - exact)[inside].max() for q in (estimate.q, start))
    assert error < 0.2 * before
    assert estimate.q[:21].min() > 0.0


def rms(found: list[lp.Estimate], a: Any, after: float) -> tuple[float, float]:
    """Return the error of the estimates, absolute and in deviations."""
    late = [estimate for estimate in found if estimate.t > after]
    values = np.array([estimate.parameters["a"] for estimate in late])
    errors = values[:, 0] - np.array([a(estimate.t) for estimate in late])
    return float(np.sqrt((errors**2).mean())), float(np.sqrt(((errors / values[:, 1]) ** 2).mean()))


# The data are those of the same scheme on the same mesh, and nobody asks for a verdict.
BARE = lp.SensitivityLaw(shadows=None, verdict=False)


@pytest.mark.long
def test_a_periodic_unknown_is_followed_without_delay():
    def a(t: float) -> float:
        return float(0.3 + 0.1 * np.cos(2 * np.pi * t / 10.0 + 0.4))

    samples = data(a, np.arange(0.0, 20.0, 0.05))
    periodic = rod({"a": lp.Scalar(lp.Normal(0.2, 0.2), evolution=lp.fem.Periodic(10.0))})
    walking = rod({"a": lp.Scalar(lp.Normal(0.2, 0.2), evolution=lp.RandomWalk(0.1))})
    error, deviations = rms(estimates(periodic, BARE, samples), a, 10.0)
    slower, _ = rms(estimates(walking, BARE, samples), a, 10.0)
    assert error < 0.004
    assert 0.3 < deviations < 2.0
    assert 3 * error < slower < 0.03


@pytest.mark.long
def test_the_gradient_law_rotates_a_periodic_unknown():
    def a(t: float) -> float:
        return float(0.3 + 0.1 * np.cos(2 * np.pi * t / 10.0 + 0.4))

    errors = {}
    for name, evolution in (("periodic", lp.fem.Periodic(10.0)), ("constant", CONSTANT)):
        model = rod({"a": lp.Scalar(lp.Normal(0.2, 0.2), evolution=evolution)})
        law = lp.GradientLaw(gain=10.0, damping=lp.laws.ResidualDamping(10.0))
        identifier = lp.Identifier(model, lp.Full(), law)
        forward, u = ForwardStage(rod({"a": lp.Normal(0.3)})), model.initial(0.0)
        times, found = np.arange(0.0, 30.0, 0.05), []
        for t0, t1 in itertools.pairwise(times):
            u = forward.solve(u, np.array([a(t1)]), t1 - t0, lp.fem.Moment(t1))
            found.append(identifier.step(t1, identifier.observed.G @ u))
        errors[name] = np.sqrt(np.mean([(e.parameters["a"][0] - a(e.t)) ** 2 for e in found[400:]]))
    assert 3 * errors["periodic"] < errors["constant"]


@pytest.mark.long
def test_an_unknown_initial_state_is_found_with_the_diffusivity():
    start = lp.Field(
        mesh,
        ElementLineP1(),
        inner=lambda u, v, x: 2.5 * u * v + 0.1 * lp.dot(lp.grad(u), lp.grad(v)),
        prior=lp.Normal(std=0.7),
    )
    model = rod({"a": lp.Normal(0.2, 0.1), "u0": start}, initial=lambda q, v, x: q.u0 * v)
    truth = model.initial_parameter({"a": 0.1, "u0": lambda x: np.sin(np.pi * x[0])})
    forward, rng = ForwardStage(model), np.random.default_rng(0)
    u = model.initial_state(truth)
    assert np.abs(u - np.sin(np.pi * mesh.p[0])).max() < 0.01
    law = lp.SensitivityLaw(modes=8, shadows=None)
    identifier = lp.Identifier(model, lp.Points(SENSORS, noise=NOISE), law)
    G, times = identifier.observed.G, np.arange(0.0, 4.0, 0.02)
    identifier.step(0.0, G @ u + NOISE * rng.standard_normal(3))
    for t0, t1 in itertools.pairwise(times):
        u = advanced(forward, u, truth, t0, t1)
        estimate = identifier.step(t1, G @ u + NOISE * rng.standard_normal(3))
    value, std = estimate.parameters["a"]
    assert abs(value - 0.1) < 4 * std < 0.01
    profile = estimate.q[model.parameter_space.part("u0")]
    assert np.abs(profile - np.sin(np.pi * mesh.p[0]))[2:-2].max() < 0.1


def test_an_initial_state_is_given_once():
    model = rod({"a": lp.Normal(0.2)}, initial=lambda q, v, x: q.a * v)
    with pytest.raises(ConfigurationError, match="leave out u0"):
        lp.Identifier(model, lp.Points(SENSORS, noise=1.0), lp.SensitivityLaw(), u0=1.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"gate": 0.0}, "gate must be positive"), ({"gate_patience": 0}, "gate_patience")],
)
def test_gates_that_cannot_be_meant_are_one_sentence(options: Any, words: str):
    with pytest.raises(LawError, match=words):
        lp.SensitivityLaw(**options)


def test_a_factor_too_narrow_for_its_unknowns_is_refused():
    model = rod({"a": lp.Normal(0.2), "b": lp.Normal(0.2)})
    with pytest.raises(LawError, match="rank must be at least the 2"):
        lp.Identifier(model, lp.Points(SENSORS, noise=1.0), lp.SensitivityLaw(rank=1))


def test_a_model_takes_more_unknowns_for_its_sensors():
    model = rod({"a": lp.Normal(0.2)}, inputs=["Q"], initial=lambda q, v, x: q.a * v)
    more = model.with_unknowns({"offset": lp.Scalars(("A", "B"), lp.Normal(0.0, 0.3))})
    assert list(more.parameter_space.labels) == ["a", "offset[A]", "offset[B]"]
    assert more.channels == ("Q",)
    np.testing.assert_array_equal(
        more.initial_state(more.initial_parameter()), model.initial_state(np.array([0.2]))
    )
    with pytest.raises(lp.errors.ModelError, match="'a' is taken"):
        model.with_unknowns({"a": lp.Normal()})
    with pytest.raises(lp.errors.ModelError, match="has no name"):
        rod(lp.Normal(), lambda q, u, v, x: q * u * v).with_unknowns({"b": lp.Normal()})


@pytest.mark.parametrize(
    "kink",
    [
        lambda u: lp.fem.absolute(u - 0.5),
        lambda u: lp.fem.maximum(u, 0.5 * u**2),
        lambda u: lp.fem.minimum(u, 0.3),
        lambda u: lp.fem.positive(u - 0.2) ** 2,
    ],
)
def test_functions_with_kinks_have_their_derivatives(kink: Any):
    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return (q.a**2 + lp.fem.absolute(q.a - 3.0)) * kink(u) * v

    check_model(rod({"a": lp.Normal(0.4, 0.1)}, A), u=0.1, spread=1e-3).raise_if_failed()


@pytest.mark.long
def test_priors_of_their_own_that_equal_the_common_one_change_nothing():
    common = {"prior": lp.LogNormal(0.5, 0.2), "evolution": lp.RandomWalk(0.01)}
    both = [lp.Piecewise(HALVES, **common, own=own) for own in ({}, {"r": lp.Scalar(**common)})]
    samples = data(lambda t: 0.3, np.linspace(0.0, 2.0, 21))
    plain, own = (estimates(rod({"a": a}), lp.SensitivityLaw(), samples)[-1] for a in both)
    assert list(own.parameters) == ["a[l]", "a[r]"]
    np.testing.assert_allclose(own.q, plain.q, rtol=1e-9)
    np.testing.assert_allclose(own.q_std, plain.q_std, rtol=1e-9)


@pytest.mark.long
def test_a_region_moves_and_another_does_not():
    walk = lp.Scalar(lp.Normal(0.5, 0.3), evolution=lp.RandomWalk(0.2))
    a = lp.Piecewise(HALVES, lp.Normal(0.4, 0.1), own={"r": walk})
    model = rod({"a": a})
    before = estimates(model, lp.SensitivityLaw(), data(lambda t: 0.3, np.linspace(0.0, 0.5, 6)))[0]
    assert before.q_std == pytest.approx([0.1, 0.3])
    identifier = lp.Identifier(model, lp.Points(SENSORS, noise=NOISE), lp.SensitivityLaw())
    samples = data(lambda t: 0.3, np.linspace(0.0, 2.0, 21))
    for t, z in samples:
        seen = identifier.step(t, z)
    later = identifier.step(12.0, [np.nan] * 3)
    assert later.q_std[0] == pytest.approx(seen.q_std[0], rel=1e-6)
    assert later.q_std[1] ** 2 == pytest.approx(seen.q_std[1] ** 2 + 0.2**2 * 10.0, rel=1e-6)


def test_jumps_of_a_region_or_of_all():
    a = lp.Piecewise(HALVES, lp.Normal(0.4, 0.1), own={"r": lp.Normal(0.5, 0.3)})
    identifier = lp.Identifier(rod({"a": a}), lp.Points(SENSORS), lp.SensitivityLaw(noise=NOISE))
    reduction = Reduction.of(identifier.problem, "auto")
    assert reduction.stay == [("a[l]", 0), ("a[r]", 1)]
    assert reduction.named(["a"], "Jumps").tolist() == [True, True]
    assert reduction.named(["a[r]"], "Jumps").tolist() == [False, True]
