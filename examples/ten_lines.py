"""Two unknown numbers of a heated rod in ten lines, estimated as the samples arrive."""

import numpy as np
from skfem import ElementLineP2

import livepde as lp
from livepde.streams import AbsoluteNoise, Twin

# u_t = k u_xx + s, with unknown conductivity k and heat source s; the right end is measured.
mesh = lp.interval(0.0, 1.0, 40)
model = lp.Model(
    state=lp.Field(mesh, ElementLineP2(), dirichlet={"left": 0.0, "right": lp.Channel("T_end")}),
    parameter={"k": lp.LogNormal(0.5, std=0.3), "s": lp.Normal(0.0, std=2.0)},
    A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) - q.s * v,
)
sensors = lp.Points({"T_1": 0.3, "T_2": 0.6}, noise=0.01)


def main() -> dict[str, tuple[float, float]]:
    """Run on simulated data with k = 0.8, s = 1.5 and noise 0.01."""
    stream = Twin(
        model=model,
        observation=sensors,
        q_true={"k": 0.8, "s": 1.5},
        u0=0.0,
        times=0.02 * np.arange(301),
        inputs=lambda t: {"T_end": np.sin(3.0 * t)},
        noise=AbsoluteNoise(0.01),
    )
    identifier = lp.Identifier(model, sensors, lp.SensitivityLaw())
    for sample in stream:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
    for name, (value, std) in estimate.parameters.items():
        print(f"{name} = {value:.3f} ± {std:.3f}")
    return estimate.parameters


if __name__ == "__main__":
    main()
