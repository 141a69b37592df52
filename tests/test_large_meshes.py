"""Forms assembled by pieces or by elements on large meshes equal forms assembled at once."""

import factories
import numpy as np
import pytest
import scipy.sparse as sp
from factories import CASES, observe, reaction
from skfem import (
    ElementLineHermite,
    ElementQuad2,
    ElementTetP1,
    ElementTetP2,
    ElementTriP1,
    ElementTriP2,
    ElementVector,
    MeshQuad,
    MeshTet,
    MeshTri,
)

import livepde as lp
from livepde.diagnostics import Spaces, noise_size, reconstruction_matrix
from livepde.diagnostics.theory import error_bounds
from livepde.errors import ObservationError
from livepde.fem import Form, FunctionSpace, Moment, forms, measure
from livepde.laws import information
from livepde.observation import operator, reconstruction

SLOTS = [("v", "u"), ("v", "q"), ("q", "u"), ("q", "v"), ("u", "q"), ("u", "v")]


@pytest.fixture
def pieces(monkeypatch):
    """Return what makes all meshes large."""

    def large():
        monkeypatch.setattr(measure, "KEPT", 0)
        monkeypatch.setattr(measure, "PIECE", 23)

    return large


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def both(make, pieces):
    """Return what `make` makes of a small mesh, and of one that counts as large."""
    small = make()
    pieces()
    return small, make()


def triangles():
    mesh = MeshTri().refined(2).with_boundaries({"left": lambda x: x[0] == 0})
    return mesh.with_subdomains({"core": lambda x: x[0] < 0.5})


def quads():
    mesh = MeshQuad().refined(2)
    return MeshQuad(mesh.p + 0.05 * np.sin(7.0 * mesh.p[::-1]), mesh.t)  # no parallelograms


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_models_on_large_meshes(name, pieces):
    def make():
        return CASES[name].model(f=lambda x, t: np.exp(t * x[0]))

    small, large = both(make, pieces)
    rng = np.random.default_rng(0)
    u, r = rng.standard_normal((2, small.X.dim))
    q = rng.standard_normal(small.Q.dim)
    close(large.mass.toarray(), small.mass.toarray())
    close(large.Q.gram.toarray(), small.Q.gram.toarray())
    close(large.F(Moment(0.7)), small.F(Moment(0.7)))
    close(large.B(u), small.B(u))
    values = {"q": q, "u": u, "v": r}
    for rows, cols in (("v", "u"), ("v", "q"), ("q", "u")):
        found = large.form_A.matrix(rows, cols, **values).toarray()
        close(found, small.form_A.matrix(rows, cols, **values).toarray())
    close(large.initial(lambda x: np.exp(x[0])), small.initial(lambda x: np.exp(x[0])))


def nonlinear(mesh, element):
    def make():
        return lp.Model(
            lp.Field(mesh, element),
            {
                "a": lp.Field(mesh, element),
                "b": lp.Normal(1.0),
                "c": lp.Piecewise({"core": "core"}, lp.Normal()),
            },
            A=[
                lambda q, u, v, x: (x.h * q.a**2 + q.b * x.t) * u**2 * v + q.c * v,
                lp.On("left", lambda q, u, v, x: x.normal[0] * q.b * u**3 * v),
                lp.On("core", lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v))),
            ],
            B=lambda u, v, x: np.exp(-u) * v,
        )

    return make


@pytest.mark.slow
@pytest.mark.parametrize("element", [ElementTriP1(), ElementTriP2()])
def test_nonlinear_forms_with_boundaries_and_regions(element, pieces):
    small, large = both(nonlinear(triangles(), element), pieces)
    rng = np.random.default_rng(1)
    u, v = rng.standard_normal((2, small.X.dim))
    q = rng.standard_normal(small.Q.dim)
    at, values = Moment(0.3), {"q": q, "u": u, "v": v}
    assert large.form_A.uses == small.form_A.uses == {"t"}
    assert not large.form_A.linear_in_parameter
    for slots in [("v", "u"), ("v", "q"), ("q", "u"), ("u", "u"), ("q", "q")]:
        found = large.form_A.matrix(*slots, at, **values)
        close(found.toarray(), small.form_A.matrix(*slots, at, **values).toarray())
    del values["v"]
    close(large.form_A.vector("v", at, **values), small.form_A.vector("v", at, **values))


