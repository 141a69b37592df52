"""Nonlinear observations z = g(G_0 u): radiation, thermistors, any pointwise sensor function.

The paper takes G linear "for simplicity of exposition. Most of what follows can be carried over to
the case of nonlinear observations" (section 2). It is done as follows: with the derivative G'(u) =
diag(g'(G_0 u)) G_0, the null space of G'(u) is that of G_0 wherever g' does not vanish, so R and P
are those of G_0 and do not move; and the observed part of the state is a step of Newton's method
from the last estimate u^,

    u_alpha = R u^ - G'(u^)^+ (G(u^) - z) = G_0^+ (y - (g(y) - z)/g'(y)),    y = G_0 u^,

which is R u* up to the square of the error R (u^ - u*), and for a linear g exactly G^+ z. That
square enters the law through B(w) with two derivatives, as noise does, so the step is repeated from
its own end a few times, which costs nothing: it goes sensor by sensor, and P u^ takes no part. The
residual r = R u - u_alpha, A(w)* r and the damping are then those of (est_exact_q), (est_exact_u).
The sensitivity law predicts with g and linearises about its prediction, H = G'(u) L.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FunctionSpace, Moment
from livepde.linalg import Array, Mask
from livepde.observation.operator import STEP, Direct, Observation, Observed
from livepde.spaces import HilbertSpace

Reading = Callable[[Array], Array]
"""What each sensor shows for the value it sees: (sensors,) -> (sensors,), one by one."""


@dataclass(frozen=True, eq=False)
class Transformed(Observation):
    """Sensors with a pointwise nonlinear characteristic, z_k = g_k((G_0 u)_k).

    The function g need not be monotone, but a sensor with g' = 0 at the estimate carries no
    information there, and counts as missing in `GradientLaw`.

    Parameters
    ----------
    base
        G_0: `Points`, `Averages`, `Subdomain`, ... Its own `noise` and `unit` are not used.
    function
        g, from values of shape (sensors,) to readings of the same shape, one by one.
    derivative
        g', of the same shape; default by a complex step (for analytic g).
    iterations
        Newton steps of `GradientLaw` from the last estimate.
    reach
        Maximum length of a Newton step in y = G_0 u, for strongly curved g far from the truth.

    Notes
    -----
    `noise` is that of the readings z. A `reconstruction` by a noise level acts on the linearised
    data y + (z - g(y))/g'(y), whose noise is larger by 1/g'(y).

    Examples
    --------
    >>> import livepde as lp
    >>> pyrometers = Transformed(lp.Points([0.3, 0.6]), lambda T: T**4, noise=0.01)
    """

    base: Observation
    function: Reading
    derivative: Reading | None = None
    iterations: int = 5
    reach: float = np.inf

    def __post_init__(self) -> None:
        self._sees_all("give of= to the observations it is made of.")
        self._shows(self.base)
        if self.base.unknowns:
            raise ObservationError(
                "Transformed: its base has uncertain positions; write the function into "
                "Calibrated, which keeps them."
            )
        if self.iterations < 1:
            raise ObservationError(
                f"Transformed: iterations must be at least 1; got {self.iterations}."
            )
        if not self.reach > 0:
            raise ObservationError(f"Transformed: reach must be positive; got {self.reach}.")

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        return self.base.matrix(state)

    def names(self, count: int) -> tuple[str, ...]:
        return self.base.names(count)

    @property
    def directs(self) -> Mapping[str, Direct]:
        return self.base.directs

    @property
    def places(self) -> Array | None:
        return self.base.places

    @property
    def nodal(self) -> bool:
        return self.base.nodal

    def region(self, state: FunctionSpace) -> Mask | None:
        return self.base.region(state)

    @property
    def portable(self) -> bool:
        return self.base.portable

    def bind(
        self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace
    ) -> TransformedObserved:
        return TransformedObserved(self, state, X, parameter)

    def read(self, y: Array) -> Array:
        """Return g(y)."""
        z = np.asarray(self.function(y), dtype=float)
        if z.shape != y.shape:
            raise ObservationError(
                f"Transformed: function gave shape {z.shape} for values of shape {y.shape}; it "
                "must act on each sensor by itself."
            )
        return z

    def slope(self, y: Array) -> Array:
        """Return g'(y)."""
        if self.derivative is not None:
            slope = np.asarray(self.derivative(y), dtype=float)
        else:
            slope = np.imag(np.asarray(self.function(cast(Array, y + 1j * STEP)))) / STEP
        return np.broadcast_to(slope, y.shape)


class TransformedObserved(Observed):
    """Bound `Transformed` sensors: G is the linear part G_0; readings and derivatives use g."""

    observation: Transformed

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        return self.observation.read(super().predict(u, q, moment))

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        slope = self.observation.slope(super().predict(u, q, moment))
        direct = self._direct(moment)
        H_u = sp.csr_array(sp.diags_array(slope) @ self.G)
        return H_u, None if direct is None else slope[:, None] * direct

    def linearised(self, z: Array, u: Array) -> Array:
        sensors, y = self.observation, np.asarray(self.G @ u)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(sensors.iterations):
                step = (z - sensors.read(y)) / sensors.slope(y)
                step[np.isinf(step)] = np.nan  # an insensitive sensor says nothing
                # A step of Newton's method may be huge where g' is small: `reach` limits it.
                y = y + np.clip(step, -sensors.reach, sensors.reach)
        return y
