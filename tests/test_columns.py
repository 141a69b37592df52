"""A column that is late, scaled, shifted, exchanged or in another unit is named first."""

import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.sparse as sp
from factories import usual
from scipy.sparse.linalg import splu

import livepde as lp
from benchmarks.first_hour import TABLES, save
from benchmarks.user_jobs.data import JOBS
from benchmarks.wrong_channels import Fault, with_fault
from livepde.cases.case import load
from livepde.laws.column_errors import UNITS, units_of
from livepde.laws.columns import Columns
from livepde.verdict import Cause, Finding, Verdict

LENGTH, CELLS, FINE = 0.1, 120, 10
STEP, COUNT, NOISE = 20.0, 300, 0.1
PLACES = {"TC2": 0.02, "TC3": 0.05, "TC4": 0.08}


@cache
def bar(seed: int, long: float = 0.0) -> tuple[float, dict[str, Any]]:
    """Return the diffusivity of a bar, and its five columns: finite volumes, Crank-Nicolson.

    `long`: the length over which TC3 averages.
    """
    rng = np.random.default_rng(seed)
    alpha = 1e-6 * np.exp(0.4 * rng.standard_normal())
    periods, sizes = rng.uniform(900.0, 2500.0, 2), rng.uniform(5.0, 15.0, 2)
    phases = rng.uniform(0.0, 6.0, 2)

    at = np.array([*PLACES.values()])[:, None] + np.zeros(40)
    at[1] += long * ((np.arange(40) + 0.5) / 40 - 0.5)

    def end(k: int, t: Any) -> Any:
        wave = np.sin(2 * np.pi * t / periods[k] + phases[k]) - np.sin(phases[k])
        return 20.0 + sizes[k] * wave + (10.0 * (1.0 - np.exp(-t / 1500.0)) if k == 0 else 0.0)

    width = LENGTH / CELLS
    x = width * (np.arange(CELLS) + 0.5)
    diagonal = np.full(CELLS, -2.0)
    diagonal[[0, -1]] = -3.0  # half a cell to the ends
    ones = np.ones(CELLS - 1)
    A = alpha / width**2 * sp.diags_array([ones, diagonal, ones], offsets=[-1, 0, 1])
    h, one = STEP / FINE, sp.eye_array(CELLS)
    solver, right = splu(sp.csc_array(one - 0.5 * h * A)), one + 0.5 * h * A
    u, shown, times = np.full(CELLS, 20.0), [], STEP * np.arange(COUNT)
    for t in h * np.arange(FINE * (COUNT - 1) + 1):
        if len(shown) * STEP <= t + 1e-9:
            shown.append(np.interp(at, x, u).mean(axis=1))
        b = np.zeros(CELLS)
        b[0], b[-1] = (2 * alpha / width**2 * end(k, t + 0.5 * h) for k in range(2))
        u = solver.solve(right @ u + h * b)
    noisy = np.array(shown) + NOISE * rng.standard_normal((COUNT, 3))
    columns = dict(zip(PLACES, noisy.T, strict=True))
    return float(alpha), columns | {"TC1": end(0, times), "TC5": end(1, times), "t": times}


def late(values: Any, by: float) -> Any:
    times = STEP * np.arange(COUNT)
    return np.interp(times - by, times, values)


def exchanged(columns: dict[str, Any], first: str, second: str) -> dict[str, Any]:
    return {**columns, first: columns[second], second: columns[first]}


def scaled(columns: dict[str, Any], name: str, factor: float, more: float = 0.0) -> dict[str, Any]:
    return {**columns, name: factor * columns[name] + more}


def tilted(columns: dict[str, Any]) -> dict[str, Any]:
    """Add a steady slope of 200 K, so that no two columns have values in common."""
    places = {"TC1": 0.0, **PLACES, "TC5": LENGTH}
    more = {name: columns[name] + 200.0 * x / LENGTH for name, x in places.items()}
    return columns | more


