"""Commands that run a study and check its numbers."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from benchmarks.commands import Program, chosen
from livepde.cli import main
from livepde.runs import Outcome

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


@program.command(quick="The first families of one and of two dimensions only.")
def dimensions(
    truth: Annotated[
        str, typer.Option(help="Where the data come from: discrete (the same scheme), analytic.")
    ] = "discrete",
    quick: bool = False,
    as_json: bool = False,
) -> Outcome:
    """Run the paper's equation in 1D, 2D and 3D with Q = H^2: orders of convergence.

    Example:  python -m experiments dimensions --truth analytic
    """
    from experiments.dimensions import NOTES
    from experiments.dimensions import dimensions as study

    chosen([truth], NOTES, "truth")
    return study(truth, quick=quick, progress=not as_json)  # type: ignore[arg-type]


@program.command(quick="The data of the paper's example only.")
def relatives(quick: bool = False, as_json: bool = False) -> Outcome:
    """Compare the laws of Boiger and Kaltenbacher, Baumeister et al. and Kügler on the same data.

    Example:  python -m experiments relatives --json
    """
    from experiments.relatives import relatives as study

    return study(quick=quick, progress=not as_json)


@program.command(
    name="seed-excited-noise", quick="One seed of white noise of 1 %, no search in hindsight."
)
def seed_excited_noise(quick: bool = False, as_json: bool = False) -> Outcome:
    """Measure what smoothing in time and space is good for: 1, 5 and 10 % noise, five seeds.

    Example:  python -m experiments seed-excited-noise --quick
    """
    from experiments.seed_excited_noise import seed_excited_noise as study

    return study(quick=quick, progress=not as_json)


@program.command(
    quick="Three settings, two meshes, and the energy of the excited twin.",
)
def exact(quick: bool = False, as_json: bool = False) -> Outcome:
    """Hold the law against an independent implementation of the paper's method, in 31 settings.

    Shows as well what nu does, mesh by mesh, and that the energy never grows.

    Example:  python -m experiments exact --quick
    """
    from experiments.exact import exact as study

    return study(quick=quick, progress=not as_json)


if __name__ == "__main__":
    sys.exit(main(app))
