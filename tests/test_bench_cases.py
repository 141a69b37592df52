"""The benchmark of the cases: means over seeds, checks, failures as rows, the page."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import cases as bench
from benchmarks.__main__ import app
from livepde.cases.new_case import write_template

pytestmark = pytest.mark.study

VARIANTS = """
[reference]
alpha = "9.7e-5 m^2/s"
source = "made up"

[[variants]]
name = "thin"
set = { data.every = 3 }
expect = { alpha.error = "<= 0.05" }

[[variants]]
name = "five seeds"
set = { data.reader = "own.py:read", data.options.noise = 0.1 }
seeds = 2
reference = { alpha = "1e-4 m^2/s" }
expect = { alpha.error = "<= 1e-9" }
"""
READER = """
import numpy as np
import pandas as pd

def read(folder, noise=0.0, seed=0):
    frame = pd.read_csv(FOLDER + "/rod.csv")
    rng = np.random.default_rng(seed)
    columns = {key: frame[key] + noise * rng.standard_normal(len(frame)) for key in frame}
    return frame["time_s"], columns
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project whose one case has variants."""
    case, _ = write_template(tmp_path / "cases")
    case = case.rename(case.with_name("rod.toml"))
    text = case.read_text().replace('file = "rod.csv"', 'reader = "own.py:read"')
    case.write_text(text + VARIANTS.replace('data.reader = "own.py:read", ', ""))
    body = READER.replace("FOLDER", repr(str(case.parent)))
    (case.parent / "own.py").write_text(body)
    monkeypatch.chdir(tmp_path)
    return case


def call(*arguments):
    result = CliRunner().invoke(app, ["cases", *arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def test_a_case_with_variants_and_one_that_fails(project, tmp_path):
    broken = project.with_name("broken.toml")
    broken.write_text(project.read_text().replace("own.py:read", "own.py:raed"))
    code, output = call("--json", "--gallery", str(tmp_path / "page"))
    assert code == 1
    found = json.loads(output)
    checks = {item["name"]: item for item in found["checks"]}
    assert not checks["broken: runs that failed"]["ok"]
    assert checks["rod: alpha"]["ok"]
    assert checks["rod: thin: alpha.error"]["ok"]
    assert not checks["rod: five seeds: alpha.error"]["ok"]
    rows: dict[str, dict[str, object]] = {}
    for table in found["tables"]:
        for row in table["rows"]:
            rows.setdefault(row[0], {}).update(zip(table["columns"], row, strict=True))
    assert set(rows) == {"broken", "rod", "rod: thin", "rod: five seeds"}
    assert rows["broken"]["failed steps"] == "failed"
    assert rows["rod"]["samples"] == 181
    assert rows["rod: thin"]["samples"] == 61
    assert rows["rod: five seeds"]["reference"] == "0.0001"
    assert float(rows["rod"]["time"]) > 0
    assert float(rows["rod"]["prior"]) > float(rows["rod"]["RMSE"])
    assert "has no function 'raed'" in found["notes"][0]
    page = (tmp_path / "page" / "gallery.md").read_text()
    assert "![rod](rod.png)" in page
    assert re.search(r"^Recorded at commit [0-9a-f]{8}\.$", page, re.MULTILINE)
    assert (tmp_path / "page" / "rod.png").exists()


def test_seeds_are_averaged(project):
    jobs = bench.jobs_of(project)
    assert [job.label for job in jobs] == ["rod", "rod: thin", *["rod: five seeds"] * 2]
    runs = [bench.run_job(job) for job in jobs[2:]]
    mean = bench._mean(runs)
    values = [run.numbers["alpha"] for run in runs]
    assert values[0] != values[1]
    assert mean.numbers["alpha"] == pytest.approx(np.mean(values))
    assert bench._mean([runs[0], bench.Run(error="bad")]).error == "bad"


def test_frozen_at_the_prior(project):
    """With the prior at the truth nothing is to be learnt."""
    settings = {"unknowns.alpha.prior": "9.7e-5 m^2/s"}
    run = bench.run_job(bench.Job(project, settings=settings))
    assert run.prior <= run.numbers["rmse"] * 1.05
    assert run.numbers["alpha.error"] < 0.03