def test_an_integrand_that_is_nonlinear_in_a_corner_only(pieces):
    pieces()
    mesh = MeshTri().refined(4)

    def corner(u, v, x):
        return u * v + ((x[0] > 0.9) & (x[1] > 0.9)) * u**2 * v

    model = lp.Model(lp.Field(mesh, ElementTriP1()), lp.Normal(), lambda q, u, v, x: q * v, corner)
    assert not model.form_B.affine


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mesh", "state", "parameter"),
    [
        (MeshTri().refined(2), ElementTriP1(), ElementTriP1()),
        (MeshTri().refined(2), ElementTriP2(), ElementTriP1()),
        (quads(), ElementQuad2(), ElementQuad2()),
        (MeshTet().refined(1), ElementTetP2(), ElementTetP1()),
        (lp.interval(0, 1, 9), ElementLineHermite(), ElementLineHermite()),
    ],
)
def test_trilinear_forms_element_by_element(mesh, state, parameter, monkeypatch):
    def make():
        return lp.Model(
            lp.Field(mesh, state),
            lp.Field(mesh, parameter),
            A=lambda q, u, v, x: (1.0 + x[0]) * q * u * v + q * lp.dot(lp.grad(u), lp.grad(v)),
        ).form_A

    stored = make()
    sparse = {slots: stored.tensor(*slots) for slots in SLOTS}
    assert all(map(sp.issparse, sparse.values()))
    monkeypatch.setattr(forms, "LARGEST_TENSOR", 0)
    monkeypatch.setattr(measure, "KEPT", 0)
    monkeypatch.setattr(measure, "PIECE", 60)
    found = make()
    rng = np.random.default_rng(2)
    for rows, cols in SLOTS:
        (third,) = {"q", "u", "v"} - {rows, cols}
        w, x = (rng.standard_normal(found.spaces[key].dim) for key in (third, cols))
        T = found.tensor(rows, cols)
        assert not sp.issparse(T)
        close(T @ w, sparse[rows, cols] @ w)
        matrix = stored.matrix(rows, cols, **{third: w})
        close(T.apply(w, x), matrix @ x)
        close(found.product(rows, cols, x, **{third: w}), matrix @ x)


def test_an_unknown_that_the_equation_does_not_read(monkeypatch):
    """Only sensors do, as those with offsets: its tensors are all zero."""
    monkeypatch.setattr(forms, "LARGEST_TENSOR", 0)
    field = lp.Field(triangles(), ElementTriP1())
    form = lp.Model(field, lp.Normal(0.0), A=lambda q, u, v, x: 0.0 * q * u * v).form_A
    u, q = np.ones(form.spaces["u"].dim), np.ones(1)
    assert not form.vector("v", q=q, u=u).any()
    assert not form.matrix("v", "u", q=q).count_nonzero()
    assert not form.product("v", "u", u, q=q).any()


def test_forms_on_some_cells_add_up():
    mesh = triangles()
    space = FunctionSpace.of(lp.Field(mesh, ElementTriP2()), "u")
    terms = [
        lambda u, v, x: (1 + x[0]) * u**2 * v,
        lp.On("left", lambda u, v, x: x[1] * u * v),
        lp.On("core", lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v))),
    ]
    whole = Form("test", terms, {"u": space, "v": space}, mesh, 6, nonlinear="u")
    inner = np.flatnonzero(mesh.p[:, mesh.t].mean(axis=1)[1] < 0.4)
    outer = np.setdiff1d(np.arange(mesh.nelements), inner)
    u = np.random.default_rng(3).standard_normal(space.dim)
    parts = [whole.on(cells) for cells in (inner, outer)]
    close(sum(part.vector("v", u=u) for part in parts), whole.vector("v", u=u))
    matrices = [part.matrix("v", "u", u=u) for part in parts]
    close(sum(matrices).toarray(), whole.matrix("v", "u", u=u).toarray())
    assert matrices[0].nnz < whole.pattern("v", "u").nnz


def test_forms_on_cells_that_some_terms_do_not_have():
    """Of a form that is nonlinear in both arguments, with terms on parts of the mesh."""
    mesh = triangles()
    form = nonlinear(mesh, ElementTriP1())().form_A
    far = np.flatnonzero(mesh.p[0, mesh.t].min(axis=0) >= 0.5)
    parts = [form.on(cells) for cells in (far, np.setdiff1d(np.arange(mesh.nelements), far))]
    rng, at = np.random.default_rng(4), Moment(0.3)
    values = {key: rng.standard_normal(space.dim) for key, space in form.spaces.items()}
    assert [len(part.terms) for part in parts] == [1, 3]
    for slots in [("v", "u"), ("q", "u"), ("q", "v")]:
        found = sum(part.matrix(*slots, at, **values) for part in parts)
        close(found.toarray(), form.matrix(*slots, at, **values).toarray())
    assert not form.on(far[:0]).matrix("q", "u", at, **values).nnz