FAULTS: dict[str, tuple[Any, str, str]] = {
    "input late": (lambda c: {**c, "TC5": late(c["TC5"], 60.0)}, "TC5", "TC5 may be 60 late"),
    "sensor late": (lambda c: {**c, "TC3": late(c["TC3"], 60.0)}, "TC3", "TC3 may be 60 late"),
    "input scaled": (lambda c: scaled(c, "TC1", 1.15), "TC1", "the scale of TC1 may be 15"),
    "input off": (lambda c: scaled(c, "TC1", 1.0, 1.5), "TC1", "TC1 may read 1.5 K too high"),
    "input in degF": (lambda c: scaled(c, "TC5", 1.8, 32.0), "TC5", "TC5 may be in degF"),
    "sensor in degF": (lambda c: scaled(c, "TC3", 1.8, 32.0), "TC3", "TC3 may be in degF"),
    "sensor in degC, stated as degF": (
        lambda c: scaled(c, "TC3", 1.0 / 1.8, -32.0 / 1.8),
        "TC3",
        "TC3 may be in degC instead of degF",
    ),
    "sensors exchanged": (
        lambda c: exchanged(c, "TC2", "TC3"),
        "TC2",
        "TC2 and TC3 may be exchanged",
    ),
    "input and sensor exchanged": (lambda c: exchanged(c, "TC1", "TC2"), "TC2", "may be exchanged"),
}


def begun(
    columns: dict[str, Any], between: Any = None, parts: Any = None, **options: Any
) -> tuple[lp.Identifier, list[Any]]:
    """Return an identifier before its first sample, and the samples."""
    mesh = lp.interval(0.0, LENGTH, 40)
    ends = {"left": lp.Channel("TC1"), "right": lp.Channel("TC5")}
    model = lp.Model(
        lp.Field(mesh, lp.fem.linear(mesh), dirichlet=ends),
        lp.LogNormal(1e-6, std=6e-7),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
    )
    sensors = lp.Points(PLACES, noise=NOISE, unit="degC")
    law = lp.SensitivityLaw(**options)
    identifier = lp.Identifier(
        model, sensors, law, **{"u0": 20.0, "between": between, **(parts or {})}
    )
    names = ("TC1", "TC5")
    samples = [
        (float(t), {name: columns[name][k] for name in PLACES}, {n: columns[n][k] for n in names})
        for k, t in enumerate(columns["t"])
    ]
    return identifier, samples


def run(columns: dict[str, Any], **options: Any) -> lp.Result:
    identifier, samples = begun(columns, **options)
    return identifier.run(samples)


@pytest.mark.slow
@pytest.mark.parametrize("fault", usual(FAULTS))
def test_the_wrong_column_is_named_first(fault: str):
    change, name, words = FAULTS[fault]
    _, columns = bar(1)
    verdict = run(change(columns)).last.verdict
    (misfit,) = (finding for finding in verdict.findings if finding.what == "misfit")
    assert verdict.level != "trusted"
    first = misfit.causes[0]
    assert first.subject == name
    assert words in first.text
    assert first.share > 0.9
    # Fit and effect come first.
    assert first.text[1:] in verdict.sentences[1]  # the first letter may be a capital
    assert len({(cause.kind, cause.subject) for cause in misfit.causes}) == len(misfit.causes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: exchanged(tilted(c), "TC2", "TC5"), "TC2 and TC5 may be exchanged"),
        pytest.param(
            lambda c: scaled(c, "TC5", 1.8, 32.0), "TC5 may be in degF", marks=pytest.mark.long
        ),
    ],
)
def test_a_wrong_input_with_noise_is_named_and_the_initial_state_is_made_of_it(change, words):
    """Inputs with noise have no refit: their first samples are kept, to try columns on them."""
    _, columns = bar(1)
    wrong = {name: values[:30] for name, values in change(columns).items()}
    first = {name: float(wrong[name][0]) for name in ("TC1", "TC5")}
    weights = {"TC1": lambda x: 1.0 - x[0] / LENGTH, "TC5": lambda x: x[0] / LENGTH}
    parts = {
        "u0": lambda x: sum(weights[name](x) * value for name, value in first.items()),
        "u0_from": weights,
        "input_noise": {"TC1": 0.05, "TC5": 0.05},
    }
    verdict = run(wrong, parts=parts).last.verdict
    cause = next(f for f in verdict.findings if f.what == "misfit").causes[0]
    assert words in cause.text
    assert cause.share > 0.99
    assert verdict.level == "do not trust"


