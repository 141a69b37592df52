"""Coupled stages on several ranks, as rank 0 sees them: Newton here, the equation everywhere.

Only where all of the state is observed: then A and B see the data alone, in all of Omega.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from livepde.errors import LawError
from livepde.fem import FieldBlock
from livepde.laws.coupled.blocks import LARGE
from livepde.laws.coupled.equation import (
    Inside,
    StageData,
    StageIterate,
    StageProblem,
    StageSolver,
    StageTerms,
)
from livepde.linalg import Array, BandedSolver, Factor, Pattern, analyse, in_use
from livepde.parallel import PetscEngine
from livepde.parallel.shares import Share, SharedModel
from livepde.parallel.stage import SharedEquation, SharedJacobian, SharedStage
from livepde.parallel.team import Handle

__all__ = ["DistributedSolver"]

PATIENCE = 3  # a solve is as dear as with a new Jacobian, for hierarchies are kept by themselves


class DistributedSolver(StageSolver):
    """Solves the coupled systems of a stage that all ranks share.

    Parameters
    ----------
    shared, model
        The stage and the model of all ranks.
    """

    def __init__(self, terms: StageTerms, shared: Handle, model: SharedModel) -> None:
        super().__init__(terms)
        self.shared = shared
        self.model = model

    @classmethod
    def of(cls, terms: StageTerms) -> DistributedSolver | None:
        """Return it for a stage; None where rank 0 keeps the stage for itself.

        Shared are large stages without a narrow band, where an engine is in use that has been told
        how to build the model, sensors see all of the state and A and B the data alone, and the
        unknowns are fields that do not move by themselves and have a constant metric.

        Raises
        ------
        LawError
            Several ranks are to work on a large stage of which a subdomain is observed.
        """
        engine, model = in_use(), terms.forms.model
        if not isinstance(engine, PetscEngine) or terms.size < LARGE:
            return None
        if isinstance(analyse(Pattern.of(model.mass), symmetric=True), BandedSolver):
            return None
        _refuse_parts(terms, engine.team.size)
        if not _is_plain(terms):
            return None
        shared = engine.shared(model)
        if shared is None:
            return None
        known: SharedModel = shared.local
        matrices = (model.mass, terms.forms.pull)
        rows = [
            (*(sp.csr_array(K[u]) for K in matrices), sp.csr_array(terms.gram[q]))
            for u, q in zip(_members(known.u), _members(known.q), strict=True)
        ]
        sent = (shared.key, terms.free, terms.free_q, terms.dual_weights)
        return cls(terms, engine.team.share(SharedStage, *sent, here=(rows,)), known)

    @property
    def keeps(self) -> bool:
        return self.terms.forms.model.constant

    @property
    def patience(self) -> int:
        return PATIENCE

    def prepare(self) -> None:
        self.shared("prepare")

    def data(self, problem: StageProblem, w: Array | None = None) -> StageData:
        model, moment = self.terms.forms.model, problem.moment
        w = model.impose(problem.u_alpha, moment) if w is None else w
        known = [
            np.concatenate([w[own], values])
            for own, values in zip(self.model.u.reaches, self.reached(problem.c), strict=True)
        ]
        sent = (self.shared.key, problem.h, moment.t, dict(moment.inputs), problem.metric.scale)
        equation = self.shared.team.share(SharedEquation, *sent, here=(known,))
        (flux,) = joined(equation("flux"), self.model.u)
        return self.terms.given(problem, model.F(moment), Inside(equation, flux))

    def evaluate(self, data: StageData, y: Array) -> StageIterate:
        terms, n, inside = self.terms, self.terms.n, _inside(data)
        u, q = self.model.u, self.model.q
        pieces = inside.A("terms", here=(self.reached(y),))
        rate, driven, Mr, mass_r, change, coupling = joined(pieces, u, u, u, u, q, q)
        r = terms.forms.split.project(y[:n]) - data.problem.u_alpha
        norms = terms.norms(r, Mr, mass_r, data.observed)
        theta = terms.theta(data, norms)
        pull = theta * Mr
        residual = np.empty_like(y)
        residual[:n] = (rate + inside.flux + driven + pull - data.source) * terms.free
        residual[n:] = (change - data.load - coupling) * terms.free_q
        first, second = [residual[:n], rate, driven, pull], [residual[n:], change, coupling]
        accuracy = self.accuracy(data)
        size, resolved, scales = terms.measured(data, first, second, norms.X, theta, accuracy)
        w = y[:n] - r
        return StageIterate(
            y, residual, size, resolved, scales, w, r, None, theta, norms, Mr, mass_r
        )

    def factor(self, data: StageData, at: StageIterate) -> Factor:
        terms, u = self.terms, self.model.u
        row = terms.slope(data, at)
        slope = np.zeros(terms.n) if row is None else row
        border = rows_of((at.Mr * terms.free, u), (slope * terms.free, u))
        sent = (_inside(data).A.key, at.theta, at.scales)
        here = (self.reached(at.y), border)
        handle = self.shared.team.share(SharedJacobian, *sent, here=here)
        return _DistributedFactor(self.model, handle)

    def reached(self, y: Array) -> list[Array]:
        """Return the part of a vector (u, q) that each rank needs."""
        u, q = y[: self.terms.n], y[self.terms.n :]
        pairs = zip(self.model.u.reaches, self.model.q.reaches, strict=True)
        return [np.concatenate([u[a], q[b]]) for a, b in pairs]


@dataclass(frozen=True, eq=False)
class _DistributedFactor:
    """The Jacobian, as a `Factor`: GMRES on all ranks."""

    model: SharedModel
    handle: Handle

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`."""
        u, q = self.model.u, self.model.q
        pieces = rows_of((b[: u.dim], u), (b[u.dim :], q))
        return np.concatenate(joined(self.handle("solve", here=(pieces,)), u, q))


