"""`livepde init --data` fills in what the table determines, and names what is missing."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import livepde as lp
from livepde import cases
from livepde.cases.data import source_of
from livepde.cases.measured import measured
from livepde.cases.new_case import channels_in, write_template
from livepde.cases.read import blanks_in, read_toml
from livepde.cli import app
from livepde.errors import CaseError
from livepde.models import EQUATIONS
from livepde.units import conversion, convert

GERMAN = """\
Zeit;Tiefe 5 cm [°C];Fühler (0,2 m);Bemerkung
01.04.2025 12:00;20,5;19;
01.04.2025 12:10;21,5;19,1;Regen
01.04.2025 12:30;;19,2;
"""

FILLED = {
    "mesh.from": 0,
    "mesh.to": "20 cm",
    "law.noise": "1 K",
    "unknowns.alpha.prior": "5e-5 m^2/s",
    "unknowns.alpha.std": "3e-5 m^2/s",
}


def begun(text: str, encoding: str = "utf-8", equation: str = "heat") -> dict:
    """Return the parsed case that `init` writes for a table."""
    Path("my.csv").write_bytes(text.encode(encoding))
    case, _ = write_template(Path("mine"), Path("my.csv"), EQUATIONS[equation])
    return tomllib.loads(case.read_text())


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252"])
def test_a_table_from_a_german_excel_is_read(here, encoding):
    found = begun(GERMAN, encoding)
    how = {} if encoding.startswith("utf-8") else {"encoding": encoding}
    assert found["data"] == {
        "file": "../my.csv",
        "time": "Zeit",
        "time_format": "%d.%m.%Y %H:%M",
        "separator": ";",
        "decimal": ",",
        **how,
    }
    assert found["channels"] == {
        "Tiefe_5_cm": {"role": "sensor", "column": "Tiefe 5 cm [°C]", "at": "5 cm"},
        "Fühler": {"role": "sensor", "column": "Fühler (0,2 m)", "at": "0.2 m"},
    }
    assert "steps" not in found
    text = Path("mine/case.toml").read_text()
    assert (
        "# 3 rows from 2025-04-01 12:00:00 to 2025-04-01 12:30:00 UTC, 900 s apart (median)" in text
    )
    assert "# without numbers: Bemerkung" in text
    assert "20.5 to 21.5, 1 missing, position from the name" in text


@pytest.mark.parametrize(
    ("header", "time", "unit", "step"),
    [
        ("time_min,T_0.05,T_b", "time_min", "min", "10 min"),
        ("t [h],T_0.05,T_b", "t [h]", "h", "10 h"),
        ("minutes,T_0.05,T_b", "minutes", "minutes", "10 minutes"),
        ("index,T_0.05,T_b", "index", "?", "? s"),
    ],
)
def test_numbers_are_read_as_times(here, header, time, unit, step):
    found = begun(f"{header}\n0,20,20\n10,21,\n20,20,21\n60,20,21\n")
    assert found["data"] == {"file": "../my.csv", "time": time, "time_unit": unit}
    assert found["steps"]["dt_max"] == step
    assert found["channels"]["T_0_05"]["at"] == "? m"
    assert 'at = "0.05 m"?' in Path("mine/case.toml").read_text()


def test_the_column_with_a_unit_of_time_goes_before_one_that_counts(here):
    assert begun("n,time_s,T\n0,0,20\n1,10,20\n")["data"]["time"] == "time_s"
    Path("mine/case.toml").unlink()
    assert begun("n,when,T\n0,2025-04-01,20\n1,2025-04-02,20\n")["data"]["time"] == "when"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("0,20,20\n10,21,20\n", "has no header. Add a first line with the names"),
        ("T\n20\n21\n", "has one column, 'T'; expected times and measurements"),
        ("time_s,T_1\n", "has no rows below its header."),
        (
            "time,T_1\na,b\ns,K\nc,d\n0,20\n",
            "row 2: contains no numbers. If the header has two lines",
        ),
        ("T_1,T_2\n20,20\n20,21\n19,20\n", "no column contains times: expected dates, or numbers"),
        (",T\n2025-04-01,20\n2025-04-02,20\n", "Column 1 has no name: give it one."),
        ("time_s,note\n0,a\n1,b\n", "no column but the times, 'time_s', contains numbers"),
        ("at,T\n12:00,20\n11:10,20\n", "'at' has times of day: add a column of days."),
        ("time_s,T\n0,20\n20,20\n10,20\n", "row 4, column 'time_s': the time is earlier"),
        ("time_s,T\n0,20\n20,ERR\n40,20\n", "row 3, column 'T': got 'ERR'"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_sentence(here, text, told):
    with pytest.raises(lp.errors.DataError, match=re.escape(told)) as error:
        begun(text)
    assert str(error.value).startswith("my.csv")
    assert not Path("mine").exists()


def test_a_table_without_a_header_is_refused(here):
    Path("my.jsonl").write_text('{"time": 0}')
    with pytest.raises(lp.errors.DataError, match=r"my\.jsonl: expected a CSV file"):
        write_template(Path("mine"), Path("my.jsonl"))
    with pytest.raises(lp.errors.DataError, match=r"there is no file 'my\.csv'"):
        write_template(Path("mine"), Path("my.csv"))


def test_a_folder_is_refused_as_a_table(here):
    Path("my.csv").write_text("time_s,T\n0,20\n")
    with pytest.raises(
        lp.errors.RunError, match=r"my\.csv is a file: 'livepde init DIR --data my\.csv'"
    ):
        write_template(Path("my.csv"))


def test_what_loggers_write_for_no_value_is_missing(here):
    begun("time_s,T\n0,20\n10,---\n20,#NV\n30,--\n")
    assert "20 to 20, 3 missing" in Path("mine/case.toml").read_text()


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("03/02/2026 08:00", "03/02/2026 08:10", "'%d/%m/%Y %H:%M' (2026-02-03 08:00:00) or "),
        ("16/06/28 06:45", "16/06/28 07:00", "'%y/%m/%d %H:%M' (2016-06-28 06:45:00)"),
    ],
)
def test_an_order_of_day_and_month_that_cannot_be_known_is_refused(here, first, second, told):
    with pytest.raises(lp.errors.DataError, match=re.escape(told)) as error:
        begun(f"time,T\n{first},20\n{second},20\n")
    assert f"the order of day, month and year in '{first}' is ambiguous" in str(error.value)


@pytest.mark.parametrize(
    ("first", "second", "form", "origin"),
    [
        ("16/06/28 23:45", "16/06/29 00:00", "%y/%m/%d %H:%M", "2016-06-28 23:45:00"),
        ("6/28/2016 11:45 PM", "6/29/2016 12:00 AM", "%m/%d/%Y %I:%M %p", "2016-06-28 23:45:00"),
        ("28-Jun-2016 23:45", "29-Jun-2016 00:00", "%d-%b-%Y %H:%M", "2016-06-28 23:45:00"),
    ],
)
def test_the_order_of_day_and_month_is_inferred_from_the_rows(here, first, second, form, origin):
    third = second.replace("00:00", "00:15").replace("12:00", "12:15")
    text = f"id,time,T\n1,{first},20\n2,{second},20\n3,{third},21\n"
    found = begun(text)
    assert found["data"] == {"file": "../my.csv", "time": "time", "time_format": form}
    assert set(found["channels"]) == {"T"}
    assert "# numbers of rows: id" in Path("mine/case.toml").read_text()
    read = measured(Path("my.csv"), "s").samples
    assert str(read.origin) == origin
    assert np.allclose(read.t, [0.0, 900.0, 1800.0])


@pytest.mark.parametrize(
    ("day", "hour", "form"),
    [
        ("2025-04-01", "12:00", ""),
        ("2025-04-01", "9:00", "%Y-%m-%d %H:%M"),
        ("01.04.2025", "12:00:00", "%d.%m.%Y %H:%M:%S"),
    ],
)
def test_dates_and_times_of_day_may_be_two_columns(here, day, hour, form):
    later = hour.replace(":00", ":10", 1)
    found = begun(f"date,hour,T_5cm,T_10cm\n{day},{hour},20,20\n{day},{later},21,20\n")
    assert found["data"]["time"] == ["date", "hour"]
    assert found["data"].get("time_format", "") == form
    stream = cases.load("mine/case.toml", settings=FILLED).prepare().stream
    assert np.allclose(stream.t, [0.0, 600.0])
    assert cases.load("mine/case.toml", settings={**FILLED, "data.follow": True}).spec.data.live
    with pytest.raises(
        lp.errors.CaseError, match="times in two columns are read from CSV files only"
    ):
        cases.load("mine/case.toml", settings=FILLED).prepare("rows.parquet")


def test_title_lines_before_the_header_are_skipped(here):
    title = "Logger 17, made by A\n\nbench 3;\n"
    table = "time_s;T_5cm;T_10cm\n0;20,5;20,5\n10;21,5;20,5\n"
    found = begun(title + table)
    assert found["data"] == {
        "file": "../my.csv",
        "skip": 3,
        "time": "time_s",
        "time_unit": "s",
        "separator": ";",
        "decimal": ",",
    }
    case = cases.load("mine/case.toml", settings=FILLED)
    assert len(case.prepare().stream) == 2
    Path("my.csv").write_text(title + table.replace("21,5", "ERR"))
    with pytest.raises(lp.errors.DataError, match="row 6, column 'T_5cm': got 'ERR'"):
        case.prepare()
    with pytest.raises(lp.errors.DataError, match="line 1 is a title, not a header: set skip = 3"):
        cases.load("mine/case.toml", settings={**FILLED, "data.skip": 0}).prepare()


def test_numbered_columns_are_one_line(here):
    names = [f"u_{k}" for k in range(12)]
    row = ",".join("1" for _ in names)
    found = begun(f"time_s,{','.join(names)}\n0,{row}\n1,{row}\n")
    assert found["channels"] == {
        "u": {"role": "sensor", "column": "u_{}", "each": ["? m", "? m", 12]}
    }


def test_numbered_columns_with_a_table_of_places(here):
    names = [f"T {k}" for k in range(1, 10)]
    row = ",".join("1" for _ in names)
    found = begun(f"time_s,{','.join(names)}\n0,{row}\n1,{row}\n")
    assert found["channels"] == {"T": {"role": "sensor", "positions": "places.csv"}}
    places = Path("mine/places.csv")
    assert places.read_text().splitlines()[:2] == ["name,x", "T 1,?"]
    with pytest.raises(lp.errors.CaseError, match=r"places\.csv, row 2: replace '\?'") as error:
        cases.load("mine/case.toml", settings=FILLED)
    assert len(str(error.value).splitlines()) == 9
    rows = [f"{name},{0.02 * k}" for k, name in enumerate(names)]
    places.write_text("\n".join(["name,x", *rows]) + "\n")
    assert len(cases.load("mine/case.toml", settings=FILLED).sensors) == 9


@pytest.mark.parametrize("name", ["dH", "dH_m", "dH [m]", "dH_cm"])
def test_a_column_named_like_an_input_is_that_input(here, name):
    found = begun(f"time_s,{name},T_5cm\n0,1,20\n1,1,20\n", equation="advection_diffusion")
    unit = {"unit": "cm"} if "cm" in name else {}
    assert found["channels"]["dH"] == {"role": "input", "column": name, **unit}
    assert set(found["unknowns"]) == {"kappa", "K"}
    assert found["options"] == {"L": "? m", "ratio": "?"}


def test_without_that_input_another_unknown_is_proposed(here):
    found = begun("time_s,T_5cm\n0,20\n1,20\n", equation="advection_diffusion")
    assert set(found["unknowns"]) == {"kappa", "v"}
    assert "transform" not in found["unknowns"]["v"]  # a flux may be negative
    assert found["options"] == {"ratio": "?"}
    assert set(found["channels"]) == {"T_5cm"}


def test_a_column_of_the_flow_needs_no_unknown_flux(here):
    found = begun("time_s,flow [mm/h],T_5cm\n0,1,20\n1,1,20\n", equation="advection_diffusion")
    assert set(found["unknowns"]) == {"kappa"}
    assert found["channels"]["flow"]["role"] == "input"


@pytest.mark.parametrize("name", ["borehole", "grouted_borehole", "pumping_test"])
def test_equations_that_need_it_get_a_graded_mesh(here, name):
    found = begun("time_s,a\n0,1\n1,1\n", equation=name)
    assert found["mesh"]["spacing"] == "geometric"
    assert found["initial"].startswith("?")  # a line between sensors is not the head around a well
    if name != "pumping_test":
        return
    filled = {"mesh.from": "0.1 m", "mesh.to": "900 m", "options.b": "10 m", "law.noise": "1 cm"}
    filled |= {f"unknowns.k.{key}": "1e-4 m/s" for key in ("prior", "std")}
    filled |= {f"unknowns.Ss.{key}": "1e-5 1/m" for key in ("prior", "std")}
    filled |= {"channels.a.at": "9 m", "inputs.Q": "36 m^3/h", "initial": 0}
    told = "where 'pumping_test' changes most. Set `mesh.spacing = 'geometric'`"
    for spacing, expected in (("geometric", False), ("uniform", True)):
        case = cases.load("mine/case.toml", settings={**filled, "mesh.spacing": spacing})
        assert any(told in note for note in case.notes) is expected


def test_similar_names_without_signs_and_units_stay_distinct(here):
    found = begun("time_s,T 1,T-1,T [K],T [degC],[K],state\n0,1,1,1,1,1,ok\n1,1,1,1,1,1,ok\n")
    assert set(found["channels"]) == {"T 1", "T-1", "T [K]", "T [degC]", "[K]"}


def test_numbers_in_names_are_not_always_positions(here):
    names = ["depth -0.5 m", "Q_5 m3/h", "flux_30_m2", "T 0.5 m"]
    found = begun(f"time_s,{','.join(names)}\n0,1,1,1,1\n1,1,1,1,1\n")["channels"]
    places = [item["at"] for item in found.values()]
    assert places == ["? m", "? m", "? m", "0.5 m"]


def test_a_case_behind_a_link_reads_its_table(here):
    (here / "far" / "away").mkdir(parents=True)
    (here / "link").symlink_to(here / "far" / "away")
    (here / "table.csv").write_text("time_s,T\n0,1\n1,1\n")
    write_template(Path("link/mine"), Path("table.csv"), EQUATIONS["heat"])
    document = tomllib.loads(Path("link/mine/case.toml").read_text())
    assert (here / "link" / "mine" / document["data"]["file"]).is_file()


def test_more_words_than_numbers_in_a_row(here):
    assert begun("time_s,T,a,b,c\n0,20,x,y,z\n1,20,x,y,z\n")["channels"].keys() == {"T"}


def test_inputs_and_units_of_another_equation(here):
    table = "time (min),Q [m3/h],near 8 m,far 25 m [ft],level [NN]\n0,43,0,0,1\n1,43,1,0,1\n"
    found = begun(table, equation="pumping_test")
    assert found["channels"] == {
        "Q": {"role": "input", "column": "Q [m3/h]", "unit": "m^3/h"},
        "near_8_m": {"role": "sensor", "column": "near 8 m", "at": "8 m"},
        "far_25_m": {"role": "sensor", "column": "far 25 m [ft]", "at": "25 m", "unit": "ft"},
        "level": {"role": "sensor", "column": "level [NN]", "at": "? m", "unit": "? NN"},
    }
    assert found["options"] == {"b": "? m"}
    assert found["unknowns"]["Ss"] == {"prior": "? 1/m", "std": "? 1/m", "transform": "log"}
    Path("mine/case.toml").unlink()
    found = begun("time (min),near 8 m\n0,0\n1,1\n", equation="pumping_test")
    assert found["inputs"] == {"Q": "? m^3/s"}
    assert "t0" not in found["data"]
    Path("mine/case.toml").unlink()
    # The process began before the first row, at an unknown time.
    found = begun("time (min),near 8 m\n2,0.1\n3,0.2\n", equation="pumping_test")
    assert found["data"]["t0"] == "? min"


@pytest.mark.parametrize("name", EQUATIONS)
def test_a_case_of_every_equation_has_what_it_needs(here, name):
    found, equation = begun("time,a\n0,1\n10,2\n20,2\n", equation=name), EQUATIONS[name]

    def needed(known):
        return {key for key, item in known.items() if not item.optional}

    chosen = {*list(equation.alternatives)[-1:]}
    assert found["equation"] == name
    assert set(found["unknowns"]) == needed(equation.unknowns) | chosen
    assert set(found["channels"]) == {"a"}
    assert set(found.get("inputs", ())) == needed(equation.inputs)
    assert set(found.get("options", ())) == {
        key
        for key, option in equation.options.items()
        if option.default is None or any(key in equation.alternatives[one] for one in chosen)
    }
    sides = ("mesh.x", "mesh.y") if equation.dimension > 1 else ("mesh.from", "mesh.to")
    with pytest.raises(lp.errors.CaseError) as error:
        cases.load("mine/case.toml")
    for side in sides:
        assert f"mine/case.toml: {side} = " in str(error.value)


def test_init_previews_the_table_it_read(here):
    Path("my.csv").write_text(
        "Logger 17\nid;when;T_5cm [degF];Q;note;T_b\n"
        "1;01.04.2025 12:00;68;1;a;20\n2;01.04.2025 12:10;;1;b;20\n3;01.04.2025 13:00;70;1;c;21\n"
    )
    done = CliRunner().invoke(app, ["init", "mine", "--data", "my.csv"])
    assert done.exit_code == 0
    shown = [" ".join(line.split()) for line in done.output.splitlines()]
    span = "3 rows from 2025-04-01 12:00:00 to 2025-04-01 13:00:00 UTC, 1800 s apart (median)"
    assert f"my.csv: {span}, 600 to 3000." in shown
    assert "Times in when" in shown
    assert "T_5cm [degF] sensor T_5cm degF 68 70 1" in shown
    assert "T_b sensor T_b degC 20 21 0" in shown
    assert "id row number" in shown
    assert "note text" in shown
    assert tomllib.loads(Path("mine/case.toml").read_text())["steps"] == {"dt_max": "1800 s"}


@pytest.mark.slow
def test_options_provide_what_the_table_does_not_contain(here):
    Path("my.csv").write_text("a;b\ntime;T\n03/02/2026 08:00;20\n03/02/2026 08:10;20\n")
    runner = CliRunner()
    begin = ["init", "mine", "--data", "my.csv"]
    error = runner.invoke(app, begin).exception
    assert "is ambiguous: set --time-format" in str(error)  # of the second title, or labels
    error = runner.invoke(app, [*begin, "--skip", "1"]).exception
    assert "is ambiguous: set --time-format, '%d/%m/%Y %H:%M' (2026-02-03" in str(error)
    begin += ["--skip", "1", "--time-format", "%m/%d/%Y %H:%M"]
    for key, told in {
        "law.nose": "there is no key 'law.nose'; did you mean 'noise'?",
        "channels.X.at": "the case has no 'channels.X'",
        "a b": "'a b' is not a key",
        "title.x": "title: got {'x': 1}; expected text in quotes",
    }.items():
        error = runner.invoke(app, [*begin, "--set", f"{key}=1"]).exception
        assert told in str(error)
    assert not Path("mine").exists()
    known = ["channels.T.at=left", "channels.T.role=boundary", "law.noise=0.1 K", "title=Two"]
    sets = [part for item in known for part in ("--set", item)]
    assert runner.invoke(app, [*begin[:1], "own", *begin[2:], *sets]).exit_code == 0
    text = Path("own/case.toml").read_text()
    found = tomllib.loads(text)
    assert found["data"]["time_format"] == "%m/%d/%Y %H:%M"
    assert found["data"]["skip"] == 1
    assert found["channels"]["T"] == {"role": "boundary", "column": "T", "at": "left"}
    assert (found["title"], found["law"]) == ("Two", {"noise": "0.1 K"})
    assert "# standard deviation of a single reading" in text
    for option in (["--skip", "0"], ["--time-format", "%d"], ["--set", "title=x"]):
        error = runner.invoke(app, ["init", "other", *option]).exception
        assert f"{option[0]} requires --data FILE" in str(error)


def test_each_place_that_is_left_open_is_named(here):
    """`init` names them, and `check` and `run` report each in one sentence."""
    names = [f"T {k}" for k in range(1, 10)]
    row = ",".join("20" for _ in names)
    Path("my.csv").write_text(f"time,Q [gpm],{','.join(names)}\n0,1,{row}\n9,1,{row}\n")
    begin = ["init", "mine", "--data", "my.csv", "--equation", "borehole"]
    runner = CliRunner()
    done = runner.invoke(app, begin, "0\n1\n")
    assert done.exit_code == 0, done.output
    case = Path("mine/case.toml")
    document = read_toml(case.read_text(), "mine/case.toml")
    blanks = blanks_in(document)
    assert "law.noise" in blanks
    assert "data.time_unit" in blanks
    for line in (f'{key} = "{value}"' for key, value in blanks.items()):
        assert f"  {line}\n" in done.output
    assert "  positions in mine/places.csv\n" in done.output
    for command in ("check", "run"):
        error = runner.invoke(app, [command, "mine/case.toml"]).exception
        assert str(error).splitlines() == [
            f"mine/case.toml: {key} = \"{value}\": replace '?' by a "
            f"{'unit' if key.endswith('unit') else 'value'}."
            for key, value in blanks.items()
        ]


def test_the_option_equation_requires_a_table(here):
    Path("my.csv").write_text("time_s,T\n0,20\n")
    runner = CliRunner()
    for arguments, told in (
        (["--equation", "heat"], "--equation requires --data"),
        (["--data", "my.csv", "--equation", "heet"], "no equation 'heet'; did you mean 'heat'?"),
        (["--data", "my.csv", "--equation", "own.py:rod"], "write 'own.py:rod' into the case."),
    ):
        error = runner.invoke(app, ["init", "mine", *arguments]).exception
        assert isinstance(error, lp.errors.ConfigurationError)
        assert told in str(error)
    assert not Path("mine").exists()


WALL = {
    "mesh.from": 0,
    "mesh.to": "20 mm",
    "options.C": "3.6e6 J/(m^3 K)",
    "unknowns.k.prior": "20 W/(m K)",
    "unknowns.k.std": "10 W/(m K)",
    "law.noise": "0.1 K",
}


@pytest.mark.parametrize(
    ("more", "driven"),
    [
        ({}, False),
        ({"channels.T_5mm.at": "left", "channels.T_5mm.role": "boundary"}, True),
        ({"boundary.left": "20 degC"}, True),
        ({"boundary.left": {"transfer": "5 W/(m^2 K)", "ambient": "20 degC"}}, True),
        ({"unknowns.source.std": "1 W/m^3"}, True),
        ({"mesh.cells": 400, "mesh.to": "20 m"}, False),
        ({"mesh.cells": 400, "mesh.to": "20 m", "unknowns.source.std": 1}, True),
    ],
)
def test_a_process_without_excitation_is_noted(here, more, driven):
    begun("time_s,T_5mm,T_10mm\n0,20,20\n10,21,21\n", equation="conduction")
    case = Path("mine/case.toml")
    if "unknowns.source.std" in more:
        case.write_text(case.read_text() + "[unknowns.source]\nprior = 0\nstd = 1\n")
    case = cases.load(case, settings={**WALL, **more})
    told = "source or input drives the process"
    assert any(told in note for note in case.notes) is not driven


@pytest.mark.long
def test_the_case_of_a_rod_is_fifteen_lines_and_runs(here):
    write_template(Path("rod"))
    runner = CliRunner()
    places = [f"channels.T_{k}.at={k} cm" for k in (10, 20, 30)]
    ends = [f"channels.T_{e}.{i}" for e in ("left", "right") for i in (f"at={e}", "role=boundary")]
    known = ["mesh.from=0", "mesh.to=40 cm", "law.noise=0.05 K", *places, *ends]
    known += ["unknowns.alpha.prior=5e-5 m^2/s", "unknowns.alpha.std=3e-5 m^2/s"]
    sets = [part for item in known for part in ("--set", item)]
    done = runner.invoke(app, ["init", "mine", "--data", "rod/rod.csv", *sets])
    assert "nothing is left open" in done.output
    lines = [line for line in Path("mine/case.toml").read_text().splitlines() if line]
    assert len([line for line in lines if not line.startswith("#")]) <= 15
    done = runner.invoke(app, ["run", "mine/case.toml", "--out", "out", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["measures"]["alpha"] == pytest.approx(9.7e-5, rel=0.02)


# --- several tables of one process ---------------------------------------------------------------

WARM = "time_s;T_5cm;T_15cm\n0;20,0;20,0\n60;21,0;20,5\n120;22,0;\n180;23,0;21,5\n240;24,0;22,0\n"
HEATER = "t [min],Q_kW,state\n-1,5,on\n1,7,on\n2.5,10,on\n4,10,off\n"
FILES = {"mesh.from": "3 cm", "mesh.to": "1 m", "law.noise": "0.1 K", "options.H": "1 m"}
FILES |= {"options.T0": "20 degC", "channels.T_15cm.role": "validation"}
FILES |= {"unknowns.k.prior": "2 W/(m K)", "unknowns.k.std": "1 W/(m K)"}
FILES |= {"unknowns.R_b.prior": "0.1 m K/W", "unknowns.R_b.std": "0.1 m K/W"}
FILES |= {"options.rho_c": "2e6 J/(m^3 K)", "initial": "20 degC"}


def two_tables() -> list[str]:
    Path("warm.csv").write_text(WARM)
    Path("heater.csv").write_text(HEATER)
    return ["--data", "warm.csv", "--data", "heater.csv", "--equation", "borehole"]


@pytest.mark.long
def test_two_tables_are_joined_by_their_times(here):
    begin = ["init", "mine", *two_tables()]
    sets = [part for key, value in FILES.items() for part in ("--set", f"{key}={value}")]
    done = CliRunner().invoke(app, [*begin, *sets])
    assert "for warm.csv and heater.csv: nothing is left open" in done.output, done.output
    found = tomllib.loads(Path("mine/case.toml").read_text())["data"]
    other = {"file": "../heater.csv", "time": "t [min]", "time_unit": "min"}
    other |= {"separator": ",", "decimal": "."}
    assert found == {
        "file": ["../warm.csv", other],
        "time": "time_s",
        "time_unit": "s",
        "separator": ";",
        "decimal": ",",
    }
    prepared = cases.load("mine/case.toml").prepare()
    raw = prepared.raw
    # The joined table begins when both tables have begun, and has the rows of both.
    np.testing.assert_allclose(raw.t, [0, 60, 120, 150, 180, 240])
    at = {name: raw.values[:, k] for k, name in enumerate(raw.names)}
    np.testing.assert_allclose(at["T_5cm"], [20, 21, 22, np.nan, 23, 24])
    np.testing.assert_allclose(at["T_15cm"], [20, 20.5, np.nan, np.nan, 21.5, 22])
    np.testing.assert_allclose(at["Q"], [6e3, 7e3, np.nan, 1e4, np.nan, 1e4])
    filled = prepared.stream
    assert np.isfinite(filled.values[:, filled.names.index("Q")]).all()
    done = CliRunner().invoke(app, ["run", "mine/case.toml", "--out", "out", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["status"] == "finished"


def test_tables_with_dates_are_joined(here):
    Path("a.csv").write_text("time,T_1cm\n2026-03-02 08:00,20\n2026-03-02 08:10,21\n")
    Path("b.csv").write_text("time,T_2cm\n2026-03-02 08:05,19\n2026-03-02 08:10,20\n")
    Path("case.toml").write_text("""
