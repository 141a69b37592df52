"""From a broker to a browser: measured soil temperatures pass through the whole program."""

import json
import queue
import re
import subprocess
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from browser import chromium, count, text, wait
from commands import start, stopped, until
from patience import PATIENCE

from livepde import cases, runs
from livepde.runs import drive

pytestmark = [pytest.mark.broker, pytest.mark.browser]

CASE = Path(__file__).parents[1] / "cases" / "soil_uniform.toml"
SAMPLES = 240  # ten days


def address(process: subprocess.Popen[str]) -> str:
    """Return where the page of a run is, as soon as it is told."""
    told: queue.Queue[str] = queue.Queue()

    def read() -> None:
        line = next(line for line in process.stderr if "Open" in line)
        told.put(line.split()[1])

    threading.Thread(target=read, daemon=True).start()
    return told.get(timeout=PATIENCE)


def publish(port: int, rows: list[dict[str, object]]) -> None:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2)
    client.connect("127.0.0.1", port)
    client.loop_start()
    for row in rows:
        client.publish("soil/rows", json.dumps(row), qos=1).wait_for_publish(PATIENCE)
    client.disconnect()
    client.loop_stop()


def test_soil_from_a_broker_to_a_browser(tmp_path, monkeypatch, data_dir, server):
    monkeypatch.chdir(tmp_path)
    file = data_dir / "soil_temperature" / "soil_2025_mar_jun.csv"
    table = pd.read_csv(file, dtype=str, keep_default_na=False)
    begin = int(np.flatnonzero(table["DATETIME_END"] >= "2025-04-01")[0])
    rows = table.iloc[begin : begin + SAMPLES].to_dict("records")
    text_of = CASE.read_text()
    own = f'mqtt = {{ port = {server.port}, rows = ["soil/rows"] }}'
    Path("soil.toml").write_text(re.sub(r"file = .*", own, text_of, count=1))
    process = start("soil.toml", "--out", "run", "--watch", "0")
    until(lambda: Path("run/run.json").exists(), process)
    with chromium() as page:
        publish(server.port, rows[: SAMPLES // 2])
        page.get(address(process))
        wait(page, lambda page: count(page) == SAMPLES // 2)
        assert text(page, "#title") == "Soil, April 2025: uniform diffusivity"
        wait(page, lambda page: "alpha" in text(page, "#cards"))
        before = text(page, "#cards")
        publish(server.port, rows[SAMPLES // 2 :])
        wait(page, lambda page: count(page) == SAMPLES)
        wait(page, lambda page: text(page, "#cards") != before)  # cards come on their own
        assert "alpha" in text(page, "#cards")
    stopped(process)

    pd.DataFrame(rows).to_csv("april.csv", index=False)
    prepared = replace(cases.load(CASE).prepare("april.csv"), live=True)  # with refits apart
    expected = drive(prepared.identifier, prepared.stream).result.to_xarray()
    found = runs.open("run").dataset
    # The fit at the end of a run changes its last estimate; a stopped run may leave this fit out.
    assert np.array_equal(found["alpha"][:-1], expected["alpha"][:-1])
    assert np.array_equal(found["innovation"], expected["innovation"], equal_nan=True)
