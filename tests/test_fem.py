"""Weak forms: matrices, vectors and derivatives against formulas; upwinding."""

import copy
import pickle

import numpy as np
import pytest
import scipy.sparse
import skfem
from factories import CASES, diffusion, laplace, line, observe, product, reaction
from scipy.sparse.linalg import spsolve
from skfem import (
    Basis,
    BilinearForm,
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementQuad1,
    ElementTriArgyris,
    ElementTriP1,
    ElementTriP2,
    ElementVector,
    FacetBasis,
    LinearForm,
    MeshLine,
    MeshQuad,
    MeshTri,
)
from skfem.helpers import dd, ddot, div, dot, grad

import livepde as lp
from livepde.errors import MissingInputError, ModelError, ObservationError, SpaceError
from livepde.fem import START, Form, FunctionSpace, Inputs, Moment, Place, upwind

ORDER = 6


def form(integrand, mesh, element, **options):
    space = FunctionSpace.of(lp.Field(mesh, element), "u")
    return Form("test", integrand, {"u": space, "v": space}, mesh, ORDER, **options)


def close(found, expected, tolerance=1e-12):
    found, expected = np.asarray(found.todense()), np.asarray(expected.todense())
    np.testing.assert_allclose(found, expected, atol=tolerance * abs(expected).max())


SMOOTH = ElementLineHermite()
BROKEN = MeshTri().refined(3).with_subdomains({"core": lambda x: x[0] < 0.5})
VECTOR = ElementVector(ElementTriP1())


def speed(u):
    """Return the derivative in a fixed direction."""
    return sum(k * part for k, part in enumerate(grad(u), 1))


@pytest.mark.parametrize(
    ("integrand", "mesh", "element", "where"),
    [
        *(
            (integrand, case.mesh(), case.state, None)
            for case in CASES.values()
            for integrand in (
                lambda u, v, x: u * v,
                lambda u, v, x: (1 + x[0]) * dot(grad(u), grad(v)),
                lambda u, v, x: speed(u) * v,
            )
        ),
        (lambda u, v, x: x[1] * u * v, BROKEN, ElementTriP1(), "core"),
        (lambda u, v, x: ddot(grad(u), grad(v)) + div(u) * v[0], BROKEN, VECTOR, None),
        (lambda u, v, x: ddot(dd(u), dd(v)), line(6), SMOOTH, None),
    ],
)
def test_matrices_are_those_of_scikit_fem(integrand, mesh, element, where):
    basis = Basis(mesh, element, intorder=ORDER, elements=where)
    expected = BilinearForm(lambda u, v, w: integrand(u, v, w.x)).assemble(basis)
    ours = form(lp.On(where, integrand) if where else integrand, mesh, element)
    # scikit-fem's own Hermite functions are exact to 1e-11 on a coarse mesh only.
    close(ours.matrix("v", "u"), expected, 1e-9 if type(element) is type(SMOOTH) else 1e-12)


@pytest.mark.parametrize(
    ("mesh", "element"),
    [
        (lp.interval(0, 1, 7), ElementLineP2()),
        (MeshTri().refined(2).with_boundaries({"left": lambda x: x[0] == 0}), ElementTriP2()),
    ],
)
def test_boundary_terms(mesh, element):
    facets = FacetBasis(mesh, element, facets="left", intorder=ORDER)
    mass = BilinearForm(lambda u, v, w: u * v).assemble(facets)
    close(form(lp.On("left", lambda u, v, x: u * v), mesh, element).matrix("v", "u"), mass)
    flux = BilinearForm(lambda u, v, w: dot(grad(u), w.n) * v).assemble(facets)
    ours = lp.On("left", lambda u, v, x: lp.dot(lp.grad(u), x.normal) * v)
    close(form(ours, mesh, element).matrix("v", "u"), flux)
    inner = BilinearForm(lambda u, v, w: u * v).assemble(Basis(mesh, element, intorder=ORDER))
    both = form([lambda u, v, x: u * v, ours], mesh, element)
    close(both.matrix("v", "u"), inner + flux)


