r"""Dense reference implementation of the method of Boiger and Kaltenbacher (2016), NumPy only.

It shares no code with livepde, so that both can be compared. It solves the example of section 4,
(PDEdiff) and (obsdiff), on a mesh of (0, 1):

    u_t - (D u_x)_x + q u = f,    u = 0 at both ends,    z = u on omega

R u = chi_omega u and P u = chi_(Omega \ omega) u act under the integrals: w = u_alpha + P u is
u_alpha on omega and the estimate u elsewhere. With the suffixes _in for integrals over omega and
_out for integrals over Omega \ omega, implicit Euler for (noisy_q) and (noisy_u) is

    G_Q (q - q_old) / (gain h) + (sigma / gain) G_Q q - A_in(u_alpha)^T (u - u_alpha) = 0

    M (u - u_old) / h + B_in u_alpha + B_out u + [A_in(u_alpha) + A_out(u)] q
        + theta M_op (u - u_alpha) + nu N_op u = F

with (A(u) q, v) = int q u v, (B u, v) = int D u' v', the mass matrix M, M_op and N_op of (MN1) and
(MN2), theta = mu / ||r||_V~ for r = R u - u_alpha, and the Gram matrix G_Q / gain of Q; the paper
has gain = 1. With exact data and alpha = sigma = 0 these are (est_exact_q) and (est_exact_u).

If nu > 0, a step can have several solutions, see `Step.solve`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Kind: TypeAlias = Literal["constant", "P1", "hermite"]
Ends: TypeAlias = Literal["free", "zero", "clamped"]

# Shape functions on (0, 1): each row has the coefficients of 1, s, s^2, s^3. The rows of "hermite"
# are phi_j and psi_j of section 4 on one cell.
SHAPES: dict[str, Array] = {
    "constant": np.array([[1.0]]),
    "P1": np.array([[1.0, -1], [0, 1]]),
    "hermite": np.array([[1.0, 0, -3, 2], [0, 1, -2, 1], [0, 0, 3, -2], [0, 0, -1, 1]]),
}
PER_NODE = {"constant": 0, "P1": 1, "hermite": 2}

# Largest accepted residual of a step, relative to the terms of its equation. Newton iterates to
# rounding level, which is 1e-14 on 16 nodes, 1e-13 on 61 and 1e-12 on 121.
TOLERANCE = 1e-11


@dataclass(frozen=True, eq=False)
class LineSpace:
    """Finite element space on a mesh of (0, 1).

    Parameters
    ----------
    nodes
        Increasing coordinates from 0 to 1: x_1, ..., x_N of section 4.
    kind
        "P1"; "hermite": cubic, with dofs [value, slope] at each node; "constant": one number.
    ends
        "free"; "zero": values vanish at the ends of (0, 1); "clamped": values and slopes vanish at
        the ends, which is the space of section 4, j = 2, ..., N - 1.
    """

    nodes: Array
    kind: Kind
    ends: Ends = "zero"

    @cached_property
    def size(self) -> int:
        """Number of dofs, fixed ones included."""
        return max(1, PER_NODE[self.kind] * len(self.nodes))

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Indices of the dofs that are not fixed to zero."""
        per_node = PER_NODE[self.kind]
        count = {"free": 0, "zero": min(per_node, 1), "clamped": per_node}[self.ends]
        fixed = [start + i for start in (0, self.size - per_node) for i in range(count)]
        return np.setdiff1d(np.arange(self.size), fixed)

    def basis(self, x: Array, order: int = 0) -> Array:
        """Return derivatives of the free basis functions at points, shape (points, free dofs)."""
        cell = np.clip(np.searchsorted(self.nodes, x, "right") - 1, 0, len(self.nodes) - 2)
        length = np.diff(self.nodes)[cell]
        local = polyval((x - self.nodes[cell]) / length, polyder(SHAPES[self.kind].T, order))
        local = local / length**order
        if self.kind == "hermite":
            local[1::2] *= length  # the dofs are slopes in x, not in the coordinate of the cell
        values = np.zeros((len(x), self.size))
        for i, row in enumerate(local):
            values[np.arange(len(x)), PER_NODE[self.kind] * cell + i] = row
        return values[:, self.free]

    def interpolate(self, function: Callable[[Any], Any]) -> Array:
        """Return the free coefficients of the interpolant of an analytic function."""
        # A complex step gives slopes to rounding accuracy without a formula for the derivative.
        values = np.asarray(function(self.nodes + 1e-40j), complex) * np.ones(len(self.nodes))
        dofs = np.stack([values.real, values.imag / 1e-40], axis=1)[:, : PER_NODE[self.kind]]
        coefficients: Array = dofs.ravel() if self.kind != "constant" else values.real[:1]
        return coefficients[self.free]

    def interpolate_all(self, function: Callable[[Any, float], Any], times: Array) -> Array:
        """Return the free coefficients of a function of (x, t), one row per time."""

        def row(t: float) -> Array:
            return self.interpolate(lambda x: function(x, t))

        return np.array([row(t) for t in times])

    def extend(self, coefficients: Array) -> Array:
        """Insert zeros for the fixed dofs, along the last axis."""
        extended = np.zeros((*coefficients.shape[:-1], self.size))
        extended[..., self.free] = coefficients
        return extended


