"""The process M u' + B(u) + A(u) q = F, its boundary data, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from factories import CASES, laplace, line, product, reaction
from skfem import ElementLineHermite, ElementLineP1, ElementLineP2, ElementTriP1, MeshTri

import livepde as lp
from livepde.fem import Inputs, Moment


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


def test_a_function_of_space_on_a_boundary():
    mesh = MeshTri().refined(3).with_boundaries({"left": lambda x: x[0] == 0})
    model = reaction(mesh, ElementTriP1(), dirichlet={"left": lambda x, t: x[1] ** 2 + t})
    u = model.impose(np.zeros(model.X.dim), Moment(2.0))
    nodes = model.X.fixed
    np.testing.assert_allclose(u[nodes], mesh.p[1, nodes] ** 2 + 2.0)


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
    with pytest.raises(lp.errors.ModelError, match="M may not depend on time"):
        reaction(mesh, ElementLineP1(), M=lambda u, v, x: (1 + x.t) * u * v)
    with pytest.raises(lp.errors.SpaceError, match="of X is singular"):
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
    with pytest.raises(lp.errors.ModelError, match="may not depend on time"):
        model.bilinear(lambda u, v, x: x.t * u * v)


def test_initial_parameter():
    mesh = line(6)
    model = reaction(mesh, ElementLineP1(), q_dirichlet={"boundary": 0.0})
    q = model.initial_parameter(lambda x: 1 + x[0])
    assert (q[0], q[-1]) == (0.0, 0.0)
    np.testing.assert_allclose(q[1:-1], 1 + mesh.p[0, 1:-1], atol=1e-12)
    bounded = lp.Model(lp.Field(mesh, ElementLineP1()), lp.Normal(1.0, bounds=(0.0, 2.0)), product)
    assert bounded.initial_parameter() == [1.0]
    with pytest.raises(lp.errors.ModelError, match="outside the bounds"):
        bounded.initial_parameter(3.0)


def test_parameter_boundary_values_must_be_zero():
    with pytest.raises(lp.errors.ModelError, match="parameter 'q': only zero boundary values"):
        reaction(line(), ElementLineP1(), q_dirichlet={"boundary": 1.0})


def test_initial_state_of_a_wrong_shape():
    with pytest.raises(
        lp.errors.SpaceError, match=r"'u': coefficients of shape \(3,\); expected \(13,\)"
    ):
        reaction(line(), ElementLineP1()).initial(np.zeros(3))


def test_a_name_that_is_no_unknown_is_said():
    with pytest.raises(lp.errors.ModelError, match=r"there is no 'd'; there are \['D', 'r'\]"):
        lp.Model(
            lp.Field(line(), ElementLineP1()),
            {"D": lp.Normal(1.0), "r": lp.Normal(1.0)},
            A=lambda q, u, v, x: q.d * u * v,
        )


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
    changing = {"Q": 3.0}  # a dictionary may change behind its back
    np.testing.assert_array_equal(model.F(Moment(1.0, changing)), found[0])
    changing["Q"] = 4.0
    np.testing.assert_allclose((model.F(Moment(1.0, changing)) - found[0]).sum(), 1.0)


def behind(x):
    """Read the time in a helper, on a branch that is not probed."""
    return x.t if x.inputs["Q"] > 2.0 else 0.0


@pytest.mark.parametrize(
    "source",
    [
        lambda x, t: t * x[0],
        lambda x, t: x.t * x[0],
        lambda x, t: x.t if x.inputs["Q"] > 2.0 else 0.0,  # not on the branch that is probed
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
