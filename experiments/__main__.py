"""Studies: each a command with the checks of its numbers."""

from __future__ import annotations

import sys

from benchmarks.commands import Program
from livepde.cli import main
from livepde.runs.outcome import Outcome

__all__ = ["app"]

program = Program(
    "python -m experiments",
    """Run a study of the paper's method on processes whose truth is known, and check its numbers.

    The experiments of the paper itself are in the package: livepde reproduce.

    Example:  python -m experiments degenerate""",
    keeps=True,
)
app = program.app


@program.command(quick="D that varies only.")
def degenerate(quick: bool = False, as_json: bool = False) -> Outcome:
    """Run the paper's equation with D that varies, vanishes, or is negative on a part.

    Example:  python -m experiments degenerate --json
    """
    from experiments.degenerate import degenerate as study

    return study(quick=quick, progress=not as_json)


if __name__ == "__main__":
    sys.exit(main(app))
