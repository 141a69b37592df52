"""`livepde fleet`: a run directory for each row of a table."""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from commands import call, estimates, until
from patience import PATIENCE
from threadpoolctl import threadpool_limits

from livepde import Fleet, cases, runs
from livepde.cases import member_blocks
from livepde.cases.new_case import write_template
from livepde.cli.printing import INTERRUPTED
from livepde.errors import ConfigurationError, DataError, RunError
from livepde.runs import JOURNAL, Journal
from livepde.runs.journal import Event

pytestmark = pytest.mark.slow

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
    rows = Path("rod/rod.csv").read_text().splitlines()[:40]
    Path("rod/rod.csv").write_text("\n".join(rows) + "\n")
    Path("rod/warm.csv").write_text("\n".join(rows[:30]) + "\n")
    Path("rods.csv").write_text(TABLE)
    return tmp_path


@pytest.fixture
def processes():
    """Processes of joblib stay, in the folder where they began: each test has its own."""
    loky = pytest.importorskip("joblib.externals.loky", reason="'fleet' is not installed")
    yield
    loky.get_reusable_executor().shutdown(wait=True)


def alone(out: str, *options: str) -> pd.Series:
    """Return the estimates of `livepde run`."""
    call("run", "rod/case.toml", "--out", out, "--json", *options)
    return runs.open(Path(out)).dataset["alpha"].to_series()


@pytest.mark.long
def test_each_row_is_a_separate_run(here):
    code, output = call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods")
    assert code == 1  # two of them cannot run
    assert "wrong:" in output
    table = pd.read_csv("rods/fleet.csv").set_index("name")
    assert table["status"].tolist() == ["finished", "finished", "failed", "failed"]
    assert table["samples"].tolist() == [39, 29, 0, 0]
    plain = Path("rods/plain")
    assert table.loc["plain", "verdict"] == runs.verdict(runs.open(plain).dataset).level
    assert table["verdict"].isna().tolist() == [False, False, True, True]
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


@pytest.mark.long
def test_the_summary_has_the_intervals_with_model_errors(here):
    Path("rods.csv").write_text("name,data,channels.T_10.at\nplain,,\nwrong,,11 cm\n")
    call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods", "--separately")
    table = pd.read_csv("rods/fleet.csv").set_index("name")
    for name, row in table.iterrows():
        last = runs.open(Path("rods") / str(name)).dataset
        errors = runs.verdict(last).errors["alpha"]
        assert (row["alpha_low"], row["alpha_high"]) == (errors.low, errors.high)
    assert table.loc["wrong", "alpha_high"] > float(last["alpha_high"][-1])


@pytest.mark.long
def test_failed_steps_are_reported(here):
    """Failed steps are also reported for members that step together."""
    table = pd.read_csv("rod/rod.csv")
    table.loc[20:, "T_left"] = 1e300
    table.to_csv("rod/hot.csv", index=False)
    Path("rods.csv").write_text("name,data\nplain,\nhot,rod/hot.csv\n")
    code, output = call(
        "fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods", "--json"
    )
    assert code == 1
    notes = json.loads(output)["notes"]
    assert "Of 2 members, 2 were stepped together." in notes
    assert "hot: 19 of 39 steps failed: not_finite" in notes
    assert not any("plain: " in note and "steps failed" in note for note in notes)


def test_a_fleet_resumes_from_existing_runs(here):
    Path("rods.csv").write_text("name,data\nplain,\n")
    arguments = ["fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods", "--json"]
    _, first = call(*arguments)
    with pytest.raises(RunError, match="already contains a run"):
        call(*arguments)
    Path("rods.csv").write_text("name,data\nplain,\nwarm,rod/warm.csv\n")
    _, second = call(*arguments, "--resume")
    rows = [json.loads(text)["tables"][0]["rows"] for text in (first, second)]
    assert rows[0][0] == rows[1][0]
    assert [row[0] for row in rows[1]] == ["plain", "warm"]