def fitted(count: int, omega: tuple[float, float]) -> Array:
    """Return a uniform mesh with the inner nodes nearest to the ends of omega moved onto them."""
    nodes = np.linspace(0, 1, count)
    for end in omega:
        if 0 < end < 1:
            nodes[1 + np.argmin(abs(nodes[1:-1] - end))] = end
    return nodes


@dataclass(frozen=True, eq=False)
class Setting:
    """Process, discretisation, data, and parameters of the method."""

    # Process; functions are analytic. Without a source, F_k = M (U_k - U_(k-1)) / h + B U_k
    # + A(U_k) q*, for which the interpolants U_k of u* solve the discrete process exactly.
    q_true: Callable[[Any], Any]
    u_true: Callable[[Any, float], Any]
    f: Callable[[Any, float], Any] | None = None
    D: Callable[[Any], Any] = np.ones_like

    # Spaces. An integer `nodes` is the number of nodes of a uniform mesh. Five Gauss points per
    # cell integrate products of three cubics exactly.
    nodes: Array | int = 31
    state: Kind = "hermite"
    state_ends: Ends = "zero"
    parameter: Kind = "hermite"
    parameter_ends: Ends = "zero"
    inner: Literal["L2", "H1"] = "H1"
    points: int = 5

    # Observed interval. If `cut`, the quadrature splits cells at the ends of omega; otherwise omega
    # is reduced to the cells in its closure.
    omega: tuple[float, float] = (0.0, 1.0)
    cut: bool = False

    # Sample times are k h, k = 0, ..., steps. The true states are interpolants of u* if `truth` is
    # "exact", and implicit Euler with the same elements and steps computes them if "discrete". The
    # interpolant of `error`, a function of (x, t), is added to the data.
    h: float = 0.6
    steps: int = 100
    truth: Literal["discrete", "exact"] = "discrete"
    error: Callable[[Any, float], Any] | None = None

    # Method; u starts at the true state. theta = c1 ||r||_X^2 / ||r||_VX~^2, the lower bound of
    # Assumption cond:mu02, plus mu / (||r||_V~^2 + floor^2 ||u_alpha||_V~^2)^(1/2), a constant mu
    # regularised at r = 0. `reconstruct` applies `penalty` with weight alpha.
    q0: Callable[[Any], Any] = np.zeros_like
    gain: float = 1.0
    c1: float = 0.0
    mu: float = 0.0
    floor: float = 1e-3
    nu: float = 0.0
    sigma: float = 0.0
    alpha: float = 0.0
    penalty: Literal["L2", "H2"] = "L2"


def form(left: Array, weights: Array, right: Array) -> Array:
    """Return the matrix of a bilinear form, the sum over points p of left_pi weights_p right_pj."""
    return left.T @ (weights[:, None] * right)


