"""The process M u' + B(u) + A(u) q = F: data, components, algebraic equations."""

from typing import Any

import numpy as np
import pytest
from factories import CASES, laplace, line, observe, product, reaction
from scipy.integrate import trapezoid
from skfem import (
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementTriP1,
    ElementVector,
    MeshTri,
)

import livepde as lp
from livepde.errors import ModelError, SpaceError
from livepde.fem import Inputs, Moment
from livepde.stepping import Advance, Alexander2, ForwardStage, simulate
from livepde.streams import Twin


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_check_model_passes(name):
    lp.diagnostics.check_model(CASES[name].model(f=lambda x, t: x[0] * t)).raise_if_failed()


def test_dirichlet_constant_function_and_channel():
    mesh = line(6)
    dirichlet = {"left": lambda x, t: 3 + x[0] + t, "right": lp.Channel("T_out")}
    model = reaction(mesh, ElementLineHermite(), dirichlet=dirichlet)
    assert model.channels == ("T_out",)
    moment = Moment(0.5, Inputs({"T_out": 7.0}))
    u = np.full(14, 2.0)
    imposed = model.impose(u, moment)
    assert (imposed[0], imposed[12]) == (3.5, 7.0)
    np.testing.assert_array_equal(np.delete(imposed, [0, 12]), 2.0)  # slopes stay free
    np.testing.assert_array_equal(u, 2.0)
    np.testing.assert_array_equal(model.X.fixed, [0, 12])
    with pytest.raises(lp.errors.MissingInputError, match="'T_out' has no value"):
        model.impose(u, Moment(0.5))

    level = reaction(MeshTri().refined(2), ElementTriP1(), dirichlet={"boundary": 4.0})
    start = level.initial(1.0)
    np.testing.assert_array_equal(start[level.X.fixed], 4.0)
    np.testing.assert_allclose(np.delete(start, level.X.fixed), 1.0)


def test_channels_of_forms_and_boundaries_in_order():
    model = reaction(
        line(),
        ElementLineP1(),
        dirichlet={"left": lp.Channel("T_top")},
        f=lp.On("right", lambda x, _: x.inputs["Q"]),
        inputs=("Q", "wind"),
    )
    assert model.channels == ("Q", "wind", "T_top")
    flux = model.F(Moment(0.0, Inputs({"Q": 3.0, "wind": 0.0})))
    np.testing.assert_allclose(flux, 3.0 * (np.arange(13) == 12), atol=1e-15)


def test_sources():
    mesh = line(6)
    numbers = reaction(mesh, ElementLineP1(), f=2.0)
    np.testing.assert_allclose(numbers.F(), 2.0 * numbers.mass @ np.ones(7))
    terms = reaction(mesh, ElementLineP1(), f=[2.0, lambda x, t: x[0] * t, lp.On("left", 5.0)])
    expected = terms.mass @ (2.0 + 3.0 * mesh.p[0]) + 5.0 * (np.arange(7) == 0)
    np.testing.assert_allclose(terms.F(Moment(3.0)), expected, atol=1e-14)
    assert not terms.form_F.constant


def test_mass_term():
    mesh = line(6)
    heavy = reaction(mesh, ElementLineP1(), M=lambda u, v, x: 3.0 * u * v)
    unit = reaction(mesh, ElementLineP1())
    np.testing.assert_allclose(heavy.mass.toarray(), 3 * unit.mass.toarray())
    np.testing.assert_array_equal(heavy.X.gram.toarray(), heavy.mass.toarray())
    with pytest.raises(ModelError, match="M may not depend on time"):
        reaction(mesh, ElementLineP1(), M=lambda u, v, x: (1 + x.t) * u * v)
    with pytest.raises(SpaceError, match="of X is singular"):
        _ = reaction(mesh, ElementLineP1(), M=lambda u, v, x: (x[0] > 0.5) * u * v).X.factor


