"""Numerical evaluation of the paper's theory: constants, bounds, T*, excitation, links."""

import importlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from factories import excited, excited_q, excited_u, line, observe, product
from skfem import ElementLineHermite, ElementLineP1, ElementLineP2
from typer.testing import CliRunner

import livepde as lp
from livepde import diagnostics as dg
from livepde.errors import ConfigurationError
from livepde.laws.coupled.equation import StageForms
from livepde.laws.damping import (
    Constants,
    ExactBound,
    Norms,
    SmoothedBound,
    diffusion_operator,
    unobserved_damping,
)
from livepde.observation import Tikhonov
from livepde.reproduce import seed, seed_excited
from livepde.streams import RelativeNoise

# Functions of equal names hide these modules in their package.
constants_module = importlib.import_module("livepde.diagnostics.theory.constants")
parts_module = importlib.import_module("livepde.diagnostics.theory.state_parts")
excitation_module = importlib.import_module("livepde.diagnostics.theory.excitation")

ROOT = Path(__file__).parents[1]
ZERO = {"boundary": 0.0}
PI2 = np.pi**2


def experiment(name):
    return importlib.import_module(f"experiments.{name}")


def rod(parameter=None, dirichlet=ZERO, element=None, cells=24, **options):
    mesh = line(cells)
    return lp.Model(
        lp.Field(mesh, element or ElementLineP2(), dirichlet=dirichlet),
        lp.Field(mesh, ElementLineP1(), inner="H1")
        if parameter == "field"
        else parameter or lp.Normal(),
        product,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        **options,
    )


# --- constants ------------------------------------------------------------------------------------


def test_embeddings_of_the_whole_interval():
    model = rod()
    part = dg.Spaces(model, observe(model, lp.Full())).observed_part
    assert part.embedding_VX_X() == pytest.approx(1 / np.sqrt(1 + PI2), rel=1e-5)
    assert part.embedding_V_VX() == pytest.approx(1 / np.sqrt(1 + PI2), rel=1e-5)


@pytest.mark.parametrize("q", [1.0, 6.0, 20.0])
def test_lipschitz_constant_of_reaction_and_diffusion(q):
    """For -u'' + q u and u - u'', the quotient (l + q)/(l + 1) is largest for l = pi^2."""
    model = rod()
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    c = dg.constants(spaces, np.array([q]), [np.zeros(model.X.dim)])
    assert pytest.approx((PI2 + q) / (PI2 + 1), rel=1e-5) == c.L_C
    assert (c.c_M, c.C_M) == pytest.approx((1.0, 1.0))


def test_norm_of_A_for_a_number():
    """For A(u) q = q u and std s of q, ||A(u)|| = s ||u||, scaled by the root of the gain."""
    model = rod(lp.Normal(std=2.0), dirichlet={})
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    u = np.full(model.X.dim, 3.0)
    c = dg.constants(spaces, np.zeros(1), [u], gain=4.0)
    assert pytest.approx(2.0 * 2.0 * 3.0) == c.C_A
    assert c.sampled == ()


def test_norm_of_A_for_a_field_is_the_embedding_into_bounded_functions():
    """||q||_inf <= sqrt(coth 1) ||q||_H1 on (0, 1), attained at the ends."""
    model = rod("field", {}, ElementLineP1(), 64)
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    c = dg.constants(spaces, np.zeros(model.Q.dim), [np.zeros(model.X.dim)])
    exact = np.sqrt(1 / np.tanh(1.0))
    assert 0.97 * exact < c.C_A <= exact


def test_large_models_sample_what_small_ones_bound(monkeypatch):
    model = rod("field")
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    arguments = spaces, np.zeros(model.Q.dim), [model.initial(lambda x: np.sin(np.pi * x[0]))]
    bound = dg.constants(*arguments)
    monkeypatch.setattr(constants_module, "LARGEST_TRACE", 0)
    sampled = dg.constants(*arguments)
    assert sampled.sampled == ("C_A",)
    assert 0.5 * bound.C_A < sampled.C_A <= bound.C_A * (1 + 1e-12)


