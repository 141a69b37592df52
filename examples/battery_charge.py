"""Charge a battery particle as fast as its surface allows while estimating its diffusivity."""

import numpy as np

import livepde as lp
import livepde.control as ct
from livepde.models import battery_particle
from livepde.models.battery import FARADAY

R, AREA, FULL = 5e-6, 1.0, 30555.0  # m, m^2, mol/m^3
ONE = FARADAY * FULL * AREA * R / 3 / 3600.0  # A, the current that fills the particle in an hour
PERIOD, NOISE, LIMIT = 30.0, 2e-3, 0.85  # s, V, largest filling at the surface


def particle(cells: int) -> lp.Model:
    """Return the particle model on a mesh that is finer towards the surface."""
    mesh = lp.fem.line((R * (1.0 - np.linspace(1.0, 0.0, cells + 1) ** 2)).tolist())
    D = lp.LogNormal(6e-15, std=3e-15)
    return battery_particle(mesh, D, area=AREA, c_max=FULL)


def voltage(c):
    """Return the open-circuit voltage of graphite, Safari and Delacourt (2011): flat at 0.085 V."""
    x = c / FULL
    falling = 0.6379 + 0.5416 * np.exp(-305.5309 * x) - 0.6875 * np.tanh((x + 0.0117) / 0.0529)
    steps = 0.044 * np.tanh((0.1958 - x) / 0.1088) - 0.1978 * np.tanh((x - 1.0571) / 0.0854)
    return falling + steps - 0.0175 * np.tanh((x - 0.5692) / 0.0875)


class Cell:
    """Simulated cell with a finer mesh, shorter steps, noise and slower diffusion."""

    def __init__(self, D: float) -> None:
        self.model, self.D, self.t = particle(60), D, 0.0
        self.c = self.model.initial(0.3 * FULL)
        self.rng = np.random.default_rng(0)

    def run(self, current: float) -> None:
        """Simulate one period."""
        times = (self.t + np.linspace(0.0, PERIOD, 11)).tolist()
        control, held = lp.Advance(lp.ImplicitEuler()), lambda t: {"I": current}
        *_, (self.t, self.c) = lp.simulate(
            self.model, np.log([self.D]), self.c, times, control, held
        )

    def measure(self) -> np.ndarray:
        """Return the voltage with noise."""
        return voltage(self.c[-1:]) + self.rng.normal(0.0, NOISE, 1)


def main(D: float = 3e-15) -> dict[str, float]:
    """Charge a cell from 30 to 75 %; return D and std over the truth, and the fillings reached."""
    model, cell = particle(24), Cell(D)
    sensor = lp.observation.Transformed(lp.Points({"V": R}), voltage, noise=NOISE)
    identifier = lp.Identifier(
        model,
        sensor,
        lp.SensitivityLaw(),
        u0=0.3 * FULL,
        scheme=lp.Alexander2(),
        between={"I": "next"},  # the current since the previous sample
    )

    seen = lp.observation.Functionals(
        {
            "mean": lambda q, c, x: 3.0 / R * c / FULL,
            "surface": lp.On("right", lambda q, c, x: c / FULL),
        }
    )
    reduced = ct.reduce(
        model, seen, ["I"], sensors=sensor, modes=2, rates=[1 / PERIOD], u=0.3 * FULL
    )
    goal = ct.Goal(
        track={"mean": 1.0},
        move={"I": 1e-5},
        inputs={"I": (-3.0 * ONE, 0.0)},
        limits={"surface": (-np.inf, LIMIT)},
    )
    controller = ct.MPC(reduced, goal, PERIOD, horizon=12)
    loop = ct.Loop(identifier, controller, ct.Trust(spread=1.0), before={"I": 0.0})
    highest = 0.0
    for k in range(80):
        action = loop.step(cell.t, cell.measure(), reference={"mean": 0.75})
        cell.run(action.inputs["I"])
        highest = max(highest, cell.c[-1] / FULL)
        if k % 8 == 0:
            value, std = action.estimate.parameters["D"]
            print(
                f"{cell.t / 60:4.0f} min: {action.inputs['I'] / ONE:5.2f} C, "
                f"mean {action.outputs['mean']:.3f}, surface {cell.c[-1] / FULL:.3f}, "
                f"D = {value:.2g} ± {std:.1g} m^2/s ({action.source})"
            )
    value, std = action.estimate.parameters["D"]
    return {"D": value / D, "std": std / D, "highest": highest, "mean": action.outputs["mean"]}


if __name__ == "__main__":
    main()
