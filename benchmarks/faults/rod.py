"""The process of these runs: a rod whose end is warmed and cooled, its case and its rows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any, TypeAlias

import numpy as np

STEP = 60.0  # seconds from one row to the next
ALPHA = 2e-5  # m^2/s, of the rod
SILENCE = 1.0  # seconds after which a source is said to be silent

Row: TypeAlias = Mapping[str, Any]

_CASE = """title = "A rod beside its process"
equation = "heat"
initial = "interpolate"

[mesh]
from = "0 m"
to = "1 m"
cells = 20

[data]
time = "time"
{source}

[intake]
silence = "{silence} s"
leap = "{leap}"

[unknowns.alpha]
prior = "3e-5 m^2/s"
std = "1e-5 m^2/s"
bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]

[channels]
left = {{ role = "boundary", column = "left", at = "left", unit = "degC" }}
T_3 = {{ role = "sensor", column = "T_3", at = "0.3 m", unit = "degC" }}
T_6 = {{ role = "sensor", column = "T_6", at = "0.6 m", unit = "degC" }}

[boundary]
right = "20 degC"

[law]
kind = "sensitivity"
noise = "0.2 K"

[output]
fields_every = 20
"""


def case_text(source: str = "", silence: float = SILENCE, leap: str = "1 d") -> str:
    """Return the case of the rod, with the lines that name a source."""
    return _CASE.format(source=source, silence=silence, leap=leap)


def rod_rows(count: int) -> list[dict[str, Any]]:
    """Return rows of a rod whose end is warmed and cooled, with noise."""
    rng, start = np.random.default_rng(0), datetime(2026, 1, 1)
    x, rate = np.array([0.0, 0.3, 0.6]), 0.04  # places, and the phase that passes in a minute
    decay = x / math.sqrt(2.0 * ALPHA / (rate / STEP))  # of a wave that goes into the rod
    found = []
    for k in range(count):
        wave = np.exp(-decay) * np.cos(rate * k - decay)
        T = 20.0 + 5.0 * (1.0 - x - wave) + [0.0, *0.2 * rng.standard_normal(2)]
        names = ("left", "T_3", "T_6")
        values = dict(zip(names, T.tolist(), strict=True))
        found.append({"time": str(start + timedelta(seconds=STEP * k)), **values})
    return found
