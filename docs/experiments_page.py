"""Write docs/gallery/experiments.md, with: python docs/experiments_page.py [NAME ...].

Runs the experiments of `livepde reproduce`, the studies and scripts of experiments/, `python -m
benchmarks control`, and the programs of examples/. NAME is an experiment or the stem of a file.
Without names all of them run, which takes hours. Their output and figures are stored in
docs/gallery/experiments/. The page shows everything stored there, with the commit of each run.
`--draw` writes the page without running anything. Cases read their data from $LIVEPDE_DATA.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent

from matplotlib.figure import Figure
from performance import commit, printed, report
from PIL import Image

from livepde.plots import PALETTE, figure
from livepde.reproduce import EXPERIMENTS

PROJECT = Path(__file__).resolve().parents[1]
PAGE = PROJECT / "docs" / "gallery" / "experiments.md"
KEPT = PAGE.with_suffix("")
COMMITS = KEPT / "commits.json"  # name -> commit of its last run
WIDEST, COLOURS = 1100, 48  # pixels and colours of a figure
LONGEST = 45  # lines of a script's output that the page shows
OPTIONS = {
    "control": ["--only", "rod", "--only", "battery", "--seeds", "1"],
}  # options that save hours

HEAD = """\
# Gallery: experiments

Experiments of the paper, studies that follow from it, and scripts that need the truth or hindsight.
Each one has its command, its figure, its table and the commit at which it was recorded. Written by
`python docs/experiments_page.py`. Cases on published data are in the [gallery](gallery.md).
"""
COMMANDS = {  # experiment that draws figures and checks its numbers -> program that runs it
    **dict.fromkeys(EXPERIMENTS, "livepde reproduce"),
    **dict.fromkeys(
        ("seed-excited-noise", "degenerate", "dimensions", "relatives", "exact"),
        "python -m experiments",
    ),
    "control": "python -m benchmarks",
}
PARTS = {
    "reproduce": "Published experiments; commands and tests check their bounds.",
    "studies": "What follows from the paper; commands and tests check their bounds.",
    "benchmarks": "Comparisons with other methods; commands check their bounds.",
    "scripts": "They use the truth or hindsight. A dot is a number of the table below.",
    "examples": "Programs to start from.",
}


@dataclass(frozen=True)
class Sketch:
    """Pattern that turns the table printed by a script into a figure with one row of dots per line.

    Attributes
    ----------
    row
        Pattern of a table line. Its groups are `label` and the numbers, named as in the legend; a
        group `NAME_std` is the standard deviation of NAME.
    heading
        Pattern of a heading; its group is put before the labels of the lines that follow.
    scale
        Scale of the axis.
    last
        If True, only the last paragraph is shown and drawn; the text before it is single runs.
    """

    row: str
    heading: str = "(?!)"  # never
    scale: str = "log"
    last: bool = False


NUMBER = r"[-+]?[\d.]+(?:e[-+]?\d+)?"
SKETCHES = {
    "jumps": Sketch(
        rf"^│ (?P<label>.+?) +│ (?P<error_before_the_jump>{NUMBER}) +│ \S+ +"
        rf"│ (?P<error_at_the_end>{NUMBER})"
    ),
    "oracle": Sketch(
        rf"^(?P<label>\S.+?)  +(?P<error_of_q>{NUMBER}) +(?P<energy_end_over_start>{NUMBER}) +\S+$",
        heading=r"(noise \d+%)",
    ),
    "stopping": Sketch(
        rf"^ *(?P<label>\S+ +\S+ +\S+ +\S+) +(?P<T>{NUMBER}) +(?P<surrogate>{NUMBER}) +\S"
    ),
    "hindsight": Sketch(
        rf"^ +(?P<label>{NUMBER}) +{NUMBER} +(?P<error_of_q>{NUMBER})(?:   <- least)?$",
        heading=r"^partial exact data, (gain \d+)",
    ),
    "scratch": Sketch(rf"^(?P<label>\d+ 000 .+?) +(?P<D>0\.0\d+) +(?P<r>{NUMBER}) +{NUMBER}$"),
    "batch": Sketch(rf"^(?P<label>\d+ cm) +(?P<D>{NUMBER}) +(?P<v>{NUMBER}).* (?P<left>{NUMBER})$"),
    "borehole": Sketch(
        rf"^(?P<label>\S.+?)  +(?P<k>{NUMBER}) ± (?P<k_std>{NUMBER}) .* "
        rf"(?P<k_after_10_h>{NUMBER}) ± (?P<k_after_10_h_std>{NUMBER})  ",
        scale="linear",
    ),
    "auto_gain": Sketch(
        rf"^(?P<label>\S+ +\d+%) +(?P<auto>{NUMBER}) +(?P<best_of_grid>{NUMBER}) ", last=True
    ),
    "outside": Sketch(
        r"^(?P<label>\S.+?) +(?P<error_in_omega>\d+\.\d{3}) *(?P<error_outside>\d+\.\d{3}) ",
        heading=r"^(reaction|rod), ",
    ),
}


def shown(name: str, text: str) -> str:
    """Return the lines of a script's output that the page shows."""
    text = text.strip("\n")
    if name in SKETCHES and SKETCHES[name].last:
        text = text.rsplit("\n\n", 1)[-1]
    rows = text.splitlines()
    if len(rows) > LONGEST:
        rows = [*rows[:LONGEST], f"... ({len(rows) - LONGEST} lines more)"]
    return "\n".join(rows)


