"""The self-tuning law, `GradientLaw(gain="auto")`."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from factories import few, observe
from skfem import ElementLineP1, ElementLineP2

import livepde as lp
from benchmarks import scale
from livepde.errors import LawError
from livepde.laws.coupled.equation import StageForms
from livepde.laws.information import InformationMetric, diagonal_bound, trace_probes
from livepde.laws.observed_part import Balance, NoiseDetector
from livepde.reproduce import seed
from livepde.streams import Twin

AUTO = lp.GradientLaw(gain="auto")


def rod(
    q: float = 1.0,
    u: float = 1.0,
    x: float = 1.0,
    t: float = 1.0,
    cells: int = 20,
    element=ElementLineP1,
    **options,
) -> tuple[lp.Model, Twin]:
    """u_t - D u_xx + q u = f in units given by their sizes, two modes, P1."""
    D = x**2 / t
    mesh = lp.interval(0, x, cells)
    model = lp.Model(
        lp.Field(mesh, element(), dirichlet={"boundary": 0.0}),
        lp.Field(
            mesh,
            element(),
            inner=lambda p, v, at: (p * v + 0.1 * x**2 * lp.dot(lp.grad(p), lp.grad(v))) / x,
            prior=lp.Normal(std=q),
        ),
        lambda p, w, v, at: p / (q * t) * w * v,
        lambda w, v, at: D * lp.dot(lp.grad(w), lp.grad(v)),
        f=lambda at, s: (
            u / t * (10 + 5 * np.sin(s / t)) * np.sin(np.pi * at[0] / x)
            + u / t * 30 * np.cos(0.7 * s / t) * np.sin(2 * np.pi * at[0] / x)
        ),
    )
    dt = options.pop("dt", 0.1)
    times = t * dt * np.arange(round(10 / dt) + 1)
    return model, Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=options.pop("observation", lp.Full()),
        q_true=lambda at: q * (1 + np.sin(np.pi * at[0] / x) ** 2),
        u0=0.0,
        times=times,
        **options,
    )


def run(
    model: lp.Model, twin: Twin, noise: float = 0.0, own: bool = True, told: float = 0.0
) -> tuple[float, np.ndarray, dict]:
    """Return the error at the end, the estimate, and the last diagnostics.

    Noise is smoothed by the law's own choice, `told` times the noise level if that is not zero, or
    by the discrepancy principle.
    """
    rng = np.random.default_rng(3)
    smooth = lp.Full(
        reconstruction=lp.observation.Tikhonov("V", lp.observation.Discrepancy(level=noise or 1.0))
    )
    observation = smooth if noise and not own else twin.observation
    if told:
        size = np.sqrt(np.mean([(z**2).mean() for z in twin.exact_data]))
        observation = lp.Full(noise=told * noise * size)
    identifier = lp.Identifier(model, observation, AUTO, q0=0.0, u0=0.0)
    for sample in twin:
        size = noise * np.sqrt((sample.z**2).mean())
        z = sample.z + size * rng.standard_normal(len(sample.z))
        estimate = identifier.step(sample.t, z)
        assert estimate.status.ok
    return twin.error(estimate.q), np.asarray(estimate.q), estimate.diagnostics


@pytest.mark.slow
def test_seed_reaches_its_floor_without_a_gain() -> None:
    model, omega = seed.build()
    twin = Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=omega,
        times=seed.TIMES,
        q_true=seed.q_true,
        u_true=seed.u_true,
    )
    identifier = lp.Identifier(model, omega, AUTO, q0=0.0, u0=lambda x: seed.u_true(x, 0.0))
    estimates = [identifier.step(s.t, s.z) for s in twin]
    errors = [twin.error(estimate.q) for estimate in estimates]
    assert errors[-1] <= 0.06  # what is left lies outside of omega
    assert estimates[-1].diagnostics.departure < 0.1
    assert errors[20] <= 0.06  # and it was there at t = 12: kept while the excitation dies


@cache
def unscaled(options: tuple[tuple[str, float], ...]) -> tuple[np.ndarray, dict[str, float]]:
    return run(*rod(), **dict(options))[1:]


OPTIONS = [{}, {"noise": 0.02}, {"noise": 0.02, "told": 1.0}, {"noise": 0.02, "own": False}]
UNITS = [{"q": 1e3}, {"u": 1e-4}, {"x": 50.0}, {"t": 3600.0}, dict(q=7, u=20, x=0.1, t=1e-3)]


@pytest.mark.slow
@pytest.mark.parametrize(("options", "units"), few(5, OPTIONS, UNITS))
def test_units_scale_out(units: dict[str, float], options: dict[str, float]) -> None:
    plain, before = unscaled(tuple(options.items()))
    _, scaled, found = run(*rod(**units), **options)
    size = units.get("q", 1.0)
    assert np.abs(scaled / size - plain).max() <= 1e-6 * np.abs(plain).max()
    assert found.information > 1.0
    assert 0.0 < found.departure < 0.2
    assert found.departure == pytest.approx(before.departure, rel=1e-5)


@pytest.mark.long
def test_sampling_rate_and_mesh_do_not_matter_without_noise() -> None:
    errors = [run(*rod(**case))[0] for case in ({}, {"dt": 0.05}, {"dt": 0.025}, {"cells": 40})]
    assert max(errors) <= 0.01


def test_what_a_right_model_may_do_is_no_departure() -> None:
    model, _ = rod(cells=40)
    learning = InformationMetric(model, True)
    q0 = np.full(model.Q.dim, 2.0)
    root = np.linalg.inv(np.linalg.cholesky(model.Q.gram.toarray())).T
    shares = np.linspace(0.0, 1.0, model.Q.dim)  # of the prior variance that the data have taken
    known = {
        1.0: replace(learning.init(q0), spread=1.0, given=1e9),
        0.0: replace(learning.init(q0), spread=1.0, given=0.0),
        0.5: replace(
            learning.init(q0), spread=1.0, given=float((shares[:-1] / (1 - shares[:-1])).sum())
        ),
    }
    rng = np.random.default_rng(0)
    for told, learned in known.items():
        weights = np.sqrt(shares) if told == 0.5 else np.full(model.Q.dim, np.sqrt(told))
        moved = (root @ (weights[:, None] * rng.standard_normal((model.Q.dim, 2000)))).T
        found = [learning.departure(learned, q0 + one) for one in moved]
        assert max(found) < 1.0
        once = root @ np.eye(model.Q.dim)[0]  # one deviation in one direction
        far = learning.departure(learned, q0 + 20.0 * once)
        assert far > 1.0
        # Twice the information and the noise are the same knowledge.
        twice = replace(learned, spread=2.0, given=2.0 * learned.given)
        assert learning.departure(twice, q0 + 20.0 * once) == pytest.approx(far)


@pytest.mark.long
def test_the_weight_of_noisy_data_does_not_depend_on_the_sampling_rate() -> None:
    # Noise of one spectral density: a deviation that grows with the root of the rate.
    found = [
        run(*rod(dt=dt), noise=0.02 * np.sqrt(0.1 / dt), own=False)[2] for dt in (0.1, 0.05, 0.025)
    ]
    information = [one.information for one in found]
    assert max(information) <= 2 * min(information)


@pytest.mark.slow
def test_the_weight_of_noisy_data_does_not_depend_on_the_mesh() -> None:
    # Noise of each node by itself: twice the nodes are twice the data.
    information = [
        run(*rod(cells=n), noise=0.02, own=False)[2].information / n for n in (20, 40, 80)
    ]
    assert max(information) <= 1.5 * min(information)


@pytest.mark.slow
def test_exact_data_are_not_smoothed() -> None:
    for told in (0.0, 1e-3):
        model, twin = rod()
        sensors = lp.Full(noise=told) if told else lp.Full()
        identifier = lp.Identifier(model, sensors, AUTO, q0=0.0, u0=0.0)
        alphas = [np.nan_to_num(identifier.step(s.t, s.z).diagnostics.alpha) for s in twin]
        assert max(alphas) == 0.0


@pytest.mark.slow
def test_what_was_learned_stays_without_excitation() -> None:
    mesh = lp.interval(0, 1, 20)
    rest = {"boundary": 0.0}
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet=rest),
        lp.Field(mesh, ElementLineP1(), inner="H1"),
        lambda q, u, v, x: q * u * v,
        lambda u, v, x: 0.1 * lp.dot(lp.grad(u), lp.grad(v)),
    )
    twin = Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=lp.Full(),
        q_true=lambda x: 1 + x[0],
        u_true=None,
        u0=lambda x: np.sin(np.pi * x[0]) + 0.5 * np.sin(2 * np.pi * x[0]),
        times=0.05 * np.arange(401),
    )
    identifier = lp.Identifier(model, lp.Full(), AUTO, q0=0.0, u0=twin.u0)
    rng = np.random.default_rng(0)
    errors = []
    for s in twin:
        z = s.z + 1e-6 * rng.standard_normal(len(s.z))
        errors.append(twin.error(identifier.step(s.t, z).q))
    assert errors[40] <= 0.2  # at t = 2; u falls by e every 0.4
    assert errors[-1] <= 1.5 * errors[40]  # at t = 20 there is nothing but noise


def test_averages_of_a_diffusivity_are_refused() -> None:
    mesh = lp.interval(0, 1, 20)
    model = lp.Model(
        lp.Field(mesh, ElementLineP2(), dirichlet={"left": 0.0}),
        lp.Normal(1.0, std=1.0),
        lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: np.sin(t) + 0 * x[0],
    )
    sensors = lp.Averages({"a": lambda x: x[0] < 0.5, "b": lambda x: x[0] > 0.5})
    with pytest.raises(LawError, match="use SensitivityLaw"):
        lp.Identifier(model, sensors, AUTO, u0=0.0)


def test_what_cannot_be_is_one_sentence() -> None:
    with pytest.raises(LawError, match="leave them out"):
        lp.GradientLaw(gain="auto", damping=lp.laws.ResidualDamping(2.0))
    with pytest.raises(LawError, match="'auto'"):
        lp.GradientLaw(gain="best")  # type: ignore[arg-type]
    mesh = lp.interval(0, 1, 4)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        lp.Scalar(lp.Normal(1.0), evolution=lp.RandomWalk(0.1)),
        lambda q, u, v, x: q * u * v,
    )
    both = lp.Model(
        {"a": lp.Field(mesh, ElementLineP1()), "b": lp.Field(mesh, ElementLineP1())},
        lp.Normal(1.0),
        lambda q, u, v, x: q * (u.a * v.a + u.b * v.b),
    )
    # One of two components is partial data, which are not smoothed.
    lp.Identifier(both, lp.Full(of="a"), AUTO, u0=0.0)
    lp.Identifier(both, lp.Full(of="a", noise=0.1), AUTO, u0=0.0)
    with pytest.raises(LawError, match="moves"):
        lp.Identifier(model, lp.Full(), AUTO, u0=0.0)


@pytest.mark.long
def test_missing_sensors_are_no_noise_that_turns_back():
    """What a change of the sensors leaves in r made the noise level negative, and the gain huge."""
    points, rng = np.linspace(0.1, 0.9, 9), np.random.default_rng(1)
    mesh = lp.interval(0.0, 1.0, 30)
    ends = {"left": lambda x, t: np.sin(t) + 0.0 * x[0], "right": 0.0}
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet=ends),
        lp.Field(mesh, ElementLineP1(), inner="H1", prior=lp.Normal(1.0, std=1.0)),
        lambda q, u, v, x: q * u * v,
        lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)) - 5.0 * v,
    )
    twin = Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=lp.Points(points),
        q_true=lambda x: 1.0 + np.sin(3.0 * x[0]),
        u0=0.0,
        times=0.1 * np.arange(61),
    )
    identifier = lp.Identifier(model, twin.observation, AUTO, q0=0.5, u0=0.0)
    for sample in twin:
        z = sample.z + 0.01 * rng.standard_normal(len(points))
        z[rng.random(len(points)) < 0.2] = np.nan
        estimate = identifier.step(sample.t, z)
        assert estimate.status.ok
        assert np.isnan(estimate.diagnostics.held)
        assert np.abs(estimate.q).max() < 5.0


def square(size: int) -> tuple[lp.Model, list[tuple[float, np.ndarray]], Callable]:
    """Return the problem of `benchmarks.scale`, exact samples, and the error of an estimate."""
    model = scale.problem(size)
    samples = list(scale.readings(model, 80))
    truth, mass = model.initial_parameter(scale.q_true), model.parameter_mass

    def error(q: np.ndarray) -> float:
        miss = q - truth
        return float(np.sqrt(miss @ (mass @ miss) / (truth @ (mass @ truth))))

    return model, samples, error


@pytest.mark.slow
@pytest.mark.parametrize(("size", "best"), [(64, 0.098), (256, 0.105)])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
def test_a_square_seen_in_a_part(size: int, best: float, noise: float) -> None:
    """`best` is the error of the best constant gain in hindsight; that of q = 0 is 1."""
    model, samples, error = square(size)
    identifier = lp.Identifier(model, scale.OMEGA, AUTO, q0=0.0, u0=2.0)
    rng, errors, departures = np.random.default_rng(0), [], []
    for t, z in samples:
        z = z + noise * np.sqrt((z**2).mean()) * rng.standard_normal(len(z))
        estimate = identifier.step(t, z)
        assert estimate.status.ok
        errors.append(error(estimate.q))
        departures.append(np.nan_to_num(estimate.diagnostics.departure))
    assert max(errors) <= 1.05
    assert max(departures) <= 0.5
    assert errors[-1] <= (1.3 * best if noise < 0.01 else 0.3)


@pytest.mark.slow
def test_an_unknown_far_from_its_prior_is_a_failed_step() -> None:
    model, twin = rod()
    twin = replace(twin, q_true=lambda x: 60.0 + 40.0 * x[0])
    identifier = lp.Identifier(model, twin.observation, AUTO, q0=0.0, u0=0.0)
    found = [identifier.step(s.t, s.z) for s in twin]
    failed = [estimate for estimate in found if not estimate.status.ok]
    assert failed
    assert {estimate.status.code for estimate in failed} == {"departed"}
    assert "increase the standard deviations of the priors" in str(failed[0].status)
    good = [estimate for estimate in found if estimate.status.ok]
    assert max(np.nan_to_num(estimate.diagnostics.departure) for estimate in good) <= 1.0
    # A failed step leaves the unknowns where they were, and takes the sample.
    first = found.index(failed[0])
    np.testing.assert_allclose(found[first].q, found[first - 1].q, rtol=1e-4)
    assert not np.array_equal(found[first].u, found[first - 1].u)


@pytest.mark.parametrize("sees", ["part", "averages"])
def test_normal_equations_are_those_of_dense_matrices(sees: str) -> None:
    model, _ = rod(cells=12)
    cells = {"a": lambda x: x[0] < 0.3, "b": lambda x: (x[0] > 0.3) & (x[0] < 0.8)}
    part = lp.Subdomain(lambda x: x[0] > 0.4) if sees == "part" else lp.Averages(cells)
    split = observe(model, part).split()
    metric = InformationMetric(model, selects=sees == "part")
    forms = StageForms(model, split, None, None, 0.0)
    rng = np.random.default_rng(0)
    w, q, error = (rng.standard_normal(n) for n in (model.X.dim, model.Q.dim, model.X.dim))
    A = forms.A_in.matrix("v", "q", u=w, q=q)
    gain = metric.normal(forms).gain(A.data, q, error, metric.probes)
    seen = model.X.free * (A.toarray() * model.Q.free).T
    if sees == "part":
        D = diagonal_bound(forms.mass)
        weights = np.diag(np.divide(model.X.free, D, out=np.zeros_like(D), where=D > 0.0))
    else:
        V = model.X.free[:, None] * split.basis
        weights = V @ np.linalg.solve(V.T @ forms.mass @ V, V.T)
    whole = seen @ weights @ seen.T
    pattern = metric.pattern
    np.testing.assert_allclose(pattern.matrix(gain.matrix.sum(axis=0)).toarray(), whole, atol=1e-12)
    np.testing.assert_allclose(gain.force, seen @ weights @ error, atol=1e-12)
    y = seen.T @ q - error
    np.testing.assert_allclose(gain.right.sum(axis=0), seen @ weights @ y, atol=1e-11)
    trace = np.trace(np.linalg.solve(model.Q.gram.toarray(), whole))
    assert gain.trace.sum() == pytest.approx(trace, rel=0.1)
    assert metric.normal(forms).trace(A.data, metric.probes) == pytest.approx(gain.trace)
    # Within omega all but the node at its end see nothing but the data.
    own = np.linalg.matrix_rank(pattern.matrix(gain.matrix[1]).toarray())
    assert own == (1 if sees == "part" else 2)


@pytest.mark.parametrize("size", [3, 8, 30, 400])
def test_probes_give_traces(size: int) -> None:
    mesh = lp.interval(0, 1, size - 1)
    space = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        lp.Field(mesh, ElementLineP1(), inner="H1"),
        lambda q, u, v, x: q * u * v,
    ).Q
    V, gram = trace_probes(space), space.gram.toarray()
    rng = np.random.default_rng(1)
    for J in (np.eye(size), np.diag(rng.random(size)), gram):
        exact = np.trace(np.linalg.solve(gram, J))
        rel = 0.1 if J is not gram else 0.7  # which sees rough functions as well as smooth ones
        assert np.trace(V.T @ J @ V) == pytest.approx(exact, rel=rel)


@pytest.mark.slow
def test_what_the_data_taught_does_not_depend_on_how_well_a_stage_is_solved() -> None:
    model, twin = rod(observation=lp.Subdomain(lambda x: x[0] > 0.4))
    found = []
    for newton in (
        lp.stepping.Newton(share=0.0, tolerance=1e-10),
        lp.stepping.Newton(share=0.3, ceiling=1e-2),
    ):
        law = lp.GradientLaw(gain="auto", newton=newton)
        identifier = lp.Identifier(model, twin.observation, law, q0=0.0, u0=0.0)
        for s in twin:
            estimate = identifier.step(s.t, s.z)
        found.append(np.asarray(estimate.q))
    assert np.abs(found[1] - found[0]).max() <= 0.02 * np.abs(found[0]).max()


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-1])
def test_noise_is_detected(noise: float) -> None:
    model, twin = rod(cells=40)
    detector = NoiseDetector(
        observe(model, twin.observation), observe(model, twin.observation).split()
    )
    balance = Balance.none(39, model.X.dim)
    rng, told = np.random.default_rng(0), []
    for s in twin:
        z = s.z + noise * rng.standard_normal(len(s.z))
        balance, noisy = detector.add(balance, z, np.zeros(model.X.dim))
        balance = balance.followed(z, np.zeros(model.X.dim))
        told.append(noisy)
    assert told[-1] == (noise > 0.0)
    assert all(told[5:]) == (noise > 0.0)
