"""Choice of the solver for a sparsity pattern: the only place of this decision.

The criterion is the half bandwidth after reverse Cuthill-McKee ordering: about sqrt(n) in 2D and
n^(2/3) in 3D, twice that for quadratic elements. The dense blocks of a sparse factor have about
this size in any dimension:

    band          2D P1       3D P1       engine
    to 48         2 000         300       banded LU
    to 500      200 000      11 000       CHOLMOD if installed, else SuperLU
    to 2500   5 000 000     120 000       CHOLMOD or Pardiso if installed, else multigrid
    beyond                                multigrid

Of CHOLMOD the simplicial factor serves up to 500, the supernodal one beyond. On one thread, for 2D
P1 and 10 201 nodes: CHOLMOD simplicial 12 ms for a factor, 0.3 ms for one column and 1.2 for five;
supernodal 21, 0.8 and 4.2; SuperLU 40, 1.3 and 3.0; Pardiso 9, 6.4 and 13. For 3D P1 and 13 824
nodes: 790, 6.9 and 17; 550, 9.5 and 28; 1220, 14 and 29; 110, 18 and 37. Pardiso is the fastest to
factorise and the slowest to solve with, so it pays where a factor costs many solves.

CHOLMOD serves symmetric positive definite matrices only; others have SuperLU up to a band of 150,
beyond it Pardiso if it is installed. Multigrid serves symmetric positive definite matrices only, if
PyAMG is installed. SuperLU, which needs no package, factorises all matrices; it is slow and needs
much memory at large sizes.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from livepde.linalg.banded import BandedSolver
from livepde.linalg.direct import CholmodSolver, PardisoSolver, Solver, SuperLUSolver
from livepde.linalg.krylov import MultigridSolver
from livepde.linalg.pattern import Pattern

# Largest half bandwidth of banded LU; the limits are those of the table above.
WIDEST_BAND = 48
# Half bandwidth up to which Pardiso is not faster than SuperLU for general matrices.
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
    moderate = band <= WIDEST_SUPERLU
    if symmetric and moderate and _installed("sksparse"):
        return Choice(CholmodSolver(pattern), f"{wide}; scikit-sparse is installed")
    limit = WIDEST_SUPERLU if symmetric else SMALL
    if band <= limit:
        return Choice(superlu, f"{wide}, at most {limit}")
    # One V-cycle is enough for an approximate inverse, so multigrid pays for smaller matrices.
    most = WIDEST_SUPERLU if approximate else WIDEST_FACTOR
    multigrid = symmetric and _installed("pyamg")
    if multigrid and band > most:
        return Choice(MultigridSolver(pattern), f"{wide}, more than {most}")
    if symmetric and _installed("sksparse"):
        return Choice(CholmodSolver(pattern, blocks=True), f"{wide}; scikit-sparse is installed")
    if _installed("pypardiso"):
        return Choice(PardisoSolver(pattern, symmetric), f"{wide}; pypardiso is installed")
    if moderate:
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
