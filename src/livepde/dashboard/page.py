"""The live page: a Dash application that shows a run, or a table of many runs."""

from __future__ import annotations

import html as markup
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote

import dash
from dash import ALL, Input, Output, State, dcc, html, no_update
from werkzeug.middleware.dispatcher import DispatcherMiddleware

from livepde import __version__
from livepde.dashboard import cards
from livepde.dashboard.figures.canvas import CONFIG, when_axis
from livepde.dashboard.figures.panels import SECTIONS, Panel, panels
from livepde.dashboard.view import RunView, View
from livepde.plots.style import axis_label
from livepde.records import scalars
from livepde.runs import run_names
from livepde.runs.summary import digits

if TYPE_CHECKING:
    from wsgiref.types import WSGIApplication

    import xarray as xr
    from flask import Response

FAST, CATCHING_UP, SLOW = 2000, 300, 10_000  # milliseconds between two updates
STOPS = 400  # number of stops of the slider
OPEN = ("waiting", "running", "silent")  # statuses in which the page is updated often
PACE = 5000  # milliseconds between two updates of the table of runs
MOST_RUNS = 500  # largest number of rows in the table of runs
MOST_UNKNOWNS = 4  # largest number of columns for unknowns
MOST_PAGES = 16  # largest number of applications in memory
ORDER = ("bad", "warn", "info", "good")
T = TypeVar("T")


def page(path: Path, prefix: str = "/") -> dash.Dash:
    """Return the page of a run.

    `path`: directory of the run, which may still be in progress.
    `prefix`: end of the page's URL path, since the page may be mounted below another one.
    Raises `RunError`: there is no run.
    """
    view = View(path)
    app = application(f"{view.look().title} – livepde", prefix)
    app.layout = _skeleton
    _look(app, view)
    _steer(app, view)
    _draw(app, view)
    harden(app)
    return app


def application(title: str, prefix: str = "/") -> dash.Dash:
    """Return an empty page that loads nothing from other servers."""
    return dash.Dash(
        "livepde",
        assets_folder=str(Path(__file__).with_name("assets")),
        serve_locally=True,
        title=markup.escape(title),
        update_title="",
        meta_tags=[{"name": "viewport", "content": "width=device-width, initial-scale=1"}],
        requests_pathname_prefix=prefix,
        routes_pathname_prefix="/",
    )


def _skeleton() -> Any:
    """Return the initial layout of the page."""
    sections = [
        html.Section(
            [
                html.H2(title, id=f"title-{key}"),
                html.Div(id=f"panels-{key}", className="panels"),
                html.Div(id=f"tables-{key}"),
            ],
            id=f"section-{key}",
            **_aria(labelledby=f"title-{key}"),
        )
        for key, title in {**SECTIONS, "events": "Events"}.items()
    ]
    return html.Main(
        [
            dcc.Interval(id="tick", interval=CATCHING_UP),
            dcc.Store(id="news"),
            dcc.Store(id="at"),
            html.Header(
                [
                    html.H1(id="title"),
                    html.Div(id="chip", role="status", className="chip"),
                    html.P(id="summary"),
                    html.P(id="facts"),
                ]
            ),
            html.Ul(id="verdict", **_aria(label="Assessment")),
            html.Div(id="cards", **_aria(label="Estimates")),
            _timebar(),
            *sections,
            html.Footer(f"livepde {__version__}"),
        ]
    )


def _timebar() -> Any:
    """Return the slider of the time and the slider of the cuts through solids."""
    plain: Any = {"marks": None, "allow_direct_input": False}
    history = dcc.Slider(0, 1, value=1, id="slider", updatemode="drag", disabled=True, **plain)
    cut = dcc.Slider(0.05, 0.95, step=0.05, value=0.5, id="cut", **plain)
    return html.Div(
        [
            html.Label("History", htmlFor="slider", id="slider-label"),
            history,
            html.Output(id="shown"),
            html.Button("Newest", id="newest", n_clicks=0),
            html.Div([html.Label("Cuts", htmlFor="cut"), cut], id="cutbar", hidden=True),
        ],
        id="timebar",
        role="group",
        **_aria(label="History: arrow keys select the time, End follows the newest sample"),
    )


