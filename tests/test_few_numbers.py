"""A form that is not linear in a few numbers is fixed once for each value of them."""

from typing import Any

import numpy as np

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
