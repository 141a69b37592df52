"""Answers of the process to terms that its model may lack: a source, a loss, a boundary value.

The free response p of the state to a term, M p' + (B + A q)' p = load, goes on by implicit Euler
steps over several samples, and its effect on the sensors is interpolated between these steps. The
response is needed to a tenth of its size, to tell causes apart, and so costs a fraction of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from livepde.fem import Inputs, Moment, On
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.stepping import ForwardStage

__all__ = ["Now", "Process", "Term", "stride"]

REACH = 64.0  # samples in which a source of amplitude one moves the state by three times the noise
DEVIATIONS = 3.0
GAIN = 0.1  # of a channel of a source or flux
LOSS = 0.1  # in `REACH` samples
MOST_STRIDE = 16  # samples of one step
MOST_ENDS = 4  # boundaries of the mesh that are looked at


@dataclass(frozen=True)
class Now:
    """Where a response stands: state, latent parameter, inputs, usual interval and rest state.

    Attributes
    ----------
    u, q, moment, unit
        The state, the latent parameter, time and inputs, and the usual time between samples.
    rest
        Value at which the state has nothing to lose: the mean of the sensors at the start.
    """

    u: Array
    q: Array
    moment: Moment
    unit: float
    rest: float


Load: TypeAlias = Callable[[Now], Array]


@dataclass(frozen=True)
class Term:
    """A term that a model may lack or have wrong.

    Attributes
    ----------
    kind
        "boundary", "source", "loss", "flux", "channel" (its gain), or "initial" state.
    subject
        Boundary or channel; empty for the whole domain.
    """

    kind: str
    subject: str = ""


class Process:
    """Responses of a model of one component to the terms that it may lack.

    Parameters
    ----------
    model, observed, level
        The process, its sensors, and their noise, by which amplitudes are counted.
    """

    def __init__(self, model: Model, observed: Observed, level: float) -> None:
        self.model = model
        self.observed = observed
        self.level = DEVIATIONS * level
        self.stage = ForwardStage(model)
        self._loads: list[Load] = []
        self._lifts: list[Array] = []
        self.terms: list[Term] = []
        if self.refused(model):
            return
        self._whole = model.mass @ model.state_space.interpolate(1.0)
        self._boundary_values()
        self._domain()
        self._ends()
        self._channels()

    @staticmethod
    def refused(model: Model) -> str:
        """Return why a model has no such terms; empty if it has."""
        if not model.state_space.single or len(model.algebraic):
            return "the state has several components"
        block = next(iter(model.state_space.fields.values()))
        return "the state is a vector" if block.vector else ""

    def _add(self, term: Term, load: Load, lift: Array) -> None:
        self.terms.append(term)
        self._loads.append(load)
        self._lifts.append(lift)

    def _boundary_values(self) -> None:
        model, n = self.model, self.model.X.dim
        zero, none = np.zeros(n), _nothing
        # Boundary values are affine in the inputs: the difference of two states is the lift of a
        # channel.
        known = dict.fromkeys(model.channels, 0.0)
        at_rest = model.impose(zero, Moment(0.0, Inputs(known)))
        # Boundary values that no channel moves are constants of the model, which may be wrong as
        # well.
        rest = model.X.free == 0.0
        for name in model.channels:
            moved = Inputs({**known, name: 1.0})
            lift = model.impose(zero, Moment(0.0, moved)) - at_rest
            if lift.any():
                rest &= lift == 0.0
                self._add(Term("boundary", name), none, self.level * lift)
        if rest.any():
            self._add(Term("boundary", "the fixed boundary"), none, self.level * rest)

    def _domain(self) -> None:
        nothing = np.zeros(self.model.X.dim)
        mass = self.model.mass

        def source(now: Now) -> Array:
            found: Array = self.level / (REACH * now.unit) * self._whole
            return found

        def loss(now: Now) -> Array:
            found: Array = -LOSS / (REACH * now.unit) * (mass @ (now.u - now.rest))
            return found

        self._add(Term("source"), source, nothing)
        self._add(Term("loss"), loss, nothing)
        self._add(Term("initial"), _nothing, nothing)

    def _ends(self) -> None:
        """Add a flux through each boundary where the model states no value."""
        model = self.model
        names = [str(name) for name in (model.mesh.boundaries or {})]
        ones = model.state_space.interpolate(1.0)
        # Each costs a solve with every answer of the process.
        for name in names[:MOST_ENDS]:
            form: Any = On(name, lambda u, v, x: u * v)
            load = model.bilinear(form) @ ones
            if np.abs(load[model.X.free == 0.0]).any() or not load.sum() > 0.0:
                continue
            # As much as the source of amplitude one brings into the whole domain.
            shape = load * (self._whole.sum() / load.sum())
            self._add(Term("flux", name), _flux(shape, self.level), np.zeros(model.X.dim))

    def _channels(self) -> None:
        """Add a gain of each channel that drives the model other than as a boundary value."""
        model, zero = self.model, np.zeros(self.model.X.dim)
        taken = {term.subject for term in self.terms}
        for name in model.channels:
            if name in taken:
                continue
            self._add(Term("channel", name), _gain(model, name), zero)

    def begun(self) -> Array:
        """Return the responses at the start, (terms, n): that to another initial state."""
        p = np.zeros((len(self.terms), self.model.X.dim))
        for k, (term, lift) in enumerate(zip(self.terms, self._lifts, strict=True)):
            p[k] = lift
            if term.kind == "initial":
                p[k] = self.level * self.model.X.free
        return p

    def advance(self, p: Array, now: Now, h: float) -> Array:
        """Return the responses a time h later, shape (terms, n)."""
        loads = np.array([load(now) for load in self._loads])
        lifts = np.array(self._lifts)
        # M (p+ - p)/h + S_u p+ = load, with p+ = lift on the boundary.
        factor, rows = self.stage.linearised(now.u, now.q, h, now.moment)
        known = (self.model.mass @ p.T).T / h + loads - (rows @ lifts.T).T
        free = self.model.X.free
        solved: Array = factor.solve((known * free).T).T
        return solved * free + lifts

    def shown(self, p: Array, now: Now) -> Array:
        """Return the readings of the responses, shape (terms, sensors)."""
        physical = self.model.latent.value(now.q)
        H, _ = self.observed.jacobian(now.u, physical, now.moment)
        return np.asarray((H @ p.T).T)


def _nothing(now: Now) -> Array:
    return np.zeros(len(now.u))


def _flux(shape: Array, level: float) -> Load:
    return lambda now: level / (REACH * now.unit) * shape


def _gain(model: Model, name: str) -> Load:
    """Return the load of a channel that is larger by `GAIN` than the model takes it for."""

    def residual(u: Array, q: Array, moment: Moment) -> Array:
        physical = model.latent.value(q)
        driven = model.physical_A.vector("v", moment, q=physical, u=u)
        found: Array = model.F(moment) - model.B(u, moment) - driven
        return found

    def load(now: Now) -> Array:
        inputs = now.moment.inputs
        more = Inputs({**inputs, name: (1.0 + GAIN) * inputs[name]})
        moved = Moment(now.moment.t, more)
        return residual(now.u, now.q, moved) - residual(now.u, now.q, now.moment)

    return load


def stride(seen: int) -> int:
    """Return over how many samples a step goes: short ones while the process is young."""
    return min(max(seen // 8, 1), MOST_STRIDE)
