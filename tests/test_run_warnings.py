"""Warnings of a run about its own estimates."""

from typing import Any

import numpy as np
import pytest
from factories import driven_rod, line

import livepde as lp
from livepde.reproduce import seed_excited
from livepde.runs import doubts, verdict
from livepde.stepping import Advance, simulate
from livepde.streams import AbsoluteNoise, Twin

SENSORS = {"A": 0.25, "B": 0.5, "C": 0.75}
TIMES = 0.1 * np.arange(61)


def rod(a: Any, loss: float = 0.0) -> lp.Model:
    unknowns = a if isinstance(a, dict) else {"a": a}
    loses = lambda u, v, x: loss * (u - 2.0) * v  # noqa: E731
    return driven_rod(unknowns, lambda t: 5 * np.sin(t), line(20), B=loses)


def run(model: lp.Model, truth: lp.Model, shift: Any = 0.0, **options: Any) -> Any:
    """Return the dataset of a run with noise 0.05, data of `truth` with a = 0.3."""
    points = lp.Points(SENSORS, noise=0.05, unit="degC")
    twin = Twin(
        model=truth,
        observation=points,
        q_true={"a": 0.3},
        u0=0.0,
        times=TIMES,
        noise=AbsoluteNoise(0.05),
    )
    samples = [(t, z + np.asarray(shift)) for t, z, *_ in map(as_tuple, twin)]
    return (
        lp.Identifier(model, points, lp.SensitivityLaw(**options), u0=0.0).run(samples).to_xarray()
    )


def as_tuple(item: Any) -> tuple[float, Any]:
    return (item.t, item.z) if isinstance(item, lp.Sample) else (item[0], item[1])


@pytest.mark.slow
def test_a_process_that_is_missing_is_said():
    found = doubts(run(rod(lp.Normal(0.2, 0.1)), rod(lp.Normal(0.2), loss=1.0), verdict=False))
    assert any("Model misfit" in text for text in found[:2])


@pytest.mark.slow
def test_an_unknown_that_nothing_shows_is_said():
    unseen = {"a": lp.Normal(0.2, 0.1), "b": lp.Normal(1.0, 0.5)}
    data = run(rod(unseen), rod(lp.Normal(0.2)))
    assert doubts(data) == [
        "`b` is not identifiable from these data: its standard deviation is still 100 % of the "
        "prior's. Use longer data with larger changes near the sensors."
    ]
    moving = {**unseen, "b": lp.Scalar(lp.Normal(1.0, 0.5), evolution=lp.MeanReverting(1.0))}
    assert doubts(run(rod(moving), rod(lp.Normal(0.2)))) == []


def test_few_samples_are_not_judged_and_none_neither():
    model = rod(lp.Normal(0.2, 0.1))
    identifier = lp.Identifier(model, lp.Full(), lp.GradientLaw(), u0=0.0)
    z = np.zeros(identifier.observed.size)
    for rows, why in (
        ([(0.1, z), (0.2, z)], "2 samples, at least 20 required"),
        ([], "no law has tested"),
    ):
        result = lp.Identifier(model, lp.Full(), lp.GradientLaw(), u0=0.0).run(rows)
        (said,) = doubts(result.to_xarray())
        assert said.startswith("Not judged: ")
        assert why in said
        assert verdict(result.to_xarray()).level == result.verdict.level == "not judged"


def reaction(cells: int) -> lp.Model:
    """Return u_t - u_xx + q u = f with a field q."""
    mesh = lp.interval(0.0, 1.0, cells)
    smooth = lp.Sobolev(1.0, 0.3).pointwise(1)
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
        {"q": lp.Field(mesh, lp.linear(mesh), inner=smooth, prior=lp.Normal(3.0, std=1.5))},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        f=seed_excited.f,
    )


@pytest.mark.slow
@pytest.mark.parametrize("cells", [60, 180])
def test_an_equation_error_that_is_no_noise_does_not_drive_a_field_out_of_its_prior(cells: int):
    """Data of 180 cells: 60 leave an error of the mesh, and q does not take it up."""
    fine, model, times = reaction(180), reaction(cells), 0.05 * np.arange(101)
    root = np.linalg.inv(np.linalg.cholesky(fine.Q.gram.toarray())).T
    true = 3.0 + root @ np.random.default_rng(0).standard_normal(fine.Q.dim)
    nodes = np.sort(model.mesh.p[0])
    G = lp.Points(nodes[(nodes > 0.299) & (nodes < 0.87)].tolist()).matrix(fine.state_space)
    control = Advance(lp.Alexander2(), dt_max=0.025)
    samples = [(t, G @ u) for t, u in simulate(fine, true, 0.0, times.tolist(), control)]
    identifier = lp.Identifier(
        model,
        lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87)),
        lp.GradientLaw(gain="auto"),
        u0=0.0,
        scheme=lp.Alexander2(),
    )
    data = identifier.run(samples).to_xarray()
    assert (data["status"] == 0).all()
    found = np.interp(np.sort(fine.mesh.p[0]), nodes, data["q"].values[-1])
    right = true[np.argsort(fine.mesh.p[0])]
    wrong = np.linalg.norm(found - right) / np.linalg.norm(right)
    assert wrong < 0.2
    assert data["departure"].values[-1] < 1.0
    assert not doubts(data)