class Discretisation:
    """Spaces, quadrature, matrices and norms of a setting, for vectors of free dofs.

    Attributes
    ----------
    X, Q
        Spaces of state and parameter.
    x, weights, inside
        Quadrature points, their weights, and the mask of points in omega.
    v, xi
        Basis functions of X and Q at the points.
    M, M_in, B_in, B_out, M_op, N_op, G_Q
        Matrices of the module's equations; M_in is the mass matrix over omega.
    observed
        Dofs of X whose basis functions meet omega.
    """

    def __init__(self, setting: Setting) -> None:
        given = setting.nodes
        nodes = np.linspace(0, 1, given) if isinstance(given, int) else given
        self.setting = setting
        self.X = LineSpace(nodes, setting.state, setting.state_ends)
        self.Q = LineSpace(nodes, setting.parameter, setting.parameter_ends)

        cells = np.union1d(nodes, setting.omega) if setting.cut else nodes
        s, w = np.polynomial.legendre.leggauss(setting.points)
        length = np.diff(cells)
        self.x = (cells[:-1, None] + length[:, None] * (s + 1) / 2).ravel()
        self.weights = (length[:, None] * w / 2).ravel()
        a, b = setting.omega
        self.inside = np.repeat((cells[:-1] > a - 1e-12) & (cells[1:] < b + 1e-12), len(s))
        w_in, w_out = self.weights * self.inside, self.weights * ~self.inside

        self.v, dv, ddv = (self.X.basis(self.x, order) for order in range(3))
        self.xi, dxi = (self.Q.basis(self.x, order) for order in range(2))
        D = setting.D(self.x)
        self.M, self.M_in = form(self.v, self.weights, self.v), form(self.v, w_in, self.v)
        self.B_in, self.B_out = form(dv, w_in * D, dv), form(dv, w_out * D, dv)
        self.M_op = form(dv, w_in * abs(D), dv) + self.M_in
        self.N_op = form(dv, w_out * abs(D), dv) + form(self.v, w_out, self.v)
        self.G_Q = form(self.xi, self.weights, self.xi)
        if setting.inner == "H1":
            self.G_Q += form(dxi, self.weights, dxi)

        self.observed = np.flatnonzero(self.v[self.inside].any(axis=0))
        self._bend = form(ddv, w_in, ddv)
        within = np.flatnonzero(
            ~self.v[~self.inside].any(axis=0)
        )  # functions with support in omega
        self._V_tilde = self.M_op[within].T @ np.linalg.solve(
            self.M[np.ix_(within, within)], self.M_op[within]
        )
        self._H1 = np.linalg.inv(np.linalg.cholesky(self.M + form(dv, self.weights, dv)))
        self._Q = np.linalg.inv(np.linalg.cholesky(self.G_Q))

    def V_tilde(self, r: Array) -> float:
        """Return ||r||_V~ as sup (M_op r, phi) / ||phi||_L2 over phi with support in omega."""
        return float(np.sqrt(r @ self._V_tilde @ r))

    def V_hat(self, p: Array) -> float:
        """Return ||P p||_V^ by its formula, ||(D p')'||_L2 + ||p||_L2; for cubic elements."""
        D = self.setting.D(self.x + 1e-40j)
        flux = D.real * (self.X.basis(self.x, 2) @ p)
        flux += D.imag / 1e-40 * (self.X.basis(self.x, 1) @ p)
        w_out = self.weights * ~self.inside
        return float(np.sqrt(w_out @ flux**2) + np.sqrt(w_out @ (self.v @ p) ** 2))

    def relative_X(self, *terms: Array) -> float:
        """Return the norm of a sum of functionals on H^1, relative to the sum of their norms."""
        sizes = [np.linalg.norm(self._H1 @ term) for term in (sum(terms), *terms)]
        return float(sizes[0] / (sum(sizes[1:]) or 1.0))

    def relative_Q(self, *terms: Array) -> float:
        """Return the norm of a sum of functionals on Q, relative to the sum of their norms."""
        sizes = [np.linalg.norm(self._Q @ term) for term in (sum(terms), *terms)]
        return float(sizes[0] / (sum(sizes[1:]) or 1.0))

    def A(self, values: Array) -> Array:
        """Return the matrix of A(u), from the values of u at the quadrature points."""
        at = values != 0
        return form(self.v[at], self.weights[at] * values[at], self.xi[at])

    def reconstruct(self, z: Array) -> Array:
        """Return u_alpha = G_alpha z of section 3.2, with G_alpha = (G* G + alpha I)^-1 G*.

        It minimises ||v - z||^2 + alpha |v|^2 over omega. With penalty "L2", |v| is the norm of
        X = L2, and u_alpha = z / (1 + alpha). With penalty "H2", |v| is the L2 norm of v''.
        """
        if self.setting.penalty == "L2":
            return z / (1 + self.setting.alpha)
        of = np.ix_(self.observed, self.observed)
        normal = self.M_in[of] + self.setting.alpha * self._bend[of]
        u_alpha = np.zeros_like(z)
        u_alpha[self.observed] = np.linalg.solve(normal, self.M_in[of] @ z[self.observed])
        return u_alpha

    def theta(self, r: Array, u_alpha: Array) -> tuple[float, Array]:
        """Return theta(r) as defined in `Setting`, and its derivative."""
        c1, mu = self.setting.c1, self.setting.mu
        theta, derivative = 0.0, np.zeros_like(r)
        if c1 and r[self.observed].any():
            X, VX = self.M_in @ r, self.M_op @ r
            quotient = float((r @ X) / (r @ VX))
            theta += c1 * quotient
            derivative += 2 * c1 / (r @ VX) * (X - quotient * VX)
        if mu:
            norm = float(np.hypot(self.V_tilde(r), self.setting.floor * self.V_tilde(u_alpha)))
            theta += mu / norm
            derivative -= mu / norm**3 * (self._V_tilde @ r)
        return theta, derivative


