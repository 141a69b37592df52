"""The deployment examples call existing commands, which work as expected."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE
from typer.testing import CliRunner

from livepde.cli import app
from livepde.runs.monitor import Metrics, Monitor
from livepde.runs.web import Address

DEPLOY = Path(__file__).parents[1] / "deploy"
UNIT = DEPLOY / "livepde@.service"
ANALYZE = shutil.which("systemd-analyze")


def commands() -> list[list[str]]:
    """Return what the unit, the image and the compose file tell livepde to do."""
    (unit,) = re.findall("^ExecStart=(.*)$", UNIT.read_text(), re.MULTILINE)
    (image,) = re.findall("^CMD (.*)$", (DEPLOY / "Containerfile").read_text(), re.MULTILINE)
    (page,) = re.findall(r"^ +command: \[(.*)\]$", (DEPLOY / "compose.yaml").read_text(), re.M)
    words = [word.strip().strip('"') for word in page.split(",")]
    return [shlex.split(unit)[1:], json.loads(image), words]


@pytest.mark.parametrize("command", commands(), ids=["unit", "image", "page"])
def test_options_exist(command):
    name, *words = command
    told = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "200"}).output
    options = [word for word in words if word.startswith("--")]
    assert options
    for option in options:
        assert option in told


@pytest.mark.process
@pytest.mark.skipif(ANALYZE is None, reason="needs systemd-analyze")
def test_the_unit_is_one(tmp_path):
    program = tmp_path / "livepde"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / "livepde@rod.service"
    unit.write_text(UNIT.read_text().replace("/opt/livepde/bin/livepde", str(program)))
    command = [str(ANALYZE), "verify", "--man=no", "--recursive-errors=no", str(unit)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (found.returncode, found.stderr) == (0, "")
    unit.write_text(unit.read_text().replace("ProtectClock=yes", "ProtectClock=maybe"))
    found = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert "Failed to parse boolean value, ignoring: maybe" in found.stderr


@pytest.mark.process
def test_the_health_check_asks_the_run():
    health = {"ok": True}
    monitor = Monitor(Address(token="a-token-of-the-example"), lambda: health, Metrics([]))
    (call,) = re.findall(r"^    CMD (\[.*\])$", (DEPLOY / "Containerfile").read_text(), re.M)
    _, script, url = json.loads(call)
    assert Path(script).name == "health.py"
    url = url.replace("9100", str(monitor.port))

    def ask(token: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(DEPLOY / "health.py"), url]
        return subprocess.run(
            command,
            env={**os.environ, "LIVEPDE_TOKEN": token},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )

    well = ask("a-token-of-the-example")
    assert (well.returncode, well.stdout.strip()) == (0, "ok")
    assert "403" in ask("another").stderr
    # A process without data is not to be restarted; who asks for more is told.
    health["ok"] = False
    assert ask("a-token-of-the-example").returncode == 0
    url = url.replace("livez", "health")
    ill = ask("a-token-of-the-example")
    assert ill.returncode == 1
    assert "503" in ill.stderr
    monitor.close()
    assert ask("a-token-of-the-example").returncode == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grafana.json", "alerts.yml"])
def test_the_dashboard_and_the_alerts_use_metrics_that_are_served(name):
    metrics = Metrics(["T_1"])
    health = {"ok": True, "silent": False, "waiting": 0, "seconds": 1.0, "counts": ()}
    health |= {"verdict": "caution"}
    monitor = Monitor(Address(), lambda: health, metrics)
    try:
        served = {sample.name for family in metrics.registry.collect() for sample in family.samples}
        served |= {family.name for family in metrics.registry.collect()}
    finally:
        monitor.close()
    served |= {f"{name}_total" for name in served}
    text = (DEPLOY / name).read_text(encoding="utf-8")
    drawn = set(re.findall(r"\blivepde_\w+", text))
    assert drawn
    assert drawn <= served
    if name == "grafana.json":
        panels = json.loads(text)["panels"]
        assert len({panel["id"] for panel in panels}) == len(panels)


def test_names_of_metrics_keep_the_conventions_of_prometheus():
    """Units of time are seconds, counters end in _total, and labels are bounded."""
    metrics = Metrics(["T_1"], second=2.0)
    health = {"ok": False, "why": "a sentence with 12 s in it", "ailment": "silent", "seconds": 1.0}
    monitor = Monitor(Address(), lambda: health, metrics)
    try:
        found = list(metrics.registry.collect())
    finally:
        monitor.close()
    for family in found:
        assert re.fullmatch("livepde(_[a-z]+)+", family.name)
        assert not family.name.endswith(("_time", "_ms", "_minutes"))
        samples = [sample for sample in family.samples if not sample.name.endswith("_created")]
        if family.type == "counter":
            assert all(sample.name.endswith("_total") for sample in samples)
        assert all(" " not in text for one in samples for text in one.labels.values())
    (unwell,) = [sample for family in found for sample in family.samples if "unwell" in sample.name]
    assert unwell.labels == {"why": "silent"}
