"""The smoother against dense least squares over all times, and what it leaves as it was."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from factories import truth
from skfem import ElementLineP1

import livepde as lp

NOISE = 0.02
MESH = lp.interval(0.0, 1.0, 6)
SENSORS = lp.Points({"a": 0.3, "b": 0.55, "c": 0.8}, noise=NOISE)
EVOLUTIONS = {"walk": lp.RandomWalk(0.4), "reverting": lp.MeanReverting(0.8)}


class Plain(lp.SensitivityLaw):
    """The law with the covariance of the filter itself."""

    def factors(self, work, x):
        return x.U, x.C


def sources(evolution):
    """Return a rod with two unknown sources, one of which moves: linear."""
    return lp.Model(
        lp.Field(MESH, ElementLineP1(), dirichlet={"left": lambda x, t: np.sin(t) + 0 * x[0]}),
        {"s": lp.Scalar(0.5, 0.7, evolution=evolution), "c": lp.Scalar(0.2, 0.5)},
        A=lambda q, u, v, x: -(q.s * (1 + x[0]) + q.c * x[0] ** 2) * v,
        B=lambda u, v, x: 0.3 * lp.dot(lp.grad(u), lp.grad(v)) + 0.4 * u * v,
    )


def irregular(count=30):
    """Return samples from time zero on; some values are missing, two samples whole."""
    rng = np.random.default_rng(0)
    times = np.cumsum(np.append(0.0, rng.uniform(0.05, 0.2, count)))
    z = np.outer(np.sin(times), [0.7, 0.5, 0.2]) + 0.2 * np.sin(3 * times)[:, None]
    z += NOISE * rng.standard_normal(z.shape)
    z[rng.random(z.shape) < 0.2] = np.nan
    z[10:12] = np.nan
    return list(zip(times.tolist(), z, strict=True))


def dense(model, samples):
    """Return means and deviations of (s, c) and of u at all samples, by least squares.

    The unknowns are s and c at the start and what s gains in each interval, each N(0, 1).
    """
    n, count = model.X.dim, len(samples) - 1
    M, zero = model.mass.toarray(), np.zeros(n)
    B, A = model.form_B.matrix("v", "u", u=zero).toarray(), model.A(zero).matrix.toarray()
    free, evolution = model.X.free.astype(bool), model.latent.parts["s"].evolution
    G = SENSORS.matrix(model.state_space)
    G = G.toarray() if hasattr(G, "toarray") else G

    def path(theta):
        q = np.array([0.5 + 0.7 * theta[0], 0.2 + 0.5 * theta[1]])
        u, found = model.initial(0.0), []
        found.append(np.concatenate([q, u]))
        for k, ((t0, _), (t1, _)) in enumerate(pairwise(samples)):
            h = t1 - t0
            gain = 0.7 * np.sqrt(evolution.growth(h, 0.7)[0]) * theta[2 + k]
            q = np.array([0.5 + evolution.transition(h)[0, 0] * (q[0] - 0.5) + gain, q[1]])
            S, load = M / h + B, M @ u / h - A @ q
            u = model.impose(np.zeros(n), lp.Moment(t1))
            u[free] = np.linalg.solve(S[np.ix_(free, free)], (load - S @ u)[free])
            found.append(np.concatenate([q, u]))
        return np.array(found)

    here = path(np.zeros(2 + count))
    J = np.stack([path(row) - here for row in np.eye(2 + count)], axis=-1)
    z = np.array([z for _, z in samples])
    seen = np.isfinite(z)
    rows = np.vstack([(np.einsum("sj,tjp->tsp", G, J[:, 2:])[seen]) / NOISE, np.eye(2 + count)])
    right = np.append((z - here[:, 2:] @ G.T)[seen] / NOISE, np.zeros(2 + count))
    theta = np.linalg.lstsq(rows, right, rcond=None)[0]
    covariance = np.linalg.inv(rows.T @ rows)
    deviations = np.sqrt(np.einsum("tip,pq,tiq->ti", J, covariance, J))
    return here + J @ theta, deviations


def compared(law, evolution, samples):
    model = sources(evolution)
    result = lp.Identifier(model, SENSORS, law, scheme=lp.ImplicitEuler()).run(samples)
    data = result.smoothed()
    mean, std = dense(model, samples)
    found = (
        np.column_stack([data.s, data.c, data.u]),
        np.column_stack([data.s_std, data.c_std, data.u_std]),
    )
    columns = [0, 1, *(2 + np.argsort(MESH.p[0]))]
    return found, (mean[:, columns], std[:, columns])


@pytest.mark.parametrize("name", EVOLUTIONS)
def test_smoothed_is_the_least_squares_solution_over_all_times(name):
    law = Plain(rank=9, gate=np.inf, start_window=0)
    (mean, std), (exact, deviations) = compared(law, EVOLUTIONS[name], irregular())
    np.testing.assert_allclose(mean, exact, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(std, deviations, rtol=1e-8, atol=1e-8)
