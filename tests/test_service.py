"""Live runs of `livepde run`, started and stopped as a service would."""

import json
import math
import signal
import socket
import threading
import time
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from commands import bad, call, estimates, start, stopped, until

import livepde as lp
from livepde import cases, runs
from livepde.cases.data import source_of
from livepde.cases.live_case import LiveCase
from livepde.runs import JOURNAL, Journal
from livepde.runs.feeds import Paced, SampleFeed
from livepde.runs.live_loop import Live
from livepde.streams.sources import Rows

pytestmark = pytest.mark.process

CASE = """
title = "A rod beside its process"
equation = "heat"
initial = "interpolate"

[mesh]
from = "0 m"
to = "1 m"
cells = 20

[data]
{data}
time = "time"

[intake]
{intake}

[unknowns.alpha]
prior = "2e-5 m^2/s"
std = "1e-5 m^2/s"
bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]

[channels]
left = {{ role = "boundary", column = "left", at = "left", unit = "degC" }}
T_3 = {{ role = "sensor", column = "T_3", at = "0.3 m", unit = "degC"{habit} }}
T_6 = {{ role = "sensor", column = "T_6", at = "0.6 m", unit = "degC" }}

[boundary]
right = "20 degC"

[law]
kind = "sensitivity"
noise = "0.2 K"

[output]
fields_every = 20
"""
HEADER = "time,left,T_3,T_6\n"
START = datetime(2026, 11, 21)


def row(k: int) -> dict[str, object]:
    left = 20.0 + 10.0 * math.sin(0.05 * k) ** 2
    values = {"left": left, "T_3": 20.0 + 0.4 * (left - 20.0), "T_6": 20.0 + 0.1 * (left - 20.0)}
    return {"time": str(START + timedelta(minutes=k)), **values}


def table(*chosen: dict[str, object]) -> str:
    return "".join(",".join(str(cell) for cell in one.values()) + "\n" for one in chosen)


def case(data='file = "rows.csv"\nfollow = true', intake="", habit="") -> str:
    Path("case.toml").write_text(CASE.format(data=data, intake=intake, habit=habit))
    return "case.toml"


def test_a_run_follows_a_file_stops_gracefully_and_resumes(here):
    whole = [row(k) for k in range(60)]
    Path("rows.csv").write_text(HEADER + table(*whole))
    code, _ = call("run", case('file = "rows.csv"'), "--out", "batch")
    assert code == 0
    expected = runs.open("batch").dataset

    Path("rows.csv").unlink()
    first = start(case(), "--out", "live", "--resume")
    Path("rows.csv").write_text(HEADER + table(*whole[:25]) + "2026-11-21 00:25")
    until(lambda: estimates("live") == 25, first)
    assert runs.open("live").status == "running"
    assert runs.open("live").dataset.sizes["time"] == 25
    stopped(first)
    assert runs.open("live").status == "interrupted"

    Path("rows.csv").write_text(HEADER + table(*whole))
    second = start("case.toml", "--out", "live", "--resume")
    until(lambda: estimates("live") == 60, second)
    stopped(second, signal.SIGINT)
    found = runs.open("live").dataset
    assert np.array_equal(found["time"], expected["time"])
    for name in ("alpha", "alpha_std", "innovation"):
        # The last estimate is from the final fit, which has one second after a signal.
        assert np.array_equal(found[name][:-1], expected[name][:-1])
    assert found.attrs["origin"] == "2026-11-21 00:00:00"
    assert len(runs.open("live").record["resumed"]) == 1


def test_a_file_given_by_data_is_followed_instead_of_the_case_file(here):
    process = start(case(), "--data", "other.csv", "--out", "live")
    Path("other.csv").write_text(HEADER + table(*(row(k) for k in range(3))))
    until(lambda: estimates("live") == 3, process)
    with Path("other.csv").open("a") as file:
        file.write(table(*(row(k) for k in range(3, 5))))
    until(lambda: estimates("live") == 5, process)
    stopped(process)
    taken = ("--data", "other.csv", "--set", "data.follow=false", "--out", "batch")
    assert call("run", "case.toml", *taken)[0] == 0
    expected = runs.open("batch").dataset
    assert np.array_equal(runs.open("live").dataset["alpha"], expected["alpha"])


