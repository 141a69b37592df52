"""Settings for the comparison of livepde with its reference implementation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from experiments.reference import Setting


def paper_q(x: Any) -> Any:
    """Return the parameter q* of section 4."""
    return 0.025 * x**2 - 0.025 * x


def paper_u(x: Any, t: float) -> Any:
    """Return the state u* of section 4."""
    return np.sin(np.pi * x) / (1 + t)


def paper_f(x: Any, t: float) -> Any:
    """Return the source f of section 4, for D = 1."""
    return (np.pi**2 - 1 / (1 + t) + paper_q(x)) * paper_u(x, t)


def twin_q(x: Any) -> Any:
    """Return the parameter q* of a persistently excited process."""
    return 2 + 3 * np.sin(np.pi * x) ** 2


def twin_u(x: Any, t: float) -> Any:
    """Return the state u* of a persistently excited process."""
    return (1 + np.sin(t) / 2) * np.sin(np.pi * x) + np.cos(0.7 * t) / 2 * np.sin(2 * np.pi * x)


def varying_D(x: Any) -> Any:
    """Return a positive diffusivity D that varies by a factor of nine."""
    return 1 + 0.8 * np.sin(2 * np.pi * x)


def wave(size: float, x: Any, t: float) -> Any:
    """Return a smooth data error of a given size."""
    return size * np.sin(2 * np.pi * x) * np.cos(t)


PAPER = Setting(paper_q, paper_u, paper_f, omega=(0.3, 0.87), cut=True, gain=100.0, c1=1.0)
"""Figure 1 of the paper, but with a gain of 100 and data of the discrete process."""

FULL = replace(PAPER, omega=(0.0, 1.0))
"""`PAPER` with full observation."""

TWIN = Setting(twin_q, twin_u, parameter_ends="free", h=0.05, steps=200, gain=1000.0, c1=1.0)
"""Full observation of a persistently excited process whose source makes u* a discrete solution."""

VARYING = replace(
    TWIN,
    D=varying_D,
    omega=(0.3, 1.0),
    nodes=21,
    state="P1",
    parameter="P1",
    h=0.02,
    steps=500,
    c1=10.0,
)
"""Section 4.1 with a varying D."""


def scaled(size: float, error: float = 0.0) -> Setting:
    """Return a setting with constant q* = 2, constant mu, and a state of a given size.

    Gain and mu scale with the state, so that the estimates of q do not depend on the size.
    """
    return Setting(
        q_true=partial(np.full_like, fill_value=2.0),
        u_true=lambda x, t: size * (1 + np.sin(t) / 2) * np.sin(np.pi * x),
        nodes=21,
        state="P1",
        parameter="constant",
        inner="L2",
        h=0.05,
        steps=600,
        error=partial(wave, error * size) if error else None,
        gain=1 / size**2,
        mu=0.1 * size,
    )


SETTINGS: dict[str, Setting] = {
    "partial, gain 1, c_1 = 0.1": replace(PAPER, gain=1.0, c1=0.1),
    "partial, gain 1": replace(PAPER, gain=1.0),
    "partial, c_1 = 0.1": replace(PAPER, c1=0.1),
    "partial": PAPER,
    "partial, gain 1e4, c_1 = 0.1": replace(PAPER, gain=1e4, c1=0.1),
    "partial, gain 1e4": replace(PAPER, gain=1e4),
    "partial, clamped": replace(PAPER, state_ends="clamped", parameter_ends="clamped"),
    "partial, P1": replace(PAPER, state="P1", parameter="P1"),
    "partial, sigma = 1e-3": replace(PAPER, sigma=1e-3),
    "partial, nu = 0.01": replace(PAPER, nu=0.01),
    "partial, nu = 0.1": replace(PAPER, nu=0.1),
    "full, gain 1, c_1 = 0.1": replace(FULL, gain=1.0, c1=0.1),
    "full": FULL,
    "full, gain 1e4": replace(FULL, gain=1e4),
    "full, analytic truth": replace(FULL, truth="exact"),
    "twin": TWIN,
    "twin, constant mu": replace(TWIN, c1=0.0, mu=0.1),
    "twin, alpha = 1e-3": replace(TWIN, alpha=1e-3),
    "twin, partial, alpha = 1e-3": replace(TWIN, omega=(0.3, 0.87), cut=True, alpha=1e-3),
    "twin, alpha = 1e-6 in H2": replace(TWIN, alpha=1e-6, penalty="H2", error=partial(wave, 0.001)),
    "twin, P1, sigma = 0.01": replace(TWIN, state="P1", parameter="P1", sigma=0.01),
    "varying D, nu = 0": VARYING,
    "varying D, nu = 0.1": replace(VARYING, nu=0.1),
    "scaled, S = 1": scaled(1.0),
    "scaled, S = 300": scaled(300.0),
    "scaled, S = 1e3": scaled(1e3),
    "scaled, S = 1e5": scaled(1e5),
    "scaled, S = 1, error 0.1 %": scaled(1.0, 1e-3),
    "scaled, S = 300, error 0.1 %": scaled(300.0, 1e-3),
    "scaled, S = 1e3, error 0.1 %": scaled(1e3, 1e-3),
    "scaled, S = 1e5, error 0.1 %": scaled(1e5, 1e-3),
}
"""Name -> setting."""
