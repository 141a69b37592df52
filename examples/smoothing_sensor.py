"""Blurring sensors: a G whose range is not closed, so that G^+ fails and G_alpha works.

Each sensor measures the blurred state, z_k = integral of k(x_k - y) u(y) dy. A small error of z can
correspond to a large error of u, so G^+ z is useless with any noise (section 3.2).
"""

import numpy as np
from skfem import ElementLineP1

import livepde as lp
from livepde.observation import Discrepancy, Pseudoinverse, Tikhonov
from livepde.streams import AbsoluteNoise, Twin

NOISE = 1e-3  # the state is of size 1
WIDTH = 0.08  # of the blur


def u_true(x, t):
    """Return the true state, which is persistently excited."""
    return (1 + np.sin(t) / 2) * np.sin(np.pi * x[0]) + np.cos(0.7 * t) / 2 * np.sin(
        2 * np.pi * x[0]
    )


def q_true(x):
    """Return the true reaction."""
    return 2 + 3 * np.sin(np.pi * x[0]) ** 2


def f(x, t):
    """Return the source that makes u_true the solution of u_t - u_xx + q_true u = f."""
    first, second = np.sin(np.pi * x[0]), np.sin(2 * np.pi * x[0])
    rate = np.cos(t) / 2 * first - 0.35 * np.sin(0.7 * t) * second
    bend = np.pi**2 * ((1 + np.sin(t) / 2) * first + 4 * np.cos(0.7 * t) / 2 * second)
    return rate + bend + q_true(x) * u_true(x, t)


def blur(nodes: np.ndarray) -> np.ndarray:
    """Return the matrix G of sensors at all nodes, by the trapezoidal rule."""
    kernel = np.exp(-((nodes[:, None] - nodes[None, :]) ** 2) / (2 * WIDTH**2))
    return kernel / (WIDTH * np.sqrt(2 * np.pi)) * np.gradient(nodes)


def main() -> dict[str, tuple[float, float]]:
    """Run each reconstruction; return the relative errors of the state and of q at the end."""
    mesh = lp.interval(0.0, 1.0, 30)
    model = lp.Model(
        state=lp.Field(mesh, ElementLineP1(), dirichlet={"boundary": 0.0}),
        parameter=lp.Field(mesh, ElementLineP1(), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        f=f,
    )
    G = blur(mesh.p[0])
    found = {}
    for name, reconstruction in {
        "G^+ (alpha = 0)": Pseudoinverse(),
        "Tikhonov in X": Tikhonov("X", Discrepancy(tau=1.1)),
        "Tikhonov in V~": Tikhonov("V", Discrepancy(tau=1.1)),
    }.items():
        sensors = lp.observation.Matrix(G, noise=NOISE, reconstruction=reconstruction)
        twin = Twin(
            scheme=lp.ImplicitEuler(),
            model=model,
            observation=sensors,
            q_true=q_true,
            u_true=u_true,
            times=0.1 * np.arange(201),
            noise=AbsoluteNoise(NOISE),
        )
        law = lp.GradientLaw(gain=1e3, damping=lp.laws.ResidualDamping(100.0))
        identifier = lp.Identifier(model, sensors, law, u0=lambda x: u_true(x, 0.0))
        errors = []
        for sample in twin:
            estimate = identifier.step(sample.t, sample.z)
            u = twin.observed.reconstruct(sample.z).u
            errors.append(model.X.norm(u - twin.u(sample.t)) / model.X.norm(twin.u(sample.t)))
        found[name] = float(np.mean(errors)), twin.error(estimate.q)
        print(f"{name:16} error of u_alpha {found[name][0]:9.4f}, of q {found[name][1]:9.4f}")
    print(f"{'q = 0':16} error of q {twin.baseline(0.0):33.4f}")
    return found


if __name__ == "__main__":
    main()
