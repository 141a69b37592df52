"""A form that is nonlinear in a few numbers is assembled once for each value of the numbers."""

from typing import Any

import numpy as np
from factories import filter_alone

import livepde as lp
from livepde.fem.forms import Form


def _form() -> Form:
    """Return a form of two fields, with a part without u and one on a boundary."""
    mesh = lp.interval(0.0, 1.0, 7)

    def volume(q: Any, u: Any, v: Any, x: Any) -> Any:
        flux = q.D**2 * lp.grad(u.c)[0] - u.c / q.phi
        return flux * lp.grad(v.c)[0] + np.exp(q.D) * (u.c - u.s - 3.0) * v.s * x[0]

    fields = {name: lp.Field(mesh, lp.linear(mesh)) for name in ("c", "s")}
    priors = {"D": lp.Normal(0.3, 0.1), "phi": lp.Normal(0.6, 0.1)}
    side = lp.On("right", lambda q, u, v, x: u.c * v.c / q.phi)
    form = lp.Model(fields, priors, A=[volume, side]).physical_A
    assert isinstance(form, Form)
    return form


def test_products_are_those_of_quadrature_whatever_numbers_come() -> None:
    form, rng = _form(), np.random.default_rng(3)
    assert form.fixed_by_numbers
    for q in ([0.3, 0.6], [0.2, 0.9], [0.3, 0.6]):
        for _ in range(2):
            numbers, u = np.array(q), rng.standard_normal(form.spaces["u"].dim)
            x = rng.standard_normal((2, 3))
            expected = form.matrix("v", "q", q=numbers, u=u) @ x
            found = form.about(numbers).product(x, u)
            assert np.abs(found - expected).max() <= 1e-13 * np.abs(expected).max()


def test_members_with_other_numbers_are_as_they_are_alone() -> None:
    """They share the form, and its numbers change from member to member."""
    mesh = lp.interval(0.0, 1.0, 8)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": 1.0}),
        {"D": lp.Normal(0.3, 0.1), "phi": lp.Normal(0.6, 0.1)},
        A=lambda q, u, v, x: q.D**2 * lp.dot(lp.grad(u), lp.grad(v)) + u * v / q.phi,
    )
    sensors, law = lp.Points([0.4, 0.8], noise=0.01), filter_alone(refit=lp.Refit())
    fleet = lp.Fleet(model, sensors, law, 2, u0=0.0)
    alone = [lp.Identifier(model, sensors, law, u0=0.0) for _ in range(2)]
    rng = np.random.default_rng(5)
    for k in range(1, 6):
        z = (1.0 - np.exp(-0.2 * k)) * np.array([0.6, 0.4]) + 0.01 * rng.standard_normal((2, 2))
        z[k % 2, 0] = np.nan
        together = fleet.step(0.1 * k, z)
        each = [one.step(0.1 * k, row) for one, row in zip(alone, z, strict=True)]
    for k, one in enumerate(each):
        found = together.member(k)
        assert np.allclose(found.q, one.q, rtol=1e-9, atol=0.0)
        assert np.allclose(found.q_std, one.q_std, rtol=1e-9, atol=0.0)
