"""Hilbert spaces: Gram matrix, Riesz map, modes, operators with adjoints; H^s."""

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp
from factories import CASES, excited, excited_q, excited_u, few, laplace, line, product, reaction
from skfem import ElementLineHermite, ElementLineP1, ElementQuadBFS, ElementTriP1, MeshTri

import livepde as lp
from livepde import spaces
from livepde.diagnostics import check_space
from livepde.errors import SpaceError
from livepde.fem.sobolev import _balakrishnan
from livepde.linalg import Leading
from livepde.spaces import BorderedSpace, HilbertSpace
from livepde.streams import Twin


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


def test_user_given_inner_product():
    def inner(u, v, x):
        return u * v + 0.01 * lp.dot(lp.grad(u), lp.grad(v))

    model = reaction(line(), ElementLineP1(), inner=inner)
    L2 = reaction(line(), ElementLineP1(), inner="L2").Q.gram
    H1 = reaction(line(), ElementLineP1(), inner="H1").Q.gram
    np.testing.assert_allclose(model.Q.gram.toarray(), (L2 + 0.01 * (H1 - L2)).toarray())


@pytest.mark.parametrize("inner", ["H1", lp.Sobolev(1.5, 0.3)])
def test_std_divides_the_inner_product(inner):
    mesh = line()
    field = lp.Field(mesh, ElementLineP1(), inner=inner, prior=lp.Normal(std=3.0))
    wide = lp.Model(lp.Field(mesh, ElementLineP1()), field, product)
    unit = reaction(mesh, ElementLineP1(), inner=inner)
    np.testing.assert_allclose(9 * wide.Q.gram.toarray(), unit.Q.gram.toarray(), rtol=1e-9)


def test_a_singular_inner_product_is_refused_with_one_sentence():
    model = reaction(line(), ElementLineP1(), inner=laplace)
    with pytest.raises(SpaceError, match="Gram matrix of Q is singular") as caught:
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
        with pytest.raises(SpaceError, match="not positive definite"):
            _ = reaction(line(30), ElementLineP1(), inner=inner).Q.factor


def test_operator_must_fit_its_spaces():
    model = CASES["line P2 / P1"].model()
    A = model.A(np.ones(model.X.dim))
    with pytest.raises(SpaceError, match=r"shape \(25, 13\).*need \(13, 25\)"):
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
    """Modes are G-orthonormal and descending, and all modes sum to the inverse Gram matrix."""
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
    with pytest.raises(SpaceError, match=f"13 free coefficients; got modes={count}"):
        model.Q.modes(count, model.parameter_mass)


def field(**options):
    return lp.Field(line(), ElementLineP1(), **options)


NOT_FINITE = [[1.0, np.nan], [np.nan, 1.0]]


@pytest.mark.parametrize(
    ("message", "make"),
    [
        ("expected 'L2', 'H1'", lambda: field(inner="H3")),
        (r"no boundary 'top'.*'left'", lambda: field(dirichlet={"top": 0.0})),
        ("lower < upper", lambda: lp.Normal(bounds=(1.0, 1.0))),
        (r"mean 3\.0 is outside", lambda: lp.Normal(3.0, bounds=(0.0, 2.0))),
        ("at least one region", lambda: lp.Piecewise({}, lp.Normal())),
        ("at least one unknown", lambda: lp.Model(field(), {}, product)),
        ("'R b': the name must", lambda: lp.Model(field(), {"R b": lp.Normal()}, product)),
        ("square", lambda: HilbertSpace(sp.csr_array((2, 3)))),
        ("not symmetric", lambda: HilbertSpace(sp.csr_array([[1.0, 0.5], [0.0, 1.0]]))),
        ("not finite", lambda: HilbertSpace(sp.csr_array(NOT_FINITE))),
        ("not symmetric", lambda: BorderedSpace(sp.csr_array(NOT_FINITE), 1)),
        *(
            ("std must be a positive number", lambda std=std: lp.Normal(std=std))
            for std in (0.0, -1.0, np.inf, np.nan)
        ),
        *(
            ("needs stop > start and cells >= 1", lambda bad=bad: lp.interval(*bad))
            for bad in ((1.0, 0.0, 4), (0.0, 1.0, 0), (0.0, np.nan, 4))
        ),
        *(
            ("the order s must be a number >= 0", lambda s=s: lp.Sobolev(s))
            for s in (-1.0, np.nan, np.inf)
        ),
        *(
            ("length must be a positive number", lambda length=length: lp.Sobolev(1.0, length))
            for length in (0.0, np.nan)
        ),
    ],
)
def test_invalid_spaces_and_priors_are_refused(message, make):
    with pytest.raises(SpaceError, match=message):
        make()


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


LENGTH = 0.3
ORDERS = (0.3, 0.75, 1.25, 1.5, 2.0, 2.5, 3.0)