HERMITE_NODES = (16, 31, 61, 121)


def papers_spaces(nodes, D=1.0):
    """Return the paper's example with (MN1), (MN2) on a mesh fitted to omega."""
    mesh = lp.interval(0.0, 1.0, nodes - 1, through=seed.OMEGA)
    element = ElementLineHermite()
    model = lp.Model(
        lp.Field(mesh, element, dirichlet=ZERO),
        lp.Field(mesh, element, inner="H1", dirichlet=ZERO),
        product,
        B=lambda u, v, x: D * lp.dot(lp.grad(u), lp.grad(v)),
    )
    omega = lp.Subdomain(lambda x: (x[0] > seed.OMEGA[0]) & (x[0] < seed.OMEGA[1]))
    MN = diffusion_operator(D)
    return dg.Spaces(model, observe(model, omega), MN, MN)


def papers_constants(spaces):
    model = spaces.model
    u = model.initial(lambda x: seed.u_true(x, 0.0))
    return dg.constants(spaces, model.parameter_space.interpolate(seed.q_true), [u])


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the diffusion of the model is negative")
@pytest.mark.parametrize("D", [1.0, -1.0, 0.1])
@pytest.mark.parametrize("nodes", HERMITE_NODES)
def test_the_papers_lipschitz_constant_is_one_on_every_mesh(nodes, D):
    """L_C <= max{1, sup |q*|} with (MN1), (MN2), for any sign of D."""
    c = papers_constants(papers_spaces(nodes, D))
    assert 0.99 < c.L_C <= 1.0 + 1e-6
    assert (c.c_M, c.C_M, c.c_N, c.C_N) == pytest.approx((1.0, 1.0, 1.0, 1.0), rel=1e-5)
    assert c.observed_VX_X <= 1.0 + 1e-9


@pytest.mark.parametrize("nodes", HERMITE_NODES)
def test_norms_of_the_two_parts_of_the_papers_state(nodes):
    """||P u*(0)|| = 0.285, 1.877 and 3.10 in X, VX^ and V^, by integrals of sin(pi x)."""
    spaces = papers_spaces(nodes)
    u = spaces.model.initial(lambda x: seed.u_true(x, 0.0))
    x = np.array([0.0, *seed.OMEGA, 1.0])
    sine, cosine = (0.5 * np.diff(x + s * np.sin(2 * np.pi * x) / (2 * np.pi)) for s in (-1, 1))
    for part, pieces in ((spaces.observed_part, [1]), (spaces.hidden_part, [0, 2])):
        found, mass = part.norms(u), sine[pieces].sum()
        gradient = PI2 * cosine[pieces].sum()
        assert np.sqrt(mass) == pytest.approx(found.X, rel=1e-4)
        assert np.sqrt(mass + gradient) == pytest.approx(found.VX, rel=1e-3)
        assert (1 + PI2) * np.sqrt(mass) == pytest.approx(found.V, rel=0.03)
        assert part.stage_norms(u).V <= found.V  # the smallest norm of functions that agree
    assert pytest.approx(3.10, rel=0.03) == found.V


@pytest.mark.slow
def test_the_norm_of_a_part_with_a_flux_is_that_of_the_law():
    """The damping rule uses `stage_norms`, which tends to `norms` as the mesh is refined."""
    gaps = []
    for nodes in HERMITE_NODES:
        spaces = papers_spaces(nodes)
        u = spaces.model.initial(lambda x: seed.u_true(x, 0.0))
        forms = StageForms(spaces.model, spaces.split, spaces.M_op, spaces.N_op, 0.0)
        dual = forms.pull @ u
        own = spaces.observed_part.stage_norms(u)
        assert np.sqrt(dual @ forms.tests.riesz(dual)) == pytest.approx(own.V)
        assert u @ dual == pytest.approx(own.VX**2)
        assert u @ forms.mass @ u == pytest.approx(own.X**2)
        gaps.append(1 - own.V / spaces.observed_part.norms(u).V)
    assert np.all(np.diff(gaps) < 0)
    assert gaps[-1] < 0.03


