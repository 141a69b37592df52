"""The paper's law: energy, the coupled stage, damping, missing samples."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from dense import DenseStage
from factories import (
    CASES,
    excited,
    excited_q,
    excited_u,
    few,
    laplace,
    line,
    observe,
    rates,
    reaction,
    truth,
)
from skfem import ElementLineP1

import livepde as lp
from livepde.fem import Moment
from livepde.laws.coupled import coupled_stage as stage_module
from livepde.laws.coupled.coupled_stage import CoupledStage
from livepde.laws.coupled.equation import Metric, StageForms, StageProblem, StageTerms
from livepde.laws.coupled.stage_solvers import BilinearSolver, MonolithicSolver
from livepde.model import h1_form
from livepde.stepping import Near, StepFailed

EXACT = lp.stepping.Newton(tolerance=1e-13, share=0.0)


def identifier(model, law, sensors=None, **options):
    return lp.Identifier(model, sensors or lp.Full(), law, **options)


def energies(model, law, q_true, states, times, **options):
    """Return ||e||_Q^2/gain + ||r||_X^2 after each sample of exact data on the whole domain."""
    ident = identifier(model, law, **options)
    G = ident.observed.G
    found = []
    start = ident.estimate()
    for t, u_true in zip(times, states, strict=True):
        estimate = start if t == times[0] else ident.step(t, G @ u_true)
        assert estimate.status.ok
        e, r = estimate.q - q_true, estimate.u - u_true
        found.append(model.Q.norm(e) ** 2 / law.gain + model.X.norm(r) ** 2)
    return np.array(found)


DAMPINGS = (
    lp.laws.ResidualDamping(0.0),
    lp.laws.ResidualDamping(1.0),
    lp.laws.ConstantDamping(2.0),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "damping"), [(10.0**k, DAMPINGS[k % len(DAMPINGS)]) for k in range(6)]
)
def test_energy_never_grows(gain, damping):
    """The terms with A cancel in every step: DESIGN.md, section 1, and (align:neplusnr).

    `gain` scales the inner product of Q, so ||e||_Q^2 is taken in the scaled one.
    """
    model = excited(12)
    times = 0.2 * np.arange(40)
    q_true = model.initial_parameter(excited_q)
    states = truth(model, q_true, lambda x: excited_u(x, 0.0), times)
    law = lp.GradientLaw(gain=gain, damping=damping, newton=EXACT)
    energy = energies(model, law, q_true, states, times, q0=5.0, u0=lambda x: 2 * x[0] * (1 - x[0]))
    assert energy[0] > 1e-3
    assert np.diff(energy).max() <= 1e-13 * energy[0]
    assert energy[-1] < energy[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["triangles P1", "quads Q1"])
def test_energy_in_the_plane_with_irregular_steps(name):
    model = CASES[name].model(f=lambda x, t: 10 * (1 + np.sin(t) * x[0]))
    times = np.cumsum([0.0, 0.1, 0.3, 0.05, 0.7, 0.2, 0.2, 0.4, 0.01, 1.0])
    q_true = model.initial_parameter(lambda x: 1 + x[0] * x[1])
    states = truth(model, q_true, 0.0, times)
    law = lp.GradientLaw(gain=1e3, newton=EXACT)
    energy = energies(model, law, q_true, states, times, q0=2.0, u0=0.3)
    assert np.diff(energy).max() <= 1e-13 * energy[0]


@pytest.mark.slow
def test_energy_of_a_diffusivity_with_a_time_dependent_model():
    model = reaction(
        line(12),
        ElementLineP1(),
        dirichlet={"left": lambda x, t: np.sin(t), "right": 1.0},
        A=lambda q, u, v, x: (1 + 0.2 * np.sin(x.t)) * q * lp.dot(lp.grad(u), lp.grad(v)),
        B=lambda u, v, x: 0.1 * laplace(u, v, x) + u * v,
    )
    times = 0.3 * np.arange(30)
    q_true = model.initial_parameter(lambda x: 0.5 + 0.2 * x[0])
    states = truth(model, q_true, lambda x: x[0], times)
    law = lp.GradientLaw(gain=10.0, newton=EXACT)
    energy = energies(model, law, q_true, states, times, q0=0.4, u0=lambda x: x[0] ** 2)
    assert np.diff(energy).max() <= 1e-13 * energy[0]


@pytest.mark.slow
def test_excited_twin_is_identified():
    """A short run of fact 5 in DESIGN.md finds q* between 2 and 5 from q0 = 0."""
    model = excited(16)
    times = 0.05 * np.arange(400)
    q_true = model.initial_parameter(excited_q)
    states = truth(model, q_true, lambda x: excited_u(x, 0.0), times)
    ident = identifier(model, lp.GradientLaw(gain=1e3), q0=0.0, u0=lambda x: excited_u(x, 0.0))
    for t, u in zip(times[1:], states[1:], strict=True):
        estimate = ident.step(t, ident.observed.G @ u)
    mass = model.parameter_mass
    error = estimate.q - q_true
    assert np.sqrt(error @ mass @ error / (q_true @ mass @ q_true)) < 0.02
    assert estimate.q_std is None
    assert estimate.u_std is None


def partly_observed(scheme, steps, h_total=1.0, **options):
    """Run the law on smooth data over [0, 1] and return (u, q) at the end."""
    model = reaction(
        line(8),
        ElementLineP1(),
        dirichlet={"left": lambda x, t: np.sin(2 * t), "right": 0.0},
        f=lambda x, t: 5 * x[0] * np.cos(t),
        **options,
    )
    sensors = lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.8))
    law = lp.GradientLaw(
        gain=30.0, damping=lp.laws.ResidualDamping(0.5), nu=0.3, sigma=0.2, newton=EXACT
    )  # theta jumps by up to c_1 where r = 0, so a larger c_1 would hide the orders
    ident = identifier(model, law, sensors, q0=1.0, u0=lambda x: x[0] * (1 - x[0]), scheme=scheme)
    nodes = ident.observed.G @ model.state.mesh.p[0]

    def z(t):
        return (1 - nodes) * (np.sin(2 * t) + nodes * np.cos(t))

    times = h_total * np.arange(steps + 1) / steps
    for t in times:
        estimate = ident.step(t, z(t))
        assert estimate.status.ok
    return np.concatenate([estimate.u, estimate.q])


@pytest.fixture(scope="module")
def resolved():
    """Return the end of the run with such small steps that their error is negligible."""
    return partly_observed(lp.Alexander2(), 1280)


@pytest.mark.long
@pytest.mark.parametrize(
    ("scheme", "order"), [(lp.ImplicitEuler(), 1), (lp.Alexander2(), 2)], ids=["euler", "alexander"]
)
def test_order_in_time_of_the_coupled_step(scheme, order, resolved):
    steps = (20, 40, 80, 160)
    errors = [abs(partly_observed(scheme, n) - resolved).max() for n in steps]
    np.testing.assert_allclose(rates(errors), order, atol=0.15)


def stage_of(model, split, rule, newton=EXACT, nu=0.0, **options):
    """Return the coupled stage with M and N of (MN1), (MN2)."""
    forms = StageForms(model, split, h1_form, h1_form, nu, **options)
    return CoupledStage(StageTerms(forms, rule), newton)


def solved(stage, *args):
    """Solve a stage, and return y = (u, q)."""
    return stage.solve(*args)[0].y


def a_stage(rule, gain=50.0, nu=0.4, sigma=0.3, size=1.0, h=0.3, seed=0, newton=EXACT):
    """Return a stage whose start does not match its data, and its dense counterpart.

    With u in another unit, `size` times as large, the same gain is one over size squared.
    """
    gain, nodes = gain / size**2, lp.interval(0.0, 1.0, 16, through=(0.3, 0.8))
    model = excited(16, ElementLineP1(), mesh=nodes)
    split = observe(model, lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.8))).split()
    x = nodes.p[0]
    inside = (x[:-1] >= 0.3) & (x[1:] <= 0.8)
    dense = DenseStage(x, inside, gain, rule, nu, sigma)
    np.testing.assert_array_equal(np.flatnonzero(inside), split.omega)
    rng, n = np.random.default_rng(seed), model.X.dim
    c = rng.standard_normal(n + model.Q.dim)
    c[:n] *= size * model.X.free
    u_alpha = split.R @ (size * model.initial(lambda x: excited_u(x, 0.3)))
    metric = Metric(1.0 / gain, sigma)
    problem = StageProblem(c, h, Moment(0.3), u_alpha, metric)
    given = (c, h, u_alpha, model.F(Moment(0.3)) * model.X.free)
    return stage_of(model, split, rule, newton, nu), problem, dense, given


RULES = [
    lp.laws.ResidualDamping(0.0),
    lp.laws.ResidualDamping(3.0),
    lp.laws.ConstantDamping(2.0, floor=0.1),
    lp.laws.ConstantDamping(0.5, floor=1e-3),
]


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("nu", [0.0, 0.4])
def test_stage_solves_its_equations(rule, nu):
    """Checks both equations with dense matrices and integrals over omega and the rest."""
    stage, problem, dense, given = a_stage(rule, nu=nu)
    y = solved(stage, problem, problem.c.copy)
    assert dense.relative(y, *given) <= 1e-12
    assert dense.relative(y + 1e-6 * problem.c, *given) > 1e-9  # detects a wrong solution


@pytest.mark.parametrize("left", [False, True])
def test_products_made_ahead_state_the_same_equation(left):
    """Residual, its size and the Jacobian equal those of the forms at any point."""
    stage, problem, *_ = a_stage(lp.laws.ResidualDamping(3.0))
    rng = np.random.default_rng(3)
    y = problem.c + 0.1 * rng.standard_normal(len(problem.c))
    if left:
        problem = replace(problem, left=0.1 * rng.standard_normal(len(y)))
    found = []
    for solver in (stage.solver, MonolithicSolver(stage.terms)):
        data = solver.data(problem)
        at = solver.evaluate(data, y)
        update = solver.factor(data, at).solve(at.residual)
        found.append(np.concatenate([at.residual, [at.size, *at.scales], update]))
    assert isinstance(stage.solver, BilinearSolver)
    np.testing.assert_allclose(*found, rtol=1e-9, atol=1e-12 * np.abs(found[0]).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "rule", "gain"),
    few(
        7,
        [1e-3, 1.0, 1e3, 1e5],
        [lp.laws.ResidualDamping(1.0), lp.laws.ConstantDamping(0.5, floor=1e-3)],
        [1.0, 1e4],
    ),
)
def test_an_accepted_stage_is_solved_in_every_unit(size, rule, gain):
    """Acceptance depends on the relative residual, not on the unit of the state."""
    newton = lp.stepping.Newton(share=0.0)
    for halvings in range(9):
        h = 0.3 / 2**halvings
        stage, problem, dense, given = a_stage(rule, gain=gain, size=size, h=h, newton=newton)
        try:
            y = solved(stage, problem, problem.c.copy)
        except StepFailed:
            continue
        break
    assert dense.relative(y, *given) <= 3 * newton.tolerance
    assert halvings <= 2


@pytest.mark.parametrize("spoiled", [0.5, 3.0, -1.0, 1e6, 1e-6])
def test_a_wrong_factor_is_never_accepted(spoiled):
    """A factor of another point makes updates small, but not the residual."""

    class Spoiled:
        def __init__(self, inner):
            self.inner = inner

        def solve(self, b):
            return self.inner.solve(b) / spoiled

    newton = lp.stepping.Newton(share=0.0)
    stage, problem, dense, given = a_stage(lp.laws.ResidualDamping(1.0), newton=newton)
    other = 10.0 * np.random.default_rng(5).standard_normal(len(problem.c))
    p = problem
    data = stage.solver.data(p)
    factor = Spoiled(stage.solver.factor(data, stage.solver.evaluate(data, other)))
    equation = stage_module._CoupledEquation(stage.solver, data)
    solved = newton.solve(equation, p.c, Near(p.c.copy(), factor))
    assert solved.at.size <= newton.tolerance
    assert dense.relative(solved.at.y, *given) <= 3 * newton.tolerance


def test_a_share_is_relative_to_the_residual_of_the_prediction():
    newton = lp.stepping.Newton(share=0.03)
    stage, problem, dense, given = a_stage(lp.laws.ResidualDamping(1.0), newton=newton)
    exact = solved(stage, problem, problem.c.copy)
    assert dense.relative(exact, *given) <= 3 * newton.tolerance  # no share without a prediction
    predicted = exact + 1e-4 * np.random.default_rng(1).standard_normal(len(exact))
    predicted[[0, stage.terms.n - 1]] = 0.0
    found = solved(stage, problem, problem.c.copy, predicted)
    missed = dense.relative(predicted, *given)
    assert dense.relative(found, *given) <= 2 * min(0.03 * missed, newton.ceiling)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [lp.ImplicitEuler(), lp.Alexander2()])
def test_without_samples_the_law_is_the_model(scheme):
    model = excited(10)
    law = lp.GradientLaw(gain=1e3, newton=EXACT)
    ident = identifier(model, law, q0=2.0, u0=1.0, scheme=scheme)
    q = model.initial_parameter(2.0)
    states = truth(model, q, 1.0, [0.0, 0.2, 0.5], scheme)
    for t, u in zip([0.2, 0.5], states[1:], strict=True):
        estimate = ident.step(t, np.full(ident.observed.size, np.nan))
        assert estimate.status.ok
        np.testing.assert_allclose(estimate.u, u, atol=1e-10)
        np.testing.assert_allclose(estimate.q, q, atol=1e-10)
    assert np.isnan(estimate.innovation).all()


@pytest.mark.slow
def test_a_missing_sensor_takes_no_part():
    """With one missing sensor, the step equals that of an observation without the sensor."""
    model = excited(10)
    omega = lp.Averages({"a": lambda x: x[0] < 0.3, "b": lambda x: x[0] > 0.6})
    alone = lp.Averages({"a": lambda x: x[0] < 0.3})
    law = lp.GradientLaw(gain=100.0)
    both = identifier(model, law, omega, q0=2.0).step(0.1, [0.4, np.nan])
    one = identifier(model, law, alone, q0=2.0).step(0.1, [0.4])
    np.testing.assert_array_equal(both.q, one.q)
    np.testing.assert_array_equal(both.u, one.u)


@pytest.mark.slow
def test_stabilising_term_decays_q():
    model = excited(6)
    ident = identifier(model, lp.GradientLaw(sigma=0.7, newton=EXACT), q0=3.0)
    nothing = np.full(ident.observed.size, np.nan)
    q0 = ident.estimate().q
    for k in range(1, 4):
        estimate = ident.step(0.5 * k, nothing)
        np.testing.assert_allclose(estimate.q, q0 / (1 + 0.7 * 0.5) ** k, atol=1e-9)


def test_stabilising_term_pulls_a_logarithm_to_its_prior_in_every_unit():
    def last(unit):
        mesh = line(6)
        model = lp.Model(
            lp.Field(mesh, ElementLineP1(), dirichlet={"left": 0.0}),
            {"k": lp.LogNormal(0.8 * unit, std=0.3 * unit)},
            A=lambda q, u, v, x: q.k / unit * lp.dot(lp.grad(u), lp.grad(v)),
            f=1.0,
        )
        ident = identifier(model, lp.GradientLaw(sigma=0.7, newton=EXACT), q0={"k": 2.0 * unit})
        nothing = np.full(ident.observed.size, np.nan)
        ident.step(0.5, nothing)
        return ident.step(1.0, nothing).q[0] / unit

    assert last(1.0) == pytest.approx(0.8 * 2.5 ** (1.35**-2), rel=1e-9)
    assert last(1e-5) == pytest.approx(last(1.0), rel=1e-9)


@pytest.mark.slow
def test_nu_damps_the_unobserved_part():
    with pytest.warns(UserWarning, match="negative at the prior mean, which is ill-posed"):
        model = reaction(line(12), ElementLineP1(), B=lambda u, v, x: -0.5 * laplace(u, v, x))
    sensors = lp.Subdomain(lambda x: x[0] > 0.5)
    sizes = []
    for nu in (0.0, 5.0):
        law = lp.GradientLaw(nu=nu)
        ident = identifier(model, law, sensors, q0=1.0, u0=lambda x: np.sin(np.pi * x[0]))
        P = ident.observed.split().P
        for k in range(1, 6):
            estimate = ident.step(0.001 * k, np.zeros(ident.observed.size))
        sizes.append(model.X.norm(P @ estimate.u))
    assert sizes[1] < sizes[0]


@pytest.mark.slow
def test_users_may_choose_the_operators():
    model = excited(8)
    first = lp.GradientLaw(gain=100.0, M_op=lambda u, v, x: u * v)
    same = lp.GradientLaw(gain=100.0, M_op=lambda u, v, x: u * v, N_op=lambda u, v, x: 7 * u * v)
    z = np.ones(identifier(model, first).observed.size)
    np.testing.assert_array_equal(
        identifier(model, first).step(0.1, z).q, identifier(model, same).step(0.1, z).q
    )
    other = identifier(model, lp.GradientLaw(gain=100.0)).step(0.1, z).q
    assert abs(identifier(model, first).step(0.1, z).q - other).max() > 1e-6


@pytest.mark.slow
def test_bounds_of_numbers_are_kept():
    """Data of q = 3 drive q to its bound, and not further."""
    model = lp.Model(
        lp.Field(line(10), ElementLineP1(), dirichlet={"boundary": 0.0}),
        lp.Normal(0.5, bounds=(0.0, 1.0)),
        A=lambda q, u, v, x: q * u * v,
        B=laplace,
        f=1.0,
    )
    times = 0.1 * np.arange(40)
    states = truth(model, np.array([3.0]), 0.0, times)
    ident = identifier(model, lp.GradientLaw(gain=1e6))
    steps = zip(times[1:], states[1:], strict=True)
    q = [ident.step(t, ident.observed.G @ u).q[0] for t, u in steps]
    assert max(q) == 1.0
    assert min(q) >= 0.0


class TestDamping:
    def test_residual_damping(self):
        """theta = c1 ||r||_X^2 / ||r||_VX^2: smooth, bounded by c1, never 0/0."""
        rule = lp.laws.ResidualDamping(2.0)
        assert rule.theta(lp.laws.Residual(4.0, 16.0, lambda: np.nan)) == 0.5
        assert rule.theta(lp.laws.Residual(0.0, 0.0, lambda: np.nan)) == 2.0
        assert rule.slopes(lp.laws.Residual(0.0, 0.0, lambda: np.nan)) == (0.0, 0.0, 0.0)

    def test_constant_damping(self):
        """theta = mu / ||r||_V~ with a floor that is relative to ||u_alpha||_V~."""
        rule = lp.laws.ConstantDamping(3.0, floor=0.5)
        for size in (1.0, 1e5):
            seen = lp.laws.Residual(0.0, 0.0, lambda size=size: size**2)
            zero = lp.laws.Residual(0.0, 0.0, lambda: 0.0, lambda seen=seen: seen)
            assert rule.theta(zero) == pytest.approx(6.0 / size)
            assert rule.theta(zero.replaced(1.0, 1.0, lambda size=size: 6.0 * size**2)) == (
                pytest.approx(3 / 2.5 / size)
            )
        nothing = lp.laws.Residual(0.0, 0.0, lambda: 0.0)
        assert (rule.theta(nothing), rule.slopes(nothing)) == (0.0, (0.0, 0.0, 0.0))

    @pytest.mark.parametrize(
        "rule", [lp.laws.ResidualDamping(2.0), lp.laws.ConstantDamping(3.0, floor=0.1)]
    )
    def test_slopes_are_derivatives(self, rule):
        at = np.array([0.7, 1.9, 2.3])
        seen = lp.laws.Residual(1.0, 2.0, lambda: 4.0)

        def theta(x):
            return rule.theta(lp.laws.Residual(x[0], x[1], lambda: x[2], lambda: seen))

        slopes = rule.slopes(lp.laws.Residual(at[0], at[1], lambda: at[2], lambda: seen))
        for k, slope in enumerate(slopes):
            step = 1e-6 * np.eye(3)[k]
            assert slope == pytest.approx((theta(at + step) - theta(at - step)) / 2e-6, abs=1e-5)

    def test_default_slopes_serve_any_rule(self):
        @dataclass(frozen=True)
        class Steep(lp.laws.Damping):
            def theta(self, r):
                return 0.5 * r.X + r.VX**2 + 0.1 * r.V

        slopes = Steep().slopes(lp.laws.Residual(0.7, 2.0, lambda: 3.0))
        np.testing.assert_allclose(slopes, [0.5, 4.0, 0.1], rtol=1e-4)
        model = excited(8)
        ident = identifier(model, lp.GradientLaw(gain=10.0, damping=Steep()))
        assert ident.step(0.1, np.ones(ident.observed.size)).status.ok

    def test_norms_of_the_residual(self):
        """||r||_V~ is the X-norm of the operator M_op r."""
        model = excited(8)
        problem = lp.laws.Problem(model, observe(model, lp.Full()), lp.Advance(lp.ImplicitEuler()))
        law = lp.GradientLaw()
        stage = law.prepare(problem).stage(np.ones(problem.observed.size, dtype=bool))
        r = np.random.default_rng(0).standard_normal(model.X.dim) * model.X.free
        Mr = stage.terms.forms.pull @ r
        norms = stage.terms.norms(r, Mr, stage.terms.forms.mass @ r)
        assert pytest.approx(model.X.norm(r) ** 2) == norms.X
        assert pytest.approx(r @ model.bilinear(law.M_op) @ r) == norms.VX
        assert pytest.approx(model.X.norm(model.X.riesz(Mr)) ** 2) == norms.V
        assert norms.VX**2 <= norms.X * norms.V * (1 + 1e-12)  # Cauchy and Schwarz

    def test_bad_rules(self):
        for c1 in (-1.0, np.nan, np.inf):
            with pytest.raises(lp.errors.LawError, match="c1 must be a number >= 0"):
                lp.laws.ResidualDamping(c1)
        for bad in ({"mu": -1.0}, {"mu": np.inf}, {"floor": 0.0}):
            with pytest.raises(lp.errors.LawError, match="mu >= 0 and floor > 0"):
                lp.laws.ConstantDamping(**bad)


def test_bad_gains():
    for gain in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(lp.errors.LawError, match="gain must be a positive number"):
            lp.GradientLaw(gain=gain)
    for name in ("nu", "sigma"):
        with pytest.raises(lp.errors.LawError, match=f"{name} must be a number >= 0"):
            lp.GradientLaw(**{name: -0.1})


def test_sensors_that_depend_on_the_parameter_are_refused():
    model = lp.Model(lp.Field(line(), ElementLineP1()), lp.Normal(), lambda q, u, v, x: q * u * v)
    sensors = lp.Points({"a": 0.5}, direct={"a": lambda q, x: q})
    with pytest.raises(lp.errors.LawError, match="use SensitivityLaw"):
        identifier(model, lp.GradientLaw(), sensors)


@pytest.mark.slow
def test_a_failed_step_keeps_the_state_and_the_stream_continues():
    model = excited(10)
    law = lp.GradientLaw(gain=1e4, newton=lp.stepping.Newton(iterations=0))
    ident = identifier(model, law, q0=1.0, halvings=0)
    before = ident.estimate()
    z = np.full(ident.observed.size, 0.3)
    failed = ident.step(0.1, z)
    assert failed.status.code == "not_converged"
    assert "residual" in failed.status.detail
    assert "Reduce `dt_max`" in failed.status.remedy
    assert failed.status.remedy in str(failed.status)
    np.testing.assert_array_equal(failed.q, before.q)
    np.testing.assert_array_equal(failed.u, before.u)
    assert ident.t == 0.0
    after = ident.step(0.2, np.full(ident.observed.size, np.nan))
    assert np.isfinite(after.u).all()


@pytest.mark.long
@pytest.mark.parametrize("damping", [lp.laws.ResidualDamping(0.0), lp.laws.ConstantDamping(1.0)])
def test_a_reaction_that_blows_up(damping):
    """u_t = exp(u) - ... blows up in finite time where nothing is observed."""
    model = reaction(line(10), ElementLineP1(), B=lambda u, v, x: -10 * np.exp(u) * v, dirichlet={})
    law = lp.GradientLaw(damping=damping)
    ident = identifier(model, law, lp.Subdomain(lambda x: x[0] < 0.25), u0=1.0)
    z = np.ones(ident.observed.size)
    first = ident.step(0.001, z)
    assert first.status.ok
    failed = ident.step(1.0, z)
    assert not failed.status.ok
    assert failed.status.code in {"not_converged", "not_finite", "singular"}
    np.testing.assert_array_equal(failed.u, first.u)
    again = ident.step(1.001, z)
    assert np.isfinite(again.u).all()
    assert ident.t == 0.001


@pytest.mark.long
def test_the_law_passes_check_law():
    model = excited(8)
    times = [0.1, 0.2, 0.35, 0.5, 0.55, 0.7]
    rng = np.random.default_rng(0)
    size = observe(model, lp.Full()).size
    samples = [(t, rng.standard_normal(size)) for t in times]
    for scheme in (lp.ImplicitEuler(), lp.Alexander2()):
        lp.diagnostics.check_law(
            lp.GradientLaw(gain=100.0),
            lambda law, scheme=scheme: identifier(model, law, scheme=scheme, dt_max=0.08),
            samples,
        ).raise_if_failed()
