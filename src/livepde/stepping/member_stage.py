"""Batched implicit stage: states and tangents of several members of one model.

Column arrays have the shape (1 + r, members, n): the state and r tangents of each member.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from livepde.fem import Channel, Form, Inputs, Moment
from livepde.linalg import (
    Array,
    Assembler,
    BandedBlocks,
    BandedSolver,
    BlockFactor,
    IntArray,
    Mask,
    Pattern,
    analyse,
    compact,
)
from livepde.model import Model
from livepde.stepping.corrections import Kept
from livepde.stepping.driven import DrivenVector
from livepde.stepping.newton import StepFailed
from livepde.stepping.span import Moments
from livepde.stepping.state import ForwardStage

# Relative error of a covariance square root. It affects the gain only, not the innovation, and may
# be coarser than the state.
GAIN = 1e-4
# Relative error of the tangent that carries the estimated mean, as accurate as the state itself.
ESTIMATE = 1e-8
# Largest number of unknowns with an assembled matrix A_j each: the cost of summing them grows
# linearly.
MOST_UNKNOWNS = 64

__all__ = [
    "BandedStage",
    "KeptFactors",
    "MemberStage",
    "SeparateStages",
    "StageOfMembers",
    "member_stage",
]


@dataclass(frozen=True, eq=False)
class KeptFactors:
    """Warm-start data of each member, as `Kept` of a single process.

    Attributes
    ----------
    q, h, spent, trend
        Shapes (members, m), (members,), (members,) and (members, n); h = 0 for a member without a
        cached factor. For stages that cache no factors, q and trend have no columns.
    """

    q: Array
    h: Array
    spent: Array
    trend: Array

    @classmethod
    def none(cls, members: int, m: int = 0, n: int = 0) -> KeptFactors:
        """Return empty warm-start data, as before the first stage."""
        zero = np.zeros(members)
        return cls(np.zeros((members, m)), zero, zero, np.zeros((members, n)))

    def forgotten(self) -> KeptFactors:
        """Return empty warm-start data of the same members."""
        return KeptFactors.none(len(self.h)) if self.q.shape[1] else self

    def member(self, k: int) -> Kept:
        """Return the warm-start data of one member."""
        if not self.h[k]:
            return Kept.none()
        return Kept(self.q[k], float(self.h[k]), float(self.spent[k]), self.trend[k])


class StageOfMembers(NamedTuple):
    """Arguments of a batched stage, besides its initial states and tangents.

    Attributes
    ----------
    members
        Numbers of the members, as keys of their cached factors, shape (members,).
    q, directions
        Latent parameters, (members, dim), and derivative of q along each tangent, (members, r, m).
    h, at
        Step length; time and inputs at its end.
    kept
        Warm-start data of the previous stage.
    off_centre
        Mask of members whose last tangent is the offset of the estimated mean from the
        linearisation point, which has to be more accurate than a covariance square root; shape
        (members,).
    factors
        Cache of factorised matrices for this q, keyed by step length, shared by the stages of one
        step of a time scheme; a stage may read it and add to it.
    apart
        Number of trailing tangents that are solved separately, so that their presence does not
        change the rounding of the other columns.
    """

    members: IntArray
    q: Array
    directions: Array
    h: float
    at: Moments
    kept: KeptFactors
    off_centre: Mask
    factors: dict[float, BlockFactor]
    apart: int = 0


class MemberStage(ABC):
    """Abstract solver of M (u - c)/h + B(u) + A(u) q = F for states and tangents of members."""

    @abstractmethod
    def kept(self, members: int) -> KeptFactors:
        """Return empty warm-start data of members, as before the first stage."""

    @abstractmethod
    def twin(self) -> MemberStage:
        """Return a stage of the same model with its own factor cache, for other step lengths."""

    @abstractmethod
    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        """Return states and tangents at the end of a stage, and its warm-start data.

        Parameters
        ----------
        columns
            States and tangents at the beginning of the stage, shape (1 + r, members, n).

        Raises
        ------
        StepFailed
            The solver finds no solution of a stage.
        """


class SeparateStages(MemberStage):
    """Loop of one `ForwardStage` per member: serves any model."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._stages: list[ForwardStage] = []

    def _stage(self, k: int) -> ForwardStage:
        """Return the stage of a member: symbolic analysis is shared, numeric factors are not."""
        if not self._stages:
            self._stages.append(ForwardStage(self.model))
        while len(self._stages) <= k:
            self._stages.append(self._stages[0].twin())
        return self._stages[k]

    def twin(self) -> SeparateStages:
        other = SeparateStages(self.model)
        other._stages = [self._stage(0).twin()]
        return other

    def kept(self, members: int) -> KeptFactors:
        stage = self._stage(0)
        if not stage.keeps or not stage.solver.price:
            return KeptFactors.none(members)
        return KeptFactors.none(members, self.model.latent.dim, self.model.X.dim)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        new, left, kept = np.empty_like(columns), [], stage.kept
        for k, member in enumerate(stage.members.tolist()):
            y, after = self._stage(member).advance(
                columns[:, k].T,
                stage.q[k],
                stage.directions[k].T,
                stage.h,
                stage.at.member(k),
                kept.member(k),
                ESTIMATE if stage.off_centre[k] else GAIN,
                stage.apart,
            )
            new[:, k] = y.T
            left.append(after)
        if not kept.q.shape[1]:
            return new, kept
        rows = (np.array([getattr(one, name) for one in left]) for name in vars(left[0]))
        return new, KeptFactors(*rows)


