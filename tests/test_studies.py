"""Studies as commands: `python -m experiments NAME`, with --quick, --json and --out."""

import json

import pytest
from commands import call
from typer.main import get_command

from experiments import degenerate
from experiments.__main__ import app
from livepde.errors import ConfigurationError
from livepde.runs import Check, Outcome


def study(*arguments: str) -> tuple[int, str]:
    return call(*arguments, program=app)


def test_every_study_has_a_quick_run_and_can_be_kept():
    commands = get_command(app).commands
    assert commands.keys() == {
        "degenerate",
        "dimensions",
        "exact",
        "relatives",
        "seed-excited-noise",
    }
    for name, command in commands.items():
        flags = {flag for option in command.params for flag in option.opts}
        assert {"--quick", "--json", "--out"} <= flags, name


def test_what_is_not_known_is_said():
    with pytest.raises(ConfigurationError, match="did you mean 'analytic'"):
        study("dimensions", "--truth", "analytc")
    assert study("degenerated")[0] == 2


@pytest.mark.parametrize(("value", "code"), [(0.5, 0), (2.0, 1)])
def test_a_check_that_fails_is_the_exit_code(value, code, monkeypatch, tmp_path):
    taken = []

    def fake(*, quick: bool, progress: bool) -> Outcome:
        taken.append((quick, progress))
        return Outcome(checks=[Check("number", value, 1.0, "<=")])

    monkeypatch.setattr(degenerate, "degenerate", fake)
    assert study("degenerate")[0] == 0  # without --json it is told, not refused
    ended, output = study("degenerate", "--quick", "--json", "--out", str(tmp_path / "kept"))
    assert ended == code
    content = json.loads(output)
    assert content["command"] == "python -m experiments degenerate --quick"
    assert [check["ok"] for check in content["checks"]] == [code == 0]
    assert taken == [(False, True), (True, False)]
    report = (tmp_path / "kept" / "report.md").read_text()
    assert report.startswith("# Run the paper's equation with D that varies, vanishes")


@pytest.mark.study
@pytest.mark.parametrize("name", get_command(app).commands)
def test_a_quick_run_keeps_its_bounds(name):
    code, output = study(name, "--quick", "--json")
    assert code == 0, output
    assert json.loads(output)["checks"]
