"""Observations G: X -> Z, and the splitting of the state into observed and unobserved part."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from livepde.errors import ObservationError
from livepde.fem import START, FunctionSpace, Moment, Place
from livepde.linalg import Array
from livepde.observation.reconstruction import (
    Pseudoinverse,
    Reconstructed,
    Reconstruction,
    Reconstructor,
)
from livepde.spaces import HilbertSpace

__all__ = ["Observation", "Observed", "Split"]

Direct = Callable[[Any, Place], Any]
DEPENDENT = 1e-12  # eigenvalues of G G* below this share of the largest count as zero
ROUNDING = 1e-14  # entries of G below this share of the largest of their row count as zero
LARGEST_MEMO = 64  # splits kept for different patterns of missing samples


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation(ABC):
    """What the sensors see of the state: z = G u (+ a part that depends on q directly).

    Subclasses say what G is; `bind` ties it to a state space.

    Parameters
    ----------
    noise
        Standard deviation of the measurement noise, in the unit of z: one number, or one for each
        sensor. None: not known.
    unit
        Unit of the measured values.
    reconstruction
        How the gradient law finds the observed part of the state: `Pseudoinverse`, G^+, or
        `Tikhonov`, G_alpha (section 3.2).
    """

    noise: float | Sequence[float] | None = None
    unit: str = ""
    reconstruction: Reconstruction = field(default_factory=Pseudoinverse)

    @abstractmethod
    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        """Return G on the coefficients of the state, shape (sensors, n).

        `state.component(of)` is a component's block and where its coefficients stand;
        `state.widen(matrix, of)` makes a matrix on that component one on the whole state.
        """

    def names(self, count: int) -> tuple[str, ...]:
        """Return a name for each sensor."""
        return tuple(f"z{k}" for k in range(count))

    @property
    def directs(self) -> Mapping[str, Direct]:
        """Sensor name -> what it sees of the parameter directly, linear in q."""
        return {}

    @property
    def nodal(self) -> bool:
        """True if G^+ is taken in coefficients, false if in the inner product of X."""
        return False

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        """Return the observation of a given state space."""
        return Observed(self, state, X, parameter)


@dataclass(frozen=True, eq=False)
class Split:
    """The projections R = G^+ G on N(G)^perp and P = I - R on N(G), and G^+ itself.

    Attributes
    ----------
    R, P
        Sparse, shape (n, n); idempotent to rounding. Fixed (Dirichlet) coefficients are known, so
        they belong to P.
    inverse
        G^+ on the present sensors, shape (n, present).
    present
        Which sensors take part, shape (sensors,).
    G
        Their rows of G, shape (present, n).
    vectors
        A basis of N(G)^perp, shape (n, k); None if `inverse` is one.
    """

    R: sp.csr_array
    P: sp.csr_array
    inverse: sp.csr_array
    present: Array
    G: sp.csr_array
    vectors: Array | None = None

    @property
    def basis(self) -> Array:
        """A basis of N(G)^perp, shape (n, k)."""
        return self.inverse.toarray() if self.vectors is None else self.vectors

    def reconstruct(self, z: Array, boundary: Array) -> Array:
        """Return the observed part R u* = G^+ z of the state in X, shape (n,).

        Parameters
        ----------
        z
            Measurements, shape (sensors,); missing ones (NaN) take no part.
        boundary
            A coefficient vector that holds the Dirichlet values and is zero elsewhere.
        """
        known = z[self.present]
        if boundary.any():
            known = known - self.G @ boundary
        part: Array = self.inverse @ known
        return part


class Observed:
    """An observation bound to a state space: the operator G with its names and its noise."""

    def __init__(
        self,
        observation: Observation,
        state: FunctionSpace,
        X: HilbertSpace,
        parameter: FunctionSpace,
    ) -> None:
        self.observation = observation
        self.state = state
        self.X = X
        self.parameter = parameter
        self.G = sp.csr_array(observation.matrix(state), copy=True).astype(float)
        if self.G.shape[1] != X.dim:
            raise ObservationError(
                f"The observation matrix has {self.G.shape[1]} columns; the state has {X.dim}."
            )
        if not np.isfinite(self.G.data).all():
            raise ObservationError("The observation matrix holds values that are not finite.")
        # Shape functions evaluated at a node leave entries of 1e-17: a sensor on the Dirichlet
        # boundary would seem to see something.
        largest = abs(self.G).max(axis=1).toarray().ravel()
        self.G.data[
            np.abs(self.G.data) <= ROUNDING * np.repeat(largest, np.diff(self.G.indptr))
        ] = 0.0
        self.G.eliminate_zeros()
        self.size = int(self.G.shape[0])
        self.names = observation.names(self.size)
        if len(set(self.names)) != self.size:
            raise ObservationError(f"Sensor names must differ; got {list(self.names)}.")
        for name in observation.directs:
            if name not in self.names:
                raise ObservationError(f"direct: no sensor is called '{name}'; {self.names} are.")
        self._splits: dict[bytes, Split] = {}
        self._reconstructors: dict[bytes, Reconstructor] = {}

    @cached_property
    def noise(self) -> Array | None:
        """Standard deviation of each sensor, shape (sensors,), or None if it is not known."""
        given = self.observation.noise
        if given is None:
            return None
        noise = np.asarray(given, dtype=float)
        if noise.ndim > 1 or (noise.ndim == 1 and noise.shape != (self.size,)):
            raise ObservationError(
                f"noise: got {noise.size} values for {self.size} sensors; give one, or one each."
            )
        if not (np.isfinite(noise).all() and np.all(noise > 0)):
            raise ObservationError("noise: standard deviations must be positive numbers.")
        return np.broadcast_to(noise, (self.size,)).copy()

    def sensitivity(self, moment: Moment = START) -> Array | None:
        """Return the direct part D of z = G u + D q, shape (sensors, m); None if there is none."""
        if not self.observation.directs:
            return None
        matrix = np.zeros((self.size, self.parameter.dim))
        zero = np.zeros(self.parameter.dim)
        place = Place(np.zeros((0,)), None, moment)
        for name, direct in self.observation.directs.items():
            row = self.names.index(name)
            offset = float(direct(self._numbers(zero), place))
            if offset != 0.0:
                raise ObservationError(
                    f"direct of sensor '{name}' must be linear in q; at q = 0 it gives {offset}."
                )
            for column in self.parameter.labels.values():
                unit = zero.copy()
                unit[column] = 1.0
                matrix[row, column] = float(direct(self._numbers(unit), place))
        return matrix

    def _numbers(self, q: Array) -> Any:
        """Return the scalar unknowns as a `direct` function sees them."""
        parts = {name: q[self.parameter.part(name)] for name in self.parameter.blocks}
        numbers = {name: part[0] if len(part) == 1 else part for name, part in parts.items()}
        if self.parameter.single:
            return next(iter(numbers.values()))
        return SimpleNamespace(**numbers)

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        """Return G u + D q, shape (sensors,)."""
        z: Array = self.G @ u
        direct = self.sensitivity(moment)
        return z if direct is None else z + direct @ q

    def slope(self, u: Array, q: Array, moment: Moment) -> Array | None:
        """Return the derivative of the readings in G u + D q, shape (sensors,); None if it is 1."""
        return None

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        """Return the derivative of `predict` in u, (sensors, n), and in q, (sensors, m) or None."""
        slope, direct = self.slope(u, q, moment), self.sensitivity(moment)
        if slope is None:
            return self.G, direct
        scaled = sp.csr_array(sp.diags_array(slope) @ self.G)
        return scaled, None if direct is None else slope[:, None] * direct

    def linearised(self, z: Array, u: Array) -> Array:
        """Return z as linear sensors would have shown it, by one Newton step from the state u."""
        return z

    def split(self, present: Array | None = None) -> Split:
        """Return R, P and G^+ for the sensors present (default all).

        Sensors that repeat others are allowed: they are averaged, as by the Moore-Penrose inverse.
        """
        if present is None:
            present = np.ones(self.size, dtype=bool)
        key = present.tobytes()
        if key not in self._splits:
            if len(self._splits) >= LARGEST_MEMO:
                self._splits.clear()
            self._splits[key] = self._split(present)
        return self._splits[key]

    def reconstruct(
        self,
        z: ArrayLike,
        delta: float | None = None,
        *,
        boundary: Array | None = None,
        present: Array | None = None,
    ) -> Reconstructed:
        """Return the observed part of the state, G^+ z or G_alpha z (section 3.2).

        Parameters
        ----------
        z
            Measurements, shape (sensors,), NaN where missing.
        delta
            Noise level ||z^delta - z||_Z; default what the rule for alpha or `noise` says.
        boundary
            A coefficient vector that holds the Dirichlet values and is zero elsewhere; default
            zero.
        present
            Which sensors take part; default those with a value.

        Raises
        ------
        ObservationError
            z has another shape, delta is not positive, or no noise level is known where one is
            needed.
        """
        z = np.asarray(z, dtype=float)
        if z.shape != (self.size,):
            raise ObservationError(
                f"reconstruct: z has shape {z.shape}; the observation has {self.size} sensors."
            )
        if delta is not None and not (np.isfinite(delta) and delta > 0):
            raise ObservationError(f"reconstruct: delta must be a positive number; got {delta}.")
        if present is None:
            present = np.isfinite(z)
        if boundary is None:
            boundary = np.zeros(self.X.dim)
        key = present.tobytes()
        if key not in self._reconstructors:
            if len(self._reconstructors) >= LARGEST_MEMO:
                self._reconstructors.clear()
            self._reconstructors[key] = self.observation.reconstruction.prepare(self, present)
        return self._reconstructors[key](z, boundary, delta)

    def _split(self, present: Array) -> Split:
        n = self.X.dim
        G = sp.csr_array(self.G[np.flatnonzero(present)])
        tangent = sp.csr_array(G @ sp.diags_array(self.X.free))
        tangent.eliminate_zeros()
        if self.observation.nodal and _is_selection(tangent):
            inverse, V = sp.csr_array(tangent.T), None
            R = sp.csr_array(inverse @ tangent)
        else:
            rows = tangent.toarray()
            representers = rows.T if self.observation.nodal else self.X.riesz(rows.T)
            values, vectors = np.linalg.eigh(rows @ representers)
            kept = values > DEPENDENT * max(values.max(initial=0.0), 1e-300)
            C = vectors[:, kept] / np.sqrt(values[kept])
            # V W is idempotent to rounding only if W V = I to rounding. C alone does not give that
            # when sensors nearly repeat each other. Sparse W keeps R as narrow as G is.
            V = representers @ C
            W = sp.csr_array(C.T) @ tangent
            W = sp.csr_array(np.linalg.inv(W @ V)) @ W
            inverse = sp.csr_array(V @ np.linalg.pinv(rows @ V))
            R = sp.csr_array(V) @ W
        P = sp.csr_array(sp.eye_array(n) - R)
        R.eliminate_zeros()
        P.eliminate_zeros()
        return Split(R, P, inverse, present, G, V)


def _is_selection(G: sp.csr_array) -> bool:
    """Return true if every row picks one coefficient, and no two the same."""
    one_each = bool(np.all(np.diff(G.indptr) == 1) and np.all(G.data == 1.0))
    return one_each and len(np.unique(G.indices)) == len(G.indices)
