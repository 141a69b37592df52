"""Your own PDE: a rod that conducts and radiates, C u_t = k u_xx - 2/R eps s (u^4 - a^4)."""

import numpy as np
from skfem import ElementLineP2

import livepde as lp
from livepde.streams import AbsoluteNoise, Twin


def radiating_rod(mesh, unknowns, dirichlet, R=0.005, C=3.9e6):
    """Return the model; the ambient temperature a is a channel of the stream."""
    loss = 2 / R * 5.67e-8
    return lp.Model(
        state=lp.Field(mesh, ElementLineP2(), dirichlet=dirichlet, unit="K", quadrature=10),
        parameter=unknowns,
        A=lambda q, u, v, x: (
            q.k * lp.dot(lp.grad(u), lp.grad(v)) + loss * q.eps * (u**4 - x.inputs["a"] ** 4) * v
        ),
        M=lambda u, v, x: C * u * v,
        inputs=["a"],
        time_unit="s",
    )


def main():
    """Check the model, then estimate k = 21 and eps = 0.8 from three thermometers."""
    k = lp.Scalar(lp.LogNormal(15.0, std=10.0), unit="W/(m K)")
    eps = lp.LogitNormal(0.5, std=0.2, bounds=(0.0, 1.0))
    model = radiating_rod(lp.interval(0.0, 0.2, 40), {"k": k, "eps": eps}, {"left": 900.0})
    lp.diagnostics.check_model(model, u=600.0, inputs={"a": 300.0}).raise_if_failed()
    sensors = lp.Points({"T_2": 0.02, "T_5": 0.05, "T_9": 0.09}, noise=1.0, unit="K")
    truth = {"q_true": {"k": 21.0, "eps": 0.8}, "u0": 300.0, "inputs": lambda t: {"a": 300.0}}
    times, noise = 10.0 * np.arange(121), AbsoluteNoise(1.0)
    stream = Twin(model=model, observation=sensors, times=times, noise=noise, **truth)  # yours here
    law = lp.SensitivityLaw()
    return lp.Identifier(model, sensors, law, u0=300.0).run(stream).last.parameters


if __name__ == "__main__":
    print(*(f"{name} = {v:.3f} ± {s:.3f}" for name, (v, s) in main().items()), sep="\n")
