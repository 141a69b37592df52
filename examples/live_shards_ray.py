"""Live rods on Ray with one actor per shard, which resumes from its dump if it is killed."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow.parquet as pq
import ray

import livepde as lp
from livepde.atomic_write import write_bytes
from livepde.models import heat

RODS, BATCHES = 20, 30


@ray.remote(max_restarts=-1, max_task_retries=-1)
class LiveShard:
    """Actor with one shard on a worker."""

    def __init__(self, folder, name):
        model = heat(lp.interval(0, 1, 99), lp.Normal(0.5, 0.2), {"left": 0.0, "right": 0.0})
        sensors, law = lp.Points([0.3, 0.6], noise=0.01), lp.SensitivityLaw(refit=None)
        self.shard = lp.fleet.Shard(
            model, sensors, law, [f"{name}{k}" for k in range(RODS)], u0=1.0
        )
        self.estimates, self.dump = f"{folder}/{name}-{{:06d}}.parquet", folder / f"{name}.bin"
        if self.dump.exists():
            self.shard.load(self.dump.read_bytes())

    def advance(self, offset, batch, before):
        """Process a batch of the log; `before` is the previous call, which keeps the order."""
        if self.shard.offset < offset + len(batch):
            table = self.shard.step(offset, batch).to_arrow()
            pq.write_table(table, self.estimates.format(offset))  # equal at each attempt
            write_bytes(self.dump, self.shard.dump(), sync=True)  # atomic, and last
        return self.shard.offset


def main(folder):
    """Submit the batches of two shards in the order of the log."""
    shards = {name: LiveShard.remote(folder, name) for name in ("north", "south")}
    tails = dict.fromkeys(shards)
    for k in range(BATCHES):
        z = np.exp(-0.4 * k) + 0.01 * np.random.default_rng(k).standard_normal((RODS, 2))
        for name, tail in tails.items():
            batch = [(f"{name}{j}", 0.05 * (k + 1), row.tolist()) for j, row in enumerate(z)]
            tails[name] = shards[name].advance.remote(k * RODS, batch, tail)
    return ray.get(list(tails.values()))


if __name__ == "__main__":
    with TemporaryDirectory() as folder, ray.init(num_cpus=2, include_dashboard=False):
        taken = main(Path(folder))
        print(f"{len(taken)} shards of {RODS} rods on 2 workers, samples taken of each: {taken}")
