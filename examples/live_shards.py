"""Live rods on Dask with one task per batch, which runs again if its worker is killed."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow.parquet as pq

import livepde as lp
from livepde.atomic_write import write_bytes
from livepde.models import heat

RODS, BATCHES = 20, 30


def new_shard(name):
    model = heat(lp.interval(0, 1, 99), lp.Normal(0.5, 0.2), {"left": 0.0, "right": 0.0})
    sensors, law = lp.Points([0.3, 0.6], noise=0.01), lp.SensitivityLaw(refit=None)
    return lp.fleet.Shard(model, sensors, law, [f"{name}{k}" for k in range(RODS)], u0=1.0)


def advance(folder, name, offset, batch, before):
    """Process a batch of the log; `before` is the previous task, which keeps the order."""
    shard, dump = new_shard(name), folder / f"{name}.bin"
    if dump.exists():
        shard.load(dump.read_bytes())
    if shard.offset < offset + len(batch):  # otherwise an earlier attempt was complete
        table = shard.step(offset, batch).to_arrow()
        pq.write_table(table, folder / f"{name}-{offset:06d}.parquet")  # equal at each attempt
        write_bytes(dump, shard.dump(), sync=True)  # atomic, and last
    return shard.offset


def main(folder, client):
    """Submit the batches of two shards in the order of the log."""
    tails = dict.fromkeys(["north", "south"])
    for k in range(BATCHES):
        z = np.exp(-0.4 * k) + 0.01 * np.random.default_rng(k).standard_normal((RODS, 2))
        for name, tail in tails.items():
            batch = [(f"{name}{j}", 0.05 * (k + 1), row.tolist()) for j, row in enumerate(z)]
            tails[name] = client.submit(advance, folder, name, k * RODS, batch, tail, retries=5)
    return client.gather(list(tails.values()))


if __name__ == "__main__":
    from distributed import Client

    with TemporaryDirectory() as folder, Client(n_workers=2, threads_per_worker=1) as client:
        taken = main(Path(folder), client)
        print(f"{len(taken)} shards of {RODS} rods on 2 workers, samples taken of each: {taken}")