class BandedStage(MemberStage):
    """Batched stage of models whose matrices are constant, banded and affine in q.

    The matrices M/h + B and A_j are assembled once. The matrices of all members are the diagonal
    blocks of one banded matrix, which is factorised by one LAPACK call.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        form, zero, free = model.physical_A, np.zeros(model.X.dim), model.X.free
        fields = [block.field for block in model.state_space.fields.values()]
        values = [value for field in fields for value in field.boundary_values]
        fixed_in_time = all(isinstance(value, int | float | Channel) for value in values)
        units = np.eye(model.parameter_space.dim)
        self.pattern, maps = _analysed(model)
        rows, cols = self.pattern.rows, self.pattern.indices
        # Masks of the entries between free coefficients, and of free rows with Dirichlet columns.
        inner, outer = free[rows] * free[cols], free[rows] * (1.0 - free[cols])
        # The matrices depend on neither time nor inputs; the forms still need some moment as
        # argument.
        some = Moment(0.0, Inputs(dict.fromkeys(model.channels, 0.0)))
        mass = maps["M"] @ model.mass.data
        rest = maps["B"] @ model.form_B.data("v", "u", some, u=zero)
        slopes = [maps["A"] @ form.data("v", "u", some, u=zero, q=q) for q in units]
        self._blocks = BandedBlocks(BandedSolver(self.pattern))
        self._mass = self._product(mass * free[rows])
        self._slopes = self._product(*(slope * inner for slope in slopes))
        self._mass_band = self._blocks.band(mass * inner)
        # Fixed coefficients have rows of the identity, multiplied by h like all of the rest.
        ones = np.where(rows == cols, 1.0 - free[rows], 0.0)
        self._rest_band = self._blocks.band(rest * inner + ones)
        self._slope_bands = self._blocks.band(np.array(slopes) * inner)
        # The couplings of free coefficients to Dirichlet values are moved to the right-hand side.
        mass_edge, rest_edge = self._product(mass * outer), self._product(rest * outer)
        slope_edge = self._product(*(slope * outer for slope in slopes))

        def boundary(moment: Moment) -> Array:
            return model.impose(zero, moment)

        def load(moment: Moment) -> Array:
            known = (model.form_F.vector("v", moment) - model.B(zero, moment)) * free
            return known - rest_edge @ boundary(moment)

        def offset(moment: Moment) -> Array:
            at_zero = [form.vector("v", moment, q=q, u=zero) * free for q in units]
            return np.concatenate(at_zero) + slope_edge @ boundary(moment)

        def driven(vector: Callable[[Moment], Array], *forms: Form) -> DrivenVector:
            def timed() -> bool:
                return not fixed_in_time or any("t" in each.uses for each in forms)

            return DrivenVector(vector, model.channels, timed)

        self._boundary = driven(boundary)
        self._mass_boundary = driven(lambda moment: mass_edge @ boundary(moment))
        self._load = driven(load, model.form_F, model.form_B)
        self._offset = driven(offset, form)

    @staticmethod
    def refuses(model: Model) -> str:
        """Return the reason why a model does not fit this stage; empty if it fits."""
        if not (model.physical_A.linear_in_parameter and model.affine):
            return "the model is not affine in its state and its unknowns"
        if model.parameter_space.dim > MOST_UNKNOWNS:
            return f"there are more than {MOST_UNKNOWNS} unknown coefficients"
        if not model.steady:
            return "the matrices of the model depend on time or inputs"
        if not isinstance(analyse(_analysed(model)[0]), BandedSolver):
            return "the matrices of the model are not banded: the mesh has more than one dimension"
        return ""

    @property
    def refusal(self) -> str:
        """Reason why members with different inputs cannot be batched; empty if they can."""
        if not all(item.affine for item in (self._boundary, self._load, self._offset)):
            return "the model is not affine in its input channels"
        return ""

    def _product(self, *parts: Array) -> sp.csr_array | Array:
        """Return vertically stacked matrices of the pattern, for products."""
        blocks = [self.pattern.matrix(part) for part in parts]
        whole = sp.csr_array(sp.vstack(blocks, format="csr"))
        whole.eliminate_zeros()  # an unknown of a layer has an effect there only
        return compact(whole)

    def twin(self) -> BandedStage:
        return self  # it keeps no factor

    def kept(self, members: int) -> KeptFactors:
        return KeptFactors.none(members)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        # The equations are multiplied by h, which avoids dividing an array of the size of all
        # columns.
        (size, n), h, at = columns.shape[1:], stage.h, stage.at
        together = len(columns) - stage.apart
        columns, apart = columns[:together], columns[together:]
        unknowns = self.model.latent.value(stage.q.T).T
        factor = stage.factors.get(h)
        if factor is None:
            storage = unknowns @ self._slope_bands
            storage += self._rest_band
            storage *= h
            storage += self._mass_band
            factor = stage.factors[h] = self._blocks.factorise(storage)
        if size == 1 and len(factor.bad):
            raise StepFailed("singular", f"the {n} by {n} matrix is singular or not finite")
        known = np.array((self._mass @ columns.reshape(-1, n).T).T, order="C")
        new = known.reshape(columns.shape)
        if not self._load.zero:
            new[0] += h * self._load(at)
        if not self._boundary.zero:
            new[0] -= self._mass_boundary(at)
        offset = None if self._offset.zero else self._offset(at).reshape(-1, unknowns.shape[1], n)
        if offset is not None:
            new[0] -= h * (unknowns[:, None] @ offset)[:, 0]
        # The state first: the tangents need it.
        new[:1] = factor.solve(new[:1])
        # A(u) e_j = A_j u + offset_j of each unknown, (members, unknowns, n), drives the tangents.
        driven = (self._slopes @ new[0].T).T.reshape(size, -1, n)
        if offset is not None:
            driven = driven + offset
        if together > 1:
            along = stage.directions[:, : together - 1]
            new[1:] -= ((h * along) @ driven).transpose(1, 0, 2)
            new[1:] = factor.solve(new[1:])
        if not self._boundary.zero:
            new[0] += self._boundary(at)
        if not len(apart):
            return new, stage.kept
        # BLAS may round products of other shapes differently, so the separate columns share no
        # product with the others.
        known = np.array((self._mass @ apart.reshape(-1, n).T).T, order="C").reshape(apart.shape)
        known -= ((h * stage.directions[:, together - 1 :]) @ driven).transpose(1, 0, 2)
        return np.concatenate([new, factor.solve(known)]), stage.kept


def _analysed(model: Model) -> tuple[Pattern, dict[str, sp.csr_array]]:
    """Return the sparsity pattern of the stage matrix, and the maps of its parts."""
    whole = Assembler(model.X.dim)
    whole.add("M", model.form_M.pattern("v", "u"))
    whole.add("B", model.form_B.pattern("v", "u"))
    whole.add("A", model.physical_A.pattern("v", "u"))
    return whole.build()


def member_stage(model: Model) -> MemberStage:
    """Return the fastest applicable batched stage; the only place of this decision."""
    if BandedStage.refuses(model):
        return SeparateStages(model)
    return BandedStage(model)
