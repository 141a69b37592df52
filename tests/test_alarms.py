"""Jumps from the case file to the report, identifiability, and the benchmark of alarms."""

import json
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1
from typer.testing import CliRunner

import livepde as lp
from livepde import cases, runs
from livepde.cases.new_case import write_template
from livepde.cli import app
from livepde.diagnostics import identifiability
from livepde.models import heat
from livepde.runs import doubts, measures, tables

JUMP, CHANGE, END = 2400.0, 1.3, 4400.0
TRUE_ALPHA, NOISE = 9.7e-5, 0.05  # of the template's rod: aluminium, m^2/s; in degC


def ends(t: float) -> dict[str, float]:
    return {"T_left": 20.0 + 15.0 * np.sin(2 * np.pi * t / 1200.0), "T_right": 20.0}


@cache
def rows(change: float) -> str:
    """Return the data of the template's rod, whose diffusivity changes after 2400 s."""
    values = {"left": lp.Channel("T_left"), "right": lp.Channel("T_right")}
    model = heat(lp.interval(0.0, 0.4, 40), lp.Normal(TRUE_ALPHA), values)
    points = lp.Points({"T_10": 0.1, "T_20": 0.2, "T_30": 0.3})
    G, control = points.matrix(model.state_space), lp.Advance(lp.Alexander2(), 20.0)
    rng, u = np.random.default_rng(0), np.full(model.X.dim, 20.0)
    lines = ["time_s,T_left,T_10,T_20,T_30,T_right", "0,20,20,20,20,20"]
    for t0, t1 in pairwise(np.arange(0.0, END + 1.0, 20.0).tolist()):
        q = np.array([TRUE_ALPHA * (change if t0 >= JUMP else 1.0)])
        u = list(lp.simulate(model, q, u, [t0, t1], control, ends))[-1][1]
        inner = G @ u + NOISE * rng.standard_normal(3)
        cells = [ends(t1)["T_left"], *inner, ends(t1)["T_right"]]
        lines.append(",".join([f"{t1:g}", *(f"{value:.4f}" for value in cells)]))
    return "\n".join(lines) + "\n"


def rod(folder: Path, change: float = CHANGE, jumps: str = "true") -> Path:
    case, data = write_template(folder)
    data.write_text(rows(change))
    text = case.read_text().split("[expect]")[0]
    case.write_text(text.replace("[law]", f"[law]\njumps = {jumps}"))
    return case


@pytest.mark.long
def test_a_jump_is_in_tables_sentences_figure_and_record(tmp_path: Path):
    case = rod(tmp_path / "rod")
    done = CliRunner().invoke(app, ["run", str(case), "--out", str(tmp_path / "run"), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["measures"]["jumps"] == 1
    assert said["measures"]["alpha"] == pytest.approx(CHANGE * TRUE_ALPHA, rel=0.02)
    (jump,) = [table for table in said["tables"] if table["title"] == "Jumps"]
    ((when, label, before, after),) = jump["rows"]
    assert label == "alpha"
    assert float(before) == pytest.approx(TRUE_ALPHA, rel=0.02)
    assert float(after.split(" ±")[0]) == pytest.approx(CHANGE * TRUE_ALPHA, rel=0.02)
    t = float(when.removeprefix("t = ").removesuffix(" s"))
    assert JUMP < t <= JUMP + 30 * 20.0
    (sentence,) = [note for note in said["notes"] if note.startswith("Jump at")]
    assert "Since then alpha has changed from" in sentence
    opened = runs.open(tmp_path / "run")
    assert [table.title for table in opened.summary()].count("Jumps") == 1
    lines = [
        line.get_label()
        for ax in lp.plots.overview(opened.dataset).axes
        for line in ax.lines
        if "jump" in str(line.get_label())
    ]
    assert len(lines) == 3  # the unknown, innovations, and validation channels


@pytest.mark.long
def test_no_jump_no_word(tmp_path: Path):
    case = cases.load(rod(tmp_path / "rod", change=1.0)).prepare()
    data = runs.drive(case.identifier, case.stream).result.to_xarray()
    assert measures(data)["jumps"] == 0
    assert "Jumps" not in [table.title for table in tables(data)]
    assert not [sentence for sentence in doubts(data) if "Jump" in sentence]


@pytest.mark.slow
def test_settings_of_the_test_reach_the_law(tmp_path: Path):
    law: Any = cases.load(rod(tmp_path / "a", jumps="{ probability = 1e-3, window = 8 }")).law
    assert (law.jumps.probability, law.jumps.window, law.jumps.size) == (1e-3, 8, 1.0)
    assert cases.load(rod(tmp_path / "b", jumps="false")).law.jumps is None
    for k, (bad, what) in enumerate(
        {"{ window = 3 }": "power of two", "{ windows = 8 }": "windows"}.items()
    ):
        with pytest.raises(lp.errors.CaseError, match=what):
            cases.load(rod(tmp_path / str(k), jumps=bad))


def dataset(jumped: list[int], before: float = 1.0, after: float = 2.0) -> Any:
    """Return the dataset of a run of ten samples with alarms at some of them."""
    model = lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 4), ElementLineP1()),
        {"a": lp.Normal(1.0, 1.0)},
        A=lambda q, u, v, x: q.a * u * v,
        time_unit="s",
    )
    law = lp.SensitivityLaw(jumps=lp.Jumps())
    identifier = lp.Identifier(model, lp.Points([0.5], noise=0.1), law, u0=1.0)
    data = identifier.run([(t, [1.0]) for t in np.arange(1.0, 11.0)]).to_xarray()
    data["jump"].values[:] = np.isin(np.arange(10), jumped)
    data["a"].values[:] = np.where(np.arange(10) < min(jumped, default=0), before, after)
    data["a_std"].values[:] = 0.1
    return data