def test_source_vector():
    mesh = MeshQuad().refined(2)
    element = skfem.ElementQuad2()
    model = reaction(mesh, element, dirichlet={}, f=lambda x, t: np.exp(x[0] * t) * x[1])
    basis = Basis(mesh, element, intorder=model.order)
    expected = LinearForm(lambda v, w: np.exp(w.x[0] * 0.7) * w.x[1] * v).assemble(basis)
    np.testing.assert_allclose(model.F(Moment(0.7)), expected, atol=1e-14)


def radius(x):
    return x[0]


def around_an_axis(**options):
    """Return a model in radius and height, written as in Cartesian coordinates."""
    mesh = MeshTri().refined(2).with_defaults()
    element = ElementTriP1()
    parts = {name: lp.Field(mesh, element, weight=radius) for name in ("a", "b")} | options
    return lp.Model(
        parts,
        {"k": lp.Normal(1.0, std=0.5)},
        A=[
            lambda q, u, v, x: q.k * (dot(grad(u.a), grad(v.a)) + (u.a - u.b) * (v.a - v.b)),
            lp.On("right", lambda q, u, v, x: q.k * u.a * v.a),
        ],
        f={"a": lambda x, t: x[1], "b": 2.0},
        initial=lambda q, v, x: q.k * v.a + x[0] * v.b,
    )


def test_all_integrals_have_the_volume_element_of_the_coordinates():
    model = around_an_axis()
    assert model.order == 4
    mesh, element = model.mesh, ElementTriP1()
    basis, wall = (
        kind(mesh, element, intorder=4, **where)
        for kind, where in ((Basis, {}), (FacetBasis, {"facets": mesh.boundaries["right"]}))
    )
    mass = BilinearForm(lambda u, v, w: w.x[0] * u * v)
    stiff = BilinearForm(lambda u, v, w: w.x[0] * dot(grad(u), grad(v))).assemble(basis)
    close(model.mass, scipy.sparse.kron(np.eye(2), mass.assemble(basis)))
    u = np.random.default_rng(0).standard_normal((2, basis.N))
    apart = mass.assemble(basis) @ (u[0] - u[1])
    left = stiff @ u[0] + apart + mass.assemble(wall) @ u[0]
    found = model.A(u.ravel()).matrix.toarray()[:, 0]
    np.testing.assert_allclose(found, np.concatenate([left, -apart]), atol=1e-13)
    sources = (lambda v, w: w.x[0] * w.x[1] * v, lambda v, w: 2.0 * w.x[0] * v)
    expected = [LinearForm(source).assemble(basis) for source in sources]
    np.testing.assert_allclose(model.F(START), np.concatenate(expected), atol=1e-14)
    start = model.initial_state(np.array([3.0]), START).reshape(2, -1)
    np.testing.assert_allclose(start, [np.full(basis.N, 3.0), mesh.p[0]], atol=1e-12)
    amounts = {"all": lambda q, u, x: u.b, "wall": lp.On("right", lambda q, u, x: u.b)}
    seen = observe(model, lp.observation.Functionals(amounts))
    assert seen.predict(start.ravel(), np.ones(1), START) == pytest.approx([1 / 3, 1.0])


@pytest.mark.parametrize(("power", "found"), [(0, []), (1, [1.0]), (2, [2.0])])
def test_a_factor_of_volume_in_the_terms_is_found(power, found):
    def layers(x):
        return 1.0 + (x[0] > 0.5)

    written = lp.Model(
        lp.Field(line(8), ElementLineP1(), quadrature=4),
        {"k": lp.Normal(1.0, std=0.5)},
        A=lambda q, u, v, x: q.k * x[0] ** power * dot(grad(u), grad(v)),
        M=lambda u, v, x: layers(x) * x[0] ** power * u * v,
    )
    assert [line.value for line in lp.diagnostics.check_model(written).failed] == found
    material = lp.Model(written.state, written.parameter, A=written.physical_A.terms[0].integrand)
    assert lp.diagnostics.check_model(material).ok


