"""Common mistakes of new users give one sentence each, and no files are written."""

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from livepde import cli
from livepde.cases.new_case import write_template
from livepde.runs import RunWriter

PAGE = Path(__file__).parents[1] / "docs" / "mistakes.md"
CASE, DATA = Path("mine/case.toml"), Path("mine/rod.csv")


def case(old: str, new: str) -> Callable[[], None]:
    """Return what changes the case."""

    def change() -> None:
        text = CASE.read_text()
        assert text.count(old) == 1
        CASE.write_text(text.replace(old, new))

    return change


def data(old: str, new: str, encoding: str = "utf-8") -> Callable[[], None]:
    """Return what changes the data."""

    def change() -> None:
        text = DATA.read_text()
        assert old in text
        DATA.write_bytes(text.replace(old, new).encode(encoding))

    return change


def excel() -> None:
    DATA.write_text(DATA.read_text().replace(",", ";").replace(".", ","))


def commas() -> None:
    excel()
    case('time_unit = "s"', 'time_unit = "s"\nseparator = ";"')()


def minutes() -> None:
    data("time_s", "time_min")()
    case('time = "time_s"                # the', 'time = "time_min" # the')()
    case('time_unit = "s"', "")()


def fahrenheit() -> None:
    data("T_10", "T_10 degF")()
    case('column = "T_10"', 'column = "T_10 degF"')()


def nothing() -> None:
    """All is as `livepde init mine` wrote it."""


RUN = ("run", "mine/case.toml")
MISTAKES = {
    "a column": (case('column = "T_10"', 'column = "T10"'), RUN),
    "a key": (case("prior =", "priro ="), RUN),
    "a unit": (case('"5e-5 m^2/s"', '"5e-5 sqm/s"'), RUN),
    "a unit in a name": (minutes, RUN),
    "a unit in the name of a channel": (fahrenheit, RUN),
    "another kind of unit": (case('time_unit = "s"', 'time_unit = "m"'), RUN),
    "no unit": (case('"5e-5 m^2/s"', '"5e-5"'), RUN),
    "a decimal comma in the case": (case('at = "10 cm"', 'at = "10,5 cm"'), RUN),
    "no quotes": (case('time = "time_s"', "time = time_s"), RUN),
    "left open": (case('prior = "5e-5 m^2/s"', 'prior = "? m^2/s"'), RUN),
    "the prior": (case('prior = "5e-5 m^2/s"', 'prior = "50 m^2/s"'), RUN),
    "a place": (case('at = "10 cm"', "at = 10"), RUN),
    "no noise": (case('at = "10 cm", noise = "0.05 K"', 'at = "10 cm"'), RUN),
    "semicolons": (excel, RUN),
    "decimal commas": (commas, RUN),
    "dates": (data("\n20,", "\n01.04.2025 12:00,"), RUN),
    "an encoding": (data("T_20", "Fühler", "cp1252"), RUN),
    "a workbook": (lambda: DATA.write_bytes(b"PK\x03\x04\x14"), RUN),
    "a word": (data("\n40,", "\nlater,"), RUN),
    "text in a cell": (data("\n20,21.623,19.991", "\n20,21.623,OVER"), RUN),
    "a repeated row": (data("\n40,", "\n20,"), RUN),
    "rows out of order": (data("\n40,", "\n10,"), RUN),
    "no rows": (lambda: DATA.write_text(DATA.read_text().partition("\n")[0]), RUN),
    "a data file": (case('"rod.csv"', '"rood.csv"'), RUN),
    "other data": (nothing, (*RUN, "--data", "rod.csv")),
    "another folder": (nothing, ("run", "case.toml")),
    "a folder": (nothing, ("run", "mine")),
    "data as a case": (nothing, ("run", "mine/rod.csv")),
    "a run again": (lambda: taken("old"), (*RUN, "--out", "old")),
    "a run elsewhere": (lambda: taken("runs/mine"), ("report", "mine")),
    "a case as a run": (lambda: taken("runs/mine"), ("report", "mine/case.toml")),
    "a page for a file": (nothing, (*RUN, "--watch", "8050")),
    "code": (case('equation = "heat"', 'equation = "own.py:model"'), RUN),
}


