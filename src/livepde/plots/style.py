"""Common style of figures (colours, axes, legends), and quantities from the dataset of a run."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from livepde.dates import instants, when
from livepde.errors import optional
from livepde.linalg import Array
from livepde.records import NOTE, scalars

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Largest number of lines in a panel. More sensors are drawn as one line with their range.
MOST_LINES = 7
# Time span from which a unit of the time axis is used, its length in seconds, its name.
CLOCKS = ((2 * 86400.0, 86400.0, "d"), (2 * 3600.0, 3600.0, "h"))
# Palette of Okabe and Ito (2008), distinguishable with all common kinds of colour blindness. Yellow
# is omitted, because it is invisible on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#7f7f7f"
# Largest number of points for which Matplotlib searches a free place for the legend.
MOST_POINTS = 20_000
# Width and height of a panel in inches.
PANEL = (5.4, 3.4)
DPI = 120


def prior_left(data: xr.Dataset, label: str, k: int = -1) -> float:
    """Return the posterior over prior standard deviation of a number at sample k.

    It is NaN if it is unknown, such as for laws without a covariance.
    """
    return float(data[f"{label}_left"].values[k]) if f"{label}_left" in data else math.nan


def modes_determined(data: xr.Dataset, name: str, k: int = -1) -> tuple[float, int, float]:
    """Return the number of a field's modes that data determine at snapshot k, of all, and `left`.

    `left` is the root mean square over all modes of the ratio s of posterior to prior standard
    deviation. Each mode contributes 1 - s^2 to the number of determined modes.
    """
    modes = data[f"{name}_modes"]
    count, determined = int(modes.attrs["of"]), float(modes.values[k])
    return determined, count, math.sqrt(max(1.0 - determined / count, 0.0)) if count else math.nan


def note(data: xr.Dataset, name: str) -> Array | None:
    """Return a note of the law over time, shape (samples,), or None if the run does not have it.

    A note with the name of another variable is stored under a different name, see `Layout.dataset`.
    """
    key = f"{NOTE}{name}" if f"{NOTE}{name}" in data else name
    about = (str(data.attrs.get(kind, "")) for kind in ("fields", "state"))
    unknown = {*scalars(data), *" ".join(about).split()}
    if key not in data or key in unknown or data[key].dims != ("time",):
        return None
    values: Array = data[key].values
    return values


def groups(data: xr.Dataset) -> dict[str, list[str]]:
    """Return a mapping from each unknown to the labels of its numbers: one, or one per region."""
    found: dict[str, list[str]] = {}
    for label in scalars(data):
        found.setdefault(label.partition("[")[0], []).append(label)
    return found


def unit_of(data: xr.Dataset, name: str) -> str:
    """Return the unit of a variable in the dataset."""
    return str(data[name].attrs.get("units", ""))


def shown_unit(unit: str) -> str:
    """Return a unit in the notation of figures; empty for 1."""
    for plain, pretty in (("degC", "°C"), ("**", "^"), ("^2", "²"), ("^3", "³")):
        unit = unit.replace(plain, pretty)
    return "" if unit == "1" else unit


def labelled(name: str, unit: str) -> str:
    """Return the label of an axis: a name with its unit."""
    shown = shown_unit(unit)
    return f"{name} [{shown}]" if shown else name


def axis_label(data: xr.Dataset, name: str, text: str = "") -> str:
    """Return the label of an axis for a variable: `text`, by default its name, with its unit."""
    return labelled(text or name, unit_of(data, name))


def time_scale(data: xr.Dataset) -> tuple[float, str]:
    """Return factor and unit of the time axis: days or hours for long runs in seconds."""
    unit = unit_of(data, "time")
    if unit in ("s", "second", "seconds") and data.sizes["time"]:
        span = float(data["time"][-1] - data["time"][0])
        for least, factor, name in CLOCKS:
            if span >= least:
                return factor, name
    return 1.0, unit


def time_values(data: xr.Dataset, times: ArrayLike) -> Array:
    """Return coordinates on a time axis: dates if the run has them, else scaled by `time_scale`."""
    dates = instants(data, times)
    if dates is None:
        scaled: Array = np.asarray(times, dtype=float) / time_scale(data)[0]
        return scaled
    values: Array = dates.tz_localize(None).to_numpy()
    return values


def time_text(data: xr.Dataset, t: float) -> str:
    """Return a time as text: a date, or a number with its unit."""
    if instants(data, []) is not None:
        return when(data, t)
    factor, unit = time_scale(data)
    return f"t = {t / factor:.4g} {unit}".rstrip()


def scored_from(data: xr.Dataset) -> int:
    """Return the index of the first assimilated sample; earlier ones are not scored."""
    start = data.attrs.get("assimilate_from")
    if start is None:
        return 0
    first = int(np.searchsorted(data["time"].values, float(start)))
    return first if first < data.sizes["time"] else 0


def sensor_names(data: xr.Dataset) -> list[str]:
    """Return the names of the assimilated sensors, followed by the validation sensors."""
    return [str(name) for of in ("sensor", "validation") if of in data for name in data[of].values]


def sensor_units(data: xr.Dataset) -> dict[str, str]:
    """Return the unit of each sensor."""
    units = dict.fromkeys(sensor_names(data), unit_of(data, "innovation"))
    for dimension in ("sensor", "validation"):
        if f"{dimension}_unit" in data.coords:
            own = data[f"{dimension}_unit"].values
            units |= dict(zip(map(str, data[dimension].values), map(str, own), strict=True))
    return units


def sensors_by_unit(data: xr.Dataset) -> dict[str, list[str]]:
    """Return a mapping from each unit to the names of its sensors."""
    found: dict[str, list[str]] = {}
    for name, unit in sensor_units(data).items():
        found.setdefault(unit, []).append(name)
    return found


class SensorPlaces(NamedTuple):
    """Names and coordinates of sensors on a plane domain."""

    names: list[str]
    x: Array
    y: Array


def sensor_places(data: xr.Dataset) -> dict[str, SensorPlaces]:
    """Return the places of sensors on a plane domain, under "sensor" and "validation"."""
    return {
        kind: SensorPlaces(
            [str(name) for name in data[kind].values],
            data[f"{kind}_x"].values,
            data[f"{kind}_y"].values,
        )
        for kind in ("sensor", "validation")
        if f"{kind}_y" in data.coords
    }


def figure_class() -> type[Figure]:
    """Return Matplotlib's figure class; raise `ConfigurationError` without Matplotlib."""
    with optional("plots", "Figures need Matplotlib, which is not installed"):
        from matplotlib.figure import Figure
    return Figure


