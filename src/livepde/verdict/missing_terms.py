"""Answers of the process to terms that its model may lack: a source, a loss, a boundary value.

The free response p of the state to a term, M p' + (B + A q)' p = load, goes on by implicit Euler
steps over several samples, and its effect on the sensors is interpolated between these steps. The
response is needed to a tenth of its size, to tell causes apart, and so costs a fraction of a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from livepde.fem import Inputs, Moment, On
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.stepping import ForwardStage

FIXED = "the fixed boundary"  # constants of the model, which may be wrong as well

REACH = 64.0  # samples in which a source of amplitude one moves the state by three times the noise
DEVIATIONS = 3.0
GAIN = 0.1  # of a channel of a source or flux
LOSS = 0.1  # in `REACH` samples
MOST_STRIDE = 16  # samples of one step
MOST_ENDS = 4  # boundaries of the mesh that are looked at


class Now(NamedTuple):
    """Point of a response: state, latent parameter, inputs, usual interval and rest state.

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


class Term(NamedTuple):
    """A term that a model may lack or have wrong, with an amplitude of one.

    Attributes
    ----------
    kind
        "boundary", "source", "loss", "flux", "channel" (its gain), or "initial" state.
    subject
        Boundary or channel; empty for the whole domain.
    load, lift
        Function that returns its load, and boundary values of its response, (n,); None for zero.
    """

    kind: str
    subject: str = ""
    load: Load | None = None
    lift: Array | None = None


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
        self.terms: list[Term] = []
        if not self.refused(model):
            parts = self._boundary_values(), self._domain(), self._fluxes()
            self.terms += [term for part in parts for term in part]
            self.terms += self._gains()
        zero = np.zeros(model.X.dim)
        self._lifts = np.array([zero if term.lift is None else term.lift for term in self.terms])

    @staticmethod
    def refused(model: Model) -> str:
        """Return why a model has no such terms; empty if it has."""
        if not model.state_space.single or len(model.algebraic):
            return "the state has several components"
        block = next(iter(model.state_space.fields.values()))
        return "the state is a vector" if block.vector else ""

    @cached_property
    def _whole(self) -> Array:
        """Load of a source of one in the whole domain."""
        return np.asarray(self.model.mass @ self.model.state_space.interpolate(1.0))

    def _boundary_values(self) -> Iterator[Term]:
        for name, lift in boundary_lifts(self.model).items():
            yield Term("boundary", name, lift=self.level * lift)

    def _domain(self) -> Iterator[Term]:
        mass = self.model.mass

        def loss(now: Now) -> Array:
            found: Array = -LOSS / (REACH * now.unit) * (mass @ (now.u - now.rest))
            return found

        yield Term("source", load=_constant(self._whole, self.level))
        yield Term("loss", load=loss)
        yield Term("initial")

    def _fluxes(self) -> Iterator[Term]:
        """Iterate over a flux through each boundary where the model states no value."""
        # Each costs a solve with every answer of the process.
        for name, load in flux_loads(self.model, MOST_ENDS).items():
            # As much as the source of amplitude one brings into the whole domain.
            shape = load * (self._whole.sum() / load.sum())
            yield Term("flux", name, load=_constant(shape, self.level))

    def _gains(self) -> list[Term]:
        """Return a gain of each channel that drives the model other than as a boundary value."""
        taken = {term.subject for term in self.terms}
        others = [name for name in self.model.channels if name not in taken]
        return [Term("channel", name, load=_gain(self.model, name)) for name in others]

    def start(self) -> Array:
        """Return the responses at the start, (terms, n): that to another initial state."""
        p: Array = self._lifts.copy()
        p[[term.kind == "initial" for term in self.terms]] = self.level * self.model.X.free
        return p

    def advance(self, p: Array, now: Now, h: float) -> Array:
        """Return the responses a time h later, shape (terms, n)."""
        # M (p+ - p)/h + S_u p+ = load, with p+ = lift on the boundary.
        factor, rows = self.stage.linearised(now.u, now.q, h, now.moment)
        known = (self.model.mass @ p.T).T / h - (rows @ self._lifts.T).T
        for k, term in enumerate(self.terms):
            if term.load is not None:
                known[k] += term.load(now)
        free = self.model.X.free
        solved: Array = factor.solve((known * free).T).T
        found: Array = solved * free + self._lifts
        return found

    def readings(self, p: Array, now: Now) -> Array:
        """Return the readings of the responses, shape (terms, sensors)."""
        physical = self.model.latent.value(now.q)
        H, _ = self.observed.jacobian(now.u, physical, now.moment)
        return np.asarray((H @ p.T).T)


def _constant(shape: Array, level: float) -> Load:
    """Return a load that is constant but for the usual interval between samples."""
    return lambda now: level / (REACH * now.unit) * shape


def _gain(model: Model, name: str) -> Load:
    """Return the load of a channel that is larger by `GAIN` than the model takes it for."""
    return lambda now: scaled_channel(model, name, now.u, now.q, now.moment, GAIN)


def boundary_lifts(model: Model) -> dict[str, Array]:
    """Return channel -> change of the boundary values by a unit of it, (n,), if it drives any.

    Boundary values that no channel moves are one more, of size one.
    """
    # Boundary values are affine in the inputs: the difference of two states is a lift.
    zero, known = np.zeros(model.X.dim), dict.fromkeys(model.channels, 0.0)
    rest, fixed = model.impose(zero, Moment(0.0, Inputs(known))), model.X.free == 0.0
    found = {}
    for name in model.channels:
        moved = Moment(0.0, Inputs({**known, name: 1.0}))
        lift = model.impose(zero, moved) - rest
        if lift.any():
            fixed &= lift == 0.0
            found[name] = lift
    return found | ({FIXED: fixed.astype(float)} if fixed.any() else {})


def flux_loads(model: Model, most: int | None = None) -> dict[str, Array]:
    """Return boundary -> load of a flux of one through it, (n,), where no value is stated.

    Of the first `most` boundaries of the mesh.
    """
    ones, found = model.state_space.interpolate(1.0), {}
    for name in [str(one) for one in model.mesh.boundaries or {}][:most]:
        form: Any = On(name, lambda u, v, x: u * v)
        load = model.bilinear(form) @ ones
        if load.sum() > 0.0 and not load[model.X.free == 0.0].any():
            found[name] = load
    return found


def force(model: Model, u: Array, q: Array, moment: Moment) -> Array:
    """Return F - B(u) - A(u) q, (n,), of a latent parameter q."""
    driven = model.physical_A.vector("v", moment, q=model.latent.value(q), u=u)
    found: Array = model.F(moment) - model.B(u, moment) - driven
    return found


def scaled_channel(
    model: Model, name: str, u: Array, q: Array, moment: Moment, share: float
) -> Array:
    """Return the change of the force with a channel that is larger by a share of it, (n,)."""
    more = Inputs({**moment.inputs, name: (1.0 + share) * moment.inputs[name]})
    return force(model, u, q, Moment(moment.t, more)) - force(model, u, q, moment)


def stride(seen: int) -> int:
    """Return over how many samples a step goes: short ones while the process is young."""
    return min(max(seen // 8, 1), MOST_STRIDE)