def test_quadrature_order():
    mesh = line(6)
    assert reaction(mesh, ElementLineHermite()).order == 9
    state = lp.Field(mesh, ElementLineP2())
    assert lp.Model(state, lp.Normal(), product).order == 4
    chosen = lp.Field(mesh, ElementLineP2(), quadrature=7)
    assert lp.Model(chosen, lp.Normal(), product).order == 7


def test_bilinear_operators():
    model = reaction(line(6), ElementLineP1())
    stiffness = model.bilinear(laplace)
    np.testing.assert_allclose(stiffness @ np.ones(7), 0.0, atol=1e-13)
    with pytest.raises(ModelError, match="may not depend on time"):
        model.bilinear(lambda u, v, x: x.t * u * v)


def test_initial_parameter():
    mesh = line(6)
    model = reaction(mesh, ElementLineP1(), q_dirichlet={"boundary": 0.0})
    q = model.initial_parameter(lambda x: 1 + x[0])
    assert (q[0], q[-1]) == (0.0, 0.0)
    np.testing.assert_allclose(q[1:-1], 1 + mesh.p[0, 1:-1], atol=1e-12)
    bounded = lp.Model(lp.Field(mesh, ElementLineP1()), lp.Normal(1.0, bounds=(0.0, 2.0)), product)
    assert bounded.initial_parameter() == [1.0]
    with pytest.raises(ModelError, match="outside the bounds"):
        bounded.initial_parameter(3.0)


def heated(source):
    """A reaction with a source, and its inputs."""
    model = reaction(line(), ElementLineP1(), f=source, inputs=("Q",))
    return model, Inputs({"Q": 3.0})


def test_a_source_is_evaluated_again_only_where_it_may_have_changed():
    counts = {"evaluated": 0}

    def held(x, _):
        counts["evaluated"] += 1
        return x.inputs["Q"] + x[0]

    model, first = heated(held)
    counts["evaluated"] = 0
    found = [model.F(Moment(t, first)) for t in (0.0, 0.5, 1.0)]
    assert counts["evaluated"] == 1
    assert found[0] is found[2]
    second = Inputs({"Q": 4.0})
    np.testing.assert_allclose((model.F(Moment(1.0, second)) - found[0]).sum(), 1.0)
    assert counts["evaluated"] == 2
    changing = {"Q": 3.0}  # a dictionary may change without notice
    np.testing.assert_array_equal(model.F(Moment(1.0, changing)), found[0])
    changing["Q"] = 4.0
    np.testing.assert_allclose((model.F(Moment(1.0, changing)) - found[0]).sum(), 1.0)


def behind(x):
    """Read the time in a helper function, on a branch that is not probed."""
    return x.t if x.inputs["Q"] > 2.0 else 0.0


@pytest.mark.parametrize(
    "source",
    [
        lambda x, t: t * x[0],
        lambda x, t: x.t * x[0],
        lambda x, t: x.t if x.inputs["Q"] > 2.0 else 0.0,  # on the branch that is not probed
        lambda x, *rest: rest[0] * x[0],
        lambda x, t: behind(x),
        lambda x, t: sum(x.t * k for k in (1.0, 2.0)) if x.inputs["Q"] > 2.0 else 0.0,
    ],
)
def test_a_source_that_may_read_the_time_is_evaluated_at_every_time(source):
    model, inputs = heated(source)
    early, late = (model.F(Moment(t, inputs)) for t in (1.0, 2.0))
    np.testing.assert_allclose(late, 2.0 * early)
    assert early.any()


def twin_of(model, sensors, q, times, **options):
    return Twin(model=model, observation=sensors, q_true=q, times=times, **options)


def diffusion(u, v):
    return lp.dot(lp.grad(u), lp.grad(v))


def exchange(mesh, parameter=None, **options):
    """Return a solute in water (c) and on grains (s), exchanged at an unknown rate."""
    return lp.Model(
        state={
            "c": lp.Field(
                mesh, ElementLineP2(), dirichlet={"left": lp.Channel("inflow")}, unit="g/l"
            ),
            "s": lp.Field(mesh, ElementLineP1(), unit="g/kg"),
        },
        parameter=parameter or {"k": lp.Normal(1.0, 1.0)},
        A=lambda q, u, v, x: q.k * (u.c - u.s) * (v.c - v.s),
        B=lambda u, v, x: 0.05 * diffusion(u.c, v.c),
        **options,
    )


