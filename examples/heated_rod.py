"""Control of a heated rod whose unknown conductivity jumps after an hour."""

import numpy as np
from skfem import ElementLineP1

import livepde as lp
import livepde.control as ct

PERIOD, ROOM = 60.0, 20.0  # s, degC


def rod(cells: int) -> lp.Model:
    """Return C u_t = k u_xx - h (u - room), heated at the left end, on a mesh of equal cells."""
    mesh = lp.interval(0.0, 0.15, cells)
    return lp.Model(
        state=lp.Field(mesh, ElementLineP1(), unit="degC"),
        parameter={"k": lp.LogNormal(20.0, std=10.0)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        B=lambda u, v, x: 2000.0 * (u - ROOM) * v,
        f=lp.On("left", lambda x, t: 60e3 * x.inputs["heater"]),
        M=lambda u, v, x: 3.6e6 * u * v,
        inputs=["heater"],
        time_unit="s",
    )


class Plant:
    """Simulated rod with a finer mesh, shorter steps, noise and a different conductivity."""

    def __init__(self) -> None:
        self.model, self.u, self.t = rod(100), np.full(101, ROOM), 0.0
        self.rng = np.random.default_rng(0)

    def run(self, heater: float) -> None:
        """Simulate one period."""
        q = np.log([26.0 if self.t < 3600.0 else 12.0])
        times = self.t + np.linspace(0.0, PERIOD, 13)
        control, held = lp.Advance(lp.ImplicitEuler()), lambda t: {"heater": heater}
        *_, (self.t, self.u) = lp.simulate(self.model, q, self.u, times.tolist(), control, held)

    def measure(self) -> np.ndarray:
        """Return the noisy readings of two thermocouples, at 5 and 10 cm."""
        return np.interp([0.05, 0.10], self.model.mesh.p[0], self.u) + self.rng.normal(0.0, 0.2, 2)


def main() -> dict[str, tuple[float, float]]:
    """Control the tip to 45 and then 60 degrees; neither the tip nor the hot face is measured."""
    model, plant = rod(30), Plant()
    sensors = lp.Points({"T_5": 0.05, "T_10": 0.10}, noise=0.2)
    law = lp.SensitivityLaw(jumps=lp.Jumps())
    applied = {"heater": "next"}  # each input was applied since the previous sample
    identifier = lp.Identifier(
        model, sensors, law, u0=ROOM, between=applied, scheme=lp.Alexander2()
    )

    seen = lp.Points({"face": 0.0, "tip": 0.15})
    reduced = ct.reduce(model, seen, controls=["heater"], sensors=sensors)
    print("missed by the reduced model:", reduced.error(h=PERIOD))
    goal = ct.Goal(track={"tip": 1.0}, move={"heater": 500.0}, inputs={"heater": (0.0, 1.0)})
    controller = ct.LQ(reduced, goal, PERIOD)  # or ct.MPC, with limits for the face

    loop = ct.Loop(identifier, controller)
    for k in range(150):
        action = loop.step(plant.t, plant.measure(), reference={"tip": 45.0 if k < 90 else 60.0})
        if k % 10 == 0 or action.estimate.diagnostics.jump > 0.0:
            k_now, std = action.estimate.parameters["k"]
            print(
                f"{plant.t / 60:4.0f} min: tip {plant.u[-1]:5.1f}, heater "
                f"{action.inputs['heater']:.2f}, k = {k_now:5.2f} ± {std:.2f}  {action.source}"
            )
        plant.run(action.inputs["heater"])
    return action.estimate.parameters


if __name__ == "__main__":
    main()
