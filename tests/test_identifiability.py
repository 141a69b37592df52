"""Which unknowns a belief reports as well determined, not identifiable, correlated or bounded."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
from livepde.cases.preview import StatedNoise
from livepde.diagnostics import Identifiability
from livepde.diagnostics.information_gain import InformationGain, information_gains

MESH = lp.interval(0.0, 1.0, 12)
TIMES = 0.1 * np.arange(1, 31)


def learned(unknowns: dict[str, Any], rate: Any, points: Any = (0.5,), z: float = 1.0) -> Any:
    """Return model and belief after samples z = const; u_t = (u_x)_x - rate(q) u, insulated."""
    model = lp.Model(
        lp.Field(MESH, ElementLineP1()),
        unknowns,
        A=lambda q, u, v, x: rate(q) * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    sensors = lp.Points(list(points), noise=1e-3)
    identifier = lp.Identifier(model, sensors, StatedNoise(modes=8), u0=1.0)
    for t in TIMES:
        identifier.step(t, np.full(len(points), z))
    belief = identifier._latent_belief()
    return model, belief


def report(*args: Any, **options: Any) -> Identifiability:
    return information_gains(*learned(*args, **options))


@pytest.mark.slow
def test_pinned_and_flat():
    found = report({"a": lp.Normal(0.0, 1.0), "b": lp.Normal(0.0, 1.0)}, lambda q: q.a)
    assert [item.verdict for item in found.unknowns] == ["pinned", "flat"]
    assert found.unknowns[1].left == pytest.approx(1.0)
    assert (found.pairs, found.directions, found.sentences) == ((), (), [])


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_two_that_only_their_difference_shows_are_named_whatever_their_units(scale: float):
    unknowns = {"a": lp.Normal(0.0, 1.0), "b": lp.Normal(0.0, scale)}
    found = report(unknowns, lambda q: q.a - q.b / scale)
    assert [item.verdict for item in found.unknowns] == ["partly", "partly"]
    assert [item.left for item in found.unknowns] == pytest.approx([0.5**0.5] * 2, abs=1e-3)
    ((a, b, r),) = found.pairs
    assert (a, b) == ("a", "b")
    assert r == pytest.approx(1.0, abs=1e-3)
    assert found.sentences[0].startswith("a and b are correlated (")


@pytest.mark.parametrize(
    ("left", "text"), [(0.01, "both are well determined"), (0.3, "not each alone")]
)
def test_a_correlation_of_two_that_are_well_determined_is_no_ambiguity(left: float, text: str):
    unknowns = (InformationGain("a", 0.01), InformationGain("b", left))
    (found,) = Identifiability(unknowns, (("a", "b", 0.99),), ()).sentences
    assert text in found


@pytest.mark.slow
def test_three_of_which_only_a_sum_shows():
    unknowns = {name: lp.Normal(0.0, 1.0) for name in "abc"}
    found = report(unknowns, lambda q: q.a + q.b + q.c)
    assert found.pairs == ()
    (direction,) = found.directions
    assert np.abs(list(direction.weights.values())) == pytest.approx(3 * [3**-0.5], abs=1e-3)
    assert "Of a, b, c, the data identify only the combination" in found.sentences[0]


@pytest.mark.slow
def test_modes_of_a_field_and_a_number_that_stands_for_its_mean():
    field = lp.Field(MESH, ElementLineP1(), inner="H1", prior=lp.Normal(std=1.0))
    alone = report({"q": field}, lambda q: q.q)
    pinned, flat, count = alone.unknowns[0].modes
    assert count == 8
    assert 0 < pinned < count
    assert 0 < flat < count
    assert alone.sentences == [
        f"q: the data determine {pinned} of 8 modes well, and leave {flat} at their prior."
    ]
    more = report({"q": field}, lambda q: q.q, points=(0.1, 0.3, 0.5, 0.7, 0.9))
    assert more.unknowns[0].left < alone.unknowns[0].left
    both = report({"q": field, "a": lp.Normal(0.0, 1.0)}, lambda q: q.q + q.a)
    assert [pair[:2] for pair in both.pairs] == [("a", "q")]


@pytest.mark.slow
def test_a_number_at_its_bound():
    found = report({"a": lp.Normal(0.5, 1.0, bounds=(0.2, 2.0))}, lambda q: q.a, z=1.5)
    assert found.unknowns[0].verdict == "at its bound"
    assert found.unknowns[0].bound == 0.2


@pytest.mark.slow
def test_one_that_moves_is_never_flat_for_good():
    walk = lp.Scalar(lp.Normal(0.0, 1.0), evolution=lp.RandomWalk(1.0))
    (known,) = report({"a": walk}, lambda q: 0.0 * q.a).unknowns
    assert known.left > 1.0
    assert known.verdict == "partly"


@pytest.mark.slow
def test_the_width_counts():
    model, belief = learned({"a": lp.Normal(0.0, 1.0)}, lambda q: q.a)
    (known,) = information_gains(model, belief).unknowns
    (wider,) = information_gains(model, replace(belief, q_factor=3.0 * belief.q_factor)).unknowns
    assert wider.left == pytest.approx(3 * known.left)


@pytest.mark.slow
def test_a_law_without_covariance():
    model, belief = learned({"a": lp.Normal(0.0, 1.0)}, lambda q: q.a)
    with pytest.raises(lp.errors.ConfigurationError, match="use SensitivityLaw"):
        information_gains(model, replace(belief, q_factor=None))