def test_an_invalid_volume_element_is_refused():
    mesh = MeshTri().refined(2).with_defaults()
    with pytest.raises(ModelError, match="must have one weight in common"):
        around_an_axis(
            a=lp.Field(mesh, ElementTriP1()), b=lp.Field(mesh, ElementTriP1(), weight=radius)
        )
    left = lp.Field(line(4), ElementLineP1(), weight=lambda x: x[0] - 0.5)
    with pytest.raises(ModelError, match="weight must be 0 or more at each vertex"):
        lp.Model(left, lp.Normal(), A=lambda q, u, v, x: q * u * v)
    both = lp.Field(line(4), ElementLineP1(), weight=radius)
    with pytest.raises(ModelError, match="weight is that of the state"):
        lp.Model(both, {"k": both}, A=lambda q, u, v, x: q.k * u * v)


def test_spaces_of_equal_size_are_not_confused():
    """Hermite elements and a product of two P1 fields both have 2 (n + 1) unknowns (fact 9)."""
    mesh = line(12)
    nodes, hermite = ElementLineP1(), ElementLineHermite()
    model = lp.Model(
        lp.Field(mesh, hermite),
        {"a": lp.Field(mesh, nodes), "b": lp.Field(mesh, nodes)},
        A=lambda q, u, v, x: (q.a + x[0] * q.b) * u * v,
    )
    assert model.X.dim == model.Q.dim
    rng = np.random.default_rng(0)
    q, u = rng.standard_normal((2, model.X.dim))
    basis_u = Basis(mesh, hermite, intorder=model.order)
    basis_q = basis_u.with_element(nodes)
    n = basis_q.N
    expected = LinearForm(lambda v, w: (w["a"] + w.x[0] * w["b"]) * w["u"] * v).assemble(
        basis_u,
        a=basis_q.interpolate(q[:n]),
        b=basis_q.interpolate(q[n:]),
        u=basis_u.interpolate(u),
    )
    np.testing.assert_allclose(model.A(u)(q), expected, atol=1e-9)
    swapped = model.form_A.vector("v", q=u, u=q)
    assert abs(swapped - expected).max() > abs(expected).max()  # swapping would be noticed


@pytest.mark.parametrize("span", [(0.0, 1.0, 30), (0.0, 1.0, 1000), (100.0, 101.0, 30)])
def test_hermite_functions_are_exact_far_from_the_origin(span):
    mesh = lp.interval(*span)
    start, stop, cells = span
    model = lp.Model(lp.Field(mesh, ElementLineHermite()), lp.Normal(), product)
    slope = 1.0 / (stop - start)
    u = model.initial(lambda x: (x[0] - start) * slope)
    nodes = (mesh.p[0] - start) * slope
    scale = np.tile([1.0, slope], cells + 1)
    np.testing.assert_allclose(
        u / scale, np.column_stack([nodes, 1 + 0 * nodes]).ravel(), atol=1e-9
    )
    row = model.state_block.probe(np.array([[stop]])).toarray()
    np.testing.assert_array_equal(np.flatnonzero(row), [2 * cells])
    mass = model.mass.toarray()
    h = (stop - start) / cells
    row = [9 / 70, 13 * h / 420, 26 / 35, 0, 9 / 70, -13 * h / 420]
    np.testing.assert_allclose(mass[2, :6] / h, row, atol=1e-12)


@pytest.mark.slow
def test_one_element_object_on_two_meshes():
    """scikit-fem's global elements remember their first mesh."""
    element, argyris = ElementLineHermite(), ElementTriArgyris()
    for cells in (30, 7, 12):
        mass = lp.Model(lp.Field(line(cells), element), lp.Normal(), product).mass
        fresh = lp.Model(lp.Field(line(cells), ElementLineHermite()), lp.Normal(), product).mass
        np.testing.assert_array_equal(mass.toarray(), fresh.toarray())
    for refined in (0, 1):
        mesh = MeshTri().refined(refined)
        kept = form(lambda u, v, x: u * v, mesh, argyris).matrix("v", "u")
        fresh = form(lambda u, v, x: u * v, mesh, ElementTriArgyris()).matrix("v", "u")
        np.testing.assert_array_equal(kept.toarray(), fresh.toarray())


