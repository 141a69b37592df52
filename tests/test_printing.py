"""Tables on narrow terminals."""

import io

import pytest
from rich.console import Console

import livepde as lp
from livepde.cli.printing import print_table
from livepde.reproduce import boiger2016
from livepde.runs import Table

ROW = ["nodal, mu = 1", 0.01, 1.0, 1.0, 0.0, 419.3123, 72.85, 2.2917e-4, 2.2917e-4, 0.0, 0.0, 5558]


@pytest.mark.parametrize("width", [40, 80, 200])
def test_numbers_are_never_cut(width: int) -> None:
    out = io.StringIO()
    rows = [[*ROW, 5554.123, 0], [*ROW, None, 3]]
    print_table(Console(file=out, width=width), Table("a table", boiger2016.COLUMNS, rows))
    text = out.getvalue()
    assert "…" not in text
    for value in ("419.3", "0.0002292", "5558", "5554", "72.85", "–"):
        assert value in text.split()


def test_words_are_folded_where_they_fit_no_longer() -> None:
    out = io.StringIO()
    table = Table("", ["what", "value"], [["word " * 30, 0.123456]])
    print_table(Console(file=out, width=40), table)
    assert out.getvalue().split().count("word") == 30
    assert max(len(line.rstrip()) for line in out.getvalue().splitlines()) <= 40
    assert "0.1235" in out.getvalue()


def test_an_estimate_without_covariance_has_no_interval():
    rod = lp.models.heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    mean = lp.Averages({"T": lambda x: x[0] > 0.5})
    estimate = lp.Identifier(rod, mean, lp.GradientLaw(), u0=1.0).step(0.1, [0.9])
    assert str(estimate["alpha"]) == f"{estimate.q[0]:.4g}"
