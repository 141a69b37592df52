"""A contact resistance between two layers, modelled in a case as a separate thin layer.

The data come from independent finite volumes with a resistance between two cells instead.
"""

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from livepde import cases

RESISTANCE, CONDUCTIVITY = 2e-3, 15.0  # m^2 K/W, W/(m K)
CAPACITY, THICK, THIN = 3.5e6, 0.04, 1e-4  # J/(m^3 K), m, m
DEPTHS = (0.005, 0.015, 0.025, 0.035)
TIMES = 4.0 * np.arange(151)
NOISE = 0.1

CASE = """\
title = "Two layers and their contact"
equation = "conduction"
initial = "25 degC"
mesh = { from = 0, to = "4 cm", cells = 80 }
data = { file = "wall.csv", time = "time_s", time_unit = "s" }
options.C = "3.5e6 J/(m^3 K)"
boundary.left = { flux = "Q" }
boundary.right = { value = "25 degC" }

[unknowns.k]
prior = "20 W/(m K)"
std = "10 W/(m K)"
transform = "log"

[unknowns.k.regions]
hot = ["0 cm", "1.995 cm"]
cold = ["2.005 cm", "4 cm"]

[unknowns.k.regions.contact]
over = ["1.995 cm", "2.005 cm"]
prior = "0.1 W/(m K)"
std = "0.1 W/(m K)"

[channels]
Q = { role = "input", column = "Q", unit = "W/m^2" }
T_1 = { role = "sensor", column = "T_1", at = "5 mm", noise = "0.1 K" }
T_2 = { role = "sensor", column = "T_2", at = "15 mm", noise = "0.1 K" }
T_3 = { role = "sensor", column = "T_3", at = "25 mm", noise = "0.1 K" }
T_4 = { role = "sensor", column = "T_4", at = "35 mm", noise = "0.1 K" }
"""


def flux(t: float) -> float:
    return 2e4 * (1.0 + np.sin(2.0 * np.pi * t / 400.0))


def temperatures(cells: int = 400, parts: int = 40) -> np.ndarray:
    """Return the readings of all sensors, shape (times, sensors)."""
    width = THICK / cells
    between = np.full(cells - 1, width / CONDUCTIVITY)
    between[cells // 2 - 1] += RESISTANCE
    g = 1.0 / between
    loss = np.zeros(cells)
    loss[:-1] += g
    loss[1:] += g
    loss[-1] += 2.0 * CONDUCTIVITY / width
    h = (TIMES[1] - TIMES[0]) / parts
    heat = CAPACITY * width
    A = sp.diags_array([heat + h * loss, -h * g, -h * g], offsets=[0, 1, -1])
    solver = splu(sp.csc_array(A))
    x, u = width * (np.arange(cells) + 0.5), np.zeros(cells)
    rows = [u]
    for k in range(1, (len(TIMES) - 1) * parts + 1):
        b = heat * u
        b[0] += h * flux(k * h)
        u = solver.solve(b)
        if k % parts == 0:
            rows.append(u)
    return 25.0 + np.array([np.interp(DEPTHS, x, row) for row in rows])


@pytest.mark.long
def test_a_thin_layer_is_a_contact_resistance(tmp_path: Path) -> None:
    shown = temperatures()
    shown = shown + NOISE * np.random.default_rng(0).standard_normal(shown.shape)
    table = np.column_stack([TIMES, shown, flux(TIMES)])
    header = "time_s,T_1,T_2,T_3,T_4,Q"
    np.savetxt(tmp_path / "wall.csv", table, "%.8g", ",", header=header, comments="")
    (tmp_path / "wall.toml").write_text(CASE)
    case = cases.load(tmp_path / "wall.toml")
    prepared, nodes = case.prepare(), case.mesh.p[0]
    assert np.isclose(nodes, 0.01995).any()  # both ends are nodes, although cells are longer
    assert np.isclose(nodes, 0.02005).any()
    result = prepared.identifier.run(prepared.stream)
    estimate = result.last
    truths = {
        "k[hot]": CONDUCTIVITY,
        "k[cold]": CONDUCTIVITY,
        "k[contact]": THIN / (RESISTANCE + THIN / CONDUCTIVITY),
    }
    for name, true in truths.items():
        low, high = estimate[name].interval(0.99)
        assert low <= true <= high
    low, high = estimate["k[contact]"].interval()
    assert high - low < 0.02 * truths["k[contact]"]
    assert result.verdict.level == "trusted"
