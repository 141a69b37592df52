"""Time schemes, the nonlinear iteration, substeps and failures."""

import functools
from itertools import pairwise

import numpy as np
import pytest
from factories import laplace, line, product, rates, reaction, truth
from skfem import ElementLineHermite, ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde.fem import Inputs, Moment
from livepde.linalg import Pattern, analyse
from livepde.stepping import End, ForwardStage, Held, Interval, Near, StepFailed, advance, simulate

SCHEMES = {"euler": lp.ImplicitEuler(), "alexander": lp.Alexander2()}


def cubic(**options):
    """Return u_t - u_xx + q u + u^3 = f with u* = (1 + x) (2 + sin 3t), which P1 contains."""

    def exact(x, t):
        return (1 + x[0]) * (2 + np.sin(3 * t))

    def source(x, t):
        u = exact(x, t)
        return (1 + x[0]) * 3 * np.cos(3 * t) + 1.5 * u + u**3

    model = lp.Model(
        lp.Field(line(5), ElementLineP1(), dirichlet={"boundary": exact}, quadrature=6),
        lp.Normal(1.5),
        A=product,
        B=lambda u, v, x: laplace(u, v, x) + u**3 * v,
        f=source,
        **options,
    )
    return model, exact


@pytest.mark.long
@pytest.mark.parametrize(("name", "order"), [("euler", 1), ("alexander", 2)])
def test_order_in_time_with_moving_boundary_data(name, order):
    """The space contains the solution, so that only the scheme has an error."""
    model, exact = cubic()
    assert SCHEMES[name].order == order
    errors = []
    for steps in (40, 80, 160, 320):
        times = np.linspace(0.0, 1.0, steps + 1)
        u = truth(model, np.array([1.5]), lambda x: exact(x, 0.0), times, SCHEMES[name])[-1]
        errors.append(model.X.norm(u - model.initial(lambda x: exact(x, 1.0), Moment(1.0))))
    np.testing.assert_allclose(rates(errors), order, atol=0.12)
    assert errors[-1] < (2e-2 if order == 1 else 2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("element", "order"), [(ElementLineP1(), 2), (ElementLineHermite(), 4)], ids=["P1", "Hermite"]
)
def test_order_in_space(element, order):
    """The solution is linear in time, so implicit Euler is exact; L2 norm by quadrature."""

    def exact(x, t):
        return (1 + t) * np.sin(np.pi * x[0])

    def source(x, t):
        return (1 / (1 + t) + np.pi**2 + 1 + x[0]) * exact(x, t)

    errors = []
    for cells in (6, 12, 24, 48):
        mesh = line(cells)
        model = lp.Model(
            lp.Field(mesh, element, dirichlet={"boundary": 0.0}, quadrature=12),
            lp.Field(mesh, element),
            A=product,
            B=laplace,
            f=source,
        )
        q = model.initial_parameter(lambda x: 1 + x[0])
        u = truth(model, q, lambda x: exact(x, 0.0), [0.0, 0.1, 0.2, 0.5])[-1]
        term = model.form_M.terms[0]
        values = term.spaces["u"].values(u)[0]
        difference = values - exact(term.measure.points, 0.5)
        errors.append(np.sqrt((difference**2 * term.measure.weights).sum()))
    np.testing.assert_allclose(rates(errors), order, atol=0.15)


def test_schemes_are_L_stable():
    """A stiff decay is damped within one step, without a change of sign."""
    model = reaction(line(8), ElementLineP1(), B=lambda u, v, x: 1e8 * u * v)
    for scheme in SCHEMES.values():
        u = truth(model, np.zeros(9), lambda x: np.sin(np.pi * x[0]), [0.0, 1.0], scheme)[-1]
        assert abs(u).max() < 1e-6


