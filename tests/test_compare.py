"""`livepde compare` runs variants of a case, ranks them and recommends one."""

import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import scipy
import tomlkit
from commands import bad, call
from factories import ROD_CASE, short_rod

from benchmarks.first_hour import FOLDER
from livepde import cases
from livepde.cases.case import with_members
from livepde.cases.proposals import proposed
from livepde.cases.read import _with, apply, filled, parse, read_toml
from livepde.cases.recommendation import conclusions, recommended
from livepde.cases.remedies import NO_SETTING, first_miss, freed, start_missed, with_settings
from livepde.cases.variants import LastEstimate, Variant, VariantRun, run_variant, variant_of
from livepde.errors import CaseError
from livepde.progress import timed
from livepde.verdict import Cause, Finding, ModelErrors, Verdict
from livepde.verdict.directions import stated_positions
from livepde.verdict.sentences import estimating

OFFSET = 0.5  # K
FREED = "offset: channels.T_10.offset='1 K'"


@pytest.fixture
def biased(tmp_path, monkeypatch):
    """Provide the case of `livepde init` with an offset of sensor T_10."""
    monkeypatch.chdir(tmp_path)
    path = short_rod(tmp_path / "rod", 41)
    table = pd.read_csv(path.parent / "rod.csv")
    table["T_10"] += OFFSET
    table.to_csv(path.parent / "rod.csv", index=False)
    return path


# --- in a terminal ------------------------------------------------------------------------------


@pytest.mark.long
def test_the_variant_that_estimates_the_fault_is_recommended_and_written(biased):
    # The second is not a valid case, the third omits readings, the fourth is refuted.
    given = [FREED, "far: channels.T_10.at='9 m'", "channels.T_10.role=ignored"]
    options = [part for text in given for part in ("--variant", text)]
    written = biased.parent / "better.toml"
    drawn = biased.parent / "compare.png"
    files = ("--write", written, "--figure", drawn)
    code, output = call("compare", biased, *options, "--json", "--jobs", "1", *files)
    assert code == 0
    assert drawn.read_bytes().startswith(b"\x89PNG")
    content = json.loads(output)
    assert content["recommended"] == "offset"
    found = {one["name"]: one for one in content["variants"]}
    assert found["offset"]["log_evidence"] > found["as stated"]["log_evidence"] + 100.0
    assert found["offset"]["level"] == "trusted"
    assert found["offset"]["misfit"] < 1.5 < found["as stated"]["misfit"]
    offset = found["offset"]["estimates"]["offset[T_10]"]
    assert offset["low"] < OFFSET < offset["high"]
    assert found["far"]["level"] == "failed"
    assert "lies outside" in found["far"]["error"]
    rows = {row[0]: row for row in content["tables"][0]["rows"]}
    assert rows["channels.T_10.role=ignored"][2] == "–"  # its evidence is from other readings
    assert any("counts other readings" in note for note in content["notes"])
    # The better case is the case with this key, comments included, and it runs as the variant did.
    lines = set(biased.read_text().splitlines())
    (line,) = (one for one in written.read_text().splitlines() if one not in lines)
    assert line.startswith("T_10 = ") and 'offset = "1 K"' in line  # noqa: PT018  one line
    again = run_variant(written, [], Variant("again"))
    assert again.log_evidence == found["offset"]["log_evidence"]


@pytest.mark.long
def test_the_program_finds_the_fault_from_a_case_and_from_a_run(biased):
    code, output = call("run", biased, "--out", "run")
    assert code == 0, output
    assert "Add --data FILE" in bad("compare", "run")  # the copied case has no table
    data = ["--data", biased.parent / "rod.csv"]
    for what in ([biased], ["run", *data]):
        code, output = call("compare", *what, "--json", "--most", "4")
        assert code == 0
        content = json.loads(output)
        assert len(content["variants"]) == 5
        assert content["recommended"] in ("offset of T_10", "offsets of all sensors")
        best = {one["name"]: one for one in content["variants"]}[content["recommended"]]
        assert best["level"] == "trusted"


@pytest.mark.slow
def test_a_better_case_is_run_with_the_data_of_the_comparison(biased):
    other = biased.parent / "rod.csv"
    other = other.rename(other.with_name("other.csv"))
    written = biased.parent / "better.toml"
    options = ("--data", other, "--variant", FREED, "--write", written, "--jobs", "1", "--json")
    code, output = call("compare", biased, *options)
    assert code == 0
    assert json.loads(output)["notes"][-1] == (
        f"Wrote {written}: livepde run {written} --data {other}"
    )


@pytest.mark.long
def test_variants_in_processes_are_those_of_this_process(biased):
    options = ["--variant", FREED, "--json", "--jobs"]
    each = [json.loads(call("compare", biased, *options, jobs)[1]) for jobs in ("1", "2")]
    assert each[0]["variants"] == each[1]["variants"]


@pytest.mark.slow
def test_a_recommended_original_case_is_not_written_again(tmp_path):
    path = short_rod(tmp_path, 31)
    written = tmp_path / "better.toml"
    options = ["--variant", "offset: channels.T_10.offset='1 K'", "--jobs", "1"]
    code, output = call("compare", path, *options, "--write", written)
    assert code == 0
    assert "is not written" in " ".join(output.split())
    assert not written.exists()


