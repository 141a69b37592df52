"""Least-squares fits of cases with more unknowns than the cases have, as quoted on their pages.

Each fit uses the forward model and all samples of a case at once, without a prior.
    column     three depths, without and with immobile water
    streambed  one uniform bed
    borehole   unknown heat capacities of fluid and grout (rho_c and share keep their priors)
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.optimize import least_squares

import livepde as lp
from livepde.cases import load
from livepde.stepping import Advance, simulate

CASES = Path(__file__).parents[1] / "cases"


class Forward:
    """Forward model of a case, with its readings z of shape (times, sensors)."""

    def __init__(self, name: str, settings: Mapping[str, Any]) -> None:
        self.case = case = load(CASES / f"{name}.toml", allow_code=True, settings=settings)
        self.prepared, self.model = case.prepare(), case.model
        readings: list[tuple[float, dict[str, Any]]] = [
            (sample.t, dict(cast("Mapping[str, Any]", sample.z))) for sample in self.prepared.stream
        ]
        spaces = self.model.state_space, self.model.X, self.model.parameter_space
        self.observed = case.observation.bind(*spaces)
        self.z = np.array([[z[name] for name in self.observed.names] for _, z in readings])
        self.inputs = dict(readings)

    def __call__(self, numbers: Mapping[str, Any], u0: Any = None) -> np.ndarray:
        """Return the predictions for given unknowns, shape (times, sensors)."""
        q = self.model.initial_parameter(numbers)
        start = self.prepared.u0 if u0 is None else u0
        control = Advance(self.case.scheme, self.case.dt_max)
        states = simulate(self.model, q, start, list(self.inputs), control, self.inputs.get)
        known = self.model.latent.value(q)
        return np.array([self.observed.predict(u, known, lp.fem.Moment(t)) for t, u in states])


def fit(
    residual: Callable[[Any], Any], start: Any, high: Any = np.inf, low: float = 1e-6
) -> tuple[Any, float]:
    """Fit parameters within bounds; return them and the root mean square of the residuals."""

    def finite(p: Any) -> Any:  # without missing samples
        misses = np.ravel(residual(p))
        return misses[np.isfinite(misses)]

    scale = np.abs(start)
    solution = least_squares(finite, start, bounds=(low, high), x_scale=scale, diff_step=[1e-5])
    return solution.x, float(np.sqrt(np.mean(solution.fun**2)))


def column() -> None:
    print("depth  D [cm^2/h]  v [cm/h]  immobile  omega [1/h]     left")
    start, high = [0.1, 2.5, 0.95, 0.1], [9.0, 9.0, 0.9999, 9.0]
    for curve, depth in enumerate(("11 cm", "17 cm", "23 cm")):
        settings = {"data.options.curve": curve, "channels.c.at": depth}
        for case, names in (("soil_column", "D v"), ("soil_column_immobile", "D v phi omega")):
            forward, unknown = Forward(case, settings), names.split()

            def misses(p: Any, forward: Forward = forward, unknown: Any = unknown) -> Any:
                return forward.z - forward(dict(zip(unknown, p, strict=True)))

            p, left = fit(misses, start[: len(unknown)], high[: len(unknown)])
            more = f"{1 - p[2]:10.3f}{p[3]:13.3f}" if len(p) == 4 else " " * 23
            print(f"{depth}{p[0]:12.3f}{p[1]:10.3f}{more}{left:9.4f}")


def streambed() -> None:
    forward = Forward("streambed_035_uniform", {})

    def misses(p: Any) -> Any:
        return (forward.z - forward({"kappa": 1e-6 * p[0], "K": 1e-5 * p[1]}))[1:]

    p, left = fit(misses, [0.8, -1.0], low=-np.inf)
    print(f"kappa {1e-6 * p[0]:.3g} m^2/s, K {1e-5 * p[1]:.3g} m/s, left {left:.3f} K")


def borehole() -> None:
    def misses(p: Any) -> Any:
        k, heat, R_b, share, fluid, grout = p
        capacities = {"options.C_f": 8800.0 * float(fluid), "options.C_g": 3.8e6 * float(grout)}
        forward = Forward("thermal_response_grout", capacities)
        z = forward({"k": k, "rho_c": 2.55e6 * heat, "R_b": R_b, "share": share})
        return np.append((forward.z - z) / 0.05, [(heat - 1) / 0.1, (share - 0.27) / 0.05])

    p, left = fit(misses, [2.0, 1.0, 0.15, 0.27, 1.0, 1.0], [9.0, 9.0, 9.0, 0.99, 9.0, 9.0])
    print(f"k {p[0]:.2f} W/(m K), R_b {p[2]:.3f} m K/W, left {0.05 * left:.3f} K")
    print(f"C_f {8800 * p[4]:.0f} J/(m K), C_g {3.8 * p[5]:.2f} MJ/(m^3 K)")


STUDIES = {study.__name__: study for study in (column, streambed, borehole)}

if __name__ == "__main__":
    for name in sys.argv[1:] or STUDIES:
        STUDIES[name]()
