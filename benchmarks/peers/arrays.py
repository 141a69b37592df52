"""Filters as a user would write them with NumPy: all members are stepped as arrays.

Each member has its own matrix; LAPACK factorises and solves all of them as one band matrix
(`benchmarks.lean.Matrices`). This requires a process that is affine in the state, steps of equal
length, and constant unknowns. For other problems, the note of the row gives the reason.
"""

from __future__ import annotations

from functools import cached_property, partial

import numpy as np

from benchmarks import lean
from benchmarks.peers.augmented import Augmented, best
from benchmarks.problems import Data
from benchmarks.scoring import Contender, Known, Score, measured
from livepde.linalg import Array
from livepde.stepping import Alexander2, ImplicitEuler, Interval

INFLATIONS = (1.0, 1.02)  # factors on the anomalies after each update


class Stack:
    """Forward model for members with states of shape (p, n) and parameters of shape (p, k).

    Matrices are assembled at the first sample, as in our laws.
    """

    def __init__(self, data: Data) -> None:
        self.data = data
        self.augmented = Augmented(data)
        self.k = self.augmented.k

    @property
    def refused(self) -> str:
        """Reason why the problem is not supported; empty if it is supported."""
        process, widths = self.data.process, np.diff(self.data.process.times)
        if not np.allclose(widths, self.h, rtol=1e-9) or process.dt_max < self.h:
            return "not run: requires one step of equal length for each sample"
        if process.model.latent.moves or not self.data.observed.linear:
            return "not run: requires constant unknowns and linear sensors"
        try:
            _ = self.matrices
        except lean.NotAffineError as error:
            return f"not run: {error}"
        return ""

    @property
    def h(self) -> float:
        """Time between samples."""
        times = self.data.process.times
        return float(times[-1] - times[0]) / (len(times) - 1)

    @cached_property
    def matrices(self) -> lean.Matrices:
        """Matrices for a stage; all stages of the scheme have the same implicit coefficient."""
        scheme = self.data.process.scheme
        share = scheme.gamma if isinstance(scheme, Alexander2) else 1.0
        Phi = self.augmented.trajectory.Phi
        return lean.Matrices.of(self.data.process.model, Phi, share * self.h)

    @cached_property
    def G(self) -> Array:
        """Observation operator over the noise, in the order of the band, shape (sensors, n)."""
        G: Array = self.data.observed.G.toarray()
        return np.ascontiguousarray(G[:, self.matrices.order] / self.data.noise[:, None])

    @cached_property
    def start(self) -> Array:
        """Known initial state in the order of the model, shape (n,)."""
        return self.augmented.full(np.append(self.augmented.start, np.zeros(self.k)), 0)

    def forecast(self, u: Array, a: Array, at: int) -> Array:
        """Advance states from the previous sample to sample `at`."""
        matrices, (before, now) = self.matrices, self.augmented.moments[at - 1 : at + 1]
        none = np.zeros(0)
        interval = Interval(
            t0=before.t, t1=now.t, inputs0=before.inputs, inputs1=now.inputs, z0=none, z1=none
        )
        factor = matrices.factorise(a)

        def stage(c: Array, t: float, h: float) -> Array:
            return matrices.solve(factor, matrices.mass(c) + matrices.forcing(interval.at(t)))

        return self.data.process.scheme.advance(stage, u, before.t, now.t - before.t)

    def z(self, at: int) -> Array:
        """Return the measurements of a sample over the noise, shape (sensors,)."""
        z: Array = self.data.z[at] / self.data.noise
        return z


class Ensemble:
    """Ensemble transform Kalman filter with a symmetric square root.

    See Hunt, Kostelich and Szunyogh (2007); without localisation.

    Attributes
    ----------
    E
        Columns of states and reduced parameters, shape (members, n + k).
    """

    def __init__(self, stack: Stack, members: int, inflation: float) -> None:
        self.stack, self.inflation = stack, inflation
        drawn = np.random.default_rng(members).standard_normal((members, stack.k))
        self.a = drawn - drawn.mean(axis=0)
        self.E: Array | None = None

    def step(self, at: int) -> None:
        """Process a sample."""
        stack = self.stack
        if self.E is None:
            start = stack.start[stack.matrices.order]
            self.E = np.hstack([np.tile(start, (len(self.a), 1)), self.a])
        n, E = self.E.shape[1] - stack.k, self.E
        E[:, :n] = stack.forecast(E[:, :n], E[:, n:], at)
        mean, root = E.mean(axis=0), np.sqrt(len(E) - 1.0)
        anomalies = E - mean
        left, size, right = np.linalg.svd(anomalies[:, :n] @ stack.G.T / root, full_matrices=False)
        d = right @ (stack.z(at) - stack.G @ mean[:n])
        rotated = left.T @ anomalies
        mean += (size / (1.0 + size**2) * d) @ rotated / root
        anomalies += left @ ((1.0 / np.sqrt(1.0 + size**2) - 1.0)[:, None] * rotated)
        self.E = mean + self.inflation * anomalies

    def known(self) -> Known:
        """Return latent coefficients and their factor."""
        a = self.a if self.E is None else self.E[:, -self.stack.k :]
        mean = a.mean(axis=0)
        return self.stack.augmented.known(mean, (a - mean).T / np.sqrt(len(a) - 1))


