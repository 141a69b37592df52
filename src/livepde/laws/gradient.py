"""The paper's update law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.base import Belief, Law, Notes, Problem, Report, Status
from livepde.laws.coupled import CoupledStage
from livepde.laws.damping import Damping, ResidualDamping
from livepde.laws.gains import PULL, Gains
from livepde.laws.memory import Learned, Learning
from livepde.laws.rest import Excitation, Probes, Rest
from livepde.laws.smoothing import Balance, Smoother, smooths
from livepde.laws.warm import Warm
from livepde.linalg import Array
from livepde.model import h1_form
from livepde.observation import Reconstructed, Split
from livepde.stepping import Interval, Newton, advance

__all__ = ["GradientLaw", "GradientState"]

SAME = 1e-9  # of a step: times that are the same but for rounding
HOLD = 1e12  # times heavier is a prior that keeps q where it is


@dataclass(frozen=True, eq=False)
class GradientState:
    """Estimates u^ and q^, shapes (n,) and (m,), and how fast they moved.

    `u_alpha` is the observed part of the state, shape (n,), and `rate` the last change of
    (u^ - u_alpha, q^) per unit of time, shape (n + m,): where the next iteration starts. `warm` is
    what it starts with, and `present`, shape (sensors,), and `resting` tell with which stage that
    was made. `excitation` is what `Rest` goes by.
    """

    u: Array
    q: Array
    u_alpha: Array
    rate: Array
    warm: Warm
    present: Array
    resting: bool
    excitation: Excitation


@dataclass(frozen=True, eq=False)
class LearningState(GradientState):
    """The same of a law that tunes itself, with what the data have taught on q and on noise."""

    learned: Learned
    balance: Balance


class GradientWork:
    """The problem with its operators M_op and N_op and a stage for each set of present sensors."""

    def __init__(
        self,
        problem: Problem,
        gains: Gains,
        newton: Newton,
        learning: Learning | None = None,
        smooths: bool = False,
        probes: Probes | None = None,
    ) -> None:
        self.problem = problem
        self.smooths = smooths
        self.gains = gains
        if problem.control.scheme.order > 1:  # it leaves out less than a first-order start misses
            newton = replace(newton, share=0.0)
        self.newton = newton
        self.learning = learning
        self.probes = probes
        self._stages: dict[tuple[Split, bool], CoupledStage] = {}
        self._smoothers: dict[Split, Smoother] = {}

    def stage(self, present: Array, resting: bool = False) -> CoupledStage:
        """Return the coupled stage for the sensors present; one that holds q."""
        split = self.problem.observed.split(present)
        if (split, resting) not in self._stages:
            if len(self._stages) >= 8:
                self._stages.clear()
            gains = self.gains
            if resting:
                gains = replace(gains, gain=gains.gain / HOLD, sigma=0.0)
            memory = None if self.learning is None else self.learning.pattern
            self._stages[split, resting] = CoupledStage(
                self.problem.model, split, gains, self.newton, memory
            )
        return self._stages[split, resting]

    def smoother(self, present: Array) -> Smoother:
        """Return the smoother for the sensors present."""
        split = self.problem.observed.split(present)
        if split not in self._smoothers:
            if len(self._smoothers) >= 8:
                self._smoothers.clear()
            self._smoothers[split] = Smoother(self.problem.observed, present)
        return self._smoothers[split]


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

        "auto": the law tunes itself, from r, the excitation and the prior (`std` of the unknowns)
        alone. The inverse of the information that the data have given so far takes the place of
        gain G_Q^{-1}, weighed against the prior by a noise level that is estimated as well
        (`livepde.laws.memory` derives it); M_op is the mass and theta h = 10, so `damping`, `M_op`
        and `sigma` are not to be given. Samples of a function (`Subdomain`, `Full`) without a
        `reconstruction` are smoothed as much as their own noise asks for
        (`livepde.laws.smoothing`); exact ones are not. For constant unknowns. What early data
        taught stays when the excitation dies out. The notes of each report hold gain, the scale of
        the inner product before any information, and information, the trace of J G_Q^{-1}/S:
        beyond 1 the data say more than the prior; and departure, the square of the distance of q
        from the prior, over what the prior and the data so far allow (`livepde.laws.memory`):
        beyond 1 model, prior or noise are wrong, and so may q be.
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
    rest
        With a number for gain: when q is held, because nothing excites it but noise, with which it
        would drift; None: never.
    """

    gain: float | Literal["auto"] = 1.0
    damping: Damping = field(default_factory=ResidualDamping)
    nu: float = 0.0
    sigma: float = 0.0
    M_op: Any = h1_form
    N_op: Any = h1_form
    newton: Newton = field(default_factory=Newton)
    rest: Rest | None = field(default_factory=Rest)

    def __post_init__(self) -> None:
        gain: Any = self.gain
        if gain == "auto":
            if (self.damping, self.M_op, self.sigma) != (ResidualDamping(), h1_form, 0.0):
                raise LawError(
                    "GradientLaw: gain='auto' chooses damping, M_op and sigma itself: leave them "
                    "out, or give a number for gain."
                )
        elif isinstance(gain, str) or not (np.isfinite(gain) and gain > 0):
            raise LawError(f"GradientLaw: gain must be a positive number or 'auto'; got {gain!r}.")
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
        if self.gain == "auto":
            return self._tuned(problem)
        M_op = model.bilinear(self.M_op)
        N_op = M_op if self.N_op is self.M_op else model.bilinear(self.N_op)
        gains = Gains(self.gain, self.damping, self.nu, self.sigma, M_op, N_op)
        probes = None if self.rest is None else Probes(model, problem.observed.split())
        return GradientWork(problem, gains, self.newton, probes=probes)

    def _tuned(self, problem: Problem) -> GradientWork:
        model = problem.model
        if model.latent.moves:
            raise LawError(
                "GradientLaw: gain='auto' accumulates what is known of constant unknowns, and here "
                "one moves (evolution=): give a number for gain, or use SensitivityLaw."
            )
        N_op = model.bilinear(self.N_op)
        gains = Gains(np.inf, self.damping, self.nu, 0.0, model.mass, N_op)
        learning = Learning(model, problem.observed.observation.nodal)
        return GradientWork(problem, gains, self.newton, learning, smooths(problem.observed))

    def init(self, work: GradientWork, q0: Array, u0: Array) -> GradientState:
        rate, zero = np.zeros(len(u0) + len(q0)), np.zeros(len(u0))
        present = np.zeros(work.problem.observed.size, dtype=bool)
        fresh = (u0, q0, zero, rate, Warm.none(), present, False, Excitation.none())
        if work.learning is not None:
            balance = Balance.none(work.problem.observed.size, len(u0))
            return LearningState(*fresh, work.learning.init(q0), balance)
        return GradientState(*fresh)

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
        interval = work.problem.control.over(interval)
        z0 = observed.linearised(interval.z0, state.u)
        z1 = observed.linearised(interval.z1, state.u)
        if z1 is not interval.z1:  # a nonlinear sensor
            interval = replace(interval, z0=z0, z1=z1)
        rest, excitation = self.rest, state.excitation
        resting = rest is not None and work.probes is not None and rest.holds(excitation)
        coupled = work.stage(interval.present, resting)
        zero = np.zeros(model.X.dim)
        regularises = observed.observation.reconstruction.regularises
        smoother, balance, alpha, waits = None, None, 0.0, False
        if work.smooths and isinstance(state, LearningState):
            smoother = work.smoother(interval.present)
            balance = state.balance
            times = (interval.t1,) if balance.samples else (interval.t0, interval.t1)
            for t in times:
                z = z1 if t == interval.t1 else z0
                balance = smoother.add(balance, z, model.impose(zero, interval.at(t)))
            alpha, waits = smoother.alpha(balance), smoother.waits(balance)

        def reconstruct(t: float) -> Reconstructed:
            boundary = None if model.homogeneous else model.impose(zero, interval.at(t))
            present = interval.present
            if regularises:
                return observed.reconstruct(interval.z(t), boundary=boundary, present=present)
            if smoother is not None and alpha > 0.0:
                known = zero if boundary is None else boundary
                return Reconstructed(smoother(alpha, interval.z(t), known), alpha, 0.0, None)
            return Reconstructed(coupled.split.reconstruct(interval.z(t), boundary), 0.0, 0.0, None)

        found = Reconstructed(zero, 0.0, 0.0, None)
        learning, length = work.learning, interval.t1 - interval.t0
        metric, spread = None, 0.0
        if learning is not None and isinstance(state, LearningState):
            observed_now = reconstruct(interval.t1).u
            w = observed_now + coupled.split.P @ state.u
            seen = learning.coupling(coupled.split, w, state.q, interval.end)
            spread = learning.spread(state.learned, seen, length) * (HOLD if waits else 1.0)
            metric = learning.metric(state.learned, spread, state.q, length)

        n = model.X.dim
        known = resting == state.resting and interval.present.tobytes() == state.present.tobytes()
        warm = state.warm if known else Warm.none()
        # When the observed part of the state was looked at last, and what it was.
        looked = (interval.t0, state.u_alpha) if known and alpha == 0.0 else (np.inf, zero)

        def stage(c: Array, t: float, h: float) -> Array:
            nonlocal found, warm, looked
            found = reconstruct(t)
            # The observed part moves with the data, the rest as in the step before.
            if abs(t - h - looked[0]) <= SAME * h:
                moved = found.u - looked[1]
            elif regularises or alpha > 0.0:
                moved = found.u - reconstruct(t - h).u
            else:
                change = interval.change(t - h, t)[interval.present]
                moved = coupled.split.inverse @ change
            near = c + h * state.rate
            near[:n] += moved

            def start() -> Array:  # without the change of r
                begin = near.copy()
                begin[:n] -= coupled.split.project(h * state.rate[:n])
                return begin

            y, warm = coupled.solve(c, h, interval.at(t), found.u, start, metric, near, warm)
            looked = (t, found.u)
            return y

        y = np.concatenate([state.u, state.q])
        end, steps, failure = advance(work.problem.control, stage, y, interval)
        held = failure is not None and metric is not None
        if held and metric is not None:  # the state goes on, and nothing is learned
            metric = replace(metric, spread=HOLD * spread, shift=np.zeros_like(state.q))
            end, steps, failure = advance(work.problem.control, stage, y, interval)
        if failure is not None:
            return state, Report(
                Status.of(failure), work.problem.predict(state.u, state.q, interval.end)
            )
        u, q = end[:n], model.latent.clipped(end[n:])
        r = coupled.split.project(u) - found.u
        rate = end - y
        rate[:n] -= found.u - state.u_alpha if known else coupled.split.project(rate[:n])
        rate /= length
        notes: dict[str, float | Callable[[], float]] = {"residual": lambda: model.X.norm(r)}
        if resting:
            notes |= {"at_rest": 1.0}
        if regularises:
            notes |= {"alpha": found.alpha, "misfit": found.misfit}
        elif smoother is not None:
            notes |= {"alpha": alpha}
        predicted = work.problem.predict(u, q, interval.end)
        if rest is not None and work.probes is not None:
            excitation = rest.add(excitation, work.probes(u - r, q, interval.end))
        moved = (u, q, found.u, rate, warm, interval.present, resting, excitation)
        if learning is None or not isinstance(state, LearningState):
            after = GradientState(*moved)
            return after, Report(Status(), predicted, steps, Notes(notes))
        seen = learning.coupling(coupled.split, u - r, q, interval.end)
        learned = state.learned
        if held:
            notes["held"] = 1.0
        elif not waits:
            same = np.array_equal(np.isnan(interval.z0), np.isnan(interval.z1))
            learned = learning.learn(learned, spread, seen, r, length, same)
        notes |= {"gain": PULL / (spread * length), "information": learned.total / spread}
        notes["departure"] = lambda: learning.departure(learned, spread, q)
        after = LearningState(*moved, learned, balance or state.balance)
        return after, Report(Status(), predicted, steps, Notes(notes))

    def belief(self, work: GradientWork, state: GradientState) -> Belief:
        return Belief(state.q, state.u)