def test_invalid_comparisons_and_outputs_are_refused_before_a_run(biased, tmp_path):
    assert "expected 'name: key=value" in bad("compare", biased, "--variant", "offset:")
    assert "is the case itself" in bad("compare", biased, "--write", biased, "--force")
    assert "--force" in bad("compare", biased, "--write", biased)
    other = tmp_path / "better.toml"
    assert "relative to it" in bad("compare", biased, "--write", other)
    assert "ends in .png" in bad("compare", biased, "--figure", tmp_path / "all.xyz")
    assert "there is no directory" in bad("compare", biased, "--figure", tmp_path / "no" / "a.png")
    follow = ["--set", "data.follow=true"]
    assert "recorded rows" in bad("compare", biased, *follow)
    shutil.rmtree(biased.parent)
    assert "no such case file" in bad("compare", biased)


# --- variants -----------------------------------------------------------------------------------


def test_a_plain_value_is_written_as_the_table_that_a_key_of_it_makes(tmp_path):
    case = short_rod(tmp_path, 5)
    given = {"initial.std": "0.5 K", "initial.length": "10 cm"}
    text = case.read_text()
    assert read_toml(text, "")["initial"] == "interpolate"
    assert read_toml(filled(text, given, ""), "") == apply(read_toml(text, ""), given, "")


def test_a_variant_has_a_name_and_settings():
    found = variant_of("two: unknowns.k.std='1 m^2/s'; data.separator=\";\"")
    assert found == Variant("two", ("unknowns.k.std='1 m^2/s'", 'data.separator=";"'))
    assert variant_of("law.jumps=true") == Variant("law.jumps=true", ("law.jumps=true",))
    assert variant_of("no offset: channels.T.offset=").settings == ("channels.T.offset=",)
    for text in ("offsets", "x: offsets", "x: law.jumps=true; offsets"):
        with pytest.raises(CaseError, match=f"^--variant {text}: expected 'name: key=value"):
            variant_of(text)


def ended(name: str, evidence: float, validation: float, unknowns: int = 2, **more) -> VariantRun:
    return VariantRun(
        Variant(name),
        verdict=Verdict.of(()).to_dict(),
        log_evidence=evidence,
        readings=more.pop("readings", {"a": 100}),
        validation={"w": validation} if math.isfinite(validation) else {},
        unknowns=unknowns,
        **more,
    )


def test_the_best_evidence_counts_unless_validation_sensors_are_predicted_worse():
    base = ended("as stated", 10.0, 1.0, 1)
    good, tied = ended("good", 50.0, 0.9), ended("tied", 51.0, 0.9, 5)
    worse, other = ended("worse", 90.0, 1.5), ended("other", 99.0, 0.5, readings={"a": 99})
    weak = ended("weak", 12.0, 0.9)
    failed = VariantRun(Variant("failed"), error="no")
    assert recommended(base, [weak, good, worse, tied, other, failed]).variant.name == "good"
    assert recommended(base, [weak, worse, other, failed]) is base
    notes = " ".join(conclusions(base, [good, worse, other, failed]))
    assert "Recommended: 'good'" in notes
    assert "'worse' fits the assimilated sensors better and predicts" in notes
    assert "evidence of 'other' is missing or counts other readings" in notes


def test_a_variant_whose_fit_fails_is_not_recommended():
    errors = ModelErrors(9.0, 0.5, {"a": 9.0}, ())
    failed = Verdict.of(()).with_errors(errors).to_dict()
    base, good = ended("as stated", 0.0, math.nan), ended("good", 20.0, math.nan)
    wild = replace(ended("wild", 800.0, math.nan), verdict=failed)
    assert recommended(base, [wild]) is base
    assert recommended(base, [wild, good]) is good
    assert recommended(replace(base, verdict=failed), [wild]) is wild


def test_without_validation_sensors_the_evidence_decides():
    base, better = ended("as stated", 10.0, math.nan), ended("better", 50.0, math.nan)
    assert recommended(base, [better]) is better


def test_causes_that_the_data_cannot_distinguish_widen_the_intervals():
    low, high, far = (LastEstimate(k, 0.1, k - 0.2, k + 0.2) for k in (1.0, 2.0, 9.0))
    base = ended("as stated", 0.0, math.nan, estimates={"k": high})
    first = ended("gain of a", 50.2, math.nan, estimates={"k": low})
    second = ended("gain of b", 50.0, math.nan, estimates={"k": high, "gain[b]": far})
    refuted = ended("offset", 40.0, math.nan, estimates={"k": far})
    best = recommended(base, [first, second, refuted])
    assert (best.variant, best.rivals, best.level) == (first.variant, ("gain of b",), "caution")
    assert best.estimates["k"] == replace(low, low=0.8, high=2.2)
    notes = " ".join(conclusions(base, [first, second, refuted]))
    assert "cannot distinguish it from 'gain of b', with other values of k." in notes
    # Variants that agree confirm each other.
    agreed = replace(second, estimates={"k": replace(low, high=1.3)})
    assert recommended(base, [first, agreed, refuted]) is first