@pytest.fixture
def mesh():
    return lp.interval(0.0, 1.0, 10)


def test_blocks_and_default_mass(mesh):
    model = exchange(mesh)
    c, s = (model.state_space.part(name) for name in ("c", "s"))
    one = model.state_space.interpolate({"c": 2.0, "s": 3.0})
    assert model.X.inner(one, one) == pytest.approx(4.0 + 9.0)
    assert abs(model.mass[c, s]).max() == 0.0
    assert model.state_space.dim == 21 + 11
    assert model.channels == ("inflow",)
    assert model.affine


def test_the_block_matrix_is_that_of_two_models(mesh):
    model = exchange(mesh)
    c, s = (model.state_space.part(name) for name in ("c", "s"))
    stiff = model.form_B.matrix("v", "u")
    alone = lp.Model(
        lp.Field(mesh, ElementLineP2(), quadrature=model.order),
        lp.Normal(),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: 0.05 * diffusion(u, v),
    )
    assert abs(stiff[c, c] - alone.form_B.matrix("v", "u")).max() < 1e-13
    assert abs(stiff[s, s]).max() == 0.0
    assert np.allclose(model.mass[c, c].toarray(), alone.mass.toarray(), atol=1e-15)


def test_boundary_values_of_each_component(mesh):
    model = lp.Model(
        {
            "a": lp.Field(mesh, ElementLineHermite(), dirichlet={"left": lambda x, t: 2.0 + t}),
            "b": lp.Field(mesh, ElementLineP1(), dirichlet={"right": lp.Channel("z"), "left": 1.0}),
        },
        lp.Normal(),
        A=lambda q, u, v, x: q * u.a * v.b,
    )
    u = model.impose(np.zeros(model.state_space.dim), Moment(3.0, Inputs({"z": 7.0})))
    ends = np.array([[0.0, 1.0]])
    assert np.allclose(model.state_space.probe(ends, of="a") @ u, [5.0, 0.0])
    assert np.allclose(model.state_space.probe(ends, of="b") @ u, [1.0, 7.0])
    assert len(model.X.fixed) == 3


def test_sources_by_component(mesh):
    model = exchange(mesh, f=[{"s": 2.0}, lp.On("right", {"c": lambda x, t: 3.0 + t})])
    F = model.F(Moment(1.0))
    assert F[model.state_space.part("s")].sum() == pytest.approx(2.0)
    assert F[model.state_space.part("c")].sum() == pytest.approx(4.0)


def test_sensors_name_their_component(mesh):
    model = exchange(mesh)
    u = model.state_space.interpolate({"c": lambda x: x[0], "s": lambda x: 1.0 - x[0]})
    spaces = (model.state_space, model.X, model.parameter_space)
    half = {"half": lambda x: x[0] < 0.5}
    for sensor, expected in (
        (lp.Points([0.25], of="c"), 0.25),
        (lp.Points([0.25], of="s"), 0.75),
        (lp.Averages(half, of="s"), 0.75),
        (lp.Subdomain(lambda x: x[0] > 0.9, of="s"), [0.1, 0.0]),
    ):
        assert sensor.bind(*spaces).G @ u == pytest.approx(expected, abs=1e-9)
    with pytest.raises(SpaceError, match=r"components \['c', 's'\]: specify one"):
        lp.Points([0.25]).bind(*spaces)
    with pytest.raises(SpaceError, match="of='w'"):
        lp.Points([0.25], of="w").bind(*spaces)


