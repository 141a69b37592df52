"""Two related laws as the paper describes them, on the coupled stage of the paper's law.

Boiger and Kaltenbacher call their method "strongly motivated" by both. The equations follow their
description, not the original articles: Baumeister et al. observe the full state, Kügler requires a
monotone C and evaluates it at the estimate.

                  C evaluated at          pull                      q^' = gain A(.)* r, r
    paper         u_alpha + P u^          mu R M r / ||r||_V~       R u^ - u_alpha
    Baumeister    z, all of u             A_0 (u^ - z)              u^ - z
    Kügler        u^                      mu G* (G u^ - z)          R u^ - u_alpha
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.coupled.equation import StageForms
from livepde.laws.damping import Damping, Residual
from livepde.laws.gradient import GradientLaw, GradientParts, GradientState, constant_parts
from livepde.laws.law import Belief, Law, Problem, Report
from livepde.linalg import Array
from livepde.model import h1_form
from livepde.stepping import Interval, Newton


@dataclass(frozen=True)
class _Linear(Damping):
    """Damping that is linear in r: theta is a constant."""

    weight: float

    def theta(self, r: Residual) -> float:
        return self.weight

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        return 0.0, 0.0, 0.0


@dataclass(frozen=True)
class _Relative(Law[GradientParts, GradientState]):
    """Law on the coupled stage of the gradient law, with damping linear in r."""

    gain: float = 1.0
    mu: float = 1.0
    newton: Newton = field(default_factory=Newton)

    def __post_init__(self) -> None:
        for name, least in (("gain", "> 0"), ("mu", ">= 0")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0 and (name == "mu" or value > 0)):
                raise LawError(
                    f"{type(self).__name__}: {name} must be a number {least}; got {value}."
                )

    @property
    def _base(self) -> GradientLaw:
        # The gradient law makes the steps; only `work`, which `_parts` builds, differs.
        return GradientLaw(self.gain, _Linear(self.mu), newton=self.newton)

    def _parts(self, problem: Problem, pull: Any) -> GradientParts:
        damping = _Linear(self.mu)
        return constant_parts(problem, self.gain, damping, self.newton, M_op=pull, N_op=pull)

    def init(self, work: GradientParts, q0: Array, u0: Array) -> GradientState:
        return self._base.init(work, q0, u0)

    def start(self, work: GradientParts, q0: Array, u0: Array, moment: Moment) -> GradientState:
        return self._base.start(work, q0, u0, moment)

    def step(
        self, work: GradientParts, state: GradientState, interval: Interval
    ) -> tuple[GradientState, Report]:
        return self._base.step(work, state, interval)

    def belief(self, work: GradientParts, state: GradientState) -> Belief:
        return self._base.belief(work, state)


@dataclass(frozen=True)
class BaumeisterLaw(_Relative):
    """The adaptive observer of Baumeister, Scondo, Demetriou and Rosen (1997), as in the paper.

    SIAM Journal on Control and Optimization 35, 678-713. The full state is measured, z = u:

        q' = gain A(z)* (u^ - z)
        M u^' + B(z) + A(z) q^ + mu A_0 (u^ - z) = F

    with a coercive operator A_0 that pulls u^ towards the measured state; one implicit step solves
    both equations together. These are (est_exact_q), (est_exact_u) for R = I, P = 0, with A_0
    instead of mu M / ||r||_V~. Boiger and Kaltenbacher added P u^ where nothing is measured, and
    damping whose size mu adapts.

    Parameters
    ----------
    gain
        Scale of the inner product of Q, > 0.
    mu
        Weight of A_0, >= 0, in 1/time.
    newton
        The nonlinear iteration.
    A_0
        Integrand (u, v, x), coercive; default u v + grad u . grad v.

    Raises
    ------
    LawError
        From `prepare`, if the sensors do not determine the full state. Missing readings of a sample
        are no error: the law then estimates the unobserved part as the paper's law does.
    """

    A_0: Any = h1_form

    def prepare(self, problem: Problem) -> GradientParts:
        X, split = problem.model.X, problem.observed.split()
        free = int(X.free.sum())
        seen = round(float(split.R.diagonal().sum()))  # trace of a projection: its rank
        if seen < free:
            raise LawError(
                f"BaumeisterLaw needs all of the state; the sensors determine {seen} of its {free} "
                "coefficients. Use GradientLaw, which estimates what is not observed, KueglerLaw "
                "if C is monotone, or observe Full()."
            )
        return self._parts(problem, self.A_0)


class _FormsAtEstimate(StageForms):
    """Stage forms that evaluate A and B at the estimate on omega as well: w = u^."""

    def argument(self, u: Array, r: Array) -> Array:
        return u

    @cached_property
    def W(self) -> sp.csr_array:
        return sp.csr_array(sp.eye_array(self.model.X.dim))


class _PartsAtEstimate(GradientParts):
    """Parts of the gradient law whose stages use `_FormsAtEstimate`."""

    @classmethod
    def of(cls, parts: GradientParts) -> GradientParts:
        given = {part.name: getattr(parts, part.name) for part in fields(parts)}
        # The stages cached in `parts` use the forms of the paper's law.
        del given["_stages"]
        return cls(**given).prepared()

    def forms(self, present: Array) -> StageForms:
        split = self.problem.observed.split(present)
        return _FormsAtEstimate(self.problem.model, split, self.M_op, self.N_op, self.nu)


@dataclass(frozen=True)
class KueglerLaw(_Relative):
    """The law of Kügler (2010), as in the paper, for a monotone C evaluated at the estimate.

    Inverse Problems 26, 035004: "Online parameter identification without Ricatti-type equations in
    a class of time-dependent partial differential equations: an extended state approach with
    potential to partial observations".

        q' = gain A(u^)* r                       r = R u^ - u_alpha
        M u^' + B(u^) + A(u^) q^ + mu G* (G u^ - z) = F

    One implicit step solves both equations together. With ||z||_Z = ||G^+ z||_X, mu G* (G u^ - z)
    is mu R^T M r. Compared with (est_exact_q), (est_exact_u), u^ replaces u_alpha + P u^. So data
    enter through r alone, and B does not differentiate noise. In return, the energy balance
    (align:neplusnr) contains (C(q*, u^) - C(q*, u*), u^ - u*), which must be nonnegative. With
    partial data, (A(u^) e, P u^ - P u*) does not cancel, and there is no proof.

    Parameters
    ----------
    gain
        Scale of the inner product of Q, > 0.
    mu
        Weight of G* (G u^ - z), >= 0, in 1/time.
    newton
        The nonlinear iteration.
    """

    def prepare(self, problem: Problem) -> GradientParts:
        # Without M_op the damping term is mu R^T M r.
        return _PartsAtEstimate.of(self._parts(problem, None))
