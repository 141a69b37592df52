"""Heated rod with an unknown conductivity that jumps.

A heater of limited power heats a rod at one end. The rod loses heat to the room along its side. Its
tip should follow a temperature program, and the hot face must not exceed the limit of the material.
Only two thermocouples inside the rod are measured. A controller needs the conductivity for three
quantities: the gain from the heater to the tip, the difference between the face and the
thermocouples, and the time by which the heater must act before the program changes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.control.problem import Problem, Simulated
from livepde.control import Goal, reduce
from livepde.fem import Field, LogNormal, On, Scalar, dot, grad, interval, linear
from livepde.identifier import Identifier
from livepde.laws import Jumps, SensitivityLaw
from livepde.model import Model
from livepde.observation import Points
from livepde.stepping import Alexander2

LENGTH = 0.15  # m
CAPACITY = 3.6e6  # J/(m^3 K): steel
LOSS = 2000.0  # W/(m^3 K): 10 W/(m^2 K) around a rod of 20 mm
POWER = 60e3  # W/m^2 of the heater
CONDUCTIVITY = Scalar(LogNormal(20.0, std=10.0), unit="W/(m K)")
BEFORE, AFTER, JUMP = 26.0, 12.0, 9000.0  # W/(m K), W/(m K), s
SENSORS = {"T_5": 0.05, "T_10": 0.10}
NOISE = 0.2  # K
OUTPUTS = {"face": 0.0, "tip": LENGTH}
HOTTEST = 180.0  # degC
TOLERANCE = 1.0  # K, approximate accuracy of a thermocouple
LEVELS, HOLD = (45.0, 60.0), 3600.0  # degC, s
PERIOD, SAMPLES, HORIZON = 60.0, 360, 30
ROOM = 20.0  # degC
CELLS, MODES = 30, 2
FINE = 150, 5.0  # cells, s


def process(cells: int) -> Model:
    """Return the model of the rod on a uniform mesh."""
    mesh = interval(0.0, LENGTH, cells)
    return Model(
        Field(mesh, linear(mesh), unit="degC"),
        {"k": CONDUCTIVITY},
        A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)),
        B=lambda u, v, x: LOSS * u * v,
        f=[
            lambda x, _: LOSS * x.inputs["room"],
            On("left", lambda x, _: POWER * x.inputs["heater"]),
        ],
        M=lambda u, v, x: CAPACITY * u * v,
        inputs=["heater", "room"],
        time_unit="s",
    )


def truth(t: float) -> Mapping[str, float]:
    """Return the true conductivity at time t, with its jump."""
    return {"k": BEFORE if t <= JUMP else AFTER}


def program(t: float) -> Mapping[str, float]:
    """Return the target temperature of the tip at time t."""
    return {"tip": LEVELS[int(t // HOLD) % 2]}


def room(t: float) -> Mapping[str, float]:
    """Return the measured room temperature at time t."""
    return {"room": ROOM + 2.0 * float(np.sin(2.0 * np.pi * t / 7200.0))}


def rod(seed: int = 0) -> Problem:
    """Return the problem, which does not depend on the seed: seeds only draw the noise."""
    sensors, outputs = Points(SENSORS, noise=NOISE), Points(OUTPUTS, unit="degC")
    model, fine = process(CELLS), process(FINE[0])
    law = SensitivityLaw(jumps=Jumps())

    def plant(seed: int) -> Simulated:
        start = {"heater": 0.0, **room(0.0)}
        return Simulated(
            fine, sensors, outputs, truth, u0=ROOM, step=FINE[1], seed=seed, start=start
        )

    return Problem(
        name="rod",
        title="A heated rod whose conductivity is unknown and jumps",
        reduced=reduce(model, outputs, ["heater"], sensors=sensors, u=ROOM, modes=MODES),
        identifier=lambda: Identifier(
            model,
            sensors,
            law,
            u0=ROOM,
            scheme=Alexander2(),
            between={"heater": "next", "room": "next"},
        ),
        goal=Goal(
            track={"tip": 1.0},
            move={"heater": 500.0},
            inputs={"heater": (0.0, 1.0)},
            limits={"face": (-np.inf, HOTTEST)},
        ),
        period=PERIOD,
        horizon=HORIZON,
        samples=SAMPLES,
        plant=plant,
        truth=truth,
        drive={"heater": 0.01},
        reference=program,
        disturbances=room,
        before={"heater": 0.0},
        tolerance=TOLERANCE,
        jump=JUMP,
    )
