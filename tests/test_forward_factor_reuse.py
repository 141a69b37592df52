"""Reuse of a factor of the forward model while the parameter changes."""

from dataclasses import replace

import factories
import numpy as np
import pytest
import scipy.sparse as sp
from factories import laplace, reaction
from skfem import ElementTriP1

import livepde as lp
from livepde.errors import LinearAlgebraError
from livepde.linalg import (
    Choice,
    CholmodSolver,
    MultigridSolver,
    PardisoSolver,
    Pattern,
    SuperLUSolver,
)
from livepde.stepping import ForwardStage, Kept
from livepde.stepping import forward as forward_module

H = 0.1


def square(cells=50, wind=0.0):
    """Heat conduction with an unknown reaction, and with wind if that is not 0."""
    return reaction(
        factories.square(cells),
        ElementTriP1(),
        dirichlet={"left": 0.0},
        B=lambda u, v, x: laplace(u, v, x) + wind * lp.grad(u)[0] * v,
        f=lambda x, t: 1.0 + t,
    )


@pytest.fixture(scope="module")
def model():
    return square()


def bump(model, size):
    return model.initial_parameter(lambda x: size * np.sin(3.0 * x[0]) * (0.3 + x[-1]))


def begun(model):
    """State and tangents at the start, and directions of the parameter."""
    rng = np.random.default_rng(0)
    free = model.X.free[:, None]
    directions = np.column_stack([bump(model, 1.0), np.ones(model.Q.dim)])
    tangents = 0.1 * np.cumsum(rng.standard_normal((model.X.dim, 2)), axis=0) / model.X.dim
    return np.hstack([free, tangents * free]), directions


class Counted(ForwardStage):
    """Counts its factorisations."""

    made = 0

    def _factorise(self, data):
        self.made += 1
        return super()._factorise(data)


def go(model, parameters, tolerance=1e-8, kept_from_start=True):
    """Return what each stage gives, the stage, and what it has left."""
    forward, kept, found = Counted(model), Kept.none(), []
    c, directions = begun(model)
    for k, q in enumerate(parameters):
        moment = lp.fem.Moment(H * (k + 1))
        c, kept = forward.advance(c, q, directions, H, moment, kept, tolerance)
        found.append(c)
        kept = kept if kept_from_start else Kept.none()
    return found, forward, kept


@pytest.mark.slow
@pytest.mark.parametrize("wind", [0.0, 5.0])
def test_a_kept_factor_gives_what_one_for_each_parameter_gives(wind):
    model = square(wind=wind)
    parameters = [bump(model, 1.0 + 0.02 * k) for k in range(6)]
    kept, once, _ = go(model, parameters)
    fresh, each, _ = go(model, parameters, kept_from_start=False)
    assert once.symmetric == (wind == 0.0)
    assert (once.made, each.made) == (1, 6)
    for mine, other in zip(kept, fresh, strict=True):
        for part in (slice(0, 1), slice(1, 3)):
            missed = np.linalg.norm(mine[:, part] - other[:, part])
            assert missed < 5e-8 * np.linalg.norm(other[:, part])
    assert not np.array_equal(kept[-1], fresh[-1])


@pytest.mark.slow
def test_tangents_may_be_less_accurate_than_the_state(model):
    parameters = [bump(model, 1.0 + 0.2 * (k > 0)) for k in range(4)]
    fresh, _, _ = go(model, parameters, kept_from_start=False)
    missed, spent = [], []
    for tolerance in (1e-3, 1e-8):
        found, forward, kept = go(model, parameters, tolerance)
        assert forward.made == 1
        state, tangents = (found[-1][:, p] - fresh[-1][:, p] for p in (slice(0, 1), slice(1, 3)))
        assert np.linalg.norm(state) < 5e-8 * np.linalg.norm(fresh[-1][:, :1])
        missed.append(np.linalg.norm(tangents) / np.linalg.norm(fresh[-1][:, 1:]))
        spent.append(kept.spent)
    assert missed[1] < 5e-8 < missed[0] < 5e-3
    assert spent[0] < spent[1]