def test_a_usable_variant_that_explains_the_data_worse_is_not_trusted():
    base = ended("as stated", 0.0, math.nan)
    usable, other = ended("usable", 60.0, math.nan), ended("other", 55.0, math.nan)
    useless = Verdict.of([Finding("held", "do not trust", "Held.")]).to_dict()
    ahead = replace(ended("ahead", 500.0, math.nan), verdict=useless)
    best = recommended(base, [usable, ahead, other])
    assert (best.variant, best.level, best.better) == (usable.variant, "caution", ("ahead",))
    notes = conclusions(base, [usable, ahead, other])
    assert "verdict 'caution'" in notes[0]
    assert "The data fit 'ahead' better, by up to 440 of log evidence" in notes[1]
    near = replace(ahead, log_evidence=62.0)
    assert recommended(base, [usable, near]) is usable
    alone = recommended(base, [ahead])
    assert (alone.variant, alone.level, alone.better) == (base.variant, "caution", ("ahead",))
    assert "the case, unchanged. No usable variant" in conclusions(base, [ahead])[0]


def test_an_unknown_that_depends_on_the_variant_is_named():
    near, far = LastEstimate(1.0, 0.1, 0.8, 1.2), LastEstimate(2.0, 0.1, 1.8, 2.2)
    base = ended("as stated", 10.0, 1.0, estimates={"k": near, "c": near})
    other = ended("other", 5.0, 1.0, estimates={"k": far, "c": near})
    notes = " ".join(conclusions(base, [other]))
    assert "k depends on the variant: its interval in 'other' does not overlap" in notes
    assert "c depends" not in notes
    assert "contradict 'other'" in notes
    assert "All variants agree" in " ".join(
        conclusions(base, [replace(other, estimates={"c": near})])
    )
    # Without a common unknown there is nothing to agree on.
    assert "agree" not in " ".join(conclusions(base, [replace(other, estimates={})]))
    # The case itself is also a variant that may disagree.
    best = replace(other, log_evidence=50.0)
    assert "its interval in 'as stated' does not" in " ".join(conclusions(base, [best]))


def test_no_validation_sensor_may_be_predicted_worse():
    base = replace(ended("as stated", 10.0, 1.0), validation={"v": 5.0, "w": 1.0})
    hidden = replace(ended("hidden", 50.0, 1.0), validation={"v": 1.0, "w": 1.5})
    fewer = replace(ended("fewer", 50.0, 1.0), validation={"w": 1.0})
    assert recommended(base, [hidden, fewer]) is base
    assert "(w 1.5 instead of 1)" in " ".join(conclusions(base, [hidden]))


def test_a_case_without_evidence_recommends_nothing_and_names_failures():
    base = ended("as stated", math.nan, 1.0)
    notes = " ".join(conclusions(base, [VariantRun(Variant("typo"), error="no")]))
    assert notes.startswith("Variants are not ranked")
    assert "failed: 'typo'" in notes


def test_an_unknown_interval_refutes_nothing():
    unknown = LastEstimate(1.0, math.nan, math.nan, math.nan)
    assert unknown.overlaps(unknown)
    content = ended("gradient", math.nan, 1.0, estimates={"k": unknown}).to_dict()
    assert content["estimates"]["k"]["low"] is None
    json.dumps(content, allow_nan=False)


@pytest.mark.long
def test_readings_before_the_start_of_the_fit_do_not_count_as_evidence(biased):
    stated = run_variant(biased, (), Variant("as stated"))
    late = run_variant(biased, (), variant_of("data.assimilate_from='4 min'"))
    assert late.readings["T_30"] < stated.readings["T_30"]
    assert math.isnan(late.gained(stated))


@pytest.mark.long
def test_the_unit_of_a_column_does_not_change_the_evidence(biased):
    stated = run_variant(biased, (), Variant("as stated"))
    table = pd.read_csv(biased.parent / "rod.csv")
    table["T_10"] = 1.8 * table["T_10"] + 32.0
    table.to_csv(biased.parent / "rod.csv", index=False)
    other = run_variant(biased, (), variant_of("channels.T_10.unit=degF"))
    count = stated.readings["T_10"]
    assert count > 30
    assert other.gained(stated) == pytest.approx(-count * math.log(1.8), abs=1e-3)


# --- settings of causes -------------------------------------------------------------------------

SIZES = {
    "offset": 0.5,
    "gain": 0.1,
    "position": 0.004,
    "source": 1e-3,
    "loss": 1e-4,
    "flux": 1e-3,
    "transfer": 1e-4,
}
ROD = {
    "heat": [],
    "conduction": [
        "equation=conduction",
        "options.C='3.6e6 J/(m^3 K)'",
        "unknowns.alpha=",
        "unknowns.k={ prior = 100, std = 50 }",
    ],
}


def causes() -> list[Cause]:
    sensors = [Cause(kind, "T_30", "", size=SIZES[kind]) for kind in ("offset", "gain", "position")]
    process = [Cause(kind, "", "", size=SIZES[kind]) for kind in ("source", "loss")]
    jump = Cause("jump", "alpha", "", setting='law.jumps=["alpha"]')
    ends = [Cause(kind, "right", "", size=SIZES[kind]) for kind in ("flux", "transfer")]
    return [*sensors, *process, *ends, jump]