@pytest.mark.parametrize("sigma", [0.02, 0.3, 0.5, 0.7, 0.98])
@pytest.mark.parametrize("largest", [1e1, 1e4, 1e7])
def test_balakrishnan(sigma, largest):
    """All weights and poles positive, relative error below 1e-3, at most 15 poles."""
    c, weights, poles = _balakrishnan(sigma, largest)
    assert c > 0
    assert min(weights.min(), poles.min()) > 0
    assert len(poles) <= 15
    x = np.geomspace(1.0, largest, 300)
    power = c + (weights * x[:, None] / (x[:, None] + poles)).sum(axis=1)
    np.testing.assert_allclose(power, x**sigma, rtol=1e-3)


ELEMENTS = ["line P1", "line P2 / P1", "triangles P1", "quads Q1", "tets P1"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "zero", "s"), few(14, ELEMENTS, [False, True], ORDERS))
def test_gram_is_the_spectral_power(name, zero, s):
    """G = M (M^-1 K)^s on the free coefficients: exact for whole s, to 1e-3 for others."""
    options = {"q_dirichlet": {"boundary": 0.0}} if zero else {}
    model = CASES[name].model(inner=lp.Sobolev(s, LENGTH), **options)
    Q = model.Q
    free = np.flatnonzero(Q.free)
    K = CASES[name].model(inner=lp.Sobolev(1.0, LENGTH)).Q.gram.toarray()[np.ix_(free, free)]
    M = model.parameter_mass.toarray()[np.ix_(free, free)]
    values, V = sl.eigh(K, M)
    exact = M @ V @ np.diag(values**s) @ V.T @ M
    ratios = sl.eigh(Q.gram.toarray()[np.ix_(free, free)], exact, eigvals_only=True)
    np.testing.assert_allclose(ratios, 1.0, rtol=1e-7 if s == int(s) else 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "s"), few(14, CASES, [0.0, 0.75, 1.0, 1.75, 2.0]))
def test_spaces_pass_their_check(name, s):
    for zero in ({}, {"boundary": 0.0}):
        model = CASES[name].model(inner=lp.Sobolev(s, LENGTH), q_dirichlet=zero)
        lp.diagnostics.check_space(model.Q).raise_if_failed()
        np.testing.assert_array_equal(model.Q.riesz(np.ones(model.Q.dim))[model.Q.fixed], 0.0)


@pytest.mark.parametrize("zero", [{}, {"boundary": 0.0}])
def test_riesz_map_of_a_large_space_of_second_order_is_two_solves(zero, monkeypatch):
    Q = CASES["triangles P1"].model(inner=lp.Sobolev(2.0, LENGTH), q_dirichlet=zero).Q
    functional = np.random.default_rng(0).standard_normal((Q.dim, 3))
    expected = Q.riesz(functional)
    monkeypatch.setattr(spaces, "LARGEST_EXPLICIT", 1)
    large = BorderedSpace(Q.border, Q.dim, Q.name, Q.fixed)
    assert isinstance(Q.factor, Leading)
    assert not isinstance(large.factor, Leading)
    found = large.riesz(functional)
    np.testing.assert_allclose(found, expected, atol=1e-10 * abs(expected).max())
    free = functional * Q.free[:, None]
    np.testing.assert_allclose(Q.free[:, None] * large.dual(found), free, atol=1e-8)


@pytest.mark.slow
def test_names_of_orders():
    """inner="L2" and "H1" are orders 0 and 1; "H2" is order 2, a sparse form on C^1 elements."""
    for name, s in (("L2", 0.0), ("H1", 1.0), ("H2", 2.0)):
        one, two = (CASES["line P1"].model(inner=inner).Q for inner in (name, lp.Sobolev(s)))
        np.testing.assert_allclose(one.gram.toarray(), two.gram.toarray(), rtol=1e-12)
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (3, 3))
    for model in (
        reaction(line(), ElementLineHermite(), inner="H2"),
        reaction(mesh, ElementQuadBFS(), inner="H2"),
    ):
        assert not isinstance(model.Q, BorderedSpace)
        lp.diagnostics.check_space(model.Q).raise_if_failed()
    q = model.parameter_space.interpolate(lambda x: x[0] ** 2 * x[1])
    # u^2 + 2 |grad u|^2 + |hess u|^2 for u = x^2 y
    grad = 4 / 9 + 1 / 5
    hess = 4 * (1 / 3) + 2 * 4 * (1 / 3)
    assert model.Q.norm(q) ** 2 == pytest.approx(1 / 15 + 2 * grad + hess)