@pytest.mark.slow
def test_columns_that_are_right_are_not_looked_at(monkeypatch: pytest.MonkeyPatch):
    def refused(*_: Any) -> None:
        raise AssertionError("nothing speaks against this run")

    monkeypatch.setattr("livepde.laws.verdict.likely_columns", refused)
    alpha, columns = bar(5)
    estimate = run(columns).last
    assert estimate.verdict.level == "trusted"
    assert abs(estimate.belief.q[0] - alpha) < 3.0 * estimate.belief.q_std[0]


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "shift", "since"), [("hold", 60.0, 700.0), ("next", -60.0, 700.0), ("hold", 300, 3500)]
)
def test_an_input_that_is_held_is_late_by_whole_samples(kind: str, shift: float, since: float):
    """A switched end: `next` is `hold` a row later, so that both are wrong by whole rows here.

    Switched once, it is a disturbance after many samples that the model explains.
    """
    _, columns = bar(1)
    times = columns["t"]
    steps = np.where((times // since) % 2 > 0.0, 30.0, 20.0)  # constant from row to row
    dense = run_switched(columns, steps)
    rows = round(shift / STEP) + (kind == "next")
    wrong = np.concatenate([np.full(max(rows, 0), steps[0]), steps])[: len(steps)]
    if rows < 0:
        wrong = np.concatenate([steps[-rows:], np.full(-rows, steps[-1])])
    verdict = run({**columns, **dense, "TC5": wrong}, between={"TC5": kind}).last.verdict
    (misfit,) = (finding for finding in verdict.findings if finding.what == "misfit")
    side = "late" if shift > 0 else "early"
    assert misfit.causes[0].text == f"TC5 may be {abs(shift):g} {side}"


def run_switched(columns: dict[str, Any], steps: Any) -> dict[str, Any]:
    """Return the readings of the bar with a right end that holds each value until the next row."""
    width, alpha = LENGTH / CELLS, bar(1)[0]
    x = width * (np.arange(CELLS) + 0.5)
    diagonal = np.full(CELLS, -2.0)
    diagonal[[0, -1]] = -3.0
    ones = np.ones(CELLS - 1)
    A = alpha / width**2 * sp.diags_array([ones, diagonal, ones], offsets=[-1, 0, 1])
    h = STEP / FINE
    solver = splu(sp.csc_array(sp.eye_array(CELLS) - h * A))  # implicit Euler: the end jumps
    left = np.interp(h * np.arange(1, FINE * (COUNT - 1) + 1), columns["t"], columns["TC1"])
    u, shown = np.full(CELLS, 20.0), [np.full(3, 20.0)]
    for k in range(COUNT - 1):
        for j in range(FINE):
            b = np.zeros(CELLS)
            b[0] = 2 * alpha / width**2 * left[k * FINE + j]
            b[-1] = 2 * alpha / width**2 * steps[k]
            u = solver.solve(u + h * b)
        shown.append(np.interp(list(PLACES.values()), x, u))
    noise = NOISE * np.random.default_rng(7).standard_normal((COUNT, 3))
    return dict(zip(PLACES, (np.array(shown) + noise).T, strict=True))


@pytest.mark.long
def test_slow_noise_is_no_wrong_column():
    """Errors that follow each other misfit by chance: no column is blamed beyond a caution."""
    _, columns = bar(5)
    rng = np.random.default_rng(2)
    slow = {}
    for name in PLACES:
        e = rng.standard_normal(COUNT)
        for k in range(1, COUNT):
            e[k] = 0.9 * e[k - 1] + np.sqrt(1.0 - 0.81) * e[k]
        slow[name] = columns[name] + NOISE * e
    verdict = run({**columns, **slow}).last.verdict
    assert verdict.level in ("trusted", "caution")
    kinds = {cause.kind for finding in verdict.findings for cause in finding.causes[:1]}
    assert not kinds & {"unit", "exchange"}


@pytest.mark.long
def test_a_fault_that_is_in_no_column_is_not_put_on_one():
    """A loss over the whole bar: no column explains more than what the model lacks."""
    _, columns = bar(7)
    times = columns["t"]
    lost = {name: columns[name] - 3.0 * (1.0 - np.exp(-times / 2000.0)) for name in PLACES}
    verdict = run({**columns, **lost}).last.verdict
    assert verdict.level == "do not trust"
    columns_named = [
        c for f in verdict.findings for c in f.causes if c.kind in ("unit", "exchange")
    ]
    assert not any(cause.share > 0.9 for cause in columns_named)


def test_causes_are_merged_by_what_they_explain():
    first = Cause("offset", "a", "a may read 1 too high", 0.4)
    second = Cause("boundary", "b", "b may be 2 too high", 0.8)
    verdict = Verdict.of(
        [Finding("misfit", "do not trust", "It misfits.", "a", causes=(second, first))]
    )
    better = Cause("offset", "b", "b may read 2 too high", 0.9)
    (misfit,) = verdict.with_causes([better]).findings
    assert misfit.causes == (better, first)
    assert misfit.subject == "b"
    # Without a misfit that is known, only a cause of at least half of it is one.
    plain = Verdict.of([])
    assert plain.with_causes([Cause("lag", "c", "c is 3 late", 0.4)]) is plain
    (found,) = plain.with_causes([better]).findings
    assert found.severity == "caution"
    (found,) = plain.with_causes([Cause("unit", "b", "b is in degF", 0.9)]).findings
    assert found.severity == "do not trust"


@pytest.mark.slow
def test_an_early_boundary_is_no_late_sensor_and_the_search_ends(tmp_path: Path):
    """Six layers and four offsets; the upper boundary is an hour early, the data by volumes."""
    (job,) = (job for job in JOBS if job.name == "soil")
    job.write(tmp_path, rows=52)
    table = pd.read_csv(tmp_path / "data.csv")
    table["T05"] = table["T05"].shift(-1).ffill()
    table.to_csv(tmp_path / "data.csv", index=False)
    prepared = load(tmp_path / "case.toml").prepare()
    last = prepared.identifier.run(prepared.stream).last
    (misfit,) = (finding for finding in last.verdict.findings if finding.what == "misfit")
    assert (misfit.causes[0].kind, misfit.causes[0].subject) == ("lag", "T05")
    assert misfit.causes[0].size == pytest.approx(-3600.0, rel=0.05)
    # Searches from elsewhere end at the same trajectory: that is the fit, and the model is wrong.
    assert {finding.what for finding in last.verdict.findings} == {"effect", "misfit", "flat"}
    assert last.fit.converged
    assert last.fit.passes < 50  # 205 where each of eleven searches is followed to its end


def walk(folder: Path, fault: Fault, rows: int, **settings: Any) -> Any:
    """Return the prepared case of a walk with a wrong column, and so many rows of the table."""
    examples = Path(__file__).parents[1] / "examples" / "first_hour"
    shutil.copy(examples / f"{fault.walk}.toml", folder)
    case = load(folder / f"{fault.walk}.toml", settings=settings)
    columns = {name: str(item.column) for name, item in case.spec.channels.items()}
    header, table, _ = TABLES[fault.walk](1)
    save(folder / f"{fault.walk}.csv", header, with_fault(fault, header, table, columns)[:rows])
    return case.prepare()


EXCHANGED = Fault("heater", ("T_10", "T_60"), "exchanged")


@pytest.mark.slow
def test_exchanged_sensors_that_contradict_all_are_found_from_the_start(tmp_path: Path):
    """The gate takes such columns for a disturbance, after which the stored state is wrong."""
    prepared = walk(tmp_path, EXCHANGED, 90)
    last = prepared.identifier.run(prepared.stream).last
    assert prepared.identifier._state.trial.shape[1] > 0  # there was a disturbance
    found = [finding.causes[0] for finding in last.verdict.findings if finding.causes]
    assert found[0].kind == "exchange"
    assert found[0].share > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "noise"),
    [
        (Fault("furnace", ("T_cold",), "fahrenheit"), ""),
        pytest.param(Fault("furnace", ("T_cold",), "fahrenheit"), "auto", marks=pytest.mark.long),
        pytest.param(Fault("furnace", ("T_2", "T_4"), "exchanged"), "", marks=pytest.mark.long),
        pytest.param(Fault("furnace", ("T_2",), "late", 30.0), "", marks=pytest.mark.long),
    ],
    ids=str,
)
def test_wrong_columns_are_named_where_an_unknown_moves(fault: Fault, noise: str, tmp_path: Path):
    """A furnace with an unknown flux that moves: samples are filtered, not fitted, again."""
    settings = {"law.noise": "auto"} if noise else {}
    rows = 150 if fault.kind == "late" else 30
    prepared = walk(tmp_path, fault, rows, **settings)
    verdict = prepared.identifier.run(prepared.stream).last.verdict
    first = next(finding.causes[0] for finding in verdict.findings if finding.causes)
    kinds = {"fahrenheit": "unit", "exchanged": "exchange", "late": "lag"}
    assert (first.kind, first.subject) == (kinds[fault.kind], fault.channels[0])
    assert first.share > 0.9
    if fault.kind == "late":
        assert first.size == pytest.approx(60.0, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", usual([EXCHANGED, Fault("furnace", ("T_cold",), "fahrenheit")]), ids=str
)
def test_samples_for_trials_outlive_a_restart(fault: Fault, tmp_path: Path):
    prepared = walk(tmp_path, fault, 50)
    first, second = prepared.identifier, load(prepared.case.path).prepare().identifier
    for number, sample in enumerate(prepared.stream):
        expected = first.step(sample.t, sample.z, sample.inputs)
        if number > 35:
            found = second.step(sample.t, sample.z, sample.inputs)
        if number == 35:
            second.restore(first.dump())
    assert first._state.trial.shape[1] > 35
    np.testing.assert_array_equal(found.q, expected.q)
    assert first.dump() == second.dump()


