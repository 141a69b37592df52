"""R and P from the discrete null space of G, and sensor functions."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from factories import CASES, excited, excited_q, excited_u, few, line, observe, product, reaction
from skfem import ElementLineHermite, ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde.errors import ObservationError
from livepde.fem import START, Inputs, Moment
from livepde.models import heat
from livepde.streams import Twin


def inside(x):
    return (x[0] > 0.25) & (x[0] < 0.8)


def points(model, *fractions):
    return lp.Points([[f] + [0.3] * (model.state.mesh.dim() - 1) for f in fractions])


KINDS = {
    "subdomain": lambda model: lp.Subdomain(inside),
    "full": lambda model: lp.Full(),
    "points": lambda model: points(model, 0.3, 0.55, 0.7),
    "points repeated": lambda model: points(model, 0.3, 0.3, 0.7, 0.3),
    "points on the boundary": lambda model: points(model, 0.0, 0.4, 1.0),
    "averages": lambda model: lp.Averages({"in": inside, "all": lambda x: x[0] >= 0}),
    "matrix": lambda model: lp.observation.Matrix(
        np.random.default_rng(0).standard_normal((4, model.X.dim)), labels=list("abcd")
    ),
    "matrix repeated": lambda model: lp.observation.Matrix(
        sp.csr_array(np.vstack([np.eye(model.X.dim)[[1, 1]], np.ones((1, model.X.dim))]))
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name", "dirichlet"), few(24, KINDS, CASES, [True, False]))
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
        with pytest.raises(ObservationError, match=message):
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
    with pytest.raises(ObservationError, match="no sensor is called 'x'"):
        observe(model, lp.Points({"a": 0.5}, direct={"x": lambda q, x: q.k}))
    affine = observe(model, lp.Points({"a": 0.5}, direct={"a": lambda q, x: q.k + 1}))
    with pytest.raises(ObservationError, match=r"must be linear in q; at q = 0 it gives 1\.0"):
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
        with pytest.raises(ObservationError, match="values for 2 sensors"):
            _ = observe(model, lp.Points([0.2, 0.3], noise=noise)).noise
    for noise in (0.0, -1.0, np.nan, np.inf, [0.1, 0.0]):
        with pytest.raises(ObservationError, match="must be positive numbers"):
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
        (model, lambda: lp.Averages({"r": lambda x: x[0] > 2}), "region 'r' contains no part"),
        (model, lambda: lp.observation.Matrix(np.eye(5)), "5 columns; the state has 13"),
        (model, lambda: lp.observation.Matrix(np.eye(13), labels=["a"]), "1 labels for 13 rows"),
        (model, lambda: lp.observation.Matrix(np.full((1, 13), np.nan)), "not finite"),
        (model, lambda: lp.observation.Matrix(np.eye(13)[:2], labels=["a", "a"]), "must differ"),
        (model, lambda: lp.Subdomain("core"), "omega must be a function of x, .*; got 'core'"),  # type: ignore[arg-type]
        (model, lambda: lp.Subdomain(lambda x: x[0] > 30), "no element .* with a free coefficient"),
        (model, lambda: lp.Subdomain(lambda x: x[0] == 0), "no element .* with a free coefficient"),
    ]
    for owner, build, message in bad:
        with pytest.raises(ObservationError, match=message):
            observe(owner, build())


def test_an_observation_of_ones_own_must_fit():
    @dataclass(frozen=True, eq=False, kw_only=True)
    class Wrong(lp.observation.Observation):
        def matrix(self, state):
            return sp.eye_array(4)

    with pytest.raises(ObservationError, match="4 columns; the state has 13"):
        observe(reaction(line(), ElementLineP1()), Wrong())


RADIATION = (lambda T: T**4, lambda T: 4 * T**3)
THERMISTOR = (lambda T: np.exp(1 / (1 + T)), lambda T: -np.exp(1 / (1 + T)) / (1 + T) ** 2)
WAVE = (lambda T: np.sin(3 * T), lambda T: 3 * np.cos(3 * T))  # not monotone


def bound(function, derivative=None, base=None, **options):
    model = reaction(lp.interval(0.0, 1.0, 12), ElementLineP1(), dirichlet={})
    base = base or lp.Points([0.2, 0.5, 0.9])
    return observe(model, lp.observation.Transformed(base, function, derivative, **options))


@pytest.mark.parametrize("reading", [RADIATION, THERMISTOR, WAVE])
@pytest.mark.parametrize("given", [True, False])
def test_taylor(reading, given):
    """With the derivative given, and by a complex step."""
    observed = bound(reading[0], reading[1] if given else None)
    lp.diagnostics.check_observation(observed).raise_if_failed()
    u = 1.0 + 0.1 * np.random.default_rng(0).standard_normal(13)
    H_u, H_q = observed.jacobian(u, np.zeros(13), START)
    slope = reading[1](observed.G @ u)
    np.testing.assert_allclose(H_u.toarray(), slope[:, None] * observed.G.toarray(), rtol=1e-14)
    assert H_q is None


def test_a_wrong_derivative_is_found():
    report = lp.diagnostics.check_observation(bound(lambda T: T**4, lambda T: 3 * T**3))
    assert [line.name for line in report.lines if not line.ok] == ["G'(u) by differences"]
    with pytest.raises(ObservationError, match="must be that of function="):
        report.raise_if_failed()


def test_newton_step_is_of_second_order():
    """u_alpha is R u* up to the square of R (u^ - u*); for a linear g exactly G^+ z."""
    rng = np.random.default_rng(2)
    exact, direction = 1.0 + 0.2 * rng.uniform(-1, 1, 13), rng.uniform(-1, 1, 13)
    observed = bound(*RADIATION, iterations=1)
    split, zero = observed.split(), np.zeros(13)
    z = observed.predict(exact, zero, START)
    errors = []
    for size in (0.08, 0.04, 0.02):
        seen = observed.linearised(z, exact + size * direction)
        errors.append(np.abs(split.reconstruct(seen, zero) - split.R @ exact).max())
    assert np.all(np.log2(np.array(errors[:-1]) / errors[1:]) > 1.8)
    repeated = bound(*RADIATION).linearised(z, exact + 0.08 * direction)
    np.testing.assert_allclose(repeated, observed.G @ exact, rtol=1e-12)
    linear = bound(lambda T: 2 * T - 1)
    z = linear.predict(exact, zero, START)
    np.testing.assert_allclose(linear.linearised(z, direction), linear.G @ exact, atol=1e-14)
    plain = observe(reaction(lp.interval(0.0, 1.0, 12), ElementLineP1()), lp.Points([0.2]))
    assert plain.linearised(z, direction) is z
    assert plain.jacobian(direction, zero, START)[0] is plain.G


def test_insensitive_and_missing_sensors_say_nothing():
    observed = bound(lambda T: (T - 1) ** 2, lambda T: 2 * (T - 1), iterations=1)
    flat = np.ones(13)
    assert np.isnan(observed.linearised(np.array([1.0, 1.0, np.nan]), flat)).all()
    seen = observed.linearised(np.array([0.25, np.nan, 0.25]), 1.4 * flat)
    np.testing.assert_allclose(seen, [1.5125, np.nan, 1.5125])


def test_reach_bounds_the_newton_step():
    observed = bound(*RADIATION, reach=0.1, iterations=1)
    seen = observed.linearised(np.ones(3), np.full(13, 0.3))
    np.testing.assert_allclose(seen, 0.4)


def test_bad_sensors():
    for options, message in (
        ({"reach": 0}, "reach must be positive; got 0"),
        ({"iterations": 0}, "iterations must be at least 1; got 0"),
        ({"base": lp.Points([0.2], noise=0.1)}, "give noise= to it and not to its base"),
    ):
        with pytest.raises(ObservationError, match=message):
            bound(*RADIATION, **options)
    with pytest.raises(ObservationError, match=r"shape \(2,\) for values of shape \(3,\)"):
        bound(lambda T: T[:2]).predict(np.ones(13), np.zeros(13), START)


@pytest.mark.slow
@pytest.mark.parametrize("reading", [(lambda T: np.exp(T / 2), None), (lambda T: T, None)])
def test_gradient_law(reading):
    """With z = exp(u/2) it finds q as well as with z = u, and with g = id it is the same law."""
    model = excited(12, ElementLineP1())
    sensors = lp.observation.Transformed(lp.Full(), *reading)
    shared = {
        "model": model,
        "q_true": excited_q,
        "u_true": excited_u,
        "times": 0.05 * np.arange(201),
    }

    def error(observation):
        twin = Twin(observation=observation, **shared)
        law = lp.GradientLaw(gain=1000.0)
        start = {"q0": 0.0, "u0": lambda x: excited_u(x, 0.0)}
        return twin.error(lp.Identifier(model, observation, law, **start).run(twin).last.q)

    plain, found = error(lp.Full()), error(sensors)
    assert plain < 0.05
    assert found < 1.5 * plain
    if reading[0](2.0) == 2.0:
        assert found == pytest.approx(plain, rel=1e-6)


def test_a_calibration_that_does_more_than_to_add_is_found_out():
    model = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    for reading in (lambda y, q, x: 2.0 * y, lambda y, q, x: y + q.alpha**2):
        sensors = lp.observation.Calibrated(
            lp.Points({"a": 0.3, "b": 0.6}), reading, adds=True, noise=0.01
        )
        identifier = lp.Identifier(model, sensors, u0=1.0)
        with pytest.raises(ObservationError, match="adds=True, but function does more"):
            identifier.step(0.1, [0.9, 0.9])