@pytest.mark.process
@pytest.mark.usefixtures("processes")
def test_a_fleet_in_several_processes_gives_equal_runs(here):
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
        ("name,data\na,rod/warm.csv,\n", "more cells than its header"),
        ("name\na\na\n", "'a' is taken"),
        ("name\n../a\n", "is not valid as a folder name"),
        ("name,data\n,rod.csv\n", "is not valid as a folder name"),
        ("", "Cannot read the members"),
    ],
)
def test_invalid_member_tables_are_refused(here, table, match):
    Path("rods.csv").write_text(table)
    with pytest.raises(DataError, match=match):
        call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods")
    assert not Path("rods").exists()


def test_invalid_options_are_refused(here):
    arguments = ["fleet", "rod/case.toml", "--members", "rods.csv"]
    with pytest.raises(ConfigurationError, match="--resume requires --out"):
        call(*arguments, "--resume")
    with pytest.raises(ConfigurationError, match="--jobs 0"):
        call(*arguments, "--jobs", "0")


def test_an_interruption_ends_all_members(here, monkeypatch):
    """Members after the interrupted one do not begin."""
    begun = []

    def alone(self, member, prepared):
        begun.append(member.name)
        return module.MemberOutcome(begun[-1], "interrupted" if len(begun) == 2 else "finished")

    module = sys.modules["livepde.cli.fleet_command"]
    monkeypatch.setattr(module.FleetRunner, "_alone", alone)
    Path("rods.csv").write_text("name,data\nplain,\nwarm,rod/warm.csv\nlast,\n")
    code, _ = call(
        "fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods", "--separately"
    )
    assert (code, begun) == (INTERRUPTED, ["plain", "warm"])


# --- stepped together ----------------------------------------------------------------------------

ALIKE = """name,data,initial
a,,
b,rod/other.csv,
c,rod/third.csv,21 degC
"""
FIRST = ["fleet", "rod/case.toml", "--members", "rods.csv", "--out"]


@pytest.fixture
def alike(here):
    """Provide three members with different data and initial values, and with missing values."""
    head, *rows = Path("rod/rod.csv").read_text().splitlines()
    for name, shift in {"other": 0.1, "third": -0.2}.items():
        changed = [head]
        for k, row in enumerate(rows):
            t, left, *inner, right = row.split(",")
            inner = [f"{float(x) + shift * np.sin(k):.3f}" if x else "" for x in inner]
            inner[k % 3] = "" if k % 5 == 3 else inner[k % 3]
            changed.append(",".join([t, "" if k == 7 else left, *inner, right]))
        Path(f"rod/{name}.csv").write_text("\n".join(changed) + "\n")
    Path("rods.csv").write_text(ALIKE)
    case = Path("rod/case.toml")
    unjudged = case.read_text().replace("[law]\n", "[law]\nverdict = false\n")  # as in a fleet
    case.write_text(unjudged)
    return here


def equal(one: Path, other: Path) -> None:
    """Assert that two run directories are equal."""
    mine, wanted = runs.open(one), runs.open(other)
    assert {file.name for file in one.iterdir()} == {file.name for file in other.iterdir()}
    assert mine.record.keys() == wanted.record.keys()
    assert (mine.status, mine.notes, mine.settings) == (
        wanted.status,
        wanted.notes,
        wanted.settings,
    )
    assert [check.name for check in mine.checks] == [check.name for check in wanted.checks]
    same(mine.dataset, wanted.dataset)
    with Journal.open(one / JOURNAL) as left, Journal.open(other / JOURNAL) as right:
        rest, judged = left.dataset(), right.dataset()
        judged.attrs.pop("verdict", None)  # only separate runs have a verdict
        rest.attrs.pop("verdict", None)
        same(rest, judged)
        assert (left.counts, told(left)) == (right.counts, told(right))
        assert (left.first.values, left.accepted) == (right.first.values, right.accepted)


def told(journal: Journal) -> list[Event]:
    """Return events of samples, without the health events that only separate runs have."""
    return [event for event in journal.events if event.kind not in ("unwell", "well")]


