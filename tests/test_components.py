"""States of several components: forms, boundary values, sensors and laws see each by name."""

import numpy as np
import pytest
from skfem import (
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementTriP1,
    ElementVector,
    MeshTri,
)

import livepde as lp
from livepde.fem import START, Inputs, Moment
from livepde.stepping import Advance, Alexander2, simulate
from livepde.streams import Twin


def twin_of(model, sensors, q, times, **options):
    return Twin(model=model, observation=sensors, q_true=q, times=times, **options)


def diffusion(u, v):
    return lp.dot(lp.grad(u), lp.grad(v))


def exchange(mesh, parameter=None, **options):
    """A solute that moves in water (c) and sits on the grains (s), exchanged at an unknown rate."""
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
    with pytest.raises(lp.errors.SpaceError, match=r"components \['c', 's'\]: specify one"):
        lp.Points([0.25]).bind(*spaces)
    with pytest.raises(lp.errors.SpaceError, match="of='w'"):
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


def test_nonlinear_reaction_system_conserves_what_it_turns_over(mesh):
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


def test_bad_states(mesh):
    good, other = lp.Field(mesh, ElementLineP1()), lp.Field(lp.interval(0, 1, 10), ElementLineP1())
    A = lambda q, u, v, x: q * u.a * v.a  # noqa: E731
    with pytest.raises(lp.errors.ModelError, match="share one mesh object"):
        lp.Model({"a": good, "b": other}, lp.Normal(), A)
    with pytest.raises(lp.errors.ModelError, match="must be a Field"):
        lp.Model({"a": good, "b": lp.Normal()}, lp.Normal(), A)
    with pytest.raises(lp.errors.ModelError, match=r"both called \['a'\]"):
        lp.Model({"a": good, "b": good}, {"a": lp.Normal()}, A)
    with pytest.raises(lp.errors.ModelError, match="give a mapping"):
        lp.Model({"a": good, "b": good}, lp.Normal(), A, f=1.0)
    model = lp.Model({"a": good, "b": good}, lp.Normal(), A)
    with pytest.raises(lp.errors.SpaceError, match="a function for each"):
        model.initial(lambda x: x[0])
    with pytest.raises(lp.errors.SpaceError, match="specify one"):
        _ = model.state_block
    assert np.allclose(model.initial(2.0, START), 2.0)
