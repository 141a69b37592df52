"""Contents of figures, and messages if nothing can be drawn."""

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import livepde as lp
from livepde import plots

DAY = 86400.0


def dataset(
    *,
    scalars: dict[str, float] | None = None,
    fields: tuple[str, ...] = (),
    points: np.ndarray | None = None,
    sensors: int = 2,
    validation: int = 0,
    samples: int = 30,
    span: float = 10.0,
    unit: str = "",
    std: float = 0.1,
) -> xr.Dataset:
    """A dataset as `Result.to_xarray()` gives it, with made-up numbers."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, span, samples)
    points = np.linspace(0, 1, 11)[None] if points is None else points
    data = xr.Dataset(
        coords={
            "time": ("time", t, {"units": unit}),
            "snapshot": t[::3],
            "sensor": [f"s{k}" for k in range(sensors)],
            "validation": [f"w{k}" for k in range(validation)],
            **{axis: ("vertex", p) for axis, p in zip("xyz", points, strict=False)},
        }
    )
    for label, value in (scalars or {}).items():
        data[label] = ("time", value + np.exp(-t / span), {"units": "W/(m K)"})
        data[f"{label}_std"] = ("time", np.full(samples, std), {"units": "W/(m K)"})
    shape = (len(t[::3]), points.shape[1])
    for name in (*fields, "u"):
        data[name] = (("snapshot", "vertex"), rng.standard_normal(shape), {"units": "degC"})
        if np.isfinite(std):
            data[f"{name}_std"] = (("snapshot", "vertex"), np.full(shape, std))
    data["innovation"] = (("time", "sensor"), rng.standard_normal((samples, sensors)))
    if validation:
        data["validation_error"] = (("time", "validation"), np.full((samples, validation), 0.5))
    data["status"] = ("time", np.zeros(samples, dtype=int))
    data.attrs = {"fields": " ".join(fields), "scalars": "\n".join(scalars or {}), "state": "u"}
    return data


def texts(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    return [text.get_text() for text in legend.get_texts()] if legend else []


def panel(figure: Figure, title: str) -> Axes:
    return next(ax for ax in figure.axes if ax.get_title().startswith(title))


def drawn(figure: Figure) -> Figure:
    figure.canvas.draw()  # layout and text: warnings are errors
    return figure


@pytest.mark.slow
def test_matplotlib_is_loaded_to_draw_and_pyplot_never() -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import livepde.plots;"
        "print('matplotlib' in sys.modules); from test_plots import *;"
        "drawn(plots.overview(dataset(scalars={'k': 2.0})));"
        "print('matplotlib.pyplot' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]


def test_without_matplotlib_one_sentence_tells_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    for draw in (
        lambda: plots.overview(dataset()),
        lambda: plots.curves(dataset(), np.zeros(0), np.zeros((0, 2))),
        lambda: plots.profiles(dataset(), "u"),
        lambda: plots.history({}),
    ):
        with pytest.raises(lp.errors.ConfigurationError, match=r"pip install 'livepde\[plots\]'"):
            draw()


def test_scalars_have_a_line_and_a_band_each_and_one_panel_for_all_regions() -> None:
    scalars = {"D[top]": 1.0, "D[bottom]": 2.0, "k": 3.0}
    figure = drawn(plots.overview(dataset(scalars=scalars), title="A run"))
    assert figure.get_suptitle() == "A run"
    regions, k = panel(figure, "D"), panel(figure, "k")
    assert len(regions.lines) == 2
    assert len(regions.collections) == 2
    assert texts(regions) == [
        "top = 1.368, 95 %: 1.172 to 1.564",
        "bottom = 2.368, 95 %: 2.172 to 2.564",
    ]
    assert texts(k) == ["k = 3.368, 95 %: 3.172 to 3.564"]
    assert k.get_ylabel() == "k [W/(m K)]"
    assert "95 %" in k.get_title()


def test_a_law_without_deviations_gets_no_band() -> None:
    figure = drawn(plots.overview(dataset(scalars={"k": 3.0}, fields=("q",), std=np.nan)))
    assert not panel(figure, "k").collections
    assert texts(panel(figure, "k")) == ["k = 3.368"]
    assert not panel(figure, "q").collections


def test_a_run_with_dates_shows_them() -> None:
    data = dataset(scalars={"k": 3.0}, span=20 * DAY, unit="s")
    data.attrs["origin"] = "2016-06-28 06:45:00"
    ax = panel(plots.overview(data), "k")
    assert ax.get_xlabel() == ""
    assert str(ax.lines[0].get_xdata()[0]).startswith("2016-06-28T06:45")
    assert texts(panel(plots.overview(data), "u"))[0] == "2016-06-28 06:45:00"


@pytest.mark.slow
def test_long_runs_in_seconds_are_shown_in_days() -> None:
    data = dataset(scalars={"k": 3.0}, span=20 * DAY, unit="s")
    ax = panel(plots.overview(data), "k")
    assert ax.get_xlabel() == "t [d]"
    assert ax.lines[0].get_xdata()[-1] == pytest.approx(20)
    assert texts(panel(plots.overview(data), "u"))[0] == "t = 0 d"
    hours = plots.overview(dataset(scalars={"k": 3.0}, span=5 * 3600.0, unit="s"))
    assert panel(hours, "k").get_xlabel() == "t [h]"
    seconds = plots.overview(dataset(scalars={"k": 3.0}, span=60.0, unit="s"))
    assert panel(seconds, "k").get_xlabel() == "t [s]"


def test_sensors_are_named_with_their_error() -> None:
    data = dataset(sensors=3, validation=1)
    data["innovation"].values[5:9] = np.nan
    figure = drawn(plots.overview(data))
    rms = float(np.sqrt((data["innovation"][:, 1] ** 2).mean()))
    assert f"s1: RMSE {rms:.3g}" in texts(panel(figure, "innovation"))
    assert texts(panel(figure, "error of validation")) == ["w0: RMSE 0.5"]


@pytest.mark.parametrize(
    ("options", "variable", "where", "value", "title", "expected"),
    [
        ({"sensors": 40}, "innovation", 3, np.nan, "innovation", "range of 40 channels"),
        ({}, "innovation", (slice(None), 1), np.nan, "innovation", "s1: RMSE nan"),
        ({"scalars": {"k": 3.0}}, "status", [4, 7], 1, "k", "2 failed steps"),
        ({"points": np.random.default_rng(0).random((3, 8))}, "u", 0, 0.0, "u in space", "median"),
    ],
)
def test_legends_of_an_overview(
    options: Any, variable: str, where: Any, value: float, title: str, expected: str
) -> None:
    """Of many sensors, one that is silent, failed steps, and a field in space."""
    data = dataset(**options)
    data[variable].values[where] = value
    assert expected in texts(panel(drawn(plots.overview(data)), title))


def test_the_band_of_the_prior_does_not_flatten_the_estimate() -> None:
    data = dataset(scalars={"k": 3.0})
    data["k_std"].values[:2] = 1e6
    low, high = panel(plots.overview(data), "k").get_ylim()
    assert high - low < 3


@pytest.mark.slow
def test_a_field_in_the_plane_is_a_map_with_its_deviation() -> None:
    points = np.array([[0, 1, 0, 1, 0.5], [0, 0, 1, 1, 0.5]], dtype=float)
    data = dataset(fields=("q",), points=points)
    figure = drawn(plots.overview(data))
    titles = [ax.get_title() for ax in figure.axes]
    assert {"q at t = 9.31", "standard deviation of q at t = 9.31", "u at t = 9.31"} <= set(titles)
    data["triangle"] = (("cell", "corner"), np.array([[0, 1, 4], [0, 2, 4]]))
    given = panel(drawn(plots.overview(data)), "q at").collections[0]
    assert len(given.get_array()) == 5


def test_sensors_are_on_maps() -> None:
    points = np.array([[0, 1, 0, 1, 0.5], [0, 0, 1, 1, 0.5]], dtype=float)
    data = dataset(fields=("q",), points=points)
    count = data.sizes["sensor"]
    x, y = np.linspace(0.1, 0.9, count), np.full(count, 0.5)
    data = data.assign_coords(sensor_x=("sensor", x), sensor_y=("sensor", y))
    (shown,) = panel(drawn(plots.overview(data)), "u at").lines
    assert np.array_equal(shown.get_xydata(), np.stack([x, y], axis=1))


def test_profiles_have_a_line_for_each_time_and_the_exact_one() -> None:
    data = dataset(fields=("q",))
    exact = np.linspace(0, 1, 11)
    ax = plots.profiles(data, "q", times=(0, 5, 9.4), exact=exact, observed=(0.3, 0.7))
    assert texts(ax) == ["observed", "t = 0", "t = 5.172", "t = 9.31", "95 %", "exact"]
    assert len(ax.lines) == 4
    marked = [line for line in ax.lines if line.get_marker() != "None"]
    assert len(marked) == 3
    assert np.array_equal(marked[-1].get_ydata(), data["q"].values[-1])
    assert np.array_equal(ax.lines[-1].get_ydata(), exact)
    assert ax.get_ylabel() == "q [°C]"
    drawn(ax.figure)  # type: ignore[arg-type]


def test_profiles_of_a_state_have_an_exact_line_for_each_time() -> None:
    data = dataset(std=np.nan)
    ax = plots.profiles(data, "u", times=2, exact=np.zeros((2, 11)), legend=False)
    curves = [line for line in ax.lines if len(line.get_xdata())]
    assert len(curves) == 4
    assert [line.get_linestyle() for line in curves] == ["-", "--", "-", "--"]
    assert ax.get_legend() is None


def test_history() -> None:
    ax = plots.history(
        {"a": ([0, 1], [1, 0.1]), "b": ([0, 1], [1, 0.2])}, levels={"q = 0": 1.0}, ylabel="error"
    )
    assert texts(ax) == ["a", "b", "q = 0"]
    assert ax.get_yscale() == "log"
    assert plots.history({"a": ([0, 1], [1, 2])}, log=False).get_yscale() == "linear"
    drawn(ax.figure)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: plots.profiles(dataset(), "D"), r"no field 'D'; it has \['u', 'u_std'\]"),
        (lambda: plots.profiles(dataset(points=np.eye(2)), "u"), "one space dimension"),
        (lambda: plots.overview(dataset().isel(time=slice(0))), "no samples yet"),
        (lambda: plots.profiles(dataset().isel(snapshot=slice(0)), "u"), "no snapshots"),
    ],
)
def test_refusals(draw: Any, message: str) -> None:
    with pytest.raises(lp.errors.ConfigurationError, match=message):
        draw()


def test_loops_name_a_limit_once():
    t = np.arange(3.0)
    names = ["y", "y_low", "y_high", "y_reference"]
    data = {name: ("time", t + shift) for name, shift in zip(names, (0, -1, 1, 0), strict=True)}
    run = xr.Dataset(data, coords={"time": ("time", t, {"units": "s"})})
    figure = plots.loops({"a": run, "b": run}, ["y"])
    legends = [ax.get_legend() for ax in figure.axes]
    assert [text.get_text() for text in legends[0].get_texts()] == ["reference", "limit"]
    assert legends[1] is None


@pytest.mark.slow
def test_an_unknown_over_orders_of_magnitude_has_a_logarithmic_axis() -> None:
    data = dataset(scalars={"k": 3.0}, span=60.0, unit="s")
    assert panel(plots.overview(data), "k").get_yscale() == "linear"
    data["k"][0] = 300.0
    data["k_low"], data["k_high"] = data["k"] / 2.0, 2.0 * data["k"]
    assert panel(plots.overview(data), "k").get_yscale() == "log"


@pytest.mark.parametrize("span", [200.0, 4 * 3600.0, 4 * DAY, 1400 * DAY])
def test_dates_of_any_span_have_ticks(span: float) -> None:
    data = dataset(span=span, unit="s").assign_attrs(origin="2024-10-25 06:00:00")
    ax = plots.style.panel(None)
    ax.plot(plots.style.time_values(data, data["time"].values), data["time"].values)
    plots.style.time_axis(ax, data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a locator that finds no interval
        assert 3 <= len(ax.get_xticks()) <= 8


# --- measured and expected -----------------------------------------------------------------------


def test_measured_and_expected_curves_of_each_sensor() -> None:
    data = dataset(validation=1)
    t = data["time"].values
    measured = np.column_stack([t, 2.0 * t, 3.0 * t])
    measured[4, 1] = np.nan
    (ax,) = drawn(plots.curves(data, t, measured, title="A run")).axes
    assert texts(ax) == ["s0", "s1", "w0 (validation)"]
    assert [line.get_linestyle() for line in ax.lines[1::2]] == ["-", "-", "--"]
    points, lines = ax.lines[::2], ax.lines[1::2]
    errors = [data["innovation"][:, 0], data["innovation"][:, 1], data["validation_error"][:, 0]]
    for k, (point, line) in enumerate(zip(points, lines, strict=True)):
        np.testing.assert_array_equal(point.get_ydata(), measured[:, k])
        np.testing.assert_allclose(line.get_ydata(), measured[:, k] - errors[k].values)


def test_the_overview_begins_with_what_was_measured() -> None:
    data = dataset(scalars={"k": 3.0}, validation=1)
    t = data["time"].values
    first, *rest = drawn(plots.overview(data, measured=(t, np.ones((30, 3))))).axes
    assert first.get_title().startswith("measured (points)")
    assert texts(first) == ["s0", "s1", "w0 (validation)"]
    assert first.get_position().width > 1.6 * rest[0].get_position().width
    plain = drawn(plots.overview(data)).axes
    assert [ax.get_title() for ax in rest] == [ax.get_title() for ax in plain]
    (ax,) = drawn(plots.curves(dataset(sensors=9), t, np.zeros((30, 9)))).axes
    assert ax.get_title().endswith(", 7 of 9 sensors")


def test_curves_of_a_journal_that_has_lost_its_first_samples() -> None:
    data = dataset()
    t = data["time"].values[10:]
    (ax,) = drawn(plots.curves(data, t, np.zeros((len(t), 2)))).axes
    np.testing.assert_allclose(ax.lines[1].get_ydata(), -data["innovation"][10:, 0].values)


def test_sensors_of_another_unit_have_a_panel_of_their_own() -> None:
    data = dataset().assign_coords(sensor_unit=("sensor", ["degC", "W/m^2"]))
    t = data["time"].values
    axes = drawn(plots.curves(data, t, np.zeros((len(t), 2)))).axes
    assert [texts(ax) for ax in axes] == [["s0"], ["s1"]]
    assert [ax.get_ylabel() for ax in axes] == ["[°C]", "[W/m²]"]


def test_intervals_stand_below_each_other_and_unknown_ends_are_left_out():
    ax = plots.intervals({"case": (2.0, 1.0, 3.0), "loss": (2.5, np.nan, np.nan)}, "m^2/s")
    assert [text.get_text() for text in ax.get_yticklabels()] == ["case", "loss"]
    ends = [line.get_xdata() for line in ax.lines if len(line.get_xdata()) == 2]
    assert [1.0, 3.0] in [list(each) for each in ends]
    assert len([each for each in ends if list(each) != [2.0, 2.0] and each[0] < each[1]]) == 1
    assert ax.get_xlabel() == "95 % interval [m²/s]"
    assert ax.yaxis_inverted()  # the first is at the top
