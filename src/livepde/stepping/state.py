"""The forward model with a known parameter: its implicit stage, its tangent, a simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Moment
from livepde.linalg import Array, Assembler, Factor, Pattern, Solver, analyse
from livepde.model import Model
from livepde.stepping.interval import Advance, Interval, advance
from livepde.stepping.newton import Newton, StepFailed

__all__ = ["ForwardStage", "simulate"]


class ForwardStage:
    """Solves M (u - c)/h + B(u) + A(u) q = F(t) for u, with Dirichlet values imposed.

    If B and A are affine in u with derivatives that read neither time nor inputs, the matrix is
    factorised once for each (h, q) and a stage is one back-substitution. What is kept never changes
    the numbers.
    """

    def __init__(self, model: Model, newton: Newton | None = None) -> None:
        self.model = model
        self.newton = newton or Newton()
        self._kept: tuple[tuple[float, bytes], _System] | None = None

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
    def _free(self) -> tuple[Solver, sp.csr_array, Array]:
        """The engine, and the map from the data of the rows to the free part, completed by ones."""
        model = self.model
        whole = Assembler(model.X.dim)
        whole.add("rows", self._rows[0], right=sp.diags_array(model.X.free))
        whole.add("fixed", Pattern.of(sp.eye_array(model.X.dim)))
        pattern, maps = whole.build()
        return analyse(pattern), maps["rows"], maps["fixed"] @ (1.0 - model.X.free)

    def _data(self, u: Array, q: Array, h: float, moment: Moment) -> Array:
        model, maps = self.model, self._rows[1]
        data: Array = maps["M"] @ (model.mass.data / h)
        data += maps["B"] @ model.form_B.data("v", "u", moment, u=u)
        data += maps["A"] @ model.form_A.data("v", "u", moment, u=u, q=q)
        return data

    def jacobian(self, u: Array, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factorised S = M/h + B'(u) + d(A(u) q)/du on the free coefficients."""
        return self._factorise(self._data(u, q, h, moment))

    def _factorise(self, data: Array) -> Factor:
        solver, rows, fixed = self._free
        try:
            return solver.factorise(rows @ data + fixed)
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
        """True if the matrix of a stage depends on h and q only: it is kept for the last ones."""
        return self.model.affine and self.model.steady

    def system(self, q: Array, h: float, moment: Moment) -> _System:
        """Return matrix and factor, and B(0) + A(0) q if it is constant, for the last (q, h)."""
        key = (h, q.tobytes())
        if self._kept is None or self._kept[0] != key:
            data = self._data(np.zeros(self.model.X.dim), q, h, moment)
            offset = self._at_zero(q, moment) if self.model.constant else None
            self._kept = (key, _System(self._rows[0].matrix(data), offset, self._factorise(data)))
        return self._kept[1]

    def solve(self, c: Array, q: Array, h: float, moment: Moment) -> Array:
        """Return u of one stage; raises `StepFailed`."""
        model = self.model
        u = model.impose(c, moment)
        if self.keeps:
            system = self.system(q, h, moment)
            offset = system.offset if system.offset is not None else self._at_zero(q, moment)
            residual = system.matrix @ u - model.mass @ (c / h) + offset - model.F(moment)
            return u - system.factor.solve(residual * model.X.free)
        equation = _Equation(self, c, q, h, moment)
        return self.newton.solve(equation, u).y

    def tangent(self, u: Array, q: Array, h: float, moment: Moment) -> Factor:
        """Return the factorised Jacobian at a solved stage, for sensitivities."""
        if self.keeps:
            return self.system(q, h, moment).factor
        return self.jacobian(u, q, h, moment)


@dataclass(frozen=True, eq=False)
class _System:
    matrix: sp.csr_array
    offset: Array | None
    factor: Factor


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