def drawn(name: str, text: str) -> Figure | None:
    """Draw the table in a script's output; return None if the script has no table."""
    sketch = SKETCHES.get(name)
    rows = list(_rows(sketch, text)) if sketch else []
    if sketch is None or not rows:
        return None
    names = [name for name in rows[0] if name != "label" and not name.endswith("_std")]
    picture, (ax,) = figure()
    picture.set_size_inches(7.0, 1.2 + 0.24 * len(rows))
    for k, what in enumerate(names):
        values = [float(row[what]) for row in rows]
        width = [float(row.get(f"{what}_std") or "nan") for row in rows]
        style = {"color": PALETTE[k], "marker": "osD"[k], "linestyle": "none", "markersize": 5}
        ax.errorbar(values, range(len(rows)), xerr=width, label=what.replace("_", " "), **style)
    ax.set(yticks=range(len(rows)), yticklabels=[row["label"] for row in rows])
    ax.set_xscale(sketch.scale)
    ax.invert_yaxis()
    ax.grid(True, alpha=0.3, linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize="small", frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3)
    return picture


def _rows(sketch: Sketch, text: str) -> Iterator[dict[str, str]]:
    heading = ""
    for line in text.splitlines():
        if (head := re.search(sketch.heading, line)) is not None:
            heading = f"{head[1]}, "
        elif (row := re.search(sketch.row, line)) is not None:
            label = re.sub(r" {2,}", "  ", row["label"])
            yield {**row.groupdict(), "label": heading + label}


def run(name: str) -> None:
    """Run one experiment, script or example, and store its output and figures."""
    sys.stderr.write(f"runs: {name}\n")
    if name == "control":
        with tempfile.TemporaryDirectory() as folder:
            content = printed([name, *OPTIONS[name], "--draw", folder, "--json"])
            keep(name, Path(folder), report(content["command"], content))
        return
    if name in COMMANDS:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            words = [*COMMANDS[name].removeprefix("python -m ").split(), name, "--out", str(out)]
            # No check of the exit code: the report lists the bounds that are missed.
            subprocess.run([sys.executable, "-m", *words], cwd=PROJECT, check=False)
            keep(name, out, (out / "report.md").read_text(encoding="utf-8"))
        return
    command = [sys.executable, *_script_command(scripts()[name])]
    done = subprocess.run(command, cwd=PROJECT, stdout=subprocess.PIPE, text=True, check=True)
    (KEPT / f"{name}.txt").write_text(done.stdout, encoding="utf-8")


def keep(name: str, out: Path, text: str) -> None:
    """Store a report, and the figures of a folder at reduced size."""
    text = re.sub(r"^!\[.*\]\(.*\)$\n?", "", text, flags=re.MULTILINE)
    for path in sorted(out.glob("*.png")):
        small(path, KEPT / f"{name}-{path.name}")
        text += f"\n![{path.stem}]({name}-{path.name})\n"
    (KEPT / f"{name}.txt").write_text(text, encoding="utf-8")