class Unscented:
    """Unscented filter on the reduced coordinates, with 2k + 1 sigma points.

    The state is uncertain only through the k unknowns, so that the joint covariance has a square
    root [U; C] with k columns. The columns define the sigma points, as in the reduced-order filter
    of Moireau and Chapelle (2011).

    Attributes
    ----------
    u, a, U, C
        Estimates, shapes (n,) and (k,), and square root, shapes (n, k) and (k, k).
    """

    def __init__(self, stack: Stack) -> None:
        k = stack.k
        self.stack, self.spread = stack, np.sqrt(k + 1.0)
        self.weights = np.full(2 * k + 1, 0.5 / (k + 1.0))
        self.weights[0] = 1.0 / (k + 1.0)
        self.a, self.C = np.zeros(k), np.eye(k)
        self.u: Array | None = None
        self.U: Array = np.zeros((0, k))

    def _points(self, mean: Array, root: Array) -> Array:
        wide = self.spread * root.T
        return np.asarray(mean + np.vstack([0.0 * mean, wide, -wide]))

    def step(self, at: int) -> None:
        """Process a sample."""
        stack, k = self.stack, self.stack.k
        if self.u is None:
            self.u = stack.start[stack.matrices.order]
            self.U = np.zeros((len(self.u), k))
        points = stack.forecast(self._points(self.u, self.U), self._points(self.a, self.C), at)
        u = self.weights @ points
        U = (points[1 : k + 1] - points[k + 1 :]).T / (2.0 * self.spread)
        Y = stack.G @ U
        W = np.linalg.inv(np.linalg.qr(np.vstack([np.eye(k), Y]), mode="r"))
        half = W.T @ (Y.T @ (stack.z(at) - stack.G @ u))
        self.U, self.C = U @ W, self.C @ W
        self.u, self.a = u + self.U @ half, self.a + self.C @ half

    def known(self) -> Known:
        """Return latent coefficients and their factor."""
        return self.stack.augmented.known(self.a, self.C)


def ensemble(members: int, data: Data) -> Score:
    """Run the square-root ensemble filter with each inflation, and return the best score."""
    runs: dict[str, Contender] = {
        f"inflation {x:g}": partial(_ensemble_run, members, x) for x in INFLATIONS
    }
    refused = Stack(data).refused
    return Score(note=refused) if refused else best(data, runs)


def _ensemble_run(members: int, inflation: float, data: Data) -> Score:
    filter_ = Ensemble(Stack(data), members, inflation)
    return measured(data, filter_.step, filter_.known)


def unscented(data: Data) -> Score:
    """Run the unscented filter on the reduced coordinates."""
    refused = Stack(data).refused
    filter_ = Unscented(Stack(data))
    return Score(note=refused) if refused else measured(data, filter_.step, filter_.known)


def reference(data: Data) -> Score:
    """Run the lean reference of our filter, if the process is linear in its unknowns."""
    if refused := Stack(data).refused:
        return Score(note=refused)
    stack, process = Stack(data), data.process
    if not process.model.latent.linear or not isinstance(process.scheme, ImplicitEuler):
        return Score(note="not run: requires linear unknowns and implicit Euler steps")
    state: lean.Filter | None = None

    def step(at: int) -> None:
        nonlocal state
        if state is None:
            state = lean.initial(stack.matrices, stack.start, 1, stack.k)
        f = stack.matrices.forcing(stack.augmented.moments[at])
        state = lean.step(stack.matrices, stack.G, state, f, stack.z(at)[None])

    def known() -> Known:
        y = np.zeros((stack.k, 1 + stack.k)) if state is None else state.y[0]
        return stack.augmented.known(y[:, 0], y[:, 1:])

    return measured(data, step, known)
