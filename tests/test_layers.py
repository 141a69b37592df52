"""Layers of a conductivity as a cause of a misfit: the truth is by finite volumes."""

from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest

import livepde as lp
from livepde.verdict import Cause

LENGTH, CELLS, SUB, NOISE = 0.4, 80, 400, 0.03
PLACES = {"T_10": 0.1, "T_20": 0.2, "T_30": 0.3}


@cache
def soil(ratio: float) -> tuple[pd.DataFrame, Any]:
    """Return hourly temperatures over a week in a soil, and the state at the start."""
    h, dx = 3600.0 / SUB, LENGTH / CELLS
    x = dx * (np.arange(CELLS) + 0.5)
    alpha = np.where(x > 0.15, ratio, 1.0) * 6e-7
    between = 2 * alpha[1:] * alpha[:-1] / (alpha[1:] + alpha[:-1])
    faces = np.concatenate([[2 * alpha[0]], between, [2 * alpha[-1]]])
    u, rows, rng = np.full(CELLS, 15.0), [], np.random.default_rng(4)
    for k in range(9 * 24 * SUB + 1):
        t = 2 * np.pi * k * h / 86400.0
        ends = 15.0 + 5.0 * np.sin(t) + 2.0 * np.sin(2 * t + 1.0), 15.0 + 0.5 * np.sin(t / 3.0)
        if k % SUB == 0:
            rows.append([*ends, *u])
        flux = faces * np.diff(np.concatenate([ends[:1], u, ends[1:]])) / dx
        u = u + h * np.diff(flux) / dx
    every = np.array(rows)[48:]  # the first two days establish the daily waves
    at = np.concatenate([[0.0, LENGTH], x])
    order = np.argsort(at)
    table = pd.DataFrame({"top": every[:, 0], "end": every[:, 1]}, index=3600.0 * np.arange(169))
    for name, place in PLACES.items():
        clean = np.array([np.interp(place, at[order], row[order]) for row in every])
        table[name] = clean + NOISE * rng.standard_normal(169)
    nodes = np.linspace(0.0, LENGTH, 41)
    return table, np.interp(nodes, at[order], every[0][order])


def causes(ratio: float, **options: Any) -> list[Cause]:
    """Return the likely causes for a model with one diffusivity."""
    table, start = soil(ratio)
    ends = {"left": lp.Channel("top"), "right": lp.Channel("end")}
    model = lp.models.heat(lp.interval(0.0, LENGTH, 40), lp.LogNormal(8e-7, std=5e-7), ends)
    sensors: Any = lp.Points(PLACES, noise=NOISE, unit="degC")
    last = lp.Identifier(model, sensors, u0=start).run(table.assign(**options)).last
    assert last is not None
    return [one for finding in last.verdict.findings for one in finding.causes]


@pytest.mark.parametrize("ratio", [0.6, 2.0])
def test_two_layers_are_named_first_with_their_border(ratio: float) -> None:
    first = causes(ratio)[0]
    assert (first.kind, first.share > 0.7) == ("layers", True)
    assert first.setting.endswith("regions={ layer_1 = [0, 0.15], layer_2 = [0.15, 0.4] }")


def test_layers_are_not_named_if_the_diffusivity_is_uniform() -> None:
    assert not causes(1.0)


def test_a_wrong_sensor_is_named_before_layers() -> None:
    table, _ = soil(1.0)
    first = causes(1.0, T_20=0.95 * table["T_20"])[0]
    assert first.subject == "T_20"
