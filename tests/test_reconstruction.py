"""G_alpha: its objective, the choice of alpha, and its use in the gradient law."""

import json

import numpy as np
import pytest
from factories import laplace, line, observe, reaction
from skfem import (
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementQuad2,
    ElementQuadBFS,
    ElementTriP2,
)

import livepde as lp
from experiments import seed_excited_noise as noisy
from livepde.errors import ObservationError
from livepde.observation import Apriori, Discrepancy, Pseudoinverse, Tikhonov

ELEMENTS = [ElementLineHermite, ElementLineP1, ElementLineP2]
MIDDLE = lambda x: (x[0] > 0.3) & (x[0] < 0.87)  # noqa: E731


def rod(element=ElementLineHermite, cells=20, dirichlet=None):
    return reaction(line(cells), element(), ElementLineP1(), dirichlet=dirichlet or {})


def kernel(cells=20, width=0.1):
    x = np.linspace(0, 1, cells + 1)
    return np.exp(-((x[:, None] - x[None, :]) ** 2) / (2 * width**2)) / cells


def sensors(noise=None, reconstruction=None):
    """One observation of each kind, for the rod with linear elements."""
    how = {"noise": noise, "reconstruction": reconstruction or Pseudoinverse()}
    return {
        "subdomain": lp.Subdomain(MIDDLE, **how),
        "points": lp.Points([0.11, 0.32, 0.5, 0.77, 0.9], **how),
        "averages": lp.Averages(
            {"a": lambda x: x[0] < 0.3, "b": lambda x: x[0] > 0.2, "c": lambda x: x[0] > 0.6}, **how
        ),
        "matrix": lp.observation.Matrix(kernel(), **how),
    }


KINDS = list(sensors())


def wavy(model):
    return model.state_space.interpolate(lambda x: np.sin(5 * x[0]) + x[0])


@pytest.mark.parametrize("kind", KINDS)
def test_the_default_is_the_pseudoinverse(kind):
    model = rod(ElementLineP1)
    observed = observe(model, sensors()[kind])
    z = observed.G @ wavy(model)
    found = observed.reconstruct(z)
    zero = np.zeros(model.X.dim)
    np.testing.assert_array_equal(found.u, observed.split().reconstruct(z, zero))
    assert found.alpha == 0.0
    assert found.misfit == pytest.approx(0.0, abs=1e-6)