@pytest.mark.slow
def test_irregular_steps_keep_the_order():
    model, exact = cubic()
    rng = np.random.default_rng(0)
    errors = []
    coarse = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 1.0, 20))])
    coarse /= coarse[-1]
    for halvings in range(3):
        times = coarse
        for _ in range(halvings):
            times = np.sort(np.concatenate([times, (times[1:] + times[:-1]) / 2]))
        u = truth(model, np.array([1.5]), lambda x: exact(x, 0.0), times, lp.Alexander2())[-1]
        errors.append(model.X.norm(u - model.initial(lambda x: exact(x, 1.0), Moment(1.0))))
    np.testing.assert_allclose(rates(errors), 2.0, atol=0.2)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_substeps_are_the_same_steps_taken_by_hand(scheme):
    model = reaction(
        line(8),
        ElementLineP1(),
        dirichlet={"left": lp.Channel("T"), "right": lambda x, t: np.sin(t)},
        f=lambda x, t: x.inputs["Q"] + t,
        inputs=["Q"],
    )
    q = np.full(9, 2.0)

    def inputs(t):
        return {"T": 3 - 2 * t, "Q": 1 + 4 * t}  # linear between two samples

    control = lp.Advance(SCHEMES[scheme], dt_max=0.03)
    once = [u for _, u in lp.simulate(model, q, 1.0, [0.0, 0.05, 0.3], control, inputs)]
    times = [0.0, 0.025, 0.05, *(0.05 + 0.25 * np.arange(1, 10) / 9)]
    by_hand = truth(model, q, 1.0, times, SCHEMES[scheme], inputs)
    np.testing.assert_allclose(once[1], by_hand[2], rtol=1e-12)
    np.testing.assert_allclose(once[2], by_hand[-1], rtol=1e-12)


def interval(t0=1.0, t1=3.0, z0=(2.0, np.nan, 1.0), z1=(4.0, 6.0, np.nan)):
    inputs = (Inputs({"Q": 10.0}), Inputs({"Q": 20.0}))
    start = lp.stepping.End(t=t0, inputs=inputs[0], z=np.array(z0))
    stop = lp.stepping.End(t=t1, inputs=inputs[1], z=np.array(z1))
    return lp.stepping.Interval.between(start, stop)


def test_between_two_samples_data_are_linear():
    span = interval()
    np.testing.assert_array_equal(span.present, [True, True, False])
    np.testing.assert_array_equal(span.z(2.0), [3.0, 6.0, np.nan])  # held without a previous value
    np.testing.assert_array_equal(span.z(3.0), [4.0, 6.0, np.nan])
    assert span.at(2.0).inputs["Q"] == 15.0
    assert span.at(3.0) is span.end
    assert span.end.inputs["Q"] == 20.0


def test_number_of_substeps():
    assert lp.Advance(lp.ImplicitEuler()).count(2.0) == 1
    assert lp.Advance(lp.ImplicitEuler(), dt_max=2.0).count(2.0) == 1
    assert lp.Advance(lp.ImplicitEuler(), dt_max=1.999).count(2.0) == 2
    # 0.1 + 0.2 != 0.3: rounding alone never adds a substep.
    assert lp.Advance(lp.ImplicitEuler(), dt_max=0.1).count(0.1 + 0.2) == 3
    since_1970 = np.diff(1.7e9 + 0.1 * np.arange(50))
    assert {*map(lp.Advance(lp.ImplicitEuler(), dt_max=0.05).count, since_1970)} == {2}


def test_a_failing_substep_is_halved_and_grows_again():
    taken = []

    def stage(c, t, h):
        if t - h < 1.5 < t and h > 0.11:
            raise StepFailed("not_converged", "too long")
        taken.append(h)
        return c + h

    control = lp.Advance(lp.ImplicitEuler(), dt_max=1.0)
    y, steps, failure = advance(control, stage, np.zeros(1), 0.0, 4.0)
    assert failure is None
    assert steps == len(taken) > 4
    assert max(taken[-2:]) == 1.0
    np.testing.assert_allclose(y, 4.0)


def test_a_substep_that_always_fails_is_reported():
    def stage(c, t, h):
        if t > 2.0:
            raise StepFailed("not_finite", "no way")
        return c + h

    control = lp.Advance(lp.ImplicitEuler(), dt_max=1.0, halvings=3)
    y, steps, failure = advance(control, stage, np.zeros(1), 0.0, 4.0)
    assert failure.code == "not_finite"
    assert str(failure) == "no way"
    assert steps == 2
    np.testing.assert_allclose(y, 2.0)