def test_vector_fields_and_points_on_large_meshes(pieces):
    mesh, element = triangles(), ElementVector(ElementTriP1())
    points = np.array([[0.31, 0.62, 0.9], [0.11, 0.43, 0.95]])

    def make():
        return FunctionSpace.of(lp.Field(mesh, element), "u").fields["u"]

    def twist(x):
        return np.array([x[1], -(x[0] ** 2)])

    small, large = both(make, pieces)
    close(large.interpolate(twist), small.interpolate(twist))
    close(large.probe(points).toarray(), small.basis.probes(points).toarray())
    close(large.doflocs, small.basis.doflocs)
    with pytest.raises(ObservationError, match=r"point 1 at \[1.5, 0.5\]"):
        large.probe(np.array([[0.5, 1.5], [0.5, 0.5]]))


def square(cells=12):
    return reaction(factories.square(cells), ElementTriP1(), f=lambda x, t: np.exp(-t) * x[0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "sensors"),
    [
        (
            lp.GradientLaw(10.0, newton=lp.stepping.Newton(tolerance=1e-11, share=0.0)),
            lp.Subdomain(lambda x: x[0] < 0.6),
        ),
        (
            # Where a search of the refit ends that does not converge depends on rounding.
            lp.SensitivityLaw(modes=4, noise=1e-3, refit=None, shadows=None),
            lp.Points([(0.3, 0.4), (0.7, 0.6)]),
        ),
    ],
)
def test_estimates_on_large_meshes(law, sensors, pieces, monkeypatch):
    def make():
        model = square()
        u = model.initial(lambda x: x[0] * (1 - x[0]) * x[1] * (1 - x[1]))
        identifier = lp.Identifier(model, sensors, law, q0=0.5, u0=u)
        G = identifier.observed.G
        for k in range(4):
            estimate = identifier.step(0.1 * k, (1.0 - 0.2 * k) * (G @ u))
            assert estimate.status.ok
        return estimate

    def large():
        pieces()
        monkeypatch.setattr(forms, "LARGEST_TENSOR", 0)

    small, found = both(make, large)
    np.testing.assert_allclose(found.u, small.u, rtol=0, atol=1e-8 * np.abs(small.u).max())
    np.testing.assert_allclose(found.q, small.q, rtol=0, atol=1e-7 * np.abs(small.q).max())


@pytest.mark.slow
def test_what_would_be_a_dense_matrix_of_a_field_is_refused(monkeypatch):
    model = square()
    averages = lp.Averages({"left": lambda x: x[0] < 0.5, "right": lambda x: x[0] >= 0.5})
    monkeypatch.setattr(information, "MOST_DENSE", 100)
    with pytest.raises(lp.errors.LawError, match="169 are too many, up to 100"):
        lp.Identifier(model, averages, lp.GradientLaw("auto"))
    lp.Identifier(model, lp.Full(), lp.GradientLaw("auto"))
    monkeypatch.setattr(operator, "LARGEST_PROJECTION", 10_000)
    with pytest.raises(ObservationError, match="169 rows with 121 entries each"):
        lp.Identifier(model, averages, lp.GradientLaw(1.0))
    lp.Identifier(model, averages, lp.SensitivityLaw(noise=0.1, modes=3))
    monkeypatch.setattr(reconstruction, "MOST_SENSORS", 100)
    smooth = lp.Full(reconstruction=lp.observation.Tikhonov("V", 0.1)).bind(
        model.state_space, model.X, model.parameter_space
    )
    with pytest.raises(ObservationError, match=r"121 sensors; .* up to 100"):
        smooth.reconstruct(np.ones(smooth.size))


def test_the_noise_of_many_sensors_is_sampled(monkeypatch):
    model = square(24)
    observed = observe(model, lp.Full())
    spaces = Spaces(model, observed)
    std = 0.01 * (1.0 + np.arange(observed.size) / observed.size)
    exact = noise_size(spaces, std)
    monkeypatch.setattr(error_bounds, "MOST_SENSORS", 100)
    found = noise_size(spaces, std)
    for name in ("X", "VX", "V"):
        assert getattr(found, name) == pytest.approx(getattr(exact, name), rel=0.03)
    assert found.X != exact.X
    monkeypatch.setattr(error_bounds, "MOST_COLUMNS", 100)
    with pytest.raises(lp.errors.ConfigurationError, match="529 sensors, up to 100"):
        reconstruction_matrix(observed)