def test_the_norm_of_X_gives_the_papers_formula():
    model, alpha = rod(), 0.03
    observed = observe(model, lp.Points([0.1, 0.3, 0.8], reconstruction=Tikhonov("X", alpha)))
    z, G = np.array([1.0, -2.0, 0.5]), observed.G.toarray()
    mass = model.mass.toarray()
    adjoint = np.linalg.solve(mass, G.T)  # G*: Z -> X
    expected = np.linalg.solve(adjoint @ G + alpha * np.eye(model.X.dim), adjoint @ z)
    np.testing.assert_allclose(observed.reconstruct(z).u, expected, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm", ["X", "V", laplace])
def test_it_lies_in_the_complement_of_the_null_space(kind, norm):
    model, rng = rod(ElementLineP1), np.random.default_rng(0)
    observed = observe(model, sensors(reconstruction=Tikhonov(norm, 1e-3))[kind])
    z = observed.G @ wavy(model) + 0.1 * rng.standard_normal(observed.size)
    u = observed.reconstruct(z).u
    np.testing.assert_allclose(observed.split().P @ u, 0.0, atol=1e-9 * np.abs(u).max())


@pytest.mark.parametrize(
    ("kind", "norm"), [(kind, "X") for kind in KINDS] + [(kind, laplace) for kind in KINDS[1:]]
)
def test_it_minimises(kind, norm):
    model, rng = rod(ElementLineP1), np.random.default_rng(0)
    observed = observe(model, sensors(reconstruction=Tikhonov(norm, 1e-3))[kind])
    split = observed.split()
    z = observed.G @ wavy(model) + 0.1 * rng.standard_normal(observed.size)
    gram = model.mass if norm == "X" else model.bilinear(norm)
    inverse = split.inverse.toarray()
    weights = inverse.T @ model.mass @ inverse if kind == "subdomain" else np.eye(observed.size)

    def cost(u):
        rest = observed.G @ u - z
        return rest @ weights @ rest + 1e-3 * u @ (gram @ u)

    found = observed.reconstruct(z)
    rest = observed.G @ found.u - z
    assert found.misfit == pytest.approx(np.sqrt(rest @ weights @ rest))
    for _ in range(10):
        other = found.u + 1e-3 * (split.R @ rng.standard_normal(model.X.dim))
        assert cost(other) > cost(found.u)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("alpha", [1e-4, 1.0, 1e4])
def test_nothing_pulls_to_zero_at_the_border_of_omega(element, alpha):
    model = rod(element)
    observed = observe(model, lp.Subdomain(MIDDLE, reconstruction=Tikhonov("V", alpha)))
    z = observed.G @ model.state_space.interpolate(lambda x: 2.0 - 3.0 * x[0])
    np.testing.assert_allclose(observed.G @ observed.reconstruct(z).u, z, atol=1e-7)


@pytest.mark.parametrize("element", ELEMENTS)
def test_known_boundary_values_count(element):
    model = rod(element, dirichlet={"left": 1.0, "right": 3.0})
    observed = observe(model, lp.Full(reconstruction=Tikhonov("V", 10.0)))
    boundary = model.impose(np.zeros(model.X.dim), lp.fem.Moment())
    u = model.initial(lambda x: 1.0 + 2.0 * x[0])
    found = observed.reconstruct(observed.G @ u, boundary=boundary)
    np.testing.assert_allclose(found.u + boundary, u, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("element", [ElementTriP2, ElementQuad2, ElementQuadBFS])
def test_in_the_plane_linear_states_pass_and_noise_does_not(element):
    mesh = lp.rectangle((0, 1), (0, 1), (6, 6))
    if element is ElementTriP2:
        mesh = mesh.to_meshtri()
    field = lp.Field(mesh, element())
    model = lp.Model(field, lp.Normal(1.0), lambda q, u, v, x: q * u * v)
    observed = observe(model, lp.Full(reconstruction=Tikhonov("V", 1e-3)))
    z = observed.G @ model.state_space.interpolate(lambda x: 1 + x[0] - 2 * x[1])
    assert model.X.norm(observed.reconstruct(z).u - z) < 1e-9
    rough = z + 0.1 * np.random.default_rng(0).standard_normal(len(z))
    error = model.X.norm(observed.reconstruct(rough).u - z)
    assert error < 0.8 * model.X.norm(rough - z)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm", ["X", "V"])
def test_the_discrepancy_principle_is_met(kind, norm):
    model, rng = rod(ElementLineP1), np.random.default_rng(1)
    rule = Discrepancy(tau=1.1)
    observed = observe(model, sensors(0.01, Tikhonov(norm, rule))[kind])
    z = observed.G @ wavy(model) + 0.01 * rng.standard_normal(observed.size)
    found = observed.reconstruct(z)
    assert found.alpha > 0
    if norm == "X" or kind in ("subdomain", "matrix"):
        assert found.misfit == pytest.approx(1.1 * found.delta, rel=1e-6)
    twice = observed.reconstruct(z, 2 * found.delta)
    assert twice.alpha >= found.alpha
    assert twice.delta == 2 * found.delta


def test_noise_levels():
    model = rod()
    points = observe(
        model, lp.Points([0.2, 0.6, 0.7], noise=[0.1, 0.2, 0.4], reconstruction=Tikhonov())
    )
    z = np.array([1.0, 2.0, np.nan])
    assert points.reconstruct(z).delta == pytest.approx(np.sqrt(2))
    part = observe(model, lp.Subdomain(MIDDLE, noise=0.1, reconstruction=Tikhonov()))
    rng = np.random.default_rng(0)
    draws = part.split().inverse @ (0.1 * rng.standard_normal((part.size, 4000)))
    size = np.sqrt(np.mean([model.X.norm(n) ** 2 for n in draws.T]))
    z = part.G @ wavy(model)
    assert part.reconstruct(z).delta == pytest.approx(size, rel=0.03)
    for rule in (Discrepancy(level=0.02), Apriori(level=0.02)):
        part = observe(model, lp.Subdomain(MIDDLE, reconstruction=Tikhonov("V", rule)))
        norm = model.X.norm(part.split().inverse @ z)
        assert part.reconstruct(z).delta == pytest.approx(0.02 * norm)
    for rule in (Discrepancy(delta=0.3), Apriori(delta=0.3)):
        part = observe(model, lp.Subdomain(MIDDLE, reconstruction=Tikhonov("V", rule)))
        assert part.reconstruct(z).delta == 0.3


def test_the_a_priori_choice():
    rule = Apriori(power=1.5, factor=4.0, delta=0.01)
    observed = observe(rod(), lp.Full(reconstruction=Tikhonov("V", rule)))
    z = observed.G @ wavy(rod())
    assert observed.reconstruct(z).alpha == pytest.approx(4e-3)
    assert observed.reconstruct(z, 0.04).alpha == pytest.approx(32e-3)


@pytest.mark.parametrize("norm", ["X", "V"])
def test_missing_samples_shrink_it(norm):
    model, how = rod(), Tikhonov(norm, 0.01)
    z = np.array([1.0, np.nan, 2.0, 0.0])
    all_four = observe(model, lp.Points([0.1, 0.2, 0.5, 0.8], noise=0.1, reconstruction=how))
    three = observe(model, lp.Points([0.1, 0.5, 0.8], noise=0.1, reconstruction=how))
    found = all_four.reconstruct(z)
    np.testing.assert_allclose(found.u, three.reconstruct(z[[0, 2, 3]]).u, atol=1e-12)
    nothing = all_four.reconstruct(np.full(4, np.nan))
    np.testing.assert_array_equal(nothing.u, 0.0)
    part = observe(model, lp.Subdomain(MIDDLE, reconstruction=how))
    z = part.G @ wavy(model)
    z[5:9] = np.nan
    u = part.reconstruct(z).u
    assert np.isfinite(u).all()
    np.testing.assert_array_equal((part.G @ u)[5:9], 0.0)


@pytest.mark.slow
def test_many_patterns_of_missing_samples_are_forgotten_again():
    observed = observe(
        rod(ElementLineP1), lp.Points(np.linspace(0, 1, 8), reconstruction=Tikhonov("X", 0.1))
    )
    for k in range(1, 100):
        z = np.where([(k >> bit) & 1 for bit in range(8)], 1.0, np.nan)
        assert np.isfinite(observed.reconstruct(z).u).all()
    assert len(observed._reconstructors) <= 64


def test_the_ends_of_the_discrepancy_principle():
    model = rod()
    repeated = observe(model, lp.Points([0.5, 0.5], noise=0.1, reconstruction=Tikhonov("X")))
    z = np.array([1.0, 3.0])  # no state comes nearer than the mean
    found = repeated.reconstruct(z)
    zero = np.zeros(model.X.dim)
    np.testing.assert_allclose(found.u, repeated.split().reconstruct(z, zero), rtol=1e-6)
    weak = repeated.reconstruct(z, 1e3)  # everything is noise
    assert np.abs(weak.u).max() < 1e-6


def test_a_range_that_is_not_closed():
    """G^+ amplifies any noise; the error of G_alpha falls with the noise."""
    model, rng = rod(ElementLineP1), np.random.default_rng(2)
    u, errors = wavy(model), []
    for noise in (1e-2, 1e-4):
        n = noise * rng.standard_normal(21)
        for how in (Pseudoinverse(), Tikhonov("X"), Tikhonov("V")):
            observed = observe(
                model, lp.observation.Matrix(kernel(), noise=noise, reconstruction=how)
            )
            z = observed.G @ u + n
            errors.append(model.X.norm(observed.reconstruct(z).u - u) / model.X.norm(u))
    assert errors[0] > 10
    assert errors[3] > 0.5
    assert max(errors[1], errors[2]) < 0.5
    assert errors[4] < 0.7 * errors[1]
    assert errors[5] < 0.5 * errors[2]


def once(z, how, delta=None):
    """Reconstruct the reading of one point."""
    return observe(rod(), lp.Points([0.5], reconstruction=how)).reconstruct(z, delta)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: once([1.0], Tikhonov()), "Discrepancy needs the noise level"),
        (lambda: once([1.0, 2.0], Tikhonov()), "shape"),
        (lambda: once([1.0], Tikhonov(), -1.0), "delta must be a positive"),
        (lambda: once([1.0], Tikhonov(lambda u, v, x: u * lp.grad(v)[0], 1.0)), "not symmetric"),
        (lambda: once([1.0], Tikhonov(lambda u, v, x: x.t * u * v, 1.0)), "may not depend on time"),
        (lambda: Tikhonov("H7"), "expected 'X', 'V'"),
        (lambda: Tikhonov("V", -1.0), "alpha must be a number >= 0"),
        (lambda: Discrepancy(tau=0.0), "tau must be a positive"),
        (lambda: Discrepancy(level=-0.1), "level must be a positive"),
        (lambda: Apriori(power=2.0), "power must lie between 0 and 2"),
        (lambda: Apriori(factor=np.nan), "factor must be a positive"),
    ],
)
def test_wrong_settings_and_wrong_use(make, words):
    with pytest.raises(ObservationError, match=words):
        make()


