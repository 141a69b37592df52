"""Noise of a single reading: in samples, cases, fleets, journals and checkpoints."""

import json
import math
import re

import numpy as np
import pytest
from commands import call
from factories import INTERPOLATED_ROD_CASE

import livepde as lp
from livepde import cases
from livepde.cases.live_case import LiveCase
from livepde.cases.member_blocks import blocks
from livepde.errors import CaseError, ConfigurationError, SampleError
from livepde.models import heat
from livepde.runs.drive import drive, journal_of
from livepde.runs.journal import Journal
from livepde.samples import noise_channel
from livepde.streams.sources import Rows

H, STEPS = 0.02, 40
NAN = math.nan


def rod() -> lp.Model:
    return heat(lp.interval(0.0, 1.0, 16), lp.Normal(0.1, std=0.05), {"left": 0.0, "right": 0.0})


def identifier(law=None, noise=0.05, model=None) -> lp.Identifier:
    points = lp.Points({"a": 0.3, "b": 0.6}, noise=noise)
    law = lp.SensitivityLaw() if law is None else law
    return lp.Identifier(model or rod(), points, law, u0=lambda x: np.sin(np.pi * x[0]))


def stream(steps=STEPS) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return times, readings and the noise that each of them has."""
    rng = np.random.default_rng(3)
    truth = identifier().forecast(H * np.arange(1, steps + 1))
    clean = np.column_stack([truth["a"], truth["b"]])
    std = rng.choice([0.005, 0.05, 0.5], size=clean.shape)
    z = clean + std * rng.standard_normal(clean.shape)
    return [(H * (k + 1), z[k], std[k]) for k in range(steps)]


def same(one: lp.Estimate, other: lp.Estimate) -> bool:
    pairs = [(one.belief.q, other.belief.q), (one.belief.u_factor, other.belief.u_factor)]
    return all(np.array_equal(a, b) for a, b in pairs)


SHORT = {"refit": lp.laws.Refit(start=4), "shadows": None}
LAWS = [
    lp.SensitivityLaw(),
    lp.SensitivityLaw(**SHORT),
    lp.SensitivityLaw(jumps=lp.Jumps(settle=5), **SHORT),
    lp.SensitivityLaw(noise="auto", **SHORT),
    lp.SensitivityLaw(drift=0.1, **SHORT),
]


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_a_reading_counts_with_its_own_noise_as_with_that_of_its_sensor(law):
    """Also in iterated starts and refits, which take readings again."""
    stated, own = identifier(law, noise=[0.02, 0.1]), identifier(law, noise=[5.0, 0.1])
    for t, z, _ in stream():
        one = stated.step(t, z)
        two = own.step(t, {"a": (float(z[0]), 0.02), "b": float(z[1])})
    assert same(one, two)


@pytest.mark.slow
def test_all_forms_say_the_same():
    each = [identifier() for _ in range(4)]
    for t, z, std in stream(8):
        a, b = zip(z.tolist(), std.tolist(), strict=True)
        each[3].run([lp.Sample(t, np.array([a, b]))])
        found = [
            each[0].step(t, {"a": a, "b": b}),
            each[1].step(t, [a, b]),
            each[2].step(t, {"a": a[0], "noise of a": a[1], "b": b}),
            each[3].estimate(),
        ]
        assert all(same(found[0], other) for other in found[1:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("z", "text"),
    [
        ({"a": (1.0, 0.0)}, "noise of a: got 0; a standard deviation must be positive"),
        ({"a": (1.0, -0.1)}, "noise of a: got -0.1"),
        ({"a": 1.0, "noise of a": -0.1}, "noise of a: got -0.1"),
        ([(1.0, 0.1), (1.0, 0.0)], "noise of b: got 0"),
        ({"a": (1.0, np.inf)}, "send NaN"),
        ({"a": (1.0, "x")}, "noise of a: got 'x'"),
        ({"a": (1.0, 0.1, 0.2)}, "expected a number, or of a sensor a pair"),
        ([(1.0, 0.1), ("1.0", 0.1)], "not an array of numbers"),
        ([(1.0, 0.1), 1.0], "not a number"),
        ({"noise of c": 0.1}, "unknown channel 'noise of c'"),
    ],
)
def test_noise_that_cannot_be_is_refused_in_one_sentence(z, text):
    one = identifier()
    with pytest.raises(SampleError, match=text):
        one.step(H, z)
    assert one.t == 0.0


def test_a_law_without_covariance_refuses_it():
    with pytest.raises(SampleError, match="GradientLaw does not weigh readings"):
        identifier(lp.GradientLaw()).step(H, {"a": (0.5, 0.1)})


def test_a_pair_belongs_to_a_sensor():
    model = heat(lp.interval(0.0, 1.0, 8), lp.Normal(0.1, std=0.05), {"left": lp.Channel("left")})
    one = lp.Identifier(model, lp.Points({"a": 0.3}, noise=0.1), lp.SensitivityLaw(), u0=0.0)
    with pytest.raises(SampleError, match=r"'left': got .* of a sensor a pair"):
        one.step(0.0, {"a": 1.0, "left": (0.0, 0.1)})


def test_a_channel_with_the_name_of_noise_is_refused():
    name = noise_channel("a")
    model = heat(lp.interval(0.0, 1.0, 8), lp.Normal(0.1, std=0.05), {"left": lp.Channel(name)})
    with pytest.raises(ConfigurationError, match="has the name of the noise of a reading"):
        lp.Identifier(model, lp.Points({"a": 0.3}, noise=0.1), lp.SensitivityLaw(), u0=0.0)


def test_a_validation_reading_may_have_noise_and_is_scored_all_the_same():
    points, hidden = lp.Points({"a": 0.3}, noise=0.1), lp.Points({"b": 0.6})
    one = lp.Identifier(rod(), points, lp.SensitivityLaw(), u0=0.0, validation=hidden)
    estimate = one.step(H, {"a": (0.1, 0.2), "b": (0.5, 0.3)})
    assert estimate.validation_error == pytest.approx([0.5], abs=0.2)


@pytest.mark.slow
def test_a_journal_keeps_noise_and_a_run_goes_on_with_it(tmp_path):
    samples = [
        lp.Sample(t, np.column_stack([z, std]) if k % 3 else z)
        for k, (t, z, std) in enumerate(stream(20))
    ]
    whole = identifier().run(samples).last
    path = tmp_path / "journal.sqlite"
    with journal_of(identifier(), path) as journal:
        for sample in samples[:12]:  # killed: nothing was estimated of what is in the journal
            values = dict(zip("ab", np.asarray(sample.z).reshape(2, -1)[:, 0], strict=True))
            if np.ndim(sample.z) == 2:
                values |= dict(zip(map(noise_channel, "ab"), sample.z[:, 1], strict=True))
            taken = journal.accept(sample.t, values)
            assert taken.values == values
    with Journal.open(path, write=True) as journal:
        driven = drive(identifier(), samples, journal=journal)
        assert driven.status == "finished"
        assert same(driven.result.last, whole)


def test_a_reading_that_the_start_is_made_of_brings_its_noise():
    model, points = rod(), lp.Points({"a": 0.5}, noise=0.1)
    given = {"a": (lambda x: 0 * x[0] + 1.0, 0.02)}
    one = lp.Identifier(model, points, lp.SensitivityLaw(), u0=1.0, u0_from=given)
    one.step(0.0, [(1.0, 0.02)])
    assert one._latent_belief().u_std.max() == pytest.approx(0.02)


# --- cases -------------------------------------------------------------------------------------

CASE = f"""{INTERPOLATED_ROD_CASE}
[channels]
left = {{ role = "boundary", column = "left", at = "left", unit = "degC" }}
[channels.T]
role = "sensor"
column = "T"
at = "0.3 m"
unit = "degF"
noise = "0.1 K"
noise_column = "s"
"""
STD = ["0.9", "1.8", "", "0", "-1", "0.9", "0.9"]  # degF of a difference


def case(folder, text=CASE):
    rows = [f"{300 * k},{20 + k % 3},{68 + 0.1 * k},{std}" for k, std in enumerate(STD)]
    (folder / "rows.csv").write_text("\n".join(["t,left,T,s", *rows, ""]))
    (folder / "case.toml").write_text(text)
    return cases.load(folder / "case.toml")


@pytest.mark.slow
def test_a_column_of_a_case_holds_the_noise(tmp_path):
    prepared = case(tmp_path).prepare()
    found = [sample.z.get("noise of T") for sample in prepared.stream]
    assert found == pytest.approx([0.5, 1.0, NAN, NAN, NAN, 0.5, 0.5], nan_ok=True)
    readings = [sample.z["T"] for sample in prepared.stream]
    assert np.isnan(readings).tolist() == [False, False, False, True, True, False, False]
    assert prepared.stream.remarks == {("invalid", "T"): 2, ("missing", "noise of T"): 1}
    reading = prepared.identifier.problem.initial_readings["T"]
    assert reading.noise == pytest.approx(0.5)
    result = prepared.identifier.run(prepared.stream)
    assert np.isfinite(result.to_xarray()["innovation"]).sum() == 5


@pytest.mark.slow
def test_rows_as_they_come_are_the_table(tmp_path):
    loaded = case(tmp_path)
    table = loaded.prepare()
    finished = table.identifier.run(table.stream).last
    keys = ("t", "left", "T", "s")
    rows = [
        dict(zip(keys, (300.0 * k, 20.0 + k % 3, 68 + 0.1 * k, float(std or NAN)), strict=True))
        for k, std in enumerate(STD)
    ]
    # The noise of a reading may come in a row of its own.
    parts = [part for row in rows for part in ({**row, "s": None}, {"t": row["t"], "s": row["s"]})]
    text = CASE.replace("[unknowns", "[intake]\nwait = 1\n[unknowns")
    with LiveCase(case(tmp_path, text), Rows(parts), path=tmp_path / "journal.sqlite") as wiring:
        live = wiring.live()
        live.run()
        assert same(live.result.last, finished)
        counts = live.journal.counts
        assert counts["invalid", "T"] == 2
        assert counts["missing", "noise of T"] == 1
    lines = [json.dumps({k: None if v != v else v for k, v in row.items()}) for row in rows]
    assert same(_ran(loaded.prepare(lines)), finished)


@pytest.mark.slow
def test_commands_show_the_column_of_noise(tmp_path):
    case(tmp_path)
    code, shown = call("check", tmp_path / "case.toml")
    assert code == 0
    assert re.search(r"noise of T\W+noise\W+0.5\W+1\W+K", shown)
    case(tmp_path, CASE.replace('file = "rows.csv"', 'file = "rows.csv"\nfollow = true'))
    code, shown = call("check", tmp_path / "case.toml")
    assert code == 0
    assert re.search(r"noise of T\W+noise\W+s\W", shown)


@pytest.mark.slow
def test_members_that_step_together_keep_the_noise_in_their_journals(tmp_path):
    loaded = case(tmp_path)
    members = {name: loaded.prepare() for name in ("north", "south")}
    finished = _ran(loaded.prepare())
    (block,), apart = blocks(members)
    assert not apart
    paths = [tmp_path / f"{name}.sqlite" for name in members]
    block.run(paths)
    for k, path in enumerate(paths):
        with block.ended(k) as (_, driven):
            assert driven.result.last.belief.q == pytest.approx(finished.belief.q, rel=1e-9)
        with Journal.open(path) as journal:
            assert journal.first.values["noise of T"] == pytest.approx(0.5)
            assert "noise of T" not in journal.recent(3)[0].values


def _ran(prepared):
    return prepared.identifier.run(prepared.stream).last


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('kind = "sensitivity"', 'kind = "gradient"', "gradient law does not weight readings"),
        ('at = "left", unit = "degC"', 'at = "left", noise_column = "s"', "requires a sensor"),
        (
            "[law]",
            '[channels."noise of T"]\nrole = "sensor"\ncolumn = "T"\nat = 0.5\nnoise = 1\n[law]',
            "rename it",
        ),
    ],
)
def test_a_column_of_noise_that_cannot_be_is_said(tmp_path, old, new, text):
    with pytest.raises(CaseError, match=text):
        case(tmp_path, CASE.replace(old, new))