equation = "heat"
initial = 20
mesh = { from = 0, to = "10 cm", cells = 10 }
data = { file = ["a.csv", "b.csv"], time = "time" }
unknowns.alpha = { prior = 1e-5, std = 1e-5 }
law = { noise = 0.1 }
boundary.left = 20
[channels]
T_1 = { role = "sensor", column = "T_1cm", at = "1 cm" }
T_2 = { role = "sensor", column = "T_2cm", at = "2 cm" }
""")
    prepared = cases.load("case.toml").prepare()
    assert prepared.origin is not None
    assert f"{prepared.origin}" == "2026-03-02 08:00:00"
    np.testing.assert_allclose(prepared.raw.t, [0, 300, 600])
    np.testing.assert_allclose(prepared.raw.values, [[20, np.nan], [np.nan, 19], [21, 20]])
    skipped = cases.load("case.toml", settings={"channels.T_1.missing": "skip"}).prepare()
    np.testing.assert_allclose(skipped.raw.values, [[20, np.nan], [21, 20]])
    assert skipped.raw.remarks["skipped", "T_1"] == 1


def test_a_late_sensor_does_not_start_a_run_before_its_initial_state(here):
    Path("a.csv").write_text("t,T_1cm,T_2cm\n0,20,20\n10,21,20\n20,22,21\n30,23,22\n")
    Path("case.toml").write_text("""
