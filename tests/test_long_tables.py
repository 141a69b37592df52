"""Tables with a row for each reading (long format): a column of sensors and one of values."""

from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from livepde.cases import load
from livepde.cli import app
from livepde.errors import CaseError, DataError
from livepde.runs import input_findings

CASE = """\
equation = "heat"
initial = "interpolate"
mesh = {{ from = 0, to = 1, cells = 10 }}
data = {{ file = "{file}", time = "when"{more} }}
unknowns.alpha = {{ prior = 1e-5, std = 1e-5, transform = "log" }}
law = {{ noise = 0.1 }}
[channels]
hot = {{ role = "boundary", column = "hot", at = "left" }}
T_1 = {{ role = "sensor", column = "T_1", at = 0.2 }}
T_2 = {{ role = "sensor", column = "T_2", at = 0.6 }}
"""
LONG = ', sensor = "name", value = "reading"'


def tables(folder: Path, hours: str = "2025-06-01") -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return a table with a column for each sensor, and the same with a row for each reading."""
    when = pd.date_range(hours, periods=8, freq="30min", tz="Europe/Berlin")
    values = np.arange(24.0).reshape(8, 3)
    wide = pd.DataFrame(values, columns=["hot", "T_1", "T_2"])
    wide.insert(0, "when", when.strftime("%Y-%m-%d %H:%M"))
    wide.loc[3, "T_1"] = np.nan
    long = wide.melt("when", var_name="name", value_name="reading").dropna()
    return wide, long


def read(folder: Path, table: pd.DataFrame, more: str) -> pd.DataFrame:
    """Return what a case reads from a table, with a column for each channel."""
    table.to_csv(folder / "rows.csv", index=False)
    (folder / "case.toml").write_text(CASE.format(file="rows.csv", more=more))
    found = load(folder / "case.toml").read().raw
    names = list(found.names)
    return pd.DataFrame(found.values, index=found.t, columns=names)[sorted(names)]


@pytest.mark.parametrize("hours", ["2025-06-01", "2025-10-26 01:00"])  # clocks are set back
@pytest.mark.parametrize("order", ["name", "when"])
def test_both_formats_are_the_same_data(tmp_path: Path, hours: str, order: str) -> None:
    wide, long = tables(tmp_path, hours)
    if order == "when":
        long = long.sort_index().iloc[np.argsort(long.groupby("name").cumcount(), kind="stable")]
    zone = ', zone = "Europe/Berlin"'
    pd.testing.assert_frame_equal(
        read(tmp_path, wide, zone), read(tmp_path, long, zone + LONG), check_like=True
    )


def test_a_start_is_made_of_all_sensors_though_each_has_its_own_times(tmp_path: Path) -> None:
    _, long = tables(tmp_path)
    late = long["name"].map({"hot": 0, "T_1": 1, "T_2": 2})
    long["when"] = pd.to_datetime(long["when"]) + pd.to_timedelta(10 * late, unit="min")
    first = read(tmp_path, long.astype({"when": str}), LONG).iloc[0]
    # The run begins with the last sensor, 20 minutes after the first: readings rise by 3 in 30.
    assert first.to_dict() == pytest.approx({"hot": 0 + 2, "T_1": 1 + 1, "T_2": 2})


def test_init_finds_sensors_and_their_units(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _, long = tables(tmp_path)
    long["unit"] = np.where(long["name"] == "T_2", "degF", "°C")
    long.sort_values("when").to_csv("rows.csv", index=False)
    done = CliRunner().invoke(app, ["init", "new", "--data", "rows.csv"])
    assert done.exit_code == 0, done.output
    text = Path("new/case.toml").read_text()
    assert 'sensor = "name", value = "reading"' in text
    assert 'T_2 = { role = "sensor", column = "T_2", at = "? m", unit = "degF" }' in text
    assert 'T_1 = { role = "sensor", column = "T_1", at = "? m" }' in text


def test_init_uses_stated_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _, long = tables(tmp_path)
    long["name"] = long["name"].map({"hot": 1, "T_1": 2, "T_2": 3})
    long.to_csv("rows.csv", index=False)
    stated = ["--set", "data.sensor=name", "--set", "data.value=reading"]
    done = CliRunner().invoke(app, ["init", "new", "--data", "rows.csv", *stated])
    assert done.exit_code == 0, done.output
    assert 'column = "3"' in Path("new/case.toml").read_text()


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    _, long = tables(tmp_path)
    with pytest.raises(DataError, match=r"set `data.sensor` and `data.value`"):
        read(tmp_path, long.sort_values("when").assign(hot=long.index, T_1=1, T_2=1), "")
    with pytest.raises(DataError, match=r"there is no sensor 'hot'; did you mean 'hot2'"):
        read(tmp_path, long.replace({"name": {"hot": "hot2"}}), LONG)
    with pytest.raises(CaseError, match="sensor and value are two columns"):
        read(tmp_path, long, ', sensor = "name"')


def test_a_note_calls_a_sensor_a_sensor() -> None:
    counts = {("early", "T_1"): 1, ("interpolated", "hot"): 2}
    journal: Any = MagicMock(counts=counts, __len__=lambda _: 9)
    first, second = (found.text for found in input_findings(journal, ["hot"]))
    assert first == "Input hot: 2 missing values were interpolated."
    assert second.startswith("Sensor T_1: 1 first values were earlier")