class Step:
    """Equations of one implicit Euler step and their solver, for vectors of free dofs.

    The unknown is r = u - u_alpha, with u_alpha = 0 in the dofs that do not meet omega. Computed as
    a difference, r would have a rounding error that a large theta amplifies.
    """

    def __init__(self, at: Discretisation, u_old: Array, q_old: Array, z: Array, F: Array) -> None:
        self.at, self.u_old, self.q_old, self.F = at, u_old, q_old, F
        self.u_alpha = at.reconstruct(z)
        self.A_in = at.A(at.inside * (at.v @ self.u_alpha))
        scale = at.setting.gain / (1 / at.setting.h + at.setting.sigma)
        self._dq = scale * np.linalg.solve(at.G_Q, self.A_in.T)

    def q(self, r: Array) -> Array:
        """Solve the equation of q, which is linear, for a given r.

        Inserting this q gives an equation of u whose scaling does not depend on the gain.
        """
        return self.q_old / (1 + self.at.setting.sigma * self.at.setting.h) + self._dq @ r

    def theta(self, r: Array) -> float:
        """Return theta at r."""
        return self.at.theta(r, self.u_alpha)[0]

    def terms_u(self, r: Array, q: Array, theta: float) -> list[Array]:
        """Return the terms of the equation of u, all on its left-hand side."""
        at, h, u = self.at, self.at.setting.h, self.u_alpha + r
        return [
            at.M @ u / h,
            at.M @ self.u_old / -h,
            at.B_in @ self.u_alpha,
            at.B_out @ u,
            self.A_in @ q,
            at.A(~at.inside * (at.v @ u)) @ q,
            theta * (at.M_op @ r),
            at.setting.nu * (at.N_op @ u),
            -self.F,
        ]

    def terms_q(self, r: Array, q: Array) -> list[Array]:
        """Return the terms of the equation of q, all on its left-hand side."""
        G_Q, h = self.at.G_Q / self.at.setting.gain, self.at.setting.h
        decay = self.at.setting.sigma * (G_Q @ q)
        return [G_Q @ q / h, G_Q @ self.q_old / -h, decay, self.A_in.T @ -r]

    def residual(self, r: Array, q: Array) -> float:
        """Return the larger residual of the two equations, relative to their terms."""
        of_u = self.at.relative_X(*self.terms_u(r, q, self.theta(r)))
        return max(of_u, self.at.relative_Q(*self.terms_q(r, q)))

    def jacobian(self, r: Array, theta: float | None) -> Array:
        """Return the Jacobian of the equation of u with q(r), for theta(r) or a fixed theta."""
        at, h, out = self.at, self.at.setting.h, ~self.at.inside
        A = self.A_in + at.A(out * (at.v @ (self.u_alpha + r)))
        A_out_q = form(at.v[out], at.weights[out] * (at.xi[out] @ self.q(r)), at.v[out])
        fixed = at.M / h + at.B_out + at.setting.nu * at.N_op + A_out_q + A @ self._dq
        if theta is not None:
            return fixed + theta * at.M_op
        theta, slope = at.theta(r, self.u_alpha)
        return fixed + theta * at.M_op + np.outer(at.M_op @ r, slope)

    def newton(self, r: Array, theta: float | None = None) -> Array:
        """Solve the equation of u with q(r) by damped Newton, for theta(r) or a fixed theta.

        The iteration ends when no fraction of a Newton step decreases the residual: either the
        equation is solved to rounding, or the iteration stalled. The caller must test the residual.
        """
        at = self.at

        def equation(r: Array) -> tuple[Array, float, float]:
            terms = self.terms_u(r, self.q(r), self.theta(r) if theta is None else theta)
            residual = np.sum(terms, axis=0)
            return residual, float(np.linalg.norm(at._H1 @ residual)), at.relative_X(*terms)

        residual, size, share = equation(r)
        for _ in range(50):
            if share <= 1e-15:
                break
            change = np.linalg.solve(self.jacobian(r, theta), -residual)
            # Near rounding level, if the full step does not help, shorter steps do not either.
            for length in 0.5 ** np.arange(12 if share > 1e-13 else 1):
                trial = equation(r + length * change)
                if trial[1] < size:
                    break
            else:
                break
            r, (residual, size, share) = r + length * change, trial
        return r

    def solve(self, theta: float) -> tuple[Array, Array, float]:
        """Solve the step from a starting value of theta; return r, q and their residual.

        For fixed theta, Newton is robust because only A_out(u) q is nonlinear. So theta is computed
        as a root of the scalar function theta(r(theta)) - theta. The root is bracketed from the
        starting value, in the direction given by the sign there. The bracket is halved until Newton
        on the full equation, with the derivative of theta, ends inside it.

        There may be several roots: c1 ||r||_X^2 / ||r||_VX~^2 depends on the shape of r, which for
        nu > 0 need not tend to zero. The theta of the previous step as starting value selects the
        solution that continues the previous step.

        Raises
        ------
        ArithmeticError
            If the residual stays above TOLERANCE.
        """
        old = self.u_old - self.u_alpha
        r = self._continued(np.log(theta), old) if theta > 0 else self.newton(old)
        q = self.q(r)
        residual = self.residual(r, q)
        if not residual <= TOLERANCE:
            raise ArithmeticError(
                f"a step has the relative residual {residual:.1e}, expected at most {TOLERANCE:g}"
            )
        return r, q, residual

    def _continued(self, near: float, r: Array) -> Array:
        """Return r for the root log(theta) nearest to `near`, in the direction given by `solve`."""

        def mismatch(log_theta: float, r: Array) -> tuple[float, Array]:
            r = self.newton(r, np.exp(log_theta))
            return np.log(max(self.theta(r), 1e-300)) - log_theta, r

        start, r = mismatch(near, r)
        far, stride = near, start
        for _ in range(60):
            far = near + np.clip(stride, -1.5, 1.5)
            value, r_far = mismatch(far, r)
            if value * start <= 0:
                break
            near, r, stride = far, r_far, 2 * stride
        for k in range(60):
            if k % 3 == 0:
                solved = self.newton(r)
                root = np.log(max(self.theta(solved), 1e-300))
                between = min(near, far) - 1e-6 <= root <= max(near, far) + 1e-6
                if between and self.residual(solved, self.q(solved)) <= TOLERANCE:
                    return solved
            middle = (near + far) / 2
            value, r_middle = mismatch(middle, r)
            if value * start > 0:
                near, r = middle, r_middle
            else:
                far = middle
        return self.newton(r)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Estimates, data and truth at the times k h, one row per time, with zeros for fixed dofs.

    Attributes
    ----------
    at
        Discretisation; `at.X.free[at.observed]` are the columns of Z with data.
    times, Q, U
        Times, shape (samples,); estimates of q and u, shapes (samples, m) and (samples, n).
    Z
        Measured coefficients on omega, including nodes at its ends; the other columns are zero.
    theta, residuals
        theta and relative residual of each step.
    q_true, U_true, F
        Coefficients of q* and of the true states; loads F_k.
    """

    at: Discretisation
    times: Array
    Q: Array
    U: Array
    Z: Array
    theta: Array
    residuals: Array
    q_true: Array
    U_true: Array
    F: Array


def truth(at: Discretisation, times: Array) -> tuple[Array, Array, Array]:
    """Return the free coefficients of q* and of the true states, and the loads F_k."""
    setting, h = at.setting, at.setting.h
    q = at.Q.interpolate(setting.q_true)
    U = at.X.interpolate_all(setting.u_true, times)
    C = at.B_in + at.B_out + form(at.v, at.weights * (at.xi @ q), at.v)
    if setting.f is None:
        return q, U, np.diff(U, axis=0, prepend=U[:1]) @ at.M / h + U @ C
    F = np.array([at.v.T @ (at.weights * setting.f(at.x, t)) for t in times])
    if setting.truth == "discrete":
        for k in range(1, len(U)):
            U[k] = np.linalg.solve(at.M / h + C, at.M @ U[k - 1] / h + F[k])
    return q, U, F


def run(setting: Setting) -> Trajectory:
    """Generate the data of a setting, and run the method on them.

    Raises
    ------
    ArithmeticError
        If a step is not solved.
    """
    at = Discretisation(setting)
    times = setting.h * np.arange(setting.steps + 1.0)
    q_true, U_true, F = truth(at, times)
    data, Z = U_true.copy(), np.zeros_like(U_true)
    if setting.error is not None:
        data += at.X.interpolate_all(setting.error, times)
    Z[:, at.observed] = data[:, at.observed]

    U, Q = U_true.copy(), np.tile(at.Q.interpolate(setting.q0), (len(times), 1))
    theta, residual = np.zeros(len(times)), np.zeros(len(times))
    for k in range(1, len(times)):
        step = Step(at, U[k - 1], Q[k - 1], Z[k], F[k])
        r, Q[k], residual[k] = step.solve(theta[k - 1] or step.theta(U[k - 1] - step.u_alpha))
        U[k], theta[k] = step.u_alpha + r, step.theta(r)
    Q, q_true = at.Q.extend(Q), at.Q.extend(q_true)
    U, Z, U_true, F = (at.X.extend(rows) for rows in (U, Z, U_true, F))
    return Trajectory(at, times, Q, U, Z, theta, residual, q_true, U_true, F)


def residuals(at: Discretisation, Q: Array, U: Array, Z: Array, F: Array) -> Array:
    """Return the relative residual of each step of a trajectory with rows as in `Trajectory`.

    If a step has several solutions, a small residual shows that the trajectory is one of them.
    """
    q, (u, z, f) = Q[:, at.Q.free], (rows[:, at.X.free] for rows in (U, Z, F))
    steps = [Step(at, u[k - 1], q[k - 1], z[k], f[k]) for k in range(1, len(u))]
    rows = zip(steps, u[1:], q[1:], strict=True)
    return np.array([step.residual(u_k - step.u_alpha, q_k) for step, u_k, q_k in rows])