equation = "heat"
initial = 20
mesh = { from = 0, to = "10 cm", cells = 10 }
data = { file = "a.csv", time = "t", time_unit = "s" }
unknowns.alpha = { prior = 1e-5, std = 1e-5 }
law = { noise = 0.1 }
boundary.left = 20
[channels]
T_1 = { role = "sensor", column = "T_1cm", at = "1 cm" }
T_2 = { role = "sensor", column = "T_2cm", at = "2 cm", late = "10 s" }
""")
    raw = cases.load("case.toml").prepare().raw
    np.testing.assert_allclose(raw.t, [0, 10, 20, 30])
    np.testing.assert_allclose(raw.values, [[20, 20], [21, 21], [22, 22], [23, np.nan]])
    assert raw.remarks["early", "T_2"] == 1


@pytest.mark.parametrize(
    ("files", "channel", "told"),
    [
        (
            ("t,a\n0,1\n1,1\n", "t,a\n0,1\n"),
            "a",
            "a.csv and b.csv have a column 'a' each; rename one",
        ),
        (("t,a\n0,1\n1,1\n", "t,b\n0,1\n"), "a", "no channel has a column of .*b.csv; leave it"),
        (("t,a\n0,1\n1,1\n", "t,b\n0,1\n"), "c", "channels.s: no file has the column 'c'"),
        (("t,a\n0,1\n1,1\n", "t,b\n5,1\n6,1\n"), "", "the files have no time in common"),
        (("t,a\n0,1\n", "t,b\n2026-03-02,1\n"), "", "of one file are dates and of another numbers"),
        (("t,a\n0,\n1,\n", "t,b\n0,\n1,\n"), "", "no sensor has a value where all files have one"),
    ],
)
def test_tables_that_cannot_be_joined_are_refused(here, files, channel, told):
    for name, text in zip(("a.csv", "b.csv"), files, strict=True):
        Path(name).write_text(text)
    both = {"s": channel} if channel else {"s": "a", "r": "b"}
    lines = [f'{k} = {{ role = "sensor", column = "{c}", at = 0.5 }}' for k, c in both.items()]
    case = Path("case.toml")
    case.write_text(
        'equation = "heat"\ninitial = 20\nmesh = { from = 0, to = 1, cells = 10 }\n'
        'data = { file = ["a.csv", "b.csv"], time = "t" }\nlaw = { noise = 0.1 }\n'
        "unknowns.alpha = { prior = 1e-5, std = 1e-5 }\n[channels]\n" + "\n".join(lines)
    )
    with pytest.raises(lp.LivepdeError, match=told):
        cases.load(case).prepare()


def test_several_tables_are_not_followed(here):
    CliRunner().invoke(app, ["init", "mine", *two_tables()])
    with pytest.raises(lp.errors.CaseError, match="follow requires a single file that grows"):
        cases.load("mine/case.toml", settings={**FILES, "data.follow": True})
    case = cases.load("mine/case.toml", settings=FILES)
    with pytest.raises(lp.errors.CaseError, match="a process is followed in one: name it"):
        source_of(case, None, "")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("time_s,T_5cm\n0,20\n", "the column 'T_5cm' is in another table, too: rename one"),
        ("time,Q\n2026-03-02 08:00,5\n", "has dates as times, the other has numbers"),
    ],
)
def test_init_refuses_unsuitable_tables(here, text, told):
    arguments = two_tables()
    Path("heater.csv").write_text(text)
    error = CliRunner().invoke(app, ["init", "mine", *arguments]).exception
    assert isinstance(error, lp.errors.DataError)
    assert told in str(error)


def test_a_column_with_a_unit_fits_a_model_without_one(tmp_path):
    """`unit = "? mg/L"` could not be filled in, because the model's concentration has no unit."""
    (tmp_path / "t.csv").write_text("t (h),c_in (mg/L),c_10cm (mg/L)\n0,50,0\n1,50,9\n2,50,20\n")
    found = channels_in(measured(tmp_path / "t.csv", "h"), EQUATIONS["advection_dispersion"])
    assert ["unit" in one.given for one in found] == [False, False]
    assert convert("1.44", "", "options.ratio") == 1.44  # if `"?"` is filled in
    with pytest.raises(CaseError, match="'mg/L' cannot be converted to '1'; expected no unit"):
        conversion("mg/L", "", "channels.c.unit")


