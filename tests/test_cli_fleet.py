"""`livepde fleet`: a run directory for each row of a table."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from livepde import cli, runs
from livepde.cases.template import write_template
from livepde.cli.printing import INTERRUPTED
from livepde.errors import ConfigurationError, DataError, RunError

TABLE = """name,data,unknowns.alpha.prior,law.noise
plain,,,
warm,rod/warm.csv,4e-5 m^2/s,
lost,rod/nowhere.csv,,
wrong,,hot,
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A case, a second data file, and a table of four members of which two cannot run."""
    monkeypatch.chdir(tmp_path)
    write_template(tmp_path / "rod")
    case = Path("rod/case.toml")
    case.write_text(case.read_text().replace("replay = true", "replay = false"))
    rows = Path("rod/rod.csv").read_text().splitlines()[:40]
    Path("rod/rod.csv").write_text("\n".join(rows) + "\n")
    Path("rod/warm.csv").write_text("\n".join(rows[:30]) + "\n")
    Path("rods.csv").write_text(TABLE)
    return tmp_path


def call(*arguments: str) -> tuple[int, str]:
    """Return exit code and output of a command that ends as it should."""
    result = CliRunner().invoke(cli.app, list(arguments))
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def alone(out: str, *options: str) -> pd.Series:
    """Return the estimates of `livepde run`."""
    call("run", "rod/case.toml", "--out", out, "--json", *options)
    return runs.open(Path(out)).dataset["alpha"].to_series()


def test_each_row_is_a_run_of_its_own(here):
    code, output = call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods")
    assert code == 1  # two of them cannot run
    assert "wrong:" in output
    table = pd.read_csv("rods/fleet.csv").set_index("name")
    assert table["status"].tolist() == ["finished", "finished", "failed", "failed"]
    assert table["samples"].tolist() == [39, 29, 0, 0]
    assert not Path("rods/lost").exists()
    for name, options in {
        "plain": (),
        "warm": ("--data", "rod/warm.csv", "--set", "unknowns.alpha.prior=4e-5 m^2/s"),
    }.items():
        mine = runs.open(Path("rods") / name)
        pd.testing.assert_series_equal(
            mine.dataset["alpha"].to_series(), alone(f"alone_{name}", *options)
        )
        assert table.loc[name, "alpha"] == float(mine.dataset["alpha"][-1])


def test_goes_on_with_what_is_there(here):
    Path("rods.csv").write_text("name,data\nplain,\n")
    arguments = ["fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods", "--json"]
    _, first = call(*arguments)
    with pytest.raises(RunError, match="already holds a run"):
        call(*arguments)
    Path("rods.csv").write_text("name,data\nplain,\nwarm,rod/warm.csv\n")
    _, second = call(*arguments, "--resume")
    rows = [json.loads(text)["tables"][0]["rows"] for text in (first, second)]
    assert rows[0][0] == rows[1][0]
    assert [row[0] for row in rows[1]] == ["plain", "warm"]


def test_in_several_processes(here):
    pytest.importorskip("joblib", reason="the extra 'fleet' is not installed")
    call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "one")
    call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "two", "--jobs", "2")
    one, two = (pd.read_csv(f"{folder}/fleet.csv") for folder in ("one", "two"))
    pd.testing.assert_frame_equal(one, two)
    assert runs.open(Path("two/warm")).record["status"] == "finished"


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ("data\nrod.csv\n", "one called 'name'"),
        ("name\n", "no rows"),
        ("name\na\na\n", "'a' is taken"),
        ("name\n../a\n", "does not do for a folder"),
        ("name,data\n,rod.csv\n", "does not do for a folder"),
        ("", "Cannot read the members"),
    ],
)
def test_bad_tables(here, table, match):
    Path("rods.csv").write_text(table)
    with pytest.raises(DataError, match=match):
        call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods")
    assert not Path("rods").exists()


def test_bad_options(here):
    arguments = ["fleet", "rod/case.toml", "--members", "rods.csv"]
    with pytest.raises(ConfigurationError, match="--resume needs --out"):
        call(*arguments, "--resume")
    with pytest.raises(ConfigurationError, match="--jobs 0"):
        call(*arguments, "--jobs", "0")


def test_an_interruption_ends_all(here, monkeypatch):
    """Members after the one that was interrupted do not begin."""
    begun = []

    def run(*arguments):
        begun.append(arguments[-1].name)
        return module.Ended(begun[-1], "interrupted" if len(begun) == 2 else "finished")

    module = sys.modules["livepde.cli.fleet"]
    monkeypatch.setattr(module, "_run", run)
    code, _ = call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods")
    assert (code, begun) == (INTERRUPTED, ["plain", "warm"])