def _refuse_parts(terms: StageTerms, ranks: int) -> None:
    """Raise `LawError` if several ranks are to work on a stage of which a part is observed.

    A reading that is missing makes a part of the whole, too: rank 0 does such a sample alone.
    """
    split = terms.forms.split
    if ranks == 1 or split.omega is None or not split.present.all():
        return
    raise LawError(
        f"the coupled stage of this law runs on several ranks only where all of the state is "
        f"observed; these sensors see {split.R.nnz} of its {int(terms.free.sum())} coefficients: "
        "run it on one rank, observe Full(), or use SensitivityLaw."
    )


def _is_plain(terms: StageTerms) -> bool:
    """Return whether a stage has only terms that are implemented on several ranks."""
    forms, model = terms.forms, terms.forms.model
    fields = all(isinstance(b, FieldBlock) for b in model.parameter_space.blocks.values())
    latent = model.latent.dim == model.parameter_space.dim and not model.latent.generator.nnz
    constant = terms.memory is None and not terms.auxiliary
    return fields and latent and constant and forms.split.omega is None and forms.W is None


def _inside(data: StageData) -> Inside:
    """Return A(w), a `Handle` of the equation of all ranks, and B(w)."""
    return cast(Inside, data.inside)


def rows_of(*parts: tuple[Array, Share]) -> list[Array]:
    """Return the rows of each rank of several vectors, each with its share."""
    cut = [np.split(values[share.order], _ends(share)) for values, share in parts]
    return [np.concatenate(pieces) for pieces in zip(*cut, strict=True)]


def joined(pieces: list[Array], *shares: Share) -> list[Array]:
    """Return vectors from the rows of each rank: the inverse of `rows_of`."""
    found = [np.empty(share.dim) for share in shares]
    sizes = np.array([share.sizes for share in shares])
    for rank, piece in enumerate(pieces):
        parts = np.split(piece, np.cumsum(sizes[:, rank])[:-1])
        for values, share, part in zip(found, shares, parts, strict=True):
            start = int(share.sizes[:rank].sum())
            values[share.order[start : start + len(part)]] = part
    return found


def _ends(share: Share) -> Any:
    return np.cumsum(share.sizes)[:-1]


def _members(share: Share) -> list[Any]:
    return np.split(share.order, _ends(share))
