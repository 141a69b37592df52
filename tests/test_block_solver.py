"""Solving large coupled stages by blocks gives the results of one factor in few iterations."""

import tracemalloc

import numpy as np
import pytest
from factories import laplace, reaction, square
from skfem import ElementTriP1

import livepde as lp
from benchmarks import scale
from livepde.errors import ConfigurationError, LinearAlgebraError
from livepde.fem import Moment
from livepde.laws.coupled import stage_solvers
from livepde.laws.coupled.equation import Metric, StageProblem
from livepde.laws.coupled.stage_solvers import BilinearSolver, BlockJacobian, BlockSolver
from livepde.linalg import solvers

EXACT = lp.stepping.Newton(tolerance=1e-11, share=0.0)


def inside(x):
    return (x[0] < 0.6) | (x[1] < 0.6)


def plane(cells=16, *, diffusion=1.0, **options):
    return reaction(
        square(cells),
        ElementTriP1(),
        dirichlet={"boundary": 2.0},
        B=lambda u, v, x: diffusion * laplace(u, v, x),
        f=lambda x, t: 10 * (1 + x[0]) * (1 + 0.3 * np.sin(3 * t)),
        **options,
    )


def data_of(model, sensors, times):
    q = model.initial_parameter(lambda x: 1 + np.sin(np.pi * x[0]) ** 2 * x[1])
    G = sensors.matrix(model.state_space)
    return [G @ u for _, u in lp.simulate(model, q, 2.0, times, lp.Advance(lp.ImplicitEuler()))]


def run(model, sensors, law, monkeypatch, large, samples=5, missing=None, **options):
    """Return (u, q) of each step, and the iterations of each solve by blocks."""
    monkeypatch.setattr(stage_solvers, "LARGE", 1 if large else 10**9)
    monkeypatch.setattr(solvers, "WIDEST_BAND", 10)  # as it would be on a finer mesh
    times = 0.05 * np.arange(samples)
    ident = lp.Identifier(model, sensors, law, q0=0.5, u0=2.0, **options)
    counts = []
    iterate = BlockJacobian.iterate

    def counted(self, *args, **options):
        x, count = iterate(self, *args, **options)
        counts.append(count)
        return x, count

    monkeypatch.setattr(BlockJacobian, "iterate", counted)
    found = []
    for k, (t, z) in enumerate(zip(times, data_of(model, sensors, times), strict=True)):
        estimate = ident.step(t, np.full_like(z, np.nan) if k == missing else z)
        assert estimate.status.ok
        found.append(np.concatenate([estimate.u, estimate.q]))
    monkeypatch.setattr(BlockJacobian, "iterate", iterate)
    return np.array(found), counts


CASES = {
    "all observed": ({}, lp.Full(), {}),
    "a part observed": ({}, lp.Subdomain(inside), {}),
    "constant mu, nu, sigma": (
        {},
        lp.Subdomain(inside),
        {"damping": lp.laws.ConstantDamping(0.5, floor=0.1), "nu": 0.1, "sigma": 0.1},
    ),
    "a diffusivity": (
        {"A": lambda q, u, v, x: (0.1 + q) * lp.dot(lp.grad(u), lp.grad(v)), "diffusion": 0.0},
        lp.Full(),
        {},
    ),
    "time-dependent": ({"A": lambda q, u, v, x: (1 + x.t) * q * u * v}, lp.Full(), {}),
    "nonlinear in q": ({"A": lambda q, u, v, x: q**3 * u * v}, lp.Full(), {}),
    "H^1.5": ({"inner": lp.Sobolev(1.5, length=0.3)}, lp.Full(), {}),
    "tunes itself": ({}, lp.Full(), {"gain": "auto"}),
}


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_blocks_do_not_change_the_result(name, monkeypatch):
    form, sensors, options = CASES[name]
    model = plane(**form)
    law = lp.GradientLaw(**{"gain": 1e3, "newton": EXACT} | options)
    direct, none = run(model, sensors, law, monkeypatch, large=False)
    blocks, counts = run(model, sensors, law, monkeypatch, large=True)
    assert not none
    assert counts
    np.testing.assert_allclose(blocks, direct, rtol=0, atol=1e-8 * abs(direct).max())


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1e3, "auto"])
@pytest.mark.parametrize("sensors", [lp.Full(), lp.Subdomain(inside)], ids=["full", "part"])
def test_blocks_serve_a_step_in_which_nothing_is_measured(sensors, gain, monkeypatch):
    model, law = plane(), lp.GradientLaw(gain, newton=EXACT)
    direct, _ = run(model, sensors, law, monkeypatch, large=False, missing=3)
    blocks, counts = run(model, sensors, law, monkeypatch, large=True, missing=3)
    assert counts
    np.testing.assert_allclose(blocks, direct, rtol=0, atol=1e-8 * abs(direct).max())