def test_a_factor_is_made_again_where_the_parameter_jumps(model):
    near, far = bump(model, 1.0), bump(model, 40.0)
    found, forward, kept = go(model, [near, near, far, far])
    fresh, _, _ = go(model, [near, near, far, far], kept_from_start=False)
    assert forward.made == 2
    assert np.array_equal(kept.q, far)
    assert kept.spent == 0.0
    np.testing.assert_allclose(found[-1], fresh[-1], atol=1e-12)


def test_a_factor_is_made_again_once_it_has_cost_a_new_one(model):
    """Each stage takes a few solves more than with the factor of a parameter nearby."""
    forward, kept, spent = Counted(model), Kept.none(), []
    c, directions = begun(model)
    parameters = [bump(model, 1.0), *[bump(model, 1.2)] * 20]
    for k, q in enumerate(parameters):
        c, kept = forward.advance(c, q, directions, H, lp.fem.Moment(H * (k + 1)), kept)
        spent.append(kept.spent)
    renewed = spent.index(0.0, 2)
    assert np.all(np.diff(spent[:renewed]) >= 0)
    assert 0.7 * forward.solver.price < spent[renewed - 1] <= forward.solver.price
    assert forward.made == 2
    assert spent[renewed:] == [0.0] * (21 - renewed)


@pytest.mark.slow
def test_errors_are_small_beside_slow_changes():
    """A state that changes by 1e-8 of itself in a step is not left where it was."""
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (50, 50)).to_meshtri()
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh)),
        lp.Field(mesh, lp.linear(mesh)),
        A=lambda q, u, v, x: q * (u - 1.0) * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    h, moment, directions = 1e-4, lp.fem.Moment(1e-4), np.zeros((model.Q.dim, 1))
    q = 1e3 * np.ones(model.Q.dim)
    forward = Counted(model)
    c = np.column_stack([1.0 + 1e-7 * bump(model, 1.0), np.zeros(model.X.dim)])
    _, kept = forward.advance(c, 0 * q, directions, h, moment, Kept.none())
    kept = replace(kept, trend=0.0 * kept.trend)
    found, _ = forward.advance(c, q, directions, h, moment, kept)
    exact, _ = ForwardStage(model).advance(c, q, directions, h, moment, Kept.none())
    change = np.linalg.norm(exact[:, 0] - c[:, 0])
    assert forward.made == 1
    assert change < 1e-7 * np.linalg.norm(c[:, 0])
    assert np.linalg.norm(found[:, 0] - exact[:, 0]) < 2e-2 * change


ENGINES = {
    "superlu": (None, lambda pattern: SuperLUSolver(pattern, symmetric=True)),
    "cholmod": ("sksparse.cholmod", CholmodSolver),
    "pardiso": ("pypardiso", lambda pattern: PardisoSolver(pattern, symmetric=True)),
    "multigrid": ("pyamg", MultigridSolver),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "engine", [*list(ENGINES)[:-1], pytest.param("multigrid", marks=pytest.mark.study)]
)
def test_a_resumed_run_has_the_same_numbers_although_its_factor_is_made_again(
    model, engine, monkeypatch
):
    module, make = ENGINES[engine]
    if module:
        pytest.importorskip(module)
    monkeypatch.setattr(
        forward_module, "choose", lambda pattern, symmetric=False: Choice(make(pattern), "a test")
    )
    points = lp.Points([(x, y) for x in (0.2, 0.5, 0.8) for y in (0.3, 0.7)])
    exact, times = bump(model, 1.0), [H * k for k in range(13)]
    G = points.matrix(model.state_space)
    control = lp.Advance(lp.ImplicitEuler())
    samples = [(t, G @ u) for t, u in lp.simulate(model, exact, 0.0, times, control)]

    def identifier():
        law = lp.SensitivityLaw(modes=3, noise=1e-3, refit=None)
        return lp.Identifier(model, points, law, q0=0.0, u0=0.0)

    whole, resumed = identifier(), identifier()
    for sample in samples[1:7]:
        whole.step(*sample)
    resumed.restore(whole.dump())
    for sample in samples[7:]:
        one, other = whole.step(*sample), resumed.step(*sample)
        np.testing.assert_array_equal(one.q, other.q)
        np.testing.assert_array_equal(one.u, other.u)
        np.testing.assert_array_equal(one.belief.q_factor, other.belief.q_factor)