def test_products_with_other_unknowns():
    """In a product of H^1.5, a number and H^1, each block keeps its inner product."""
    mesh, element = line(), ElementLineP1()
    parts = {
        "a": lp.Field(mesh, element, inner=lp.Sobolev(1.5, LENGTH), dirichlet={"left": 0.0}),
        "k": lp.Normal(std=0.5),
        "b": lp.Field(mesh, element, inner="H1"),
    }
    model = lp.Model(lp.Field(mesh, element), parts, A=lambda q, u, v, x: (q.a + q.b + q.k) * u * v)
    lp.diagnostics.check_space(model.Q).raise_if_failed()
    gram, part = model.Q.gram.toarray(), model.parameter_space.part
    alone = lp.Model(lp.Field(mesh, element), parts["a"], product).Q
    np.testing.assert_allclose(gram[part("a"), part("a")], alone.gram.toarray(), rtol=1e-9)
    assert gram[part("k"), part("k")] == pytest.approx(4.0)
    np.testing.assert_allclose(gram[part("a"), part("b")], 0.0, atol=1e-12)
    block = model.parameter_space.fields["a"]
    restricted = model.Q.restricted(part("a"), block.fixed)
    phi, variance = restricted.modes(3, model.parameter_mass[part("a"), part("a")])
    expected, same = alone.modes(3, model.parameter_mass[part("a"), part("a")])
    np.testing.assert_allclose(variance, same, rtol=1e-9)
    np.testing.assert_allclose(phi, expected, atol=1e-7)
    assert not isinstance(model.Q.restricted(part("b"), np.zeros(0, int)), BorderedSpace)
    sensors = lp.Points([0.3, 0.7], noise=0.01)
    work = lp.SensitivityLaw(modes=3).prepare(
        lp.Identifier(model, sensors, lp.GradientLaw()).problem
    )
    Phi = work.filter.reduction.Phi
    np.testing.assert_allclose(Phi.T @ gram @ Phi, np.eye(7), atol=1e-8)


@pytest.mark.long
def test_modes_of_a_large_space_are_powers_of_those_of_H1(monkeypatch):
    """H^s has the modes of H^1 with variances to the power s, without assembling matrices."""
    monkeypatch.setattr(spaces, "LARGEST_EXPLICIT", 1000)
    mesh, element = MeshTri().refined(5), ElementTriP1()
    one, two = (
        lp.Model(lp.Field(mesh, element), lp.Field(mesh, element, inner=inner), product)
        for inner in (lp.Sobolev(1.0, LENGTH), lp.Sobolev(1.5, LENGTH))
    )
    assert two.Q.dim > spaces.LARGEST_EXPLICIT
    _, first = one.Q.modes(4, one.parameter_mass)
    phi, power = two.Q.modes(4, two.parameter_mass)
    np.testing.assert_allclose(power, first**1.5, rtol=1e-3)
    np.testing.assert_allclose(phi.T @ two.Q.dual(phi), np.eye(4), atol=1e-7)
    with pytest.raises(SpaceError, match="is dense and has 1089 rows; it is written out up to"):
        _ = two.Q.gram


@pytest.mark.slow
@pytest.mark.parametrize("s", [0.75, 1.5, 2.0])
def test_the_coupled_stage_with_a_border_is_that_with_the_gram_written_out(s):
    """The auxiliary unknowns change the linear algebra, not the result."""
    model = excited(10, ElementLineP1(), inner=lp.Sobolev(s, LENGTH))
    plain = excited(10, ElementLineP1())
    plain.__dict__["Q"] = lp.spaces.HilbertSpace(model.Q.gram, "Q", model.Q.fixed)
    found = []
    for one in (model, plain):
        twin = Twin(
            scheme=lp.ImplicitEuler(),
            model=one,
            observation=lp.Full(),
            q_true=excited_q,
            u_true=excited_u,
            times=0.1 * np.arange(11),
        )
        strict = lp.stepping.Newton(tolerance=1e-10, share=0.0)
        law = lp.GradientLaw(gain=100.0, sigma=0.01, newton=strict)
        start = {"q0": 0.0, "u0": lambda x: excited_u(x, 0.0)}
        found.append(lp.Identifier(one, lp.Full(), law, **start).run(twin).last)
    np.testing.assert_allclose(found[0].q, found[1].q, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(found[0].u, found[1].u, atol=1e-7)


@pytest.mark.parametrize(
    ("mesh", "s"),
    [
        (lp.interval(0.0, 1.0, 60), 1),
        (lp.interval(0.0, 1.0, 60), 2),
        (lp.rectangle((0.0, 1.0), (0.0, 1.0), (30, 30)), 2),
    ],
)
def test_the_prior_deviation_is_that_at_a_point(mesh, s):
    inner = lp.Sobolev(s, length=0.1).pointwise(len(mesh.p))
    field = lp.Field(mesh, lp.linear(mesh), inner=inner, prior=lp.Normal(std=0.7))
    model = lp.Model(lp.Field(mesh, lp.linear(mesh)), field, A=lambda q, u, v, x: q * u * v)
    centre = np.argmin(np.abs(mesh.p - 0.5).sum(axis=0))
    unit = np.zeros(model.Q.dim)
    unit[centre] = 1.0
    assert np.sqrt(model.Q.riesz(unit)[centre]) == pytest.approx(0.7, rel=0.05)
    with pytest.raises(SpaceError, match="take a larger s"):
        lp.Sobolev(s).pointwise(2 * s)
