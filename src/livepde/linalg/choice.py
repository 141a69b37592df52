"""Choice of the solver for a sparsity pattern: the only place of this decision.

The criterion is the half bandwidth after reverse Cuthill-McKee ordering: about sqrt(n) in 2D and
n^(2/3) in 3D, twice that for quadratic elements. The dense blocks of a sparse factor have about
this size in any dimension:

    band          2D P1       3D P1       engine
    to 48         2 000         300       banded LU
    to 150       20 000       1 700       SuperLU
    to 500      200 000      11 000       CHOLMOD or Pardiso if installed, else SuperLU
    to 2500   5 000 000     120 000       CHOLMOD or Pardiso if installed, else multigrid
    beyond                                multigrid

Multigrid serves symmetric positive definite matrices only, if PyAMG is installed; others are
factorised at any size, by Pardiso if it is installed. SuperLU, which needs no package, factorises
all matrices; it is slow and needs much memory at large sizes.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from livepde.linalg.banded import BandedSolver
from livepde.linalg.cholmod import CholmodSolver
from livepde.linalg.multigrid import MultigridSolver
from livepde.linalg.pardiso import PardisoSolver
from livepde.linalg.pattern import Pattern
from livepde.linalg.protocol import Solver
from livepde.linalg.superlu import SuperLUSolver

__all__ = ["Choice", "analyse", "choose"]

# Largest half bandwidth of banded LU; the limits are those of the table above.
WIDEST_BAND = 48
# Half bandwidth up to which no installed package is faster than SuperLU.
SMALL = 150
WIDEST_SUPERLU = 500
WIDEST_FACTOR = 2500


@dataclass(frozen=True, eq=False)
class Choice:
    """A solver bound to a pattern, and the reason of its choice."""

    solver: Solver
    reason: str


def analyse(pattern: Pattern, *, symmetric: bool = False, approximate: bool = False) -> Solver:
    """Return the solver for a pattern, as chosen by `choose`."""
    return choose(pattern, symmetric=symmetric, approximate=approximate).solver


def choose(pattern: Pattern, *, symmetric: bool = False, approximate: bool = False) -> Choice:
    """Choose the solver for a pattern by its bandwidth and the installed packages.

    Parameters
    ----------
    pattern
        Sparsity pattern of the matrices.
    symmetric
        True if every matrix is symmetric positive definite.
    approximate
        True if only `approximate_inverse` is needed: then multigrid serves from a bandwidth of 500.
    """
    banded = BandedSolver(pattern)
    band = max(banded.band)
    wide = f"a band of {band}"
    if band <= WIDEST_BAND:
        return Choice(banded, f"{wide}, at most {WIDEST_BAND}")
    superlu = SuperLUSolver(pattern, symmetric)
    if band <= SMALL:
        return Choice(superlu, f"{wide}, at most {SMALL}")
    # One V-cycle is enough for an approximate inverse, so multigrid pays for smaller matrices.
    most = WIDEST_SUPERLU if approximate else WIDEST_FACTOR
    multigrid = symmetric and _installed("pyamg")
    if multigrid and band > most:
        return Choice(MultigridSolver(pattern), f"{wide}, more than {most}")
    if symmetric and _installed("sksparse"):
        return Choice(CholmodSolver(pattern), f"{wide}; scikit-sparse is installed")
    if _installed("pypardiso"):
        return Choice(PardisoSolver(pattern, symmetric), f"{wide}; pypardiso is installed")
    if band <= WIDEST_SUPERLU:
        return Choice(superlu, f"{wide}, at most {WIDEST_SUPERLU}")
    if multigrid:
        return Choice(
            MultigridSolver(pattern),
            f"{wide}, more than {WIDEST_SUPERLU}; neither scikit-sparse nor pypardiso is installed",
        )
    return Choice(
        superlu,
        f"{wide}; slow at this size, pip install 'livepde[solvers]' brings a faster one",
    )


def _installed(module: str) -> bool:
    return find_spec(module) is not None
