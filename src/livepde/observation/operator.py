"""Observation operators G: X -> Z, sensors bound to a state space, and G^+ (section 3.2)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from livepde.errors import ObservationError, require_positive
from livepde.fem import (
    FieldBlock,
    FunctionSpace,
    Moment,
    Place,
    SensorState,
    Unknown,
    numbers,
)
from livepde.linalg import Array, IntArray, Mask, Memo
from livepde.spaces import HilbertSpace

Direct = Callable[[Any, Place], Any]
# Eigenvalues of G G* below this share of the largest count as zero: redundant sensors.
DEPENDENT = 1e-12
# Entries of G below this share of the largest in their row are rounding errors of shape functions.
ROUNDING = 1e-14
# Largest number of entries of R, which is dense on the support of the sensors (800 MB).
LARGEST_PROJECTION = 100_000_000
# Number of cached splits, one for each pattern of missing sensors.
LARGEST_MEMO = 64


@dataclass(frozen=True, eq=False)
class Split:
    """Projections R = G^+ G on N(G)^perp and P = I - R on N(G), and G^+ itself.

    Attributes
    ----------
    R, P
        Sparse, shape (n, n); idempotent up to rounding. Fixed (Dirichlet) coefficients are known
        and are in the range of P.
    inverse, G
        G^+ and G restricted to the present sensors, shapes (n, present) and (present, n).
    present
        Mask of the sensors in use, shape (sensors,).
    vectors
        Basis of N(G)^perp, shape (n, k); None if the columns of `inverse` are a basis.
    omega
        Elements on which the data determine the state, for sensors on a subdomain. There, chi_omega
        of the paper is one: integrals over Omega are split into integrals over `omega` with the
        data and over the other elements with the estimate. None: all elements, and the state is
        split only by R and P.
    """

    R: sp.csr_array
    P: sp.csr_array
    inverse: sp.csr_array
    present: Array
    G: sp.csr_array
    vectors: Array | None = None
    omega: IntArray | None = None

    @property
    def basis(self) -> Array:
        """Basis of N(G)^perp, shape (n, k)."""
        return self.inverse.toarray() if self.vectors is None else self.vectors

    @cached_property
    def _diagonal(self) -> Array | None:
        """Diagonal of R if R is diagonal, else None."""
        diagonal = bool(np.array_equal(self.R.indices, np.flatnonzero(np.diff(self.R.indptr))))
        return self.R.diagonal() if diagonal else None

    @cached_property
    def _selected(self) -> IntArray | None:
        """Coefficient of each present sensor if each reads a single coefficient; else None."""
        selects = self.vectors is None and is_selection(sp.csr_array(self.inverse.T))
        return sp.csr_array(self.inverse.T).indices if selects else None

    def project(self, u: Array) -> Array:
        """Return R u."""
        return self.R @ u if self._diagonal is None else self._diagonal * u

    def reconstruct(self, z: Array, boundary: Array | None) -> Array:
        """Return the observed part R u* = G^+ z of the state in X, shape (n,).

        Missing measurements (NaN) are ignored. `boundary` is a coefficient vector with Dirichlet
        values, and zero elsewhere; None for zero.
        """
        data: Array = z[self.present]
        if boundary is not None and boundary.any():
            data = data - self.G @ boundary
        if self._selected is None:
            return self.inverse @ data
        observed = np.zeros(self.R.shape[0])
        observed[self._selected] = data
        return observed


def is_selection(G: sp.csr_array) -> bool:
    """Return whether every row selects a single coefficient, different for all rows."""
    single = bool(np.all(np.diff(G.indptr) == 1) and np.all(G.data == 1.0))
    return single and len(np.unique(G.indices)) == len(G.indices)


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """Reconstruction u = u_alpha = G_alpha z of the observed part of the state, shape (n,).

    Attributes
    ----------
    alpha
        Regularisation parameter; 0 for G^+.
    misfit
        ||G u_alpha - z||_Z.
    delta
        Noise level ||z^delta - z||_Z that was used, or None if unknown.
    """

    u: Array
    alpha: float
    misfit: float
    delta: float | None


class Reconstructor(ABC):
    """Factorised G_alpha for one set of present sensors."""

    @abstractmethod
    def __call__(self, z: Array, boundary: Array, delta: float | None = None) -> Reconstructed:
        """Return the reconstruction u_alpha from measurements of shape (sensors,).

        `boundary`: coefficient vector with Dirichlet values, and zero elsewhere. `delta`: noise
        level ||z^delta - z||_Z; by default taken from the rule or the observation.
        """


class Reconstruction(ABC):
    """Abstract method to reconstruct the observed part of the state from measurements."""

    @property
    def regularises(self) -> bool:
        """Whether the reconstruction differs from G^+."""
        return True

    @abstractmethod
    def prepare(self, observed: Observed, present: Array) -> Reconstructor:
        """Return the reconstructor for a set of present sensors."""


@dataclass(frozen=True)
class Pseudoinverse(Reconstruction):
    """Moore-Penrose inverse G^+, for exact data or if averaging over time suffices."""

    @property
    def regularises(self) -> bool:
        return False

    def prepare(self, observed: Observed, present: Array) -> Reconstructor:
        return _Inverse(observed, present)


class _Inverse(Reconstructor):
    def __init__(self, observed: Observed, present: Array) -> None:
        self.split = observed.split(present)
        self.weights = weights(observed, present)

    def __call__(self, z: Array, boundary: Array, delta: float | None = None) -> Reconstructed:
        u = self.split.reconstruct(z, boundary)
        residual = self.split.G @ (u + boundary) - z[self.split.present]
        return Reconstructed(u, 0.0, data_norm(residual, self.weights), delta)


def weights(observed: Observed, present: Array) -> sp.csr_array:
    """Return the Gram matrix of Z for the present sensors (see `Tikhonov`)."""
    if observed.observation.nodal:
        inverse = observed.split(present).inverse
        return sp.csr_array(inverse.T @ observed.X.gram @ inverse)
    if observed.noise is None:
        return sp.csr_array(sp.eye_array(int(present.sum())))
    return sp.csr_array(sp.diags_array(observed.noise[present] ** -2.0))


def data_norm(z: Array, gram: sp.csr_array) -> float:
    """Return the norm of measurements in Z with a given Gram matrix."""
    return float(np.sqrt(max(float(z @ (gram @ z)), 0.0)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """Abstract observation operator: z = G u, plus a direct part D q.

    Subclasses define G by `matrix`. Sensors that are nonlinear in the state return their own bound
    object from `bind`. If an attribute contains the sensors, as a sequence or by name, `listed` is
    its name, and the word for one of its items.

    Parameters
    ----------
    of
        Observed component of the state, if there are several.
    inputs
        Channels that the sensors use, in addition to the channels of the model.
    noise
        Standard deviation of the measurement noise, in the unit of z: one number, or one for each
        sensor. None: unknown.
    unit
        Unit of the measured values.
    reconstruction
        Reconstruction of the observed part of the state in the gradient law: `Pseudoinverse`, G^+,
        or `Tikhonov`, G_alpha (section 3.2).
    """

    of: str = ""
    inputs: Sequence[str] = ()
    noise: float | Sequence[float] | None = None
    unit: str = ""
    reconstruction: Reconstruction = field(default_factory=Pseudoinverse)

    listed: ClassVar[tuple[str, str]] = ("", "")

    def __post_init__(self) -> None:
        sensors, singular = self.listed
        if sensors and not len(getattr(self, sensors)):
            raise ObservationError(f"{type(self).__name__}: give at least one {singular}.")

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        """Return G on the coefficients of the state, shape (sensors, n)."""
        raise ObservationError(
            f"{type(self).__name__} is not linear in the state alone, so it has no matrix G and no "
            "projections R and P: use SensitivityLaw."
        )

    def _refuse_component(self, remedy: str) -> None:
        """Raise an error if `of` is given, for observations on which it has no effect."""
        if self.of:
            raise ObservationError(f"{type(self).__name__}: of='{self.of}' has no effect; {remedy}")

    def scalar_block(self, state: FunctionSpace) -> FieldBlock:
        """Return the observed component; raise an error if it is a vector field."""
        block, _ = state.component(self.of)
        if block.vector:
            raise ObservationError(
                f"{type(self).__name__} requires a state that is one number at each point, and "
                "this one is a vector: use Points(..., component=0), or Matrix."
            )
        return block

    def _reads(self, channels: Iterable[str]) -> None:
        """Prepend channels to `inputs`, without duplicates."""
        object.__setattr__(self, "inputs", tuple(dict.fromkeys([*channels, *self.inputs])))

    def _add_base_channels(self, base: Observation) -> None:
        """Add the channels of a base observation; raise an error if the base has noise."""
        if base.noise is not None:
            raise ObservationError(
                f"{type(self).__name__}: give noise= to it and not to its base: it is that of the "
                "readings."
            )
        self._reads(base.inputs)

    def names(self, count: int) -> tuple[str, ...]:
        """Return a name for each sensor."""
        sensors = getattr(self, self.listed[0], None)
        return tuple(sensors if isinstance(sensors, Mapping) else (f"z{k}" for k in range(count)))

    @property
    def places(self) -> Array | None:
        """Coordinates of the sensors, shape (sensors, d), if each is at a single point."""
        return None

    @property
    def directs(self) -> Mapping[str, Direct]:
        """Sensor name -> direct dependence on the parameter, linear in q."""
        return {}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Unknowns of the sensors, which an identifier adds to the unknowns of the model."""
        return {}

    @property
    def states(self) -> Mapping[str, SensorState]:
        """Sensor name -> state of a slow sensor, which an identifier adds to the state."""
        return {}

    @property
    def optional(self) -> frozenset[str]:
        """Names of `inputs` that may be missing; sensors that require them then have no reading."""
        return frozenset()

    @property
    def nodal(self) -> bool:
        """Whether G^+ uses the Euclidean inner product of coefficients instead of that in X."""
        return False

    def region(self, state: FunctionSpace) -> Mask | None:
        """Return a mask of the observed elements of the mesh; None if undefined."""
        return None

    @property
    def portable(self) -> bool:
        """Whether readings have the same meaning on every mesh; coefficients do not."""
        return False

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        """Return the observation bound to a state space."""
        return Observed(self, state, X, parameter)


