"""A checkpoint is only accepted by the problem that saved it."""

import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np
import pytest

import livepde as lp
from livepde.fleet import Fleet, Shard


def law(**options: Any) -> lp.SensitivityLaw:
    return lp.SensitivityLaw(shadows=None, **options)


PLAIN: dict[str, Any] = {"factor": 1.0, "std": 0.05, "place": 0.5, "left": 1.0, "noise": 0.01}
STEPS: dict[str, Any] = {"u0": 0.0, "dt_max": np.inf}
CASES: dict[str, tuple[dict[str, Any], str]] = {
    "equation": ({"factor": 3.0}, "another model"),
    "equation, a little": ({"factor": 1.0001}, "another model"),
    "mesh": ({"cells": 22}, "n = "),
    "moved nodes": ({"grade": 1.1}, "another model"),
    "boundary value": ({"left": 1.01}, "another model"),
    "source": ({"f": 0.1}, "another model"),
    "source that depends on time": ({"f": lambda x, t: 0.1 * t + 0.0 * x[0]}, "another model"),
    "prior": ({"std": 0.005}, "another prior"),
    "prior mean": ({"mean": 0.11}, "another prior"),
    "evolution": ({"evolution": lp.RandomWalk(0.1)}, "another prior"),
    "place": ({"place": 0.51}, "another sensor"),
    "noise": ({"noise": 0.02}, "another sensor"),
    "gate": ({"law": law(gate=4.0)}, "another option of the law"),
    "refit": ({"law": law(refit=None)}, "another option of the law"),
    "dt_max": ({"dt_max": 0.1}, "another scheme, dt_max"),
    "scheme": ({"scheme": lp.ImplicitEuler()}, "another scheme, dt_max"),
    "initial state": ({"u0": 0.1}, "another u0 or q0"),
    "initial parameter": ({"q0": {"k": 0.11}}, "another u0 or q0"),
}


def parts(**changed: Any) -> tuple[Any, dict[str, Any]]:
    given = {**PLAIN, **changed}
    nodes = np.linspace(0.0, 1.0, given.get("cells", 20) + 1) ** given.get("grade", 1.0)
    mesh = lp.interval(0.0, 1.0, len(nodes) - 1)
    mesh = type(mesh)(nodes[None], mesh.t).with_boundaries({"left": lambda x: x[0] == 0.0})
    prior = lp.LogNormal(given.get("mean", 0.1), std=given["std"])
    moves = {"evolution": given["evolution"]} if "evolution" in given else {}
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": given["left"]}),
        {"k": lp.Scalar(prior, **moves)},
        A=lambda q, u, v, x: given["factor"] * q.k * lp.dot(lp.grad(u), lp.grad(v)),
        f=given.get("f", 0.0),
    )
    sensors = lp.Points({"T": given["place"]}, noise=given["noise"])
    rule = given.get("law", law())
    keywords = {name: given[name] for name in ("q0", "scheme") if name in given}
    return (model, sensors, rule), {**STEPS, **keywords} | {
        name: given[name] for name in STEPS if name in given
    }


def rod(**changed: Any) -> lp.Identifier:
    positional, keywords = parts(**changed)
    return lp.Identifier(*positional, **keywords)


def begun(**changed: Any) -> lp.Identifier:
    who = rod(**changed)
    for k in range(1, 6):
        who.step(0.1 * k, [0.05 * k])
    return who


@cache
def saved() -> bytes:
    return begun().dump()


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_checkpoint_of_another_problem_is_refused(case):
    changed, message = CASES[case]
    other = rod(**changed)
    before = other.dump()
    with pytest.raises(lp.errors.RunError, match=message):
        other.restore(saved())
    assert other.dump() == before


@pytest.mark.parametrize(
    "options",
    [{}, {"left": lambda x, t: np.sin(t) + 0.0 * x[0]}, {"evolution": lp.RandomWalk(0.1)}],
)
def test_the_same_problem_built_again_continues(options):
    who, other = begun(**options), rod(**options)
    other.restore(who.dump())
    np.testing.assert_array_equal(who.step(0.6, [0.3]).q, other.step(0.6, [0.3]).q)


def test_a_run_that_is_judged_continues_one_that_was_not():
    rod().restore(begun(law=law(verdict=False)).dump())


def test_rounding_of_another_machine_does_not_matter():
    shift = {"factor": 1.0 + 1e-12, "left": 1.0 - 1e-12, "noise": 0.01 * (1.0 + 1e-12)}
    rod(**shift).restore(saved())


@pytest.mark.slow
def test_another_process_has_the_same_fingerprint(tmp_path):
    begun().save(tmp_path / "a.bin")
    code = "import sys; sys.path.insert(0, sys.argv[1]); import test_checkpoint_fingerprint as t; "
    code += "t.rod().load(sys.argv[2])"
    here = str(__file__).rpartition("/")[0]
    done = subprocess.run(
        [sys.executable, "-c", code, here, str(tmp_path / "a.bin")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("case", ["equation", "gate", "initial state"])
def test_fleets_and_shards_refuse_other_problems_too(case):
    changed, message = CASES[case]
    (positional, keywords), (others, options) = parts(), parts(**changed)
    fleet = Fleet(*positional, 2, **keywords)
    fleet.step(0.1, [[0.05], [0.06]])
    Fleet(*positional, 2, **keywords).restore(fleet.dump())
    with pytest.raises(lp.errors.RunError, match=message):
        Fleet(*others, 2, **options).restore(fleet.dump())
    shard = Shard(*positional, ["a", "b"], **keywords)
    shard.step(0, [("a", 0.1, [0.05])])
    Shard(*positional, ["a", "b"], **keywords).load(shard.dump())
    with pytest.raises(lp.errors.RunError, match=message):
        Shard(*others, ["a", "b"], **options).load(shard.dump())


def test_a_member_continues_as_an_identifier_of_its_own():
    """Members with another start have the fingerprint of an identifier with that start."""
    positional, keywords = parts()
    fleet = Fleet(*positional, 2, **{**keywords, "u0": [0.0, 0.2], "q0": [{"k": 0.1}, {"k": 0.2}]})
    fleet.step(0.1, [[0.05], [0.06]])
    for k, (u0, q0) in enumerate([(0.0, 0.1), (0.2, 0.2)]):
        rod(u0=u0, q0={"k": q0}).restore(fleet.identifier(k).dump())
    with pytest.raises(lp.errors.RunError, match="another u0 or q0"):
        rod(u0=0.0).restore(fleet.identifier(1).dump())