@pytest.mark.long
@pytest.mark.parametrize("sparse", [True, False])
def test_both_laws_learn_an_exchange_rate(mesh, sparse):
    model = exchange(mesh, {"k": lp.Normal(1.0, 1.0, bounds=(0.0, 20.0))})
    times = np.arange(0.0, 4.01, 0.05)
    inflow = lambda t: {"inflow": 1.0 + np.sin(2.0 * t)}  # noqa: E731
    if sparse:
        sensors, law = lp.Points([0.3, 0.7], of="c", noise=1e-3), lp.SensitivityLaw()
    else:
        sensors = lp.Full(of="c")
        law = lp.GradientLaw(gain=1e3, damping=lp.laws.ResidualDamping(c1=1.0))
    options = {"u0": 0.0, "inputs": inflow, "scheme": law.scheme}
    twin = twin_of(model, sensors, {"k": 2.5}, times, **options)
    ident = lp.Identifier(model, sensors, law)
    result = ident.run(twin)
    assert twin.error(result.last.q) < (0.01 if sparse else 0.05)
    data = result.to_xarray()
    assert data.attrs["state"] == "c s"
    assert data["c"].shape == data["s"].shape
    assert data["s"].attrs["units"] == "g/kg"
    exact = twin.u(times[-1])
    s = model.state_space.component("s")[0].at_vertices @ exact[model.state_space.part("s")]
    assert np.abs(data["s"][-1].values - s[np.argsort(mesh.p[0])]).max() < 0.05


@pytest.mark.slow
def test_plots_draw_every_component(mesh):
    pytest.importorskip("matplotlib")
    model = exchange(mesh)
    sensors = lp.Points([0.3], of="c", noise=0.1)
    twin = twin_of(
        model, sensors, {"k": 2.0}, [0.0, 0.1, 0.2], u0=0.0, inputs=lambda t: {"inflow": 1.0}
    )
    result = lp.Identifier(model, sensors, lp.SensitivityLaw()).run(twin)
    labels = [ax.get_ylabel() for ax in result.plot().axes]
    assert any(label.startswith("c ") for label in labels)
    assert any(label.startswith("s ") for label in labels)
    assert result.table()["k"]["value"] > 0


def test_truth_on_another_mesh_and_by_formula(mesh):
    sensors = lp.Points([0.3], of="s")
    options = {"inputs": lambda t: {"inflow": 1.0}}
    fine = exchange(lp.interval(0.0, 1.0, 40))
    twin = twin_of(
        exchange(mesh), sensors, {"k": 2.0}, [0.0, 0.2], u0=0.0, truth="fine", fine=fine, **options
    )
    coarse = twin_of(exchange(mesh), sensors, {"k": 2.0}, [0.0, 0.2], u0=0.0, **options)
    assert np.abs(twin.u(0.2) - coarse.u(0.2)).max() < 0.2
    formula = {"c": lambda x, t: 1.0 + 0 * x[0], "s": lambda x, t: x[0] * t}
    twin = twin_of(
        exchange(mesh), sensors, {"k": 2.0}, [0.0, 0.2], u_true=formula, truth="analytic", **options
    )
    assert twin.exact_data[1] == pytest.approx(0.06)


def test_a_nonlinear_reaction_system_conserves_mass(mesh):
    model = lp.Model(
        {"a": lp.Field(mesh, ElementLineP1()), "b": lp.Field(mesh, ElementLineP1())},
        {"k": lp.Normal(1.0)},
        A=lambda q, u, v, x: q.k * u.a**2 * (v.a - v.b),
        B=lambda u, v, x: diffusion(u.a, v.a) + 0.1 * diffusion(u.b, v.b),
    )
    assert not model.affine
    lp.diagnostics.check_model(model).raise_if_failed()
    total = model.mass @ model.state_space.interpolate(1.0)
    run = simulate(
        model,
        np.array([3.0]),
        {"a": lambda x: 1 + x[0], "b": 0.0},
        [0.0, 0.5, 1.0],
        Advance(Alexander2(), 0.1),
    )
    masses = [total @ u for _, u in run]
    assert np.allclose(masses, 1.5, atol=1e-9)


