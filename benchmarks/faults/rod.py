"""Case and rows of the test process, a rod with one end heated and cooled periodically."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any, TypeAlias

import numpy as np

STEP = 60.0  # seconds between two rows
ALPHA = 2e-5  # diffusivity of the rod, m^2/s
SILENCE = 1.0  # seconds after which a source is reported as silent

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
    """Return the case file of the rod, with lines that configure a data source."""
    return _CASE.format(source=source, silence=silence, leap=leap)


def rod_rows(count: int) -> list[dict[str, Any]]:
    """Return noisy rows of a rod with one end heated and cooled periodically."""
    rng, start = np.random.default_rng(0), datetime(2026, 1, 1)
    x, rate = np.array([0.0, 0.3, 0.6]), 0.04  # positions, and phase per row
    decay = x / math.sqrt(2.0 * ALPHA / (rate / STEP))  # decay and phase lag of the thermal wave
    rows = []
    for k in range(count):
        wave = np.exp(-decay) * np.cos(rate * k - decay)
        T = 20.0 + 5.0 * (1.0 - x - wave) + [0.0, *0.2 * rng.standard_normal(2)]
        names = ("left", "T_3", "T_6")
        values = dict(zip(names, T.tolist(), strict=True))
        rows.append({"time": str(start + timedelta(seconds=STEP * k)), **values})
    return rows
