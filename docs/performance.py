"""Write docs/performance/costs.md, with: python docs/performance.py [jobs step ...].

This runs benchmarks, stores their JSON output in docs/performance/, and writes the page and its
figures from all files there. `--draw` runs no benchmark, so that files of longer runs can be added
by hand: `python -m benchmarks step --size 1000000 --json > docs/performance/step-1e6.json`. If
several files contain the same row, the page shows that of the last file by name.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from livepde.plots import PALETTE, figure
from livepde.runs import Check, Table
from livepde.runs.directory import markdown

DOCS = Path(__file__).resolve().parent
MEASURED = DOCS / "performance"
PROJECT = DOCS.parent
SUITE = "benchmarks.suite.costs"
BENCHES = ("jobs", "step", "memory", "scale", "petsc", "fleet", "import")
SIZED = ("step", "scale")  # benchmarks with the option --size
MEMORY_SIZES = (10_000, 40_000)
LAWS = ("gradient", "sensitivity")
KEYS = (
    "nodes",
    "unknowns",
    "ends",
    "dimension",
    "law",
    "c1",
    "gain",
)  # leading columns that identify a row of a table
PER_UNKNOWN = "kB per unknown"  # columns whose name contains this are drawn as memory
MARKERS = "osD^vP*X"

Row = Mapping[str, Any]

PAGE = """\
# Measured costs

Written by `python docs/performance.py` from `docs/performance/*.json`; each section names its
command and the commit that was measured. [Performance and comparison](../performance.md) explains
the columns. A check that fails is marked `FAILED`.
"""
STEP = """\
![One step over one forward step](step.png)

*Solid: median. Dashed, in the same colour: bound.*
"""
MEMORY = """\
![Memory per state unknown](memory.png)

*Memory that an identification adds to a process that has imported livepde, the forward model
included, per state unknown.*
"""


def measure(names: Iterable[str], sizes: Sequence[int]) -> None:
    """Run benchmarks, and store their output."""
    MEASURED.mkdir(exist_ok=True)
    for name in names:
        sys.stderr.write(f"measures: {name}\n")
        if name == "memory":
            content = _memory(sizes or MEMORY_SIZES)
        else:
            chosen = [word for size in sizes for word in ("--size", str(size))]
            command = [name, *(chosen if name in SIZED else []), "--json"]
            content = printed(command)
        keep(MEASURED / f"{name}.json", content)


def keep(path: Path, content: Mapping[str, Any]) -> None:
    """Write the output of a benchmark, with the commit."""
    path.write_text(json.dumps({"commit": commit(), **content}, indent=1) + "\n")


def commit() -> str:
    """Return the short name of the present commit."""
    command = ["git", "rev-parse", "--short=8", "HEAD"]
    done = subprocess.run(command, cwd=PROJECT, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.strip()


def measured(content: Mapping[str, Any]) -> str:
    """Return the commands and commits of an output as Markdown."""
    commands = content.get("commands") or [content["command"]]
    commits = content.get("commits") or [content["commit"]]
    return "\n".join(["```sh", *commands, "```", "", f"Recorded at commit {', '.join(commits)}."])


def printed(command: Sequence[str]) -> dict[str, Any]:
    """Return the output of a benchmark, whether its checks pass or not."""
    words = [sys.executable, "-m", "benchmarks", *command]
    done = subprocess.run(words, cwd=PROJECT, stdout=subprocess.PIPE, text=True, check=False)
    try:
        found: dict[str, Any] = json.loads(done.stdout)
    except json.JSONDecodeError:
        raise SystemExit(f"python -m benchmarks {' '.join(command)} has printed no JSON") from None
    return found


def _memory(sizes: Sequence[int]) -> dict[str, Any]:
    rows = []
    for size in sizes:
        for law in LAWS:
            command = [sys.executable, "-m", SUITE, str(size), law]
            done = subprocess.run(
                command, cwd=PROJECT, stdout=subprocess.PIPE, text=True, check=True
            )
            rows.append([size, law, float(done.stdout)])
    table = Table("Memory of an identification", ("nodes", "law", PER_UNKNOWN), rows)
    command = f"python -m {SUITE} NODES LAW"
    return {"command": command, "checks": [], "tables": [table.to_dict()], "notes": []}


def merged(contents: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge outputs of one benchmark; later rows replace earlier rows with the same keys."""
    commands: list[str] = []
    commits: list[str] = []
    tables: dict[str, dict[str, Any]] = {}
    checks: dict[str, Any] = {}
    notes: dict[str, None] = {}
    for content in contents:
        commands.append(content["command"])
        commits.append(content["commit"])
        checks |= {item["name"]: item for item in content["checks"]}
        notes |= dict.fromkeys(content["notes"])
        for table in content["tables"]:
            into = tables.setdefault(table["title"], {**table, "rows": {}})
            keys = max(1, sum(name in KEYS for name in table["columns"]))
            into["rows"] |= {tuple(row[:keys]): row for row in table["rows"]}
    for table in tables.values():
        table["rows"] = list(table["rows"].values())
    return {
        "commands": list(dict.fromkeys(commands)),
        "commits": list(dict.fromkeys(commits)),
        "tables": list(tables.values()),
        "checks": list(checks.values()),
        "notes": list(notes),
    }