@pytest.mark.parametrize("name", [None, "other.csv"])
def test_a_missing_followed_file_is_named(here, caplog, name):
    source_of(cases.load(case()), name, "").close()
    assert f"there is no file '{name or 'rows.csv'}' yet: waiting for it" in caplog.text


def test_malformed_input_does_not_end_a_run(here):
    rows = [json.dumps(row(k)) for k in range(12)]
    rows[4:4] = ["{", '{"time": "soon"}', '{"time": "2026-11-21 00:02", "T_3": 21.5}', "[1]"]
    rows[9] = json.dumps({**row(5), "T_3": 85.0})
    habit = ', valid = ["-20 degC", "60 degC"]'
    text = case('file = "rows.csv"', habit=habit)
    code, output = call(
        "run", text, "--realtime", "--data", "-", "--out", "run", stdin="\n".join(rows)
    )
    assert code == 0
    assert "Irregular rows" in output
    with Journal.open(Path("run") / JOURNAL) as journal:
        assert len(journal) == 12
        assert journal.counts == {
            ("invalid", "T_3"): 1,
            ("conflict", "T_3"): 1,
            ("malformed", ""): 3,
            ("missing", "T_3"): 1,
        }
        assert "85 is not between -20 and 60" in [event.message for event in journal.events]


def test_rows_repeated_on_standard_input_are_used_once(here):
    lines = [json.dumps(row(k)) + "\n" for k in range(12)]
    options = ("--realtime", "--data", "-", "--estimates", "--resume", "--out")
    assert call("run", case(), *options, "whole", stdin="".join(lines))[0] == 0
    _, first = call("run", case(), *options, "run", stdin="".join(lines[:8]) + lines[8][:20])
    kept = max(json.loads(line)["t"] for line in first.splitlines() if line.startswith("{"))
    assert kept == 7 * 60.0
    _, second = call("run", case(), *options, "run", stdin="".join(lines[3:]))
    found = [json.loads(line)["t"] for line in second.splitlines() if line.startswith("{")]
    assert found == [60.0 * k for k in range(8, 12)]
    with Journal.open(Path("run") / JOURNAL) as journal:
        assert journal.counts == {("malformed", ""): 1, ("repeated", ""): 5}
    expected, resumed = (runs.open(name).dataset for name in ("whole", "run"))
    assert np.array_equal(resumed["time"], expected["time"])
    assert np.array_equal(resumed["alpha"], expected["alpha"])


@pytest.mark.parametrize("source", ["file", pytest.param("lines", marks=pytest.mark.long)])
def test_a_repeated_block_of_rows_changes_nothing(here, source):
    """Rows 80 to 139, more than one commit, are sent again after row 159, and are counted."""
    alone = ("--set", "law.refit=false")  # a background fit is used when it is done
    whole = [row(k) for k in range(220)]
    again = [*whole[:160], *whole[80:140], *whole[160:]]
    found = {}
    for name, given in (("whole", whole), ("again", again)):
        if source == "file":
            Path("rows.csv").write_text(HEADER + table(*given))
            command = ("run", case('file = "rows.csv"'), "--realtime", "--speed", "inf")
            assert call(*command, *alone, "--out", name)[0] == 0
        else:
            lines = "".join(json.dumps(one) + "\n" for one in given)
            command = ("run", case(), "--realtime", "--data", "-", "--out", name)
            assert call(*command, *alone, stdin=lines)[0] == 0
        found[name] = runs.open(name).dataset
        with Journal.open(Path(name) / JOURNAL) as journal:
            assert journal.counts == ({} if name == "whole" else {("repeated", ""): 60})
    for variable in ("time", "alpha", "alpha_std", "innovation"):
        expected = found["whole"][variable]
        assert np.array_equal(found["again"][variable], expected, equal_nan=True)


def test_a_run_resumes_with_a_stated_clock_shift(here):
    """A clock is set back by twenty minutes; rows are late until the user states the shift."""
    back = [{**row(k), "time": row(k - 20)["time"]} for k in range(20, 40)]
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(20)), *back[:10]))
    command = ("run", case('file = "rows.csv"'), "--realtime", "--speed", "inf")
    command = (*command, "--out", "run", "--resume")
    assert call(*command)[0] == 0
    found = runs.open("run")
    assert found.dataset.sizes["time"] == 20
    with Journal.open(Path("run") / JOURNAL) as journal:
        assert "intake.shift" in journal.health
        assert journal.counts[("clock", "")] == 1
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(20)), *back))
    assert call(*command, "--set", "intake.shift=20 min")[0] == 0
    expected = [60.0 * k for k in (*range(20), *range(30, 40))]
    assert runs.open("run").dataset["time"].values.tolist() == expected
    assert runs.open("run").record["resumed"][0]["intake.shift"] == "20 min"
    with pytest.raises(lp.errors.CaseError, match=r"intake\.shift"):
        call(*command, "--set", "intake.shift=20 K")


