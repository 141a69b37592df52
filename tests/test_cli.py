"""The command line: output, files and exit codes."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr
from commands import bad, bench, call, cut, estimates, shell, until
from factories import short_rod
from patience import PATIENCE

import livepde
from livepde import cli, runs
from livepde.runs import Check, Outcome, Table

COMMANDS = (
    "demo",
    "reproduce",
    "init",
    "equations",
    "check",
    "run",
    "fleet",
    "report",
    "compare",
    "watch",
    "export",
    "citation",
)


@pytest.fixture
def rod(here):
    """The case of `livepde init`, short."""
    short_rod(here / "rod")
    return "rod/case.toml"


# --- help and errors -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches(command):
    code, output = call(command, "--help")
    assert code == 0
    assert "Example:" in output or "Live:" in output


def test_version():
    assert call("--version") == (0, f"livepde {livepde.__version__}\n")


@pytest.mark.process
def test_bad_input_is_one_sentence_and_exit_code_2(here):
    result = shell("run", "none.toml")
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.startswith("Error: none.toml: there is no such case file")
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr
    assert list(here.iterdir()) == []


def test_main_returns_codes(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["livepde", "report", "nowhere"])
    assert cli.main() == 2
    assert "[" not in capsys.readouterr().out

    def broken(**_):
        raise BrokenPipeError

    class Stream:
        def close(self):
            self.closed = True

    monkeypatch.setattr("livepde.cli.app", broken)
    monkeypatch.setattr(sys, "stderr", Stream())
    assert cli.main() == 0


# --- cases -----------------------------------------------------------------------------------


def test_equations(here):
    assert "thermal response test" in call("equations")[1]
    output = call("equations", "borehole")[1]
    for word in ("R_b", "rho_c", "needed", "fluid", "[options]", "Length in m, time in s"):
        assert word in output
    assert "did you mean 'heat'" in bad("equations", "haet")


@pytest.mark.long
def test_values_set_from_outside(rod, here, monkeypatch):
    setting = ("--set", "data.every=3", "--set", "title=Thin")
    assert call("check", rod, *setting)[1].startswith("Thin")
    monkeypatch.setattr(sys, "argv", ["livepde", "run", rod, *setting])
    code, output = call("run", rod, *setting)
    assert code == 0
    assert "21 samples" in output
    folder = here / "runs" / "rod"
    assert "every = 3" in (folder / "case.toml").read_text()
    assert json.loads((folder / "run.json").read_text())["settings"] == [
        "data.every=3",
        "title=Thin",
    ]
    code, output = call("report", "runs/rod", "--theory", "--json")
    assert code == 0


@pytest.mark.slow
def test_run_as_json_with_checks(rod):
    code, output = call("run", rod, "--json", "--out", "out")
    assert code == 0
    content = json.loads(output)
    assert [check["name"] for check in content["checks"]] == ["alpha", "rmse"]
    assert all(check["ok"] for check in content["checks"])
    assert content["run"] == "out"
    assert content["status"] == "finished"
    assert content["measures"]["failed_steps"] == 0
    code, again = call("report", "out", "--json")
    assert code == 0
    assert json.loads(again)["checks"] == content["checks"]
    before = {p: p.stat().st_mtime_ns for p in Path("out").iterdir()}
    assert "already contains a run" in bad("run", rod, "--out", "out")
    assert {p: p.stat().st_mtime_ns for p in Path("out").iterdir()} == before


@pytest.mark.long
def test_a_failed_check_is_exit_code_1_with_json(rod):
    path = Path(rod)
    path.write_text(
        path.read_text().replace('rmse = "<= 0.15"', 'rmse = "<= 0.001"\nbeta = [0, 1]')
    )
    code, output = call("run", rod, "--json", "--out", "out")
    assert code == 1
    checks = {check["name"]: check for check in json.loads(output)["checks"]}
    assert not checks["rmse"]["ok"]
    assert checks["beta"] == {
        "name": "beta", "value": None, "bound": [0, 1], "sense": "in", "ok": False,
    }  # fmt: skip
    assert call("report", "out", "--json")[0] == 1
    code, output = call("run", rod, "--out", "other")
    assert code == 0
    assert "failed" in output


@pytest.mark.slow
def test_check_shows_notes_and_failures(rod, monkeypatch):
    path = Path(rod)
    path.write_text(path.read_text().replace('kind = "sensitivity"', 'kind = "gradient"'))
    code, output = call("check", rod)
    assert code == 0
    assert "Note: The gradient law" in output

    from livepde import diagnostics

    report = diagnostics.CheckReport(
        "model", (diagnostics.Check.at_most("transpose", 1.0, 1e-12, "mend it"),)
    )
    monkeypatch.setattr(diagnostics, "check_model", lambda *_, **__: report)
    code, output = call("check", rod)
    assert code == 1
    assert "transpose" in output


def lines(count: int) -> str:
    row = '{{"time_s": {t}, "T_left": {v}, "T_10": 20, "T_20": 20, "T_30": 20, "T_right": 20}}\n'
    return "".join(row.format(t=20 * k, v=20 + k % 7) for k in range(count))


@pytest.mark.slow
def test_standard_input(rod):
    code, output = call("run", rod, "--data", "-", "--json", "--out", "out", stdin=lines(12))
    assert code in (0, 1)
    assert json.loads(output)["tables"][2]["rows"][0][5] == 12


@pytest.mark.slow
def test_a_bad_line_ends_a_run_that_is_kept(rod, here):
    stdin = lines(5) + '{"time_s": 100, "T_left": "warm"}\n'
    with pytest.raises(livepde.errors.SampleError, match="line 6, 'T_left': got 'warm'"):
        call("run", rod, "--data", "-", "--out", "out", stdin=stdin)
    record = json.loads((here / "out" / "run.json").read_text())
    assert record["status"] == "failed"
    assert record["samples"] == 5
    code, output = call("report", "out")
    assert code == 0
    assert "Stopped after 5 samples" in output


@pytest.mark.long
def test_json_lines_file_can_be_checked(rod, here):
    (here / "data.jsonl").write_text(lines(30))
    for arguments in (("--data", "data.jsonl"), ("--set", f"data.file={here}/data.jsonl")):
        code, output = call("check", rod, *arguments, "--advise")
        assert code == 0
        assert "that 30 samples allow" in output
        assert "One more sensor helps most at" in output


@pytest.mark.process
def test_ctrl_c_keeps_what_there_is(rod, here):
    code = "import sys; from livepde.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "run", rod, "--data", "-", "--out", "out"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    process.stdin.write(lines(8))
    process.stdin.flush()
    record = here / "out" / "run.json"
    until(lambda: estimates(here / "out") == 8, process)  # now it waits for more
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert json.loads(record.read_text())["status"] == "interrupted"
    assert json.loads(record.read_text())["samples"] == 8


@pytest.mark.long
def test_resume_goes_on_where_a_run_was_killed(rod, here):
    assert call("run", rod, "--out", "whole")[0] == 0
    whole = runs.open("whole").dataset
    cut("whole", "cut", 20)
    assert call("run", rod, "--out", "cut", "--resume")[0] == 0
    xr.testing.assert_identical(runs.open("cut").dataset, whole)
    assert len(runs.open("cut").record["resumed"]) == 1
    assert "--resume requires --out" in bad("run", rod, "--resume")
    assert "another case or other settings" in bad(
        "run", rod, "--out", "cut", "--resume", "--set", "law.noise=1 K"
    )
    assert call("run", rod, "--out", "begun", "--resume")[0] == 0  # there is none: it begins
    xr.testing.assert_identical(runs.open("begun").dataset, whole)


@pytest.mark.long
def test_a_full_disk_is_one_sentence_where_a_run_goes_on_or_is_shown(rod, here, monkeypatch):
    assert call("run", rod, "--out", "full")[0] == 0

    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        assert "No space left" in bad("run", rod, "--out", "full", "--resume")
        assert "No space left" in bad("report", "full")
    assert call("run", rod, "--out", "full", "--resume")[0] == 0


@pytest.mark.slow
def test_no_figures_without_matplotlib(rod, here, monkeypatch):
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *a: None if name == "matplotlib" else found(name, *a),
    )
    code, output = call("run", rod, "--out", "out")
    assert code == 0
    assert "pip install 'livepde[plots]'" in output
    assert not list((here / "out").glob("*.png"))


@pytest.mark.process
def test_silence_in_a_pipe(rod):
    result = shell("run", rod, "--json", "--out", "out", env={**os.environ, "TERM": "dumb"})
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    json.loads(result.stdout)


# --- experiments -----------------------------------------------------------------------------


def outcome(value: float) -> Outcome:
    def draw():
        from livepde import plots

        return plots.figure()[0]

    return Outcome(
        [Table("errors", ("gain", "error"), [("1", value)])],
        [Check("error of q", value, 0.05, "<=")],
        ["a note"],
        figures={"parameter": draw},
    )


class Fake:
    name = "seed"
    summary = "the first experiment"

    def __init__(self, value: float) -> None:
        self.value = value
        self.asked: list[tuple[str | None, bool]] = []

    def run(self, truth=None, progress=False):
        self.asked.append((truth, progress))
        return outcome(self.value)


@pytest.fixture
def fake(monkeypatch):
    from benchmarks import rods, step, usual_step
    from livepde import reproduce

    def install(value: float) -> Fake:
        one = Fake(value)
        monkeypatch.setattr(reproduce, "EXPERIMENTS", {"seed": one})
        monkeypatch.setattr(step, "step", lambda sizes, modes: outcome(value))
        monkeypatch.setattr(rods, "RODS", ())
        monkeypatch.setattr(usual_step, "usual_step", lambda *_, **__: Outcome())
        return one

    return install


@pytest.mark.slow
def test_demo(fake, here):
    fake(0.04)
    code, output = call("demo")
    assert code == 0
    assert "errors" in output
    assert (here / "runs" / "demo" / "parameter.png").is_file()
    assert output.rstrip().endswith("runs/demo")
    assert call("demo")[1].rstrip().endswith("runs/demo-2")


@pytest.mark.parametrize(("value", "expected"), [(0.04, 0), (0.06, 1)])
def test_reproduce_and_bench_as_json(fake, value, expected):
    one = fake(value)
    code, output = call("reproduce", "seed", "--truth", "analytic", "--json")
    assert code == expected
    assert json.loads(output)["checks"] == [
        {"name": "error of q", "value": value, "bound": 0.05, "sense": "<=", "ok": value < 0.05}
    ]
    assert one.asked == [("analytic", False)]
    code, output = bench("step", "--json")
    assert code == expected
    assert json.loads(output)["notes"] == ["a note"]


@pytest.mark.slow
def test_reproduce_and_bench_for_people(fake, here):
    fake(0.06)
    code, output = call("reproduce", "seed", "--out", "kept")
    assert code == 0
    assert "failed" in output
    assert (here / "kept" / "parameter.png").is_file()
    assert bench("step")[0] == 0
    assert "the first experiment" in call("reproduce", "list")[1]
    assert "coverage" in bench("--help")[1]
    assert "did you mean 'seed'?" in bad("reproduce", "sed")
    code, output = bench("xyz")
    assert code == 2
    assert "No such command 'xyz'" in output
