"""Estimates and results are pickled with their values, models with their arguments."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

import livepde as lp
from livepde.fleet import Fleet

MESH = lp.interval(0.0, 1.0, 8)


def conduction(q, u, v, x):
    return q.k * lp.dot(lp.grad(u), lp.grad(v))


def outer(x):
    return x[0] > 0.5


def inner(x):
    return x[0] <= 0.5


def rod(**parts):
    """Return an identifier of a rod, by default with functions that pickle finds by name."""
    unknowns = parts.pop("unknowns", {"k": lp.LogNormal(0.1, std=0.05)})
    A = parts.pop("A", conduction)
    model = lp.Model(lp.Field(MESH, lp.linear(MESH), dirichlet={"left": 1.0}), unknowns, A=A)
    hidden = lp.Points({"W": 0.8})
    return lp.Identifier(
        model, lp.Points({"T": 0.5}, noise=0.01), lp.SensitivityLaw(), u0=0.0, validation=hidden
    )


def layers():
    """Return a rod with lambdas in its forms and in the regions of its unknown."""
    halves = {"outer": lambda x: outer(x), "inner": lambda x: inner(x)}
    return rod(
        unknowns={"k": lp.Piecewise(halves, lp.LogNormal(0.1, std=0.05))},
        A=lambda q, u, v, x: conduction(q, u, v, x),
    )


def field():
    """Return a rod with a field."""
    unknown = lp.Field(MESH, lp.linear(MESH), inner="H1", prior=lp.Normal(0.5, 0.1))
    return rod(unknowns={"k": unknown}, A=lambda q, u, v, x: conduction(q, u, v, x))


RODS = {"a number": rod, "layers and lambdas": layers, "a field": field}


def samples(count=6):
    return [(0.1 * k, {"T": 0.05 * k, "W": 0.04 * k}) for k in range(1, count)]


@pytest.mark.parametrize("name", RODS)
def test_an_estimate_has_the_same_values(name):
    estimate = RODS[name]().run(samples()).last
    again = pickle.loads(pickle.dumps(estimate))
    for attribute in ("q", "u", "q_std", "u_std", "innovation", "validation_error"):
        np.testing.assert_array_equal(getattr(again, attribute), getattr(estimate, attribute))
    assert again.to_dict() == estimate.to_dict()
    assert again.parameters == estimate.parameters
    assert again.diagnostics.named() == estimate.diagnostics.named()
    assert again.verdict.to_dict() == estimate.verdict.to_dict()
    for label in [*estimate.space.labels, *estimate.space.fields]:
        pairs = zip(again[label].interval(), estimate[label].interval(), strict=True)
        for one, other in pairs:
            np.testing.assert_array_equal(one, other)
    assert pickle.dumps(pickle.loads(pickle.dumps(again))) == pickle.dumps(again)
    with pytest.raises(lp.errors.ConfigurationError, match="this estimate was pickled, without"):
        again["u"].at(0.5)


@pytest.mark.parametrize("name", RODS)
def test_a_result_has_the_same_datasets_and_tables(name):
    identifier = RODS[name]()
    result = identifier.run(samples(), fields_every=2)
    again = pickle.loads(pickle.dumps(result))
    xr.testing.assert_identical(again.to_xarray(), result.to_xarray())
    assert again.table() == result.table()
    assert len(again) == len(result)
    assert again.verdict.to_dict() == result.verdict.to_dict()
    xr.testing.assert_identical(pickle.loads(pickle.dumps(again)).to_xarray(), again.to_xarray())
    with pytest.raises(lp.errors.ConfigurationError, match="was pickled, without its model"):
        again.add(result.last)
    with pytest.raises(lp.errors.ConfigurationError, match="samples of this result are not known"):
        again.smoothed()
    assert not hasattr(again, "anything")


def test_a_model_is_built_again_from_its_parts():
    identifier = rod()
    model = pickle.loads(pickle.dumps(identifier.model))
    other = lp.Identifier(
        model,
        lp.Points({"T": 0.5}, noise=0.01),
        lp.SensitivityLaw(),
        u0=0.0,
        validation=lp.Points({"W": 0.8}),
    )
    other.restore(identifier.dump())  # which refuses any other model
    one, two = (who.run(samples()).last for who in (identifier, other))
    np.testing.assert_array_equal(one.q, two.q)


def test_a_model_of_lambdas_says_why_it_cannot_be_pickled():
    model = layers().model
    with pytest.raises(lp.errors.ConfigurationError, match="stores a function by its name"):
        pickle.dumps(model)
    assert copy.deepcopy(model) is model
    assert copy.copy(model) is model


@pytest.mark.slow
def test_another_process_reads_a_result(tmp_path):
    result = layers().run(samples())
    (tmp_path / "result.pickle").write_bytes(pickle.dumps(result))
    code = "import pickle, sys; r = pickle.load(open(sys.argv[1], 'rb')); print(repr(r.last.q[0]))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "result.pickle")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == repr(result.last.q[0])


@pytest.mark.parametrize("law", [lp.SensitivityLaw(), lp.GradientLaw(gain=1.0)])
def test_estimates_of_a_fleet_have_the_same_values(law):
    fleet = Fleet(rod().model, lp.Points({"T": 0.5}, noise=0.01), law, 2, u0=0.0)
    estimate = fleet.step(0.1, [[0.05], [0.06]])
    again = pickle.loads(pickle.dumps(estimate))
    np.testing.assert_array_equal(again.q, estimate.q)
    np.testing.assert_array_equal(again.u, estimate.u)
    for k in range(2):
        np.testing.assert_array_equal(again.member(k).q, estimate.member(k).q)
        assert again.member(k).to_dict() == estimate.member(k).to_dict()