def same(one: xr.Dataset, other: xr.Dataset) -> None:
    """Assert that two datasets are equal, with numbers equal to rounding."""
    xr.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)
    for name in other.variables:
        assert str(one[name].attrs) == str(other[name].attrs)
    assert _attrs(one) == _attrs(other)


def _attrs(data: xr.Dataset) -> dict:
    """Return the attributes of a dataset, with kinds and subjects of its verdict's findings."""
    found = dict(data.attrs)
    if "log_evidence" in found:  # also a number, compared to rounding
        found["log_evidence"] = round(float(found["log_evidence"]), 6)
    if "verdict" in found:
        findings = json.loads(found["verdict"])["findings"]
        found["verdict"] = [(f["what"], f["subject"], f["severity"]) for f in findings]
    return found


@pytest.mark.long
def test_similar_members_step_together(alike):
    """The results of each member equal those of a separate run."""
    code, output = call(*FIRST, "rods", "--json")
    assert code == 1  # too few samples for the expectations of the case
    assert json.loads(output)["notes"][0] == "Of 3 members, 3 were stepped together."
    _, output = call(*FIRST, "apart", "--separately", "--json")
    assert "3 were stepped separately: --separately (3)" in json.loads(output)["notes"][0]
    for name in "abc":
        equal(Path("rods") / name, Path("apart") / name)
    left, right = (pd.read_csv(f"{folder}/fleet.csv") for folder in ("rods", "apart"))
    pd.testing.assert_frame_equal(left, right, rtol=1e-7)


@pytest.mark.process
@pytest.mark.usefixtures("processes")
def test_each_process_steps_its_part_together(alike):
    Path("rods.csv").write_text(ALIKE + "d,rod/third.csv,\n")
    call(*FIRST, "one")
    _, output = call(*FIRST, "two", "--jobs", "2", "--json")
    assert json.loads(output)["notes"][0] == "Of 4 members, 4 were stepped together."
    for name in "abcd":
        equal(Path("two") / name, Path("one") / name)


def workers(parent: int) -> list[int]:
    """Return the worker processes that loky has started."""
    text = Path(f"/proc/{parent}/task/{parent}/children").read_text()
    found = []
    for child in map(int, text.split()):
        with suppress(OSError):
            if "LokyProcess" in Path(f"/proc/{child}/cmdline").read_text():
                found.append(child)
    return found


@pytest.fixture
def longer(alike):
    """Provide longer data, with eight times as many samples."""
    case = Path("rod/case.toml")
    case.write_text(case.read_text().replace("[law]\n", "[law]\nshadows = false\n"))
    for path in (Path("rod/rod.csv"), Path("rod/other.csv"), Path("rod/third.csv")):
        table = pd.read_csv(path)
        table = pd.concat([table] * 8, ignore_index=True)
        table[table.columns[0]] = 20.0 * np.arange(len(table))
        table.to_csv(path, index=False)
    Path("rods.csv").write_text(ALIKE + "d,rod/third.csv,\n")
    return alike


@pytest.mark.process
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="workers are found in /proc")
@pytest.mark.usefixtures("longer")
def test_a_killed_worker_is_replaced_and_reported():
    """All members finish with the numbers of undisturbed runs."""
    pytest.importorskip("joblib", reason="'fleet' is not installed")
    with threadpool_limits(1):  # as in the program, because last digits depend on BLAS threads
        call(*FIRST, "one", "--separately")
    command = [sys.executable, "-m", "livepde", *FIRST, "two", "--separately", "--jobs", "2"]
    pipe = subprocess.PIPE
    process = subprocess.Popen([*command, "--json"], stdout=pipe, stderr=pipe, text=True)
    until(lambda: any(estimates(f"two/{name}") > 50 for name in "abcd"), process)
    os.kill(workers(process.pid)[0], signal.SIGKILL)
    output, errors = process.communicate(timeout=PATIENCE)
    assert "Traceback" not in errors
    (told,) = (note for note in json.loads(output)["notes"] if "worker process died" in note)
    assert told.endswith("members unfinished. They were resumed from their run directories.")
    assert pd.read_csv("two/fleet.csv")["status"].tolist() == ["finished"] * 4
    for name in "abcd":
        mine, wanted = (runs.open(Path(folder) / name) for folder in ("two", "one"))
        assert mine.status == "finished"
        xr.testing.assert_identical(*(run.dataset.drop_attrs() for run in (mine, wanted)))


