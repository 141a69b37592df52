"""A live run in Python with rows from your own source and estimates to your own sink."""

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
    """Yield rows, column -> value, as from a live process; some values are malformed."""
    with path.open(newline="") as file:
        for k, row in enumerate(csv.DictReader(file)):
            if k % 50 == 7:
                yield {**row, "T_20": "broken"}
            else:
                yield row


class Printer(Sink):
    """Sink that prints every fiftieth estimate."""

    def __init__(self) -> None:
        self.count = 0

    def put(self, estimate: Estimate) -> None:
        """Process one estimate."""
        if self.count % 50 == 0:
            value, std = estimate.parameters["alpha"]
            print(f"t = {estimate.t:6.0f} s: alpha = {value:.3g} ± {std:.1g} m^2/s")
        self.count += 1

    def close(self) -> None:
        """Release resources; this sink has none."""


def main() -> dict[str, tuple[float, float]]:
    """Run the case of `livepde init`, and print the counts of irregular rows."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case, data = write_template(folder)
        # If the journal exists, the run resumes from it, also after a crash.
        with LiveCase(load(case), Rows(measured(data)), path=folder / "journal.sqlite") as wiring:
            live = wiring.live([Printer()])
            live.run()
            for (kind, channel), number in live.journal.counts.items():
                print(f"{kind} {channel}: {number}")
            return live.result.last.parameters


if __name__ == "__main__":
    main()