def test_norms_over_a_subdomain_take_integrands():
    model = excited(8)
    observed = observe(model, SENSORS["subdomain"])
    with pytest.raises(ConfigurationError, match="give an integrand"):
        _ = dg.Spaces(model, observed, VX=model.mass).observed_part


SENSORS = {
    "subdomain": lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.8)),
    "points": lp.Points([0.2, 0.5, 0.61]),
    "averages": lp.Averages({"left": lambda x: x[0] < 0.4, "right": lambda x: x[0] > 0.7}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_constants_hold_for_every_vector(name):
    model = excited(12, ElementLineHermite())
    spaces = dg.Spaces(model, observe(model, SENSORS[name]), VX=_weighted, V=_rough)
    q = model.parameter_space.interpolate(excited_q)
    u = model.initial(lambda x: excited_u(x, 0.0))
    c = dg.constants(spaces, q, [u])
    rng = np.random.default_rng(1)
    J = model.form_A.matrix("v", "u", u=u, q=q) + model.form_B.matrix("v", "u", u=u)
    seen, hidden = spaces.observed_part, spaces.hidden_part
    M, N, tests = operators_of(spaces)
    for _ in range(20):
        x = rng.standard_normal(model.X.dim) * model.X.free
        x = model.X.riesz(model.mass @ x) if rng.random() < 0.5 else x
        a, b = seen.norms(x), hidden.norms(x)
        image = J @ x
        size = np.sqrt(image @ model.X.riesz(image))
        assert size <= c.L_C * (a.V + b.V) * (1 + 1e-9)
        assert x @ M @ x >= c.c_M * a.VX**2 * (1 - 1e-9)
        assert x @ N @ x >= c.c_N * b.VX**2 * (1 - 1e-9)
        assert np.sqrt((M @ x) @ tests.riesz(M @ x)) <= c.C_M * a.V * (1 + 1e-9)
        assert c.observed_V_VX * a.V * (1 + 1e-9) >= a.VX
        assert c.hidden_VX_X * b.VX * (1 + 1e-9) >= b.X
        assert c.observed_ratio * a.VX**2 * (1 + 1e-9) >= a.V * a.X
        assert c.hidden_ratio * b.VX**2 * (1 + 1e-9) >= b.V * b.X
        xi = rng.standard_normal(model.Q.dim) * model.Q.free
        image = model.A(u + x)(xi)
        size = np.sqrt(image @ model.X.riesz(image))
        assert size <= c.C_A * (1 + model.X.norm(x)) * model.Q.norm(xi)


def operators_of(spaces):
    """Return the operators M and N of both parts, and X on their test functions."""
    model, split = spaces.model, spaces.split
    forms = StageForms(model, split, spaces.M_op, spaces.N_op, 1.0)
    return forms.pull, sp.diags_array(model.X.free) @ forms.hidden, forms.tests


def _weighted(u, v, x):
    return u * v + (1 + x[0]) * lp.dot(lp.grad(u), lp.grad(v))


def _rough(u, v, x):
    return u * v + lp.dot(lp.grad(u), lp.grad(v)) + lp.fem.ddot(lp.fem.hess(u), lp.fem.hess(v))


@pytest.mark.slow
def test_lanczos_gives_what_the_dense_solver_gives(monkeypatch):
    model = excited(16)
    observed = observe(model, SENSORS["subdomain"])
    q, u = model.parameter_space.interpolate(2.0), model.initial(lambda x: x[0])
    dense = dg.constants(dg.Spaces(model, observed), q, [u])
    monkeypatch.setattr(parts_module, "DENSE", 0)
    lanczos = dg.constants(dg.Spaces(model, observed), q, [u])
    for name in ("L_C", "C_A", "c_M", "C_M", "observed_V_VX", "hidden_VX_X", "hidden_ratio"):
        assert getattr(lanczos, name) == pytest.approx(getattr(dense, name), rel=1e-6)


def test_constants_refuse_invalid_arguments(monkeypatch):
    model = rod()
    spaces = dg.Spaces(model, observe(model, lp.Points([0.3])))
    with pytest.raises(ConfigurationError, match="at least one state"):
        dg.constants(spaces, np.zeros(1), [])
    monkeypatch.setattr(constants_module, "LARGEST_DENSE_BASIS", 3)
    with pytest.raises(ConfigurationError, match="Use a coarser mesh"):
        dg.constants(spaces, np.zeros(1), [np.zeros(model.X.dim)])


# --- propositions ---------------------------------------------------------------------------------


def follow(twin, law, u0, c=None):
    identifier = lp.Identifier(twin.model, twin.observation, law, q0=0.0, u0=u0)
    spaces = dg.Spaces.of(twin.model, identifier.observed, law)
    tracker = dg.TwinTracker(twin, spaces, law.gain, law.damping)
    for sample in twin:
        tracker.add(identifier.step(sample.t, sample.z), sample.z)
    return tracker


def twin_of(module, samples, **options):
    times = options.pop("times", module.TIMES[:samples])
    return module.twin_of(times=times, scheme=lp.GradientLaw.scheme, **options)


def constants_of(twin, gain):
    spaces = dg.Spaces(twin.model, twin.observed)
    return dg.constants(spaces, twin.q, twin.states[::10], gain=gain)


@pytest.mark.slow
@pytest.mark.parametrize("u0", [0.0, lambda x: seed_excited.u_true(x, 0.0)], ids=["zero", "exact"])
@pytest.mark.parametrize("data", ["exact", "noisy", "smoothed"])
def test_all_propositions_hold_on_the_excited_twin(u0, data):
    """With exact data d = 0, so that all three propositions apply to the same run."""
    gain = 1000.0
    twin = twin_of(seed_excited, 60)
    tracker = follow(twin, lp.GradientLaw(gain, lp.laws.ResidualDamping(1.0)), u0)
    c = constants_of(twin, gain)
    dg.conditions(tracker.errors, c, data=data, c1=1.0).raise_if_failed()
    report = dg.bounds(tracker.errors, c, data=data).raise_if_failed()
    assert len(report.lines) == 3
    energies = [item.energy for item in tracker.errors]
    assert np.all(np.diff(energies) <= 1e-12)


@pytest.mark.long
@pytest.mark.parametrize("nu", [0.0, None], ids=["nu = 0", "nu of the paper"])
def test_all_propositions_hold_on_the_papers_twin(nu):
    """Partial data with gains that satisfy the conditions on mu and nu."""
    gain, floor = 100.0, 1e-8
    twin = twin_of(seed, 20)
    c = constants_of(twin, gain)
    nu = unobserved_damping(c, 0.1) if nu is None else nu
    # With nu the bound of p has to cover nu times the flux of u through the boundary of omega.
    p_bound = 0.01 if nu == 0 else 1000.0
    law = lp.GradientLaw(gain, ExactBound(c, p_bound, 1.0, floor), nu=nu)
    tracker = follow(twin, law, lambda x: seed.u_true(x, 0.0))
    assert max(item.p.V for item in tracker.errors) <= p_bound  # the bound given by the user
    report = dg.bounds(tracker.errors, c, nu=nu).raise_if_failed()
    assert len(report.lines) == (2 if nu == 0 else 3)
    met = dg.conditions(tracker.errors, c, nu=nu, floor=floor)
    assert met.lines[0].ok
    assert met.lines[-1].ok == (nu > 0)


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1.0, 100.0, 1e4])
def test_the_energy_never_grows_with_the_default_rule(gain):
    """ResidualDamping omits the part of the bound with p; nevertheless bound 1 holds."""
    twin = twin_of(seed, 20)
    tracker = follow(
        twin, lp.GradientLaw(gain, lp.laws.ResidualDamping(1.0)), lambda x: seed.u_true(x, 0.0)
    )
    lines = dg.bounds(tracker.errors, constants_of(twin, gain)).lines
    assert lines[0].ok