class Observed:
    """An observation bound to a state space: predicted readings and their derivatives.

    Sensors other than z = G u + D q override `predict`, `jacobian` and `linear`; `available` if
    readings may be missing; and `_prepare` for data that these methods share.
    """

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
        self._prepare()
        self.names = self._names()
        self.size = len(self.names)
        if len(set(self.names)) != self.size:
            raise ObservationError(
                f"Sensor names must differ; got {list(self.names)}. A mapping gives them names, as "
                'in Points({"T_30": 0.3}).'
            )
        for name in observation.directs:
            if name not in self.names:
                raise ObservationError(f"direct: no sensor is called '{name}'; {self.names} are.")
        self._steady_direct: Array | None = None  # D, if found to be independent of time and inputs
        self._splits: Memo[bytes, Split] = Memo(LARGEST_MEMO)
        self._reconstructors: Memo[bytes, Reconstructor] = Memo(LARGEST_MEMO)

    def _prepare(self) -> None:
        """Compute data that predictions share; none in the base class."""

    @property
    def places(self) -> Mapping[str, Array]:
        """Sensor name -> coordinates, for sensors at a single point."""
        coordinates = self.observation.places
        return {} if coordinates is None else dict(zip(self.names, coordinates, strict=True))

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each sensor."""
        return (self.observation.unit,) * self.size

    @property
    def unit(self) -> str:
        """Common unit of the sensors; empty if they differ."""
        first, *others = self.units
        return first if all(other == first for other in others) else ""

    @cached_property
    def noise(self) -> Array | None:
        """Noise standard deviation of each sensor, shape (sensors,); None if unknown."""
        stated = self.observation.noise
        if stated is None:
            return None
        try:
            noise = np.asarray(stated, dtype=float)
        except (TypeError, ValueError):
            raise ObservationError(
                f"noise: got {stated!r}; expected one number, or one for each of {self.names}."
            ) from None
        if noise.ndim > 1 or (noise.ndim == 1 and noise.shape != (self.size,)):
            raise ObservationError(
                f"noise: got {noise.size} values for {self.size} sensors; give one, or one each."
            )
        if not (np.isfinite(noise).all() and np.all(noise > 0)):
            raise ObservationError("noise: standard deviations must be positive numbers.")
        return np.broadcast_to(noise, (self.size,)).copy()

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(int(self.G.shape[0]))

    @cached_property
    def G(self) -> sp.csr_array:
        """Constant matrix of the linear part, (sensors, n); an error if there is none."""
        G = sp.csr_array(self.observation.matrix(self.state), copy=True).astype(float)
        if G.shape[1] != self.X.dim:
            raise ObservationError(
                f"The observation matrix has {G.shape[1]} columns; the state has {self.X.dim}."
            )
        if not np.isfinite(G.data).all():
            raise ObservationError("The observation matrix holds values that are not finite.")
        # Shape functions evaluated at a node leave entries of 1e-17: a sensor on the Dirichlet
        # boundary would seem to depend on free coefficients.
        largest = abs(G).max(axis=1).toarray().ravel()
        G.data[np.abs(G.data) <= ROUNDING * np.repeat(largest, np.diff(G.indptr))] = 0.0
        G.eliminate_zeros()
        return G

    @cached_property
    def _shown(self) -> IntArray | None:
        """Coefficient of each sensor if each reads a single coefficient; else None."""
        return self.G.indices if is_selection(self.G) else None

    @property
    def linear(self) -> bool:
        """Whether z = G u, possibly after `linearised`, as projections require."""
        return not self.observation.directs

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        """Return the predicted readings, G u + D q, shape (sensors,); NaN for no reading.

        u and q are coefficients of the state, (n,), and of the parameter, (m,).
        """
        z: Array = self.G @ u if self._shown is None else u[self._shown]
        direct = self._direct(moment)
        return z if direct is None else z + direct @ q

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        """Return the derivatives of `predict` in u and q, shapes (sensors, n) and (sensors, m).

        The second is None if the sensors do not depend on the parameter. Rows without a reading are
        zero.
        """
        return self.G, self._direct(moment)

    def available(self, moment: Moment) -> Array:
        """Return the mask of sensors that can have a reading; other values are ignored."""
        return np.ones(self.size, dtype=bool)

    def _direct(self, moment: Moment) -> Array | None:
        """Return the direct part D of z = G u + D q, shape (sensors, m); None if there is none."""
        if not self.observation.directs or self._steady_direct is not None:
            return self._steady_direct
        matrix = np.zeros((self.size, self.parameter.dim))
        zero = np.zeros(self.parameter.dim)
        place = Place(np.zeros((0,)), None, moment)
        # The functions are linear in q, so their values at unit vectors are the columns.
        for name, direct in self.observation.directs.items():
            row = self.names.index(name)
            offset = float(direct(numbers(self.parameter, zero), place))
            if offset != 0.0:
                raise ObservationError(
                    f"direct of sensor '{name}' must be linear in q; at q = 0 it gives {offset}."
                )
            for column in self.parameter.labels.values():
                unit = zero.copy()
                unit[column] = 1.0
                matrix[row, column] = float(direct(numbers(self.parameter, unit), place))
        if not place.used:
            matrix.setflags(write=False)
            self._steady_direct = matrix
        return matrix

    @property
    def steady_matrix(self) -> sp.csr_array:
        """Matrix G in z = G u + D q, for sensors with a constant D or without D."""
        return self.G

    def steady_direct(self, moment: Moment) -> Array | None:
        """Return D if z = G u + D q with a constant D; None for other sensors, or without D."""
        if type(self) is not Observed or self.observation.inputs:
            return None
        self._direct(moment)
        return self._steady_direct

    def linearised(self, z: Array, u: Array) -> Array:
        """Return readings of equivalent linear sensors, by one Newton step from the state u."""
        return z

    def split(self, present: Array | None = None) -> Split:
        """Return R, P and G^+ for the present sensors (default all).

        Sensors may be redundant: the Moore-Penrose inverse averages them.
        """
        used = np.ones(self.size, dtype=bool) if present is None else present
        return self._splits.get(used.tobytes(), lambda: self._split(used))

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
            Measurements, shape (sensors,), NaN if missing.
        delta
            Noise level ||z^delta - z||_Z; by default from the rule for alpha or from `noise`.
        boundary
            Coefficient vector with Dirichlet values, and zero elsewhere; default zero.
        present
            Mask of the sensors to use; default: sensors with a value.

        Raises
        ------
        ObservationError
            z has a wrong shape, delta is not positive, or a required noise level is not known.
        """
        z = np.asarray(z, dtype=float)
        if z.shape != (self.size,):
            raise ObservationError(
                f"reconstruct: z has shape {z.shape}; the observation has {self.size} sensors."
            )
        if delta is not None:
            require_positive("reconstruct: delta", delta, ObservationError)
        used = np.isfinite(z) if present is None else present
        if boundary is None:
            boundary = np.zeros(self.X.dim)
        rule = self.observation.reconstruction
        prepared = self._reconstructors.get(used.tobytes(), lambda: rule.prepare(self, used))
        return prepared(z, boundary, delta)

    def _split(self, present: Array) -> Split:
        n = self.X.dim
        G = sp.csr_array(self.G[np.flatnonzero(present)])
        tangent = sp.csr_array(G @ sp.diags_array(self.X.free))
        tangent.eliminate_zeros()
        if self.observation.nodal and is_selection(tangent):
            # For sensors that read single coefficients, R is diagonal with entries 0 and 1, and G^+
            # is G^T.
            inverse, V = sp.csr_array(tangent.T), None
            R = sp.csr_array(inverse @ tangent)
            omega = self._observed_elements(tangent.indices)
        else:
            omega = None
            if (support := len(np.unique(tangent.indices))) * n > LARGEST_PROJECTION:
                raise ObservationError(
                    f"R, the projection on what these sensors see, has {n} rows with {support} "
                    "entries each, too many to be stored. At this size observe a Subdomain, of "
                    "which R is diagonal, or use SensitivityLaw, which needs no R."
                )
            rows = tangent.toarray()
            representers = rows.T if self.observation.nodal else self.X.riesz(rows.T)
            values, vectors = np.linalg.eigh(rows @ representers)
            # Redundant sensors cause zero eigenvalues of G G*, which the pseudoinverse omits.
            independent = values > DEPENDENT * max(values.max(initial=0.0), 1e-300)
            C = vectors[:, independent] / np.sqrt(values[independent])
            # V W is idempotent up to rounding only if W V = I up to rounding, which C does not
            # ensure for nearly redundant sensors. With a sparse W, R has the support of G.
            V = representers @ C
            W = sp.csr_array(C.T) @ tangent
            W = sp.csr_array(np.linalg.inv(W @ V)) @ W
            inverse = sp.csr_array(V @ np.linalg.pinv(rows @ V))
            R = sp.csr_array(V) @ W
        P = sp.csr_array(sp.eye_array(n) - R)
        R.eliminate_zeros()
        P.eliminate_zeros()
        return Split(R, P, inverse, present, G, V, omega)

    def _observed_elements(self, observed: IntArray) -> IntArray | None:
        """Return the elements on which observed coefficients determine the state; None for all.

        With several components, every observed component must be determined. Dirichlet coefficients
        are known.
        """
        known = self.X.free == 0.0
        known[observed] = True
        determined = np.ones(0, dtype=bool)
        for name, block in self.state.fields.items():
            start = self.state.part(name).start
            in_component = (observed >= start) & (observed < start + block.size)
            if in_component.any():
                complete = known[start + block.element_dofs].all(axis=0)
                determined = determined & complete if len(determined) else complete
        region = self.observation.region(self.state)
        if region is not None and len(determined):
            determined = determined & region
        return None if determined.all() and len(determined) else np.flatnonzero(determined)
