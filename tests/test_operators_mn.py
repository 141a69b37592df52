"""(MN1), (MN2): the operators M and N, and the processes that need them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from factories import CASES, line, observe, reaction
from skfem import ElementLineP1

import livepde as lp
from experiments import degenerate
from livepde.laws.coupled.equation import StageForms
from livepde.laws.damping import diffusion_operator
from livepde.runs import Outcome
from livepde.stepping import Advance, ImplicitEuler


def left(x):
    return x[0] < 0.5


def integrated(model, D, nu=1.0):
    """Return M over the left half and N over the right one, as the law integrates them."""
    MN = diffusion_operator(D)
    forms = StageForms(model, observe(model, lp.Subdomain(left)).split(), MN, MN, nu)
    return forms.pull, forms.hidden, forms


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("D", [1.0, -1.0, lambda x: x[0] - 0.5])
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