@pytest.mark.slow
def test_a_failed_condition_states_a_remedy():
    twin = twin_of(seed, 10)
    tracker = follow(twin, lp.GradientLaw(100.0, lp.laws.ResidualDamping(0.1)), 0.0)
    report = dg.conditions(tracker.errors, constants_of(twin, 100.0))
    assert not report.ok
    assert "mu is below the paper's bound" in str(report)
    assert "unobserved_damping" in str(report)
    failed = dg.bounds(tracker.errors, constants_of(twin, 100.0))
    assert "hypothesis of the proposition" in str(failed)


@pytest.mark.slow
def test_the_noisy_bounds_hold_until_T_star():
    """Until T* the bounds of well_defined_noisy hold; from T* (cond_d) fails."""
    gain = 1000.0
    full = lp.Full(reconstruction=Tikhonov("V", 1e-5))
    noise = RelativeNoise(0.01)
    twin = twin_of(seed_excited, 0, observation=full, times=0.01 * np.arange(60), noise=noise)
    tracker = follow(twin, lp.GradientLaw(gain, lp.laws.ResidualDamping(10.0)), 0.0)
    c = constants_of(twin, gain)
    T = dg.stopping_time(tracker.errors, c)
    assert 0.0 < T < 0.5
    assert dg.bounds(tracker.errors, c, data="noisy", until=T).lines[0].ok
    early = [item for item in tracker.errors if item.t < T]
    assert dg.conditions(early, c, data="noisy").lines[-1].ok
    late = dg.conditions(tracker.errors, c, data="noisy").lines[-1]
    assert not late.ok
    assert "T* has passed" in late.remedy
    with_sigma = dg.bounds(tracker.errors, c, data="noisy", sigma=0.1, q_true=tracker.q_true)
    assert with_sigma.lines[0].bound >= tracker.q_true**2


