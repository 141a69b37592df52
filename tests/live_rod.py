"""Live runs of a rod whose rows come from a growing file."""

import math
from functools import cache
from pathlib import Path

import numpy as np

import livepde as lp
from livepde.frames import layout_of
from livepde.runs.feeds import Gathered
from livepde.runs.journal import Journal
from livepde.runs.live_loop import Live
from livepde.streams.clock import Clock
from livepde.streams.intake import Intake
from livepde.streams.sources import Follow
from livepde.streams.table import Column

COLUMNS = {name: Column((name,)) for name in ("a", "b", "left")}
CLOCK = Clock("t")
OPENED: list = []  # sources; the test module that uses them closes them after each test


def identifier(*, verdict: bool = True) -> lp.Identifier:
    mesh = lp.interval(0.0, 1.0, 10)
    model = lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("left"), "right": 0.0}),
        parameter={"k": lp.Normal(0.05, std=0.03)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    sensors = lp.Points({"a": 0.3, "b": 0.6}, noise=0.01)
    refit = lp.laws.Refit(start=4) if verdict else None  # refits take half of the time of a run
    law = lp.SensitivityLaw(refit=refit, shadows=None, verdict=verdict)
    return lp.Identifier(model, sensors, law)


@cache
def readings(count: int) -> np.ndarray:
    """Return noisy readings that match `identifier`: for other data, runs search for causes."""
    who = identifier()
    times = [0.1 * k for k in range(count)]
    q = who.model.initial_parameter({"k": 0.06})
    control = lp.Advance(lp.Alexander2(), dt_max=0.05)
    states = lp.simulate(who.model, q, 0.0, times, control, lambda t: {"left": left(t)})
    clean = np.array([who.observed.G @ u for _, u in states])
    return clean + 0.01 * np.random.default_rng(0).standard_normal((count, 2))


def left(t: float) -> float:
    return 1.0 + math.sin(t)


def rows(count: int):
    for k, (a, b) in enumerate(readings(count).tolist()):
        yield {"t": 0.1 * k, "a": a, "b": b, "left": left(0.1 * k)}


def journal(path: Path) -> Journal:
    who = identifier()
    layout = layout_of(who.model, who.observed, who.validation)
    return Journal.create(path, ("a", "b", "left"), layout)


def live(folder: Path, source=None, *, verdict: bool = True, **options) -> Live:
    path = folder / "journal.sqlite"
    kept = Journal.open(path, write=True) if path.exists() else journal(path)
    if source is None:
        source = Follow(folder / "data.csv", position=kept.position)
    OPENED.append(source)
    intake = Intake(COLUMNS, CLOCK, origin=0.0, last=kept.last)
    intake.past = kept
    return Live(
        identifier(verdict=verdict), Gathered(source, intake), kept, fields_every=10, **options
    )


def write(folder: Path, count: int) -> None:
    lines = ["t,a,b,left", *(",".join(map(repr, row.values())) for row in rows(count))]
    (folder / "data.csv").write_text("\n".join(lines) + "\n")


def same(one: Journal, other: Journal) -> None:
    mine, yours = list(one), list(other)
    assert len(mine) == len(yours) > 0
    for a, b in zip(mine, yours, strict=True):
        for name in ("t", "numbers", "innovation", "status", "steps"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        assert (a.snapshot is None) == (b.snapshot is None)
        if a.snapshot is not None:
            for name, values in a.snapshot.profiles.items():
                assert np.array_equal(values, b.snapshot.profiles[name])