@pytest.mark.slow
def test_a_law_that_tunes_itself_learns_little_from_what_blocks_leave(monkeypatch):
    model, law = plane(), lp.GradientLaw("auto")
    q = model.initial_parameter(lambda x: 1 + np.sin(np.pi * x[0]) ** 2 * x[1])
    errors = []
    for large in (False, True):
        found, _ = run(model, lp.Full(), law, monkeypatch, large=large, samples=26)
        errors.append(np.linalg.norm(found[-1, model.X.dim :] - q))
    assert errors[1] < 1.03 * errors[0]


@pytest.mark.long
def test_blocks_serve_the_second_order_scheme_and_averages(monkeypatch):
    model = plane()
    sensors = lp.Averages({f"z{k}": lambda x, k=k: abs(x[0] - 0.2 * k) < 0.1 for k in range(1, 5)})
    law = lp.GradientLaw(gain=1e2, newton=EXACT)
    options = {"scheme": lp.Alexander2()}
    direct, _ = run(model, sensors, law, monkeypatch, large=False, **options)
    blocks, counts = run(model, sensors, law, monkeypatch, large=True, **options)
    assert counts
    np.testing.assert_allclose(blocks, direct, rtol=0, atol=1e-8 * abs(direct).max())


def first_stage(model, gain, monkeypatch, sensors=None, c1=1.0):
    """Return the solver by blocks, the first stage, and a point."""
    monkeypatch.setattr(stage_solvers, "LARGE", 1)
    monkeypatch.setattr(solvers, "WIDEST_BAND", 10)
    law = lp.GradientLaw(gain=gain, damping=lp.laws.ResidualDamping(c1))
    ident = lp.Identifier(model, sensors or lp.Full(), law, q0=0.5, u0=2.0)
    stage = ident._work.stage(np.ones(ident.observed.size, dtype=bool))
    assert isinstance(stage.solver, BlockSolver)
    u = model.initial(lambda x: 2.0 + x[0] * (1 - x[0]) * x[1] * (1 - x[1]))
    c = np.concatenate([u, model.initial_parameter(0.5)])
    metric = Metric(1.0 / gain)
    u_alpha = stage.terms.forms.split.R @ u
    data = stage.solver.data(StageProblem(c, 0.05, Moment(0.05), u_alpha, metric))
    return stage.solver, data, c


@pytest.mark.slow
def test_iterations_with_new_factors(monkeypatch):
    """To 1e-8, on two meshes: they hardly depend on the mesh."""
    monkeypatch.setattr(stage_solvers, "LARGE", 1)
    monkeypatch.setattr(solvers, "WIDEST_BAND", 10)
    outcome = scale.iterations((1600, 2500))
    assert len(outcome.checks) == 2 * len(scale.ITERATIONS)
    assert [check.name for check in outcome.checks if not check.ok] == []
    engines = ("LU", "CHOLMOD")
    assert all(any(engine in row[4] for engine in engines) for row in outcome.tables[0].rows)
    assert all(row[5] for row in outcome.tables[0].rows)
    monkeypatch.setattr(stage_solvers, "LARGE", 10**9)
    with pytest.raises(ConfigurationError, match="use more"):
        scale.iterations((300,))


FORMS = {
    "nonlinear in q": lambda q, u, v, x: (q + q**3) * u * v,
    "nonlinear in u": lambda q, u, v, x: q * u**2 * v,
    "a diffusivity": lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
}


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("sensors", [lp.Full(), lp.Subdomain(inside)], ids=["full", "part"])
@pytest.mark.parametrize("c1", [0.0, 1.0])
def test_the_jacobian_by_blocks_is_the_derivative(form, sensors, c1, monkeypatch):
    model = plane(A=FORMS[form])
    solver, data, c = first_stage(model, 10.0, monkeypatch, sensors, c1)
    free = np.concatenate([model.X.free, model.Q.free])
    rng = np.random.default_rng(0)
    y = c + 0.1 * free * rng.standard_normal(len(c))
    direction = free * rng.standard_normal(len(c))
    found = solver.factor(data, solver.evaluate(data, y)).apply(direction)
    step = 1e-5
    ahead, back = (solver.evaluate(data, y + s * step * direction).residual for s in (1, -1))
    np.testing.assert_allclose(found, (ahead - back) / (2 * step), atol=1e-6 * abs(found).max())


