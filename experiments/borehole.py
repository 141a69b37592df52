"""Sensitivity of the conductivity in `cases/thermal_response_grout.toml` to its assumptions.

Changes one assumption at a time. Prints k with its standard deviation, the time from which k stays
within 5 % of an independent measurement, and the share of 95 % intervals that contain that value.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from experiments.failed_steps import FailedSteps
from livepde.cases import load
from livepde.plots import interval_95
from livepde.runs import drive

CASE = Path(__file__).parents[1] / "cases" / "thermal_response_grout.toml"
WATER, GROUT = 4890.0, 3910.0  # heat capacities within r_p, J/(m K); C_f is their sum
ERROR = "channels.T_fluid.correlated"
CHANGES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "k 1 ± 0.5": {"unknowns.k": {"prior": 1.0, "std": 0.5}},
    "k 4 ± 2": {"unknowns.k": {"prior": 4.0, "std": 2.0}},
    "grout - 10 %": {"options.C_g": 0.9 * 3.8e6, "options.C_f": WATER + 0.9 * GROUT},
    "grout + 10 %": {"options.C_g": 1.1 * 3.8e6, "options.C_f": WATER + 1.1 * GROUT},
    "water - 20 %": {"options.C_f": 0.8 * WATER + GROUT},
    "water + 20 %": {"options.C_f": 1.2 * WATER + GROUT},
    "T0 - 0.1 K": {"options.T0": "22.0 degC", "initial": "22.0 degC"},
    "T0 + 0.1 K": {"options.T0": "22.2 degC", "initial": "22.2 degC"},
    "from 1 h on": {"data.assimilate_from": "1 h"},
    "from 10 h on": {"data.assimilate_from": "10 h"},
    "correlated, 3 h": {f"{ERROR}.time": "3 h"},
    "correlated, 12 h": {f"{ERROR}.time": "12 h"},
    "correlated, 0.05 K": {f"{ERROR}.std": "0.05 K"},
    "correlated, 0.2 K": {f"{ERROR}.std": "0.2 K"},
    "not correlated": {f"{ERROR}.std": "1e-6 K"},
    "no cold ends": {"mesh.y": [0, 100, 400, 1000, 3000]},
}


def main() -> None:
    steps = FailedSteps()
    chosen = {title: CHANGES[title] for title in sys.argv[1:] or CHANGES}
    print(f"{'changed':20}{'k':>14}{'6 h':>14}{'10 h':>14}{'within 5 %':>12}{'covered':>9}")
    for title, settings in chosen.items():
        case = load(CASE, settings=settings)
        prepared = case.prepare()
        data = drive(prepared.identifier, prepared.stream).result.to_xarray()
        steps.add(data.sizes["time"], int((data["status"] != 0).sum()))
        true, hours = case.references["k"], data["time"].values / 3600
        k, std = data["k"].values, data["k_std"].values
        far = hours[np.abs(k / true - 1) > 0.05]
        within = f"{hours[hours > far[-1]][0]:.1f} h" if far[-1] < hours[-1] else "never"
        low, high = interval_95(data, "k")
        used = hours >= prepared.assimilate_from / 3600
        covered = np.mean(((low <= true) & (true <= high))[used])
        at = [int(np.abs(hours - hour).argmin()) for hour in (hours[-1], 6.0, 10.0)]
        row = "".join(f"{k[i]:7.2f} ± {std[i]:.2f}" for i in at)
        print(f"{title:20}{row}{within:>12}{covered:9.1%}", flush=True)
    steps.report()


if __name__ == "__main__":
    main()
