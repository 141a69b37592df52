"""Write docs/peers/results.md, with: python docs/peers.py [rod heat2d ...].

Runs `python -m benchmarks peers` for each problem, stores its JSON in docs/peers/, and writes the
page from all files there. `--draw` measures nothing, so that a file can also be added by hand, such
as with `python -m benchmarks peers --only rod --seeds 16 --json > docs/peers/rod.json`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from performance import keep, measured, printed, report

DOCS = Path(__file__).resolve().parent
MEASURED = DOCS / "peers"
PROBLEMS = ("rod", "rod-source", "seed", "seed-excited", "heat2d", "burgers-varying", "wall")
SEEDS: Mapping[str, int] = {"rod": 16, "rod-source": 16}
FEW = 4  # seeds of the other problems

PAGE = """\
# Comparison with peers: results

Written by `python docs/peers.py` from `docs/peers/*.json`; each section names its command and the
commit that was measured. [Performance and comparison](../performance.md#comparison-with-peers)
explains the rows and columns.
"""


def measure(names: Iterable[str]) -> None:
    """Run the benchmark on each problem, and store its JSON output."""
    MEASURED.mkdir(exist_ok=True)
    for name in names:
        seeds = str(SEEDS.get(name, FEW))
        content = printed(["peers", "--only", name, "--seeds", seeds, "--json"])
        keep(MEASURED / f"{name}.json", content)


def section(name: str, content: Mapping[str, Any]) -> str:
    """Format the stored output of a problem as a section of the page."""
    text = report(name, {**content, "notes": []})
    lines = [f"#{line}" if line.startswith("#") else line for line in text.splitlines()]
    return "\n".join([lines[0], "", measured(content), *lines[1:]]) + "\n"


def write(folder: Path = DOCS) -> None:
    """Write the page from the stored measurements."""
    files = [folder / "peers" / f"{name}.json" for name in PROBLEMS]
    stored = {path.stem: json.loads(path.read_text()) for path in files if path.exists()}
    parts = [PAGE, *(section(name, content) for name, content in stored.items())]
    (folder / "peers" / "results.md").write_text("\n".join(parts))


def main() -> None:
    """Measure the chosen problems, and write the page."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("names", nargs="*", help=f"of {', '.join(PROBLEMS)}; default all")
    options.add_argument("--draw", action="store_true", help="measure nothing")
    given = options.parse_args()
    unknown = [name for name in given.names if name not in PROBLEMS]
    if unknown:
        options.error(f"there is no problem '{unknown[0]}'; there are {', '.join(PROBLEMS)}")
    if not given.draw:
        measure(given.names or PROBLEMS)
    write()


if __name__ == "__main__":
    main()
