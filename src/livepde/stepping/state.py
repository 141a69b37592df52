"""The forward model with a known parameter: its implicit stage, its tangent, a simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Inputs, Moment
from livepde.linalg import (
    Array,
    Assembler,
    Choice,
    Factor,
    IntArray,
    Pattern,
    Solver,
    analyse,
    choose,
)
from livepde.model import Model
from livepde.stepping.interval import Advance, Interval, advance
from livepde.stepping.newton import Newton, StepFailed

__all__ = ["ForwardStage", "Kept", "simulate"]

STATE = 1e-8  # relative error of the state that corrections with a kept factor leave
PASSES = 2  # corrections of the state by the factor of a q nearby; those of tangents are one less
SHARE = 1e-2  # of what a stage changes: the error is at most this, however slow the process
ROUNDING = 1e-11  # relative corrections below this are the end of what arithmetic can do
SLOW = 0.3  # a factor whose corrections leave more than this share of the error is made again
LINEAR = 1e-12  # relative asymmetry that is rounding


@dataclass(frozen=True, eq=False)
class Kept:
    """What a stage leaves to the next one: where its factor was made, and how the state moved.

    The factor itself is made again from this where it is gone, after a restart say: the numbers
    that follow are the same.

    Attributes
    ----------
    q, h
        Latent parameter, shape (m,), and step; q is empty if nothing is kept.
    spent
        Solves that stages have taken beyond those that a factor of a q nearby takes.
    trend
        Change of the state per unit of time, with which the next stage starts, shape (n,).
    """

    q: Array
    h: float
    spent: float
    trend: Array

    @classmethod
    def none(cls) -> Kept:
        """Return the value before any stage."""
        return cls(np.zeros(0), 0.0, 0.0, np.zeros(0))


class _At(NamedTuple):
    """Where a matrix is taken."""

    q: Array
    h: float

    def same(self, q: Array, h: float) -> bool:
        return self.h == h and np.array_equal(self.q, q)


class ForwardStage:
    """Solves M (u - c)/h + B(u) + A(u) q = F(t) for u, with Dirichlet values imposed.

    If B and A are affine in u with derivatives that read neither time nor inputs, the matrix is
    factorised once for each (h, q) and a stage is one back-substitution. That never changes the
    numbers. `advance` solves for tangents, too, and keeps a factor while q and h change.
    """

    def __init__(self, model: Model, newton: Newton | None = None) -> None:
        self.model = model
        self.newton = newton or Newton()
        self._made: tuple[_At, Factor] | None = None
        self._last: tuple[_At, _System] | None = None
        self._rate: tuple[float, Array] | None = None

    @cached_property
    def _rows(self) -> tuple[Pattern, dict[str, sp.csr_array]]:
        """Pattern of M/h + B' + d(A q)/du on the free rows, and the maps of its parts."""
        model = self.model
        free = sp.diags_array(model.X.free)
        whole = Assembler(model.X.dim)
        whole.add("M", model.form_M.pattern("v", "u"), free)
        whole.add("B", model.form_B.pattern("v", "u"), free)
        whole.add("A", model.form_A.pattern("v", "u"), free)
        return whole.build()

    @cached_property
    def _free(self) -> tuple[Pattern, sp.csr_array, Array]:
        """Pattern and map from the data of the rows to the free part, completed by ones."""
        model = self.model
        whole = Assembler(model.X.dim)
        whole.add("rows", self._rows[0], right=sp.diags_array(model.X.free))
        whole.add("fixed", Pattern.of(sp.eye_array(model.X.dim)))
        pattern, maps = whole.build()
        return pattern, maps["rows"], maps["fixed"] @ (1.0 - model.X.free)

    @cached_property
    def symmetric(self) -> bool:
        """True if the matrix of a stage should be symmetric for all q and h.

        M is, and the rest is at one q that is random: `_factorise` looks at each matrix again.
        """
        if not self.keeps:
            return False
        model, rows = self.model, self._free[1]
        some = np.random.default_rng(0).standard_normal(model.Q.dim) * model.latent.deviations
        inputs = Inputs(dict.fromkeys(model.channels, 1.0))
        with np.errstate(all="ignore"):
            rest = self._data_at(model.latent.prior + some, math.inf, Moment(0.0, inputs))
        parts = (self._rows[1]["M"] @ model.mass.data, rest)
        return all(self._mirrored(rows @ part) for part in parts)

    @cached_property
    def _mirror(self) -> IntArray:
        """Where in the data of the free part the entries of its transpose stand."""
        pattern = self._free[0]
        return pattern.positions(pattern.indices, pattern.rows)

    def _mirrored(self, data: Array) -> bool:
        """Return whether data of the free part are symmetric, each beside its own diagonal.

        A positive definite matrix has no entry beyond the root of the product of its two diagonal
        entries: that measure does not depend on the units of the state's components.
        """
        pattern = self._free[0]
        scale = np.sqrt(np.abs(pattern.matrix(data).diagonal()))
        allowed = LINEAR * scale[pattern.rows] * scale[pattern.indices]
        return bool(np.all(np.abs(data - data[self._mirror]) <= allowed))

    @cached_property
    def engine(self) -> Choice:
        """The engine of the matrix of a stage, and why it was chosen."""
        return choose(self._free[0], symmetric=self.symmetric)

    @property
    def solver(self) -> Solver:
        """The engine of the matrix of a stage."""
        return self.engine.solver

    @cached_property
    def _general(self) -> Solver:
        """The engine of a symmetric matrix that is not positive definite."""
        return analyse(self._free[0])

    def _data(self, u: Array, q: Array, h: float, moment: Moment) -> Array:
        model, maps = self.model, self._rows[1]
        data: Array = maps["M"] @ (model.mass.data / h)
        data += maps["B"] @ model.form_B.data("v", "u", moment, u=u)
        data += maps["A"] @ model.form_A.data("v", "u", moment, u=u, q=q)
        return data

    def _data_at(self, q: Array, h: float, moment: Moment) -> Array:
        """Return the same where they do not depend on u; what does not change is kept."""
        model, maps = self.model, self._rows[1]
        zero = np.zeros(model.X.dim)
        if self._rate is None or self._rate[0] != h:
            data = maps["M"] @ (model.mass.data / h)
            data += maps["B"] @ model.form_B.data("v", "u", moment, u=zero)
            self._rate = (h, data)
        if self._slope is not None:
            changing: Array = self._slope @ q
        else:
            changing = maps["A"] @ model.form_A.data("v", "u", moment, u=zero, q=q)
        return changing + self._rate[1]

    @cached_property
    def _slope(self) -> sp.csr_array | None:
        """Map from q to the data of d(A q)/du, where it is one."""
        tensor = self.model.form_A.tensor("v", "u")
        if not isinstance(tensor, sp.csr_array):  # none, or one of a large mesh
            return None
        return sp.csr_array(self._rows[1]["A"] @ tensor)

    def jacobian(self, u: Array, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factorised S = M/h + B'(u) + d(A(u) q)/du on the free coefficients."""
        return self._factorise(self._data(u, q, h, moment))

    def _factorise(self, data: Array) -> Factor:
        _, rows, fixed = self._free
        complete = rows @ data + fixed
        # An engine for definite matrices reads half of each, and would not see the other half.
        if not self.solver.definite or self._mirrored(complete):
            try:
                return self.solver.factorise(complete)
            except LinearAlgebraError as error:
                if not self.symmetric:
                    raise StepFailed("singular", str(error)) from error
        try:  # not positive definite: q is far off, and the step may still be good
            return self._general.factorise(complete)
        except LinearAlgebraError as error:
            raise StepFailed("singular", str(error)) from error

    @cached_property
    def _offset(self) -> tuple[Array, sp.csr_array | None]:
        """B(0) of an affine, constant model, and A(0) if it is linear in q."""
        zero = np.zeros(self.model.X.dim)
        linear = self.model.form_A.linear_in_parameter
        return self.model.B(zero), self.model.A(zero).matrix if linear else None

    def _at_zero(self, q: Array, moment: Moment) -> Array:
        """Return B(0) + A(0) q of an affine model."""
        model, zero = self.model, np.zeros(self.model.X.dim)
        if not model.constant:
            return model.B(zero, moment) + model.form_A.vector("v", moment, q=q, u=zero)
        offset, constant = self._offset
        if constant is None:
            return offset + model.form_A.vector("v", moment, q=q, u=zero)
        return offset + constant @ q if constant.data.any() else offset

    @property
    def keeps(self) -> bool:
        """True if the matrix of a stage depends on h and q only, and its factor is kept."""
        return self.model.affine and self.model.steady

    def _system(self, q: Array, h: float, moment: Moment) -> _System:
        """Return the matrix, and B(0) + A(0) q if it is constant, for the last (q, h)."""
        if self._last is None or not self._last[0].same(q, h):
            offset = self._at_zero(q, moment) if self.model.constant else None
            matrix = self._rows[0].matrix(self._data_at(q, h, moment))
            self._last = (_At(q, h), _System(matrix, offset))
        return self._last[1]

    def factor(self, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factor of an affine model for (q, h), made unless it was the last one."""
        if self._made is None or not self._made[0].same(q, h):
            self._made = None  # two at once may be more than there is memory
            self._made = (_At(q, h), self._factorise(self._data_at(q, h, moment)))
        return self._made[1]

    def _known(self, c: Array, system: _System, q: Array, h: float, moment: Moment) -> Array:
        """Return the right-hand side of a stage of an affine model."""
        offset = system.offset if system.offset is not None else self._at_zero(q, moment)
        known: Array = self.model.mass @ (c / h) - offset + self.model.F(moment)
        return known

    def solve(self, c: Array, q: Array, h: float, moment: Moment) -> Array:
        """Return u of one stage; raises `StepFailed`."""
        u = self.model.impose(c, moment)
        if self.keeps:
            system = self._system(q, h, moment)
            residual = system.matrix @ u - self._known(c, system, q, h, moment)
            factor = self.factor(q, h, moment)
            return u - _solved(factor, residual * self.model.X.free)
        equation = _Equation(self, c, q, h, moment)
        return self.newton.solve(equation, u).y

    def tangent(self, u: Array, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factorised Jacobian at a solved stage, for sensitivities."""
        if self.keeps:
            return self.factor(q, h, moment)
        return self.jacobian(u, q, h, moment)

    def advance(
        self,
        c: Array,
        q: Array,
        directions: Array,
        h: float,
        moment: Moment,
        kept: Kept,
        tolerance: float = STATE,
    ) -> tuple[Array, Kept]:
        """Return state and tangents at the end of a stage, and what it leaves to the next.

        Where the matrix depends on q and h only, the factor of an earlier q corrects the solution
        until the error of the state is 1e-8 of its norm, and a hundredth of its change. It is made
        again where that would cost more solves than a factorisation (`Solver.price`), counted from
        when it was made.

        Parameters
        ----------
        c
            The state where the stage begins, and tangents behind it, shape (n, 1 + r).
        directions
            How latent coefficients change along each tangent, shape (m, r).
        kept
            What the stage before has left.
        tolerance
            Bound on the error of the tangents, relative to the norm of all of them; it is a
            hundredth of their change, too.

        Raises
        ------
        StepFailed
            The stage has no solution that is found.
        """
        model, start = self.model, c[:, 1:]
        if not self.keeps or not self.solver.price:
            u = self.solve(c[:, 0], q, h, moment)
            known = self._driven(u, start, q, directions, h, moment)
            tangents = _solved(self.tangent(u, q, h, moment), known * model.X.free[:, None])
            return np.column_stack([u, tangents]), kept
        begin, at = c[:, 0], _At(q, h)
        factor_at = _At(kept.q, kept.h) if len(kept.q) else at
        guess = begin + h * kept.trend if len(kept.q) else begin
        system = self._system(q, h, moment)
        known = self._known(begin, system, q, h, moment)
        corrected = _Corrections(self, system.matrix, at, moment, factor_at, kept.spent)
        u = corrected.solve(begin, model.impose(guess, moment), known, STATE, PASSES)
        known = self._driven(u, start, q, directions, h, moment)
        tangents = corrected.solve(start, start, known, tolerance, PASSES - 1)
        left = Kept(*corrected.factor_at, corrected.spent, (u - begin) / h)
        return np.column_stack([u, tangents]), left

    def _driven(
        self, u: Array, c: Array, q: Array, directions: Array, h: float, moment: Moment
    ) -> Array:
        """Return the right-hand sides of tangents, shape (n, r)."""
        model = self.model
        forcing = model.form_A.product("v", "q", directions, moment, u=u, q=q)
        driven: Array = (model.mass @ c) / h - forcing
        return driven


class _Corrections:
    """Solves with the matrix of one stage by the factor of another.

    Attributes
    ----------
    factor_at
        Where the factor was made that is used now.
    spent
        As for `Kept`.
    """

    def __init__(
        self,
        stage: ForwardStage,
        matrix: sp.csr_array,
        at: _At,
        moment: Moment,
        factor_at: _At,
        spent: float,
    ) -> None:
        self.stage = stage
        self.matrix = matrix
        self.at = at
        self.moment = moment
        self.factor_at = factor_at
        self.spent = spent

    def solve(self, before: Array, start: Array, b: Array, tolerance: float, passes: int) -> Array:
        """Return x with matrix x = b on the free coefficients.

        Parameters
        ----------
        before
            What x was where the stage begins.
        start
            What x is on the fixed ones, and about elsewhere, shape (n,) or (n, r).
        tolerance
            Bound on the error relative to x, both in the Euclidean norm over all columns: that does
            not change where columns of a square root are rotated.
        passes
            Corrections that are as many as expected.
        """
        free = self.stage.model.X.free.reshape(-1, *[1] * (b.ndim - 1))
        width = b[0].size
        exact = self.at.same(*self.factor_at)
        first = (b - self.matrix @ start) * free
        x, r, count = start, first, 0
        while True:
            update = _solved(self.stage.factor(*self.factor_at, self.moment), r)
            x, count = x + update, count + 1
            moved, size = float(np.linalg.norm(update)), float(np.linalg.norm(x))
            if exact or moved <= ROUNDING * size:
                return x
            last, r = float(np.linalg.norm(r)), (b - self.matrix @ x) * free
            rate = float(np.linalg.norm(r)) / last if last else math.inf  # squares may underflow
            if rate <= SLOW:
                left = moved * rate / (1.0 - rate)
                change = float(np.linalg.norm(x - before))
                allowed = max(min(tolerance * size, SHARE * change), ROUNDING * size)
                done = left <= allowed
                more = 0.0 if done else math.log(allowed / left) / math.log(rate)
                spent = self.spent + width * max(count + more - passes, 0)
                if done:
                    self.spent = spent
                    return x
                if spent <= self.stage.solver.price:
                    continue
            # Keeping the factor has cost as much as a new one, or would.
            self.factor_at, self.spent, exact = self.at, 0.0, True
            x, r = start, first


def _solved(factor: Factor, b: Array) -> Array:
    try:
        return factor.solve(b)
    except LinearAlgebraError as error:
        raise StepFailed("singular", str(error)) from error


@dataclass(frozen=True, eq=False)
class _System:
    matrix: sp.csr_array
    offset: Array | None


@dataclass(frozen=True, eq=False)
class _Equation:
    stage: ForwardStage
    c: Array
    q: Array
    h: float
    moment: Moment

    @cached_property
    def source(self) -> Array:
        return self.stage.model.F(self.moment)

    def residual(self, y: Array) -> Array:
        model = self.stage.model
        rate = model.mass @ ((y - self.c) / self.h)
        flux = model.B(y, self.moment) + model.form_A.vector("v", self.moment, q=self.q, u=y)
        masked: Array = (rate + flux - self.source) * model.X.free
        return masked

    def factor(self, y: Array, sweep: bool) -> Factor:
        return self.stage.jacobian(y, self.q, self.h, self.moment)


def simulate(
    model: Model,
    q: Array,
    u0: Any,
    times: Sequence[float],
    control: Advance,
    inputs: Callable[[float], Any] | None = None,
) -> Iterator[tuple[float, Array]]:
    """Yield (t, u) of the forward model at the given times, the first being the initial time.

    Parameters
    ----------
    q
        Coefficients of the parameter, shape (m,).
    u0
        Initial state: a number, a function of x, or coefficients.
    inputs
        t -> mapping of input channels.

    Raises
    ------
    StepFailed
        A step failed even when halved as often as `control` allows.
    """
    values = inputs or (lambda t: {})
    forward = ForwardStage(model)
    none = np.zeros(0)
    u = model.initial(u0, Moment(times[0], values(times[0])))
    yield times[0], u
    for t0, t1 in pairwise(times):
        interval = Interval(t0, t1, values(t0), values(t1), none, none)

        def stage(c: Array, t: float, h: float, interval: Interval = interval) -> Array:
            return forward.solve(c, q, h, interval.at(t))

        u, _, failure = advance(control, stage, u, interval)
        if failure is not None:
            raise failure
        yield t1, u
