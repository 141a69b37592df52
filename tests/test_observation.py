"""R and P from the discrete null space of G: projections to rounding, whatever the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from factories import CASES, line, observe, product, reaction
from skfem import ElementLineHermite, ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde.fem import Inputs, Moment


def inside(x):
    return (x[0] > 0.25) & (x[0] < 0.8)


def points(dim, fractions=(0.3, 0.55, 0.7)):
    return [[f] + [0.3] * (dim - 1) for f in fractions]


KINDS = {
    "subdomain": lambda model: lp.Subdomain(inside),
    "full": lambda model: lp.Full(),
    "points": lambda model: lp.Points(points(model.state.mesh.dim())),
    "points repeated": lambda model: lp.Points(
        points(model.state.mesh.dim(), (0.3, 0.3, 0.7, 0.3))
    ),
    "points on the boundary": lambda model: lp.Points(
        points(model.state.mesh.dim(), (0.0, 0.4, 1.0))
    ),
    "averages": lambda model: lp.Averages({"in": inside, "all": lambda x: x[0] >= 0}),
    "matrix": lambda model: lp.observation.Matrix(
        np.random.default_rng(0).standard_normal((4, model.X.dim)), labels=list("abcd")
    ),
    "matrix repeated": lambda model: lp.observation.Matrix(
        sp.csr_array(np.vstack([np.eye(model.X.dim)[[1, 1]], np.ones((1, model.X.dim))]))
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dirichlet", [True, False])
def test_projections(kind, name, dirichlet):
    """P P = P, R R = R, G P = 0, ... to 1e-12, for every element and every kind of sensor."""
    model = CASES[name].model(dirichlet=None if dirichlet else {})
    lp.diagnostics.check_observation(KINDS[kind](model), model).raise_if_failed()


@dataclass(frozen=True, eq=False, kw_only=True)
class Nodal(lp.observation.Matrix):
    """A matrix whose inverse is taken in coefficients."""

    @property
    def nodal(self) -> bool:
        return True


@pytest.mark.parametrize("G", [np.eye(13)[[2, 2, 5]], 2.0 * np.eye(13)[[2]], np.ones((2, 13))])
def test_nodal_matrices_that_select_nothing(G):
    model = reaction(line(), ElementLineP1())
    observed = observe(model, Nodal(G=G))
    lp.diagnostics.check_observation(observed).raise_if_failed()
    tangent = G * model.X.free
    np.testing.assert_allclose(
        observed.split().inverse.toarray(), np.linalg.pinv(tangent), atol=1e-14
    )


@pytest.mark.parametrize("distance", [1e-1, 1e-3, 1e-4, 1e-5])
def test_sensors_that_nearly_repeat_each_other(distance):
    model = reaction(line(30), ElementLineHermite())
    lp.diagnostics.check_observation(lp.Points([0.5, 0.5 + distance, 0.9]), model).raise_if_failed()


def test_inverse_is_the_moore_penrose_inverse_in_X():
    """R u is the element closest to u, in X, among those that vanish where G does not look."""
    model = reaction(line(), ElementLineP1(), dirichlet={})
    observed = observe(model, lp.Points([0.21, 0.64]))
    split = observed.split()
    G, M = observed.G.toarray(), model.mass.toarray()
    expected = np.linalg.solve(M, G.T) @ np.linalg.inv(G @ np.linalg.solve(M, G.T))
    np.testing.assert_allclose(split.inverse.toarray(), expected, atol=1e-12)
    u = np.random.default_rng(1).standard_normal(13)
    assert model.X.inner(split.R @ u, split.P @ u) == pytest.approx(0.0, abs=1e-14)


def test_subdomain_selects_the_elements_in_omega_with_the_nodes_on_their_ends():
    model = reaction(line(10), ElementLineHermite())
    sensors = lp.Subdomain(inside)
    observed = observe(model, sensors)
    np.testing.assert_array_equal(sensors.elements(model.state_block), [3, 4, 5, 6, 7])
    assert observed.size == 12  # values and slopes at 0.3, 0.4, ..., 0.8
    np.testing.assert_array_equal(observed.split().R.diagonal().nonzero()[0], np.arange(6, 18))
    np.testing.assert_array_equal(observed.split().omega, [3, 4, 5, 6, 7])
    full = observe(model, lp.Full())
    assert full.size == 22 - 2
    np.testing.assert_array_equal(full.split().P.diagonal().nonzero()[0], [0, 20])
    assert full.split().omega is None  # integrals over all of the domain


@pytest.mark.parametrize("cells", [16, 31, 61])
def test_omega_begins_and_ends_at_nodes_that_the_mesh_is_given(cells):
    """u|_omega with both ends: 0.3 and 0.87 are seen, and nothing beyond."""
    mesh = lp.interval(0.0, 1.0, cells, through=(0.3, 0.87))
    model = reaction(mesh, ElementLineP1())
    observed = observe(model, lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87)))
    seen = np.sort(observed.G @ mesh.p[0])
    assert (seen[0], seen[-1]) == (0.3, 0.87)
    nodes = np.sort(mesh.p[0])
    np.testing.assert_array_equal(seen, nodes[(nodes >= 0.3) & (nodes <= 0.87)])
    split = observed.split()
    ends = mesh.p[0][mesh.t[:, split.omega]]
    assert (ends.min(), ends.max()) == (0.3, 0.87)
    assert np.ptp(ends, axis=0).sum() == pytest.approx(0.57)


def test_an_element_that_omega_cuts_is_left_out():
    model = reaction(line(10), ElementLineP1())
    cut = observe(model, lp.Subdomain(lambda x: (x[0] > 0.35) & (x[0] < 0.81)))
    fits = observe(model, lp.Subdomain(lambda x: (x[0] > 0.4) & (x[0] < 0.8)))
    np.testing.assert_array_equal(cut.G.toarray(), fits.G.toarray())
    np.testing.assert_array_equal(cut.split().omega, fits.split().omega)


@pytest.mark.parametrize("name", CASES)
def test_omega_is_where_the_observed_coefficients_give_all_of_the_state(name):
    """w = u_alpha + P u is known there: no function that the sensors do not see reaches it."""
    model = CASES[name].model()
    sensors = lp.Subdomain(inside)
    split = observe(model, sensors).split()
    omega = np.arange(model.mesh.nelements) if split.omega is None else split.omega
    # Next to the Dirichlet boundary the data may give all of the state beyond omega: no part of it.
    assert set(sensors.elements(model.state_block)) == set(omega)
    on_omega = model.form_M.on(omega).matrix("v", "u")
    hidden = sp.diags_array(model.X.free) @ split.P
    assert abs(on_omega @ hidden).max() == 0.0


def test_sensors_that_fail_shrink_omega():
    model = reaction(line(10), ElementLineP1())
    observed = observe(model, lp.Subdomain(inside))
    present = np.ones(observed.size, dtype=bool)
    present[2] = False  # the node at 0.5
    np.testing.assert_array_equal(observed.split(present).omega, [3, 6, 7])
    assert len(observed.split(np.zeros(observed.size, dtype=bool)).omega) == 0


def test_omega_of_one_component_is_where_that_one_is_known():
    mesh, field = line(10), ElementLineP1()
    model = lp.Model(
        {"a": lp.Field(mesh, field), "b": lp.Field(mesh, field)},
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * u.a * v.b,
    )
    one = observe(model, lp.Subdomain(inside, of="a")).split()
    combined = observe(model, lp.Combined([lp.Subdomain(inside, of="a")])).split()
    np.testing.assert_array_equal(one.omega, [3, 4, 5, 6, 7])
    np.testing.assert_array_equal(combined.omega, [3, 4, 5, 6, 7])
    mixed = lp.Combined([lp.Subdomain(inside, of="a"), lp.Points({"far": 0.93}, of="b")])
    assert observe(model, mixed).split().omega is None  # of points there is no omega


def test_regions_that_are_none_are_refused_in_a_sentence():
    bad = [
        ([lambda x: x[0] < 0.5], "expected a mapping, sensor name -> predicate .*; got \\[<func"),
        (lambda x: x[0] < 0.5, "expected a mapping, sensor name -> predicate .*; got <func"),
        (0.5, r"as in Averages\({'core': lambda x: x\[0\] < 0\.1}\); got 0\.5"),
        ({"core": (0.1, 0.2)}, r"'core': \(0\.1, 0\.2\) is not a region; expected the name of a"),
        ({"core": None}, "'core': None is not a region"),
        ({3: "left"}, "3: 'left' is not a region"),
        ({}, "at least one region"),
    ]
    for regions, message in bad:
        with pytest.raises(lp.errors.ObservationError, match=message):
            lp.Averages(regions)


def test_missing_samples_shrink_G():
    model = reaction(line(), ElementLineP1())
    observed = observe(model, lp.Points({"a": 0.2, "b": 0.5, "c": 0.5}))
    present = np.array([True, False, True])
    split = observed.split(present)
    alone = observe(model, lp.Points([0.2, 0.5])).split()
    np.testing.assert_array_equal(split.R.toarray(), alone.R.toarray())
    z = np.array([1.0, np.nan, 2.0])
    rebuilt = split.reconstruct(z, np.zeros(13))
    np.testing.assert_allclose(observed.G @ rebuilt, [1.0, 2.0, 2.0], atol=1e-12)
    # Repeated sensors are averaged.
    both = observed.split().reconstruct(np.array([1.0, 2.0, 4.0]), np.zeros(13))
    np.testing.assert_allclose(observed.G @ both, [1.0, 3.0, 3.0], atol=1e-12)
    nothing = observed.split(np.zeros(3, dtype=bool))
    assert nothing.R.nnz == 0
    np.testing.assert_array_equal(nothing.P.toarray(), np.eye(13))
    np.testing.assert_array_equal(nothing.reconstruct(np.full(3, np.nan), np.zeros(13)), 0.0)


def test_known_boundary_values_are_taken_from_the_samples():
    model = reaction(line(10), ElementLineP1(), dirichlet={"boundary": 5.0})
    observed = observe(model, lp.Points([0.02, 0.5]))  # the first sees mostly the boundary
    u = model.initial(lambda x: 5 + np.sin(np.pi * x[0]))
    boundary = model.impose(np.zeros(11), Moment())
    split = observed.split()
    rebuilt = split.reconstruct(observed.G @ u, boundary)
    np.testing.assert_allclose(rebuilt, split.R @ u, atol=1e-12)
    assert rebuilt[0] == 0.0


@pytest.mark.slow
def test_splits_are_kept_but_not_without_end():
    model = reaction(line(), ElementLineP1())
    observed = observe(model, lp.Full())
    assert observed.split() is observed.split(np.ones(observed.size, dtype=bool))
    for k in range(300):
        present = (k >> np.arange(observed.size) % 9) & 1 == 1
        observed.split(present)
    assert len(observed._splits) <= 64


def borehole():
    return lp.Model(
        lp.Field(line(10), ElementLineP1(), dirichlet={}),
        {"k": lp.Normal(2.0), "R": lp.Piecewise({"a": inside, "b": inside}, lp.Normal())},
        A=lambda q, u, v, x: q.k * u * v,
        inputs=["Q"],
    )


def test_sensors_that_see_the_parameter():
    model = borehole()
    direct = {"fluid": lambda q, x: q.k * x.inputs["Q"] - q.R[1]}
    observed = observe(model, lp.Points({"wall": 0.3, "fluid": 0.0}, direct=direct))
    moment = Moment(0.0, Inputs({"Q": 4.0}))
    u, q = np.arange(11.0), np.array([2.0, 7.0, 1.0])
    G, direct = observed.jacobian(u, q, moment)
    np.testing.assert_array_equal(direct, [[0, 0, 0], [4, 0, -1]])
    assert G is observed.G
    assert not observed.linear
    np.testing.assert_allclose(observed.predict(u, q, moment), [3.0, 0.0 + 8.0 - 1.0], atol=1e-12)
    assert observe(model, lp.Points([0.3])).jacobian(u, q, moment)[1] is None

    single = lp.Model(lp.Field(line(10), ElementLineP1()), lp.Normal(), product)
    seen = observe(single, lp.Points({"s": 0.5}, direct={"s": lambda q, x: 3 * q}))
    np.testing.assert_array_equal(seen.jacobian(u, q[:1], moment)[1], [[3.0]])


def test_direct_parts_are_checked():
    model = borehole()
    with pytest.raises(lp.errors.ObservationError, match="no sensor is called 'x'"):
        observe(model, lp.Points({"a": 0.5}, direct={"x": lambda q, x: q.k}))
    affine = observe(model, lp.Points({"a": 0.5}, direct={"a": lambda q, x: q.k + 1}))
    with pytest.raises(
        lp.errors.ObservationError, match=r"must be linear in q; at q = 0 it gives 1\.0"
    ):
        affine.predict(np.zeros(11), np.zeros(3), Moment())


def test_names_and_noise():
    model = reaction(line(), ElementLineP1())
    named = observe(model, lp.Points({"a": 0.2, "b": 0.3}, noise=0.5, unit="K"))
    assert named.names == ("a", "b")
    np.testing.assert_array_equal(named.noise, [0.5, 0.5])
    each = observe(model, lp.observation.Matrix(np.eye(13)[:2], noise=[0.1, 0.2]))
    assert each.names == ("z0", "z1")
    np.testing.assert_array_equal(each.noise, [0.1, 0.2])
    assert observe(model, lp.Full()).noise is None
    for noise in ([0.1, 0.2, 0.3], [[0.1]]):
        with pytest.raises(lp.errors.ObservationError, match="values for 2 sensors"):
            _ = observe(model, lp.Points([0.2, 0.3], noise=noise)).noise
    for noise in (0.0, -1.0, np.nan, np.inf, [0.1, 0.0]):
        with pytest.raises(lp.errors.ObservationError, match="must be positive numbers"):
            _ = observe(model, lp.Points([0.2, 0.3], noise=noise)).noise


def test_sensors_that_do_not_fit():
    model = reaction(line(), ElementLineP1())
    plane = reaction(MeshTri().refined(2), ElementTriP1())
    bad = [
        (model, lambda: lp.Points([]), "at least one position"),
        (model, lambda: lp.Points([0.2, 1.2]), r"sensor 1 at \[1\.2\] lies outside.*unit"),
        (model, lambda: lp.Points({"T": -3.0}), r"sensors \['T'\]: number 0 at"),
        (model, lambda: lp.Points([[0.2, 0.3]]), "dimension 2; the mesh has 1"),
        (plane, lambda: lp.Points([[0.2, np.nan]]), "lies outside"),
        (model, lambda: lp.Averages({}), "at least one region"),
        (model, lambda: lp.Averages({"r": lambda x: x[0] > 2}), "region 'r' contains no part"),
        (model, lambda: lp.observation.Matrix(np.eye(5)), "5 columns; the state has 13"),
        (model, lambda: lp.observation.Matrix(np.eye(13), labels=["a"]), "1 labels for 13 rows"),
        (model, lambda: lp.observation.Matrix(np.full((1, 13), np.nan)), "not finite"),
        (model, lambda: lp.observation.Matrix(np.eye(13)[:2], labels=["a", "a"]), "must differ"),
        (
            model,
            lambda: lp.Subdomain(lambda x: x[0] > 30),
            "no element of the mesh with a free coefficient",
        ),
        (
            model,
            lambda: lp.Subdomain(lambda x: x[0] == 0),
            "no element of the mesh with a free coefficient",
        ),
    ]
    for owner, build, message in bad:
        with pytest.raises(lp.errors.ObservationError, match=message):
            observe(owner, build())


def test_an_observation_of_ones_own_must_fit():
    @dataclass(frozen=True, eq=False, kw_only=True)
    class Wrong(lp.observation.Observation):
        def matrix(self, state):
            return sp.eye_array(4)

    with pytest.raises(lp.errors.ObservationError, match="4 columns; the state has 13"):
        observe(reaction(line(), ElementLineP1()), Wrong())