@pytest.mark.slow
def test_smoothed_data_with_the_papers_rule():
    """prop:wellposed_noisesmooth holds with the damping rule that satisfies its hypothesis."""
    gain = 1000.0
    twin = twin_of(
        seed_excited,
        0,
        observation=lp.Full(reconstruction=Tikhonov("V", 1e-5)),
        times=0.01 * np.arange(40),
        noise=RelativeNoise(0.001),
    )
    c = constants_of(twin, gain)
    tracker = follow(twin, lp.GradientLaw(gain, lp.laws.ResidualDamping(1.0)), 0.0)
    d = max(item.d.V for item in tracker.errors)
    rate = max(item.rate for item in tracker.errors)
    law = lp.GradientLaw(gain, SmoothedBound(c, 0.0, d, rate, 1.0, 1e-6))
    tracker = follow(twin, law, 0.0)
    dg.bounds(tracker.errors, c, data="smoothed").raise_if_failed()
    dg.conditions(tracker.errors, c, data="smoothed", floor=1e-6).raise_if_failed()


# --- T* online ------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("row", [0, 3, 4])
def test_the_surrogate_of_T_star_is_within_a_factor_of_two(row):
    """Mean of five seeds, in a setting where noise dominates the smoothing error."""
    stopping = experiment("stopping")
    ((_, exact, _, ratio, within),) = stopping.table([stopping.SETTINGS[row]], samples=40)
    assert exact > 0
    assert within, ratio


