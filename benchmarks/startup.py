"""Cost of `import livepde` relative to the import of its main dependencies.

Each import is timed in a new process, by the processor time of the statement without the start of
the interpreter. Ratios are computed within a round of consecutive imports, so that other load on
the machine affects both. Bytecode is written beforehand, as pip does for installed packages.
"""

from __future__ import annotations

import subprocess
import sys
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.processes import usual_environment
from livepde.diagnostics.check_report import Check, Table
from livepde.runs import Outcome

BASE = "import scipy.sparse.linalg, skfem"
IMPORT = "import livepde"
NAMES = ("Model", "Identifier", "SensitivityLaw", "Points", "Scalar", "Field")
SCRIPT = "import livepde as lp; " + ", ".join(f"lp.{name}" for name in NAMES)
BOUND = 1.5

_TIMED = """
from time import process_time
begun = process_time()
{}
print(process_time() - begun)
"""


def startup(rounds: int = 15) -> Outcome:
    """Time the import of livepde, without and with the names that a short script uses.

    Parameters
    ----------
    rounds
        Number of new processes for each import.
    """
    codes = (BASE, IMPORT, SCRIPT)
    with TemporaryDirectory() as cache:
        for code in codes:
            _seconds(code, cache)  # writes the bytecode
        times = [[_seconds(code, cache) for code in codes] for _ in range(rounds)]
    rows, checks = [], []
    for k, code in enumerate(codes[1:], start=1):
        low, middle, high = np.quantile([row[k] / row[0] for row in times], (0.0, 0.5, 1.0))
        rows.append((code, low, middle, high))
        checks.append(Check(code, middle, BOUND, "<="))
    table = Table(f"Time over that of: {BASE}", ("code", "min", "median", "max"), rows)
    note = f"Ratios of processor times in {rounds} rounds, each with a new process per import."
    return Outcome(tables=[table], checks=checks, notes=[note])


def _seconds(code: str, cache: str) -> float:
    command = [sys.executable, "-c", _TIMED.format(code)]
    given = usual_environment(cache)
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
    return float(done.stdout)
