"""A new user's first session: install, init, edit three lines, check, run, watch, report."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE

import livepde as lp
from livepde.models import heat
from livepde.stepping import Advance, Alexander2, simulate

pytestmark = pytest.mark.process

PROJECT = Path(__file__).resolve().parents[1]
DIFFUSIVITY = 6.4e-5  # of the user's rod, m^2/s
NOISE = 0.05  # K
EDITS = {  # line of the template -> line for data of his own: dates, another column in Fahrenheit
    'time = "time_s"': 'time = "when"',
    'column = "T_10"': 'T_10 = { role = "sensor", column = "probe near furnace", at = "10 cm", '
    f'noise = "{NOISE} K", unit = "degF" }}',
    "alpha = [9e-5": "alpha = [5e-5, 8e-5]",
}


OPEN = {  # what his table does not tell: the ends, the places, a unit, the prior, the noise
    'from = "?': 'mesh = { from = 0, to = "40 cm", cells = 40 }',
    'prior = "?': "unknowns.alpha = "
    '{ prior = "5e-5 m^2/s", std = "3e-5 m^2/s", transform = "log" }',
    'column = "T_left"': 'left = { role = "boundary", column = "T_left", at = "left" }',
    'column = "probe': 'probe = { role = "sensor", column = "probe near furnace", at = "10 cm", '
    'unit = "degF" }',
    'column = "T_20"': 'T_20 = { role = "validation", column = "T_20", at = "20 cm" }',
    'column = "T_30"': 'T_30 = { role = "sensor", column = "T_30", at = "30 cm" }',
    'column = "T_right"': 'right = { role = "boundary", column = "T_right", at = "right" }',
    'noise = "?': f'law = {{ noise = "{NOISE} K" }}',
}


class Shell:
    """A shell in which the new environment is active."""

    def __init__(self, environment: Path, folder: Path) -> None:
        own = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COVERAGE"))}
        self.folder = folder
        self._path = environment / "bin"
        self._how = {"cwd": folder, "env": {**own, "COLUMNS": "120"}, "text": True}

    def __call__(self, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [str(self._path / program), *arguments]
        return subprocess.run(command, capture_output=True, timeout=PATIENCE, **self._how)

    def ok(self, program: str, *arguments: str) -> str:
        """Return what a command prints that has to succeed."""
        done = self(program, *arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def start(self, program: str, *arguments: str) -> subprocess.Popen[str]:
        command = [str(self._path / program), *arguments]
        return subprocess.Popen(command, stdout=subprocess.PIPE, **self._how)


@pytest.fixture(scope="module")
def shell(tmp_path_factory) -> Shell:
    """A fresh virtual environment with the wheel of this checkout and what the live page needs."""
    folder = tmp_path_factory.mktemp("new")
    environment = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True, timeout=PATIENCE)
    shell = Shell(environment, folder)
    if shell("pip", "download", "-q", "--no-deps", "-d", "index", "hatchling").returncode:
        pytest.skip("pip reaches no package index: a new user could not install anything")
    shell.ok("pip", "wheel", "-q", "--no-deps", "-w", "dist", str(PROJECT))
    (wheel,) = (folder / "dist").glob("livepde-*.whl")
    uv = Path(sys.executable).with_name("uv")
    if uv.exists():  # as pip, in a few seconds
        command = [uv, "pip", "install", "-q", "--python", environment, f"{wheel}[dashboard]"]
        subprocess.run(command, check=True, timeout=PATIENCE)
    else:
        shell.ok("pip", "install", "-q", "--no-compile", f"{wheel}[dashboard]")
    return shell


def measured(path: Path) -> None:
    """Write what the user's logger has: a rod of another metal, dates, Celsius and Fahrenheit."""
    seconds = np.arange(0.0, 3601.0, 30.0)

    def ends(t: float) -> dict[str, float]:
        return {"left": 22.0 + 18.0 * np.sin(2 * np.pi * t / 1500.0), "right": 22.0}

    values = {name: lp.Channel(name) for name in ("left", "right")}
    model = heat(lp.interval(0.0, 0.4, 80), lp.Normal(DIFFUSIVITY), values)
    q, block = model.initial_parameter({"alpha": DIFFUSIVITY}), model.state_block
    rng = np.random.default_rng(7)
    rows = ["when,T_left,probe near furnace,T_20,T_30,T_right"]
    for t, u in simulate(model, q, 22.0, seconds.tolist(), Advance(Alexander2(), 5.0), ends):
        near, middle, far = (block.at_vertices @ u)[[20, 40, 60]] + NOISE * rng.standard_normal(3)
        date = np.datetime64("2026-03-02T08:00:00") + np.timedelta64(int(t), "s")
        fahrenheit = "" if t == 900.0 else f"{1.8 * near + 32.0:.2f}"
        left, right = ends(t).values()
        rows.append(f"{date}+01:00,{left:.2f},{fahrenheit},{middle:.2f},{far:.2f},{right:.2f}")
    path.write_bytes("\r\n".join(rows).encode("utf-8-sig"))


