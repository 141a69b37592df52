"""Damping rules, and the operators M and N of the paper."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from factories import CASES, few, line, observe, reaction
from skfem import ElementLineP1

import livepde as lp
from experiments import degenerate
from livepde.laws.coupled.equation import StageForms
from livepde.laws.damping import (
    Constants,
    ExactBound,
    NoisyBound,
    Norms,
    SmoothedBound,
    diffusion_operator,
    nu_exact,
    nu_noisy,
    theta_exact,
    theta_noisy,
    theta_smoothed,
    unobserved_damping,
)
from livepde.runs import Outcome
from livepde.stepping import Advance, ImplicitEuler

C = Constants(L_C=3.0, C_A=2.0, c_M=0.5, C_M=1.5, c_N=0.25, hidden_V_VX=0.4, hidden_VX_X=0.5)
R = Norms(X=0.2, VX=0.5, V=2.0)
D = Norms(X=0.01, VX=0.02, V=0.1)
P = Norms(X=0.03, VX=0.1, V=0.7)


SEEN = Norms(X=1.0, VX=3.0, V=10.0)  # of u_alpha


def residual(n: Norms) -> lp.laws.Residual:
    return n.residual(SEEN)


def mu(theta: float, norm: float) -> float:
    return theta * norm


def test_exact_data():
    bound = 2 * 3 / 0.5 * P.V * R.X * R.V / R.VX**2  # cond:mu_1
    assert mu(theta_exact(C, P.V, R), R.V) == pytest.approx(bound)
    with_c1 = max(2 * 3 / 0.5 * P.V, 100 * R.X) * R.X * R.V / R.VX**2  # cond:mu02
    assert mu(theta_exact(C, P.V, R, c1=100), R.V) == pytest.approx(with_c1)


def test_noisy_data():
    e, ra_V = 0.3, 1.9
    first = 4 * 3 / 0.5 * (D.V + P.V) * R.X + 4 * 2 / 0.5 * (1 + D.V + P.V) * e * D.X
    assert mu(theta_noisy(C, e, P.V, R, D), ra_V) == pytest.approx(first * ra_V / R.VX**2)
    sigma = 1e3
    second = 2 * sigma / 0.5 * R.X**2
    assert theta_noisy(C, e, P.V, R, D, sigma) == pytest.approx(second / R.VX**2)
    assert theta_noisy(C, e, P.V, R, D, c1=1e5) == pytest.approx(1e5 * R.X**2 / R.VX**2)


def test_smoothed_data():
    bound = 2 / 0.5 * (3 * (D.V + P.V) + 0.6) * R.X / R.VX**2
    assert theta_smoothed(C, P.V, R, D.V, 0.6) == pytest.approx(bound)
    assert theta_smoothed(C, 0, R, 0, 0, c1=2) == pytest.approx(2 * R.X**2 / R.VX**2)


def test_nu():
    e = 0.3
    exact = 4 * (3 + 2 * (e + 0.5 * 0.4 * 0.5)) / 0.25 * P.V * P.X / P.VX**2
    assert nu_exact(C, e, P) == pytest.approx(exact)
    rough = 4 * (3 + 2 * e) / 0.25 * (P.V + D.V) + 2 * 2 * 0.4 * 0.5 / 0.25 * P.V
    assert nu_noisy(C, e, P, D.V) == pytest.approx(rough * P.X / P.VX**2)
    assert nu_exact(C, e, Norms()) == 0.0
    assert nu_noisy(C, e, P, 0.0) <= nu_noisy(C, e, P, D.V)


def test_the_constant_nu_satisfies_the_bound_for_every_p():
    ratio = P.V * P.X / P.VX**2
    c = Constants(L_C=3.0, C_A=2.0, hidden_ratio=ratio, hidden_V_VX=0.4, hidden_VX_X=0.5)
    assert unobserved_damping(c, 0.3) == pytest.approx(nu_exact(c, 0.3, P))


@pytest.mark.parametrize("size", [1e-2, 1.0, 30.0])
def test_rules_give_what_the_formulas_ask(size):
    r = Norms(size * R.X, size * R.VX, size * R.V)
    exact = ExactBound(C, p_bound=P.V, c1=0.5, floor=1e-6)
    assert exact.theta(residual(r)) == pytest.approx(theta_exact(C, P.V, r, 0.5))
    smooth = SmoothedBound(C, P.V, D.V, 0.6, c1=0.5, floor=1e-6)
    assert smooth.theta(residual(r)) == pytest.approx(theta_smoothed(C, P.V, r, D.V, 0.6, 0.5))


@pytest.mark.parametrize("size", [0.3, 1.0, 30.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_noisy_rule_asks_for_at_least_what_the_true_residual_would(size, sign):
    true = Norms(size * R.X, size * R.VX, size * R.V)
    seen = Norms(true.X + sign * D.X, true.VX + sign * D.VX, true.V + sign * D.V)
    rule = NoisyBound(C, P.V, 0.3, D, sigma=0.1, c1=0.2, theta_max=1e9)
    asked = theta_noisy(C, 0.3, P.V, true, D, 0.1, 0.2)
    assert rule.theta(residual(seen)) >= asked * (1 - 1e-12)


def test_rules_are_bounded_at_vanishing_residuals():
    zero = residual(Norms())
    assert ExactBound(C, 0.1, 1.0, 1e-2).theta(zero) == pytest.approx(2 * 3 / 0.5 * 0.1 / 1e-2)
    assert ExactBound(C, 0.0, 1.0).theta(zero) == lp.laws.ResidualDamping(1.0).theta(zero)
    assert SmoothedBound(C, 0, 0, 0, c1=2.0).theta(zero) == 2.0
    assert NoisyBound(C, 0.1, 0.3, D, theta_max=7.0).theta(zero) == 7.0
    nothing = Norms().residual(Norms())
    assert ExactBound(C, 0.1, 1.0).theta(nothing) == SmoothedBound(C, 1, 1, 1).theta(nothing) == 1.0


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_floors_are_relative_to_the_observed_state(scale):
    """With bounds of p, d and their rates in the same unit, theta does not depend on that unit."""

    def scaled(n: Norms) -> Norms:
        return Norms(scale * n.X, scale * n.VX, scale * n.V)

    for size in (0.0, 1e-5, 1.0):
        r = Norms(size * R.X, size * R.VX, size * R.V)
        rules = (ExactBound(C, P.V), SmoothedBound(C, P.V, D.V, 0.6))
        others = (
            ExactBound(C, scale * P.V),
            SmoothedBound(C, scale * P.V, scale * D.V, scale * 0.6),
        )
        for rule, other in zip(rules, others, strict=True):
            found = other.theta(scaled(r).residual(scaled(SEEN)))
            assert found == pytest.approx(rule.theta(r.residual(SEEN)))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ExactBound(C, -1.0), "p_bound must be a number >= 0"),
        (lambda: ExactBound(C, 1.0, floor=0.0), "floor must be positive"),
        (lambda: SmoothedBound(C, 0.0, np.nan, 0.0), "d_bound must be a number >= 0"),
        (lambda: SmoothedBound(C, 0.0, 0.0, 0.0, floor=-1.0), "floor must be positive"),
        (lambda: NoisyBound(C, 0.0, np.inf, D), "e_bound must be a number >= 0"),
        (lambda: Constants(L_C=-1.0, C_A=0.0), "L_C must be a number >= 0"),
        (lambda: Constants(L_C=1.0, C_A=0.0, c_M=0.0), "c_M must be positive"),
    ],
)
def test_rules_refuse(make, words):
    with pytest.raises(lp.errors.LawError, match=words):
        make()


def left(x):
    return x[0] < 0.5


def integrated(model, D, nu=1.0):
    """Return M over the left half and N over the right one, as the law integrates them."""
    MN = diffusion_operator(D)
    forms = StageForms(model, observe(model, lp.Subdomain(left)).split(), MN, MN, nu)
    return forms.pull, forms.hidden, forms


@pytest.mark.slow
@pytest.mark.parametrize(("name", "D"), few(12, CASES, [1.0, -1.0, lambda x: x[0] - 0.5]))
def test_M_and_N_share_the_domain(name, D):
    """M + N = |D| grad grad + mass over Omega, each symmetric and coercive on its part."""
    model = CASES[name].model(dirichlet={})
    M, N, forms = integrated(model, D)
    absolute = (lambda x: np.abs(D(x))) if callable(D) else abs(D)

    def whole(u, v, x):
        weight = absolute(x) if callable(absolute) else absolute
        return weight * lp.dot(lp.grad(u), lp.grad(v)) + u * v

    np.testing.assert_allclose((M + N).toarray(), model.bilinear(whole).toarray(), atol=1e-12)
    for operator, mass in ((M, forms.mass), (N, model.mass - forms.mass)):
        np.testing.assert_allclose(operator.toarray(), operator.T.toarray(), atol=1e-14)
        assert np.linalg.eigvalsh((operator - mass).toarray()).min() > -1e-12


def test_the_norm_of_VX():
    """(M v, v)_X = ||sqrt|D| v'||^2 + ||v||^2 over omega = (0, 1/2), for v = x and D = -4."""
    model = reaction(line(), ElementLineP1(), dirichlet={})
    v = model.initial(lambda x: x[0])
    M, N, _ = integrated(model, lambda x: np.where(x[0] < 0.5, -4.0, 2.0))
    assert v @ M @ v == pytest.approx(4.0 * 0.5 + 1 / 24)
    assert v @ N @ v == pytest.approx(2.0 * 0.5 + 7 / 24)