def test_vector_fields():
    mesh = MeshTri().refined(2)
    field = lp.Field(mesh, ElementVector(ElementTriP1()))
    model = lp.Model(
        {"w": field, "T": lp.Field(mesh, ElementTriP1())},
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * lp.fem.ddot(lp.grad(u.w), lp.grad(v.w)) + q * diffusion(u.T, v.T),
        f={"w": lambda x, t: np.stack([1.0 + 0 * x[0], 2.0 + 0 * x[0]])},
    )
    u = model.state_space.interpolate({"w": lambda x: np.stack([x[0], x[1] ** 0]), "T": 4.0})
    assert model.X.inner(u, u) == pytest.approx(1 / 3 + 1 + 16)
    assert model.F() @ u == pytest.approx(0.5 + 2.0)
    sensors = lp.Points([(0.5, 0.5)], of="T", noise=0.1)
    ident = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=0.0)
    data = ident.run([lp.Sample(0.2, [1.0])]).to_xarray()
    assert data.attrs["state"] == "w_x w_y T"
    assert set(data["w_x"].dims) == {"snapshot", "vertex"}


GOOD, OTHER = (lp.Field(line(10), ElementLineP1()) for _ in range(2))
NO = lp.Normal()


def coupled(u: Any, q: Any = NO, **options: Any) -> lp.Model:
    return lp.Model(u, q, lambda q, u, v, x: 1.0 * u.a * v.a, **options)


@pytest.mark.parametrize(
    ("error", "message", "build"),
    [
        (ModelError, "share one mesh object", lambda: coupled({"a": GOOD, "b": OTHER})),
        (ModelError, "must be a Field", lambda: coupled({"a": GOOD, "b": NO})),
        (ModelError, r"both called \['a'\]", lambda: coupled({"a": GOOD, "b": GOOD}, {"a": NO})),
        (ModelError, "give a mapping", lambda: coupled({"a": GOOD, "b": GOOD}, f=1.0)),
        (
            SpaceError,
            "a function for each",
            lambda: coupled({"a": GOOD, "b": GOOD}).initial(lambda x: x[0]),
        ),
        (SpaceError, "specify one", lambda: coupled({"a": GOOD, "b": GOOD}).state_block),
        (
            SpaceError,
            r"'u': coefficients of shape \(3,\); expected \(11,\)",
            lambda: lp.Model(GOOD, NO, product).initial(np.zeros(3)),
        ),
        (
            ModelError,
            "parameter 'q': only zero boundary values",
            lambda: reaction(line(), ElementLineP1(), q_dirichlet={"boundary": 1.0}),
        ),
        (
            ModelError,
            r"there is no 'd'; there are \['D', 'r'\]",
            lambda: lp.Model(GOOD, {"D": NO, "r": NO}, A=lambda q, u, v, x: q.d * u * v),
        ),
    ],
)
def test_bad_states_and_unknowns(error: Any, message: str, build: Any):
    with pytest.raises(error, match=message):
        build()


def test_a_number_is_the_initial_value_of_all_components():
    np.testing.assert_allclose(coupled({"a": GOOD, "b": GOOD}).initial(2.0), 2.0)


MESH = lp.interval(0.0, 1.0, 16)
D, SIGMA = 0.2, 0.7


def electrolyte(held: bool = True, mass: Any = None) -> lp.Model:
    """Return a diffusing concentration and the quasi-static potential of its charge."""
    inflow = {"left": lambda x, t: np.sin(t) + 0.0 * x[0]}
    state = {
        "c": lp.Field(MESH, ElementLineP1(), dirichlet=inflow),
        "phi": lp.Field(MESH, ElementLineP1(), dirichlet={"right": 0.0} if held else {}),
    }
    unknowns = {"D": lp.LogNormal(0.3, 0.2), "sigma": lp.LogNormal(1.0, 0.5)}

    def fluxes(q: Any, u: Any, v: Any, x: Any) -> Any:
        diffusion = q.D * lp.dot(lp.grad(u.c), lp.grad(v.c))
        return diffusion + q.sigma * lp.dot(lp.grad(u.phi), lp.grad(v.phi))

    def charge(u: Any, v: Any, x: Any) -> Any:
        return -u.c * v.phi

    return lp.Model(state, unknowns, fluxes, charge, M=mass or (lambda u, v, x: u.c * v.c))


