"""A PDE of your own: Fisher and KPP's spreading population, u_t = D u_xx + r u (1 - u)."""

import numpy as np
from skfem import ElementLineP2

import livepde as lp
from livepde.diagnostics import check_model
from livepde.streams import AbsoluteNoise, Twin


def fisher_kpp(length: float, cells: int) -> lp.Model:
    """Return the model; D and r are unknown. The form is nonlinear in u: nothing more to write."""
    mesh = lp.interval(0.0, length, cells)
    return lp.Model(
        state=lp.Field(mesh, ElementLineP2(), quadrature=6),
        parameter={
            "D": lp.Scalar(1.0, std=0.5, bounds=(0.01, 10.0), unit="mm^2/d"),
            "r": lp.Scalar(1.0, std=0.5, bounds=(0.0, 10.0), unit="1/d"),
        },
        A=lambda q, u, v, x: q.D * lp.dot(lp.grad(u), lp.grad(v)) - q.r * u * (1 - u) * v,
        time_unit="d",
    )


def main() -> dict[str, tuple[float, float]]:
    """Check the model, then find D = 0.6 and r = 1.4 from five point sensors."""
    model = fisher_kpp(length=20.0, cells=60)
    print(check_model(model, u=0.5))
    sensors = lp.Points([2.0, 5.0, 8.0, 12.0, 16.0], noise=0.01)
    start = lambda x: 0.8 * np.exp(-(x[0] ** 2))  # noqa: E731
    twin = Twin(
        model=model,
        observation=sensors,
        q_true={"D": 0.6, "r": 1.4},
        u0=start,
        times=0.1 * np.arange(81),
        noise=AbsoluteNoise(0.01),
    )
    law = lp.SensitivityLaw(replay=lp.Replay(first=10))
    result = lp.Identifier(model, sensors, law, u0=start).run(twin)
    for name, (value, std) in result.last.parameters.items():
        print(f"{name} = {value:.3f} ± {std:.3f}")
    return result.last.parameters


if __name__ == "__main__":
    main()
