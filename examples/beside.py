"""A run beside a process from Python: rows from your own source, estimates to your own sink."""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Iterator
from pathlib import Path

from livepde.cases import LiveCase, load
from livepde.cases.new_case import write_template
from livepde.result import Estimate
from livepde.runs import Sink
from livepde.streams import Rows


def measured(path: Path) -> Iterator[dict[str, str]]:
    """Yield rows, column -> value, as a process brings them: now and then something is wrong."""
    with path.open(newline="") as file:
        for k, row in enumerate(csv.DictReader(file)):
            if k % 50 == 7:
                yield {**row, "T_20": "broken"}
            else:
                yield row


class Printer(Sink):
    """Prints every fiftieth estimate."""

    def __init__(self) -> None:
        self.count = 0

    def put(self, estimate: Estimate) -> None:
        """Take one estimate."""
        if self.count % 50 == 0:
            value, std = estimate.parameters["alpha"]
            print(f"t = {estimate.t:6.0f} s: alpha = {value:.3g} ± {std:.1g} m^2/s")
        self.count += 1

    def close(self) -> None:
        """Let go of what it holds: nothing."""


def main() -> dict[str, tuple[float, float]]:
    """Run the case of `livepde init`, and say what was irregular."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case, data = write_template(folder)
        # A journal that is there already is gone on with, also after a crash.
        with LiveCase(load(case), Rows(measured(data)), path=folder / "journal.sqlite") as wiring:
            live = wiring.live([Printer()])
            live.run()
            for (kind, channel), number in live.journal.counts.items():
                print(f"{kind} {channel}: {number}")
            return live.result.last.parameters


if __name__ == "__main__":
    main()
