"""(MN1), (MN2): the operators M and N, and the processes that need them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from problems import CASES, line, observe, reaction
from skfem import ElementLineP1

import livepde as lp
from livepde.laws.operators import observed_operator, unobserved_operator
from livepde.reproduce import EXPERIMENTS, degenerate
from livepde.runs.outcome import Outcome
from livepde.stepping import Advance, ImplicitEuler


def left(x):
    return x[0] < 0.5


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("D", [1.0, -1.0, lambda x: x[0] - 0.5])
def test_gradients_count_on_one_part_each(name, D):
    """M + N = |D| grad grad + 2 mass, both symmetric and coercive: (M v, v) >= ||v||_X^2."""
    model = CASES[name].model(dirichlet={})
    M, N = (
        model.bilinear(operator(left, D)) for operator in (observed_operator, unobserved_operator)
    )
    absolute = (lambda x: np.abs(D(x))) if callable(D) else abs(D)

    def whole(u, v, x):
        weight = absolute(x) if callable(absolute) else absolute
        return weight * lp.dot(lp.grad(u), lp.grad(v)) + 2 * u * v

    np.testing.assert_allclose((M + N).toarray(), model.bilinear(whole).toarray(), atol=1e-12)
    for operator in (M, N):
        np.testing.assert_allclose(operator.toarray(), operator.T.toarray(), atol=1e-14)
        assert np.linalg.eigvalsh((operator - model.mass).toarray()).min() > -1e-12


def test_the_norm_of_VX():
    """(M v, v)_X = ||sqrt|D| v'||^2 on omega + ||v||^2, for v = x and D = -4 on (0, 1/2)."""
    model = reaction(line(), ElementLineP1(), dirichlet={})
    v = model.initial(lambda x: x[0])
    M = model.bilinear(observed_operator(left, -4.0))
    N = model.bilinear(unobserved_operator(left, lambda x: np.where(x[0] < 0.5, -4.0, 2.0)))
    assert v @ M @ v == pytest.approx(4.0 * 0.5 + 1 / 3)
    assert v @ N @ v == pytest.approx(2.0 * 0.5 + 1 / 3)


def test_the_law_takes_them():
    """PNP sees the unobserved part of N only, and RMR the observed one of M."""
    model = reaction(line(), ElementLineP1())
    law = lp.GradientLaw(M_op=observed_operator(left, -1.0), N_op=unobserved_operator(left, -1.0))
    work = law.prepare(
        lp.Problem(model, observe(model, lp.Subdomain(left)), Advance(ImplicitEuler()))
    )
    stage = work.stage(np.ones(work.problem.observed.size, dtype=bool))
    hidden = np.flatnonzero(stage.split.P.diagonal())
    assert set(np.unique(stage.PNP.nonzero()[0])) <= set(hidden)
    assert not set(np.unique(stage.RMR.nonzero()[0])) & set(hidden)


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return EXPERIMENTS["degenerate"].run()


def test_varying_and_degenerate_diffusivities(outcome):
    assert outcome.ok, [check for check in outcome.checks if not check.ok]
    json.dumps(outcome.to_dict(), allow_nan=False)
    for draw in outcome.figures.values():
        draw().canvas.draw()


def test_antidiffusion_is_bounded_with_nu_and_fails_without(outcome):
    rows = [
        dict(zip(outcome.tables[0].columns, row, strict=True)) for row in outcome.tables[0].rows
    ]
    without, held = (row for row in rows if row["D"] == "antidiffusion")
    assert (without["nu"], held["nu"]) == (0.0, degenerate.NU)
    assert without["largest |p|"] > degenerate.FAILED
    assert without["ended at t"] < 0.1 * without["of"]
    assert held["largest |p|"] < degenerate.BOUNDED
    assert held["ended at t"] == held["of"]
    assert held["error of q"] < 0.7


def test_the_manufactured_state_solves_the_discrete_process():
    """Even with D < 0: implicit Euler from u*(0) with q* returns u* (a few steps: it grows)."""
    model, _ = degenerate.build(degenerate.PROCESSES["antidiffusion"])
    times = model.h * np.arange(4)
    q = model.parameter_space.interpolate(degenerate.q_true)
    run = lp.simulate(model, q, model.exact(0.0), times, lp.Advance(lp.ImplicitEuler()))
    for t, u in run:
        np.testing.assert_allclose(u, model.exact(t), atol=1e-11)


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
    assert course.failed != holds
    assert (course.hidden.max() < degenerate.BOUNDED) == holds
