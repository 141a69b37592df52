"""The paper's update law."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.base import Belief, Law, Problem, Report, Status
from livepde.laws.coupled import CoupledStage, Gains
from livepde.laws.damping import Damping, ResidualDamping
from livepde.linalg import Array
from livepde.model import h1_form
from livepde.observation import Reconstructed, Split
from livepde.stepping import Interval, Newton, advance

__all__ = ["GradientLaw", "GradientState"]


@dataclass(frozen=True, eq=False)
class GradientState:
    """Estimates u^ and q^, shapes (n,) and (m,), and how fast they moved.

    `rate` is the last change of (P u^, q^) per unit of time, shape (n + m,): where the next
    iteration starts.
    """

    u: Array
    q: Array
    rate: Array


class GradientWork:
    """The problem with its operators M_op and N_op and a stage for each set of present sensors."""

    def __init__(self, problem: Problem, gains: Gains, newton: Newton) -> None:
        self.problem = problem
        self.gains = gains
        self.newton = newton
        self._stages: dict[Split, CoupledStage] = {}

    def stage(self, present: Array) -> CoupledStage:
        """Return the coupled stage for the sensors present."""
        split = self.problem.observed.split(present)
        if split not in self._stages:
            if len(self._stages) >= 8:
                self._stages.clear()
            self._stages[split] = CoupledStage(self.problem.model, split, self.gains, self.newton)
        return self._stages[split]


@dataclass(frozen=True)
class GradientLaw(Law[GradientWork, GradientState]):
    """The online method of Boiger and Kaltenbacher, (est_exact_q) and (est_exact_u).

        q' = gain A(w)* r - sigma q,            w = u_alpha + P u,  r = R u - u_alpha
        M u' + B(w) + A(w) q + theta R^T M_op r + nu P^T N_op P u = F

    u_alpha = G^+ z, or G_alpha z if the observation has a `reconstruction` that regularises: then
    these are (noisy_q) and (noisy_u), and the notes of each report hold alpha and the misfit
    ||G u_alpha - z||_Z.

    For observed subdomains and averages. A few noisy point sensors mislead it (jumps of the flux at
    the sensors reward a vanishing diffusivity): use `SensitivityLaw` there.

    Parameters
    ----------
    gain
        Scale of the inner product of Q, > 0. The theory holds for every value; it sets how fast q
        learns. Stable for every value, because u and q are solved together.
    damping
        Rule for theta = mu / ||r||_V~.
    nu
        Weight of P N P u >= 0. It biases the unobserved part and is needed only where the dynamics
        do not damp that part (D <= 0).
    sigma
        Stabilising term of (noisy_q), >= 0.
    M_op, N_op
        Integrands (u, v, x) of M and N of (MN1), (MN2); default u v + grad u . grad v.
        `observed_operator(omega, D)` and `unobserved_operator(omega, D)` are the paper's, with |D|.
    newton
        The nonlinear iteration.
    """

    gain: float = 1.0
    damping: Damping = field(default_factory=ResidualDamping)
    nu: float = 0.0
    sigma: float = 0.0
    M_op: Any = h1_form
    N_op: Any = h1_form
    newton: Newton = field(default_factory=Newton)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gain) and self.gain > 0):
            raise LawError(f"GradientLaw: gain must be a positive number; got {self.gain}.")
        for name in ("nu", "sigma"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise LawError(f"GradientLaw: {name} must be a number >= 0; got {value}.")

    def prepare(self, problem: Problem) -> GradientWork:
        if not problem.observed.linear:
            raise LawError(
                "GradientLaw needs readings z = G u; this observation is not linear or sees a "
                "parameter directly: use SensitivityLaw."
            )
        model = problem.model
        M_op = model.bilinear(self.M_op)
        N_op = M_op if self.N_op is self.M_op else model.bilinear(self.N_op)
        gains = Gains(self.gain, self.damping, self.nu, self.sigma, M_op, N_op)
        return GradientWork(problem, gains, self.newton)

    def init(self, work: GradientWork, q0: Array, u0: Array) -> GradientState:
        return GradientState(u0, q0, np.zeros(len(u0) + len(q0)))

    def start(self, work: GradientWork, q0: Array, u0: Array, moment: Moment) -> GradientState:
        form = work.problem.model.form_initial
        if form is not None and form.data("v", "q", moment, q=q0).any():
            raise LawError(
                "the initial state depends on unknowns (initial=), which this law cannot learn: "
                "use SensitivityLaw, or leave out initial= and give u0."
            )
        return self.init(work, q0, u0)

    def step(
        self, work: GradientWork, state: GradientState, interval: Interval
    ) -> tuple[GradientState, Report]:
        model, observed = work.problem.model, work.problem.observed
        z0, z1 = (observed.linearised(z, state.u) for z in (interval.z0, interval.z1))
        if z1 is not interval.z1:  # a nonlinear sensor
            interval = replace(interval, z0=z0, z1=z1)
        coupled = work.stage(interval.present)
        zero = np.zeros(model.X.dim)
        regularises = observed.observation.reconstruction.regularises

        def reconstruct(t: float) -> Reconstructed:
            boundary = model.impose(zero, interval.at(t))
            present = interval.present
            if regularises:
                return observed.reconstruct(interval.z(t), boundary=boundary, present=present)
            return Reconstructed(coupled.split.reconstruct(interval.z(t), boundary), 0.0, 0.0, None)

        found = Reconstructed(zero, 0.0, 0.0, None)

        def stage(c: Array, t: float, h: float) -> Array:
            nonlocal found
            found = reconstruct(t)
            # The observed part moves with the data, the rest as in the step before.
            start = c + h * state.rate
            if regularises:
                start[: model.X.dim] += found.u - reconstruct(t - h).u
            else:
                start[: model.X.dim] += (
                    coupled.split.inverse @ interval.change(t - h, t)[interval.present]
                )
            return coupled.solve(c, h, interval.at(t), found.u, start)

        y = np.concatenate([state.u, state.q])
        end, steps, failure = advance(work.problem.control, stage, y, interval)
        if failure is not None:
            return state, Report(
                Status.of(failure), work.problem.predict(state.u, state.q, interval.end)
            )
        lower, upper = model.latent.bounds
        u, q = end[: model.X.dim], np.clip(end[model.X.dim :], lower, upper)
        observed_u = coupled.split.R @ u
        rate = end - y
        rate[: model.X.dim] -= observed_u - coupled.split.R @ state.u
        rate /= interval.t1 - interval.t0
        notes = {"residual": model.X.norm(observed_u - found.u)}
        if regularises:
            notes |= {"alpha": found.alpha, "misfit": found.misfit}
        predicted = work.problem.predict(u, q, interval.end)
        return GradientState(u, q, rate), Report(Status(), predicted, steps, notes)

    def belief(self, work: GradientWork, state: GradientState) -> Belief:
        return Belief(state.q, state.u)