def test_reversed_cells():
    """A mesh whose cells run from right to left has the same functions."""
    mesh = MeshLine(np.linspace(0, 1, 5), np.array([[1, 1, 3, 3], [0, 2, 2, 4]]))
    plain = MeshLine(np.linspace(0, 1, 5))
    for integrand in (laplace, lambda u, v, x: x[0] * u * v):
        np.testing.assert_allclose(
            form(integrand, mesh, ElementLineHermite()).matrix("v", "u").toarray(),
            form(integrand, plain, ElementLineHermite()).matrix("v", "u").toarray(),
            atol=1e-11,
        )


def nonlinear(**options):
    return reaction(
        line(8),
        ElementLineP2(),
        B=lambda u, v, x: (1 + u**2) * lp.dot(lp.grad(u), lp.grad(v)) + np.exp(-u) * v,
        **options,
    )


def test_complex_step_is_the_derivative_by_hand():
    by_hand = nonlinear(
        dB=lambda u, du, v, x: (
            (1 + u**2) * lp.dot(lp.grad(du), lp.grad(v))
            + 2 * u * du * lp.dot(lp.grad(u), lp.grad(v))
            - np.exp(-u) * du * v
        )
    )
    model = nonlinear()
    u = np.random.default_rng(4).standard_normal(model.X.dim)
    assert not model.form_B.affine
    close(model.form_B.matrix("v", "u", u=u), by_hand.form_B.matrix("v", "u", u=u), 1e-14)


@pytest.mark.parametrize("name", ["line Hermite", "triangles P2 / P1"])
def test_derivatives_of_a_trilinear_form(name):
    model = CASES[name].model(A=diffusion)
    rng = np.random.default_rng(5)
    u, du, r = rng.standard_normal((3, model.X.dim))
    q, dq = rng.standard_normal((2, model.Q.dim))
    form_A = model.form_A
    assert form_A.affine
    assert form_A.constant
    value = model.A(u)(q) @ r
    assert form_A.matrix("v", "u", q=q) @ u @ r == pytest.approx(value)
    assert form_A.matrix("q", "u", v=r) @ u @ q == pytest.approx(value)
    slope = form_A.matrix("q", "u", u=u, v=r) @ du @ dq
    assert slope == pytest.approx(model.A(du)(dq) @ r)
    # A tensor and, if it would be too large, quadrature give equal numbers.
    plain = form_A._quadrature("v", "q", START, {"u": u})
    np.testing.assert_allclose(form_A.data("v", "q", u=u), plain, atol=1e-10 * abs(plain).max())


def test_affine_and_constant_forms_are_detected():
    mesh, element = line(6), ElementLineP1()
    cases = {
        "linear": (lambda u, v, x: u * v, True, True),
        "affine": (lambda u, v, x: (u - 3.0) * v, True, True),
        "time": (lambda u, v, x: x.t * u * v, True, False),
        "square": (lambda u, v, x: u * u * v, False, True),
        "root": (lambda u, v, x: np.sqrt(u) * v, False, True),
        "exponential": (lambda u, v, x: np.exp(u) * v, False, True),
        "weak": (lambda u, v, x: (u + 1e-6 * u**3) * v, False, True),
    }
    for name, (integrand, affine, constant) in cases.items():
        found = form(integrand, mesh, element, nonlinear="u")
        assert (found.affine, found.constant) == (affine, constant), name


def test_affine_form_keeps_its_offset():
    model = reaction(line(6), ElementLineP1(), B=lambda u, v, x: 2.0 * (u - 3.0) * v)
    u = np.random.default_rng(7).standard_normal(model.X.dim)
    expected = 2.0 * model.mass @ (u - 3.0)
    np.testing.assert_allclose(model.B(u), expected, atol=1e-14)


def broken(u, v, x):
    raise KeyError("D")


