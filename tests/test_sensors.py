"""Sensors of every kind: exact values for polynomials, derivatives, and what they identify."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from factories import observe, short_rod
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from skfem import (
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementQuad1,
    ElementTetP1,
    ElementTriP2,
    MeshTri,
)

import livepde as lp
from livepde import cases
from livepde.errors import ObservationError
from livepde.fem import Inputs, Moment, box

REGIONS = {"core": lambda x: x[0] < 0.5}
PLANE = MeshTri.init_tensor(np.linspace(0, 1, 6), np.linspace(0, 1, 5)).with_boundaries(
    {"right": lambda x: np.isclose(x[0], 1.0), "top": lambda x: np.isclose(x[1], 1.0)}
)


def rod(cells=10, element=None, **unknowns):
    unknowns = unknowns or {"k": lp.Normal(2.0, std=0.5)}
    return lp.Model(
        lp.Field(lp.interval(0.0, 1.0, cells, regions=REGIONS), element or ElementLineP2()),
        unknowns,
        A=lambda q, u, v, x: next(iter(vars(q).values())) * lp.dot(lp.grad(u), lp.grad(v)),
    )


def plate(element=None, mesh=PLANE):
    return lp.Model(
        lp.Field(mesh, element or ElementTriP2()),
        {"k": lp.Normal(2.0, std=0.5)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )


def at(t=0.0, **inputs):
    return Moment(t, Inputs(inputs))


def read(model, sensors, u, q=None, moment=None):
    observed = observe(model, sensors)
    q = model.initial_parameter(q)
    return observed.predict(model.state_space.interpolate(u), q, moment or at())


def test_averages_over_named_parts_and_boundaries():
    sensors = lp.Averages({"core": "core", "end": "right", "where": lambda x: x[0] > 0.5})
    z = read(rod(), sensors, lambda x: 3 * x[0] ** 2)
    np.testing.assert_allclose(z, [0.25, 3.0, 1.75], rtol=1e-12)
    z = read(plate(), lp.Averages({"r": "right", "t": "top"}), lambda x: x[0] ** 2 + 3 * x[1] ** 2)
    np.testing.assert_allclose(z, [2.0, 1 / 3 + 3.0], rtol=1e-12)
    with pytest.raises(ObservationError, match=r"region 'a' is 'nowhere'; the mesh names"):
        observe(rod(), lp.Averages({"a": "nowhere"}))


@pytest.mark.parametrize(("low", "high"), [(0.26, 0.42), (0.3, 0.36), (0.34, 0.36), (0.05, 0.93)])
def test_averages_over_regions_whose_border_crosses_cells(low, high):
    """Against the exact mean over an interval, and over a square of rectangles and triangles."""

    def between(*x):
        return np.logical_and.reduce([(low < one) & (one < high) for one in x])

    means = {"mean": lambda x: between(x[0])}
    z = read(rod(), lp.Averages(means), lambda x: x[0])
    np.testing.assert_allclose(z, (low + high) / 2, atol=1e-3)  # cells are 0.1 long
    squares = {"mean": lambda x: between(x[0], x[1])}
    rectangles = plate(ElementQuad1(), lp.rectangle((0, 1), (0, 1), (10, 10)))
    for owner in (rectangles, plate()):
        z = read(owner, lp.Averages(squares), lambda x: x[0] - 2 * x[1])
        np.testing.assert_allclose(z, -(low + high) / 2, atol=0.01)


@pytest.mark.parametrize("mean", [True, False])
def test_line_integrals_are_exact(mean):
    lines = {"a": (0.13, 0.77), "whole": (1.0, 0.0)}
    z = read(
        rod(element=ElementLineHermite()),
        lp.observation.LineIntegrals(lines, mean),
        lambda x: x[0] ** 3,
    )
    exact = np.array([(0.77**4 - 0.13**4) / 4, 0.25])
    np.testing.assert_allclose(z, exact / [0.64, 1.0] if mean else exact, rtol=1e-11)

    a, b = np.array([0.1, 0.05]), np.array([0.9, 0.8])
    z = read(plate(), lp.observation.LineIntegrals({"beam": (a, b)}, mean), lambda x: x[0] * x[1])
    s = np.polynomial.Polynomial
    average = (s([a[0], b[0] - a[0]]) * s([a[1], b[1] - a[1]])).integ()(1.0)
    length = np.linalg.norm(b - a)
    np.testing.assert_allclose(z, average if mean else average * length, rtol=1e-12)


def test_line_integrals_follow_kinks_from_cell_to_cell():
    """A function with random values at the nodes of P1 elements, against a fine sum."""
    model = rod(7, ElementLineP1())
    u = np.random.default_rng(0).standard_normal(8)
    x = np.linspace(0.05, 0.93, 200_001)
    exact = trapezoid(np.interp(x, model.state.mesh.p[0], u), x)
    G = observe(model, lp.observation.LineIntegrals({"a": (0.05, 0.93)})).G
    assert (G @ u)[0] == pytest.approx(exact, abs=1e-8)
    for owner, ends in (
        (plate(), ([0.03, 0.9], [0.95, 0.2])),
        (plate(ElementQuad1(), lp.rectangle((0, 1), (0, 1), (4, 3))), ([0.1, 0.1], [0.9, 0.8])),
        (
            plate(ElementTetP1(), box((0, 1), (0, 1), (0, 1), (2, 2, 2))),
            ([0.1] * 3, [0.9, 0.4, 0.6]),
        ),
    ):
        block, (a, b) = owner.state_block, np.array(ends)
        u = np.random.default_rng(1).standard_normal(block.size)
        s = (np.arange(4000) + 0.5) / 4000
        fine = (block.probe(a[:, None] + (b - a)[:, None] * s) @ u).mean()
        found = observe(owner, lp.observation.LineIntegrals({"a": ends}, mean=True)).G @ u
        assert found[0] == pytest.approx(fine, abs=1e-5)


def test_bad_lines():
    with pytest.raises(ObservationError, match="line 'a' has no length"):
        observe(rod(), lp.observation.LineIntegrals({"a": (0.2, 0.2)}))
    with pytest.raises(ObservationError, match=r"line 'a': point .* lies outside the mesh"):
        observe(rod(), lp.observation.LineIntegrals({"a": (0.2, 1.2)}))
    with pytest.raises(ObservationError, match="the mesh has 1 coordinates"):
        observe(rod(), lp.observation.LineIntegrals({"a": ([0.2, 0.1], [0.3, 0.1])}))


def test_functionals_are_integrals_of_forms():
    flux = lp.On("right", lambda q, u, x: -q.k * lp.dot(lp.grad(u), x.normal))
    sensors = lp.observation.Functionals(
        {
            "flux": flux,
            "energy": lambda q, u, x: q.k * u**2 / 2,
            "heat": lp.On("core", lambda q, u, x: x.inputs["c"] * u + x.t),
        },
        inputs=("c",),
    )
    z = read(rod(), sensors, lambda x: x[0] ** 2, moment=at(3.0, c=6.0))
    np.testing.assert_allclose(z, [-4.0, 0.2, 6.0 / 24 + 1.5], rtol=1e-12)
    observed = observe(rod(), sensors)
    assert (observed.names, observed.linear) == (("flux", "energy", "heat"), False)
    H_u, H_q = observed.jacobian(np.ones(21), np.array([2.0]), at(3.0, c=6.0))
    assert H_u.shape == (3, 21)
    np.testing.assert_allclose(H_u.sum(axis=1), [0.0, 2.0, 3.0], atol=1e-11)
    np.testing.assert_allclose(H_q, [[0.0], [0.5], [0.0]], atol=1e-12)
    with pytest.raises(ObservationError, match=r"no matrix G .* use SensitivityLaw"):
        observed.split()
    with pytest.raises(ObservationError, match=r"sensor 'bad'.*failed at its first evaluation"):
        observe(rod(), lp.observation.Functionals({"bad": lambda q, u, x: q.nothing * u}))


def test_functionals_of_fields_and_single_unknowns():
    field = lp.Field(lp.interval(0.0, 1.0, 5), ElementLineP1(), prior=lp.Normal(1.0))
    model = lp.Model(lp.Field(field.mesh, ElementLineP2()), field, A=lambda q, u, v, x: q * u * v)
    z = read(
        model,
        lp.observation.Functionals({"z": lambda q, u, x: q**2 * u}),
        lambda x: x[0],
        lambda x: x[0],
    )
    np.testing.assert_allclose(z, [0.25], rtol=1e-12)


def test_moving_sensors():
    sensors = lp.observation.Moving({"probe": "x", "other": "y"}, noise=0.1)
    assert sensors.inputs == ("x", "y")
    observed, u = observe(rod(), sensors), rod().state_space.interpolate(lambda x: x[0] ** 2)
    for moment, expected in (
        (at(x=0.3, y=0.55), [0.09, 0.3025]),
        (at(x=0.3, y=1.01), [0.09, np.nan]),
        (at(x=np.nan, y=1.0), [np.nan, 1.0]),
        (at(y=0.5), [np.nan, 0.25]),
        (at(), [np.nan, np.nan]),
    ):
        np.testing.assert_allclose(observed.predict(u, np.ones(1), moment), expected, atol=1e-14)
        seen = observed.available(moment)
        np.testing.assert_array_equal(seen, np.isfinite(expected))
        H, direct = observed.jacobian(u, np.ones(1), moment)
        np.testing.assert_allclose((H @ u)[seen], np.array(expected)[seen], atol=1e-14)
        assert direct is None
    scan = lp.observation.Moving({"s": ("x", "y")})
    z = read(plate(), scan, lambda x: x[0] * x[1], moment=at(x=0.31, y=0.72))
    np.testing.assert_allclose(z, [0.31 * 0.72], rtol=1e-12)
    with pytest.raises(ObservationError, match=r"position channels .*'x'.*has 2 coordinates"):
        observe(plate(), lp.observation.Moving({"s": "x"}))


def test_combined_sensors():
    parts = [
        lp.Points({"a": 0.3}, noise=0.1),
        lp.Averages({"b": "core", "c": "right"}, noise=0.5),
        lp.observation.Moving({"d": "x"}, noise=0.2),
    ]
    observed = observe(rod(), lp.Combined(parts))
    assert observed.names == ("a", "b", "c", "d")
    assert observed.observation.inputs == ("x",)
    np.testing.assert_array_equal(observed.noise, [0.1, 0.5, 0.5, 0.2])
    np.testing.assert_array_equal(observed.available(at()), [True, True, True, False])
    z = read(rod(), lp.Combined(parts), lambda x: x[0], moment=at(x=0.7))
    np.testing.assert_allclose(z, [0.3, 0.25, 1.0, 0.7], rtol=1e-12)
    assert not observed.linear
    linear = observe(rod(), lp.Combined(parts[:2]))
    assert linear.linear
    lp.diagnostics.check_observation(linear).raise_if_failed()
    np.testing.assert_array_equal(observe(rod(), lp.Combined([lp.Full()], noise=2.0)).noise, 2.0)
    with pytest.raises(ObservationError, match="names must differ"):
        observe(rod(), lp.Combined([lp.Points({"a": 0.3}), lp.Points({"a": 0.4})]))
    with pytest.raises(ObservationError, match="not to both"):
        lp.Combined(parts, noise=1.0)
    with pytest.raises(ObservationError, match="at least one"):
        lp.Combined([])


def gained(y, q, x):
    return q.gain * y + q.R[0] * x.inputs["Q"] * y**2


CALIBRATION = {"gain": lp.Normal(1.2), "R": lp.Piecewise({"a": "core"}, lp.Normal(0.5))}


def test_calibrated_sensors():
    model = rod(**{**CALIBRATION, "R": lp.Piecewise({"a": "core", "b": "core"}, lp.Normal(0.5))})
    sensors = lp.observation.Calibrated(lp.Points([0.3, 0.6]), gained, inputs=("Q",), noise=0.1)
    z = read(model, sensors, lambda x: x[0], moment=at(Q=2.0))
    np.testing.assert_allclose(z, [0.36 + 0.09, 0.72 + 0.36], rtol=1e-12)
    observed = observe(model, sensors)
    H_u, H_q = observed.jacobian(
        model.state_space.interpolate(1.0), model.initial_parameter(), at(Q=2.0)
    )
    np.testing.assert_allclose(H_u.sum(axis=1), [1.2 + 2.0] * 2, rtol=1e-12)
    np.testing.assert_allclose(H_q, [[1.0, 2.0, 0.0]] * 2, rtol=1e-12)
    moving = lp.observation.Calibrated(
        lp.observation.Moving({"m": "x", "n": "y"}), lambda y, q, x: q.gain * y.mean() + y
    )
    seen = observe(model, moving)
    assert not seen.available(at(x=0.5)).any()  # the mean of both needs both
    moving = lp.observation.Calibrated(
        lp.observation.Moving({"m": "x", "n": "y"}), lambda y, q, x: q.gain * y
    )
    seen = observe(model, moving)
    np.testing.assert_array_equal(seen.available(at(x=0.5)), [True, False])
    H_u, H_q = seen.jacobian(np.ones(21), model.initial_parameter(), at(x=0.5))
    np.testing.assert_allclose(H_u.sum(axis=1), [1.2, 0.0], rtol=1e-12)
    np.testing.assert_allclose(H_q, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], rtol=1e-12)
    with pytest.raises(ObservationError, match="give noise= to it and not to its base"):
        lp.observation.Calibrated(lp.Points([0.3], noise=1.0), gained)
    with pytest.raises(ObservationError, match=r"shape \(\) for 2 sensors"):
        read(model, lp.observation.Calibrated(lp.Points([0.3, 0.4]), lambda y, q, x: y.sum()), 0.0)


def test_the_gradient_law_names_the_other_one():
    model = rod()
    for sensors in (
        lp.observation.Moving({"m": "x"}),
        lp.observation.Functionals({"f": lambda q, u, x: u}),
        lp.observation.Calibrated(lp.Points([0.3]), lambda y, q, x: q.k * y),
        lp.Points({"a": 0.3}, {"a": lambda q, x: q.k}),
        lp.Combined([lp.Points([0.3]), lp.observation.Moving({"m": "x"})]),
    ):
        with pytest.raises(lp.errors.LawError, match="use SensitivityLaw"):
            lp.Identifier(model, sensors, lp.GradientLaw())


inside = st.floats(0.01, 0.99)
anything = st.floats(-3.0, 3.0)


EVERY_CLASS = {
    item
    for item in (getattr(lp.observation, name) for name in lp.observation.__all__)
    if isinstance(item, type)
    and issubclass(item, lp.observation.Observation)
    and item is not lp.observation.Observation
}


@st.composite
def sensors_of_any_kind(draw):
    """Every class of sensors, with random positions, weights, gains and powers."""
    a, b, c = draw(inside), draw(inside), draw(anything)
    power = draw(st.integers(1, 4))
    base = [
        lp.Points([a]),
        lp.Points({"p": a}, {"p": lambda q, x: c * q.gain - x.inputs["x"] * q.R}, inputs=("x",)),
        lp.Averages({"A": "core", "B": "left", "C": lambda x: x[0] > 0.4}),
        lp.observation.LineIntegrals(
            {"l": (a, b + 1e-3 if a == b else b)}, mean=draw(st.booleans())
        ),
        lp.observation.Functionals(
            {
                "f": lambda q, u, x: c * q.gain**2 * u**power * x[0] + q.R / q.gain * x.inputs["x"],
                "g": lp.On("left", lambda q, u, x: -q.R * lp.dot(lp.grad(u), x.normal) * x.t),
            },
            inputs=("x",),
        ),
        lp.observation.FluxPlates({"e": "left", "i": a}, "gain"),
        lp.observation.Slow(lp.Points([a]), 0.1 * power),
        lp.observation.Moving({"m": "x", "n": "missing"}),
        lp.observation.Transformed(
            lp.Points({"t": a}, {"t": lambda q, x: 0.1 * q.gain}), lambda y: y + np.exp(c * y / 2)
        ),
        lp.Full(),
        lp.Subdomain(lambda x: x[0] > 0.8 * a),
        lp.observation.Matrix(np.random.default_rng(power).standard_normal((3, 13)) + c),
    ]
    both = lp.Combined([base[k] for k in (1, 2, 3, 4, 5, 6, 7, 8)])
    base += [
        both,
        lp.observation.Calibrated(
            both, lambda y, q, x: q.gain * y + c * q.R * x.inputs["x"] * y[0] * y**2
        ),
    ]
    assert {type(sensor) for sensor in base} == EVERY_CLASS
    return draw(st.sampled_from(base))


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(sensors=sensors_of_any_kind(), position=inside, seed=st.integers(0, 2**31))
def test_any_sensor_passes_the_checks(sensors, position, seed):
    model = rod(6, **CALIBRATION)
    inputs = {name: position for name in ("x",) if name in sensors.inputs}
    inputs |= {name: 2.0 for name in ("missing",) if name in sensors.inputs}  # outside
    lp.diagnostics.check_observation(sensors, model, seed=seed, inputs=inputs).raise_if_failed()


def test_a_wrong_jacobian_is_found():
    class Wrong(type(observe(rod(), lp.Points([0.3])))):
        def jacobian(self, u, q, moment):
            return 1.01 * self.G, np.ones((1, 1))

    model = rod()
    wrong = Wrong(lp.Points([0.3]), model.state_space, model.X, model.parameter_space)
    failed = [line.name for line in lp.diagnostics.check_observation(wrong).lines if not line.ok]
    assert failed == ["G'(u) by differences", "G'(q) by differences"]


def heated(**more):
    """A rod heated at its left end by a channel, cooled at its right end."""
    return lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 20), ElementLineP1(), dirichlet={"right": 0.0}),
        {"k": lp.Normal(1.0, std=0.5, bounds=(0.05, 10.0)), **more},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        f=[0.0, lp.On("left", lambda x, t: 1.0 + np.sin(3 * t))],
    )


@pytest.mark.slow
def test_positions_are_inputs_that_may_be_missing(tmp_path):
    model, law = heated(), lp.SensitivityLaw()
    sensors = lp.Combined(
        [
            lp.observation.Moving({"T": "x"}, noise=0.01),
            lp.observation.Functionals(
                {"Q": lambda q, u, x: x.inputs["c"] * u}, inputs=("c",), noise=0.01
            ),
        ]
    )
    assert sensors.inputs == ("x", "c")
    assert sensors.optional == {"x"}
    identifier = lp.Identifier(model, sensors, law)
    assert identifier.channels == ("T", "Q", "x", "c")
    with pytest.raises(lp.errors.MissingInputError, match="No estimate before the first sample"):
        identifier.estimate()
    with pytest.raises(
        lp.errors.MissingInputError, match=r"input 'c' has no value.*all of \['c'\]"
    ):
        identifier.step(0.0, {"T": 0.0})
    identifier.step(0.0, {"T": 0.0, "c": 1.0})
    estimate = identifier.step(0.1, {"T": 5.0, "Q": np.nan})
    assert estimate.held == ("c",)
    assert np.isnan(estimate.innovation).all()
    assert estimate.q == pytest.approx(model.initial_parameter())
    estimate = identifier.step(0.2, {"T": 0.1, "x": 0.3})
    assert np.isfinite(estimate.innovation[0])
    identifier.save(tmp_path / "state")
    again = lp.Identifier(model, sensors, law)
    again.load(tmp_path / "state")
    for one in (identifier, again):
        estimate = one.step(0.3, {"T": 0.1, "Q": 0.1, "x": 7.0})
        assert np.isnan(estimate.innovation[0])
    np.testing.assert_array_equal(identifier.estimate().q, again.estimate().q)
    # The channels of validation sensors are inputs, too.
    hidden = lp.Identifier(
        model, lp.Points({"P": 0.5}, noise=0.1), law, validation=lp.observation.Moving({"T": "x"})
    )
    assert hidden.inputs == ("x",)
    hidden.step(0.0, {"P": 0.0, "T": 1.0})
    assert np.isnan(hidden.step(0.1, {"P": 0.0, "T": 1.0}).validation_error).all()
    assert np.isfinite(hidden.step(0.2, {"P": 0.0, "T": 1.0, "x": 0.2}).validation_error).all()


@pytest.mark.parametrize(
    "build",
    [
        lambda: lp.Combined([lp.Points([0.5])], of="u"),
        lambda: lp.observation.Calibrated(lp.Points([0.5]), lambda y, q, x: y, of="u"),
        lambda: lp.observation.Transformed(lp.Points([0.5]), lambda y: y, of="u"),
        lambda: lp.observation.Functionals({"f": lambda q, u, x: u}, of="u"),
        lambda: lp.observation.Matrix(np.eye(3), of="u"),
    ],
)
def test_a_component_that_says_nothing_is_refused(build):
    with pytest.raises(ObservationError, match="of='u' has no effect"):
        build()


def test_derivatives_of_stated_errors_are_those_of_a_complex_step(tmp_path):
    errors = {"gain": 0.1, "offset": "0.2 K", "correlated": {"std": "0.1 K", "time": "100 s"}}
    settings = {f"channels.T_10.{key}": value for key, value in errors.items()}
    settings |= {"channels.T_30.offset": "0.2 K", "channels.T_10.at_std": "1 cm"}
    prepared = cases.load(short_rod(tmp_path, 11), settings=settings).prepare()
    problem = prepared.identifier.problem
    stated = problem.observed
    stepped = replace(stated.observation, derivatives=None).bind(
        stated.state, stated.X, stated.parameter
    )
    rng = np.random.default_rng(1)
    u, q = rng.normal(size=stated.state.dim), rng.normal(size=stated.parameter.dim)
    found, expected = (one.jacobian(u, q, Moment()) for one in (stated, stepped))
    for one, other in zip(found, expected, strict=True):
        dense, known = sp.csr_array(one).toarray(), sp.csr_array(other).toarray()
        np.testing.assert_allclose(dense, known, atol=1e-12)
    np.testing.assert_allclose(
        stated.predict(u, q, Moment()), stepped.predict(u, q, Moment()), rtol=1e-14
    )