@pytest.mark.process
@pytest.mark.usefixtures("processes")
def test_workers_that_crash_repeatedly_end_the_command(here, monkeypatch):
    """It reports each member and a summary, and no run appears to continue."""
    Path("rods.csv").write_text("name,data\nplain,\nwarm,rod/warm.csv\n")
    call("fleet", "rod/case.toml", "--members", "rods.csv", "--out", "rods")
    opened = runs.open(Path("rods/plain"))
    runs.RunWriter(opened.path, opened.record | {"status": "running"})._save_record()
    died = []

    def parallel(self, tasks):
        died.append(len(list(tasks)))
        raise BrokenProcessPool

    with monkeypatch.context() as patch:
        patch.setattr("joblib.Parallel.__call__", parallel)
        code, output = call(*FIRST, "rods", "--resume", "--jobs", "2", "--json")
    assert (code, len(died)) == (1, 5)
    assert runs.open(Path("rods/plain")).status == "failed"
    assert runs.open(Path("rods/warm")).status == "finished"
    table = pd.read_csv("rods/fleet.csv")
    assert table["status"].tolist() == ["failed", "finished"]
    assert table["samples"].tolist() == [39, 29]
    assert "plain: A worker process died" in output
    call(*FIRST, "rods", "--resume")
    assert runs.open(Path("rods/plain")).status == "finished"


def test_the_summary_is_also_written_if_the_command_fails(here, monkeypatch):
    Path("rods.csv").write_text("name,data\nplain,\nwarm,rod/warm.csv\n")

    def defect(self, member, prepared):
        if member.name == "warm":
            self._writer(member, prepared.case)
            raise ZeroDivisionError
        return alone(self, member, prepared)

    module = sys.modules["livepde.cli.fleet_command"]
    alone = module.FleetRunner._alone
    monkeypatch.setattr(module.FleetRunner, "_alone", defect)
    with pytest.raises(ZeroDivisionError):
        call(*FIRST, "rods", "--separately")
    assert runs.open(Path("rods/warm")).status == "failed"
    assert pd.read_csv("rods/fleet.csv")["status"].tolist() == ["finished", "failed"]


KILLED = """
import os, signal, sys, threading, time
from pathlib import Path
from commands import call, estimates

def kill():
    while not any(estimates(f"two/{name}") > 50 for name in "abcd"):
        time.sleep(0.01)
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            ours = f"HERE={os.getcwd()}" in (process / "environ").read_text()
            if ours and os.environ["KILLED"] in (process / "cmdline").read_text():
                found.append(int(process.name))
        except OSError:
            pass
    os.kill(min(found), signal.SIGKILL)

if __name__ == "__main__":
    threading.Thread(target=kill, daemon=True).start()
    print(call(*sys.argv[1:])[1])
"""
WORKERS = {"dask": "--multiprocessing-fork", "ray": "ray::PoolActor"}


