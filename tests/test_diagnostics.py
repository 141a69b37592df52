"""The shipped checks pass for correct objects, and name the faults of incorrect ones."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from factories import excited, line, observe, reaction
from skfem import ElementLineHermite, ElementLineP1, ElementTriP2, MeshTri

import livepde as lp
from livepde.diagnostics import (
    Check,
    CheckReport,
    check_law,
    check_model,
    check_observation,
    check_space,
)
from livepde.fem import START
from livepde.stepping import ForwardStage


def failed(report):
    return [line.name for line in report.failed]


def test_a_wrong_derivative_is_found():
    model = reaction(
        line(6),
        ElementLineP1(),
        B=lambda u, v, x: u**3 * v,
        dB=lambda u, du, v, x: 2 * u**2 * du * v,
    )
    report = check_model(model, u=1.0)
    assert not report.ok
    assert any("B'(u)" in name for name in failed(report))
    with pytest.raises(lp.errors.ModelError, match="B'"):
        report.raise_if_failed()


def heat_with_traces(factor, capacity):
    """A temperature with a large term, and traces with a small one whose derivative is given."""
    P1 = lp.Field(line(6), ElementLineP1())
    return lp.Model(
        {"T": P1, "c": lp.Field(P1.mesh, ElementLineP1())},
        {"k": lp.Normal(1.0, std=0.5)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u.T), lp.grad(v.T)),
        B=lambda u, v, x: capacity * u.T**4 * v.T + u.c**2 * v.c,
        dB=lambda u, du, v, x: 4 * capacity * u.T**3 * du.T * v.T + factor * u.c * du.c * v.c,
    )


def test_a_wrong_derivative_is_found_beside_larger_terms():
    start = {"T": 2.0, "c": 1e-3}
    check_model(heat_with_traces(2.0, 1e6), u=start).raise_if_failed()
    report = check_model(heat_with_traces(1.0, 1e6), u=start)
    assert failed(report) == ["B'(u) of 'c' by 'c': rate of the Taylor remainder"]


def test_a_wrong_derivative_of_a_sensor_is_found_beside_larger_readings():
    model = reaction(line(6), ElementLineP1())
    power = lp.observation.Transformed(lp.Points({"P": 0.9}), function=lambda u: u**4)

    def voltage(slope):
        return lp.observation.Transformed(
            lp.Points({"V": 0.2}), lambda u: 1e-6 * u**2, derivative=lambda u: slope * 1e-6 * u
        )

    check_observation(lp.Combined([voltage(2.0), power]), model, at=600.0).raise_if_failed()
    report = check_observation(lp.Combined([voltage(1.0), power]), model, at=600.0)
    assert failed(report) == ["G'(u) by differences"]


@pytest.mark.slow
def test_a_form_that_is_not_analytic_is_found():
    report = check_model(reaction(line(6), ElementLineP1(), B=lambda u, v, x: np.abs(u) * v))
    assert any("B'(u)" in name for name in failed(report))


@pytest.mark.slow
def test_a_form_that_is_not_linear_in_q_has_its_derivatives_checked():
    model = lp.Model(
        lp.Field(line(6), ElementLineP1()), lp.Normal(1.0), A=lambda q, u, v, x: q**2 * u * v
    )
    report = check_model(model, u=1.0)
    report.raise_if_failed()
    assert any("/dq" in line.name for line in report.lines)


@pytest.mark.slow
def test_a_form_that_is_not_analytic_in_q_is_found():
    model = lp.Model(
        lp.Field(line(6), ElementLineP1()),
        lp.Normal(1.0),
        A=lambda q, u, v, x: abs(q) ** 1.5 * u * v,
    )
    assert any("/dq" in name for name in failed(check_model(model, u=1.0)))


def test_an_unsymmetric_mass_is_refused():
    model = lp.Model(
        lp.Field(line(6), ElementLineP1(), dirichlet={"boundary": 0.0}),
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * u * v,
        M=lambda u, v, x: u * v + 0.1 * lp.grad(u)[0] * v,
    )
    with pytest.raises(lp.errors.SpaceError, match="not symmetric"):
        check_model(model, u=1.0)


def test_a_projection_that_is_none_is_found():
    """M^-1 M_omega, which the design warns of: not idempotent."""
    model = excited(8)
    observed = observe(model, lp.Subdomain(lambda x: x[0] > 0.4))
    good = observed.split()
    weight = lambda u, v, x: (x[0] > 0.4) * u * v  # noqa: E731
    wrong = sp.csr_array(np.linalg.solve(model.mass.toarray(), model.bilinear(weight).toarray()))
    bad = type(good)(
        **{
            **{name: getattr(good, name) for name in good.__dataclass_fields__},
            "R": wrong,
            "P": sp.csr_array(sp.eye_array(model.X.dim) - wrong),
        }
    )
    observed.split = lambda present=None: bad
    assert "R R = R" in failed(check_observation(observed))


def test_a_sensor_that_sees_nothing_is_found():
    blind = lp.observation.Matrix([[0.0] * 6 + [1.0], [0.0] * 7])
    report = check_observation(blind, reaction(line(6), ElementLineP1()))
    assert failed(report) == ["sensors that depend on nothing"]
    assert "['z1'] depend" in report.failed[0].remedy


def test_a_function_without_complex_values_needs_a_derivative():
    def table(y):
        return np.interp(y, [0.0, 2.0], [0.0, 4.0])

    with pytest.raises(lp.errors.ModelError, match=r"Form B has no derivative .*dB="):
        check_model(reaction(line(6), ElementLineP1(), B=lambda u, v, x: table(u) * v))
    sensors = lp.observation.Transformed(lp.Points([0.5]), table)
    with pytest.raises(lp.errors.ModelError, match=r"Transformed: .*derivative="):
        check_observation(sensors, reaction(line(6), ElementLineP1()))


def test_a_line_inside_the_mesh_has_a_normal_only_with_an_orientation():
    mesh = MeshTri.init_sqsymmetric().refined(2).with_subdomains({"west": lambda x: x[0] < 0.5})
    cut = mesh.facets_satisfying(lambda x: np.isclose(x[0], 0.5))
    mesh = mesh.with_boundaries({"cut": cut, "around": mesh.facets_around("west")})
    model = reaction(mesh, ElementTriP2())

    def outflow(name):
        flux = lp.observation.Functionals({"J": lp.On(name, lambda q, u, x: u * x.normal[0])})
        observed = flux.bind(model.state_space, model.X, model.parameter_space)
        u = model.state_space.interpolate(lambda x: x[0])
        return observed.predict(u, np.zeros(model.Q.dim), START)

    with pytest.raises(lp.errors.ObservationError, match="it has no side: write the direction"):
        outflow("cut")
    assert outflow("around") == pytest.approx([0.5])


def test_spaces():
    check_space(excited(6).Q).raise_if_failed()
    check_space(excited(6).X).raise_if_failed()


@dataclass(frozen=True, eq=False)
class State:
    u: np.ndarray
    q: np.ndarray


@dataclass(frozen=True)
class OpenLoop(lp.laws.Law):
    """Learns nothing, correctly."""

    def prepare(self, problem):
        return problem, ForwardStage(problem.model)

    def init(self, work, q0, u0):
        return State(u0, q0)

    def step(self, work, state, interval):
        problem, forward = work
        h = interval.t1 - interval.t0
        u = forward.solve(state.u, state.q, h, interval.end)
        predicted = problem.observed.predict(u, state.q, interval.end)
        return State(u, state.q), lp.laws.Report(lp.laws.Status(), predicted, steps=1)

    def belief(self, work, state):
        return lp.laws.Belief(state.q, state.u)


class Dice(OpenLoop):
    """Moves q at random."""

    def step(self, work, state, interval):
        new, report = super().step(work, state, interval)
        return State(new.u, new.q + np.random.default_rng().standard_normal(len(new.q))), report


class Scribbler(OpenLoop):
    """Changes its old state in place."""

    def step(self, work, state, interval):
        new, report = super().step(work, state, interval)
        state.u[:] = new.u
        return new, report


class Fragile(OpenLoop):
    """Does not think of missing samples."""

    def step(self, work, state, interval):
        new, report = super().step(work, state, interval)
        return State(new.u, new.q + 0.0 * interval.z1.sum()), report


class Informed(OpenLoop):
    """Knows the truth."""

    def step(self, work, state, interval):
        new, report = super().step(work, state, interval)
        return State(new.u, new.q + 0.1 * (2.0 - new.q)), report


class Flattering(OpenLoop):
    """Reports the readings as its predictions."""

    def step(self, work, state, interval):
        new, report = super().step(work, state, interval)
        predicted = np.where(interval.present, interval.z1, report.predicted)
        return new, lp.laws.Report(report.status, predicted, steps=1)


class Misshapen(OpenLoop):
    """Reports a covariance of q where its square root is expected."""

    def belief(self, work, state):
        n, m = len(state.u), len(state.q)
        return lp.laws.Belief(state.q, state.u, np.eye(m), np.ones((n, m + 1)))


def build(law):
    model = reaction(line(6), ElementLineP1())
    return lp.Identifier(model, lp.Points([0.3, 0.6], noise=0.1), law, u0=lambda x: x[0])


SAMPLES = [(0.1 * k, [0.2, 0.1]) for k in range(1, 6)]


@pytest.mark.slow
def test_a_good_law_passes():
    check_law(OpenLoop(), build, SAMPLES).raise_if_failed()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Dice(), "two runs"),
        (Scribbler(), "value"),
        (Fragile(), "missing"),
        (Informed(), "no readings at all"),
        (Flattering(), "innovations follow"),
        (Misshapen(), "wrong shapes"),
    ],
)
def test_bad_laws_are_found(law, words):
    report = check_law(law, build, SAMPLES)
    assert any(words in name for name in failed(report))
    with pytest.raises(lp.errors.LawError):
        report.raise_if_failed()


def test_samples_may_have_their_own_noise():
    noisy = [(t, np.column_stack([z, [0.1, 0.2]])) for t, z in SAMPLES]
    check_law(lp.SensitivityLaw(), build, noisy).raise_if_failed()


def test_a_law_needs_some_samples():
    with pytest.raises(lp.errors.LawError, match="four samples"):
        check_law(OpenLoop(), build, SAMPLES[:2])


def test_reports_are_read_by_people():
    bad = Check.at_most("P P = P", 0.5, 1e-12, "make it a projection.")
    report = CheckReport("observation", (bad,))
    assert "FAIL" in str(report)
    assert "make it a projection." in str(report)
    assert not Check.at_most("x", np.nan, 1.0, "").ok
    assert not Check.at_least("x", np.nan, 1.0, "").ok


def test_hermite_models_at_the_users_scale():
    model = reaction(line(8), ElementLineHermite(), A=lambda q, u, v, x: q * u**2 * v)
    check_model(model, u=300.0, spread=5.0).raise_if_failed()
