"""Estimates that are computed when read, and results that store numbers instead of objects."""

import copy
import math
import pickle
from array import array
from dataclasses import replace
from sys import getsizeof

import numpy as np
import pytest

import livepde as lp
from livepde.checkpoint import flatten
from livepde.estimate import read_together
from livepde.frames import interval_ends
from livepde.models import heat
from livepde.readout import ScalarReadout


def rod(unknown=None, law=None, validation=None, cells=30):
    ends = {"left": lp.Channel("T_left"), "right": lp.Channel("T_right")}
    alpha = unknown or lp.Normal(0.02, std=0.01, bounds=(1e-3, 1.0))
    model = heat(lp.interval(0.0, 1.0, cells), alpha, ends, source=lp.Normal(0.0, std=1.0))
    sensors = lp.Points({f"T_{k}": k / 6 for k in range(1, 6)}, noise=0.01)
    law = law or lp.SensitivityLaw()
    return lp.Identifier(model, sensors, law, validation=validation, u0=1.0)


def samples(count, extra=()):
    rng = np.random.default_rng(3)
    for k in range(1, count + 1):
        names = [*(f"T_{n}" for n in range(1, 6)), *extra]
        values = dict(zip(names, (1.0 + 0.1 * rng.normal(size=len(names))).tolist(), strict=True))
        yield 0.1 * k, values | {"T_left": 1.0 + math.sin(k), "T_right": 1.0}


UNKNOWNS = [
    lp.Normal(0.02, std=0.01, bounds=(1e-3, 1.0)),
    lp.Normal(0.02, std=0.01),
    lp.LogNormal(0.02, std=0.01),
    lp.LogitNormal(0.02, std=0.01, bounds=(1e-3, 1.0)),
]


SHORT = {"refit": lp.laws.Refit(start=4), "shadows": None}
# Each law once, and each unknown with one of them.
PAIRS = [
    (UNKNOWNS[0], lp.SensitivityLaw()),
    *((unknown, lp.SensitivityLaw(**SHORT)) for unknown in UNKNOWNS[1:]),
    (UNKNOWNS[2], lp.GradientLaw()),
]


@pytest.mark.long
@pytest.mark.parametrize(("unknown", "law"), [*PAIRS, (UNKNOWNS[3], lp.SensitivityLaw(**SHORT))])
def test_an_estimate_that_is_read_later_is_the_same(unknown, law):
    """What `step` returns does not change while the identifier goes on."""
    one, other = rod(unknown, law), rod(unknown, law)
    later = [one.step(*sample) for sample in samples(12)]
    for estimate, sample in zip(later, samples(12), strict=True):
        at_once = other.step(*sample).belief
        read = estimate.belief
        assert read is estimate.belief
        for name in ("q", "u", "q_factor", "u_factor", "prior_factor", "rest"):
            np.testing.assert_array_equal(getattr(read, name), getattr(at_once, name))


def test_estimates_that_are_read_together_are_the_same():
    """To the bit, also where the intervals of only some of them are wider than expected."""
    taken = [*samples(12)]
    for _, values in taken[:6]:
        values |= {f"T_{n}": 1.0 for n in range(1, 6)}
    alone, together = ([*map(rod(UNKNOWNS[2]).step, *zip(*taken, strict=True))] for _ in range(2))
    read_together(together)
    for one, other in zip(alone, together, strict=True):
        assert one.diagnostics.named() == other.diagnostics.named()
        for name in ("q", "u", "q_factor", "u_factor", "prior_factor", "rest"):
            np.testing.assert_array_equal(getattr(one.belief, name), getattr(other.belief, name))


@pytest.mark.slow
def test_an_unread_estimate_holds_no_factor_of_the_stage():
    """What it keeps until it is read is of the size of the belief that it gives then."""
    identifier = rod(cells=300)  # what the gate remembers of five sensors is little beside it
    for sample in samples(5):
        estimate = identifier.step(*sample)
    _, now = vars(estimate)["_read"].item
    leaves = flatten(replace(now, ledger=None))  # an empty one, which all estimates share
    assert not now.ledger.rows.size
    held = [leaf for leaf in leaves.values() if isinstance(leaf, np.ndarray)]
    belief = estimate.belief
    given = [belief.q, belief.u, belief.q_factor, belief.u_factor]
    # Beside it the shifts by step and mesh, and the state on the halved mesh.
    assert 0 < sum(x.nbytes for x in held) <= 3 * sum(x.nbytes for x in given)
    assert not hasattr(estimate, "_read")


@pytest.mark.slow
def test_an_estimate_is_copied_with_its_belief():
    identifier = rod()
    for sample in samples(3):
        estimate = identifier.step(*sample)
    other = copy.deepcopy(estimate)
    assert other.belief is not estimate.belief
    np.testing.assert_array_equal(other.q_std, estimate.q_std)
    belief = pickle.loads(pickle.dumps(estimate.belief))
    np.testing.assert_array_equal(belief.u, estimate.u)
    with pytest.raises(AttributeError, match="no attribute 'velocity'"):
        estimate.velocity  # noqa: B018


@pytest.mark.long
@pytest.mark.parametrize(("unknown", "law"), PAIRS)
def test_numbers_of_a_record_are_those_of_the_estimate(unknown, law):
    """To the bit: value, deviation, ends of the interval and share left, label by label."""
    identifier = rod(unknown, law)
    readout = ScalarReadout(identifier.model.parameter_space)
    for sample in samples(12):
        estimate = identifier.step(*sample)
        space = estimate.space
        left = estimate.belief.left([*space.labels.values()])
        wanted = []
        for (label, (value, std)), share in zip(estimate.parameters.items(), left, strict=True):
            ends = interval_ends(label, space.unknown_of(label), value, std)
            wanted += [value, std, *map(float, ends.values()), float(share)]
        np.testing.assert_array_equal(readout([estimate.belief])[0], wanted)


@pytest.mark.long
def test_a_result_keeps_little_more_than_its_numbers():
    identifier = rod(validation=lp.Points({"T_0": 0.4}))
    count = 300
    result = identifier.run(samples(count, ["T_0"]))
    records, axes = result.records, {"time", "snapshot"}
    data = result.to_xarray()
    # `estimates` repeats numbers of other variables.
    kept = [data[name] for name in data if axes & set(data[name].dims) and name != "estimates"]
    needed = 8 * count + sum(values.nbytes for values in kept)
    parts = [*vars(records).values(), *records._notes.values(), *records._fields]
    held = sum(getsizeof(part) for part in parts if isinstance(part, array | list | bytes))
    assert data.sizes["snapshot"] == data.sizes["time"] == count
    assert needed <= held + 4 * 8 * count  # the matrix of correlations is told once
    assert held <= 1.2 * (needed + 4 * 8 * count)