def small(path: Path, target: Path) -> None:
    """Write a copy of a picture with fewer pixels and colours."""
    with Image.open(path) as large:
        picture = large.convert("RGB")
    picture.thumbnail((WIDEST, 10 * WIDEST))
    picture.quantize(COLOURS).save(target, optimize=True)


def scripts() -> dict[str, Path]:
    """Return the files of all scripts and examples by name."""
    return {
        path.stem: path
        for folder in ("experiments", "examples")
        for path in sorted((PROJECT / folder).glob("[!_]*.py"))
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    }


def _script_command(path: Path) -> list[str]:
    """Return the arguments with which Python runs a script or an example."""
    module = ["-m", f"experiments.{path.stem}"]
    where = module if path.parent.name == "experiments" else [f"examples/{path.name}"]
    return [*where, *OPTIONS.get(path.stem, ())]


def page() -> str:
    """Return the page of all stored runs."""
    files = scripts()
    commits = json.loads(COMMITS.read_text(encoding="utf-8"))
    parts = [HEAD]
    for title, words in PARTS.items():
        names = [name for name in (*COMMANDS, *files) if _part(name, files) == title]
        kept = [name for name in names if _kept(name).exists()]
        parts += [f"## {title.capitalize()}\n\n{words}\n"] if kept else []
        for name in kept:
            parts.append(_script(files[name]) if name in files else _report(name))
            parts.append(f"Recorded at commit {commits[name]}.\n")
    return "\n".join(parts)


def _part(name: str, files: dict[str, Path]) -> str:
    """Return the key in `PARTS` of an experiment, script or example."""
    folder = files[name].parent.name if name in files else COMMANDS[name].split()[-1]
    if folder != "experiments":
        return folder
    return "scripts" if name in files else "studies"


def _kept(name: str) -> Path:
    return KEPT / f"{name}.txt"


def _report(name: str) -> str:
    """Return the section of an experiment that stores a report, with its figures first."""
    text = _kept(name).read_text(encoding="utf-8").replace("| None |", "| – |")
    title, rest = text.removeprefix("# ").split("\n", 1)
    pictures = re.findall(r"^!\[.*\]\((.*)\)$\n?", rest, flags=re.MULTILINE)
    rest = re.sub(r"^!\[.*\]\(.*\)$\n?", "", rest, flags=re.MULTILINE)
    shown = [f"![{Path(name).stem}](experiments/{name})" for name in pictures]
    rest = re.sub(r"^## (.*)$", r"**\1**", rest, flags=re.MULTILINE)
    command = " ".join([COMMANDS[name], name, *OPTIONS.get(name, ())])
    lines = [f"### {name}", f"`{command}`", *shown, rest.strip()]
    if title != command:
        lines.insert(1, title)
    return "\n\n".join(lines) + "\n"


def _script(path: Path) -> str:
    """Return the section of a script: its purpose, command, figure and output."""
    about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    printed = _kept(path.stem).read_text(encoding="utf-8")
    lines = [f"### {path.stem}", about.split("\n\n")[0]]
    lines.append(f"`{' '.join(['python', *_script_command(path)])}`")
    if (picture := drawn(path.stem, printed)) is not None:
        target = KEPT / f"{path.stem}.png"
        picture.savefig(target, dpi=120)
        small(target, target)
        lines.append(f"![{path.stem}](experiments/{target.name})")
    lines.append(indent(shown(path.stem, printed), "    "))
    return "\n\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the chosen experiments, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    known = [*COMMANDS, *scripts()]
    parser.add_argument("names", nargs="*", choices=[[], *known], metavar="NAME")
    parser.add_argument("--draw", action="store_true", help="run nothing")
    chosen = parser.parse_args(arguments)
    KEPT.mkdir(exist_ok=True)
    commits = json.loads(COMMITS.read_text(encoding="utf-8"))
    for name in () if chosen.draw else chosen.names or known:
        run(name)
        commits[name] = commit()
        COMMITS.write_text(json.dumps(commits, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