def test_invalid_values_are_also_counted_in_files(here):
    rows = [row(k) for k in range(12)]
    rows[4]["T_3"], rows[7]["left"] = 85.0, ""
    Path("rows.csv").write_text(HEADER + table(*rows))
    text = case('file = "rows.csv"', habit=', valid = ["-20 degC", "60 degC"]')
    path = Path(text)
    path.write_text(path.read_text().replace('at = "left"', 'at = "left", missing = "skip"'))
    for more in ((), ("--realtime", "--speed", "inf")):
        folder = f"run{len(more)}"
        assert call("run", text, "--out", folder, *more)[0] == 0
        with Journal.open(Path(folder) / JOURNAL) as journal:
            assert len(journal) == 11
            assert journal.counts[("invalid", "T_3")] == 1
            assert journal.counts[("skipped", "left")] == 1
    assert np.array_equal(runs.open("run0").dataset["alpha"], runs.open("run3").dataset["alpha"])


def test_parquet_files_are_read_like_csv_files(here):
    import pandas as pd

    rows = [row(k) for k in range(12)]
    Path("rows.csv").write_text(HEADER + table(*rows))
    pd.DataFrame(rows).assign(time=lambda d: pd.to_datetime(d["time"])).to_parquet("rows.parquet")
    assert call("run", case('file = "rows.csv"'), "--out", "csv")[0] == 0
    for folder, more in (("batch", ()), ("live", ("--realtime", "--speed", "inf"))):
        assert call("run", "case.toml", "--data", "rows.parquet", "--out", folder, *more)[0] == 0
        found = runs.open(folder).dataset
        assert np.array_equal(found["alpha"], runs.open("csv").dataset["alpha"])
        assert found.attrs["origin"] == "2026-11-21 00:00:00"


def test_a_run_begins_with_the_first_complete_sample(here):
    lines = [json.dumps({"time": "2026-11-20 23:00", "T_3": 20.0, "left": None, "T_6": None})]
    lines += [json.dumps(row(k)) for k in range(5)]
    code, _ = call(
        "run", case(), "--realtime", "--data", "-", "--out", "run", stdin="\n".join(lines)
    )
    assert code == 0
    assert runs.open("run").dataset.sizes["time"] == 5
    with pytest.raises(lp.errors.DataError, match="'left'"):
        call("run", "case.toml", "--realtime", "--data", "-", "--out", "none", stdin=lines[0])
    with pytest.raises(lp.errors.DataError, match="no sample arrived"):
        call("run", "case.toml", "--realtime", "--data", "-", "--out", "void", stdin="")


def test_estimates_as_lines_of_json(here):
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(4))))
    arguments = ("--realtime", "--speed", "inf", "--estimates", "--out", "run")
    code, output = call("run", case('file = "rows.csv"'), *arguments)
    assert code == 0
    found = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    assert [line["t"] for line in found] == [0.0, 60.0, 120.0, 180.0]
    # The run ends with a fit of all samples, which is in its files.
    told = [line["unknowns"]["alpha"]["value"] for line in found]
    assert told[:-1] == runs.open("run").dataset["alpha"].values.tolist()[:-1]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--speed", "2"), "--speed requires --realtime"),
        (("--realtime", "--speed", "0"), "a speed > 0; got 0"),
        (("--realtime", "--speed", "nan"), "a speed > 0; got nan"),
        (
            ("--realtime", "--speed", "2", "--data", "-"),
            "only valid for the replay of a complete file",
        ),
    ],
)
def test_a_speed_of_zero_is_refused(here, arguments, told):
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(4))))
    with pytest.raises(lp.errors.ConfigurationError, match=told):
        call("run", case('file = "rows.csv"'), "--out", "run", *arguments)
    assert not Path("run").exists()


