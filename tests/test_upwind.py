"""Stabilised transport: exact at the vertices, smooth, along the streamlines only."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve
from skfem import ElementLineP1, ElementQuad1

import livepde as lp
from livepde.fem import upwind


def steady(model, u):
    K, free = model.form_B.matrix("v", "u").tocsc(), np.flatnonzero(model.X.free)
    u = model.impose(u, lp.fem.Moment())
    u[free] = spsolve(K[free][:, free], -(K @ u)[free])
    return u


@pytest.mark.parametrize("kappa", [1.0, 0.1, 1e-2, 1e-4])
@pytest.mark.parametrize("b", [1.0, -3.0])
def test_exact_at_the_vertices_of_a_boundary_layer(kappa, b):
    mesh = lp.interval(0.0, 1.0, 10)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": 0.0, "right": 1.0}),
        lp.Normal(),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: (
            (kappa + upwind(b, kappa, x.h)) * lp.dot(lp.grad(u), lp.grad(v)) + b * lp.grad(u)[0] * v
        ),
    )
    s = mesh.p[0]
    exact = (
        np.expm1(b * s / kappa) / np.expm1(b / kappa)
        if b * 1 / kappa < 500
        else (np.exp(b * (s - 1) / kappa))
    )
    values = model.state_block.at_vertices @ steady(model, np.zeros(model.X.dim))
    assert np.abs(values - exact).max() < 1e-10


def test_limits_and_smoothness():
    h = 0.1
    assert upwind(2.0, 1e-9, h) == pytest.approx(2.0 * h / 2)
    assert upwind(1e-6, 1.0, h) == pytest.approx((1e-6 * h) ** 2 / 12)
    assert upwind(0.0, 1.0, h) == 0.0
    for b in (0.0, 1e-9, 1.9999, 2.0001, 5.0, -5.0, 1e4):  # the series ends at b = 2
        derivative = np.imag(upwind(b + 1e-30j, 1.0, h)) / 1e-30
        e = 1e-5 * max(abs(b), 1.0)
        difference = (upwind(b + e, 1.0, h) - upwind(b - e, 1.0, h)) / (2 * e)
        assert derivative == pytest.approx(float(difference), rel=1e-6, abs=1e-12)


def test_along_streamlines():
    tensor = upwind((3.0, np.array([[4.0, 0.0]])), 0.01, 0.1)
    assert tensor.shape == (2, 2, 1, 2)
    across = np.einsum("ij,j", tensor[..., 0, 0], [-4.0, 3.0])
    assert np.abs(across).max() < 1e-14
    assert np.trace(tensor[..., 0, 0]) == pytest.approx(float(upwind(5.0, 0.01, 0.1)))


def test_no_wiggles_in_the_plane():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (12, 4))
    b, kappa = (1.0, 0.0), 1e-4
    model = lp.Model(
        lp.Field(mesh, ElementQuad1(), dirichlet={"left": 0.0, "right": 1.0}),
        lp.Normal(),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: (
            kappa * lp.dot(lp.grad(u), lp.grad(v))
            + lp.dot(lp.fem.mul(upwind(b, kappa, x.h), lp.grad(u)), lp.grad(v))
            + b[0] * lp.grad(u)[0] * v
        ),
    )
    u = steady(model, np.zeros(model.X.dim))
    assert u.min() > -1e-12
    assert u.max() < 1.0 + 1e-12