def test_equal_steps_are_one_number():
    """Steps between equidistant times share one factorised matrix."""
    widths = set()

    def stage(c, t, h):
        widths.add(h)
        return c

    times = [k * 0.6 for k in range(200)]
    for t0, t1 in pairwise(times):
        advance(lp.Advance(lp.ImplicitEuler()), stage, np.zeros(1), t0, t1)
    assert len(widths) <= 8
    np.testing.assert_allclose(list(widths), 0.6, rtol=1e-12)


class Slope:
    """Factor of a 1 x 1 matrix."""

    def __init__(self, slope):
        self.slope = slope

    def solve(self, b):
        return b / self.slope


class Cubic:
    """Equation x^3 = x for x = y - 5, with roots at 4, 5 and 6."""

    def __init__(self):
        self.factors = 0

    def evaluate(self, y):
        x = y - 5.0
        return Point(y, x**3 - x, 6.0)

    def factor(self, at, last=None):
        self.factors += 1
        return Slope(3.0 * (at.y[0] - 5.0) ** 2 - 1.0)

    def limited(self, at, allowed):
        return at.size <= 1e-16


class Point:
    """Point of an equation, with the residual relative to a scale."""

    def __init__(self, y, residual, scale=1.0, resolved=True):
        self.y, self.residual, self.resolved = y, residual, resolved
        self.size = float(np.max(np.abs(residual) / scale))


class Equation:
    """Equations y^3 = a, with optional errors of the Jacobian and hidden small differences."""

    def __init__(self, a, slope=3.0, resolution=np.inf):
        self.a, self.slope, self.resolution = np.asarray(a, dtype=float), slope, resolution
        self.factors = 0

    def evaluate(self, y):
        with np.errstate(over="ignore", invalid="ignore"):
            residual = y**3 - self.a
            missed = np.max(np.abs(residual))
            return Point(y, residual, np.abs(self.a), bool(missed <= self.resolution))

    def factor(self, at, last=None):
        self.factors += 1
        pattern = Pattern.of(np.eye(len(at.y)))
        return analyse(pattern).factorise(self.slope * at.y**2)

    def limited(self, at, allowed):
        return bool(np.all(np.abs(at.residual) <= 4e-16 * np.abs(self.a)))


def test_newton_solves():
    equation = Equation([8.0, 27.0])
    found = lp.stepping.Newton(tolerance=1e-10).solve(equation, np.array([2.5, 2.5])).at
    np.testing.assert_allclose(found.y, [2.0, 3.0], rtol=1e-9)
    assert found.size <= 1e-10
    by_function = (
        lp.stepping.Newton(tolerance=1e-10).solve(equation, lambda: np.array([2.5, 2.5])).at
    )
    np.testing.assert_array_equal(by_function.y, found.y)


def test_newton_keeps_its_factor_while_it_is_good():
    equation = Equation([8.0])
    lp.stepping.Newton(tolerance=1e-10).solve(equation, np.array([2.001]))
    assert equation.factors == 1


@pytest.mark.parametrize("tolerance", [1e-15, 1e-17, 0.0])
def test_newton_iterates_to_rounding_level(tolerance):
    found = (
        lp.stepping.Newton(tolerance=tolerance)
        .solve(Equation([3.0, 1e5]), np.array([1.5, 50.0]))
        .at
    )
    np.testing.assert_allclose(found.y, np.cbrt([3.0, 1e5]), rtol=4e-16)


@pytest.mark.parametrize(
    ("near", "kept", "made"),
    [
        (6.01, None, 1),  # good start, one new factor
        (6.01, Slope(2.0), 0),  # no new factor
        (6.01, Slope(0.1), 1),  # a poor cached factor is replaced
        (6.01, Slope(-2.0), 1),  # this factor increases the residual
    ],
)
def test_newton_begins_where_the_start_is_good(near, kept, made):
    equation = Cubic()
    newton = lp.stepping.Newton(tolerance=1e-10, share=0.0)
    found = newton.solve(equation, lambda: pytest.fail("not needed"), Near(np.array([near]), kept))
    np.testing.assert_allclose(found.at.y, 6.0, rtol=1e-9)
    assert equation.factors == made