def test_only_components_without_a_mass_are_algebraic():
    model = electrolyte()
    part = model.state_space.part("phi")
    free = np.flatnonzero(model.X.free)
    assert model.algebraic.tolist() == [k for k in free if part.start <= k < part.stop]
    assert not len(electrolyte(mass=lambda u, v, x: u.c * v.c + u.phi * v.phi).algebraic)


def test_a_model_with_an_algebraic_component_passes_its_check():
    report = lp.diagnostics.check_model(electrolyte(), u=0.5)
    report.raise_if_failed()
    names = [line.name for line in report.lines]
    assert "M positive definite (failures)" in names
    assert "algebraic components: size of their inverse" in names


@pytest.mark.filterwarnings("ignore:the diffusion of 'c' is negative")  # relative to M
@pytest.mark.parametrize(
    ("options", "failed"),
    [
        ({"held": False}, ["algebraic components: size of their inverse"]),
        ({"mass": lambda u, v, x: -u.c * v.c}, ["M positive definite (failures)"]),
    ],
)
def test_a_model_that_does_not_determine_the_state_fails(options: Any, failed: list[str]):
    report = lp.diagnostics.check_model(electrolyte(**options), u=0.5)
    assert [line.name for line in report.failed] == failed


def test_the_potential_is_that_of_the_concentration_at_every_moment():
    """For -sigma phi'' = c, phi(1) = 0, phi'(0) = 0: phi(0) = integral of (1 - x) c / sigma."""
    model = electrolyte()
    forward, u = ForwardStage(model), model.initial(0.0)
    space = model.state_space
    nodes = MESH.p[0]
    for k in range(5):
        u = forward.solve(u, np.log([D, SIGMA]), 0.3, lp.fem.Moment(0.3 * (k + 1)))
        c, phi = u[space.part("c")], u[space.part("phi")]
        fine = np.linspace(0.0, 1.0, 4001)
        inner = (1.0 - fine) * np.interp(fine, nodes, c)
        expected = trapezoid(inner, fine) / SIGMA
        assert phi[np.argmin(nodes)] == pytest.approx(expected, rel=1e-5)


def samples(sensors: lp.observation.Observation, noise: float) -> list[tuple[float, Any]]:
    model, rng = electrolyte(), np.random.default_rng(0)
    observed = observe(model, sensors)
    forward, u, found = ForwardStage(model), model.initial(0.0), []
    for k in range(60):
        for j in range(10):  # the truth has ten steps per step of the filter
            moment = lp.fem.Moment(0.1 * k + 0.01 * (j + 1))
            u = forward.solve(u, np.log([D, SIGMA]), 0.01, moment)
        z = observed.G @ u
        found.append((0.1 * (k + 1), z + noise * rng.standard_normal(len(z))))
    return found


@pytest.mark.parametrize("refit", [None, lp.laws.Refit()])
@pytest.mark.parametrize("of", ["phi", "c and phi"])
@pytest.mark.slow
def test_both_unknowns_are_identified_from_the_potential(refit: Any, of: str):
    law = lp.SensitivityLaw(refit=refit, shadows=None)
    noise = 0.01
    potential = lp.Points({"phi_2": 0.2, "phi_6": 0.6}, of="phi", noise=noise)
    concentration = lp.Points({"c_5": 0.5}, of="c", noise=noise)
    sensors = potential if of == "phi" else lp.Combined([concentration, potential])
    options: Any = {"u0": 0.0, "scheme": lp.Alexander2()}
    identifier = lp.Identifier(electrolyte(), sensors, law, **options)
    estimate = None
    for t, z in samples(sensors, noise):
        estimate = identifier.step(t, z)
        assert estimate.status.ok
    for name, true in (("D", D), ("sigma", SIGMA)):
        value, std = estimate.parameters[name]
        assert abs(value - true) < 4.0 * std < 0.4 * true


def test_the_gradient_law_needs_a_mass_everywhere():
    potential = lp.Points([0.2, 0.6], of="phi")
    with pytest.raises(lp.errors.LawError, match="no mass term, so M is not an inner product"):
        lp.Identifier(electrolyte(), potential, lp.GradientLaw())
