"""Excessive cases: each is refused with one sentence, in short time and with little memory."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.faults.plan import Plan
from benchmarks.faults.rod import case_text
from livepde.runs import Check, Outcome, Table

SOONEST = 2.0  # limit of processor seconds, which exclude other programs
MEMORY = 500e6  # limit in bytes
PATIENCE = 60.0  # seconds after which a command is killed

_DATA = 'file = "rows.csv"'
_PRIOR = 'prior = "3e-5 m^2/s"'
_MESH = '[mesh]\nfrom = "0 m"\nto = "1 m"\ncells = 20\n'
_COLUMN = 'column = "T_3", at = "0.3 m", unit = "degC"'
_T_3 = 'at = "0.3 m", unit = "degC"'


def _nested(count: int) -> tuple[str, str]:
    return "[output]", "a" + ".a" * count + " = 1\n[output]"


# Name -> text in the case of the rod, and its replacement.
HOSTILE: Mapping[str, tuple[str, str]] = {
    "unit, powers of powers": (_PRIOR, 'prior = "3e-5 m^9^9^9^9"'),
    "unit, number of powers": (_PRIOR, 'prior = "9**9**9**9 m^2/s"'),
    "unit, powers of groups": (_PRIOR, 'prior = "1 (((m^99)^99)^99)^99"'),
    "unit, 20 000 factors": (_PRIOR, f'prior = "1 {"*".join(["m"] * 20_000)}"'),
    "unit, 20 000 brackets": (_PRIOR, f'prior = "1 {"(" * 20_000}m{")" * 20_000}"'),
    "unit, long number": (_PRIOR, f'prior = "1 {"9" * 50_000} m"'),
    "unit of a channel": (_T_3, 'at = "0.3 m", unit = "K^9^9^9^9"'),
    "dotted key of 50 000 parts": _nested(50_000),
    "dotted key of 1000 parts": _nested(1000),
    "dotted key with spaces": ("[output]", "a" + " . a" * 50_000 + " = 1\n[output]"),
    "table of 50 000 parts": ("[output]", "[a" + ".a" * 50_000 + "]\n[output]"),
    "lists in lists": ("[output]", "a = " + "[" * 50_000 + "]" * 50_000 + "\n[output]"),
    "tables in tables": ("[output]", "a = " + "{a = " * 50_000 + "1" + "}" * 50_000 + "\n[output]"),
    "lists 100 deep": ("[output]", "a = " + "[" * 100 + "]" * 100 + "\n[output]"),
    "5e7 cells": ("cells = 20", "cells = 50_000_000"),
    "1e12 cells": ("cells = 20", "cells = 1_000_000_000_000"),
    "1e5 x 1e5 cells": (
        _MESH,
        '[mesh]\nx = ["0 m", "1 m"]\ny = ["0 m", "1 m"]\ncells = [100_000, 100_000]\n',
    ),
    "cells of 1e5 digits": ("cells = 20", f"cells = {'9' * 100_000}"),
    "cells of 3e5 bits": ("cells = 20", f"cells = 0x{'f' * 80_000}"),
    "each with 1e9": (
        _COLUMN,
        'column = "T_{}", each = ["0.1 m", "0.9 m", 1_000_000_000], unit = "degC"',
    ),
    "each with 1e6": (
        _COLUMN,
        'column = "T_{}", each = ["0.1 m", "0.9 m", 1_000_000], unit = "degC"',
    ),
    "fields_every of 1e5 digits": ("fields_every = 20", f"fields_every = {'9' * 100_000}"),
    "std 1e300": ('std = "1e-5 m^2/s"', 'std = "1e300 m^2/s"'),
    "std 1e-300": ('std = "1e-5 m^2/s"', 'std = "1e-300 m^2/s"'),
    "std 1e300 as a number": ('std = "1e-5 m^2/s"', "std = 1e300"),
    "std of 1e5 digits": ('std = "1e-5 m^2/s"', f'std = "{"9" * 100_000} m^2/s"'),
    "prior 1e308": (_PRIOR, "prior = 1e308"),
    "noise 1e-300": ('noise = "0.2 K"', 'noise = "1e-300 K"'),
    "1e9 harmonics": (
        _PRIOR,
        _PRIOR + '\nevolution = { period = "1 d", harmonics = 1_000_000_000 }',
    ),
    "1e9 modes": ('noise = "0.2 K"', 'noise = "0.2 K"\nmodes = 1_000_000_000'),
    "window 1e9": ('noise = "0.2 K"', 'noise = "0.2 K"\nrefit = { window = 1_000_000_000 }'),
    "%d twice": ('time = "time"', 'time = "time"\ntime_format = "%d.%d.%Y %H:%M"'),
    "time_format of 1e5 letters": (
        'time = "time"',
        f'time = "time"\ntime_format = "{"%d.%m.%Y " * 10_000}"',
    ),
    "not UTF-8": ('title = "', 'title = "\udcff'),
    "a zone that is a path": ('time = "time"', 'time = "time"\nzone = "../../etc/passwd"'),
    "a long title for a number": ("cells = 20", f'cells = "{"x" * 500_000}"'),
    "a text of a megabyte": ("[output]", "#" * 1_000_001 + "\n[output]"),
    "a key of a megabyte": ("[output]", "a" * 900_000 + " = 1\n[output]"),
    "names without end": ("[output]", "".join(f"b{k} = 1\n" for k in range(50_000)) + "[output]"),
}


def hostile_case(folder: Path, name: str) -> Path:
    """Write the case of the rod with a hostile replacement; '' writes the valid case."""
    text = case_text(_DATA)
    if name:
        old, new = HOSTILE[name]
        if old not in text:
            raise LookupError(f"{name}: the case has no {old!r}")
        if new.endswith("[output]") and "." not in old:
            # Keys before `[output]` would be part of the table above, so they go to the top.
            text = new.removesuffix("[output]") + text
        else:
            text = text.replace(old, new, 1)
    path = folder / f"{[*HOSTILE, ''].index(name)}.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    return path


def hostile_cases(plan: Plan) -> Outcome:
    """Run `livepde check` on each hostile case, one process per case."""
    rows, worst = [], {"time": 0.0, "memory": 0.0}
    wrong = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        empty = _checked(hostile_case(folder, ""))
        for case in HOSTILE:
            code, text, seconds, memory = _checked(hostile_case(folder, case))
            if code != 2 or "Traceback" in text or text.strip().count("\n"):
                wrong.append(case)
            worst["time"] = max(worst["time"], seconds)
            worst["memory"] = max(worst["memory"], memory)
            rows.append((case, round(seconds, 2), round(memory / 1e6), text.strip()[:100]))
    title = f"Hostile cases; the right one takes {empty[2]:.2f} s and {empty[3] / 1e6:.0f} MB"
    return Outcome(
        tables=[Table(title, ("case", "s", "MB", "answer"), rows)],
        checks=[
            Check("hostile cases without one sentence", len(wrong), 0, "<="),
            Check("hostile cases: longest answer (s)", worst["time"], SOONEST, "<="),
            Check("hostile cases: most memory (bytes)", worst["memory"], MEMORY, "<="),
        ],
        notes=[f"No sentence: {case}" for case in wrong],
    )


def _checked(path: Path) -> tuple[int, str, float, float]:
    """Return exit code, error output, processor seconds and memory of `livepde check`."""
    code = (
        "import resource, sys, atexit\n"
        "from livepde.cli import main\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "spent = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])\n"
        "atexit.register(lambda: sys.stdout.write(f'\\npeak {peak()} {spent()}'))\n"
        "sys.argv = ['livepde', 'check', sys.argv[1]]\n"
        "sys.exit(main())\n"
    )
    try:
        found = subprocess.run(
            [sys.executable, "-c", code, str(path)],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    except subprocess.TimeoutExpired:
        return -1, "no answer", PATIENCE, 0.0
    peak, seconds = map(float, found.stdout.rpartition("peak ")[2].split())
    unit = 1 if sys.platform == "darwin" else 1024
    return found.returncode, found.stderr, seconds, peak * unit