def test_a_comment_with_as_many_cells_as_a_row_is_not_a_header(here):
    Path("t.csv").write_text("# chain; mooring Z3; local time\ntime;a;b\n0;1,5;2,5\n1;2,5;3,5\n")
    assert measured(Path("t.csv"), "s").samples.names == ("a", "b")
    Path("t.csv").write_text("# time;a;b\n0;1,5;2,5\n1;2,5;3,5\n")
    assert measured(Path("t.csv"), "s").samples.names == ("a", "b")


def test_a_moisture_in_percent_is_the_state_of_a_case(here):
    """Moisture was once refused because diffusion equations expected a temperature."""
    rows = "".join(f"{h},{20 - h},{20 - h / 2}\n" for h in range(30))
    Path("t.csv").write_text(f"time_s,u_1cm (%),u_3cm (%)\n{rows}")
    settings = ["mesh.from=0", "mesh.to=5 cm", "law.noise=0.2 %", "unknowns.alpha.prior=1e-6 m^2/s"]
    settings = [f"--set={one}" for one in (*settings, "unknowns.alpha.std=1e-6 m^2/s")]
    written = CliRunner().invoke(app, ["init", "mine", "--data", "t.csv", *settings])
    assert written.exit_code == 0, written.output
    added = {"boundary.left.flux": "1e-3 % m/s", "unknowns.source": {"prior": 0, "std": "1e-3 %/s"}}
    case = cases.load("mine/case.toml", settings=added)
    assert case.unit("u_1cm") == case.model.state.unit == "%"
    assert EQUATIONS["heat"].in_unit("mg/l").fluxes.flux == "(mg/l) m/s"
    with pytest.raises(CaseError, match=r"expected .* degF. If the state .* `options.unit`"):
        cases.load("mine/case.toml", settings={"options.unit": "degC"}).prepare()


