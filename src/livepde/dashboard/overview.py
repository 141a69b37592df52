"""Overview of many runs in a browser: a row for each, and its page behind a link."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote

from dash import Input, Output, dcc, html
from werkzeug.middleware.dispatcher import DispatcherMiddleware

from livepde import __version__
from livepde.dashboard import cards
from livepde.dashboard.canvas import unit_of, when_axis
from livepde.dashboard.page import application, harden, page
from livepde.dashboard.view import RunView, View
from livepde.plots.dataset import labelled
from livepde.records import scalars
from livepde.runs import run_names
from livepde.runs.summary import digits

if TYPE_CHECKING:
    from wsgiref.types import WSGIApplication

    import xarray as xr

PACE = 5000  # milliseconds between two looks
MOST_RUNS = 500  # rows
MOST_UNKNOWNS = 4  # columns
MOST_PAGES = 16  # applications that are kept
ORDER = ("bad", "warn", "info", "good")

T = TypeVar("T")


class PerRun(Mapping[str, T]):
    """Values made for runs of a folder when they are asked for; the latest are kept."""

    def __init__(self, folder: Path, prefix: str, most: int, make: Callable[[str], T]) -> None:
        self.folder, self.prefix = folder, prefix
        self._made = lru_cache(most)(make)

    def __iter__(self) -> Iterator[str]:
        return (f"{self.prefix}{name}" for name in run_names(self.folder))

    def __len__(self) -> int:
        return len(run_names(self.folder))

    def __getitem__(self, key: str) -> T:
        if key not in set(self):  # so that no path leads out of the folder
            raise KeyError(key)
        return self._made(key.removeprefix(self.prefix))


def overview_page(folder: Path) -> WSGIApplication:
    """Return the page of a folder of runs, such as a fleet's: a table, and the page of each run.

    Parameters
    ----------
    folder
        It holds run directories. Runs that begin later appear, too.
    """
    views = PerRun(folder, "", MOST_RUNS, lambda name: View(folder / name))
    app = application(f"{folder.resolve().name} – livepde")
    app.layout = lambda: html.Main(
        [
            dcc.Interval(id="tick", interval=PACE),
            html.Header([html.H1(folder.resolve().name), html.P(id="facts")]),
            html.Div(overview_table(views), id="runs"),
            html.Footer(f"livepde {__version__}"),
        ]
    )

    @app.callback(Output("runs", "children"), Input("tick", "n_intervals"))
    def look(_: int | None) -> Any:
        return overview_table(views)

    harden(app)

    def of(name: str) -> WSGIApplication:
        server: WSGIApplication = page(folder / name, f"/run/{quote(name)}/").server
        return server

    pages: Any = PerRun(folder, "/run/", MOST_PAGES, of)  # of a dict it uses `in` and []
    return DispatcherMiddleware(app.server, pages)


def overview_table(views: Mapping[str, View]) -> Any:
    """Return a table of runs, those with the gravest verdict first."""
    seen = {name: views[name].look() for name in list(views)[:MOST_RUNS]}
    labels = _labels(one.dataset for one in seen.values() if one.dataset is not None)
    shown = list(labels)[:MOST_UNKNOWNS]
    titles = ["Run", "Status", "Assessment", "Newest sample", *(labels[k] for k in shown)]
    levels = {name: cards.gravest(one) for name, one in seen.items()}
    order = sorted(seen, key=lambda name: (ORDER.index(levels[name][0]), name))
    rows = [html.Tr(_cells(name, seen[name], levels[name], shown)) for name in order]
    more = len(views) - len(seen)
    count = f"{len(views)} runs" + (f", of which {more} are not shown." if more > 0 else ".")
    head = html.Thead(html.Tr([html.Th(title) for title in titles]))
    return [html.P(count), html.Table([head, html.Tbody(rows)])]


def _labels(datasets: Iterable[xr.Dataset]) -> dict[str, str]:
    """Return unknown -> title of its column; those of the last dataset come first."""
    found: dict[str, str] = {}
    for data in datasets:
        found = {k: _title(data, k) for k in scalars(data)} | found
    return found


def _title(data: xr.Dataset, label: str) -> str:
    """Return the name of an unknown with its unit, and what its column contains."""
    name = labelled(label, unit_of(data, label))
    first_order = "comment" in data[f"{label}_std"].attrs
    return f"{name}, median ± first-order std. dev." if first_order else f"{name} ± std. dev."


def _cells(name: str, one: RunView, level: tuple[cards.Level, str], shown: list[str]) -> list[Any]:
    """Return the cells of one run."""
    data, newest, values = one.dataset, "–", ["–"] * len(shown)
    if data is not None and data.sizes["time"]:
        newest = when_axis(data).text(float(data["time"][-1]))
        known = scalars(data)
        values = [_value(data, label) if label in known else "–" for label in shown]
    link = html.A(name, href=f"/run/{quote(name)}/")
    short = level[1].partition(": ")[0].partition(". ")[0].removesuffix(".")
    sign = html.Span([cards.sign(level[0]), html.Span(short)], title=level[1])
    cells: list[Any] = [link, cards.chip(one), sign, newest, *values]
    return [html.Td(cell) for cell in cells]


def _value(data: Any, label: str) -> str:
    """Return the last estimate of an unknown with its standard deviation."""
    value, std = (float(data[key].values[-1]) for key in (label, f"{label}_std"))
    return " ± ".join(cards.pretty(text) for text in digits(value, std))