def figure(rows: int = 1, columns: int = 1, title: str = "") -> tuple[Figure, list[Axes]]:
    """Return an empty figure and its panels, row by row.

    Raises `ConfigurationError`: Matplotlib is not installed.
    """
    drawn = empty(rows, columns, title)
    return drawn, list(drawn.subplots(rows, columns, squeeze=False).ravel())


def empty(rows: int, columns: int, title: str) -> Figure:
    """Return an empty figure with space for rows and columns of panels."""
    size = (PANEL[0] * columns, PANEL[1] * rows)
    drawn = figure_class()(figsize=size, layout="constrained")
    if title:
        drawn.suptitle(title)
    return drawn


def png(drawn: Figure) -> bytes:
    """Return a figure as PNG image; `Figure.savefig` would draw it twice, once for its layout."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    image = io.BytesIO()
    drawn.set_dpi(DPI)
    canvas: Any = FigureCanvasAgg(drawn)  # has no types
    canvas.print_png(image)
    return image.getvalue()


def panel(ax: Axes | None) -> Axes:
    """Return the given axes, or the axes of a new figure."""
    return figure()[1][0] if ax is None else ax


def time_axis(ax: Axes, data: xr.Dataset) -> None:
    """Label the time axis of a panel whose times are those of `time_values`."""
    dated = instants(data, []) is not None
    ax.set_xlabel("" if dated else labelled("t", time_scale(data)[1]))
    if dated:
        import matplotlib.dates

        dates: Any = matplotlib.dates  # has no types
        # With the default of at least 5 ticks, no interval suits 3 to 5 days, hours or minutes.
        locator = dates.AutoDateLocator(minticks=3, maxticks=7)
        ax.xaxis.set_major_locator(locator)
        ax.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))


def finish(ax: Axes, *, legend: bool = True, outside: bool = False) -> Axes:
    """Add grid and legend to a finished panel."""
    ax.grid(True, alpha=0.3, linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    if legend and ax.get_legend_handles_labels()[0]:
        if outside:
            ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False)
        else:
            # loc="best" tests every point, which is too slow for long runs.
            points = sum(np.size(line.get_xdata()) for line in ax.lines)
            place: Any = "best" if points <= MOST_POINTS else "upper right"
            ax.legend(loc=place, fontsize="small", framealpha=0.85, edgecolor="none")
    return ax


def shades_of(count: int) -> list[Any]:
    """Return colours for a sequence in time: viridis without its yellow end."""
    import matplotlib as mpl

    shades: list[Any] = list(mpl.colormaps["viridis"](np.linspace(0.0, 0.88, max(count, 2))))
    return shades[:count]
