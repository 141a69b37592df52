"""Room behind a wall with unknown layers, heated by a weak heater.

The layers in the wall of an old building are unknown. By day the air must be warm, by night it may
cool down, heat has a price, and the heater barely exceeds the losses of a cold day. Therefore a
controller must start heating in time. The conductivities determine how long the wall takes to warm
up. If the assumed wall insulates too well, heating starts too late and the room is cold in the
morning; in the opposite case it starts too early, which is expensive.

The room is a lumped node: air and furniture are a layer with so large a conductivity that it has a
uniform temperature. The film of air at the wall is a layer with a negligible heat capacity.

The outside temperature is a record in `LIVEPDE_DATA` (soil_temperature, hourly air temperature of
March and April), with a different week for each seed and an exact forecast. The conductivities are
drawn from the prior for each seed.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.control.problem import Problem, Simulated
from livepde.control import Goal, Trust, reduce
from livepde.errors import ConfigurationError
from livepde.fem import Field, LogNormal, On, Piecewise, dot, grad, line, linear
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Points
from livepde.stepping import Alexander2

HOUR, DAY = 3600.0, 86400.0
# Name -> end in m, data-sheet conductivity in W/(m K), heat capacity in J/(m^3 K), number of cells.
ROOM: dict[str, tuple[float, float, float, int]] = {
    "room": (0.02, 10.0, 6e5, 1),
    "film": (0.03, 0.08, 1.2e3, 1),
}
WALL: dict[str, tuple[float, float, float, int]] = {
    "masonry": (0.23, 0.8, 1.6e6, 12),
    "insulation": (0.28, 0.06, 5e4, 3),
    "render": (0.36, 0.9, 1.6e6, 5),
}
LAYERS = ROOM | WALL
DEEP = ROOM["room"][0]
SPREAD = 0.6  # prior standard deviation of the factor on a data-sheet conductivity
AIRING, OUTSIDE = 0.6, 20.0  # W/(m^2 K), ventilation and outer air film
POWER = 40.0  # W/m^2, power of the heater per area of the wall
NOISE = 0.1  # K
COLD = 8.0  # degC, initial temperature of the unheated building
WARM, NIGHT = 20.0, 15.0  # degC, lower limits by day and by night
MORNING, EVENING = 6.0, 18.0  # h
HOTTEST = 24.0  # degC
PRICE = 1.0 / POWER  # a sample with full power costs 1
LEARNT = 2.0 * DAY  # s, end of the learning phase; every controller heats up on the first day
PENALTY = 5.0  # cost of one kelvin below the limit in a sample
PERIOD, HORIZON, DAYS = 1800.0, 20, 5
FINE = 4, 300.0  # cells of the truth per cell of the model, and its time step in s
WEEKS = (0, 1, 2, 4, 5)  # weeks of the record with frost
RECORD = Path("soil_temperature") / "soil_2025_mar_jun.csv"


def process(fine: int = 1) -> Model:
    """Return the model of room and wall, per square metre of wall."""
    nodes, begin = [0.0], {}
    for name, (end, _, _, cells) in LAYERS.items():
        begin[name] = nodes[-1]
        nodes += np.linspace(nodes[-1], end, cells * fine + 1)[1:].tolist()

    def inside(x: Any, name: str) -> Any:
        return (x[0] >= begin[name]) & (x[0] < LAYERS[name][0])

    def layered(x: Any, layers: Mapping[str, Any], column: int) -> Any:
        return sum(values[column] * inside(x, name) for name, values in layers.items())

    mesh = line(nodes).with_subdomains({"room": lambda x: x[0] < DEEP})
    share = Piecewise(
        {name: partial(inside, name=name) for name in WALL}, LogNormal(1.0, std=SPREAD)
    )
    return Model(
        Field(mesh, linear(mesh), unit="degC"),
        {"k": share},
        A=lambda q, u, v, x: q.k * layered(x, WALL, 1) * dot(grad(u), grad(v)),
        B=[
            lambda u, v, x: layered(x, ROOM, 1) * dot(grad(u), grad(v)),
            On("room", lambda u, v, x: AIRING / DEEP * u * v),
            On("right", lambda u, v, x: OUTSIDE * u * v),
        ],
        f=[
            On("room", lambda x, _: (x.inputs["heater"] + AIRING * x.inputs["outside"]) / DEEP),
            On("right", lambda x, _: OUTSIDE * x.inputs["outside"]),
        ],
        M=lambda u, v, x: layered(x, LAYERS, 2) * u * v,
        inputs=["heater", "outside"],
        time_unit="s",
    )


def comfort(t: float) -> dict[str, tuple[float, float]]:
    """Return the limits of the air temperature at time t."""
    occupied = MORNING <= t / HOUR % 24.0 < EVENING
    return {"air": (WARM if occupied else NIGHT, HOTTEST)}


def wall(seed: int = 0) -> Problem:
    """Return the problem of a seed."""
    sensors, outputs = Points({"air": 0.0, "face": 0.03}, noise=NOISE), Points({"air": 0.0})
    model, fine = process(), process(FINE[0])
    rng = np.random.default_rng([seed, 0])
    labels = list(model.parameter_space.labels)
    values = np.exp(SPREAD * rng.standard_normal(len(labels)))
    true = dict(zip(labels, values.tolist(), strict=True))
    record = weather()[24 * 7 * WEEKS[seed % len(WEEKS)] :]

    def outside(t: float) -> dict[str, float]:
        return {"outside": float(np.interp(t / HOUR, np.arange(len(record)), record))}

    def plant(noise: int) -> Simulated:
        start = {"heater": 0.0, **outside(0.0)}
        given = lambda t: true  # noqa: E731
        return Simulated(
            fine, sensors, outputs, given, u0=COLD, step=FINE[1], seed=noise, start=start
        )

    return Problem(
        name="wall",
        title="A room behind a wall whose layers are unknown",
        reduced=reduce(model, outputs, ["heater"], sensors=sensors, modes=4, u=COLD),
        identifier=lambda: Identifier(
            model,
            sensors,
            SensitivityLaw(),
            u0=COLD,
            scheme=Alexander2(),
            between={"heater": "next", "outside": "next"},
        ),
        goal=Goal(
            track={},
            move={"heater": 1e-6},
            inputs={"heater": (0.0, POWER)},
            limits={"air": (NIGHT, HOTTEST)},
            price={"heater": PRICE},
            penalty=PENALTY,
        ),
        period=PERIOD,
        horizon=HORIZON,
        samples=round(DAYS * DAY / PERIOD),
        plant=plant,
        truth=lambda t: true,
        drive={"heater": 0.05 * POWER, "outside": 0.5},
        reference=lambda t: {},
        disturbances=outside,
        before={"heater": 0.0},
        limits=comfort,
        foreseen=True,
        settled=LEARNT,
        tolerance=0.2,
        # The outer layer is barely identifiable, and does not affect the room.
        trust=Trust(spread=2.0),
    )


@cache
def weather() -> Array:
    """Return the hourly outside temperatures, in degC."""
    folder = os.environ.get("LIVEPDE_DATA")
    if not folder:
        raise ConfigurationError(
            f"wall: the weather is read from {RECORD}, and LIVEPDE_DATA is not set; set it to the "
            "folder that holds the measurements, or leave this problem out."
        )
    with (Path(folder) / RECORD).open(newline="") as file:
        return np.array([float(row["TA_1_1_1"]) for row in csv.DictReader(file)])
