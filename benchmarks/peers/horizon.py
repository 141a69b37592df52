"""Moving-horizon estimator of do-mpc for the paper's equation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.peers.augmented import Augmented, best
from benchmarks.problems import Data
from benchmarks.scoring import Known, Score, measured
from livepde.linalg import Array

ARRIVALS = (1.0, 10.0, 100.0)  # weights of the last estimate of the parameters
HORIZON = 10
SETTINGS: Any = {
    "n_horizon": HORIZON,
    "meas_from_data": False,
    "store_full_solution": False,
    "state_discretization": "collocation",
    "collocation_type": "radau",  # degree 1 is implicit Euler, the scheme of the data
    "collocation_deg": 1,
    "collocation_ni": 1,
    "nlpsol_opts": {
        "ipopt.max_iter": 100,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": 0,
    },
}


def moving_horizon(data: Data) -> Score | None:
    """Run do-mpc's moving-horizon estimator; None except for the paper's example."""
    if data.problem.name != "seed":
        return None
    return best(
        data,
        {
            f"horizon {HORIZON}, arrival weight {weight:g}": partial(_run, weight)
            for weight in ARRIVALS
        },
    )


@dataclass(frozen=True, eq=False)
class Scaled:
    """Equation M u' + K u + sum_k a_k A_k u = F and z = H u, scaled so that Ipopt converges.

    Attributes
    ----------
    unit
        Scale of the free coefficients that gives unit mass, shape (n,).
    M, K, A, H, F
        Shapes (n, n), (n, n), (n, n, k) with the column of u first, (sensors, n) for measurements
        of unit noise, and (times, n).
    """

    unit: Array
    M: Array
    K: Array
    A: Array
    H: Array
    F: Array

    @classmethod
    def of(cls, augmented: Augmented) -> Scaled:
        """Return the scaled equation of the paper, which is bilinear in u and a."""
        model, free, data = augmented.model, augmented.free, augmented.data
        unit = 1.0 / np.sqrt(model.mass.diagonal()[free])
        eye = np.eye(model.X.dim)[:, free] * unit
        A = np.array([model.A(e).matrix @ augmented.trajectory.Phi for e in eye.T])[:, free]
        return cls(
            unit,
            M=unit[:, None] * model.mass[free][:, free].toarray() * unit,
            K=unit[:, None] * np.column_stack([model.B(e) for e in eye.T])[free],
            A=A * unit[:, None],
            H=data.observed.G[:, free].toarray() * unit / data.noise[:, None],
            F=np.array([unit * model.F(moment)[free] for moment in augmented.moments]),
        )

    def process(self) -> Any:
        """Return the do-mpc model of the equation."""
        import casadi
        import do_mpc

        n, k = len(self.unit), self.A.shape[2]
        process = do_mpc.model.Model("continuous")
        u = process.set_variable("_x", "u", (n, 1))
        rate = process.set_variable("_z", "rate", (n, 1))
        a = process.set_variable("_p", "a", (k, 1))
        source = process.set_variable("_tvp", "source", (n, 1))
        process.set_meas("z", casadi.DM(self.H) @ u, meas_noise=True)
        process.set_rhs("u", rate)
        flux = casadi.DM(self.K) @ u
        for mode in range(k):  # one sparse matrix for each mode
            matrix = self.A[:, :, mode].T
            matrix = np.where(np.abs(matrix) < 1e-14 * np.abs(matrix).max(), 0.0, matrix)
            flux += a[mode] * (casadi.sparsify(casadi.DM(matrix)) @ u)
        process.set_alg("balance", casadi.sparsify(casadi.DM(self.M)) @ rate + flux - source)
        process.setup()
        return process


def _run(arrival: float, data: Data) -> Score:
    import casadi
    import do_mpc

    augmented = Augmented(data)
    k, times = augmented.k, augmented.times
    scaled = Scaled.of(augmented)
    horizon = do_mpc.estimator.MHE(scaled.process(), ["a"])
    horizon.set_param(t_step=times[1] - times[0], **SETTINGS)
    sources, readings = horizon.get_tvp_template(), horizon.get_y_template()
    now = 0

    def window(template: Any, name: str, rows: Array) -> Any:
        # Measurements and sources at the ends of the intervals, the last of which ends now.
        for j in range(HORIZON):
            template[name, j] = rows[now - HORIZON + 1 + j]
        return template

    horizon.set_tvp_fun(lambda _: window(sources, "_tvp", scaled.F))
    horizon.set_y_fun(lambda _: window(readings, "y_meas", data.z / data.noise))
    horizon.set_default_objective(
        P_x=casadi.DM(np.diag((scaled.unit / data.noise.min()) ** 2)),
        P_v=casadi.DM(np.eye(len(data.noise))),
        P_p=casadi.DM(np.eye(k) * arrival),
    )
    p_template = horizon.get_p_template()
    horizon.set_p_fun(lambda now: p_template)
    horizon.setup()
    horizon.x0 = augmented.start / scaled.unit
    horizon.p_est0 = np.zeros(k)
    horizon.set_initial_guess()

    def step(at: int) -> None:
        nonlocal now
        now = at
        if at >= HORIZON:  # a shorter window would repeat the first sample
            horizon.make_step((data.z[at] / data.noise).reshape(-1, 1))

    def known() -> Known:
        return augmented.known(np.asarray(horizon.p_est0.cat).ravel(), None)

    return measured(data, step, known)
