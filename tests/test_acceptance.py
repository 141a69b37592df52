"""Accepted stages are solved: a run with constant mu agrees with strict solves in every unit."""

from dataclasses import replace
from functools import cache

import numpy as np
from factories import laplace, observe, product
from skfem import ElementLineP2

import livepde as lp

TIMES = 0.05 * np.arange(101)
EXACT_Q = 2.0


def state(x, t):
    return (1 + 0.5 * np.sin(t)) * np.sin(np.pi * x[0])


def heat(scale):
    """Return u_t - u'' + 2 u = f with u = scale (1 + sin(t)/2) sin(pi x), where q = 2 is sought."""

    def f(x, t):
        rate = 0.5 * np.cos(t) * np.sin(np.pi * x[0])
        return scale * (rate + (np.pi**2 + EXACT_Q) * state(x, t))

    field = lp.Field(lp.interval(0.0, 1.0, 16), ElementLineP2(), dirichlet={"boundary": 0.0})
    return lp.Model(field, lp.Normal(), product, B=laplace, f=f)


def exact(model, scale):
    """Return the states that implicit Euler gives with the exact q."""
    start = model.initial(lambda x: scale * state(x, 0.0))
    scheme = lp.Advance(lp.ImplicitEuler())
    return [u for _, u in lp.simulate(model, np.array([EXACT_Q]), start, TIMES, scheme)]


@cache
def run(scale, noise, strict):
    """Return q and the status along a run, of a law that knows the scale."""
    model = heat(scale)
    newton = lp.stepping.Newton()
    if strict:
        newton = replace(newton, tolerance=1e-12, share=0.0)
    damping = lp.laws.ConstantDamping(0.1 * scale)
    law = lp.GradientLaw(1 / scale**2, damping, newton=newton, gate=None)
    identifier = lp.Identifier(model, lp.Full(), law, q0=0.0, u0=lambda x: scale * state(x, 0.0))
    G = observe(model, lp.Full()).G
    q, ok = [], []
    rough = model.initial(lambda x: scale * np.sin(3 * np.pi * x[0]))
    for t, u in zip(TIMES, exact(model, scale), strict=True):
        error = noise * np.sin(2 * np.pi * t)
        estimate = identifier.step(t, G @ (u + error * rough))
        q.append(float(estimate.q[0]))
        ok.append(estimate.status.ok)
    return np.array(q), np.array(ok)


def test_a_state_of_which_nothing_is_seen_yet():
    """Where u_alpha = 0 the floor of a constant mu is zero: the stage is solved all the same."""
    model = heat(1.0)
    law = lp.GradientLaw(1.0, lp.laws.ConstantDamping(10.0))
    identifier = lp.Identifier(model, lp.Full(), law, q0=0.0, u0=1e-9)
    for t in TIMES[:3]:
        estimate = identifier.step(t, np.zeros(identifier.observed.size))
        assert estimate.status.ok
        assert model.X.norm(estimate.u) < 1e-3
