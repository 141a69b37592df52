"""Moving sensors: lowered probes, floats, scanners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FunctionSpace, Moment
from livepde.linalg import Array
from livepde.observation.operator import Observation, Observed
from livepde.spaces import HilbertSpace


@dataclass(frozen=True, eq=False)
class Moving(Observation):
    """Point sensors with positions from the stream, z_k(t) = u(x_k(t), t).

    While its position is missing or outside of the mesh, a sensor has no reading: its prediction is
    NaN and its sample is not used. Positions are not held from one sample to the next.

    Parameters
    ----------
    positions
        Mapping from sensor name to the channel of its position; in more than one dimension to one
        channel for each coordinate.

    Examples
    --------
    >>> Moving({"probe": ("probe_x", "probe_y")}, noise=0.1).inputs
    ('probe_x', 'probe_y')
    """

    positions: Mapping[str, str | Sequence[str]]

    def __post_init__(self) -> None:
        if not self.positions:
            raise ObservationError("Moving: give at least one sensor.")
        self._reads(name for names in self.channels for name in names)

    @property
    def channels(self) -> list[tuple[str, ...]]:
        """Channels of the coordinates of each sensor."""
        given = self.positions.values()
        return [(names,) if isinstance(names, str) else tuple(names) for names in given]

    def names(self, count: int) -> tuple[str, ...]:
        return tuple(self.positions)

    @property
    def optional(self) -> frozenset[str]:
        return frozenset(name for names in self.channels for name in names)

    @property
    def portable(self) -> bool:
        return True

    def bind(
        self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace
    ) -> MovingObserved:
        return MovingObserved(self, state, X, parameter)


class MovingObserved(Observed):
    """Bound `Moving` sensors: G depends on the moment."""

    observation: Moving

    def __init__(
        self,
        observation: Moving,
        state: FunctionSpace,
        X: HilbertSpace,
        parameter: FunctionSpace,
    ) -> None:
        super().__init__(observation, state, X, parameter)
        self.block = observation.scalar_block(state)
        dimension = self.block.field.mesh.dim()
        for name, channels in zip(self.names, observation.channels, strict=True):
            if len(channels) != dimension:
                raise ObservationError(
                    f"Moving: sensor '{name}' has position channels {list(channels)}; the mesh "
                    f"has {dimension} coordinates."
                )
        # G at the last positions. Copies of an identifier share it, possibly in several threads:
        # the three values are read and replaced as one tuple, so that they are always consistent.
        self._last: tuple[bytes, sp.csr_array, Array] | None = None

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(len(self.observation.positions))

    @property
    def linear(self) -> bool:
        return False

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        G, seen = self._at(moment)
        z: Array = G @ u
        z[np.logical_not(seen)] = np.nan
        return z

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        return self._at(moment)[0], None

    def available(self, moment: Moment) -> Array:
        return self._at(moment)[1]

    def _at(self, moment: Moment) -> tuple[sp.csr_array, Array]:
        """Return G at a moment, and the mask of sensors inside the mesh."""
        given = dict(moment.inputs)
        points = np.array(
            [[given.get(name, np.nan) for name in names] for names in self.observation.channels]
        )
        key = points.tobytes()
        last = self._last
        if last is None or last[0] != key:
            seen = np.array([self.block.contains(point) for point in points])
            rows = np.flatnonzero(seen)
            G = sp.csr_array((len(points), self.state.dim))
            if len(rows):
                values = self.state.widen(self.block.probe(points[rows].T), self.observation.of)
                place = sp.csr_array(
                    (np.ones(len(rows)), (rows, np.arange(len(rows)))), (len(points), len(rows))
                )
                G = sp.csr_array(place @ values)
            # Callers share the cached mask, so it must not be changed in place.
            seen.setflags(write=False)
            self._last = last = (key, G, seen)
        return last[1], last[2]