def identifier(reconstruction, **options):
    model = rod(ElementLineP1, dirichlet={"left": 1.0})
    full = lp.Subdomain(MIDDLE, noise=0.01, reconstruction=reconstruction)
    return lp.Identifier(model, full, lp.GradientLaw(gain=100.0), u0=1.0, **options)


def samples(count=8):
    rng = np.random.default_rng(5)
    size = identifier(Pseudoinverse()).observed.size
    return [(0.1 * k, 1 + 0.01 * rng.standard_normal(size)) for k in range(1, count)]


@pytest.mark.slow
def test_the_gradient_law_uses_and_reports_it():
    found = [identifier(how).run(samples()) for how in (Pseudoinverse(), Tikhonov("V", 0.0))]
    np.testing.assert_allclose(found[0].last.q, found[1].last.q, rtol=1e-6)
    assert np.isnan(found[0].last.diagnostics.alpha)
    result = identifier(Tikhonov("V")).run(samples())
    assert result.last.diagnostics.alpha > 0
    assert result.last.diagnostics.misfit > 0
    assert set(result.to_xarray()) >= {"alpha", "misfit", "residual"}


@pytest.mark.slow
def test_checked_contract_of_the_law():
    lp.diagnostics.check_law(
        lp.GradientLaw(gain=100.0), lambda law: identifier(Tikhonov("V"), dt_max=0.04), samples()
    ).raise_if_failed()