def test_a_power_is_not_read_as_power_per_volume(here):
    """A column `P(W)` was once used as a source in W/m^3 without a warning."""
    rows = "".join(f"{s},20,{20 + s},5\n" for s in range(30))
    Path("t.csv").write_text(f"time_s,T_room (C),T_1cm,P(W)\n{rows}")
    case = Path("case.toml")
    case.write_text(
        'equation = "conduction"\noptions.C = 2e6\nmesh = { from = 0, to = 0.02, cells = 10 }\n'
        'data = { file = "t.csv", time = "time_s" }\nlaw.noise = 0.1\nsources.heat.value = "P"\n'
        "initial = 20\nunknowns.k = { prior = 1, std = 1 }\n"
        'boundary.left = { transfer = 5, ambient = "T_room" }\n'
        '[channels]\nT_room = { role = "input", column = "T_room (C)" }\n'
        'P = { role = "input", column = "P(W)" }\n'
        'T = { role = "sensor", column = "T_1cm", at = "1 cm" }\n'
    )
    with pytest.raises(CaseError, match=r"channels.P: .* 'W', and the model is in W/m.3: set fact"):
        cases.load(case).prepare()
    assert cases.load(case, settings={"channels.P.factor": 2e3}).prepare()
    Path("t.csv").write_text(f"time_s,T_room (in),T_1cm,P\n{rows}")  # an inlet, no inches
    case.write_text(case.read_text().replace("(C)", "(in)").replace("P(W)", "P"))
    assert cases.load(case).prepare()


