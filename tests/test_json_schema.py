"""The JSON schema accepts the case files that the program accepts, and documents their keys."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from factories import short_rod
from typer.testing import CliRunner

from livepde.cases.new_case import MEANINGS, SCHEMA_FILE, case_schema, write_template
from livepde.cli import app
from livepde.models import EQUATIONS

jsonschema = pytest.importorskip("jsonschema")
CASES = sorted((Path(__file__).resolve().parents[1] / "cases").glob("*.toml"))


def as_json(value: Any) -> Any:
    """Return a TOML document as an editor sees it: dates are text."""
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [as_json(item) for item in value]
    return value.isoformat() if hasattr(value, "isoformat") else value


def problems(document: dict[str, Any]) -> list[str]:
    """Return what the schema has against a case."""
    validator = jsonschema.Draft202012Validator(case_schema())
    return [error.message for error in validator.iter_errors(as_json(document))]


@pytest.mark.slow
def test_the_schema_is_one():
    jsonschema.Draft202012Validator.check_schema(case_schema())


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_the_cases_of_the_project_are_accepted(path):
    assert problems(tomllib.loads(path.read_text(encoding="utf-8"))) == []


def test_all_cases_are_looked_at():
    assert len(CASES) > 15


@pytest.mark.parametrize(
    "more",
    [
        "initial = { from = 20, std = '1 K' }",
        "[law]\nmodes = 5\njumps = ['alpha']",
        "[law]\nkind = 'gradient'\ngain = 'auto'",
        "[law]\nrefit = { start = 100 }\nshadows = false",
        "[boundary]\nleft = { transfer = 3, ambient = 20 }\nright = '20 degC'",
        "[data]\nfile = ['a.csv', { file = 'b.csv', separator = ';' }]\ntime = ['day', 'hour']",
        "[data]\nfile = 'a.csv'\ntime = 't'\nstart = 2025-03-01\nstop = 2025-03-01T12:00:00",
        "[expect]\nalpha.error = '<= 0.1'\nrmse = [0, 1]",
        "[unknowns.beta]\nprior = 1\nstd = 1\nregions = { a = [0, '1 m'], b = { over = 'core' } }",
    ],
)
def test_short_forms_are_accepted(more, tmp_path):
    document = tomllib.loads(short_rod(tmp_path).read_text())
    assert problems(document | tomllib.loads(more)) == []


@pytest.mark.parametrize(
    "wrong",
    [
        "titel = 'a rod'",
        "[mesh]\nfrom = 0\nto = 1\ncells = 'many'",
        "[law]\nkind = 'kalman'",
        "[expect]\nrmse = '< 3'",
        "[steps]\nscheme = 'rk4'",
        "[channels]\nT = { role = 'thermometer', column = 'T' }",
    ],
)
def test_mistakes_are_found(wrong, tmp_path):
    document = tomllib.loads(short_rod(tmp_path).read_text())
    assert problems(document) == []
    assert problems(document | tomllib.loads(wrong)) != []


def test_every_key_has_a_meaning_and_a_default_or_is_required():
    schema = case_schema()
    tables = {"CaseSpec": schema, **schema["$defs"]}
    for name, table in tables.items():
        for key, value in table["properties"].items():
            assert value.get("description", "").strip(), f"{name}.{key}"
            assert ("default" in value) or key in table.get("required", []) or _is_table(value), (
                f"{name}.{key}"
            )
    every = {key for table in tables.values() for key in table["properties"]}
    for name, meanings in MEANINGS.items():  # of base classes, too
        assert set(meanings) <= set(tables[name]["properties"] if name in tables else every), name


def _is_table(value: dict[str, Any]) -> bool:
    """Return whether the value of a key is a table, which is empty by default."""
    return "$ref" in value or value.get("type") == "object"


def test_the_command_prints_it():
    done = CliRunner().invoke(app, ["schema"])
    assert json.loads(done.stdout) == json.loads(json.dumps(case_schema()))


def test_a_new_case_names_its_schema(here):
    case, _ = write_template(Path("mine"))
    Path("own.csv").write_text("time_s,T_5cm\n0,20\n1,20\n")
    other, _ = write_template(Path("own"), Path("own.csv"), EQUATIONS["heat"])
    for path in (case, other):
        first = path.read_text().splitlines()[0]
        assert first == f"#:schema ./{SCHEMA_FILE}"
        assert json.loads((path.parent / SCHEMA_FILE).read_text())["properties"]["mesh"]
    assert problems(tomllib.loads(case.read_text())) == []