@pytest.mark.study
@pytest.mark.process
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="workers are found in /proc")
@pytest.mark.usefixtures("longer")
@pytest.mark.parametrize("backend", WORKERS)
def test_a_worker_of_another_engine_is_killed(backend):
    """Its members resume from their run directories in another process."""
    name = {"dask": "distributed"}.get(backend, backend)
    pytest.importorskip(name, reason=f"{backend} is not installed")
    call(*FIRST, "one", "--separately")
    Path("script.py").write_text(KILLED)
    command = [sys.executable, "script.py", *FIRST, "two", "--separately"]
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    environment = os.environ | {
        "PYTHONPATH": paths,
        "HERE": os.getcwd(),
        "KILLED": WORKERS[backend],
    }
    done = subprocess.run(
        [*command, "--backend", backend, "--jobs", "2"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=environment,
    )
    assert "Run directories: two" in done.stdout, done.stderr
    assert pd.read_csv("two/fleet.csv")["status"].tolist() == ["finished"] * 4
    assert any("resumed" in runs.open(Path("two") / name).record for name in "abcd")
    for name in "abcd":
        mine, wanted = (runs.open(Path(folder) / name) for folder in ("two", "one"))
        xr.testing.assert_identical(*(run.dataset.drop_attrs() for run in (mine, wanted)))


@pytest.mark.long
def test_other_commands_accept_the_runs_of_a_fleet(alike):
    call(*FIRST, "rods")
    call("report", "rods/b")
    call("export", "rods/b", "b.csv", "b.html")
    assert len(pd.read_csv("b.csv")) == 39
    case = cases.load("rod/case.toml").prepare("rod/other.csv")
    case.identifier.load("rods/b/checkpoint.bin")
    run = runs.open(Path("rods/b"))
    assert case.identifier.t == run.dataset["time"][-1]
    estimate = case.identifier._settled(case.identifier.estimate())
    assert estimate.q[0] == run.dataset["alpha"][-1]
    assert case.identifier.step(estimate.t + 20.0, list(case.stream)[-1].z).status.ok


@pytest.mark.long
@pytest.mark.parametrize(
    ("waiting", "how"),
    [(250, "3 were stepped separately: resumed runs (3)."), (10**9, "3 were stepped together.")],
)
def test_a_killed_fleet_resumes(alike, monkeypatch, waiting, how):
    """Members with results resume separately, members without begin together."""
    call(*FIRST, "rods")
    monkeypatch.setattr(member_blocks, "WAITING", waiting)
    stepped = Fleet.step

    def step(self, t, z, inputs=None):
        if t == 400.0:
            raise Killed
        return stepped(self, t, z, inputs)

    with monkeypatch.context() as patch:
        patch.setattr(Fleet, "step", step)
        with pytest.raises(Killed):
            call(*FIRST, "again")
    assert runs.open(Path("again/a")).status == "running"
    assert (Path("again/a") / JOURNAL).exists() == (waiting == 250)
    _, output = call(*FIRST, "again", "--resume", "--json")
    assert json.loads(output)["notes"][0] == f"Of 3 members, {how}"
    assert runs.open(Path("again/a")).status == "finished"
    for name in "abc":
        same(runs.open(Path("again") / name).dataset, runs.open(Path("rods") / name).dataset)


class Killed(BaseException):
    """Exception that simulates a kill within the process."""


@pytest.mark.long
def test_a_signal_ends_all_members_where_they_are(alike, monkeypatch):
    """Later members do not begin."""
    others = "d,,,0.1 K\ne,rod/other.csv,,0.1 K\nf,,,0.2 K\n"
    lines = [line + "," for line in ALIKE.splitlines()[1:]]
    Path("rods.csv").write_text("\n".join(["name,data,initial,law.noise", *lines, others]))
    stepped = Fleet.step

    def step(self, t, z, inputs=None):
        if t == 400.0:
            signal.raise_signal(signal.SIGINT)
        return stepped(self, t, z, inputs)

    with monkeypatch.context() as patch:
        patch.setattr(Fleet, "step", step)
        code, _ = call(*FIRST, "rods")
    assert code == INTERRUPTED
    table = pd.read_csv("rods/fleet.csv")
    assert table["name"].tolist() == ["a", "b", "c"]
    assert (table["status"] == "interrupted").all()
    assert (table["samples"] == 21).all()
    assert "Interrupted after 21 samples." in runs.open(Path("rods/c")).notes
    call(*FIRST, "rods", "--resume")
    table = pd.read_csv("rods/fleet.csv")
    assert (len(table), table["samples"].unique().tolist()) == (6, [39])


def test_a_member_with_a_different_run_is_refused_alone(alike):
    """The other members continue."""
    call(*FIRST, "rods")
    for name in "abc":
        for file in (JOURNAL, "estimates.nc"):
            (Path("rods") / name / file).unlink()
    Path("rods.csv").write_text(ALIKE.replace("b,rod/other.csv", "b,rod/third.csv"))
    code, output = call(*FIRST, "rods", "--resume")
    assert code == 1
    assert "b: rods/b was run with --data" in " ".join(output.split())
    assert pd.read_csv("rods/fleet.csv")["status"].tolist() == ["finished", "failed", "finished"]


def test_finished_members_are_not_run_again(alike, monkeypatch):
    call(*FIRST, "rods")
    table = pd.read_csv("rods/fleet.csv")
    monkeypatch.setattr(cases.Prepared, "identifier", None)  # no identifier is created
    call(*FIRST, "rods", "--resume")
    pd.testing.assert_frame_equal(pd.read_csv("rods/fleet.csv"), table)
    _, output = call(*FIRST, "rods", "--resume", "--set", "law.noise=1 K", "--json")
    assert "other settings" in output


@pytest.mark.parametrize(("key", "value"), [("late", "20 s"), ("noise_column", "T_right")])
def test_members_with_different_channels_step_separately(here, key, value):
    """Their columns were once read in the order of the first member."""
    case, names = Path("rod/case.toml"), ("T_10", "T_30")
    settings = [{f"channels.{name}.{key}": value} for name in names]
    members = {k: cases.load(case, settings=one).prepare() for k, one in enumerate(settings)}
    assert len({one.stream.names for one in members.values()}) == 2
    together, apart = member_blocks.blocks(members)
    assert not together
    assert list(apart) == [0, 1]


@pytest.mark.long
def test_the_reason_for_separate_members_is_reported(alike):
    Path("rods.csv").write_text(
        "name,data,initial,law.noise,law.refit\n"
        "a,,,,\nb,rod/other.csv,,,\nshort,rod/warm.csv,,,\nnoisy,,,0.2 K,\n"
        "p,,,,false\nq,rod/other.csv,,,false\nlost,rod/gap.csv,,,\n"
    )
    rows = Path("rod/rod.csv").read_text().splitlines()
    time, _, *others = rows[1].split(",")
    Path("rod/gap.csv").write_text("\n".join([rows[0], ",".join([time, "", *others]), *rows[2:]]))
    code, output = call(*FIRST, "rods", "--json")
    found = json.loads(output)
    assert code == 0
    assert found["notes"][0] == (
        "Of 7 members, 4 were stepped together, and 3 were stepped separately: no other member has "
        "their settings and sample times (3)."
    )
    # A run begins with the first row in which each input has a value.
    assert [row[1] for row in found["tables"][0]["rows"]] == ["finished"] * 7


@pytest.mark.long
def test_a_failed_step_is_reported_for_its_member_only(alike):
    """An event in its journal, a status in its dataset."""
    rows = Path("rod/other.csv").read_text().splitlines()
    time, _, *others = rows[12].split(",")
    rows[12] = ",".join([time, "1e308", *others])  # the step overflows
    Path("rod/other.csv").write_text("\n".join(rows) + "\n")
    case = Path("rod/case.toml")
    kept = case.read_text().replace('role = "boundary"', 'role = "boundary", spikes = "keep"')
    case.write_text(kept)
    call(*FIRST, "rods")
    call(*FIRST, "apart", "--separately")
    for name in "abc":
        equal(Path("rods") / name, Path("apart") / name)
        with Journal.open(Path("rods") / name / JOURNAL) as journal:
            assert bool(journal.events) == (name == "b")


@pytest.mark.long
def test_a_pause_of_decades_ends_no_member(alike):
    """The pause exceeds the number of substeps; fleets and single runs finish equally."""
    for name in ("rod", "other", "third"):
        path = Path(f"rod/{name}.csv")
        rows = path.read_text().splitlines()
        rows[-1] = ",".join(["1e9", *rows[-1].split(",")[1:]])
        path.write_text("\n".join(rows) + "\n")
    call(*FIRST, "rods")
    call(*FIRST, "apart", "--separately")
    left, right = (pd.read_csv(f"{folder}/fleet.csv") for folder in ("rods", "apart"))
    assert left["status"].tolist() == ["finished"] * 3
    pd.testing.assert_frame_equal(left, right, rtol=1e-7)
