"""The coupled stage on many ranks, as rank 0 sees it: Newton here, the equation everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from livepde.fem import FieldBlock, Moment
from livepde.laws.schur import LARGE
from livepde.linalg import Array, BandedSolver, Pattern, analyse, in_use
from livepde.parallel import PetscEngine
from livepde.parallel.shares import SharedModel
from livepde.parallel.stage import SharedEquation, SharedJacobian, SharedStage, Weights
from livepde.parallel.team import Handle

if TYPE_CHECKING:
    from livepde.laws.coupled import CoupledStage

__all__ = ["Distributed", "distributed"]


@dataclass(frozen=True, eq=False)
class Distributed:
    """A stage that all ranks share, and how vectors are cut for them."""

    stage: Handle
    model: SharedModel

    def reached(self, u: Array, q: Array) -> list[Array]:
        """Return what each rank needs of vectors of the state and of the parameter."""
        pairs = zip(self.model.u.reaches, self.model.q.reaches, strict=True)
        return [np.concatenate([u[a], q[b]]) for a, b in pairs]

    def rows(self, *parts: tuple[Array, Any]) -> list[Array]:
        """Return the rows of each rank of several vectors, each with its share."""
        cut = [np.split(values[share.order], _ends(share.sizes)) for values, share in parts]
        return [np.concatenate(pieces) for pieces in zip(*cut, strict=True)]

    def whole(self, pieces: list[Array], *shares: Any) -> list[Array]:
        """Return vectors from the rows of each rank: the inverse of `rows`."""
        found = [np.empty(share.dim) for share in shares]
        sizes = np.array([share.sizes for share in shares])
        for rank, piece in enumerate(pieces):
            parts = np.split(piece, np.cumsum(sizes[:, rank])[:-1])
            for values, share, part in zip(found, shares, parts, strict=True):
                start = int(share.sizes[:rank].sum())
                values[share.order[start : start + len(part)]] = part
        return found

    def equation(
        self, c: Array, h: float, moment: Moment, u_alpha: Array, source: Array
    ) -> DistributedEquation:
        """Return one stage's equation."""
        u, q = self.model.u, self.model.q
        c_u, c_q = c[: u.dim], c[u.dim :]
        own = self.rows((source, u))
        known = [
            np.concatenate([c_u[a], u_alpha[a], c_q[b], f])
            for a, b, f in zip(u.reaches, q.reaches, own, strict=True)
        ]
        sent = (self.stage.key, h, moment.t, dict(moment.inputs))
        handle = self.stage.team.share(SharedEquation, *sent, here=(known,))
        return DistributedEquation(self, handle)


@dataclass(frozen=True, eq=False)
class DistributedEquation:
    """Residual and Jacobian of one stage."""

    shared: Distributed
    handle: Handle

    def residual(self, u: Array, q: Array) -> list[Array]:
        """Return the first line without its damping, R^T M_op r, R^T M r, and the second line."""
        at = self.shared
        pieces = self.handle("residual", here=(at.reached(u, q),))
        return at.whole(pieces, at.model.u, at.model.u, at.model.u, at.model.q)

    def jacobian(self, theta: float, sweep: bool, column: Array, row: Array) -> DistributedFactor:
        """Return the Jacobian at the point of the last residual, column row^T added to S."""
        at, u = self.shared, self.shared.model.u
        border = at.rows((column, u), (row, u))
        sent = (self.handle.key, theta, sweep)
        return DistributedFactor(at, at.stage.team.share(SharedJacobian, *sent, here=(border,)))


@dataclass(frozen=True, eq=False)
class DistributedFactor:
    """The Jacobian, as a `Factor`: GMRES on all ranks."""

    shared: Distributed
    handle: Handle

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`."""
        at, u, q = self.shared, self.shared.model.u, self.shared.model.q
        pieces = at.rows((b[: u.dim], u), (b[u.dim :], q))
        return np.concatenate(at.whole(self.handle("solve", here=(pieces,)), u, q))


def distributed(stage: CoupledStage) -> Distributed | None:
    """Return a stage as all ranks share it; None where rank 0 keeps it for itself.

    It is shared where it is large and no band is narrow, an engine of several ranks is in use that
    has been told how to build the model, sensors see coefficients (R is diagonal), the unknowns are
    fields that do not move by themselves, and the gain is a number.
    """
    engine, model, R = in_use(), stage.model, stage.split.R
    if not isinstance(engine, PetscEngine) or stage.size < LARGE:
        return None
    fields = all(isinstance(b, FieldBlock) for b in model.parameter_space.blocks.values())
    selects = R.nnz == np.count_nonzero(R.diagonal())
    plain = model.latent.dim == model.parameter_space.dim and not model.latent.generator.nnz
    if not (fields and selects and plain and not stage.auxiliary and np.isfinite(stage.gains.gain)):
        return None
    shared = engine.shared(model)
    narrow = isinstance(analyse(Pattern.of(model.mass), symmetric=True), BandedSolver)
    if shared is None or narrow:
        return None
    g, known = stage.gains, shared.local
    rows = [
        (
            *(sp.csr_array(K[u]) for K in (model.mass, stage.RM, stage.PNP)),
            sp.csr_array(stage.gram[q]),
        )
        for u, q in zip(_members(known.u), _members(known.q), strict=True)
    ]
    weights = Weights(g.gain, g.nu, g.sigma, g.at_estimate)
    sent = (shared.key, weights, R.diagonal(), model.X.free, stage.free_q)
    return Distributed(engine.team.share(SharedStage, *sent, here=(rows,)), known)


def _ends(sizes: Any) -> Any:
    return np.cumsum(sizes)[:-1]


def _members(share: Any) -> list[Any]:
    return np.split(share.order, _ends(share.sizes))