def test_a_setting_of_a_sensor_writes_its_family_as_single_channels(tmp_path):
    path = short_rod(tmp_path)
    (tmp_path / "places.csv").write_text("name,x\n10,0.1\n30,0.3\n")
    lines = [one for one in path.read_text().splitlines() if not one.startswith(("T_1", "T_3"))]
    where = 1 + lines.index(next(one for one in lines if one.startswith("[channels]")))
    family = 'T = { role = "sensor", positions = "places.csv", column = "T_{}", noise = "0.05 K" }'
    path.write_text("\n".join([*lines[:where], family, *lines[where:]]))
    cause = Cause("offset", "10", "", size=0.5)
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    (found,) = with_settings(cases.load(path).prepare(), verdict).findings[0].causes
    assert found.remedy == estimating("offset", "T", '"1 K"')  # the existing table of the case
    settings = parse([found.setting, "channels.30.column=T_20"])
    case = cases.load(path, settings=settings)
    assert list(case.roles("sensor")) == ["10", "30"]
    assert case.model.parameter_space.labels.keys() == {"alpha", "offset[10]"}
    assert (case.columns["10"].names, case.columns["30"].names) == (("T_10",), ("T_20",))
    document = tomlkit.parse(path.read_text())
    with_members(document, settings, path, allow_code=False)
    path.write_text(filled(tomlkit.dumps(document), settings, str(path)))
    assert cases.load(path).spec == case.spec


@pytest.mark.slow
@pytest.mark.parametrize("equation", ROD)
def test_every_cause_has_a_setting_that_makes_it_an_unknown(tmp_path, equation):
    path = short_rod(tmp_path)
    insulated = [*ROD[equation], "channels.T_right="]
    prepared = cases.load(path, settings=parse(insulated)).prepare()
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=tuple(causes()))])
    found = with_settings(prepared, verdict).findings[0].causes
    expected = ["offset[T_30]", "gain[T_30]", "position[T_30]", "source", "loss"]
    expected += ["flux_right", "transfer_right"]
    for cause, label in zip(found, expected, strict=False):
        settings = [*insulated, *cause.setting.split("; ")]
        again = cases.load(path, settings=parse(settings)).prepare()
        assert label in again.case.model.parameter_space.labels


def test_the_size_of_a_source_does_not_depend_on_the_unit_of_the_prior(tmp_path):
    path, cause = short_rod(tmp_path), Cause("source", "", "", size=1e-3)
    common = ["equation=conduction", "unknowns.alpha=", "unknowns.k={ prior = 100, std = 50 }"]
    common += ["channels.T_right=", "boundary.right.flux='1 W/m^2'"]
    given = ("unit = 'MJ/(m^3 K)', prior = 3.6, std = 1", "prior = 3.6e6, std = 1e6")
    priors = [f"unknowns.C={{ {text} }}" for text in given]
    found = {
        freed(cases.load(path, settings=parse([*common, prior])).prepare(), cause)
        for prior in priors
    }
    assert len(found) == 1


def test_a_cause_without_a_setting_says_so(tmp_path):
    prepared = cases.load(short_rod(tmp_path)).prepare()
    lag = Cause("lag", "T_10", "it is late", remedy="Check the clock.")
    there = Cause("flux", "right", "a flux is missing", size=1.0)  # the boundary has a value
    causes = lag, there
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=causes)])
    once = with_settings(prepared, verdict)
    remedies = [cause.remedy for cause in once.findings[0].causes]
    assert not any(cause.setting for cause in once.findings[0].causes)
    assert remedies == [f"Check the clock. {NO_SETTING}", NO_SETTING]
    assert with_settings(prepared, once) == once


def test_a_sensor_that_averages_is_read_along_a_line(tmp_path):
    path = short_rod(tmp_path)
    given = "channels.T_10.at=; channels.T_10.along=[[0.08], [0.12]]"
    settings = freed(cases.load(path).prepare(), Cause("averaging", "T_10", "", setting=given))
    observed = cases.load(path, settings=parse(settings)).prepare().identifier.observed
    u = observed.state.interpolate(lambda x: x[0] ** 2)
    mean = (observed.G @ u)[observed.names.index("T_10")]
    assert mean == pytest.approx(0.1**2 + 0.04**2 / 12.0, rel=0.01)
    uncertain = cases.load(path, settings=parse(["channels.T_10.at_std='1 cm'"])).prepare()
    assert freed(uncertain, Cause("averaging", "T_10", "", setting=given)) == ()


@pytest.mark.parametrize(("unit", "there"), [("degF", True), ("W/m^2", False)])
def test_a_column_is_not_read_in_the_unit_of_another_quantity(tmp_path, unit, there):
    prepared = cases.load(short_rod(tmp_path)).prepare()
    setting = f'channels.T_10.unit="{unit}"'
    assert freed(prepared, Cause("unit", "T_10", "", setting=setting)) == (setting,) * there


def test_settings_swap_exchanged_columns(tmp_path):
    """The law reports names of channels, which differ from the names of their columns."""
    path = short_rod(tmp_path)
    named = path.read_text().replace("T_10 = {", "first = {", 1)
    path.write_text(named)
    prepared = cases.load(path).prepare()
    given = 'channels.first.column="T_30"; channels.T_30.column="first"'
    cause = Cause("exchange", "first", "they may be exchanged", setting=given)
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    once = with_settings(prepared, verdict)
    (found,) = once.findings[0].causes
    assert found.setting == 'channels.first.column="T_30"; channels.T_30.column="T_10"'
    assert with_settings(prepared, once) == once
    right = cases.load(path, settings=parse(found.setting.split("; "))).prepare().raw
    part = replace(cause, setting='channels.T_1.column="T_30"; channels.T_30.column="T_1"')
    several = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(part,))])
    assert not with_settings(prepared, several).findings[0].causes[0].setting  # no such channel
    first = right.names.index("first")
    column = prepared.raw.names.index("T_30")
    np.testing.assert_array_equal(right.values[:, first], prepared.raw.values[:, column])


