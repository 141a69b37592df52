"""The coupled stage on many ranks, as rank 0 sees it: Newton here, the equation everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from livepde.fem import FieldBlock
from livepde.laws.equation import Equation
from livepde.laws.schur import LARGE
from livepde.laws.way import Way
from livepde.linalg import Array, BandedSolver, Factor, Pattern, analyse, in_use
from livepde.parallel import PetscEngine
from livepde.parallel.shares import SharedModel
from livepde.parallel.stage import SharedEquation, SharedJacobian, SharedStage, Weights
from livepde.parallel.team import Handle

if TYPE_CHECKING:
    from livepde.laws.coupled import CoupledStage

__all__ = ["Distributed", "DistributedEquation"]


@dataclass(frozen=True, eq=False)
class _DistributedFactor:
    """The Jacobian, as a `Factor`: GMRES on all ranks."""

    way: Distributed
    handle: Handle

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`."""
        way, u, q = self.way, self.way.model.u, self.way.model.q
        pieces = way.rows((b[: u.dim], u), (b[u.dim :], q))
        return np.concatenate(way.joined(self.handle("solve", here=(pieces,)), u, q))


class DistributedEquation(Equation):
    """The equation of a stage, its residual and Jacobian on all ranks."""

    way: Distributed

    @cached_property
    def handle(self) -> Handle:
        """The equation of all ranks."""
        way, c, u_alpha = self.way, self.c, self.u_alpha
        u, q = way.model.u, way.model.q
        c_u, c_q = c[: u.dim], c[u.dim :]
        own = way.rows((self.source, u))
        known = [
            np.concatenate([c_u[a], u_alpha[a], c_q[b], f])
            for a, b, f in zip(u.reaches, q.reaches, own, strict=True)
        ]
        sent = (way.shared.key, self.h, self.moment.t, dict(self.moment.inputs))
        return way.shared.team.share(SharedEquation, *sent, here=(known,))

    def residual(self, y: Array) -> Array:
        way, n = self.way, self.stage.n
        u, q = y[:n], y[n:]
        self.r = self.stage.split.R @ u - self.u_alpha
        pieces = self.handle("residual", here=(way.reached(u, q),))
        shares = (way.model.u, way.model.u, way.model.u, way.model.q)
        first, self.Mr, self.mass_r, second = way.joined(pieces, *shares)
        return np.concatenate([first + self.pull(), second])

    def factor(self, y: Array, sweep: bool) -> Factor:
        way, u, row = self.way, self.way.model.u, self.slope(sweep)
        border = way.rows((self.Mr, u), (np.zeros(u.dim) if row is None else row, u))
        sent = (self.handle.key, self.theta, sweep)
        factor = _DistributedFactor(
            way, way.shared.team.share(SharedJacobian, *sent, here=(border,))
        )
        if not sweep:
            self.made = (y, factor)
        return factor


class Distributed(Way):
    """Solves a stage that all ranks share.

    Attributes
    ----------
    shared, model
        The stage and the model of all ranks.
    """

    equations = DistributedEquation

    def __init__(self, stage: CoupledStage, shared: Handle, model: SharedModel) -> None:
        super().__init__(stage)
        self.shared = shared
        self.model = model

    @classmethod
    def of(cls, stage: CoupledStage) -> Distributed | None:
        """Return a stage as all ranks share it; None where rank 0 keeps it for itself.

        It is shared where it is large and no band is narrow, an engine of several ranks is in use
        that has been told how to build the model, sensors see coefficients (R is diagonal), the
        unknowns are fields that do not move by themselves, and the gain is a number.
        """
        engine, model, R = in_use(), stage.model, stage.split.R
        if not isinstance(engine, PetscEngine) or stage.size < LARGE:
            return None
        fields = all(isinstance(b, FieldBlock) for b in model.parameter_space.blocks.values())
        selects = R.nnz == np.count_nonzero(R.diagonal())
        plain = model.latent.dim == model.parameter_space.dim and not model.latent.generator.nnz
        finite = np.isfinite(stage.gains.gain)
        if not (fields and selects and plain and not stage.auxiliary and finite):
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
        return cls(stage, engine.team.share(SharedStage, *sent, here=(rows,)), known)

    @property
    def keeps(self) -> bool:
        return self.stage.model.constant

    @property
    def patience(self) -> int:
        return 3

    def reached(self, u: Array, q: Array) -> list[Array]:
        """Return what each rank needs of vectors of the state and of the parameter."""
        pairs = zip(self.model.u.reaches, self.model.q.reaches, strict=True)
        return [np.concatenate([u[a], q[b]]) for a, b in pairs]

    def rows(self, *parts: tuple[Array, Any]) -> list[Array]:
        """Return the rows of each rank of several vectors, each with its share."""
        cut = [np.split(values[share.order], _ends(share.sizes)) for values, share in parts]
        return [np.concatenate(pieces) for pieces in zip(*cut, strict=True)]

    def joined(self, pieces: list[Array], *shares: Any) -> list[Array]:
        """Return vectors from the rows of each rank: the inverse of `rows`."""
        found = [np.empty(share.dim) for share in shares]
        sizes = np.array([share.sizes for share in shares])
        for rank, piece in enumerate(pieces):
            parts = np.split(piece, np.cumsum(sizes[:, rank])[:-1])
            for values, share, part in zip(found, shares, parts, strict=True):
                start = int(share.sizes[:rank].sum())
                values[share.order[start : start + len(part)]] = part
        return found


def _ends(sizes: Any) -> Any:
    return np.cumsum(sizes)[:-1]


def _members(share: Any) -> list[Any]:
    return np.split(share.order, _ends(share.sizes))