def _aria(**values: str) -> Any:
    return {f"aria-{name}": value for name, value in values.items()}


def _look(app: dash.Dash, view: View) -> None:
    """Register the callbacks that update the page at intervals."""

    @app.callback(
        Output("news", "data"),
        Output("tick", "interval"),
        Output("chip", "className"),
        *(Output(part, "children") for part in ("title", "chip", "summary", "facts")),
        Input("tick", "n_intervals"),
        State("news", "data"),
    )
    def look(_: int | None, known: int | None) -> tuple[Any, ...]:
        seen = view.look()
        news = no_update if known == seen.version else seen.version
        pace = CATCHING_UP if seen.reading else FAST if seen.status in OPEN else SLOW
        level = cards.STATUS.get(seen.status, ("info", ""))[0]
        texts = seen.title, cards.chip(seen), cards.summary(seen), cards.facts(seen)
        return news, pace, f"chip {level}", *texts


def _steer(app: dash.Dash, view: View) -> None:
    """Register the callbacks that follow the newest estimate, or hold the selected time."""

    @app.callback(
        Output("at", "data"),
        *(Output("slider", key) for key in ("min", "max", "step", "value", "disabled")),
        Output("shown", "children"),
        Input("news", "data"),
        Input("slider", "value"),
        Input("newest", "n_clicks"),
        State("at", "data"),
        prevent_initial_call=True,
    )
    def steer(_: int | None, wanted: float, __: int, before: float | None) -> tuple[Any, ...]:
        if (data := view.look().estimates) is None:
            return None, 0, 1, 1, 1, True, ""
        low, high = (float(data["time"].values[k]) for k in (0, -1))
        step = (high - low) / STOPS or 1.0
        at = None if dash.ctx.triggered_id == "newest" else before
        if dash.ctx.triggered_id == "slider":
            at = None if wanted >= high - step / 2 else wanted  # follows at the end
        moment = high if at is None else at
        label = f"{'newest' if at is None else 'history'}: {when_axis(data).text(moment)}"
        return at, low, high, step, moment, not high > low, label


def _draw(app: dash.Dash, view: View) -> None:
    """Register the callbacks that draw text, tables and figures for the chosen time."""

    @app.callback(
        *(Output(part, "children") for part in ("verdict", "cards")),
        *(Output(f"tables-{key}", "children") for key in ("sensors", "events")),
        Input("at", "data"),
        prevent_initial_call=True,
    )
    def tell(at: float | None) -> tuple[Any, ...]:
        seen = view.look()
        shown = cards.cards(seen.dataset, at)
        return cards.verdict(seen), shown, cards.sensor_tables(seen), cards.event_tables(seen)

    @app.callback(
        *(Output(f"panels-{key}", "children") for key in SECTIONS),
        *(Output(f"section-{key}", "hidden") for key in SECTIONS),
        Output("cutbar", "hidden"),
        Output({"panel": ALL}, "figure"),
        Output({"about": ALL}, "children"),
        Input("at", "data"),
        Input("cut", "value"),
        State({"panel": ALL}, "id"),
        prevent_initial_call=True,
    )
    def draw(at: float | None, cut: float, there: list[dict[str, str]]) -> tuple[Any, ...]:
        data = view.look().dataset
        shown = [] if data is None else panels(data, at, cut)
        names = [item["panel"] for item in there]
        # If the panels are the same, only figures and captions are sent, which preserves the focus.
        if names == [panel.name for panel in shown]:
            same = (no_update,) * (2 * len(SECTIONS) + 1)
            return (*same, [panel.figure for panel in shown], [panel.about for panel in shown])
        frames = [[_framed(panel) for panel in shown if panel.section == key] for key in SECTIONS]
        flat = data is None or "z" not in data.coords
        later = [no_update] * len(names)  # new frames contain their figures
        return *frames, *(not part for part in frames), flat, later, later


