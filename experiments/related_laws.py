"""Two laws after the paper's description of related methods, through its coupled stage.

Boiger and Kaltenbacher call their method "strongly motivated" by both. The original articles were
not read. The equations below follow the description by Boiger and Kaltenbacher: Baumeister et al.
observe all of the state, Kügler requires a monotone C and evaluates it at the estimate.

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
    """A pull that is linear in r: theta is a number."""

    weight: float

    def theta(self, r: Residual) -> float:
        return self.weight

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        return 0.0, 0.0, 0.0


@dataclass(frozen=True)
class _Relative(Law[GradientParts, GradientState]):
    """A law on the coupled stage of the gradient law, with a linear pull."""

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
        # The step is that of the gradient law: what differs is in `work`, from `_parts`.
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
    """The adaptive observer as the paper describes Baumeister, Scondo, Demetriou and Rosen (1997).

    SIAM Journal on Control and Optimization 35, 678-713. All of the state is measured, z = u:

        q' = gain A(z)* (u^ - z)
        M u^' + B(z) + A(z) q^ + mu A_0 (u^ - z) = F

    with a coercive operator A_0 that draws u^ to the measured state; both equations are solved
    together in one implicit step. It is (est_exact_q), (est_exact_u) for R = I, P = 0, with the
    coercive A_0 instead of mu M / ||r||_V~: Boiger and Kaltenbacher added P u^ where nothing
    is measured, and a pull whose size mu adapts.

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
        From `prepare`: some of the state is not observed. A sample that lacks sensors is no error:
        the part of the state without a reading is estimated as by the paper's law.
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
    """Forms with A and B at the estimate over omega, too: w = u^."""

    def argument(self, u: Array, r: Array) -> Array:
        return u

    @cached_property
    def W(self) -> sp.csr_array:
        return sp.csr_array(sp.eye_array(self.model.X.dim))


class _PartsAtEstimate(GradientParts):
    """Parts of the gradient law whose stages have such forms."""

    @classmethod
    def of(cls, parts: GradientParts) -> GradientParts:
        given = {part.name: getattr(parts, part.name) for part in fields(parts)}
        # The stages that `parts` has kept have the forms of the paper's law.
        del given["_stages"]
        return cls(**given).prepared()

    def forms(self, present: Array) -> StageForms:
        split = self.problem.observed.split(present)
        return _FormsAtEstimate(self.problem.model, split, self.M_op, self.N_op, self.nu)


@dataclass(frozen=True)
class KueglerLaw(_Relative):
    """The law for monotone C, evaluated at the estimate, as the paper describes Kügler (2010).

    Inverse Problems 26, 035004: "Online parameter identification without Ricatti-type equations in
    a class of time-dependent partial differential equations: an extended state approach with
    potential to partial observations".

        q' = gain A(u^)* r                       r = R u^ - u_alpha
        M u^' + B(u^) + A(u^) q^ + mu G* (G u^ - z) = F

    both solved together in one implicit step. With ||z||_Z = ||G^+ z||_X the pull mu G* (G u^ - z)
    is mu R^T M r. Against (est_exact_q), (est_exact_u): u^ stands for u_alpha + P u^, so the data
    enter through r alone and noise is never differentiated by B; in return the energy balance
    (align:neplusnr) holds the term (C(q*, u^) - C(q*, u*), u^ - u*), which must not be negative.
    With partial data (A(u^) e, P u^ - P u*) does not cancel, so nothing is proved then.

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
        # Without M_op the pull is mu R^T M r.
        return _PartsAtEstimate.of(self._parts(problem, None))
