"""Nonlinear sensors: two unknown numbers from pyrometers, which measure T^4."""

import numpy as np
from skfem import ElementLineP2

import livepde as lp
from livepde.diagnostics import check_observation
from livepde.streams import AbsoluteNoise, Twin

# u_t = k u_xx + s in units of the left end's temperature; three pyrometers measure z = u^4.
model = lp.Model(
    state=lp.Field(lp.interval(0.0, 1.0, 40), ElementLineP2(), dirichlet={"left": 1.0}),
    parameter={"k": lp.Normal(0.5, std=0.3, bounds=(0.01, 5.0)), "s": lp.Normal(0.0, std=2.0)},
    A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) - q.s * v,
)
sensors = lp.observation.Transformed(
    lp.Points({"T_1": 0.2, "T_2": 0.5, "T_3": 1.0}),
    function=lambda T: T**4,
    derivative=lambda T: 4 * T**3,  # optional, because T**4 is analytic
    noise=0.02,
)


def main() -> dict[str, tuple[float, float]]:
    """Check the sensors, then run on simulated readings with k = 0.8, s = 1.5 and noise 0.02."""
    print(check_observation(sensors, model))
    stream = Twin(
        model=model,
        observation=sensors,
        q_true={"k": 0.8, "s": 1.5},
        u0=1.0,
        times=0.02 * np.arange(151),
        noise=AbsoluteNoise(0.02),
    )
    result = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=1.0).run(stream)
    for name, (value, std) in result.last.parameters.items():
        print(f"{name} = {value:.3f} ± {std:.3f}")
    return result.last.parameters


if __name__ == "__main__":
    main()