def test_a_finished_file_is_replayed_at_its_pace():
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    samples = [lp.Sample(float(t), {"a": 0.0}) for t in (0, 60, 120, 300)]
    feed = Paced(SampleFeed(samples), 60.0, lambda: now[0], sleep)
    seen = []
    while not feed.done:
        seen += [(ready.t, now[0] - 100.0) for ready in feed.poll(0.5)]
    assert seen == [(0.0, 0.0), (60.0, 1.0), (120.0, 2.0), (300.0, 5.0)]
    assert max(slept) <= 0.5


def test_a_run_reads_from_and_publishes_to_a_broker(here, server):
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    data = (
        f'mqtt = {{ port = {server.port}, rows = ["rod/rows"], columns = {{ "rod/T_6" = "T_6" }} }}'
    )
    text = case(data, intake='tolerance = "1 s"')
    output = f'\nmqtt = {{ port = {server.port}, topic = "rod/estimate" }}\n'
    Path(text).write_text(Path(text).read_text() + output)
    heard = []
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda c, u, message: heard.append(json.loads(message.payload))
    client.connect("127.0.0.1", server.port)
    client.subscribe("rod/estimate")
    client.loop_start()
    process = start(text, "--out", "run", "--log", "json")
    until(lambda: Path("run/run.json").exists(), process)
    for k in range(10):
        values = row(k)
        last = {"time": values["time"], "value": values.pop("T_6")}
        client.publish("rod/rows", json.dumps(values), qos=1)
        client.publish("rod/T_6", json.dumps(last), qos=1)
    until(lambda: len(heard) == 10, process)
    stopped(process)
    client.loop_stop()
    found = runs.open("run").dataset
    # The run ends with a fit of all samples, which is in its files.
    told = [one["unknowns"]["alpha"]["value"] for one in heard]
    assert told[:-1] == found["alpha"].values.tolist()[:-1]
    assert np.isfinite(found["innovation"].sel(sensor="T_6")[1:]).all()


def test_a_custom_source_is_used(here):
    with LiveCase(
        cases.load(case()), Rows(row(k) for k in range(7)), path=here / "j.sqlite"
    ) as mine:
        run = mine.live()
        run.run()
        assert len(run.result) == 7
    with LiveCase(
        cases.load("case.toml"), Rows(row(k) for k in range(9)), path=here / "j.sqlite"
    ) as mine:
        run = mine.live()
        run.run()
        assert len(run.result) == 9
        assert run.journal.counts == {("repeated", ""): 7}


def test_rows_that_are_sent_are_taken_though_the_file_has_titles(here):
    Path("rows.csv").write_text("a title\n" + HEADER + table(*(row(k) for k in range(9))))
    loaded = cases.load(case('file = "rows.csv"\nskip = 1'))
    with LiveCase(loaded, Rows(row(k) for k in range(4)), path=here / "sent.sqlite") as wiring:
        run = wiring.live()
        run.run()
        assert len(run.result) == 4
    with LiveCase(loaded, path=here / "file.sqlite") as wiring:
        run = wiring.live()
        run.run()
        assert len(run.result) == 9


def test_dates_without_a_zone_are_of_the_zone_that_the_case_names(here):
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(3))))
    for zone, origin in (("UTC", "2026-11-21 00:00:00"), ("Europe/Berlin", "2026-11-20 23:00:00")):
        text = case(f'file = "rows.csv"\nzone = "{zone}"')
        assert str(cases.load(text).prepare().origin) == origin
        with LiveCase(cases.load(text)) as wiring:
            assert wiring.live().journal.layout.attrs["origin"] == origin


@pytest.mark.parametrize("moment", ["the case begins", "the loop has not begun"])
def test_a_signal_before_the_first_step_ends_the_run(here, monkeypatch, moment):
    begin = cases.Case.begin

    def begins(*arguments, **options):
        signal.raise_signal(signal.SIGINT)
        return begin(*arguments, **options)

    def resumes(self):
        signal.raise_signal(signal.SIGINT)
        return resume(self)

    resume = Live.resume
    if moment == "the case begins":
        monkeypatch.setattr(cases.Case, "begin", begins)
    else:
        monkeypatch.setattr(Live, "resume", resumes)
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(5))))
    arguments = ["run", case('file = "rows.csv"'), "--realtime", "--speed", "inf", "--out", "live"]
    assert call(*arguments)[0] == 0
    assert runs.open("live").status == "interrupted"
    assert estimates("live") == 0
    monkeypatch.undo()
    monkeypatch.chdir(here)
    assert call(*arguments, "--resume")[0] == 0
    assert estimates("live") == 5


