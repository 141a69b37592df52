"""Batched implicit stages: states and tangents of several members of one model.

Column arrays have the shape (1 + r, members, n): the state and r tangents of each member.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from livepde.fem import Channel, Form, Moment
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
    row_product,
)
from livepde.model import Model
from livepde.stepping.driven_vector import LARGE, DrivenVector
from livepde.stepping.forward import ForwardStage
from livepde.stepping.interval import Moments
from livepde.stepping.newton import Kept, StepFailed

# Relative error of a covariance square root. It affects the gain but not the innovation, so it can
# be larger than the error of the state.
GAIN = 1e-4
# Relative error of the tangent that represents the estimated mean: as accurate as the state.
ESTIMATE = 1e-8


@dataclass(frozen=True, eq=False)
class KeptFactors:
    """Warm-start data of all members: arrays of `Kept` with the members as first axis.

    For a member without a cached factor, h = 0. If a stage caches no factors, q and trend have no
    columns.
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
        """Return empty warm-start data for the same number of members."""
        return KeptFactors.none(len(self.h)) if self.q.shape[1] else self

    def member(self, k: int) -> Kept:
        """Return the warm-start data of one member."""
        if not self.h[k]:
            return Kept.none()
        return Kept(self.q[k], float(self.h[k]), float(self.spent[k]), self.trend[k])


class StageOfMembers(NamedTuple):
    """Arguments of a batched stage, in addition to its initial states and tangents."""

    members: IntArray  # indices of the members, as keys of their cached factors, shape (members,)
    # q, directions: latent parameters, (members, dim), and derivative of q along each tangent,
    # (members, r, m).
    q: Array
    directions: Array
    # h, at: step length; time and inputs at its end.
    h: float
    at: Moments
    kept: KeptFactors  # warm-start data of the previous stage
    # Mask of members, (members,), whose last tangent is the offset of the estimated mean from the
    # linearisation point, which has to be more accurate than a covariance square root.
    off_centre: Mask
    # Cache of factorised matrices for this q by step length, which the stages of one step of a time
    # scheme share and extend.
    factors: dict[float, Any]
    # Number of trailing tangents that are solved separately, so that their presence does not change
    # the rounding of the other columns.
    apart: int = 0


class MemberStage(ABC):
    """Abstract solver of M (u - c)/h + B(u) + A(u) q = F for states and tangents of members."""

    @abstractmethod
    def kept(self, members: int) -> KeptFactors:
        """Return empty warm-start data of members, as before the first stage."""

    @abstractmethod
    def twin(self) -> MemberStage:
        """Return a stage of the same model with a separate factor cache, for other step lengths."""

    @abstractmethod
    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        """Return states and tangents, (1 + r, members, n), at the end of a stage; warm-start data.

        Raises `StepFailed`: the solver finds no solution of a stage.
        """


