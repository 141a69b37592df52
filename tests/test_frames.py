"""Verdict and intervals do not depend on axes, direction or time origin of a body.

The data are from a line; a sheet with insulated sides has the same data.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import livepde as lp
from livepde.laws.stored_samples import principal
from livepde.models import heat

PLACES = {"a": (0.15, 0.25), "b": (0.3, 0.5), "c": (0.55, 0.75), "d": (0.8, 0.375)}
TIMES = 0.1 * np.arange(1, 31)
WIDTH = 0.5
LAYERS: Any = {"one": lambda x: x[0] < 0.5, "two": lambda x: x[0] > 0.5}
RATE = 0.3  # of the loss to the surroundings at 15 degrees


@dataclass(frozen=True)
class Frame:
    flat: bool = False  # a line; else a sheet
    swapped: bool = False  # the line is along y
    mirrored: bool = False
    origin: float = 0.0  # of time
    unit: float = 1.0  # of time
    scale: float = 1.0  # of readings
    split: bool = False  # the sensors are in two groups


def driven(t: float) -> dict[str, float]:
    return {"T_0": 20.0 + 5.0 * np.sin(1.3 * t) + 2.0 * (t > 2.0), "T_1": 20.0 - 3.0 * np.sin(t)}


def process(frame: Frame) -> lp.Model:
    sides = ("left", "right") if not frame.swapped else ("bottom", "top")
    sides = sides[::-1] if frame.mirrored else sides
    mesh: Any = lp.interval(0.0, 1.0, 12)
    if frame.flat:
        x, y, cells = (0.0, 1.0), (0.0, WIDTH), (12, 2)
        mesh = lp.rectangle(*((y, x, cells[::-1]) if frame.swapped else (x, y, cells)))
    ends = {side: lp.Channel(name) for side, name in zip(sides, ("T_0", "T_1"), strict=True)}
    unknowns = {name: lp.LogNormal(0.1, 0.05) for name in ("alpha", "loss")}
    rate = 1.0 / frame.unit
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet=ends),
        unknowns,
        A=[
            lambda q, u, v, x: rate * q.alpha * lp.dot(lp.grad(u), lp.grad(v)),
            lambda q, u, v, x: rate * q.loss * (u - 15.0 * frame.scale) * v,
        ],
    )


def sensors(frame: Frame) -> lp.observation.Observation:
    found: dict[str, Any] = {}
    for name, (x, y) in PLACES.items():
        along, across = 1.0 - x if frame.mirrored else x, WIDTH * y
        place = (across, along) if frame.swapped else (along, across)
        found[name] = place if frame.flat else along
    names, noise = list(found), 0.05 * frame.scale
    if not frame.split:
        return lp.Points(found, noise=noise)
    groups = [{name: found[name] for name in some} for some in (names[:3], names[3:])]
    return lp.Combined([lp.Points(group, noise=noise) for group in groups])


@cache
def readings() -> tuple[dict[str, float], ...]:
    """Return the readings of a line, of which one sensor is two samples late."""
    model, seen = process(Frame()), [tuple(PLACES).index(name) for name in PLACES]
    scheme = lp.Advance(lp.Alexander2(), 0.05)
    times = [0.0, *TIMES.tolist()]
    plant = lp.simulate(model, np.array([0.06, RATE]), 20.0, times, scheme, driven)
    nodes = np.linspace(0.0, 1.0, 13)
    along = [x for x, _ in PLACES.values()]
    rows = [np.interp(along, nodes, model.state_block.at_vertices @ u) for _, u in plant]
    z = np.array(rows)[1:][:, seen]
    z[2:, 2] = z[:-2, 2].copy()
    z += 0.05 * np.random.default_rng(1).standard_normal(z.shape)
    return tuple(dict(zip(PLACES, row.tolist(), strict=True)) for row in z)


@cache
def ended(frame: Frame) -> lp.Estimate:
    model, held = process(frame), {"T_0": "hold", "T_1": "hold"}
    parts: Any = {"u0": 20.0 * frame.scale, "t0": frame.origin, "between": held}
    identifier = lp.Identifier(model, sensors(frame), **parts)
    size = frame.scale
    samples = [
        (
            frame.origin + frame.unit * t,
            {name: size * value for name, value in row.items()},
            {name: size * value for name, value in driven(t).items()},
        )
        for t, row in zip(TIMES.tolist(), readings(), strict=True)
    ]
    last = identifier.run(samples).last
    return last


SHEET = Frame(flat=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frame", "other"),
    [
        (Frame(), Frame(mirrored=True, origin=500.0, unit=3600.0, split=True)),
        (SHEET, replace(SHEET, swapped=True, scale=1.0 + 1e-12)),  # and rounding
    ],
)
def test_verdict_and_intervals_do_not_depend_on_the_frame(frame: Frame, other: Frame):
    one, two = ended(frame), ended(other)
    assert one.verdict.level == two.verdict.level != "trusted"
    shown = [
        [
            (finding.what, finding.subject, *[(each.kind, each.subject) for each in finding.causes])
            for finding in estimate.verdict.findings
        ]
        for estimate in (one, two)
    ]
    assert shown[0] == shown[1]
    assert max(len(finding.causes) for finding in one.verdict.findings) > 1
    for first, second in zip(one.verdict.findings, two.verdict.findings, strict=True):
        shares = [[cause.share for cause in each.causes] for each in (first, second)]
        assert shares[0] == pytest.approx(shares[1], rel=1e-5, nan_ok=True)
    errors = one.verdict.errors, two.verdict.errors
    for name in ("alpha", "loss"):
        ends = [(each[name].low, each[name].high, each[name].wider) for each in errors]
        assert ends[0] == pytest.approx(ends[1], rel=1e-5)


@pytest.mark.slow
def test_layers_are_the_same_by_name_and_by_place():
    """Names of cells and of their halves, on which the discretisation is judged, agree."""

    def stds(**regions: Any) -> Any:
        mesh = lp.interval(0.0, 1.0, 12, regions={name: LAYERS[name] for name in LAYERS})
        k = lp.Piecewise(regions, lp.LogNormal(0.1, 0.05))
        ends = {"left": lp.Channel("T_0"), "right": lp.Channel("T_1")}
        places = lp.Points({name: x for name, (x, _) in PLACES.items()}, noise=0.05)
        identifier = lp.Identifier(heat(mesh, k, ends), places, u0=20.0)
        rows = zip(TIMES.tolist(), readings(), strict=True)
        last = identifier.run([(t, row, driven(t)) for t, row in rows]).last
        return last.q_std

    by_name, by_place = stds(**{name: name for name in LAYERS}), stds(**LAYERS)
    np.testing.assert_allclose(by_name, by_place, rtol=1e-9)


@pytest.mark.slow
def test_the_offset_that_is_proposed_is_twice_the_one_that_is_named():
    """Both are those of the fit, and not one of a fit and one of a linear model."""
    rows = [{**row, "b": row["b"] + 2.0} for row in readings()]
    places = lp.Points({name: x for name, (x, _) in PLACES.items() if name != "c"}, noise=0.05)
    identifier = lp.Identifier(process(Frame()), places, u0=20.0)
    samples = [
        (t, {name: row[name] for name in row if name != "c"}, driven(t))
        for t, row in zip(TIMES.tolist(), rows, strict=True)
    ]
    verdict = identifier.run(samples).verdict
    cause = next(one for one in verdict.findings if one.what == "misfit").causes[0]
    assert (cause.kind, cause.subject) == ("offset", "b")
    assert cause.size == pytest.approx(2.0, abs=0.05)
    assert cause.setting == f"channels.b.offset={2.0 * cause.size:.2g}"
    assert f"`offset = {2.0 * cause.size:.2g}`" in cause.remedy


@pytest.mark.slow
def test_members_that_are_stepped_apart_begin_as_single_runs_do():
    """The discretisation is judged from the initial state of each member, and not of the first."""
    places = lp.observation.Calibrated(
        lp.Points({name: x for name, (x, _) in PLACES.items()}), lambda y, q, x: 1.0 * y, noise=0.05
    )
    starts = [20.0, lambda x: 20.0 + np.sin(9.0 * x[0]), lambda x: 20.0 - np.sin(11.0 * x[0])]
    model, law = process(Frame()), lp.SensitivityLaw(verdict=False)
    fleet = lp.Fleet(model, places, law, len(starts), u0=starts)
    assert not fleet.together
    singles = [lp.Identifier(model, places, law, u0=u0) for u0 in starts]
    for t, row in zip(TIMES[:4].tolist(), readings(), strict=False):
        found = fleet.step(t, row, driven(t))
        for k, single in enumerate(singles):
            one = single.step(t, row, driven(t))
            np.testing.assert_allclose(found.member(k).q_std, one.q_std, rtol=1e-12)
            np.testing.assert_allclose(found.member(k).u_std, one.u_std, rtol=1e-12)


def test_what_rounding_takes_from_the_prior_is_put_back():
    """Readings that tell one direction up to the last digit leave no negative or singular rest."""
    J = 1e10 * np.array([[1.0, 1.0 / 3.0, 0.1], [3.0, 1.0, 0.3]])
    H = np.eye(3) + J.T @ J
    assert np.linalg.eigvalsh(H)[0] < 0.0  # as it is computed
    sizes, axes = principal(H)
    np.testing.assert_allclose(sizes[-1], np.trace(H), rtol=1e-12)
    assert sizes[0] == 1.0
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