def test_newton_stops_at_a_share_of_the_residual_that_the_start_had():
    near = Near(np.array([6.001]), Slope(2.0 / 0.96))  # leaves about a twentieth in each update
    start = np.array([5.6])
    had = Cubic().evaluate(near.y).size
    few = lp.stepping.Newton(tolerance=1e-12, share=0.1).solve(Cubic(), start, near)
    more = lp.stepping.Newton(tolerance=1e-12, share=1e-3).solve(Cubic(), start, near)
    full = lp.stepping.Newton(tolerance=1e-12, share=0.0).solve(Cubic(), start, near)
    assert 1 == few.updates < more.updates < full.updates
    assert few.at.size <= 0.1 * had
    assert more.at.size <= 1e-3 * had
    assert full.at.size <= 1e-12
    capped = lp.stepping.Newton(tolerance=1e-12, share=0.5, ceiling=1e-9).solve(
        Cubic(), start, near
    )
    assert capped.at.size <= 1e-9


def test_a_stage_that_needs_a_small_difference_is_solved_until_it_is_resolved():
    rough = lp.stepping.Newton(tolerance=1e-2).solve(Equation([8.0]), np.array([2.5])).at
    fine = (
        lp.stepping.Newton(tolerance=1e-2)
        .solve(Equation([8.0], resolution=1e-9), np.array([2.5]))
        .at
    )
    assert abs(rough.residual[0]) > 1e-9
    assert abs(fine.residual[0]) <= 1e-9


@pytest.mark.parametrize("near", [5.5773, np.nan])
def test_a_prediction_from_which_newton_fails_is_discarded(near):
    """Newton from there diverges far below, or cannot begin."""
    equation, plain = Cubic(), Cubic()
    newton = lp.stepping.Newton(tolerance=1e-10, iterations=12)
    y = newton.solve(equation, np.array([5.8]), Near(np.array([near]), Slope(1e-3))).at.y
    expected = lp.stepping.Newton(tolerance=1e-10).solve(plain, np.array([5.8])).at.y
    np.testing.assert_allclose(y, expected, rtol=1e-9)


def test_an_update_that_goes_too_far_is_shortened():
    """The full update diverges from the root of the arc tangent."""

    class Arc(Equation):
        def evaluate(self, y):
            return Point(y, np.arctan(y))

        def factor(self, at, last=None):
            return Slope(1.0 / (1.0 + at.y[0] ** 2))

    found = lp.stepping.Newton(tolerance=1e-12).solve(Arc([0.0]), np.array([20.0])).at
    assert abs(found.y[0]) < 1e-12


@pytest.mark.parametrize("slope", [0.01, 0.3, 30.0, 1e4])
def test_a_wrong_factor_never_makes_a_solution(slope):
    """With a factor that is too large, updates are arbitrarily small, but the residual is not."""
    newton = lp.stepping.Newton(tolerance=1e-8, share=0.0)
    near = Near(np.array([2.1]), Slope(slope * 12.0))
    found = newton.solve(Equation([8.0]), np.array([2.5]), near).at
    assert abs(found.y[0] ** 3 - 8.0) <= 8e-8


@pytest.mark.parametrize(
    ("equation", "start", "newton", "code"),
    [
        (Equation([8.0]), 3.0, lp.stepping.Newton(iterations=1), "not_converged"),
        (Equation([8.0], slope=-3.0), 3.0, lp.stepping.Newton(iterations=2000), "not_converged"),
        (Equation([8.0]), 0.0, lp.stepping.Newton(), "singular"),
        (Equation([8.0], slope=1e-200), 3.0, lp.stepping.Newton(), "not_finite"),
        (Equation([np.nan]), 1.0, lp.stepping.Newton(), "not_finite"),
    ],
)
def test_newton_reports_why_it_failed(equation, start, newton, code):
    with pytest.raises(StepFailed) as caught:
        newton.solve(equation, np.array([start]))
    assert caught.value.code == code
    assert str(caught.value)


