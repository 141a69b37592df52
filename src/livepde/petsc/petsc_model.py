"""The process on PETSc vectors: the protocol that a finite-element package implements."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from livepde.errors import ConfigurationError
from livepde.linalg import IntArray

MISSING = (
    "livepde.petsc needs petsc4py, mpi4py and, for UFL, DOLFINx; deploy/petsc.sh sets up an "
    "environment with Debian's packages: see docs/parallel.md."
)


def petsc_module(name: str = "petsc4py.PETSc") -> Any:
    """Return a module, by default that of PETSc, which starts MPI; raises `ConfigurationError`."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ConfigurationError(MISSING) from error


@runtime_checkable
class PetscModel(Protocol):
    """A process M u' + F(u, q, t) = 0 on PETSc vectors and matrices.

    F holds all terms without a time derivative, B(u) + A(u) q - f in the letters of the paper, as a
    dual vector of X. u in X has n coefficients and q in Q has m; both are vectors of type
    "standard", of which every rank owns a part. An action is the product with a matrix (`mult`),
    its transpose `multTranspose`: a matrix may be a shell, except where "assembled" is said. A
    matrix belongs to the model, and holds until the same method is called again.

    `w` in the methods below is data of the state on the observed subdomain omega, shape (n,): there
    F sees w, and u elsewhere, as the paper splits its integrals. Without w, F sees u everywhere.
    Coefficients with Dirichlet values need no treatment in F, its derivatives and the matrices: the
    laws eliminate the rows and columns `fixed`.

    Attributes
    ----------
    mass
        M, assembled, shape (n, n); symmetric positive definite.
    gram, mass_q
        G_Q, the inner product of Q, assembled, and that of L2, for modes; shape (m, m).
    sensors
        G of point sensors or averages, shape (sensors, n).
    mass_observed, pull
        Integrals over omega: M, and M_op of (MN1), assembled, shape (n, n).
    push
        N_op of (MN2), integrated over the rest, assembled, shape (n, n); None: omega is everything.
    fixed
        Global numbers of owned coefficients of u with Dirichlet values.
    linear
        True if F is affine in u: one Newton update solves an implicit step.
    symmetric
        True if M/h + dF/du is symmetric positive definite: conjugate gradients serve.
    """

    mass: Any
    gram: Any
    mass_q: Any
    sensors: Any
    mass_observed: Any
    pull: Any
    push: Any
    fixed: IntArray
    linear: bool
    symmetric: bool

    @property
    def numbers_u(self) -> IntArray:
        """Number of each owned coefficient of u in an order that no number of ranks changes."""
        ...

    @property
    def numbers_q(self) -> IntArray:
        """The same for q."""
        ...

    def impose(self, u: Any, t: float) -> None:
        """Set the Dirichlet values of a time in u."""
        ...

    def residual(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return F(u, q, t), a new dual vector, shape (n,)."""
        ...

    def jacobian_u(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return dF/du, assembled, shape (n, n); None: zero, as for w with all of u observed."""
        ...

    def jacobian_q(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return dF/dq, shape (n, m); assembled if a `PetscObserver` uses it."""
        ...

    def coupling(self, w: Any, q: Any, t: float) -> Any:
        """Return A(w), the derivative of F in q integrated over omega, assembled, shape (n, m).

        With all of u observed it is `jacobian_q` at w.
        """
        ...