def test_noise_size_is_the_mean_over_draws():
    model = excited(12)
    observed = observe(model, lp.Full(reconstruction=Tikhonov("V", 1e-4)))
    spaces = dg.Spaces(model, observed)
    matrix = dg.reconstruction_matrix(observed, 1e-4)
    std = np.linspace(0.5, 1.0, observed.size)
    expected = dg.noise_size(spaces, std, matrix)
    rng = np.random.default_rng(0)
    draws = [
        spaces.observed_part.norms(observed.reconstruct(std * rng.standard_normal(len(std))).u)
        for _ in range(400)
    ]
    for name in ("X", "VX", "V"):
        mean = np.sqrt(np.mean([getattr(n, name) ** 2 for n in draws]))
        assert getattr(expected, name) == pytest.approx(mean, rel=0.1)
    u = model.initial(lambda x: np.sin(np.pi * x[0]))
    assert dg.noise_size(spaces, std, matrix, u).V > expected.V
    with pytest.raises(ConfigurationError, match="3 standard deviations"):
        dg.noise_size(spaces, std[:3], matrix)


def test_online_stopping():
    stop = dg.OnlineStopping(Constants(1.0, 1.0))
    d = Norms(0.01, 0.1, 1.0)
    assert stop.margin(Norms(1.0, 3.0, 9.0), Norms()) == np.inf
    assert stop.margin(Norms(0.005, 0.05, 0.5), d) == 0.0
    state = stop.add(stop.init(), 0.0, Norms(1.0, 3.0, 9.0), d)
    assert np.inf == state.T
    assert state.margin > 1
    violated = stop.add(state, 1.0, Norms(0.1, 0.3, 1.0), d)
    assert stop.add(violated, 2.0, Norms(1.0, 3.0, 9.0), d).T == 1.0


# --- excitation -----------------------------------------------------------------------------------


def accumulated(excitation, states, step):
    state = excitation.init()
    for k, u in enumerate(states):
        state = excitation.add(state, k * step, u)
    return state


def test_gramian_of_a_constant_state_is_that_of_one_matrix():
    """For w = sin(pi x) the integral is gamma_0 A(w), whose singular values need one solve."""
    model = rod("field", cells=16)
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    u = model.initial(lambda x: np.sin(np.pi * x[0]))
    excitation = dg.Excitation(spaces, 0.2, gain=9.0)
    found = excitation.spectrum(accumulated(excitation, [u] * 5, 0.1))
    norm = constants_module._norm_of_A(model, u, lp.fem.Moment(0.0))[0]
    assert found.strength[0] == pytest.approx(0.2 * norm * 3.0 * np.sqrt(2), rel=1e-9)
    assert found.windows == 2
    gram = found.modes.T @ model.Q.gram @ found.modes / 9.0
    assert gram == pytest.approx(np.eye(len(found.strength)), abs=1e-8)
    latest = excitation.spectrum(accumulated(excitation, [u] * 5, 0.1), latest=True)
    assert latest.strength[0] == pytest.approx(0.2 * norm * 3.0, rel=1e-9)


@pytest.mark.slow
def test_unobserved_modes_are_not_determined():
    model = excited(20)
    omega = lp.Subdomain(lambda x: x[0] < 0.5)
    excitation = dg.Excitation(dg.Spaces(model, observe(model, omega)), 0.25)
    states = [model.initial(lambda x, t=t: excited_u(x, t)) for t in 0.05 * np.arange(11)]
    spectrum = excitation.spectrum(accumulated(excitation, states, 0.05))
    full = dg.Excitation(dg.Spaces(model, observe(model, lp.Full())), 0.25)
    whole = full.spectrum(accumulated(full, states, 0.05))
    assert spectrum.epsilon < 1e-7 * spectrum.strength[0]
    assert 0 < spectrum.pinned() < whole.pinned()
    values = model.parameter_space.fields["q"].at_vertices @ spectrum.modes[:, 0]
    x = model.state.mesh.p[0]
    assert np.abs(values[x < 0.5]).max() > np.abs(values[x > 0.7]).max()
    assert np.all(np.diff(spectrum.error_bounds(0.25, 0.1)) >= 0)