@pytest.mark.slow
def test_white_noise_has_its_level_in_L2():
    twin = noisy._twin()
    gram, ratio = twin.weights, []
    for sample, z in zip(noisy.WhiteNoise(twin, 0.05, 0), twin.exact_data, strict=True):
        n = sample.z - z
        ratio.append((n @ gram @ n) / (z @ gram @ z))
    assert np.sqrt(np.mean(ratio)) == pytest.approx(0.05, rel=0.01)
    assert len(noisy.WhiteNoise(twin, 0.05, 0)) == len(ratio)


@pytest.mark.study
def test_the_noisy_excited_twin_shows_what_smoothing_is_good_for(monkeypatch):
    monkeypatch.setattr(noisy, "SEEDS", (100, 101))
    monkeypatch.setattr(noisy, "GRID", (100.0,))
    levels = ((0.01, "white"), (0.10, "white"))
    monkeypatch.setattr(noisy, "WHITE", levels)
    monkeypatch.setattr(noisy, "CASES", levels)
    whole, found = noisy.noisy_run, {}

    def once(level, seed, smoothing, *, c1=noisy.C1, kind, progress):
        """Run what both tables show one time."""
        key = (level, seed, smoothing, c1, kind)
        if key not in found:
            found[key] = whole(level, seed, smoothing, c1=c1, kind=kind, progress=progress)
        return found[key]

    monkeypatch.setattr(noisy, "noisy_run", once)
    outcome = noisy.seed_excited_noise()
    assert len(found) == 8
    assert outcome.ok, [check for check in outcome.checks if not check.ok]
    assert whole(0.01, 100, smoothing=True).error == outcome.tables[1].rows[0][2] <= 0.10
    json.dumps(outcome.to_dict(), allow_nan=False)
    outcome.figures["error"]()