@pytest.mark.parametrize("cells", [12, 24, 48])
def test_what_is_hidden_has_no_gradient_of_the_splitting(cells):
    """(N u, u) of u = 1 is the length of the rest on every mesh: P u does not fall to zero."""
    model = reaction(line(cells), ElementLineP1(), dirichlet={})
    one = np.ones(model.X.dim)
    M, N, _ = integrated(model, 1.0)
    assert one @ N @ one == pytest.approx(0.5)
    assert one @ M @ one == pytest.approx(0.5)


def test_the_law_takes_them():
    """N is integrated over the rest only and M over omega; they share the node between."""
    model = reaction(line(), ElementLineP1())
    MN = diffusion_operator(-1.0)
    law = lp.GradientLaw(nu=1.0, M_op=MN, N_op=MN)
    work = law.prepare(
        lp.laws.Problem(model, observe(model, lp.Subdomain(left)), Advance(ImplicitEuler()))
    )
    forms = work.stage(np.ones(work.problem.observed.size, dtype=bool)).terms.forms
    x = model.state.mesh.p[0]
    for operator, side in ((forms.pull, x <= 0.5), (forms.hidden, x >= 0.5)):
        rows = np.unique((sp.diags_array(model.X.free) @ operator).nonzero()[0])
        assert set(rows) <= set(np.flatnonzero(side))
    M, N, _ = integrated(model, -1.0)
    np.testing.assert_allclose(forms.pull.toarray(), M.toarray())
    np.testing.assert_allclose(forms.hidden.toarray(), N.toarray())


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return degenerate.degenerate()