def _framed(panel: Panel) -> Any:
    return html.Figure(
        [
            html.H3(panel.title),
            html.Figcaption(panel.about, id={"about": panel.name}),
            dcc.Graph(
                id={"panel": panel.name},
                figure=panel.figure,
                config=CONFIG,
                style={"height": panel.figure.layout.height},
            ),
        ],
        className="panel",
    )


def harden(app: dash.Dash) -> None:
    """Set a policy that allows browsers to load and run only content of this server."""
    scripts = " ".join(app.csp_hashes())
    policy = (
        # Plotly compiles code for WebGL.
        f"default-src 'self'; script-src 'self' 'unsafe-eval' {scripts}; style-src 'self' "
        "'unsafe-inline'; img-src 'self' data: blob:; frame-ancestors 'none'"
    )

    @app.server.after_request  # type: ignore[untyped-decorator]
    def add(answer: Response) -> Response:
        answer.headers["Content-Security-Policy"] = policy
        return answer


class PerRun(Mapping[str, T]):
    """Cache of values for the runs of a folder, computed on demand; the latest are kept."""

    def __init__(self, folder: Path, prefix: str, most: int, make: Callable[[str], T]) -> None:
        self.folder, self.prefix = folder, prefix
        self._made = lru_cache(most)(make)

    def __iter__(self) -> Iterator[str]:
        return (f"{self.prefix}{name}" for name in run_names(self.folder))

    def __len__(self) -> int:
        return len(run_names(self.folder))

    def __getitem__(self, key: str) -> T:
        if key not in set(self):  # prevents paths out of the folder
            raise KeyError(key)
        return self._made(key.removeprefix(self.prefix))


def overview_page(folder: Path) -> WSGIApplication:
    """Return the page of a folder of runs, such as a fleet: a table, and the page of each run.

    `folder`: folder of run directories, to which new runs may be added.
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

    pages: Any = PerRun(folder, "/run/", MOST_PAGES, of)  # only `in` and [] are used
    return DispatcherMiddleware(app.server, pages)


def overview_table(views: Mapping[str, View]) -> Any:
    """Return a table of runs, the most severe verdict first."""
    seen = {name: views[name].look() for name in list(views)[:MOST_RUNS]}
    labels: dict[str, str] = {}  # unknown -> title of its column, beginning with the last run
    for one in seen.values():
        if (data := one.dataset) is not None:
            labels = {label: _title(data, label) for label in scalars(data)} | labels
    shown = list(labels)[:MOST_UNKNOWNS]
    titles = ["Run", "Status", "Assessment", "Newest sample", *(labels[k] for k in shown)]
    levels = {name: cards.gravest(one) for name, one in seen.items()}
    order = sorted(seen, key=lambda name: (ORDER.index(levels[name][0]), name))
    rows = [html.Tr(_cells(name, seen[name], levels[name], shown)) for name in order]
    more = len(views) - len(seen)
    count = f"{len(views)} runs" + (f", of which {more} are not shown." if more > 0 else ".")
    head = html.Thead(html.Tr([html.Th(title) for title in titles]))
    return [html.P(count), html.Table([head, html.Tbody(rows)])]


def _title(data: xr.Dataset, label: str) -> str:
    """Return the name of an unknown with its unit, and what its column contains."""
    name = axis_label(data, label)
    first_order = "comment" in data[f"{label}_std"].attrs
    return f"{name}, median ± first-order std. dev." if first_order else f"{name} ± std. dev."


def _cells(name: str, one: RunView, level: tuple[cards.Level, str], shown: list[str]) -> list[Any]:
    newest, values = "–", ["–"] * len(shown)
    if (data := one.estimates) is not None:
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
