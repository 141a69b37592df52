"""Keys of a channel that correct its column: `factor` and `late`."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from factories import short_rod

from livepde import cases
from livepde.cases.recommendation import recommended
from livepde.cases.remedies import with_settings
from livepde.cases.variants import GAINED, Variant, run_variant
from livepde.errors import CaseError
from livepde.samples import noise_channel
from livepde.verdict import Cause, Finding, Verdict

ROWS = 41


def changed(folder: Path, change) -> Path:
    path = short_rod(folder, ROWS)
    table = pd.read_csv(path.parent / "rod.csv")
    change(table)
    table.to_csv(path.parent / "rod.csv", index=False)
    return path


def read(path: Path, **settings: object):
    raw = cases.load(path, settings=settings).prepare().raw
    return pd.DataFrame(raw.values, index=raw.t, columns=list(raw.names))


def late_by(name: str, rows: int):
    def change(table: pd.DataFrame) -> None:
        table[name] = table[name].shift(rows)

    return change


@pytest.mark.parametrize("name", ["T_10", "T_left"])
def test_a_late_column_is_read_at_its_times(tmp_path, name):
    plain = read(short_rod(tmp_path / "plain", ROWS))
    step = float(np.median(np.diff(plain.index)))
    path = changed(tmp_path / "late", late_by(name, 3))
    found = read(path, **{f"channels.{name}.late": f"{3 * step} s"})
    times = plain.index[:-4]
    np.testing.assert_allclose(
        found.loc[times, list(plain.columns)], plain.loc[times], rtol=1e-12, equal_nan=True
    )


def test_an_early_column_is_read_at_its_times_and_the_run_begins_as_before(tmp_path):
    plain = read(short_rod(tmp_path / "plain", ROWS))
    step = float(np.median(np.diff(plain.index)))
    path = changed(tmp_path / "early", late_by("T_10", -3))
    found = read(path, **{"channels.T_10.late": f"{-3 * step} s"}).loc[plain.index]
    assert found["T_10"].isna().tolist()[:4] == [True, True, True, False]
    plain.loc[plain.index[:3], "T_10"] = np.nan  # lost by the shift
    np.testing.assert_allclose(found[list(plain.columns)], plain, rtol=1e-12, equal_nan=True)


def test_a_factor_corrects_a_scale(tmp_path):
    plain = read(short_rod(tmp_path / "plain", ROWS))

    def scaled(table: pd.DataFrame) -> None:
        table["T_left"] *= 1.25

    found = read(changed(tmp_path / "scaled", scaled), **{"channels.T_left.factor": 0.8})
    np.testing.assert_allclose(found[list(plain.columns)], plain, rtol=1e-12)


def test_a_factor_turns_the_sign_of_readings_but_not_of_their_noise(tmp_path):
    plain = read(short_rod(tmp_path / "plain", ROWS))

    def turned(table: pd.DataFrame) -> None:
        table["T_10"] *= -1.0
        table["s"] = 0.1

    path = changed(tmp_path / "turned", turned)
    settings = {"channels.T_10.factor": -1, "channels.T_10.noise_column": "s"}
    found = read(path, **settings)
    np.testing.assert_allclose(found[list(plain.columns)], plain, rtol=1e-12)
    table = cases.load(path, settings=settings).prepare().raw
    assert (table.values[:, table.names.index("noise of T_10")] == 0.1).all()
    with pytest.raises(CaseError, match=r"channels\.T_10\.factor: got 0"):
        cases.load(path, settings={"channels.T_10.factor": 0})


def test_a_source_that_goes_on_has_no_late_columns(tmp_path):
    path = short_rod(tmp_path, ROWS)
    case = cases.load(path, settings={"channels.T_10.late": "5 s"})
    with pytest.raises(CaseError, match=r"T_10\.late: late requires complete data"):
        case.read(iter(['{"time": 0.0}']))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "key"),
    [
        (late_by("T_10", 4), "channels.T_10.late="),
        pytest.param(
            lambda table: table.__setitem__("T_left", 1.3 * table["T_left"]),
            "channels.T_left.",
            marks=pytest.mark.long,
        ),
    ],
)
def test_the_cause_of_a_wrong_column_has_the_key_that_corrects_it(tmp_path, change, key):
    path = changed(tmp_path, change)
    prepared = cases.load(path).prepare()
    verdict = with_settings(prepared, prepared.identifier.run(prepared.stream).last.verdict)
    causes = [cause for finding in verdict.findings for cause in finding.causes]
    assert any(cause.setting.startswith(key) for cause in causes), verdict.sentences
    late = [cause for cause in causes if cause.kind == "lag"]
    assert all(f"set `{cause.setting}`" in cause.remedy for cause in late), verdict.sentences


def test_the_noise_of_a_reading_has_its_time(tmp_path):
    def noisy(table: pd.DataFrame) -> None:
        table["s"] = 0.01 * (1.0 + np.arange(len(table)))
        late_by("T_10", 3)(table)
        late_by("s", 3)(table)

    path = changed(tmp_path, noisy)
    step = float(np.median(np.diff(pd.read_csv(path.parent / "rod.csv")["time_s"])))
    settings = {"channels.T_10.noise_column": "s", "channels.T_10.late": f"{3 * step} s"}
    found = read(path, **settings)
    noise = found[noise_channel("T_10")].dropna()
    known = found["T_10"].dropna()
    assert len(known) > ROWS // 2
    assert set(known.index) <= set(noise.index)


def test_a_channel_without_values_may_be_late(tmp_path):
    path = changed(tmp_path, lambda table: table.__setitem__("T_20", np.nan))
    found = read(path, **{"channels.T_20.late": "5 s"})
    assert len(found) == ROWS
    assert found["T_20"].isna().all()


def test_a_sensor_between_the_rows_of_the_others_changes_no_input(tmp_path):
    """Half an interval late: its readings get separate rows, and inputs do not change."""
    plain = read(short_rod(tmp_path / "plain", ROWS))
    step = float(np.median(np.diff(plain.index)))
    found = read(short_rod(tmp_path / "late", ROWS), **{"channels.T_10.late": f"{step / 2} s"})
    shared = found.index.intersection(plain.index)
    np.testing.assert_allclose(found.loc[shared, "T_left"], plain.loc[shared, "T_left"])
    # The first one is before all other rows: there, the initial profile has the line to the next.
    begin, *later = shared
    assert found.loc[begin, "T_10"] == pytest.approx(plain["T_10"].iloc[:2].mean())
    assert found["T_10"].count() == plain["T_10"].count()
    assert not found.loc[later, "T_10"].notna().any()


@pytest.mark.parametrize("role", ["validation", "ignored"])
def test_no_reading_is_made_up_beside_the_initial_profile(tmp_path, role: str):
    path = short_rod(tmp_path, ROWS)
    plain = read(path)
    step = float(np.median(np.diff(plain.index)))
    late = {"channels.T_20.late": f"{step / 2} s", "channels.T_20.role": role}
    found = read(path, **late)
    assert not found.loc[found.index.intersection(plain.index), "T_20"].notna().any()


@pytest.mark.slow
def test_a_late_sensor_is_fitted_as_if_it_were_not(tmp_path):
    """Half an interval late, with refits and gaps: the estimate of the table without a fault."""
    plain = cases.load(short_rod(tmp_path / "plain", 61)).prepare()
    whole = plain.identifier.run(plain.stream).last
    path = short_rod(tmp_path / "late", 61)
    table = pd.read_csv(path.parent / "rod.csv")
    step = float(np.median(np.diff(table["time_s"])))
    times = table["time_s"].to_numpy(float)
    # The table has what T_10 was half an interval before, on a straight line.
    table["T_10"] = np.interp(times - 0.5 * step, times, table["T_10"])
    table.loc[[20, 33], "T_10"] = np.nan
    table.to_csv(path.parent / "rod.csv", index=False)
    late = cases.load(path, settings={"channels.T_10.late": f"{step / 2} s"}).prepare()
    found = late.identifier.run(late.stream).last
    (one, std), (other, _) = found.parameters["alpha"], whole.parameters["alpha"]
    assert abs(one - other) < 2.0 * std


def test_the_setting_of_a_cause_has_the_size_that_was_fitted():
    linear = Cause("lag", "T_10", "T_10 is 71 s late", 0.9, "", 'channels.T_10.late="71 s"', 71.0)
    fitted = Cause("lag", "T_10", "T_10 is 80 s late", 0.9, "", 'channels.T_10.late="80 s"', 80.0)
    misfit = Finding("misfit", "caution", "The residuals are large.", causes=(linear,))
    (found,) = Verdict((misfit,)).with_causes([fitted]).findings[0].causes
    assert found.setting == fitted.setting


@pytest.mark.slow
def test_an_early_input_is_compared_with_the_readings_that_it_uses(tmp_path):
    path = changed(tmp_path, lambda table: table.update(table["T_left"].shift(-3).ffill()))
    step = pd.read_csv(path.parent / "rod.csv").iloc[:, 0].diff().median()
    plain = ("law.shadows=false",)
    base = run_variant(path, plain, Variant("as stated"))
    # The run begins when the input does, after the first readings of the sensors.
    late = f'channels.T_left.late="{-2.9 * step} s"'
    early = run_variant(path, plain, Variant("early", (late,)))
    assert early.readings["T_30"] == base.readings["T_30"] - 3
    assert early.gained(base) > GAINED
    assert early.same_readings == pytest.approx(base.log_evidence, rel=0.3)
    assert early.same_readings > base.log_evidence  # without three readings that misfit
    assert recommended(base, [early]) is early


@pytest.mark.slow
def test_a_late_column_that_loses_nothing_is_compared_with_the_case(tmp_path):
    path = changed(tmp_path, late_by("T_10", 3))
    step = pd.read_csv(path.parent / "rod.csv").iloc[:, 0].diff().median()
    late = run_variant(path, (), Variant("late", (f'channels.T_10.late="{3 * step} s"',)))
    assert late.same_readings is None