def test_excitation_of_many_parameters_by_lanczos(monkeypatch):
    model = excited(12)
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    states = [model.initial(lambda x, t=t: excited_u(x, t)) for t in 0.05 * np.arange(4)]
    dense = dg.Excitation(spaces, 0.15)
    expected = dense.spectrum(accumulated(dense, states, 0.05), latest=True)
    monkeypatch.setattr(excitation_module, "DENSE", 0)
    few = dg.Excitation(spaces, 0.15, count=4)
    found = few.spectrum(accumulated(few, states, 0.05))
    assert found.strength == pytest.approx(expected.strength[:4], rel=1e-6)


def test_excitation_is_a_value_and_restarts():
    model = excited(8)
    excitation = dg.Excitation(dg.Spaces(model, observe(model, lp.Full())), 0.2)
    states = [model.initial(lambda x, t=t: excited_u(x, t)) for t in 0.1 * np.arange(5)]
    middle = accumulated(excitation, states[:3], 0.1)
    kept = replace(middle)
    for k in (3, 4):
        middle = excitation.add(middle, 0.1 * k, states[k])
    again = kept
    for k in (3, 4):
        again = excitation.add(again, 0.1 * k, states[k])
    assert np.array_equal(middle.gram, again.gram)
    assert kept.windows == 1


def test_excitation_refuses_invalid_arguments():
    model = excited(8)
    spaces = dg.Spaces(model, observe(model, lp.Full()))
    with pytest.raises(ConfigurationError, match="window must be positive"):
        dg.Excitation(spaces, 0.0)
    excitation = dg.Excitation(spaces, 1.0)
    with pytest.raises(ConfigurationError, match="no window of length 1 is complete"):
        excitation.spectrum(excitation.init())
    assert dg.Spectrum(np.zeros(0), np.zeros((2, 0)), 0).pinned() == 0
    assert dg.Spectrum(np.zeros(0), np.zeros((2, 0)), 0).epsilon == 0.0


# --- links and interpolation ----------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
def test_links_find_their_exponent(exponent):
    t = np.linspace(0, 10, 201)
    x = 1 / (1 + t)
    found = dg.link(t, x, 0.5 * x**exponent, window=1.0)
    assert found.exponent == pytest.approx(exponent, abs=1e-6)
    assert found.holds
    # The integrand is constant, 2^(1/(a-1)) over a window of one: C = 2^(1/a).
    assert found.constant == pytest.approx(2.0 ** (1 / exponent), rel=1e-6)
    assert "does not grow" in str(found)


def test_a_link_that_fails_grows():
    t = np.linspace(0, 10, 201)
    found = dg.link(t, np.ones_like(t), np.exp(-t), window=1.0, exponent=2.0, start=1.0)
    assert not found.holds
    assert "in doubt" in str(found)
    assert dg.link(t, 0 * t, np.exp(-t), window=1.0).holds
    assert dg.link(t, np.ones_like(t), np.ones_like(t), window=1.0).exponent == 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"theta": np.zeros(5)}, "three or more"),
        ({"exponent": 0.5}, "at least 1"),
        ({"window": 100.0, "exponent": 2.0}, "shorter than the window"),
    ],
)
def test_links_refuse_invalid_arguments(options, words):
    t = np.arange(5.0)
    given = {"x": np.ones(5), "theta": np.ones(5), "window": 1.0, **options}
    with pytest.raises(ConfigurationError, match=words):
        dg.link(t, **given)


@pytest.mark.slow
def test_interpolation_along_a_run_stays_within_its_bounds():
    twin = twin_of(seed_excited, 30)
    tracker = follow(twin, lp.GradientLaw(1000.0, lp.laws.ResidualDamping(1.0)), 0.0)
    found = dg.interpolation([item.r for item in tracker.errors])
    c = constants_of(twin, 1000.0)
    assert 1 / c.observed_ratio <= found.c_int <= found.C_int <= 1 + 1e-9
    with pytest.raises(ConfigurationError, match="every residual is zero"):
        dg.interpolation([Norms()])


