"""A shard gives the numbers of separate identifiers from a stream with offsets."""

import os
import runpy
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from patience import PATIENCE
from test_fleet import LAWS, MODELS, SENSORS, law, rod, samples

import livepde as lp

MEMBERS = ["a", "b", "c", "d", "e"]


def stream(model, steps=40, seed=1):
    """Return items in the order of their times: members that miss samples, or go their own way."""
    rng = np.random.default_rng(seed)
    fleet = lp.Fleet(model, SENSORS, law(), MEMBERS, u0=0.0)
    items = []
    for t, z, inputs in samples(fleet, steps):
        for k, name in enumerate(MEMBERS):
            if rng.random() < 0.1 and t > 0.15:
                continue
            later = 0.03 if name == "e" else 0.0
            given = {key: np.broadcast_to(value, 5)[k] for key, value in inputs.items()}
            items.append((name, t + later, z[k].tolist(), given))
    return items


def batches(items, size=17):
    return [(k, items[k : k + size]) for k in range(0, len(items), size)]


def separately(model, items, rule, **options):
    """Return the estimates of an identifier for each member, in the order of the samples."""
    ones = {name: lp.Identifier(model, SENSORS, rule, u0=0.0, **options) for name in MEMBERS}
    return [ones[name].step(*sample) for name, *sample in items]


def shard(model, rule=None, members=MEMBERS):
    return lp.fleet.Shard(model, SENSORS, rule or law(), members, u0=0.0)


def run(one, pieces):
    """Return q, standard deviations, innovations and statuses of all samples."""
    found = [one.step(offset, batch) for offset, batch in pieces]
    arrays = (np.concatenate([getattr(f, name) for f in found]) for name in ("q", "q_std"))
    return (
        *arrays,
        np.concatenate([f.innovation for f in found]),
        [s for f in found for s in f.status],
    )


# A law that keeps more than a filter, and members one by one: test_fleet.py has each law.
PAIRS = [("rod", "gradient"), ("layers", "jumps")]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "rule"), PAIRS)
def test_equals_separate_identifiers(model, rule):
    built, chosen = MODELS[model](), lp.GradientLaw() if rule == "gradient" else LAWS[rule]
    items = stream(built, 7)
    one = shard(built, chosen)
    assert bool(one.note) == (rule == "gradient")
    q, q_std, innovation, status = run(one, batches(items))
    wanted = separately(built, items, chosen)
    assert status == [estimate.status.code for estimate in wanted]
    known = () if rule == "gradient" else ((q_std, "q_std"),)  # a law without covariance
    for mine, name in ((q, "q"), (innovation, "innovation"), *known):
        theirs = np.array([getattr(estimate, name) for estimate in wanted])
        np.testing.assert_allclose(mine, theirs, rtol=1e-7, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["usual", "gradient"])
def test_goes_on_from_a_dump_at_any_batch(rule):
    """With identical numbers, and at its offset."""
    model, chosen = rod(), lp.GradientLaw() if rule == "gradient" else LAWS[rule]
    pieces = batches(stream(model, 7))
    whole, others = shard(model, chosen), [shard(model, chosen) for _ in range(2)]
    dumps, found = [], []
    for offset, batch in pieces:
        dumps.append(whole.dump())
        found.append(whole.step(offset, batch))
    for k, content in enumerate(dumps):
        other = others[k % 2]  # also one that has gone on since
        other.load(content)
        assert other.offset == pieces[k][0]
        for (offset, batch), wanted in zip(pieces[k:], found[k:], strict=True):
            got = other.step(offset, batch)
            assert np.array_equal(got.q, wanted.q, equal_nan=True)
            assert np.array_equal(got.q_std, wanted.q_std, equal_nan=True)
            assert got.status == wanted.status
        assert other.dump() == whole.dump()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset", "count", "said"),
    [
        (0, 3, r"samples 0 to 2 were taken already, the shard is at 5: skip them\."),
        (0, 5, r"samples 0 to 4 were taken already"),
        (3, 4, r"samples 3 to 4 of the batch were taken already, 5 to 6 were not: read .* from 5"),
        (7, 1, r"the batch begins at 7, the shard is at 5: samples 5 to 6 are missing"),
    ],
)
def test_refuses_a_batch_that_does_not_continue(offset, count, said):
    model = rod()
    items, one = stream(model, 6), shard(model)
    one.step(0, items[:5])
    before = one.dump()
    with pytest.raises(lp.errors.OffsetError, match=said):
        one.step(offset, items[offset : offset + count])
    assert one.dump() == before
    assert one.step(5, items[5:8]).status == ["ok"] * 3