def test_tolerance_is_relative_in_each_line():
    """State and parameter may differ by many orders of magnitude."""
    equation = Equation([1e-24, 1e24])
    y = lp.stepping.Newton(tolerance=1e-9).solve(equation, np.array([1.3e-8, 1.1e8])).at.y
    np.testing.assert_allclose(y, [1e-8, 1e8], rtol=1e-8)


def test_forward_stage_of_an_affine_model_is_one_factorisation():
    model = reaction(MeshTri().refined(3), ElementTriP1(), f=lambda x, t: t * x[0])
    assert model.affine
    forward = ForwardStage(model)
    q = np.ones(model.Q.dim)
    u = np.random.default_rng(1).standard_normal(model.X.dim)
    first = forward.solve(u, q, 0.1, Moment(0.1))
    kept = forward.factor(q, 0.1, lp.fem.Moment())
    assert forward.factor(q.copy(), 0.1, lp.fem.Moment()) is kept
    assert forward.factor(2 * q, 0.1, lp.fem.Moment()) is not kept
    # Caching never changes the numbers.
    np.testing.assert_array_equal(ForwardStage(model).solve(u, q, 0.1, Moment(0.1)), first)
    # The result solves the equation.
    start = model.impose(u, Moment(0.1))
    del start
    residual = model.mass @ (first - u) / 0.1 + model.B(first) + model.A(first)(q)
    residual = (residual - model.F(Moment(0.1))) * model.X.free
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)


def test_held_inputs_are_held_exactly():
    held = Held(next=("Q",))
    between = Interval.between(
        End(t=0.0, inputs=Inputs({"Q": 5.0}), z=np.ones(1)),
        End(t=1.0, inputs=Inputs({"Q": 0.1}), z=np.ones(1)),
    ).driven(held)
    assert between.at(1.0 / 3.0).inputs["Q"] == between.at(1.0).inputs["Q"] == 0.1
    assert between.at(1.0 / 3.0).inputs is between.at(1.0).inputs
    assert between.driven(held) is between


def test_shortcuts_of_affine_models_do_not_change_the_numbers():
    """Compares a constant model with an equal one disguised as time-dependent and nonlinear."""
    mesh = line(8)
    plain = reaction(mesh, ElementLineP1(), B=lambda u, v, x: (u - 1.0) * v)
    timed = reaction(mesh, ElementLineP1(), B=lambda u, v, x: (u - 1.0 + 0 * x.t) * v)
    curved = reaction(mesh, ElementLineP1(), B=lambda u, v, x: (u - 1.0 + 1e-14 * u**3) * v)
    assert plain.constant
    assert not timed.constant
    q = np.linspace(1, 2, 9)
    runs = [truth(m, q, 1.0, [0.0, 0.3, 1.0])[-1] for m in (plain, timed, curved)]
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-12)
    np.testing.assert_allclose(runs[2], runs[0], atol=1e-11)


def test_tangent_is_the_derivative_of_a_stage():
    """S du = M dc/h: sensitivities are exact derivatives of the discrete step."""
    model, _ = cubic()
    forward = ForwardStage(model, lp.stepping.Newton(tolerance=1e-13))
    q = np.array([1.5])
    rng = np.random.default_rng(2)
    c, dc = rng.standard_normal((2, model.X.dim))
    h, moment = 0.2, Moment(0.2)
    u = forward.solve(c, q, h, moment)
    factor = forward.tangent(u, q, h, moment)
    step = 1e-6
    for direction, rhs in (
        ((dc, 0.0), model.mass @ dc / h),
        ((0 * dc, 1.0), -model.form_A.matrix("v", "q", u=u) @ [1.0]),
    ):
        ahead = forward.solve(c + step * direction[0], q + step * direction[1], h, moment)
        back = forward.solve(c - step * direction[0], q - step * direction[1], h, moment)
        tangent = factor.solve(rhs * model.X.free)
        np.testing.assert_allclose(tangent, (ahead - back) / (2 * step), atol=1e-7)