@pytest.mark.parametrize(
    ("error", "message", "forms"),
    [
        (ModelError, r"Form B\(u, v, x\) failed.*KeyError: 'D'", {"B": broken}),
        (ModelError, r"scalar per point.*dot", {"B": lambda u, v, x: lp.grad(u) * v}),
        (ModelError, "one derivative for each of its 2", {"B": [laplace] * 2, "dB": [laplace]}),
        (ModelError, r"x\.normal exists on", {"B": lambda u, v, x: x.normal[0] * u * v}),
        (SpaceError, r"On\('top'.*names \['left', 'right'\]", {"B": lp.On("top", laplace)}),
        (MissingInputError, "Input channel 'Q' has", {"B": lambda u, v, x: x.inputs["Q"] * u * v}),
    ],
)
def test_a_failing_form_is_reported(error, message, forms):
    with pytest.raises(error, match=message):
        reaction(line(), ElementLineP1(), **forms)


def test_meshes_without_names_and_fields_on_two_meshes():
    with pytest.raises(SpaceError, match="the mesh names nothing"):
        reaction(MeshTri(), ElementTriP1(), B=lp.On("top", laplace))
    with pytest.raises(SpaceError, match="one mesh object"):
        lp.Model(lp.Field(line(), ElementLineP1()), lp.Field(line(), ElementLineP1()), product)


def test_piecewise_by_predicate_and_by_subdomain():
    mesh = lp.interval(0, 1, 10, regions={"top": lambda x: x[0] < 0.4})
    predicate = lp.Piecewise({"a": lambda x: x[0] < 0.4, "b": lambda x: x[0] >= 0.4}, lp.Normal())
    named = lp.Piecewise({"a": "top", "b": lambda x: x[0] >= 0.4}, lp.Normal())
    state = lp.Field(mesh, ElementLineP1())
    u = np.random.default_rng(8).standard_normal(11)
    both = [
        lp.Model(state, unknown, diffusion).A(u).matrix.toarray() for unknown in (predicate, named)
    ]
    np.testing.assert_array_equal(*both)
    together = lp.Model(state, lp.Normal(), diffusion).A(u).matrix.toarray()
    np.testing.assert_allclose(both[0].sum(axis=1, keepdims=True), together, atol=1e-13)

    On = lp.On("top", lambda q, u, v, x: q * u * v)
    part = lp.Model(state, named, On).A(u).matrix.toarray()
    assert abs(part[:, 0]).max() > 0
    np.testing.assert_array_equal(part[:, 1], 0.0)

    with pytest.raises(SpaceError, match="Region 'a': the mesh has no subdomain 'bottom'"):
        lp.Model(state, lp.Piecewise({"a": "bottom"}, lp.Normal()), diffusion)
    edge = lp.Model(state, named, lp.On("left", lambda q, u, v, x: q * u * v))
    assert edge.A(np.ones(edge.X.dim)).matrix.nnz


def test_product_of_unknowns():
    mesh = line(9)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        {
            "D": lp.Scalar(lp.Normal(2.0, std=0.5, bounds=(0.0, 9.0)), unit="m2/s"),
            "k": lp.Field(mesh, ElementLineP2(), inner="H1", prior=lp.Normal(1.5)),
            "R": lp.Piecewise(
                {"in": lambda x: x[0] < 0.5, "out": lambda x: x[0] >= 0.5}, lp.Normal()
            ),
        },
        A=lambda q, u, v, x: q.D * lp.dot(lp.grad(u), lp.grad(v)) + q.k * u * v + q.R * v,
    )
    space = model.parameter_space
    assert space.dim == 1 + 19 + 2
    assert space.labels == {"D": 0, "R[in]": 20, "R[out]": 21}
    q = model.initial_parameter({"R": [3.0, 4.0]})
    assert q[0] == 2.0
    np.testing.assert_allclose(q[1:20], 1.5, atol=1e-12)
    np.testing.assert_array_equal(q[20:], [3.0, 4.0])
    np.testing.assert_array_equal(model.initial_parameter({"R": 5.0})[20:], 5.0)
    np.testing.assert_array_equal(model.initial_parameter(q), q)
    assert model.Q.gram.toarray()[0, 0] == pytest.approx(1 / 0.5**2)
    lower, upper = model.latent.bounds
    assert (lower[0], upper[0], lower[5], upper[21]) == (0.0, 9.0, -np.inf, np.inf)
    u = model.initial(lambda x: x[0])
    regions = model.A(u)(q * (np.arange(22) > 19))
    stiffness = form(laplace, mesh, ElementLineP1()).matrix("v", "u")
    expected = 2 * (stiffness @ u) + 1.5 * model.mass @ u + regions
    np.testing.assert_allclose(model.A(u)(q), expected, atol=1e-12)
    for given, message in (
        ({"E": 1.0}, r"no unknown is called \['E'\]"),
        (np.zeros(3), r"coefficients of shape \(3,\); expected \(22,\)"),
        ({"R": [1.0, 2.0, 3.0]}, r"'R': coefficients of shape \(3,\); expected \(2,\)"),
    ):
        with pytest.raises(SpaceError, match=message):
            model.initial_parameter(given)