def test_a_part_that_hardly_moves_does_not_hold_up_the_other(monkeypatch):
    """Without a residual in the second line its update is rounding, which GMRES cannot reduce."""
    model, law = plane(), lp.GradientLaw("auto", newton=EXACT)
    _, counts = run(model, lp.Full(), law, monkeypatch, large=True, missing=3, samples=4)
    assert max(counts) < 20


def settled(model, sensors, samples, identifier=None):
    """Step through the samples; return estimates, and how often factors were made in each step."""
    made, counts = [], []
    factorise = BlockSolver.factorise

    def counted(self, name, *args, **options):
        made.extend([name] if name == "S" else [])
        return factorise(self, name, *args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BlockSolver, "factorise", counted)
        estimates = []
        for sample in samples:
            made.clear()
            estimates.append(identifier.step(*sample))
            counts.append(len(made))
    return estimates, counts


@pytest.fixture
def stream(monkeypatch):
    monkeypatch.setattr(stage_solvers, "LARGE", 1)
    monkeypatch.setattr(solvers, "WIDEST_BAND", 10)
    model, sensors = plane(), lp.Subdomain(inside)
    times = 0.05 * np.arange(30)
    samples = list(zip(times, data_of(model, sensors, times), strict=True))

    def fresh(gain=10.0):
        return lp.Identifier(model, sensors, lp.GradientLaw(gain=gain), q0=0.5, u0=2.0)

    return model, sensors, samples, fresh


@pytest.mark.slow
@pytest.mark.parametrize("gain", [10.0, "auto"])
def test_a_run_resumed_gives_the_same_numbers(gain, stream, tmp_path):
    model, sensors, samples, fresh = stream
    whole = fresh(gain)
    settled(model, sensors, samples[:20], whole)
    whole.save(tmp_path / "half.bin")
    again = fresh(gain)
    again.load(tmp_path / "half.bin")
    one, kept = settled(model, sensors, samples[20:], whole)
    other, made = settled(model, sensors, samples[20:], again)
    assert made[0] == kept[0] + 1
    assert made[1:] == kept[1:]
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(a.u, b.u)
        assert np.array_equal(a.q, b.q)


@pytest.mark.slow
def test_nothing_of_the_size_of_the_square_is_made(monkeypatch):
    """64 times the unknowns may take at most 100 times the memory of a step."""
    monkeypatch.setattr(stage_solvers, "LARGE", 1)
    monkeypatch.setattr(solvers, "WIDEST_BAND", 2)

    def peak(cells):
        model, sensors = plane(cells), lp.Subdomain(inside)
        times = 0.05 * np.arange(3)
        samples = list(zip(times, data_of(model, sensors, times), strict=True))
        tracemalloc.start()
        ident = lp.Identifier(model, sensors, lp.GradientLaw(), q0=0.5, u0=2.0)
        for sample in samples:
            assert ident.step(*sample).status.ok
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    assert peak(64) < 100 * peak(8)


@pytest.mark.slow
def test_a_system_that_does_not_converge_is_a_status(monkeypatch):
    solver, data, c = first_stage(plane(), 1e6, monkeypatch)
    at = solver.evaluate(data, 1.1 * c)
    K = solver.factor(data, at)
    with pytest.raises(LinearAlgebraError, match="smaller gain or a smaller time step"):
        K.iterate(at.residual, 0.0)

    def fails(self, b):
        return K.iterate(at.residual, 0.0)[0]

    monkeypatch.setattr(BlockJacobian, "solve", fails)
    model, sensors = plane(), lp.Full()
    times = 0.05 * np.arange(2)
    ident = lp.Identifier(model, sensors, lp.GradientLaw(gain=1e6), q0=0.5, u0=2.0)
    z = data_of(model, sensors, times)
    ident.step(0.0, z[0])
    estimate = ident.step(0.05, z[1])
    assert estimate.status.code == "singular"
    assert np.isfinite(estimate.u).all()


def test_banded_problems_are_factorised_at_any_size(monkeypatch):
    monkeypatch.setattr(stage_solvers, "LARGE", 1)
    mesh = lp.interval(0.0, 1.0, 40)
    model = lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
        parameter=lp.Field(mesh, lp.linear(mesh)),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    ident = lp.Identifier(model, lp.Full(), lp.GradientLaw(), q0=0.5, u0=0.0)
    stage = ident._work.stage(np.ones(ident.observed.size, dtype=bool))
    assert isinstance(stage.solver, BilinearSolver)