def transport(share):
    """Conduction in slow units with wind; `share(q)` of it."""
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (50, 50)).to_meshtri()
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": 0.0}),
        lp.Normal(0.0),
        A=lambda q, u, v, x: share(q) * lp.grad(u)[0] * v,
        B=lambda u, v, x: 1e-16 * lp.dot(lp.grad(u), lp.grad(v)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize(
    ("share", "claimed"),
    [
        (lambda q: 1e-15 * (1.0 + q), False),  # beside M/h it is rounding, unless h is large
        (lambda q: 1e-15 * (q - 8.0) * (np.real(q) > 8.0), True),  # begins eight deviations off
    ],
)
def test_only_symmetric_matrices_are_factorised_as_such(engine, share, claimed, monkeypatch):
    module, make = ENGINES[engine]
    if module:
        pytest.importorskip(module)

    def chosen(pattern, symmetric=False):
        return Choice(make(pattern) if symmetric else SuperLUSolver(pattern), "a test")

    monkeypatch.setattr(forward_module, "choose", chosen)
    moving, h, q = transport(share), 1e15, np.array([20.0])
    forward = ForwardStage(moving)
    assert forward.symmetric is claimed
    c = moving.initial(lambda x: np.sin(3.0 * x[0]) + x[1])
    u = forward.solve(c, q, h, lp.fem.Moment(h))
    rate, wind = moving.mass @ (u - c) / h, moving.form_A.vector("v", q=q, u=u)
    residual = (rate + wind + moving.B(u)) * moving.X.free
    np.testing.assert_allclose(residual, 0.0, atol=1e-10 * np.abs(wind).max())


def test_units_of_components_do_not_hide_what_is_not_symmetric():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (20, 20)).to_meshtri()
    field = lp.Field(mesh, lp.linear(mesh))
    two = lp.Model(
        {"a": field, "b": field},
        lp.Normal(0.0),
        A=lambda q, u, v, x: q * u.b * v.b,
        M=lambda u, v, x: 1e15 * u.a * v.a + u.b * v.b,
        B=lambda u, v, x: 1e15 * u.a * v.a + lp.grad(u.b)[0] * v.b,
    )
    assert not ForwardStage(two).symmetric


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-157, 1e-160])
def test_a_state_may_fade_until_its_squares_underflow(model, size):
    kept, directions = Kept.none(), np.ones((model.Q.dim, 1))
    calm = lp.Model(
        model.state_space.blocks["u"].field,
        model.parameter_space.blocks["q"].field,
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    forward, c = ForwardStage(calm), size * np.column_stack([model.X.free] * 2)
    for k in range(3):
        q = bump(calm, 1.0 + 0.1 * k)
        c, kept = forward.advance(c, q, directions, H, lp.fem.Moment(H * (k + 1)), kept)
    assert 0.0 < np.abs(c[:, 0]).max() < size


def test_a_matrix_that_is_not_positive_definite_is_still_solved(model):
    """A reaction that grows faster than the step resolves."""
    q = bump(model, -400.0)
    c, _ = begun(model)
    forward = ForwardStage(model)
    u = forward.solve(c[:, 0], q, H, lp.fem.Moment(H))
    residual = (
        model.mass @ (u - c[:, 0]) / H + model.B(u) + model.A(u)(q) - model.F(lp.fem.Moment(H))
    )
    np.testing.assert_allclose(residual * model.X.free, 0.0, atol=1e-10)


def test_superlu_refuses_what_it_cannot_factorise_without_pivots():
    rng = np.random.default_rng(0)
    dense = rng.standard_normal((50, 50))
    dense += dense.T
    np.fill_diagonal(dense, 1e-13)
    matrix, x = sp.csr_array(dense), rng.standard_normal(50)
    pattern = Pattern.of(matrix)
    with pytest.raises(LinearAlgebraError, match="not positive definite"):
        SuperLUSolver(pattern, symmetric=True).factorise(matrix.data)
    found = SuperLUSolver(pattern).factorise(matrix.data).solve(dense @ x)
    np.testing.assert_allclose(found, x, atol=1e-10)
