"""Hilbert spaces: Gram matrix, Riesz map, modes, operators with adjoints."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from factories import CASES, laplace, line, product, reaction
from skfem import ElementLineHermite, ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde import spaces
from livepde.diagnostics import check_space


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("inner", ["L2", "H1"])
def test_spaces_of_all_elements(name, inner):
    model = CASES[name].model(inner=inner)
    for space in (model.X, model.Q):
        check_space(space).raise_if_failed()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("zero", [False, True])
def test_adjoint_identity(name, zero):
    """(A(u)* r, xi)_Q = <A(u) xi, r> to 1e-12 for random u, r, xi, with and without H^1_0."""
    model = CASES[name].model(q_dirichlet={"boundary": 0.0} if zero else None)
    rng = np.random.default_rng(1)
    for _ in range(5):
        u, r = rng.standard_normal((2, model.X.dim))
        xi = rng.standard_normal(model.Q.dim) * model.Q.free
        A = model.A(u)
        star = A.adjoint(r)
        assert np.all(star[model.Q.fixed] == 0.0)
        size = model.Q.norm(star) * model.Q.norm(xi)
        assert abs(model.Q.inner(star, xi) - A(xi) @ r) <= 1e-12 * size
        np.testing.assert_allclose(A.transposed(r), A.matrix.T @ r)


def test_gain_scales_the_adjoint():
    model = CASES["line Hermite"].model()
    rng = np.random.default_rng(2)
    u, r = rng.standard_normal((2, model.X.dim))
    A = model.A(u)
    Q = lp.spaces.HilbertSpace(model.Q.gram / 50.0, "Q", model.Q.fixed)
    scaled = lp.spaces.DualOperator(A.matrix, Q, model.X)
    np.testing.assert_allclose(scaled.adjoint(r), 50.0 * A.adjoint(r), rtol=1e-9)


def test_user_given_inner_product():
    def inner(u, v, x):
        return u * v + 0.01 * lp.dot(lp.grad(u), lp.grad(v))

    model = reaction(line(), ElementLineP1(), inner=inner)
    L2 = reaction(line(), ElementLineP1(), inner="L2").Q.gram
    H1 = reaction(line(), ElementLineP1(), inner="H1").Q.gram
    np.testing.assert_allclose(model.Q.gram.toarray(), (L2 + 0.01 * (H1 - L2)).toarray())


def test_std_divides_the_inner_product():
    mesh = line()
    field = lp.Field(mesh, ElementLineP1(), inner="H1", prior=lp.Normal(std=3.0))
    wide = lp.Model(lp.Field(mesh, ElementLineP1()), field, product)
    unit = reaction(mesh, ElementLineP1())
    np.testing.assert_allclose(9 * wide.Q.gram.toarray(), unit.Q.gram.toarray())


def test_singular_inner_product_is_one_sentence():
    model = reaction(line(), ElementLineP1(), inner=laplace)
    with pytest.raises(lp.errors.SpaceError, match="Gram matrix of Q is singular") as caught:
        _ = model.Q.factor
    assert "zero-order term" in str(caught.value)
    assert "\n" not in str(caught.value)
    # Fixed boundary values make the same inner product regular.
    check_space(
        reaction(line(), ElementLineP1(), inner=laplace, q_dirichlet={"boundary": 0.0}).Q
    ).raise_if_failed()


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_singularity_does_not_depend_on_units(scale):
    mesh = line(40)
    for inner, regular in (("H1", True), (laplace, False)):
        field = lp.Field(mesh, ElementLineHermite(), inner=inner, prior=lp.Normal(std=scale))
        model = lp.Model(lp.Field(mesh, ElementLineHermite()), field, product)
        assert check_space(model.Q).ok == regular


def test_indefinite_inner_products_are_refused():
    def negative(u, v, x):
        return -u * v

    def weak(u, v, x):  # its eigenvalue next to zero is positive
        return u * v - 0.01 * lp.dot(lp.grad(u), lp.grad(v))

    for inner in (negative, weak):
        with pytest.raises(lp.errors.SpaceError, match="not positive definite"):
            _ = reaction(line(30), ElementLineP1(), inner=inner).Q.factor


def test_bad_gram_matrices():
    with pytest.raises(lp.errors.SpaceError, match="square"):
        lp.spaces.HilbertSpace(sp.csr_array((2, 3)))
    with pytest.raises(lp.errors.SpaceError, match="not symmetric"):
        lp.spaces.HilbertSpace(sp.csr_array([[1.0, 0.5], [0.0, 1.0]]))
    with pytest.raises(lp.errors.SpaceError, match="not finite"):
        lp.spaces.HilbertSpace(sp.csr_array([[1.0, np.nan], [np.nan, 1.0]]))


def test_operator_must_fit_its_spaces():
    model = CASES["line P2 / P1"].model()
    A = model.A(np.ones(model.X.dim))
    with pytest.raises(lp.errors.SpaceError, match=r"shape \(25, 13\).*need \(13, 25\)"):
        lp.spaces.DualOperator(A.matrix, model.X, model.Q)


def test_norms_and_duals():
    model = CASES["triangles P2 / P1"].model()
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, model.Q.dim))
    assert model.Q.inner(x, y) == pytest.approx(model.Q.inner(y, x))
    assert model.Q.norm(x) ** 2 == pytest.approx(model.Q.inner(x, x))
    assert model.Q.dual(x) @ y == pytest.approx(model.Q.inner(x, y))
    block = rng.standard_normal((model.Q.dim, 3))
    columns = np.column_stack([model.Q.riesz(column) for column in block.T])
    np.testing.assert_allclose(model.Q.riesz(block), columns, atol=1e-12)


@pytest.mark.parametrize("name", ["line Hermite", "triangles P1", "quads Q1"])
def test_modes(name):
    """G-orthonormal, descending, and all of them sum to the inverse Gram matrix."""
    model = CASES[name].model(q_dirichlet={"boundary": 0.0})
    Q, mass = model.Q, model.parameter_mass
    count = int(Q.free.sum())
    phi, variance = Q.modes(count, mass)
    np.testing.assert_allclose(phi.T @ (Q.gram @ phi), np.eye(count), atol=1e-9)
    np.testing.assert_allclose(phi.T @ (mass @ phi), np.diag(variance), atol=1e-9)
    assert np.all(np.diff(variance) <= 1e-14)
    inverse = Q.riesz(np.eye(Q.dim))
    np.testing.assert_allclose(phi @ phi.T, inverse, atol=1e-9 * abs(inverse).max())
    few, few_variance = Q.modes(4, mass)
    np.testing.assert_allclose(few_variance, variance[:4], rtol=1e-8)
    assert few.shape == (Q.dim, 4)
    np.testing.assert_array_equal(few[Q.fixed], 0.0)


@pytest.mark.slow
def test_modes_of_a_large_space_are_those_of_a_dense_solver():
    model = reaction(MeshTri().refined(5), ElementTriP1())
    assert model.Q.dim > 400
    phi, variance = model.Q.modes(5, model.parameter_mass)
    again, _ = model.Q.modes(5, model.parameter_mass)
    np.testing.assert_array_equal(phi, again)
    from scipy.linalg import eigh

    dense = eigh(model.parameter_mass.toarray(), model.Q.gram.toarray(), eigvals_only=True)
    np.testing.assert_allclose(variance, dense[::-1][:5], rtol=1e-9)
    np.testing.assert_allclose(phi.T @ (model.Q.gram @ phi), np.eye(5), atol=1e-9)


@pytest.mark.parametrize("count", [0, 14])
def test_number_of_modes_must_exist(count):
    model = CASES["line P1"].model()
    with pytest.raises(lp.errors.SpaceError, match=f"13 free coefficients; got modes={count}"):
        model.Q.modes(count, model.parameter_mass)


def test_bad_unknowns():
    mesh, element = line(), ElementLineP1()
    with pytest.raises(lp.errors.SpaceError, match="expected 'L2', 'H1'"):
        lp.Field(mesh, element, inner="H3")
    with pytest.raises(lp.errors.SpaceError, match=r"no boundary 'top'.*'left'"):
        lp.Field(mesh, element, dirichlet={"top": 0.0})
    for std in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(lp.errors.SpaceError, match="std must be a positive number"):
            lp.Normal(std=std)
    with pytest.raises(lp.errors.SpaceError, match="lower < upper"):
        lp.Normal(bounds=(1.0, 1.0))
    with pytest.raises(lp.errors.SpaceError, match=r"mean 3\.0 is outside"):
        lp.Piecewise({"a": lambda x: x[0] < 1}, lp.Normal(3.0, bounds=(0.0, 2.0)))
    with pytest.raises(lp.errors.SpaceError, match="at least one region"):
        lp.Piecewise({}, lp.Normal())
    for bad in ((1.0, 0.0, 4), (0.0, 1.0, 0), (0.0, np.nan, 4)):
        with pytest.raises(lp.errors.SpaceError, match="needs stop > start and cells >= 1"):
            lp.interval(*bad)
    with pytest.raises(lp.errors.SpaceError, match="at least one unknown"):
        lp.Model(lp.Field(mesh, element), {}, product)
    with pytest.raises(lp.errors.SpaceError, match="'R b': the name must be a Python identifier"):
        lp.Model(lp.Field(mesh, element), {"R b": lp.Normal()}, product)


@pytest.mark.long
def test_prior_variances_are_the_diagonal_of_the_inverse():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (12, 12))
    for inner in ("H1", lp.Sobolev(2.0, 0.3), lp.Sobolev(1.5, 0.3)):
        unknown = {"q": lp.Field(mesh, lp.linear(mesh), inner=inner, prior=lp.Normal(std=2.0))}
        model = lp.Model(lp.Field(mesh, lp.linear(mesh)), unknown, A=lambda q, u, v, x: q.q * u * v)
        exact = np.diag(np.linalg.inv(model.Q.gram.toarray()))
        assert model.Q.variance == pytest.approx(exact)


@pytest.mark.long
def test_prior_variances_of_large_fields_are_interpolated(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(spaces, "SOLVED", 250)
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (24, 24))
    for inner in (lp.Sobolev(2.0, 0.3), lp.Sobolev(1.5, 0.3)):
        unknown = {"q": lp.Field(mesh, lp.linear(mesh), inner=inner, dirichlet={"left": 0.0})}
        model = lp.Model(lp.Field(mesh, lp.linear(mesh)), unknown, A=lambda q, u, v, x: q.q * u * v)
        exact = np.zeros(model.Q.dim)
        free = np.flatnonzero(model.Q.free)
        exact[free] = np.diag(np.linalg.inv(model.Q.gram.toarray()[np.ix_(free, free)]))
        found = model.Q.variance
        missed = np.abs(found - exact) / exact.max()
        assert missed.max() < 0.35  # at corners, where the variance has its peaks
        assert 0.0 < missed.mean() < 0.03
        assert abs(found.sum() / exact.sum() - 1.0) < 0.03
        assert (found[model.Q.fixed] == 0.0).all()


@pytest.mark.slow
def test_modes_and_total_variance_of_large_fields(monkeypatch: pytest.MonkeyPatch):
    model = reaction(MeshTri().refined(5), ElementTriP1(), q_dirichlet={"boundary": 0.0})
    Q, mass = model.Q, model.parameter_mass
    free = np.flatnonzero(Q.free)
    exact = np.zeros(Q.dim)
    exact[free] = np.diag(np.linalg.inv(Q.gram.toarray()[np.ix_(free, free)]))
    weights = mass.diagonal()
    phi, variance = Q.modes(12, mass)
    monkeypatch.setattr(spaces, "LARGE", 500)
    found, again = Q.modes(12, mass)
    np.testing.assert_allclose(again, variance, rtol=1e-7)
    np.testing.assert_allclose(found.T @ (Q.gram @ found), np.eye(12), atol=1e-9)
    for modes in (phi[:, :0], phi):
        held = weights @ (modes**2).sum(axis=1)
        rest = weights @ exact - held
        left = Q.spread(weights, modes) - held
        assert left != rest
        assert abs(left - rest) < 0.1 * rest
    assert Q.spread(weights, phi) == Q.spread(weights, phi)


@pytest.mark.slow
def test_fewer_variances_are_solved_for_in_larger_fields(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(spaces, "LARGE", 200)
    monkeypatch.setattr(spaces, "FEWEST_SOLVED", 10)
    monkeypatch.setattr(spaces, "SOLVED", 50)
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (24, 24))
    smooth = lp.Field(mesh, lp.linear(mesh), inner=lp.Sobolev(2.0, 0.3))
    model = lp.Model(lp.Field(mesh, lp.linear(mesh)), smooth, A=lambda q, u, v, x: q * u * v)
    exact = np.diag(np.linalg.inv(model.Q.gram.toarray()))
    same = np.isclose(model.Q.variance, exact, rtol=1e-9)
    assert 32 <= same.sum() < 40  # 2 * 50 * 200 // 625
    phi, _ = model.Q.modes(8, model.parameter_mass)
    left, held = model.Q.beyond(phi), (phi**2).sum(axis=1)
    assert np.abs(left + held - exact).mean() < 0.25 * np.abs(model.Q.variance - exact).mean()


@pytest.mark.slow
def test_large_well_conditioned_spaces_need_no_factor(monkeypatch: pytest.MonkeyPatch):
    def make():
        return reaction(MeshTri().refined(5), ElementTriP1(), q_dirichlet={"boundary": 0.0})

    direct = make()
    factors = direct.X.factor, direct.Q.factor
    monkeypatch.setattr(spaces, "LARGE", 500)
    found = make()
    b = np.random.default_rng(0).standard_normal((direct.X.dim, 3))
    for one, other in ((found.X, direct.X), (found.Q, direct.Q)):
        np.testing.assert_allclose(one.riesz(b), other.riesz(b), rtol=1e-8, atol=1e-9)
    assert type(found.X.factor) is not type(factors[0])  # L2
    assert type(found.Q.factor) is type(factors[1])  # H1