def test_a_simulation_that_blows_up_is_reported():
    model = reaction(line(6), ElementLineP1(), B=lambda u, v, x: -np.exp(u) * v, dirichlet={})
    control = lp.Advance(lp.ImplicitEuler(), halvings=2)
    with pytest.raises(StepFailed) as caught:
        list(lp.simulate(model, np.zeros(7), 5.0, [0.0, 1.0], control))
    assert caught.value.code in {"not_converged", "not_finite", "singular"}


def wells(terms, f=0.0):
    mesh = lp.interval(0.0, 1.0, 12)
    state = lp.Field(mesh, ElementLineP1(), dirichlet={"right": 0.0})
    unknowns = {"k": lp.Normal(0.3), "S": lp.Normal(2.0)}
    return lp.Model(state, unknowns, A=terms, f=f, inputs=["Q"])


def conducts(q, u, v, x):
    return q.k / q.S * lp.dot(lp.grad(u), lp.grad(v))


def test_inputs_that_do_not_touch_the_state_keep_the_factor():
    well = lp.On("left", lambda q, _, v, x: -x.inputs["Q"] / q.S * v)
    apart = wells([conducts, well])
    mixed = wells(
        [conducts, lp.On("left", lambda q, u, v, x: -x.inputs["Q"] / q.S * v + 0 * u * v)]
    )
    assert apart.steady
    assert not apart.constant
    assert not mixed.steady
    times, q = [0.0, 0.1, 0.2, 0.4], np.array([0.3, 2.0])
    runs = [
        [
            u
            for _, u in simulate(
                model, q, 0.0, times, lp.Advance(lp.Alexander2()), lambda t: {"Q": 1 + t}
            )
        ]
        for model in (apart, mixed)
    ]
    np.testing.assert_allclose(runs[0], runs[1], rtol=1e-9, atol=1e-12)
    assert np.abs(runs[0][-1]).max() > 0.1


@pytest.mark.parametrize(
    "term",
    [
        lambda q, u, v, x: (u if x.t > 5 else 0.0) * v,  # a branch that is taken later
        lambda q, u, v, x: x.inputs["Q"] * (lambda: u)() * v,  # in a closure
        functools.partial(lambda a, q, u, v, x: a * x.t * v, 1.0),  # not a plain function
    ],
)
def test_terms_that_may_depend_on_the_state_are_not_cached(term):
    assert not wells([conducts, term]).steady


def test_steps_near_the_start_are_graded():
    """A step is at most half of the time since the start, and at least an eighth of its length."""
    ends: list[float] = []

    def stage(c, t, h):
        ends.append(t)
        return c

    scheme = lp.ImplicitEuler()
    for t0, t1 in ((1.0, 2.0), (2.0, 3.0), (3.0, 4.0)):
        advance(lp.Advance(scheme, start=1.0), stage, np.zeros(1), t0, t1)
    assert ends == [1.125, 1.25, 1.375, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0]
    for control in (lp.Advance(scheme), lp.Advance(scheme, start=2.5)):
        assert control.grade(1.0, 1.0) == 0
    assert lp.Advance(scheme, halvings=0, start=1.0).grade(1.0, 1.0) == 0
    halves: list[float] = []
    again = lp.Advance(scheme, parts=2, start=1.0)
    advance(again, lambda c, t, h: halves.append(t) or c, np.zeros(1), 1.0, 2.0)
    assert halves[1::2] == [1.125, 1.25, 1.375, 1.5, 1.75, 2.0]  # every step in two


@pytest.mark.slow
def test_graded_steps_resolve_a_flux_that_starts():
    """The state grows as the square root of time, which one long step misses."""
    model = lp.Model(
        lp.Field(lp.interval(0.0, 4.0, 400), ElementLineP1()),
        lp.Normal(1.0, 0.1),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
        f=[lp.On("left", lambda x, t: 1.0)],
    )
    times, errors = np.arange(0.0, 0.51, 0.05), []
    for start in (np.nan, 0.0):
        control = lp.Advance(lp.Alexander2(), start=start)
        run = lp.simulate(model, np.array([1.0]), 0.0, times.tolist(), control)
        surface = np.argmin(model.mesh.p[0])
        errors.append(max(abs(u[surface] - 2.0 * np.sqrt(t / np.pi)) for t, u in run))
    assert errors[1] < 0.05 * errors[0]