@pytest.mark.slow
def test_a_sample_that_cannot_be_used_is_refused_alone():
    model = rod()
    items = stream(model, 6)
    poor = [
        ("nobody", 0.1, [0.0, 0.0, 0.0], {}),
        ("a", 0.1, [0.0, 0.0, 0.0], {}),  # not later
        ("b", float("nan"), [0.0, 0.0, 0.0], {}),
        ("b", "now", [0.0, 0.0, 0.0], {}),
        ("c", 0.9, [0.0, 0.0], {}),
        ("c", 0.9, [0.0, "warm", 0.0], {}),
        ("d", 0.9, [0.0, 0.0, 0.0], {"T_9": 1.0}),
        ("d", 0.9, {"T_9": 1.0}),
        ("d",),
        None,
        (["d"], 0.9, [0.0, 0.0, 0.0]),
        ("d", 0.9, [0.0, 0.0, 0.0], 1.0),
        ("d", 0.9, None),
    ]
    said = [
        "no member 'nobody'",
        "not later",
        "time t is nan",
        "time t",
        "z has shape (2,)",
        "not an array of numbers",
        "unknown input 'T_9'",
        "unknown channel 'T_9'",
        "1 parts",
        "0 parts",
        "no member ['d']",
        "inputs are 1.0",
        "z has shape ()",
    ]
    one, other = shard(model), shard(model)
    one.step(0, items[:15])
    other.step(0, items[:15])
    found = one.step(15, [*poor, *items[15:]])
    wanted = other.step(15, items[15:])
    assert found.status == ["refused"] * len(poor) + wanted.status
    for message, part in zip(found.message[: len(poor)], said, strict=True):
        assert part in message
    np.testing.assert_allclose(found.q[len(poor) :], wanted.q, rtol=1e-9)
    assert np.isnan(found.q[: len(poor)]).all()


ROW = pd.Series({"T_c": 0.3, "T_b": 0.2, "T_a": 0.1})
FORMS = [
    ROW,
    {"T_a": (0.1, 0.02), "T_b": 0.2},
    [(0.1, 0.02), (0.2, 0.01), (0.3, 0.01)],
    np.ma.masked_array([0.1, 0.2, 0.3], [True, False, False]),
]


@pytest.mark.parametrize("z", FORMS, ids=["row", "pair", "pairs", "masked"])
def test_a_reading_has_each_form_that_an_identifier_takes(z):
    """A row of a table counts by its names, as one for a list of such rows in a fleet."""
    places = {"T_a": 0.2, "T_b": 0.5, "T_c": 0.8}
    parts = rod(), lp.Points(places, noise=0.01), law(refit=None)
    inputs = dict.fromkeys(lp.Identifier(*parts, u0=0.0).inputs, 1.0)
    wanted = lp.Identifier(*parts, u0=0.0).step(0.1, z, inputs)
    one = lp.fleet.Shard(*parts, ["a", "b"], u0=0.0)
    got = one.step(0, [("a", 0.1, z, inputs), ("b", 0.1, z, inputs)])
    assert got.status == ["ok", "ok"]
    fleet = lp.Fleet(*parts, ["a", "b"], u0=0.0)
    together = [] if isinstance(z, list | np.ma.MaskedArray) else [fleet.step(0.1, [z, z], inputs)]
    for found in (got, *together):
        for name in ("q", "q_std", "innovation"):
            theirs = [getattr(wanted, name)] * 2
            np.testing.assert_allclose(getattr(found, name), theirs, rtol=1e-9)