def test_an_offset_takes_the_prior_that_other_sensors_state(tmp_path):
    stated = {"channels.T_10.offset": "0.3 K"}
    prepared = cases.load(short_rod(tmp_path), settings=stated).prepare()
    cause = Cause("offset", "T_30", "", size=0.5)
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    (found,) = with_settings(prepared, verdict).findings[0].causes
    assert found.setting == 'channels.T_30.offset="0.3 K"'
    line = 'add `offset = "0.3 K"` to `[channels.T_30]`'
    assert found.remedy == f"To test this, estimate an offset: {line}."


def test_an_offset_that_is_estimated_already_is_not_recommended(tmp_path):
    stated = {"channels.T_10.offset": "0.3 K"}
    prepared = cases.load(short_rod(tmp_path), settings=stated).prepare()
    remedy, setting = estimating("offset", "T_10", '"1 K"'), "channels.T_10.offset=1"
    cause = Cause("offset", "T_10", "", remedy=remedy, setting=setting, size=0.5)
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    (found,) = with_settings(prepared, verdict).findings[0].causes
    assert (found.setting, found.remedy) == ("", "Check the offset and the position of T_10.")


def test_a_stated_start_that_the_first_readings_miss_may_be_uncertain(tmp_path):
    path = short_rod(tmp_path)
    first = cases.load(path).prepare().first.z
    stated = float(np.mean([first[name] for name in ("T_10", "T_30")])) + 5.0
    settings = parse([f"initial='{stated} degC'"])
    prepared = cases.load(path, settings=settings).prepare()
    cause = Cause("initial", "", "", setting='initial="interpolate"')
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    once = with_settings(prepared, verdict)
    (found,) = once.findings[0].causes
    assert found.setting == f'initial={{ from = "{stated} degC", std = "10 K" }}'
    assert found.setting in found.remedy
    assert with_settings(prepared, once) == once
    sizes = {"T_10": 0.2, "T_30": 0.2}
    names = [one.name for one in proposed(prepared, ended("as stated", 0.0, 1.0, errors=sizes))]
    assert names[0] == "uncertain start"
    again = cases.load(path, settings=(settings, parse(found.setting.split("; ")))).prepare()
    assert len(again.identifier.problem.initial_errors)


def test_the_uncertainty_of_a_start_without_a_unit_is_a_number():
    case = cases.load(FOLDER / "column.toml", settings=parse(["initial=0.1"]))
    (setting,) = freed(case.prepare(), Cause("initial", "", ""))
    assert setting.startswith("initial={ from = 0.1, std = 0.")


@pytest.mark.long
@pytest.mark.parametrize("equation", ROD)
def test_every_proposed_variant_is_a_case(tmp_path, equation):
    path = short_rod(tmp_path)
    own = [*ROD[equation], "channels.T_10.offset=0.2", "unknowns.source={ prior = 0, std = 1e-3 }"]
    prepared = cases.load(path, settings=parse(own)).prepare()
    sizes = {"T_10": 0.5, "T_30": 0.2}
    near = LastEstimate(1.0, 0.1, 0.8, 1.2)
    base = ended("as stated", 0.0, 1.0, errors=sizes, misfits=sizes, estimates={"k": near})
    found = proposed(prepared, base)
    names = {variant.name for variant in found}
    assert {"loss", "no offsets", "no source", "jumps", "offsets of all sensors"} <= names
    for variant in found:
        settings = parse(own), parse(variant.settings)
        assert cases.load(path, settings=settings).prepare().identifier


def heated(
    h: float = 1e-12, upper: float = 2e-5, switched: float = 0.0, step: float = 10.0
) -> pd.DataFrame:
    """Return readings of a rod with side loss, by finite volumes and the trapezoidal rule.

    The left end is driven, the surroundings are at `ambient`. `h`: heat transfer at the right end.
    `upper`: diffusivity beyond 10 cm. `switched`: source from 1200 s on.
    """
    cells, count, parts, rate = 120, round(2400.0 / step), 10, 3e-4
    dx = 0.3 / cells
    x, t = dx * (np.arange(cells) + 0.5), step * np.arange(count)
    alpha = np.where(x < 0.1, 2e-5, upper)
    left = 20.0 + 25.0 * (1.0 - np.exp(-t / 100.0)) * (1.0 + 0.4 * np.sin(t / 110.0))
    ambient = 20.0 + 1.5 * np.sin(t / 320.0)
    near = 2.0 / (1.0 / alpha[1:] + 1.0 / alpha[:-1]) / dx**2
    through = 1.0 / (1.0 / h + 0.5 * dx / alpha[-1]) / dx
    out = np.r_[2.0 * alpha[0] / dx**2, near], np.r_[near, through]
    A = scipy.sparse.diags_array([near, -out[0] - out[1] - rate, near], offsets=[-1, 0, 1])
    one, dt = scipy.sparse.eye_array(cells), step / parts
    solver = scipy.sparse.linalg.splu(scipy.sparse.csc_array(one - 0.5 * dt * A))
    u, shown = np.full(cells, 20.0), [np.full(cells, 20.0)]
    for k in range((count - 1) * parts):
        wall, air = (np.interp(dt * (k + 0.5), t, drive) for drive in (left, ambient))
        b = np.full(cells, rate * air + (switched if dt * k >= 1200.0 else 0.0))
        b[0] += out[0][0] * wall
        b[-1] += through * air
        u = solver.solve((one + 0.5 * dt * A) @ u + dt * b)
        if (k + 1) % parts == 0:
            shown.append(u)
    rng = np.random.default_rng(1)
    places = {"T_5": 0.05, "T_15": 0.15, "T_25": 0.25}
    readings = {
        name: np.array([np.interp(at, x, one) for one in shown]) + 0.05 * rng.standard_normal(count)
        for name, at in places.items()
    }
    return pd.DataFrame({"t": t, "left": left, "ambient": ambient} | readings)