def edit(case: Path, edits: Mapping[str, str]) -> None:
    """Replace exactly those lines of a case that hold a text."""
    lines = case.read_text().splitlines()
    for text, line in edits.items():
        (k,) = (k for k, old in enumerate(lines) if text in old)
        lines[k] = line
    case.write_text("\n".join(lines) + "\n")


@pytest.mark.long
def test_from_nothing_to_a_result_of_ones_own(shell, ctrl_c):
    home = shell.folder

    # He looks around, and lets a case be written.
    assert "livepde init mycase" in shell.ok("livepde", "--help")
    assert "livepde check mine/case.toml" in shell.ok("livepde", "init", "mine")
    case = home / "mine" / "case.toml"

    # His own data do not fit the case: he is told what to mend.
    measured(home / "mine" / "rod.csv")
    refused = shell("livepde", "check", "mine/case.toml")
    assert refused.returncode == 2
    columns = "when, T_left, probe near furnace, T_20, T_30, T_right"
    assert f"mine/rod.csv: there is no column 'time_s'; there are {columns}." in refused.stderr

    # Three lines later the check is happy.
    before = case.read_text().splitlines()
    edit(case, EDITS)
    after = case.read_text().splitlines()
    assert sum(old != new for old, new in zip(before, after, strict=True)) == len(EDITS) == 3
    told = shell.ok("livepde", "check", "mine/case.toml")
    assert "Data: 121 samples from 2026-03-02 07:00:00" in told
    assert "not identifiable" not in told
    assert "ok  livepde run mine/case.toml" in told

    # The run finds his rod, and says where its results are and how to look at them.
    told = shell.ok("livepde", "run", "mine/case.toml")
    assert re.search(r"alpha +6\.\d+e-05", told)
    assert "Note:" not in told
    assert "failed" not in told
    assert "To view it: livepde watch runs/mine" in told
    assert (home / "runs" / "mine" / "run.json").is_file()

    # The page shows it in the browser, until Ctrl-C.
    page = shell.start("livepde", "watch", "runs/mine", "--address", "127.0.0.1:0")
    try:
        (address,) = re.findall(r"http://127\.0\.0\.1:\d+/", page.stdout.readline())
        with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
            assert "A metal rod, heated and cooled at its left end" in answer.read().decode()
    finally:
        page.send_signal(signal.SIGINT)
        page.communicate(timeout=PATIENCE)
    assert page.returncode == 0

    # The report has the numbers again, for people and for programs.
    assert "T_20" in shell.ok("livepde", "report", "runs/mine")
    found = json.loads(shell.ok("livepde", "report", "runs/mine", "--json"))
    assert [check["name"] for check in found["checks"]] == ["alpha", "rmse"]
    assert all(check["ok"] for check in found["checks"])
    estimate, std = found["measures"]["alpha"], found["measures"]["alpha.std"]
    assert abs(estimate - DIFFUSIVITY) < 0.02 * DIFFUSIVITY
    assert abs(estimate - DIFFUSIVITY) < 4.0 * std
    assert found["measures"]["rmse.validation"] < 2.0 * NOISE

    # A second run goes beside the first; into the same directory it is refused.
    assert "runs/mine-2" in shell.ok("livepde", "run", "mine/case.toml")
    refused = shell("livepde", "run", "mine/case.toml", "--out", "runs/mine")
    assert refused.returncode == 2
    assert "runs/mine already contains a run" in refused.stderr

    # For the same table he might have begun with a case of its own, and found the same.
    assert "replace each '?'" in shell.ok("livepde", "init", "own", "--data", "mine/rod.csv")
    refused = shell("livepde", "check", "own/case.toml")
    assert refused.returncode == 2
    assert "own/case.toml: mesh.to = \"? m\": replace '?' by a value." in refused.stderr
    edit(home / "own" / "case.toml", OPEN)
    shell.ok("livepde", "run", "own/case.toml")
    again = json.loads(shell.ok("livepde", "report", "runs/own", "--json"))["measures"]
    assert abs(again["alpha"] - estimate) < std