UNDER = """\
# Survey of a wall; plates by A, B
timestamp,T_in,q,P / kW,10cm
,degC,W/m2,,[degF]
2024-01-10 00:00,18.1,24.5,1,68
2024-01-10 00:10,18.2,24.4,2,69
"""


def test_a_line_of_units_under_the_header_states_units(here):
    found = begun(UNDER, equation="conduction")
    assert found["data"]["skip"] == 1
    channels = found["channels"]
    assert "unit" not in channels["T_in"]  # that of the model
    assert channels["q"]["quantity"] == "flux"
    assert "unit" not in channels["q"]
    assert channels["P_kW"]["unit"] == "? kW"
    assert channels["10cm"]["unit"] == "degF"


def test_a_unit_of_times_under_the_header(here):
    text = "Elapsed,W1,OW (30 m)\nmin,m3/h,depth to water m\n0.5,45,4.2\n2,45,4.4\n"
    found = begun(f"Test W1\nOperator: B, C.\n{text}", equation="pumping_test")
    assert (found["data"]["skip"], found["data"]["time_unit"]) == (2, "min")
    assert found["channels"]["Q"]["unit"] == "m^3/h"


def test_a_case_for_a_parquet_file(here):
    times = pd.date_range("2024-01-10", periods=4, freq="10min")
    table = {"time": times, "T_5cm": [20.0, 20.1, np.nan, 20.3], "note": ["", "", "x", ""]}
    pd.DataFrame(table).to_parquet("my.parquet")
    made = CliRunner().invoke(app, ["init", "mine", "--data", "my.parquet"])
    assert made.exit_code == 0, made.output
    found = tomllib.loads(Path("mine/case.toml").read_text())
    assert found["data"] == {"file": "../my.parquet", "time": "time"}
    assert found["channels"]["T_5cm"]["at"] == "5 cm"