@pytest.mark.parametrize(
    ("data", "intake", "habit", "text"),
    [
        ('file = "rows.csv"\nzone = "Mars"', "", "", "data.zone: there is no time zone 'Mars'"),
        ("mqtt = {}", "", "", "expected rows = [topics], or columns"),
        (
            'follow = true\nmqtt = { rows = ["a"] }',
            "",
            "",
            "follow requires a single file that grows",
        ),
        ('file = "a.csv"\nmqtt = { rows = ["a"] }', "", "", "file and mqtt are two sources"),
        ('file = "rows.csv"\nfollow = true\nevery = 2', "", "", "every requires complete data"),
        ('file = "rows.csv"', 'wait = "-1 s"', "", "wait must be a time >= 0"),
        ('file = "rows.csv"', 'wait = "1 m"', "", "intake.wait: 'm' cannot be converted to 's'"),
        ('file = "rows.csv"', "queue = 0", "", "queue"),
        ('file = "rows.csv"', "", ', valid = ["1 degC", "0 degC"]', "the lower one first"),
        ('file = "rows.csv"', "", ', missing = "guess"', "expected one of interpolate, hold, skip"),
    ],
)
def test_invalid_combinations_of_sources_and_sinks_are_refused(here, data, intake, habit, text):
    Path("rows.csv").write_text(HEADER + table(row(0)))
    message = bad("run", case(data, intake, habit), "--realtime", "--out", "run")
    assert text in message
    assert not Path("run").exists()


@pytest.mark.parametrize("option", [("--listen", "9100"), ("--watch", "8050"), ("--estimates",)])
def test_options_of_live_runs_require_realtime(here, option):
    Path("rows.csv").write_text(HEADER + table(row(0)))
    assert "requires --realtime" in bad("run", case('file = "rows.csv"'), *option)


def test_a_password_comes_from_the_environment(here, monkeypatch):
    text = case('mqtt = { rows = ["a"], username = "me", password_env = "LIVEPDE_ROD" }')
    monkeypatch.delenv("LIVEPDE_ROD", raising=False)
    assert "the environment variable LIVEPDE_ROD is not set" in bad("run", text)


def test_the_reason_for_a_missing_first_sample_is_reported(here, caplog):
    wrong = [{"when": k, "left": 20.0, "T_3": 20.0, "T_6": 20.0} for k in range(3)]
    loaded = cases.load(case())
    with (
        caplog.at_level("WARNING"),
        LiveCase(loaded, Rows(wrong)) as wiring,
        pytest.raises(lp.errors.DataError, match=r"no sample arrived \(malformed: .*'time'"),
    ):
        wiring.live()
    assert [one.message.split(":")[0] for one in caplog.records] == ["malformed"]

    good = [row(k) for k in range(3)]
    with LiveCase(loaded, Rows([*wrong, *good])) as wiring:
        live = wiring.live()
        live.run()
        assert live.journal.counts == {("malformed", ""): 3}
        assert len(live.result) == 3

    class Nothing(Rows):
        stopping = threading.Event()
        polls = 0

        def poll(self, wait):
            self.polls += 1
            time.sleep(0.01)
            if self.polls == 3:
                self.stopping.set()
            return []

    caplog.clear()
    with LiveCase(cases.load(case(intake='silence = "1 ms"')), Nothing([])) as wiring:
        assert wiring.live(stopping=Nothing.stopping) is None
        assert wiring.silent
    assert "no data from the source" in caplog.text


def test_a_run_without_a_sample_has_failed_and_can_begin_again(here):
    Path("rows.csv").write_text(HEADER)
    arguments = ["run", case('file = "rows.csv"'), "--realtime", "--speed", "inf"]
    assert "no sample arrived" in bad(*arguments, "--out", "live")
    assert runs.open("live").status == "failed"
    assert "status is 'failed'. case.toml: no sample arrived" in bad("report", "live")
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(5))))
    assert call(*arguments, "--out", "live", "--resume")[0] == 0
    assert runs.open("live").status == "finished"


def test_a_port_that_is_taken_or_no_speed_leaves_nothing_behind(here):
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(5))))
    arguments = ["run", case('file = "rows.csv"'), "--realtime", "--out", "live"]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert "choose another port" in bad(*arguments, "--listen", port)
    assert "speed > 0" in bad(*arguments, "--speed", "0")
    assert not Path("live").exists()