class SeparateStages(MemberStage):
    """Loop over a separate `ForwardStage` for each member: applicable to any model."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._stages: list[ForwardStage] = []

    def _stage(self, k: int) -> ForwardStage:
        """Return the stage of a member, which shares the symbolic analysis but no factors."""
        if not self._stages:
            self._stages.append(ForwardStage(self.model))
        while len(self._stages) <= k:
            self._stages.append(self._stages[0].twin())
        return self._stages[k]

    def twin(self) -> SeparateStages:
        stages = SeparateStages(self.model)
        stages._stages = [self._stage(0).twin()]
        return stages

    def kept(self, members: int) -> KeptFactors:
        stage = self._stage(0)
        if not stage.keeps or not stage.solver.price:
            return KeptFactors.none(members)
        return KeptFactors.none(members, self.model.latent.dim, self.model.X.dim)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        new, new_kept, previous = np.empty_like(columns), [], stage.kept
        for k, member in enumerate(stage.members.tolist()):
            y, warm_start = self._stage(member).advance(
                columns[:, k].T,
                stage.q[k],
                stage.directions[k].T,
                stage.h,
                stage.at.member(k),
                previous.member(k),
                ESTIMATE if stage.off_centre[k] else GAIN,
                stage.apart,
            )
            new[:, k] = y.T
            new_kept.append(warm_start)
        if not previous.q.shape[1]:
            return new, previous
        rows = (np.array([getattr(item, name) for item in new_kept]) for name in vars(new_kept[0]))
        return new, KeptFactors(*rows)


# Largest number of unknowns with assembled matrices A_j: the cost of their sum grows linearly.
MOST_UNKNOWNS = 64

NO_RESPONSE = np.zeros((0, 0))  # derivative in the inputs of a stage that does not depend on them


class BandedStep(NamedTuple):
    """Common data of stages with the same length and unknowns.

    `amounts`: h q of the coefficients in which A is linear, (members, unknowns). `slopes`: their
    derivatives by the physical unknowns, (members, unknowns, m), None for the identity. `forced`:
    the right-hand side of the state and its derivative by the inputs, see `_forced`.
    """

    factor: BlockFactor
    h: float
    amounts: Array
    slopes: Array | None
    forced: tuple[Array, Array] | None


class MatrixTerm(NamedTuple):
    """Entries of one matrix of a stage: part of A_j, or of B if `unknown` is -1.

    It is the factor of the input of a channel, or the part without inputs if `channel` is -1.
    """

    unknown: int
    channel: int
    data: Array


class BandedStage(MemberStage):
    """Batched stage for models whose matrices are banded, and affine in q and in the inputs.

    The matrices M, B and A_j are assembled once, with separate terms for inputs, such as a flow
    that transports heat. The matrices of all members are the diagonal blocks of one banded matrix,
    which is factorised by one LAPACK call.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        free, unknowns = model.X.free, model.linear_A.spaces["q"].dim
        self.pattern, maps = _analysed(model)
        rows, cols = self.pattern.rows, self.pattern.indices
        # Masks of the entries between free coefficients, and of free rows with Dirichlet columns.
        inner, outer = free[rows] * free[cols], free[rows] * (1.0 - free[cols])
        mass = maps["M"] @ model.mass.data
        self._mass = row_product(self._stacked(mass * free[rows]))
        # Terms without inputs come first: one for each unknown, then one for B.
        terms = _matrix_terms(model, maps)
        self._terms = terms[unknowns + 1 :]
        slopes = [term.data for term in terms if term.unknown >= 0]
        self._slopes = row_product(self._stacked(*(slope * inner for slope in slopes)))
        # Fixed coefficients have rows of the identity, scaled by h like the matrix.
        ones = np.where(rows == cols, 1.0 - free[rows], 0.0)
        parts = [term.data * inner for term in terms]
        parts[unknowns] = parts[unknowns] + ones
        entries = np.array([*parts, mass * inner])
        self._blocks = BandedBlocks.of(BandedSolver(self.pattern), *entries)
        # The matrix of a stage is their sum with weights h q, h, both times inputs, and 1.
        self._bands = self._blocks.band(entries)
        # Couplings of free coefficients to Dirichlet values are moved to the right-hand side. They
        # are sparse matrices with few entries.
        self._drive(
            self._stacked(mass * outer),
            self._stacked(terms[unknowns].data * outer),
            self._stacked(*(term.data * outer for term in terms[:unknowns])),
        )
        edges = ((term, self._stacked(term.data * outer)) for term in self._terms)
        self._edges = [(term, edge) for term, edge in edges if edge.nnz]

    def _drive(
        self, mass_edge: sp.csr_array, rest_edge: sp.csr_array, slope_edge: sp.csr_array
    ) -> None:
        """Set the driving vectors of a stage, given the Dirichlet couplings of M, B and all A_j."""
        model, form, free = self.model, self.model.linear_A, self.model.X.free
        zero, units = np.zeros(model.X.dim), np.eye(form.spaces["q"].dim)
        timeless = (int, float, Channel)
        fixed_in_time = all(isinstance(value, timeless) for value in model.boundary_values)

        def boundary(moment: Moment) -> Array:
            return model.impose(zero, moment)

        def load(moment: Moment) -> Array:
            total = model.form_F.vector("v", moment) - model.B(zero, moment)
            if not form.linear_in_parameter:
                total = total - form.vector("v", moment, q=0.0 * units[0], u=zero)
            return np.asarray(total * free - rest_edge @ boundary(moment))

        def offset(moment: Moment) -> Array:
            def at_zero(q: Array) -> Array:
                return form.vector("v", moment, q=q, u=zero)

            derivatives = [_along(form, q, at_zero) * free for q in units]
            return np.asarray(np.concatenate(derivatives) + slope_edge @ boundary(moment))

        def driven(vector: Callable[[Moment], Array], *forms: Form) -> DrivenVector:
            def timed() -> bool:
                return not fixed_in_time or any("t" in form_read.uses for form_read in forms)

            return DrivenVector(vector, model.channels, timed)

        self._boundary = driven(boundary)
        self._mass_boundary = driven(lambda moment: mass_edge @ boundary(moment))
        affine_forms = () if form.linear_in_parameter else (form,)
        self._load = driven(load, model.form_F, model.form_B, *affine_forms)
        self._offset = driven(offset, form)

    @staticmethod
    def refuses(model: Model) -> str:
        """Return why this stage is not applicable to a model; empty if it is."""
        if not (model.linear_A.affine_in_parameter and model.affine):
            return "the model is not affine in its state and its unknowns"
        if model.linear_A.spaces["q"].dim > MOST_UNKNOWNS:
            return f"there are more than {MOST_UNKNOWNS} unknown coefficients"
        pattern, maps = _analysed(model)
        if not (model.steady or all(matrix.responses for matrix in _matrices(model, maps))):
            return "the matrices of the model depend on time, or on inputs other than linearly"
        if not isinstance(analyse(pattern), BandedSolver):
            return "the matrices of the model are not banded: the mesh has more than one dimension"
        return ""

    @property
    def refusal(self) -> str:
        """Why members with different inputs cannot be batched; empty if they can."""
        if not all(item.affine for item in (self._boundary, self._load, self._offset)):
            return "the model is not affine in its input channels"
        return ""

    @property
    def repeats(self) -> bool:
        """Whether stages with the same length and unknowns differ only in their inputs."""
        vectors = self._boundary, self._mass_boundary, self._load, self._offset
        return not self._terms and all(vector.responses is not None for vector in vectors)

    def _stacked(self, *parts: Array) -> sp.csr_array:
        """Return vertically stacked matrices of the pattern."""
        blocks = [self.pattern.matrix(part) for part in parts]
        stacked = sp.csr_array(sp.vstack(blocks, format="csr"))
        stacked.eliminate_zeros()  # an unknown of one layer has entries only there
        return stacked

    def twin(self) -> BandedStage:
        return self  # no factor is cached

    def kept(self, members: int) -> KeptFactors:
        return KeptFactors.none(members)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        # The equations are multiplied by h, which avoids dividing an array of the size of all
        # columns.
        (size, n), at = columns.shape[1:], stage.at
        step = stage.factors.get(stage.h) or self._begin(stage)
        if size == 1 and len(step.factor.bad):
            raise StepFailed("singular", f"the {n} by {n} matrix is singular or not finite")
        together = (len(columns) - stage.apart) * size
        new = self._times_mass(columns, together)
        u = new[0]
        self._add_load(u, step, stage)
        offset = None if self._offset.zero else self._offset(at).reshape(-1, len(step.amounts.T), n)
        if self._edges:
            offset = self._along_edges(u, offset, step, at)
        if offset is not None:
            u -= (step.amounts[:, None] @ offset)[:, 0]
        # Solve for the state first, since the tangents depend on it.
        u[:] = step.factor.solve(new[:1])[0]
        if len(columns) > 1:
            driven = self._driven(u, offset, step, at.inputs)
            self._add_driven(new.reshape(-1, n), driven, stage, step, together)
            new[1:] = step.factor.solve(new[1:])
        if not self._boundary.zero:
            u += self._boundary(at)
        return new, stage.kept

    def _times_mass(self, columns: Array, together: int) -> Array:
        """Return M times the columns, with a separate product for rows from `together` on."""
        # Rounding in BLAS may depend on the shape, so separate columns must not share a product
        # with the others. The solution of a column does not depend on other columns.
        new, n = np.empty(columns.shape), columns.shape[2]
        rows, products = columns.reshape(-1, n), new.reshape(-1, n)
        if self._mass.separate or together == len(rows):
            self._mass(rows, products)
        else:
            self._mass(rows[:together], products[:together])
            self._mass(rows[together:], products[together:])
        return new

    def _add_load(self, u: Array, step: BandedStep, stage: StageOfMembers) -> None:
        """Add loads and boundary terms to the right-hand side of the state, (members, n)."""
        if step.forced is None:
            u += stage.h * self._load(stage.at) - self._mass_boundary(stage.at)
            return
        base, changes = step.forced
        u += base
        if len(changes):
            u += stage.at.inputs[:, : len(changes)].dot(changes)

    @staticmethod
    def _add_driven(
        known: Array, driven: Array, stage: StageOfMembers, step: BandedStep, together: int
    ) -> None:
        """Subtract the forcing from the right-hand sides of tangents, (columns * members, n)."""
        size = len(stage.q)
        scaled, joint = stage.h * stage.directions, together // size - 1
        if step.slopes is not None:
            scaled = scaled @ step.slopes.transpose(0, 2, 1)
        if joint:
            known[size:together] -= _sums_along(scaled[:, :joint], driven)
        if stage.apart:
            known[together:] -= _sums_along(scaled[:, joint:], driven)

    def _begin(self, stage: StageOfMembers) -> BandedStep:
        """Return the common data of stages of a length, and cache them if they are reusable."""
        latent, h = self.model.latent, stage.h
        unknowns = stage.q if latent.plain else latent.value(stage.q.T).T
        slopes, coefficients = None, self.model.coefficients
        if coefficients is not None:
            slopes = np.array([coefficients.slopes(q) for q in unknowns])
            unknowns = np.array([coefficients.value(q) for q in unknowns])
        count = unknowns.shape[1]
        weights = np.empty((len(unknowns), count + len(self._terms) + 2))
        amounts = np.multiply(unknowns, h, out=weights[:, :count])
        weights[:, count], weights[:, -1] = h, 1.0
        for column, term in enumerate(self._terms, count + 1):
            weights[:, column] = weights[:, term.unknown if term.unknown >= 0 else count]
            weights[:, column] *= stage.at.inputs[:, term.channel]
        factor = self._blocks.factorise(weights.dot(self._bands))
        step = BandedStep(factor, h, amounts, slopes, self._forced(h))
        if not self._terms:  # otherwise the factor depends on the inputs of this stage
            stage.factors[h] = step
        return step

    def _along_edges(
        self, u: Array, offset: Array | None, step: BandedStep, at: Moments
    ) -> Array | None:
        """Add the terms that couple inputs to boundary values to u and to the returned offset."""
        h, boundary = step.h, self._boundary(at)
        members, unknowns = step.amounts.shape
        offset = None if offset is None else offset.repeat(members // len(offset), axis=0)
        for term, edge in self._edges:
            coupling = at.inputs[:, term.channel, None] * (edge @ boundary.T).T
            if term.unknown < 0:
                u -= h * coupling
                continue
            if offset is None:
                offset = np.zeros((members, unknowns, u.shape[1]))
            offset[:, term.unknown] += coupling
        return offset

    def _driven(self, u: Array, offset: Array | None, step: BandedStep, inputs: Array) -> Array:
        """Return the forcing A(u) e_j = A_j u + offset_j of tangents, (members, unknowns, n)."""
        parts, count = self._slopes(u).reshape(len(u), -1, u.shape[1]), step.amounts.shape[1]
        forcing = parts
        if self._terms:
            forcing, more = parts[:, :count].copy(), iter(range(count, parts.shape[1]))
            for term in self._terms:
                if term.unknown >= 0:
                    forcing[:, term.unknown] += inputs[:, term.channel, None] * parts[:, next(more)]
        return forcing if offset is None else forcing + offset

    def _forced(self, h: float) -> tuple[Array, Array] | None:
        """Return the right-hand side of the state, (1, n), and its derivative by the inputs.

        None if it depends on time, or is not affine in the inputs.
        """
        load, boundary = self._load.responses, self._mass_boundary.responses
        if load is None or boundary is None:
            return None
        if self._mass_boundary.zero:
            return h * load[0], NO_RESPONSE if self._load.constant else h * load[1]
        return h * load[0] - boundary[0], h * load[1] - boundary[1]


def _sums_along(directions: Array, driven: Array) -> Array:
    """Return the forcing of the tangents along their directions, (r * members, n)."""
    if len(driven) == 1:  # faster than a product of stacks
        return np.asarray(directions[0].dot(driven[0]))
    sums: Array = (directions @ driven).transpose(1, 0, 2)
    return sums.reshape(-1, driven.shape[2])


def _along(form: Form, unit: Array, of: Callable[[Array], Array]) -> Array:
    """Return the derivative of an affine function of q by an unknown; `unit` is its unit vector.

    If A has a part without unknowns, the derivative is a difference at values that are large enough
    to lose no digits.
    """
    if form.linear_in_parameter:
        return of(unit)
    return (of(LARGE * unit) - of(0.0 * unit)) / LARGE


def _matrices(model: Model, maps: Mapping[str, sp.csr_array]) -> Iterator[DrivenVector]:
    """Iterate over the entries of A_j and B as functions of inputs; B includes A at q = 0."""
    A, B, zero = model.linear_A, model.form_B, np.zeros(model.X.dim)
    units = np.eye(A.spaces["q"].dim)

    def slope(moment: Moment, unit: Array) -> Array:
        data = _along(A, unit, lambda q: A.data("v", "u", moment, u=zero, q=q))
        return np.asarray(maps["A"] @ data)

    def rest(moment: Moment) -> Array:
        data = maps["B"] @ B.data("v", "u", moment, u=zero)
        if not A.linear_in_parameter:
            data = data + maps["A"] @ A.data("v", "u", moment, u=zero, q=0.0 * units[0])
        return np.asarray(data)

    for unit in units:
        yield DrivenVector(partial(slope, unit=unit), model.channels, lambda: "t" in A.uses)
    uses = B.uses if A.linear_in_parameter else A.uses | B.uses
    yield DrivenVector(rest, model.channels, lambda: "t" in uses)


def _matrix_terms(model: Model, maps: Mapping[str, sp.csr_array]) -> list[MatrixTerm]:
    """Return the terms of A_j and B: all terms without inputs, then nonzero terms of inputs."""
    bases, of_inputs = list[MatrixTerm](), list[MatrixTerm]()
    matrices = list(_matrices(model, maps))
    for unknown, entries in zip((*range(len(matrices) - 1), -1), matrices, strict=True):
        if model.steady:
            bases.append(MatrixTerm(unknown, -1, entries.without_inputs()))
            continue
        base, changes = entries.assembled()
        bases.append(MatrixTerm(unknown, -1, base))
        terms = (MatrixTerm(unknown, c, change) for c, change in enumerate(changes))
        of_inputs += [term for term in terms if term.data.any()]
    return bases + of_inputs


def _analysed(model: Model) -> tuple[Pattern, dict[str, sp.csr_array]]:
    """Return the sparsity pattern of the stage matrix, and the maps of its parts."""
    assembler = Assembler(model.X.dim)
    assembler.add("M", model.form_M.pattern("v", "u"))
    assembler.add("B", model.form_B.pattern("v", "u"))
    assembler.add("A", model.linear_A.pattern("v", "u"))
    return assembler.build()


def member_stage(model: Model) -> MemberStage:
    """Return the fastest batched stage that is applicable to a model."""
    if BandedStage.refuses(model):
        return SeparateStages(model)
    return BandedStage(model)
