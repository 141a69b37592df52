"""The forward model with a known parameter: implicit stage, tangents, and time integration."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

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
    compact,
)
from livepde.model import Model
from livepde.stepping.driven_vector import DrivenVector
from livepde.stepping.interval import Interval
from livepde.stepping.newton import TINY, At, Corrections, Kept, Newton, StepFailed, solved
from livepde.stepping.schemes import Advance, advance

# Relative error of a state that is solved with a reused factor.
STATE = 1e-8
# Rounding error of a sum, relative to the sizes of its terms.
ROUNDING = 1e-15
# Expected number of corrections of the state with the factor of a nearby q; tangents require one
# less. Only further corrections count as excess solves.
PASSES = 2
# Relative asymmetry that is attributed to rounding in the assembly.
LINEAR = 1e-12


class ForwardStage:
    """Implicit stage M (u - c)/h + B(u) + A(u) q = F(t) for u, with Dirichlet values imposed.

    If B and A are affine in u, and their derivatives depend on neither time nor inputs, the matrix
    is factorised once for each (h, q). A stage is then one back-substitution with identical
    results. `advance` also solves for tangents, and reuses a factor for nearby q and h.
    """

    def __init__(self, model: Model, newton: Newton | None = None) -> None:
        self.model = model
        self.newton = newton or Newton()
        self.form = model.physical_A
        self._cached_factor: tuple[At, Factor] | None = None
        self._cached_system: tuple[At, _System] | None = None
        self._rate: tuple[float, Array] | None = None
        # q, the load without inputs, and its derivative by each input.
        self._driving: tuple[Array, Array, Array] | None = None

    def twin(self) -> ForwardStage:
        """Return a stage with the same symbolic analysis and separate factors."""
        _ = self._dual_weights, self.engine  # computed before the copy, to be shared
        stage = copy.copy(self)
        stage._cached_factor = stage._cached_system = stage._rate = stage._driving = None
        return stage

    @cached_property
    def _rows(self) -> tuple[Pattern, dict[str, sp.csr_array]]:
        """Pattern of M/h + B' + d(A q)/du on the free rows, and the maps of its parts."""
        model = self.model
        free = sp.diags_array(model.X.free)
        assembler = Assembler(model.X.dim)
        assembler.add("M", model.form_M.pattern("v", "u"), free)
        assembler.add("B", model.form_B.pattern("v", "u"), free)
        assembler.add("A", self.form.pattern("v", "u"), free)
        return assembler.build()

    @cached_property
    def _free(self) -> tuple[Pattern, sp.csr_array, Array]:
        """Pattern and map from row data to the free block, with ones on fixed diagonals."""
        model = self.model
        assembler = Assembler(model.X.dim)
        assembler.add("rows", self._rows[0], right=sp.diags_array(model.X.free))
        assembler.add("fixed", Pattern.of(sp.eye_array(model.X.dim)))
        pattern, maps = assembler.build()
        return pattern, maps["rows"], maps["fixed"] @ (1.0 - model.X.free)

    @cached_property
    def symmetric(self) -> bool:
        """Whether the matrix of a stage is expected to be symmetric for all q and h."""
        if not self.keeps:
            return False
        # If the matrix is linear in q, a test with one random q is correct with probability one.
        # `_factorise` tests every matrix again.
        model, rows = self.model, self._free[1]
        amplitudes = np.random.default_rng(0).standard_normal(model.Q.dim) * model.latent.deviations
        inputs = Inputs(dict.fromkeys(model.channels, 1.0))
        with np.errstate(all="ignore"):
            q = model.latent.value(model.latent.prior + amplitudes)
            without_mass = self._data_at(q, math.inf, Moment(0.0, inputs))
        parts = (self._rows[1]["M"] @ model.mass.data, without_mass)
        return all(self._mirrored(rows @ part) for part in parts)

    @cached_property
    def _mirror(self) -> IntArray:
        """Positions of transposed entries in the data of the free block."""
        pattern = self._free[0]
        return pattern.positions(pattern.indices, pattern.rows)

    def _mirrored(self, data: Array) -> bool:
        """Return whether data of the free block are symmetric, relative to the diagonal."""
        # Entries of a positive definite matrix satisfy |a_ij| <= sqrt(a_ii a_jj). This scale does
        # not depend on the units of the components of the state.
        pattern = self._free[0]
        scale = np.sqrt(np.abs(pattern.matrix(data).diagonal()))
        allowed = LINEAR * scale[pattern.rows] * scale[pattern.indices]
        return bool(np.all(np.abs(data - data[self._mirror]) <= allowed))

    @cached_property
    def engine(self) -> Choice:
        """Solver chosen for the matrix of a stage, with the reason."""
        return choose(self._free[0], symmetric=self.symmetric)

    @property
    def solver(self) -> Solver:
        return self.engine.solver

    @cached_property
    def _general(self) -> Solver:
        """Solver for matrices that are not positive definite."""
        return analyse(self._free[0])

    def _data(self, u: Array, q: Array, h: float, moment: Moment) -> Array:
        """Return the data of the matrix rows at a state; q is physical, also in private methods."""
        model, maps = self.model, self._rows[1]
        data: Array = maps["M"] @ (model.mass.data / h)
        data += maps["B"] @ model.form_B.data("v", "u", moment, u=u)
        data += maps["A"] @ self.form.data("v", "u", moment, u=u, q=q)
        return data

    def _data_at(self, q: Array, h: float, moment: Moment) -> Array:
        """Return the data of the matrix rows of an affine model; constant parts are cached."""
        model, maps = self.model, self._rows[1]
        zero = np.zeros(model.X.dim)
        rate = self._rate  # read only once: copies of an identifier may step in other threads
        if rate is None or rate[0] != h:
            data = maps["M"] @ (model.mass.data / h)
            data += maps["B"] @ model.form_B.data("v", "u", moment, u=zero)
            self._rate = rate = (h, data)
        if self._slope is not None:
            changing: Array = self._slope @ q
        elif self.form.fixed_by_numbers:
            changing = maps["A"] @ self.form.about(q).by_state
        else:
            changing = maps["A"] @ self.form.data("v", "u", moment, u=zero, q=q)
        return changing + rate[1]

    @cached_property
    def _slope(self) -> sp.csr_array | Array | None:
        """Linear map from q to the data of d(A q)/du; None if there is no sparse tensor."""
        tensor = self.form.tensor("v", "u")
        if not isinstance(tensor, sp.csr_array):  # no tensor, or the mesh is large
            return None
        return compact(sp.csr_array(self._rows[1]["A"] @ tensor))

    def dual(self, functional: Array) -> float:
        """Return the dual norm of a functional on the state, by the lumped (diagonal) mass."""
        return math.sqrt(float((functional * functional) @ self._dual_weights))

    @cached_property
    def _dual_weights(self) -> Array:
        diagonal = np.abs(self.model.mass.diagonal())
        largest = diagonal.max(initial=0.0) or 1.0
        # Algebraic components have no mass and use the largest diagonal entry instead.
        return self.model.X.free / np.where(diagonal > 0.0, diagonal, largest)

    @cached_property
    def _mass(self) -> sp.csr_array | Array:
        return compact(self.model.mass)

    def jacobian(self, u: Array, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factorised S = M/h + B'(u) + d(A(u) q)/du on the free coefficients."""
        return self._factorise(self._data(u, self.model.latent.value(q), h, moment))

    def _factorise(self, data: Array) -> Factor:
        _, rows, fixed = self._free
        free_data = rows @ data + fixed if len(self.model.X.fixed) else data
        # A Cholesky solver reads only one triangle, so a nonsymmetric matrix would go unnoticed.
        if not self.solver.definite or self._mirrored(free_data):
            try:
                return self.solver.factorise(free_data)
            except LinearAlgebraError as error:
                if not self.symmetric:
                    raise StepFailed("singular", str(error)) from error
        try:  # the matrix is not positive definite for extreme q, but the step may still succeed
            return self._general.factorise(free_data)
        except LinearAlgebraError as error:
            raise StepFailed("singular", str(error)) from error

    @cached_property
    def _offset(self) -> tuple[Array, sp.csr_array | None]:
        """B(0) of an affine, constant model, and A(0) if it is linear in q."""
        zero = np.zeros(self.model.X.dim)
        A = self.form.matrix("v", "q", u=zero) if self.form.linear_in_parameter else None
        return self.model.B(zero), A

    def _at_zero(self, q: Array, moment: Moment) -> Array:
        """Return B(0) + A(0) q of an affine model."""
        model, zero = self.model, np.zeros(self.model.X.dim)
        if not model.constant:
            return model.B(zero, moment) + self.form.vector("v", moment, q=q, u=zero)
        offset, constant = self._offset
        if self.form.fixed_by_numbers:
            return offset + self.form.about(q).at_zero
        if constant is None:
            return offset + self.form.vector("v", moment, q=q, u=zero)
        return offset + constant @ q if constant.data.any() else offset

    @property
    def keeps(self) -> bool:
        """Whether the matrix of a stage depends only on h and q, so that its factor is reusable."""
        return self.model.affine and self.model.steady

    def _system(self, q: Array, h: float, moment: Moment) -> _System:
        """Return matrix and constant offset B(0) + A(0) q, cached for the last (q, h)."""
        cached = self._cached_system
        if cached is None or not cached[0].same(q, h):
            physical = self.model.latent.value(q)
            data = self._data_at(physical, h, moment)
            offset = self._at_zero(physical, moment) if self.model.constant else None
            cached = (At(q, h), _System(data, self._rows[0].compact(data), offset))
            self._cached_system = cached
        return cached[1]

    def factor(self, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factor of an affine model for (q, h), cached for the last pair."""
        cached, system = self._cached_factor, self._cached_system
        if cached is None or not cached[0].same(q, h):
            self._cached_factor = cached = None  # memory may not suffice for two factors
            if system is not None and system[0].same(q, h):
                data = system[1].data
            else:
                data = self._data_at(self.model.latent.value(q), h, moment)
            self._cached_factor = cached = (At(q, h), self._factorise(data))
        return cached[1]

    def _right_side(self, c: Array, system: _System, q: Array, h: float, moment: Moment) -> Array:
        """Return the right-hand side of a stage of an affine model."""
        right_side: Array = self._mass @ (c / h)
        if system.offset is not None:
            return right_side - system.offset + self.model.F(moment)
        if not self._driven_affinely:
            physical = self.model.latent.value(q)
            return right_side - self._at_zero(physical, moment) + self.model.F(moment)
        driving = self._driving  # read only once: copies of an identifier may step in other threads
        if driving is None or not np.array_equal(driving[0], q):
            self._driving = driving = (q, *self._load(self.model.latent.value(q)).assembled())
        _, base, changes = driving
        inputs = np.array([moment.inputs[name] for name in self.model.channels])
        return right_side + base + inputs @ changes

    def _load(self, q: Array) -> DrivenVector:
        """Return F - B(0) - A(0) q of an affine model, as a function of time and inputs."""
        model, forms = self.model, (self.model.form_F, self.model.form_B, self.form)

        def load(moment: Moment) -> Array:
            return model.F(moment) - self._at_zero(q, moment)

        return DrivenVector(load, model.channels, lambda: any("t" in form.uses for form in forms))

    @cached_property
    def _driven_affinely(self) -> bool:
        """Whether the load is affine in the inputs and independent of time.

        Tested at a random q: at the prior mean, a product of an unknown and an input may vanish.
        """
        latent = self.model.latent
        amplitudes = np.random.default_rng(0).standard_normal(latent.dim) * latent.deviations
        with np.errstate(all="ignore"):
            return self._load(latent.value(latent.prior + amplitudes)).responses is not None

    def solve(self, c: Array, q: Array, h: float, moment: Moment) -> Array:
        """Return the state at the end of a stage; raise `StepFailed` without a solution."""
        u = self.model.impose(c, moment)
        if self.keeps:
            system = self._system(q, h, moment)
            residual = system.matrix @ u - self._right_side(c, system, q, h, moment)
            return u - solved(self.factor(q, h, moment), residual * self.model.X.free)
        equation = _StageEquation(self, c, self.model.latent.value(q), h, moment)
        return self.newton.solve(equation, u).at.y

    def tangent(self, u: Array, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factorised Jacobian at a solved stage, for sensitivities."""
        if self.keeps:
            return self.factor(q, h, moment)
        return self.jacobian(u, q, h, moment)

    def linearised(
        self, u: Array, q: Array, h: float, moment: Moment
    ) -> tuple[Factor, sp.csr_array | Array]:
        """Return the factor of S = M/h + B'(u) + d(A(u) q)/du, and S as a matrix.

        The factor is restricted to free coefficients; the matrix has free rows and all columns.
        """
        if self.keeps:
            rows = self._system(q, h, moment).matrix  # first, since `factor` reuses its data
            return self.factor(q, h, moment), rows
        data = self._data(u, self.model.latent.value(q), h, moment)
        return self._factorise(data), self._rows[0].matrix(data)

    def advance(
        self,
        c: Array,
        q: Array,
        directions: Array,
        h: float,
        moment: Moment,
        kept: Kept,
        tolerance: float = STATE,
        apart: int = 0,
    ) -> tuple[Array, Kept]:
        """Return state and tangents at the end of a stage, and its warm-start data.

        If the matrix depends only on q and h, the factor of an earlier q is used for iterative
        refinement. It ends if the error of the state is below 1e-8 of its norm and 1 % of its
        change. The matrix is factorised again if the excess solves since the last factorisation
        would cost more than a new one (`Solver.price`).

        Parameters
        ----------
        c
            State and tangents at the beginning of the stage, shape (n, 1 + r).
        directions
            Derivative of the latent coefficients of q along each tangent, shape (m, r).
        tolerance
            Bound on the error of the tangents, relative to the norm of all of them. A second bound
            is 1 % of their change.
        apart
            Number of trailing tangents that are solved separately, by one correction.

        Raises
        ------
        StepFailed
            The solver finds no solution of the stage.
        """
        model, begin, free = self.model, c[:, 0], self.model.X.free[:, None]
        new, end = np.empty_like(c), c.shape[1] - apart
        groups = [part for part in (slice(1, end), slice(end, c.shape[1])) if c[0, part].size]

        def driven(u: Array, part: slice) -> Array:
            along = directions[:, part.start - 1 : part.stop - 1]  # the state has no direction
            return self._driven(u, c[:, part], q, along, h, moment)

        if not self.keeps or not self.solver.price:
            new[:, 0] = u = self.solve(begin, q, h, moment)
            if groups:
                tangent = self.tangent(u, q, h, moment)
                for part in groups:
                    new[:, part] = solved(tangent, driven(u, part) * free)
            return new, kept
        # Predict the state by linear extrapolation in time: a better predictor saves corrections.
        guess = begin + h * kept.trend if len(kept.q) else begin
        system = self._system(q, h, moment)
        known = self._right_side(begin, system, q, h, moment)
        corrections = self._corrections(system, At(q, h), moment, kept)
        new[:, 0] = u = corrections.solve(begin, model.impose(guess, moment), known, STATE, PASSES)
        current = At(q, h).same(*corrections.factor_at)
        for part in groups:
            start, known = c[:, part], driven(u, part)
            if current:  # a direct solve requires no initial guess
                known *= free
                new[:, part] = solved(self.factor(q, h, moment), known)
            elif part.start == end:
                new[:, part] = corrections.correct(start, known)
            else:
                new[:, part] = corrections.solve(start, start, known, tolerance, PASSES - 1)
        return new, Kept(*corrections.factor_at, corrections.spent, (u - begin) / h)

    def _corrections(self, system: _System, at: At, moment: Moment, kept: Kept) -> Corrections:
        """Return the refinement for a stage that starts with the factor of an earlier stage."""
        return Corrections(
            system.matrix,
            at,
            self.model.X.free,
            lambda q, h: self.factor(q, h, moment),
            self.solver.price,
            At(kept.q, kept.h) if len(kept.q) else at,
            kept.spent,
        )

    def _driven(
        self, u: Array, c: Array, q: Array, directions: Array, h: float, moment: Moment
    ) -> Array:
        """Return the right-hand sides of tangents, shape (n, r)."""
        arguments = {} if self.form.linear_in_parameter else {"q": self.model.latent.value(q)}
        if self.form.fixed_by_numbers:
            forcing = self.form.about(arguments["q"]).product(directions, u)
        else:
            forcing = self.form.product("v", "q", directions, moment, u=u, **arguments)
        driven: Array = self._mass @ c
        driven /= h
        driven -= forcing
        return driven


@dataclass(frozen=True, eq=False)
class _System:
    """Matrix of a stage, as data and as a matrix, and B(0) + A(0) q if constant, else None."""

    data: Array
    matrix: sp.csr_array | Array
    offset: Array | None


@dataclass(frozen=True, eq=False)
class _StateEvaluation:
    """Nonlinear stage equation evaluated at a state, a `StagePoint`."""

    y: Array
    residual: Array
    size: float
    resolved: bool = True


@dataclass(frozen=True, eq=False)
class _StageEquation:
    """Nonlinear equation of a stage, a `StageEquation`."""

    stage: ForwardStage
    c: Array
    q: Array
    h: float
    moment: Moment

    @cached_property
    def source(self) -> Array:
        return self.stage.model.F(self.moment)

    def evaluate(self, y: Array) -> _StateEvaluation:
        model = self.stage.model
        rate = model.mass @ ((y - self.c) / self.h)
        driven = self.stage.form.vector("v", self.moment, q=self.q, u=y)
        flux = model.B(y, self.moment)
        residual = (rate + flux + driven - self.source) * model.X.free
        error, *sizes = (
            self.stage.dual(term) for term in (residual, rate, flux, driven, self.source)
        )
        return _StateEvaluation(y, residual, error / max(*sizes, TINY))

    def factor(self, at: _StateEvaluation) -> Factor:
        return self.stage._factorise(self.stage._data(at.y, self.q, self.h, self.moment))

    def limited(self, at: _StateEvaluation, allowed: float) -> bool:
        stage, moment = self.stage, self.moment
        data = np.abs(stage._data(at.y, self.q, self.h, moment))
        # The rounding error is proportional to |S| |u|, the sum of the sizes of terms in each row.
        sizes = stage._rows[0].matrix(data) @ np.maximum(np.abs(at.y), np.abs(self.c))
        error = stage.dual(at.residual)
        rounding = ROUNDING * max(stage.dual(sizes), stage.dual(self.source))
        return error <= max(allowed * error / max(at.size, TINY), rounding)


def simulate(
    model: Model,
    q: Array,
    u0: Any,
    times: Sequence[float],
    control: Advance,
    inputs: Callable[[float], Any] | None = None,
) -> Iterator[tuple[float, Array]]:
    """Yield (t, u) of the forward model at the given times, starting with the initial time.

    Parameters
    ----------
    q
        Coefficients of the parameter, shape (m,).
    u0
        Initial state: a number, a function of x, or coefficients.
    inputs
        Function t -> mapping of input channels.

    Raises
    ------
    StepFailed
        A step failed after the maximum number of halvings of `control`.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    >>> q = rod.initial_parameter({"alpha": 0.07})
    >>> run = lp.simulate(rod, q, 1.0, [0.0, 0.5, 1.0], lp.Advance(lp.Alexander2()))
    >>> [t for t, u in run]
    [0.0, 0.5, 1.0]
    """
    values = inputs or (lambda t: {})
    forward = ForwardStage(model)
    none = np.zeros(0)
    u = model.impose(model.initial_values(u0), Moment(times[0], values(times[0])))
    yield times[0], u
    for t0, t1 in pairwise(times):
        interval = Interval(t0=t0, t1=t1, inputs0=values(t0), inputs1=values(t1), z0=none, z1=none)

        # The interval is bound as a default, since a closure would use a later iteration's value.
        def stage(c: Array, t: float, h: float, interval: Interval = interval) -> Array:
            return forward.solve(c, q, h, interval.at(t))

        u, _, failure = advance(control, stage, u, t0, t1)
        if failure is not None:
            raise failure
        yield t1, u