@pytest.mark.slow
def test_a_step_that_was_broken_off_has_to_be_loaded_again(monkeypatch):
    """Some of its members have gone on, so that the same batch would give other numbers."""
    model = rod()
    items, one = stream(model, 6), shard(model)
    one.step(0, items[:10])
    before = one.dump()
    stepped = lp.Fleet.step

    def step(self, t, z, inputs=None):
        if "e" in self.members:
            raise MemoryError
        return stepped(self, t, z, inputs)

    with monkeypatch.context() as patch:
        patch.setattr(lp.Fleet, "step", step)
        with pytest.raises(MemoryError):
            one.step(10, items[10:20])
    for call in (lambda: one.step(10, items[10:20]), one.dump):
        with pytest.raises(lp.errors.RunError, match="at offset 10 was broken off"):
            call()
    one.load(before)
    other = shard(model)
    other.step(0, items[:10])
    assert np.array_equal(one.step(10, items[10:20]).q, other.step(10, items[10:20]).q)


@pytest.mark.slow
def test_dumps_of_others_are_refused():
    model = rod()
    content = shard(model).dump()
    with pytest.raises(lp.errors.RunError, match="another members"):
        shard(model, members=["a", "b"]).load(content)
    with pytest.raises(lp.errors.RunError, match="another law"):
        shard(model, lp.GradientLaw()).load(content)
    with pytest.raises(lp.errors.RunError, match="damaged"):
        shard(model).load(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(lp.errors.RunError, match="another shard"):
        shard(model).load(lp.Fleet(model, SENSORS, law(), MEMBERS, u0=0.0).dump())


@pytest.mark.slow
def test_gives_an_arrow_table():
    pytest.importorskip("pyarrow", reason="'parquet' is not installed")
    model = rod()
    items = stream(model, 6)
    one = shard(model)
    one.step(0, items[:4])
    found = one.step(4, [*items[4:8], ("nobody", 1.0, [0.0])])
    table = found.to_arrow()
    assert table.column_names[:7] == [
        "offset",
        "member",
        "t",
        "status",
        "message",
        "alpha",
        "alpha_std",
    ]
    assert table["offset"].to_pylist() == list(range(4, 9))
    assert table["member"].to_pylist() == [item[0] for item in items[4:8]] + ["nobody"]
    assert table["alpha"].to_numpy()[:4] == pytest.approx(found.q[:4, 0])
    assert table["status"].to_pylist()[-1] == "refused"
    assert "innovation T_1" in table.column_names


@pytest.mark.slow
def test_an_identifier_goes_on_by_itself():
    model = rod()
    items = stream(model, 6)
    one = shard(model)
    one.step(0, items[:20])
    left = one.identifier("b")
    q = left.estimate().q.copy()
    one.step(20, items[20:])
    assert np.array_equal(left.estimate().q, q)
    assert left.t < one.identifier("b").t


# --- a worker that is killed ---------------------------------------------------------------------

WORKER = """
import struct, sys
from pathlib import Path
from test_shard import batches, rod, shard, stream

model = rod()
one, dump, out = shard(model), Path("dump"), Path("estimates")
if dump.exists():
    one.load(dump.read_bytes())
with out.open("ab") as file:
    for offset, batch in batches(stream(model)):
        if offset < one.offset:
            continue
        found = one.step(offset, batch)
        for k, row in enumerate(found.q):
            file.write(struct.pack("<q2d", offset + k, *row))
        file.flush()
        if offset // len(batch) % 3 == 2:
            partial = Path("dump.partial")
            partial.write_bytes(one.dump())
            partial.replace(dump)
Path("done").touch()
"""
ROW = struct.Struct("<q2d")


@pytest.mark.process
def test_a_worker_that_is_killed_at_any_moment_changes_nothing(tmp_path):
    """Restarted from its last dump it writes the same estimates again: none is lost or differs."""
    model = rod()
    wanted = run(shard(model), batches(stream(model)))[0]
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    rng, kills = np.random.default_rng(5), 0
    out, end = tmp_path / "estimates", time.monotonic() + PATIENCE
    while not (tmp_path / "done").exists():
        assert time.monotonic() < end
        size = out.stat().st_size if out.exists() else 0
        worker = subprocess.Popen(
            [sys.executable, "-c", WORKER], cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}
        )
        while worker.poll() is None and kills < 3:  # it has begun: then at a random moment
            if out.exists() and out.stat().st_size > size:
                time.sleep(rng.uniform(0.0, 0.05))
                worker.send_signal(signal.SIGKILL)
                kills += worker.wait(timeout=PATIENCE) == -signal.SIGKILL
        assert worker.wait(timeout=PATIENCE) in (0, -signal.SIGKILL)
    assert kills
    content = out.read_bytes()
    rows = list(ROW.iter_unpack(content[: len(content) // ROW.size * ROW.size]))
    assert {offset for offset, *_ in rows} == set(range(len(wanted)))
    different = [offset for offset, *q in rows if not np.array_equal(q, wanted[offset])]
    assert different == []


ON_DASK = """
import os, signal, sys, threading, time
from pathlib import Path

sys.path.insert(0, sys.argv[1])
import live_shards
from distributed import Client


def kill(client, folder):
    for count in (10, 31):
        while len(list(folder.glob("*.parquet"))) < count:
            time.sleep(0.005)
        os.kill(client.cluster.workers[count % 2].pid, signal.SIGKILL)
        print("killed", flush=True)


if __name__ == "__main__":
    folder = Path("out")
    folder.mkdir()
    with Client(n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
        threading.Thread(target=kill, args=[client, folder], daemon=True).start()
        print(live_shards.main(folder, client))
"""


ON_RAY = """
import subprocess, sys, threading, time
from pathlib import Path

sys.path.insert(0, sys.argv[1])
import live_shards_ray
import ray


def kill(folder):
    for count in (10, 31):
        while len(list(folder.glob("*.parquet"))) < count:
            time.sleep(0.005)
        subprocess.run(["pkill", "-9", "-n", "-f", "^ray::LiveShard"], check=True)
        print("killed", flush=True)


folder = Path("out").resolve()
folder.mkdir()
with ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False):
    threading.Thread(target=kill, args=[folder], daemon=True).start()
    print(live_shards_ray.main(folder))
"""


@pytest.mark.process
@pytest.mark.parametrize(("engine", "script"), [("distributed", ON_DASK), ("ray", ON_RAY)])
def test_the_recipe_for_an_engine_survives_workers_that_are_killed(engine, script, tmp_path):
    """Every estimate is there once, and is that of a shard in one process."""
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    parquet = pytest.importorskip("pyarrow.parquet", reason="'parquet' is not installed")
    examples = Path(__file__).parents[1] / "examples"
    (tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, "script.py", str(examples)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.stdout.count("killed\n") == 2, done.stderr
    assert "[600, 600]\n" in done.stdout, done.stderr
    one = runpy.run_path(str(examples / "live_shards.py"))
    for name in ("north", "south"):
        alone, wanted = one["new_shard"](name), []
        for k in range(one["BATCHES"]):
            rng = np.random.default_rng(k)
            z = np.exp(-0.4 * k) + 0.01 * rng.standard_normal((one["RODS"], 2))
            times = 0.05 * (k + 1)
            batch = [(f"{name}{j}", times, row.tolist()) for j, row in enumerate(z)]
            wanted += alone.step(alone.offset, batch).q[:, 0].tolist()
        tables = [parquet.read_table(path) for path in sorted((tmp_path / "out").glob(f"{name}-*"))]
        assert [k for table in tables for k in table["offset"].to_pylist()] == list(range(600))
        assert [x for table in tables for x in table["alpha"].to_pylist()] == wanted