def test_interpolation_is_exact_in_the_space():
    for name, case in CASES.items():
        mesh = case.mesh()
        model = lp.Model(lp.Field(mesh, case.state), lp.Normal(), product)
        u = model.initial(lambda x: 1 + 2 * x[0])
        inside = np.full((mesh.dim(), 3), 0.2) + 0.1 * np.arange(3)
        values = model.state_block.probe(inside) @ u
        np.testing.assert_allclose(values, 1 + 2 * inside[0], atol=1e-11, err_msg=name)
        constant = model.state_block.at_vertices @ model.initial(4.0)
        np.testing.assert_allclose(constant, 4.0, atol=1e-11, err_msg=name)
        np.testing.assert_array_equal(model.initial(0.0), 0.0)


def test_probe_outside_of_the_mesh():
    ring = MeshTri().refined(3)
    ring = ring.restrict(
        ring.elements_satisfying(lambda x: (x[0] - 0.5) ** 2 + (x[1] - 0.5) ** 2 > 0.06)
    )
    block = lp.Model(lp.Field(ring, ElementTriP1()), lp.Normal(), product).state_block
    for points, message in (
        ([[0.1, 0.5], [0.1, 0.5]], r"point 1 at \[0.5, 0.5\] lies outside"),
        ([[1.5], [0.5]], r"point 0 at \[1.5, 0.5\].*unit"),
        ([[0.5]], "coordinates of dimension 1; the mesh has 2"),
    ):
        with pytest.raises(ObservationError, match=message):
            block.probe(np.array(points))


def test_place():
    place = Place(np.zeros((2, 3, 4)), None, START)
    assert place[1].shape == (3, 4)
    assert place.used == set()
    assert place.t == 0.0
    assert len(place.inputs) == 0
    assert place.used == {"t", "inputs"}


def test_inputs_of_a_moment_never_change_and_name_what_is_missing():
    inputs = Inputs({"T": 1.0, "Q": 2.0})
    changes = (
        lambda: inputs.__setitem__("T", 3.0),
        lambda: inputs.__delitem__("T"),
        lambda: inputs.update(T=3.0),
        lambda: inputs.setdefault("R", 3.0),
        lambda: inputs.pop("T"),
        inputs.popitem,
        inputs.clear,
        lambda: inputs.__ior__({"T": 3.0}),
    )
    for change in changes:
        with pytest.raises(TypeError, match="never change"):
            change()
    assert inputs == {"T": 1.0, "Q": 2.0}
    for other in (copy.deepcopy(inputs), pickle.loads(pickle.dumps(inputs)), Inputs(inputs)):
        assert isinstance(other, Inputs)
        assert other == inputs
    with pytest.raises(MissingInputError, match="'R' has no value; channels with one: Q, T"):
        inputs["R"]


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
    s, steep = mesh.p[0], b / kappa
    exact = np.expm1(steep * s) / np.expm1(steep) if steep < 500 else np.exp(steep * (s - 1))
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