def said(data: Any) -> list[str]:
    return [sentence for sentence in doubts(data) if "ump" in sentence]


@pytest.mark.slow
def test_what_has_moved_between_two_alarms():
    first, second = runs.jumps(dataset([4, 7]))
    assert (first.t, second.t) == (5.0, 8.0)
    assert first.moved == {"a": (1.0, 2.0, pytest.approx(0.1))}
    assert second.moved == {}
    told = said(dataset([4, 7]))
    assert told[0].startswith("Jump at t = 5 s: ")
    assert "No number changed permanently" in told[1]


@pytest.mark.slow
def test_many_jumps_are_counted_and_dates_are_dates():
    data = dataset([2, 3, 4, 5, 6, 7, 8])
    data.attrs["origin"] = "2025-04-01 12:00:00"
    told = said(data)
    assert told[0].startswith("Jump at 2025-04-01 12:00:03: ")
    assert told[-1].startswith("2 more jumps were detected")


def test_what_settles_is_not_looked_at():
    rng, jumps = np.random.default_rng(0), lp.Jumps(settle=50)
    watch = jumps.start(2)
    for k in range(200):
        e = (3.0 if k < 50 else 1.0) * rng.standard_normal((1, 2))
        watch, alarm = jumps.add(watch, e)
        assert not alarm
    _, alarm = jumps.add(watch, np.full((1, 2), 10.0))
    assert alarm


@pytest.mark.slow
def test_slow_errors_below_the_noise_hide_no_jump():
    rng, jumps = np.random.default_rng(0), lp.Jumps(settle=0)
    watch, alarm = jumps.start(2), False
    for k in range(2000):
        watch, _ = jumps.add(watch, rng.standard_normal((1, 2)) + 0.3 * np.sin(0.01 * k))
    assert watch.usual.inflation > 1.5
    assert watch.usual.scatter < 1.25
    for k in range(30):
        watch, alarm = jumps.add(watch, rng.standard_normal((1, 2)) + 2.0 * np.sin(k))
        if alarm:
            break
    assert alarm


MESH = lp.interval(0.0, 1.0, 12)


def learned(unknowns: dict[str, Any], rate: Any) -> tuple[Any, Any]:
    model = lp.Model(
        lp.Field(MESH, ElementLineP1()),
        unknowns,
        A=lambda q, u, v, x: rate(q) * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    sensors = lp.Points([0.5], noise=1e-3)
    identifier = lp.Identifier(model, sensors, lp.SensitivityLaw(modes=8), u0=1.0)
    result = identifier.run([(0.1 * k, [1.0]) for k in range(1, 31)])
    return result.to_xarray(), identifiability(identifier)


@pytest.mark.slow
def test_shares_over_time_end_where_identifiability_says():
    unknowns = {
        "a": lp.LogNormal(1.0, 0.5),
        "b": lp.Scalar(lp.Normal(0.0, 1.0), evolution=lp.fem.Periodic(5.0)),
        "f": lp.Field(MESH, ElementLineP1(), inner="H1", prior=lp.Normal(std=1.0)),
    }
    data, known = learned(unknowns, lambda q: q.a + q.b + q.f)
    a, b, f = known.unknowns
    for item in (a, b):
        share = data[f"{item.name}_left"]
        assert share.dims == ("time",)
        assert float(share[-1]) == pytest.approx(item.left)
        assert float(share[0]) > float(share[-1])
    modes = data["f_modes"]
    assert modes.dims == ("snapshot",)
    assert modes.attrs["of"] == 8
    assert 0 < float(modes[-1]) < 8
    assert float(modes[-1]) == pytest.approx(8 * (1 - f.left**2), abs=0.2)
    assert float(modes[0]) < float(modes[-1])


@pytest.mark.slow
def test_the_table_says_pinned_flat_traded_off_and_at_a_bound():
    def states(unknowns: dict[str, Any], rate: Any) -> dict[str, str]:
        data, _ = learned(unknowns, rate)
        (table,) = [t for t in tables(data) if t.title == "Identifiability"]
        return {row[0]: row[2] for row in table.rows}

    two = {"a": lp.Normal(0.0, 1.0), "b": lp.Normal(0.0, 1.0)}
    assert states(two, lambda q: q.a) == {"a": "well determined", "b": "not identifiable"}
    traded = states(two, lambda q: q.a - q.b)
    assert traded == {
        "a": "partly determined, correlated with b",
        "b": "partly determined, correlated with a",
    }
    bound = {"a": lp.Normal(0.5, 1.0, bounds=(0.2, 2.0))}
    assert states(bound, lambda q: q.a) == {"a": "at its bound"}
    walk = {"a": lp.Scalar(lp.Normal(0.0, 1.0), evolution=lp.RandomWalk(5.0))}
    assert states(walk, lambda q: 0.0 * q.a) == {"a": "changes with time"}
    field = {"f": lp.Field(MESH, ElementLineP1(), inner="H1")}
    assert states(field, lambda q: q.f)["f"].endswith("of 8 modes determined")


def test_a_law_without_covariance_says_nothing_of_it():
    model = lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 4), ElementLineP1()),
        {"a": lp.Normal(1.0, 1.0)},
        A=lambda q, u, v, x: q.a * u * v,
    )
    identifier = lp.Identifier(model, lp.Full(), lp.GradientLaw(), u0=1.0)
    data = identifier.run([(0.1, np.ones(5)), (0.2, np.ones(5))]).to_xarray()
    assert np.isnan(data["a_left"].values).all()
    assert "Identifiability" not in [table.title for table in tables(data)]