def rows_of(content: Mapping[str, Any]) -> list[Row]:
    """Return the rows that have a number of nodes, as dictionaries, sorted by it."""
    rows = [
        dict(zip(table["columns"], row, strict=True))
        for table in content["tables"]
        for row in table["rows"]
    ]
    return sorted((row for row in rows if "nodes" in row), key=lambda row: row["nodes"])


def costs(rows: Sequence[Row]) -> Figure:
    """Draw ratios against nodes, with a panel for each law and a line for each setting."""
    drawn, panels = figure(1, len(LAWS))
    for ax, law in zip(panels, LAWS, strict=True):
        settings = dict.fromkeys(row["law"] for row in rows if row["law"].startswith(law))
        for k, setting in enumerate(settings):
            mine = [row for row in rows if row["law"] == setting]
            nodes, colour = [row["nodes"] for row in mine], PALETTE[k % len(PALETTE)]
            style = {"color": colour, "marker": MARKERS[k % len(MARKERS)]}
            label = setting.removeprefix(f"{law}, ")
            ax.plot(nodes, [row["median"] for row in mine], label=label, **style)
            bounds = [(row["nodes"], row["bound"]) for row in mine if row["bound"] is not None]
            if bounds:
                ax.plot(*zip(*bounds, strict=True), "--", color=colour, marker="_", ms=14)
        _finished(ax, f"{law} law", "step over forward step")
    return drawn


def memory(lines: Mapping[str, Sequence[tuple[float, float]]]) -> Figure:
    """Draw memory per unknown against nodes."""
    drawn, (ax,) = figure()
    for k, (label, points) in enumerate(lines.items()):
        style = {"color": PALETTE[k % len(PALETTE)], "marker": MARKERS[k % len(MARKERS)]}
        ax.plot(*zip(*points, strict=True), label=label, **style)
    _finished(ax, "memory", PER_UNKNOWN)
    return drawn


def memory_lines(contents: Mapping[str, Mapping[str, Any]]) -> dict[str, list[tuple[float, float]]]:
    """Return label -> (nodes, memory per unknown) from all benchmarks that measure memory."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for name, content in contents.items():
        for row in rows_of(content):
            for column, value in row.items():
                if PER_UNKNOWN in column and value is not None:
                    label = str(row.get("law", name))
                    lines.setdefault(label, []).append((row["nodes"], value))
    return lines


def _finished(ax: Axes, title: str, what: str) -> None:
    ax.set(xscale="log", title=title, xlabel="nodes", ylabel=what)
    ax.set_ylim(bottom=0.0)
    ax.grid(True, alpha=0.3, linewidth=0.6, which="both")
    ax.spines[["top", "right"]].set_visible(False)
    if ax.lines:
        ax.legend(fontsize="small", frameon=False)


def report(title: str, content: Mapping[str, Any]) -> str:
    """Return the JSON output of a command as a report in Markdown."""
    shown = [Table(item["title"], item["columns"], item["rows"]) for item in content["tables"]]
    checks = [
        Check(
            item["name"],
            float("nan") if item["value"] is None else item["value"],
            tuple(item["bound"]) if isinstance(item["bound"], list) else item["bound"],
            item["sense"],
        )
        for item in content["checks"]
    ]
    return markdown(title, shown, checks, content["notes"])


def section(name: str, content: Mapping[str, Any]) -> str:
    """Return the section of the page for a benchmark."""
    title = f"python -m benchmarks {name}" if name != "memory" else "Memory"
    text = report(title, content)
    lines = [f"#{line}" if line.startswith("#") else line for line in text.splitlines()]
    return "\n".join([lines[0], "", measured(content), *lines[1:]]) + "\n"


def write(folder: Path = DOCS) -> None:
    """Write the page and its figures from the stored outputs."""
    contents: dict[str, dict[str, Any]] = {}
    for name in BENCHES:
        files = [folder / "performance" / f"{name}.json"]
        files += sorted((folder / "performance").glob(f"{name}-*.json"))
        found = [json.loads(path.read_text()) for path in files if path.exists()]
        if found:
            contents[name] = merged(found)
    figures = []
    if "step" in contents:
        costs(rows_of(contents["step"])).savefig(folder / "performance" / "step.png", dpi=120)
        figures.append(STEP)
    lines = memory_lines(contents)
    if lines:
        memory(lines).savefig(folder / "performance" / "memory.png", dpi=120)
        figures.append(MEMORY)
    sections = {name: section(name, content) for name, content in contents.items()}
    jobs = [sections.pop("jobs")] if "jobs" in sections else []
    parts = [PAGE, *jobs, *figures, *sections.values()]
    (folder / "performance" / "costs.md").write_text("\n".join(parts))


def main() -> None:
    """Run benchmarks, and write the page."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("names", nargs="*", help=f"of {', '.join(BENCHES)}; default all")
    options.add_argument("--size", type=int, action="append", default=[], help="nodes; repeat it")
    options.add_argument("--draw", action="store_true", help="run no benchmark")
    given = options.parse_args()
    unknown = [name for name in given.names if name not in BENCHES]
    if unknown:
        options.error(f"there is no benchmark '{unknown[0]}'; there are {', '.join(BENCHES)}")
    if not given.draw:
        measure(given.names or BENCHES, given.size)
    write()


if __name__ == "__main__":
    main()
