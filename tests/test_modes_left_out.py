"""Contribution of omitted modes to the interval of a field."""

import numpy as np
import pytest
from skfem import ElementLineP1

import livepde as lp
from livepde.runs.drive import drive, journal_of
from livepde.runs.journal import Journal
from livepde.runs.run_verdict import doubts
from livepde.runs.summary import tables

MESH = lp.interval(0.0, 1.0, 40)
POINTS = {f"u_{k}": x for k, x in enumerate(np.linspace(0.05, 0.95, 19).tolist())}


def model(length: float = 0.2) -> lp.Model:
    """Return a rod with an unknown source s(x), which all of its sensors together see well."""
    inner = lp.Sobolev(1, length).pointwise(1)
    return lp.Model(
        state=lp.Field(MESH, ElementLineP1(), dirichlet={"left": 0.0, "right": 0.0}),
        parameter={
            "s": lp.Field(MESH, ElementLineP1(), prior=lp.Normal(0.0, std=1.0), inner=inner)
        },
        A=lambda q, u, v, x: lp.dot(lp.grad(u), lp.grad(v)) - q.s * v,
    )


def ran(modes: int | str, journal=None) -> lp.Result:
    law = lp.SensitivityLaw(modes=modes)
    one = lp.Identifier(model(), lp.Points(POINTS, noise=1e-4), law, u0=0.0)
    samples = [lp.Sample(0.1 * k, np.zeros(len(POINTS))) for k in range(1, 11)]
    if journal is None:
        return one.run(samples)
    with journal_of(one, journal) as kept:
        return drive(one, samples, journal=kept).result


@pytest.mark.slow
def test_the_share_is_that_of_the_prior_beyond_the_modes():
    result = ran(4)
    belief, share = result.last.belief, result.to_xarray()["s_left_out"]
    rest, kept = belief.rest**2, (belief.q_factor**2).sum(axis=1)
    assert float(share[-1]) == pytest.approx(rest.sum() / (rest + kept).sum())
    assert 0.9 < float(share[-1]) < 1.0
    assert np.all(np.diff(share) > 0.0)  # what the data narrow is the rest


@pytest.mark.slow
def test_a_sentence_says_so_with_the_remedy():
    data = ran(4).to_xarray()
    (text,) = [text for text in doubts(data) if "modes" in text]
    std = np.sqrt((data["s_std"].values[-1] ** 2).mean())
    alone = std * np.sqrt(1.0 - float(data["s_left_out"][-1]))
    assert "More than 99 % of the variance of `s`" in text
    assert f"root mean square) is {std:.2g}, and {alone:.2g} from these modes alone" in text
    assert "Increase `law.modes`" in text
    (row,) = next(table for table in tables(data) if table.title == "Estimated fields").rows
    assert row[-2] == f"{100 * float(data['s_left_out'][-1]):.2g} %"


@pytest.mark.slow
def test_where_nothing_is_left_out_nothing_is_said():
    data = ran(41).to_xarray()
    assert float(data["s_left_out"][-1]) < 1e-6
    assert not [text for text in doubts(data) if "modes" in text]


@pytest.mark.slow
def test_a_journal_keeps_the_share(tmp_path):
    ran(4, tmp_path / "journal.sqlite")
    with Journal.open(tmp_path / "journal.sqlite") as kept:
        data = kept.layout.dataset(list(kept))
    assert np.array_equal(data["s_left_out"], ran(4).to_xarray()["s_left_out"])


def test_a_law_without_covariance_has_no_share():
    one = lp.Identifier(model(), lp.Full(), lp.GradientLaw(), u0=0.0)
    data = one.run([lp.Sample(0.1, np.zeros(one.observed.size))]).to_xarray()
    assert "s_left_out" not in data