@pytest.mark.study
def test_varying_and_degenerate_diffusivities(outcome):
    assert outcome.ok, [check for check in outcome.checks if not check.ok]
    json.dumps(outcome.to_dict(), allow_nan=False)
    for draw in outcome.figures.values():
        draw().canvas.draw()


@pytest.mark.study
def test_antidiffusion_is_bounded_with_nu_and_fails_without(outcome):
    rows = [
        dict(zip(outcome.tables[0].columns, row, strict=True)) for row in outcome.tables[0].rows
    ]
    *lost, held = (row for row in rows if row["D"] == "antidiffusion")
    assert [row["nu"] for row in (*lost, held)] == [0.0, 0.1, degenerate.NU]
    for without in lost:
        assert without["largest |p|"] > degenerate.FAILED
        assert without["ended at t"] < 0.1 * without["of"]
    assert held["largest |p|"] < degenerate.BOUNDED
    assert held["ended at t"] == held["of"]
    expected = degenerate.EXPECTED["antidiffusion", degenerate.NU]
    assert held["error of q"] == pytest.approx(expected, rel=degenerate.TOLERANCE)


def test_the_manufactured_state_solves_the_discrete_process():
    """Even with D < 0: implicit Euler from u*(0) with q* returns u* (a few steps: it grows)."""
    model, _ = degenerate.build(degenerate.PROCESSES["antidiffusion"])
    times = model.h * np.arange(4)
    q = model.parameter_space.interpolate(degenerate.q_true)
    run = lp.simulate(model, q, model.exact(0.0), times, lp.Advance(lp.ImplicitEuler()))
    for t, u in run:
        np.testing.assert_allclose(u, model.exact(t), atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(("D", "nu", "holds"), [(0.05, 0.0, True), (-0.05, 0.9, False)])
def test_it_is_the_sign_of_D_that_needs_nu_above_one(D, nu, holds):
    """With D > 0 the same gains hold p without nu; with D < 0 nu = 0.9 is too little, as |D| says.

    nu = 1.1 and 5 hold it as nu = 2 does, with |p| <= 1.5.
    """
    process = replace(
        degenerate.PROCESSES["antidiffusion"],
        D=lambda x: np.where(x[0] < degenerate.OMEGA, D, 1.0),
        steps=400,
    )
    course = degenerate.identify(process, nu)
    # Each stage has a solution: without a bound p grows until the run is stopped.
    assert course.failed == 0
    assert course.lost != holds
    assert (course.hidden.max() < degenerate.BOUNDED) == holds