@pytest.mark.slow
@pytest.mark.parametrize("since", [60, 150])
def test_columns_that_were_right_for_long_are_not_wrong_from_the_start(since: int):
    """All sensors are another unit from some sample on, which is a disturbance."""
    _, columns = bar(3)
    wrong = {name: np.where(np.arange(COUNT) < since, z, z + 30.0) for name, z in columns.items()}
    identifier, samples = begun(columns | {name: wrong[name] for name in PLACES})
    for sample in samples[: since + 60]:
        identifier.step(*sample)
    first = float(identifier._state.trial[0, 0, 0])
    assert first == 0.0 if since == 60 else first >= STEP * since


@pytest.mark.slow
def test_a_sensor_that_averages_over_a_length_is_named_and_the_interval_allows_for_it():
    alpha, columns = bar(2, 0.02)
    verdict = run(columns).last.verdict
    (misfit,) = (finding for finding in verdict.findings if finding.what == "misfit")
    first = misfit.causes[0]
    assert (first.kind, first.subject) == ("averaging", "TC3")
    assert 0.01 < first.size < 0.02
    assert first.setting.startswith("channels.TC3.at=; channels.TC3.along=[[0.0")
    one = verdict.errors.unknowns[0]
    assert one.low < alpha < one.plain_low


def test_an_input_of_power_is_in_no_unit_of_temperature():
    mesh = lp.interval(0.0, 1.0, 8)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": 0.0}, unit="degC"),
        {"k": lp.LogNormal(1.0, std=0.1)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) - x.inputs["Q"] * v,
        inputs={"Q": "W"},
    )
    problem = lp.Identifier(model, lp.Points({"T": 1.0}, noise=0.1, unit="degC"), u0=0.0).problem
    work: Any = SimpleNamespace(filter=SimpleNamespace(problem=problem))
    columns = Columns(work, None, {}, ("Q",), lp.Refit())
    assert (columns.unit("T"), columns.unit("Q")) == ("degC", "W")


def test_a_flux_is_in_no_unit_of_temperature():
    named = {unit: {UNITS[k].name for k in units_of(unit, scaled=True)} for unit in ("K", "W/m^2")}
    assert named == {"K": {"", "degC", "degF", "K"}, "W/m^2": {""}}
    assert all(UNITS[k].name for k in units_of("degC", scaled=False))