# --- the page -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_page_of_a_twin_shows_all_bounds():
    twin = twin_of(seed_excited, 40, noise=RelativeNoise(1e-4))
    law = lp.GradientLaw(1000.0, lp.laws.ResidualDamping(1.0))
    identifier = lp.Identifier(twin.model, twin.observation, law, q0=0.0, u0=0.0)
    found = dg.theory_report(identifier, twin, noise=1e-4, twin=twin)
    assert [report.name for report in found.reports] == [
        "conditions, noisy data",
        "error bounds, noisy data",
    ]
    page = found.markdown("Excited")
    for words in ("# Excited", "T* with truth", "LipschitzC", "asspof", "cond:link, kappa"):
        assert words in page
    assert found.stopping is not None
    assert found.spectrum.pinned() > 1


def test_the_page_without_truth_names_what_requires_it():
    model = rod(lp.Normal(1.0), cells=8)
    identifier = lp.Identifier(model, lp.Points([0.4]), lp.SensitivityLaw(noise=0.1), u0=1.0)
    found = dg.theory_report(identifier, [(t, [np.exp(-t)]) for t in 0.1 * np.arange(9)])
    assert any("Without the truth" in note for note in found.notes)
    assert any("no damping rule" in note for note in found.notes)
    assert any("No noise level" in note for note in found.notes)
    assert found.reports == ()
    with pytest.raises(ConfigurationError, match="at least two samples"):
        dg.theory_report(identifier, [(0.0, [1.0])])


def test_the_page_of_a_run_without_any_measurement():
    model = rod(lp.Normal(1.0), cells=8)
    identifier = lp.Identifier(model, lp.Points([0.4]), lp.GradientLaw(), u0=1.0)
    found = dg.theory_report(identifier, [(t, [np.nan]) for t in (0.1, 0.2, 0.3)])
    assert found.constants is None
    assert any("no sample of the run contains a measurement" in note for note in found.notes)


@pytest.mark.long
def test_report_theory_of_a_run_directory(tmp_path):
    from livepde.cli import app

    runner, folder = CliRunner(), tmp_path / "case"
    for words in (
        ["init", str(folder)],
        ["run", str(folder / "case.toml"), "--out", str(tmp_path / "run"), "--json"],
    ):
        assert runner.invoke(app, words).exit_code in (0, 1)
    copy = tmp_path / "run"
    found = runner.invoke(
        app, ["report", str(copy), "--theory", "--data", str(folder / "rod.csv"), "--json"]
    )
    assert found.exit_code == 0, found.output
    titles = [table["title"] for table in json.loads(found.stdout)["tables"]]
    assert "Constants of the discretised model" in titles
    assert (copy / "theory.md").read_text().startswith("# Theory: ")
    without = runner.invoke(app, ["report", str(copy), "--theory"])
    assert "Add --data FILE" in str(without.exception)


# --- experiments ----------------------------------------------------------------------------------


@pytest.mark.long
def test_the_oracle_satisfies_the_bounds():
    oracle = experiment("oracle")
    plain, bound, with_mu, with_nu = oracle.run(samples=8)
    assert plain.error < with_mu.error < bound.error  # the bound damps what q learns from
    for found in (plain, bound, with_mu):
        energies = [item.energy for item in found.errors]
        assert max(energies) <= energies[0] * (1 + 1e-9)
    assert with_nu.nu > 1


@pytest.mark.slow
def test_hindsight_prefers_the_strongest_pull():
    hindsight = experiment("hindsight")
    tried = hindsight.partial(100.0, samples=30, steps=(0.1, 10.0))
    assert hindsight.best(tried).gains == (10.0,)
    assert tried[0].error < tried[1].error
    noisy = hindsight.noisy(0.01, 1.0, samples=4, steps=(1.0, 1000.0))
    assert len(noisy) == 4


# --- documentation --------------------------------------------------------------------------------


def test_every_check_has_an_example():
    page = (ROOT / "docs" / "extending.md").read_text()
    checks = [name for name in dg.__all__ if name.startswith("check_")]
    assert all(f"dg.{name}(" in page for name in checks)
