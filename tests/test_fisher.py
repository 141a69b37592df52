"""Fisher-KPP and porous Fisher: travelling waves, random parameters, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import livepde as lp
from livepde import cases
from livepde.models import fisher_kpp, porous_fisher
from livepde.stepping import Advance, Alexander2, simulate

ONE = lp.Normal(1.0, 1.0)
CASE = Path(__file__).parents[1] / "cases" / "scratch_assay.toml"


def kpp_wave(x, t):
    """Ablowitz and Zeppetella (1979): speed 5/sqrt(6)."""
    return (1.0 + np.exp((x - 5 / np.sqrt(6) * t) / np.sqrt(6))) ** -2.0


def sharp_wave(x, t):
    """Newman (1980): speed 1/sqrt(2), nothing beyond the front."""
    return np.maximum(1.0 - np.exp((x - t / np.sqrt(2)) / np.sqrt(2)), 0.0)


def error(function, wave, cells, span, **options):
    mesh = lp.interval(*span, cells)
    model = function(mesh, ONE, ONE, **options)
    times = np.linspace(0.0, 6.0, cells // 5 + 1)
    control = Advance(Alexander2())
    *_, (t, u) = simulate(model, np.ones(2), lambda x: wave(x[0], 0.0), times, control)
    return model.state_block.at_vertices @ u - wave(mesh.p[0], t)


@pytest.mark.slow
def test_the_exact_wave_of_fisher_kpp():
    coarse, fine = (np.abs(error(fisher_kpp, kpp_wave, n, (-20, 40))).max() for n in (150, 300))
    assert fine < 4e-4
    assert coarse / fine > 3.5  # second order in space and time


@pytest.mark.slow
def test_the_sharp_wave_of_porous_fisher():
    coarse, fine = (error(porous_fisher, sharp_wave, n, (-10, 20)) for n in (150, 600))
    assert np.abs(fine).max() < 3e-3  # at the foot
    assert np.abs(fine).mean() < 5e-5
    assert np.abs(coarse).mean() / np.abs(fine).mean() > 8


def test_what_is_refused():
    mesh = lp.interval(0.0, 1.0, 4)
    with pytest.raises(lp.errors.ModelError, match="K must be a positive number"):
        fisher_kpp(mesh, ONE, ONE, K=0.0)
    with pytest.raises(lp.errors.ModelError, match="m must be at least 1"):
        porous_fisher(mesh, ONE, ONE, m=0.5)


@pytest.mark.study
@pytest.mark.parametrize(
    ("density", "D", "r"), [(10, 0.0074, 1.05), (14, 0.0164, 1.16), (18, 0.0177, 1.30)]
)
@pytest.mark.parametrize("prior", [0.003, 0.05])
def test_scratch_assays_find_the_published_values(density, D, r, prior, data_dir, monkeypatch):
    """Whatever the prior of D; Lagergren et al. (2020)."""
    monkeypatch.setenv("LIVEPDE_DATA", str(data_dir))
    wide = {"unknowns.D": {"prior": prior, "std": prior}, "data.options.density": density}
    prepared = cases.load(CASE, allow_code=True, settings=wide).prepare()
    prepared.identifier.run(prepared.stream)
    assert prepared.identifier.estimate().q == pytest.approx([D, r], rel=0.15)