HEATED = """
equation = "heat"
initial = "20 degC"
mesh = { from = 0, to = "30 cm", cells = 30 }
data = { file = "rod.csv", time = "t", time_unit = "s" }
[unknowns]
alpha = { prior = "3e-5 m^2/s", std = "2e-5 m^2/s", transform = "log" }
loss = { prior = "4e-4 1/s", std = "4e-4 1/s", transform = "log" }
[channels]
left = { column = "left", role = "boundary", at = "left" }
ambient = { column = "ambient", role = "input" }
T_5 = { column = "T_5", role = "sensor", at = "5 cm", noise = "0.05 K" }
T_15 = { column = "T_15", role = "sensor", at = "15 cm", noise = "0.05 K" }
T_25 = { column = "T_25", role = "sensor", at = "25 cm", noise = "0.05 K" }
"""


@pytest.mark.slow
def test_a_missing_heat_exchange_is_named_and_estimated(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(HEATED)
    heated(h=2e-5, step=20.0).to_csv(tmp_path / "rod.csv", index=False)
    base = run_variant(path, (), Variant("as stated"))
    assert (base.error, base.level) == ("", "caution")
    assert (base.causes[0].kind, base.causes[0].subject) == ("transfer", "right")
    variants = {one.name: one for one in proposed(cases.load(path).prepare(), base)}
    found = run_variant(path, (), variants["heat transfer at right"])
    assert found.level == "trusted"
    assert found.gained(base) > 1000.0
    truth = {"alpha": 2e-5, "loss": 3e-4, "transfer_right": 2e-5}
    assert all(one.low <= truth[name] <= one.high for name, one in found.estimates.items())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "error", "truth"),
    [
        (
            "layers of alpha",
            {"upper": 4e-5, "step": 20.0},
            {"alpha[layer_1]": 2e-5, "alpha[layer_2]": 4e-5},
        ),
        pytest.param(
            "source that jumps",
            {"switched": 0.003},
            {"alpha": 2e-5, "source": 0.003},
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_layer_for_each_sensor_and_a_source_that_jumps_are_tried(tmp_path, name, error, truth):
    """The layers meet halfway between the sensors, not in the middle of the domain."""
    path = tmp_path / "case.toml"
    path.write_text(HEATED)
    heated(**error).to_csv(tmp_path / "rod.csv", index=False)
    doubted = ended("as stated", 0.0, 1.0, errors={"T_5": 0.3})
    variants = {one.name: one for one in proposed(cases.load(path).prepare(), doubted)}
    found = run_variant(path, (), variants[name])
    assert found.error == ""
    assert found.misfit < 1.1
    truth = truth | {"loss": 3e-4}
    for label, value in truth.items():
        one = found.estimates[label]
        assert one.low <= value <= one.high
        assert abs(one.value / value - 1.0) < 0.1


def test_a_source_that_changes_all_the_time_is_tried(tmp_path):
    # Heat of hydration or of a compost rises and decays: neither constant nor a jump.
    path = tmp_path / "case.toml"
    path.write_text(HEATED)
    heated(switched=0.003).to_csv(tmp_path / "rod.csv", index=False)
    doubted = ended("as stated", 0.0, 1.0, errors={"T_5": 0.3})
    variants = {one.name: one for one in proposed(cases.load(path).prepare(), doubted)}
    prepared = cases.load(path, settings=parse(variants["source that changes"].settings)).prepare()
    assert prepared.case.model.parameter_space.unknown_of("source").evolution.moves


SWITCHED = """
equation = "pumping_test"
initial = 0
mesh = { from = "10 cm", to = "1 km", cells = 20, spacing = "geometric" }
options.b = "1 m"
data = { file = "well.csv", time = "time_s" }
unknowns.k = { prior = 5e-3, std = 5e-3, transform = "log" }
unknowns.Ss = { prior = 5e-4, std = 5e-4, transform = "log" }
channels.Q = { role = "input", column = "Q" }
channels.s = { role = "sensor", column = "s", at = "30 m", noise = 0.01 }
"""


def test_an_input_that_switches_is_held_in_a_variant_and_the_only_sensor_stays(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(SWITCHED)
    rate = np.repeat([0.02, 0.01, 0.0], 20)
    table = {"time_s": 600.0 * np.arange(60), "Q": rate, "s": 10 * rate}
    pd.DataFrame(table).to_csv(tmp_path / "well.csv", index=False)
    prepared = cases.load(path).prepare()
    cause = Cause("sensor", "s", "", setting='channels.s.role="ignored"')
    found = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    base = replace(ended("as stated", 0.0, 1.0, errors={"s": 0.3}), verdict=found.to_dict())
    names = [one.name for one in proposed(prepared, base)]
    assert "Q held" in names
    stated = cases.load(path, settings={"channels.Q.between": "line"}).prepare()
    assert "Q held" not in [one.name for one in proposed(stated, base)]
    assert freed(prepared, cause) == ()
    (causes,) = [one.causes for one in with_settings(prepared, found).findings]
    assert causes[0].setting == ""


def test_the_loss_of_a_column_is_its_decay(tmp_path):
    path = tmp_path / "case.toml"
    unknown = '{ prior = 10.0, std = 10.0, transform = "log" }'
    path.write_text(
        'equation = "advection_dispersion"\ninitial = 0\n'
        'mesh = { from = 0, to = 40, cells = 10 }\ndata = { file = "t.csv", time = "t" }\n'
        f"options.R = 2.0\nunknowns = {{ D = {unknown}, v = {unknown} }}\n"
        'channels.c_in = { role = "input", column = "c_in" }\n'
        'channels.c = { role = "sensor", column = "c", at = 20, noise = 0.01 }\n'
    )
    (tmp_path / "t.csv").write_text("t,c_in,c\n0,1,0\n1,1,0.1\n2,1,0.2\n")
    lost = Cause("loss", "", "", size=0.05)
    (setting,) = freed(cases.load(path).prepare(), lost)
    assert setting.startswith("unknowns.decay=")
    assert "prior = 0.1" in setting  # R times the rate
    assert cases.load(path, settings=(parse([setting]),)).prepare()
    stated = cases.load(path, settings={"options.decay": 0.1}).prepare()
    assert freed(stated, lost) == ()


def test_estimates_of_a_recommended_variant_that_is_not_trusted_are_not_to_be_used():
    unusable = Verdict.of([Finding("misfit", "do not trust", "It misfits.")]).to_dict()
    estimate = {"k": LastEstimate(1.0, 0.1, 0.8, 1.2)}
    sound = ended("as stated", 10.0, math.nan, estimates=estimate)
    base = replace(sound, verdict=unusable)
    best = replace(ended("best", 50.0, math.nan, estimates=estimate), verdict=unusable)
    said = " ".join(conclusions(base, [best]))
    assert "Recommended: 'best'" in said
    assert "Do not use its estimates: no variant explains the data." in said
    assert "All variants agree" not in said
    usable = replace(best, verdict=sound.verdict)
    assert "All variants agree" in " ".join(conclusions(base, [usable]))
    unjudged = replace(best, verdict=Verdict.unjudged().to_dict())
    assert "Do not use" not in " ".join(conclusions(base, [unjudged]))


def test_a_variant_without_an_unknown_omits_its_inputs(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(HEATED)
    heated().iloc[:5].to_csv(tmp_path / "rod.csv", index=False)
    with pytest.raises(CaseError, match=r"channels\.ambient: the equation does not read it with"):
        cases.load(path, settings={"unknowns.loss": None})
    variants = {
        one.name: one for one in proposed(cases.load(path).prepare(), ended("as stated", 0.0, 1.0))
    }
    assert variants["no loss"].settings == ("unknowns.loss=", "channels.ambient=")
    assert not run_variant(path, (), variants["no loss"]).error


def test_a_variant_has_no_reference_for_unknowns_that_it_lacks(tmp_path):
    """Variants without such a number failed if the case had a published value of it."""
    path = tmp_path / "case.toml"
    path.write_text(f'{HEATED}\n[reference]\nalpha = "1e-5 m^2/s"\nloss = "1e-4 1/s"\n')
    heated().iloc[:5].to_csv(tmp_path / "rod.csv", index=False)
    prepared = cases.load(path).prepare()
    variants = {one.name: one for one in proposed(prepared, ended("as stated", 0.0, 1.0))}
    for name in ("no loss", "two layers of alpha"):
        assert not run_variant(path, (), variants[name]).error


def test_no_variant_removes_an_unknown_that_the_equation_needs(tmp_path):
    """The flow in a stream bed needs `v` or `K`, so no variant removes the only one."""
    path = tmp_path / "case.toml"
    flow = 'v = { prior = "0 m/s", std = "1e-6 m/s" }'
    lines = [one for one in HEATED.splitlines() if not one.startswith(("loss", "ambient"))]
    text = "\n".join(lines).replace('"heat"', '"advection_diffusion"')
    path.write_text(text.replace("alpha =", f"{flow}\nkappa ="))
    heated().iloc[:5].to_csv(tmp_path / "rod.csv", index=False)
    found = proposed(cases.load(path).prepare(), ended("as stated", 0.0, 1.0))
    assert "no v" not in {variant.name for variant in found}


def test_a_setting_adds_an_unknown_only_as_a_whole(tmp_path):
    path = short_rod(tmp_path)
    whole = {"unknowns.source": {"prior": "0 K/s", "std": "1e-3 K/s"}}
    assert "source" in cases.load(path, settings=whole).model.parameter_space.labels
    with pytest.raises(CaseError, match="to add it, set all of it"):
        cases.load(path, settings={"unknowns.sorce.std": "1e-3 K/s"})


def test_a_key_that_is_new_among_dotted_keys_has_its_own_line():
    text = "unknowns.alpha = { prior = 1 }  # told\noptions.C = 2\nlaw = { noise = 1 }\n"
    given = {"unknowns.loss": {"prior": 3}, "options.H": 4, "unknowns.alpha.prior": 5}
    for key, value in given.items():
        once = _with(text, key.split("."), value)
        assert read_toml(once, "") == apply(read_toml(text, ""), {key: value}, "")
        assert once.count("# told\n") == 1


# --- effects that an equation neglects at the start of a process ---------------------------------

RESPONSE = """
equation = "borehole"
initial = "10 degC"
options = { H = "100 m", T0 = "10 degC" }
mesh = { from = "65 mm", to = "10 m", cells = 10, spacing = "geometric" }
data = { file = "test.csv", time_unit = "h" }
unknowns.k = { prior = "2 W/(m K)", std = "1 W/(m K)" }
unknowns.R_b = { prior = "0.1 m K/W", std = "0.1 m K/W" }
law.noise = "0.1 K"
channels.Q = { role = "input", column = "Q" }
channels.T = { role = "sensor", column = "T", quantity = "fluid" }
"""


@pytest.mark.parametrize(
    ("begin", "end", "level", "told"),
    [
        (0, 72, "caution", 'grouted_borehole".*: `data.assimilate_from="27 h"`. Check the clock'),
        (0, 50, "caution", 'grouted_borehole"` contains. Check'),  # 27 h is more than half of it
        (25, 72, "caution", 'grouted_borehole"` contains. Check'),  # nearly as late
        (30, 72, "do not trust", 'grouted_borehole"` contains. Check'),  # begins later already
        (0, 72, "trusted", "^Check the clock"),
    ],
)
def test_a_misfit_of_a_response_test_names_the_stored_heat(tmp_path, begin, end, level, told):
    (tmp_path / "test.csv").write_text(
        "time,Q,T\n" + "".join(f"{t},5000,{15 + 0.1 * t}\n" for t in range(end + 1))
    )
    (tmp_path / "case.toml").write_text(RESPONSE)
    settings = {"data.assimilate_from": f"{begin} h"}
    prepared = cases.load(tmp_path / "case.toml", settings=settings).prepare()
    misfit = Finding("misfit", "caution", "Model misfit.", "T", remedy="Check the clock.")
    once = with_settings(prepared, Verdict(level, (misfit,)))
    assert re.search(told, once.findings[0].remedy)
    assert with_settings(prepared, once) == once
    later = [
        one
        for one in proposed(prepared, VariantRun(Variant("as stated")))
        if one.name == "later start"
    ]
    assert [one.settings for one in later] == (
        [('data.assimilate_from="27 h"',)] if (begin, end) == (0, 72) else []
    )


def test_sensors_of_a_family_are_readings_of_the_start(tmp_path):
    (tmp_path / "rows.csv").write_text("t,u_0,u_1,left\n0,23,17,20\n9,24,18,20\n")
    boundary = 'left = { role = "boundary", column = "left", at = "left" }'
    family = 'u = { role = "sensor", column = "u_{}", each = ["20 cm", "40 cm", 2] }'
    (tmp_path / "case.toml").write_text(
        f"{ROD_CASE}noise = 0.1\n[channels]\n{boundary}\n{family}\n"
    )
    assert first_miss(cases.load(tmp_path / "case.toml").prepare()) == pytest.approx(3.0)


def test_a_quantity_is_no_reading_of_the_start(tmp_path):
    # The fluid of a heated borehole is R_b Q/H warmer than its wall from the first reading on.
    (tmp_path / "test.csv").write_text("time,Q,T\n0,5000,15\n1,5000,16\n")
    (tmp_path / "case.toml").write_text(RESPONSE)
    prepared = cases.load(tmp_path / "case.toml").prepare()
    assert first_miss(prepared) == 0.0
    assert start_missed(prepared, Verdict("caution", ())) == []
    # It has no position that could be wrong, because `at_std` requires `at`.
    assert stated_positions(prepared.identifier.observed) is None


def test_a_variant_that_other_readings_make_usable_is_named():
    base = VariantRun(Variant("as stated"), verdict={"level": "do not trust"}, log_evidence=0.0)
    later = replace(
        base, variant=Variant("later start"), verdict={"level": "caution"}, readings={"T": 3}
    )
    assert "'later start' has the verdict 'caution' with its readings." in conclusions(
        base, [later]
    )


def test_each_variant_has_a_line_in_a_terminal(monkeypatch, capsys):
    def two(quiet=False):
        with timed(["as stated", "offset of [T_10]"], quiet) as running:
            for index in range(2):
                with running(index):
                    pass
        return capsys.readouterr()

    assert two() == ("", "as stated: 0 s\noffset of [T_10]: 0 s\n")  # without a terminal
    monkeypatch.setenv("FORCE_COLOR", "1")
    output, shown = two()
    assert output == ""
    assert all(text in shown for text in ("✓", "as stated", "offset of [T_10]", "0:00:00"))
    assert two(quiet=True) == ("", "")