def taken(folder: str) -> None:
    Path(folder).mkdir(parents=True)
    (Path(folder) / "run.json").write_text("{}")


def messages() -> dict[str, str]:
    """Return mistake -> message, as the page has them in the first two columns of its tables.

    A message with names in backticks has two of them, and a space, at each end.
    """
    row = r"^\| ([^|]+?) \| (?:`` ([^|]+?) ``|`([^|`]+)`) \|"
    rows = re.findall(row, PAGE.read_text(), flags=re.MULTILINE)
    return {mistake: named or plain for mistake, named, plain in rows}


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_template(Path("mine"))
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def livepde(command: Sequence[str], monkeypatch, capsys) -> tuple[int, str, str]:
    """Return exit code, standard output and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["livepde", *command])
    try:
        code = cli.main()
    except SystemExit as end:  # so typer ends what went well
        code = end.code
    return code, *capsys.readouterr()


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_with_its_remedy(mistake, home, monkeypatch, capsys):
    prepare, command = MISTAKES[mistake]
    prepare()
    before = contents(home)
    expected = (2, "", f"Error: {messages()[mistake]}\n")
    assert livepde(command, monkeypatch, capsys) == expected
    assert contents(home) == before


@pytest.mark.slow
def test_data_in_any_encoding_are_no_case(home, monkeypatch, capsys):
    data("T_20", "Fühler", "cp1252")()
    expected = (2, "", f"Error: {messages()['data as a case']}\n")
    assert livepde(("check", str(DATA)), monkeypatch, capsys) == expected


@pytest.mark.slow
def test_a_file_of_a_run_leads_to_the_run(home, monkeypatch, capsys):
    taken("runs/mine")
    code, _, told = livepde(("report", "runs/mine/run.json"), monkeypatch, capsys)
    assert code == 2
    assert told.endswith("run.json contains no run (it is a file); did you mean 'runs/mine'?\n")


@pytest.mark.parametrize("command", [("watch", "old"), (*RUN, "--realtime", "--watch", "8050")])
def test_a_missing_package_is_said_before_a_run_begins(command, home, monkeypatch, capsys):
    RunWriter.create(Path("old"), version="", command=[], title="")
    before = contents(home)
    monkeypatch.setitem(sys.modules, "dash", None)  # as if it were not there
    code, out, err = livepde(command, monkeypatch, capsys)
    assert (code, out, err.splitlines()[-1]) == (2, "", f"Error: {messages()['no Dash']}")
    assert contents(home) == before


def rest() -> None:
    header = DATA.read_text().partition("\n")[0]
    rows = [f"{20 * k},20,20,20,20,20" for k in range(30)]
    DATA.write_text("\n".join([header, *rows]))


NOTED = {
    "nothing to learn": rest,
    "the law": case('kind = "sensitivity"', 'kind = "gradient"'),
    "a coarse mesh": case("cells = 40  ", "cells = 1  "),
}


@pytest.mark.long
@pytest.mark.parametrize(("mistake", "prepare"), NOTED.items())
def test_what_is_no_mistake_gets_a_note(mistake, prepare, home, monkeypatch, capsys):
    prepare()
    code, out, _ = livepde(RUN, monkeypatch, capsys)
    assert code == 0
    assert f"Note: {messages()[mistake]}\n" in out


@pytest.mark.slow
def test_check_tells_of_data_that_tell_nothing(home, monkeypatch, capsys):
    rest()
    _, out, _ = livepde(("check", "mine/case.toml"), monkeypatch, capsys)
    assert "Note: `alpha` is not identifiable from these data. Use longer data" in out


def test_the_page_has_these_mistakes_and_no_others():
    assert set(messages()) == {*MISTAKES, *NOTED, "no Dash"}
