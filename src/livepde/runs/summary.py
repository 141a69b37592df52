"""Summary of a run: estimates, thermal resistance of a wall, errors of each channel, checks."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from livepde.dates import when
from livepde.diagnostics.check_report import Bound, Check, Sense, Table
from livepde.diagnostics.information_gain import TRADED, InformationGain
from livepde.frames import ERRORS, estimates, model_errors, relative_error
from livepde.linalg import Array
from livepde.plots.style import modes_determined, note, prior_left
from livepde.records import NORMAL_95, field_names, refused_readings, scalars, used_errors
from livepde.runs.journal import Journal
from livepde.showing import in_percent

if TYPE_CHECKING:
    import xarray as xr

# Attributes of a dataset: the layers as JSON, label of a conductivity -> thickness in m, and the
# sum of the surface resistances in m^2 K/W, which is optional.
LAYERS, SURFACES = "wall_layers", "surface_resistance"
MOST_ROWS = 40
DIGITS = 15  # largest number of digits shown
FINEST = 1000.0  # width of an interval over the finest resolution of its ends
MOST = 10.0  # relative error from which on a dash is shown
TOTALS = ("rmse", "innovation_ratio", "jumps", "failed_steps")  # numbers of a run as a whole
ROLES = ("assimilated", "validation")  # roles of channels that have totals
IGNORED = "ignored"  # role of channels that are shown but not included in totals
MOVED = 3.0  # standard deviations by which an unknown has moved after an alarm
JUMP = "jump"  # name of the law's note on alarms
STATES = {
    "pinned": "well determined",
    "partly": "partly determined",
    "flat": "not identifiable",
    "at its bound": "at its bound",
    "moves": "changes with time",
}
"""How well the data determine a number: value of `determination` -> words."""


@dataclass(frozen=True)
class Resistance:
    """Thermal resistance of a wall, R = sum of thickness/k, without surface resistances."""

    R: float  # value in m^2 K/W
    relative: float  # standard deviation of ln R, to first order in the errors of ln k
    surfaces: float | None = None  # sum of the surface resistances in m^2 K/W; None: not stated
    # R with each conductivity at the upper or lower end of its interval with model errors; NaN if
    # model errors are not known.
    low: float = math.nan
    high: float = math.nan

    @property
    def U(self) -> float:
        """Thermal transmittance 1/(R + surface resistances) in W/(m^2 K)."""
        return 1.0 / (self.R + (self.surfaces or 0.0))

    @property
    def relative_U(self) -> float:
        """Standard deviation of ln U."""
        return self.relative * self.R * self.U


def resistance(data: xr.Dataset) -> Resistance | None:
    """Return the final resistance of the wall of a run, or None if it has no wall."""
    layers: Mapping[str, float] = json.loads(data.attrs.get(LAYERS, "{}"))
    if not layers or not data.sizes["time"]:
        return None
    k = np.array([float(data[label][-1]) for label in layers])
    relative = np.array([float(data[f"{label}_std"][-1]) for label in layers]) / k
    parts = np.array([*layers.values()]) / k
    R = float(parts.sum())
    # d ln R / d ln k_i = -R_i / R.
    slopes = relative * parts / R
    variance = float(slopes @ _correlation(data, list(layers)) @ slopes)
    surfaces = data.attrs.get(SURFACES)
    errors = model_errors(data)
    each = {one.label: (one.high, one.low) for one in (errors.unknowns if errors else ())}
    ends = np.array([each.get(label, (math.nan, math.nan)) for label in layers])
    # A conductivity is positive, so that a lower end up to zero counts as unknown.
    low, high = np.array([*layers.values()]) / np.where(ends > 0.0, ends, math.nan).T
    return Resistance(
        R,
        variance**0.5,
        None if surfaces is None else float(surfaces),
        low=float(low.sum()),
        high=float(high.sum()),
    )


def _correlation(data: xr.Dataset, labels: Sequence[str]) -> Array:
    """Return the final correlation matrix of unknowns; the identity if it is not known."""
    if len(labels) == 1 or "correlation" not in data:
        return np.eye(len(labels))
    names = [str(name) for name in data["unknown"].values]
    rows = [names.index(label) for label in labels]
    return np.asarray(data["correlation"].values[np.ix_(rows, rows)])


def digits(value: float, std: float) -> tuple[str, str]:
    """Return value and standard deviation as text, to the second digit of the deviation.

    >>> digits(2.7344, 0.0261)
    ('2.734', '0.026')
    >>> digits(4.97e-07, 2.07e-08)
    ('4.97e-07', '0.21e-07')
    >>> digits(0.5, float("nan"))
    ('0.5', '–')
    """
    if not (math.isfinite(std) and std > 0 and math.isfinite(value)):
        return f"{value:.5g}", "–"
    power = 0
    if value and not 1e-3 <= abs(value) < 1e5:
        power = math.floor(math.log10(abs(value)))
    scale = 10.0**power
    # The first digit of std has the weight 10^floor(log10 std). One more digit is shown.
    places = max(0, 1 + power - math.floor(math.log10(std)))
    if places > DIGITS or std / scale > 10.0**DIGITS:  # no common digits
        return f"{value:.5g}", f"{std:.2g}"
    exponent = f"e{power:+03d}" if power else ""
    return f"{value / scale:.{places}f}{exponent}", f"{std / scale:.{places}f}{exponent}"


def shown(value: float, form: str = ".3g", unit: str = "") -> str:
    """Return a number with its unit as text, or a dash if it is not finite.

    >>> shown(2.5, ".2g", " %"), shown(float("nan"), ".2g", " %")
    ('2.5 %', '–')
    """
    return format(value, form) + unit if math.isfinite(value) else "–"


class ChannelErrors(NamedTuple):
    """Role of a channel, its errors in all samples and in the second half of the samples.

    Readings that the gate refused are excluded, and `refused` is their number.
    """

    role: str
    errors: np.ndarray[Any, Any]
    later: np.ndarray[Any, Any]
    refused: int = 0


def channel_errors(data: xr.Dataset) -> dict[str, ChannelErrors]:
    """Return the errors of each channel since the start of the assimilation."""
    start = float(data.attrs.get("assimilate_from", -math.inf))
    kept = data["time"].values >= start
    found, refused = {}, refused_readings(data)
    ignored = str(data.attrs.get("ignored", "")).split("\n")
    for (variable, dimension), role in zip(ERRORS, ROLES, strict=True):
        if variable not in data:
            continue
        columns = used_errors(data, variable, dimension)[kept].T
        for name, errors in zip(map(str, data[dimension].values), columns, strict=True):
            whole, later = (e[np.isfinite(e)] for e in (errors, errors[len(errors) // 2 :]))
            count = int(refused[name][kept].sum()) if name in refused else 0
            as_role = IGNORED if name in ignored else role
            found[name] = ChannelErrors(as_role, whole, later, count)
    return found


def _grouped(channels: Mapping[str, ChannelErrors]) -> dict[str, ChannelErrors]:
    """Return the errors by channel, or by role if there are too many channels for a table."""
    if len(channels) <= MOST_ROWS:
        return dict(channels)
    found = {}
    for role in dict.fromkeys(item.role for item in channels.values()):
        names = [name for name, item in channels.items() if item.role == role]
        _, errors, later, refused = zip(*(channels[name] for name in names), strict=True)
        both = np.concatenate(errors), np.concatenate(later)
        found[f"{names[0]} ... {names[-1]}"] = ChannelErrors(role, *both, sum(refused))
    return found


def rmse(errors: np.ndarray[Any, Any]) -> float:
    """Return the root mean square, or NaN without errors."""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan


@dataclass(frozen=True)
class Jump:
    """An alarm of `Jumps`.

    Attributes
    ----------
    t
        Time of the sample that raised the alarm.
    moved
        Unknowns that have moved by more than three standard deviations between this alarm and the
        next one or the end: label -> (value before, value after, standard deviation after).
    """

    t: float
    moved: Mapping[str, tuple[float, float, float]]


def jumps(data: xr.Dataset) -> list[Jump]:
    """Return the alarms of a run in time order; empty if the law does not test for jumps."""
    alarms = note(data, JUMP)
    if alarms is None:
        return []
    at = np.flatnonzero(alarms > 0.0)
    ends = np.append(at, data.sizes["time"])[1:] - 1
    found = []
    for k, end in zip(at, ends, strict=True):
        moved = {}
        for label in scalars(data):
            values, std = data[label].values, data[f"{label}_std"].values
            # From the sample before the alarm to the last one before the next alarm.
            before = max(int(k) - 1, 0)
            spread = math.hypot(float(std[before]), float(std[end]))
            if abs(values[end] - values[before]) > MOVED * spread:
                moved[label] = float(values[before]), float(values[end]), float(std[end])
        found.append(Jump(float(data["time"].values[k]), moved))
    return found


def interval(low: float, high: float, std: float) -> str:
    """Return an interval as text, or a dash if its ends or standard deviation are not finite."""
    if not math.isfinite(std + high - low):
        return "–"
    size = max(std, (high - low) / FINEST)
    return f"{digits(low, size)[0]} to {digits(high, size)[0]}"


def measures(data: xr.Dataset) -> dict[str, float]:
    """Return the numbers of a run for which a case may state expected bounds, by name.

    `LABEL`, `LABEL.std`: value and standard deviation of a scalar unknown. With a reference, also
    `LABEL.error`, the relative error, and `LABEL.deviations`, the error in standard deviations.
    `rmse`, `rmse.assimilated`, `rmse.validation`, `rmse.CHANNEL`: one-step errors of all sensors
    including validation sensors, of each role, and of each channel. `innovation_ratio`: final ratio
    of squared innovations to their expected square. `jumps`: number of alarms. `failed_steps`.
    """
    found: dict[str, float] = {}
    for label in scalars(data) if data.sizes["time"] else ():
        value, std = float(data[label][-1]), float(data[f"{label}_std"][-1])
        found |= {label: value, f"{label}.std": std}
        if "reference" in data[label].attrs:
            distance = abs(value - float(data[label].attrs["reference"]))
            found[f"{label}.error"] = relative_error(data, label)
            found[f"{label}.deviations"] = distance / std if std else math.inf
    found |= _channel_measures(data)
    ratios = note(data, "innovation_ratio")
    if ratios is not None and len(ratios):
        found["innovation_ratio"] = float(ratios[-1])
    if note(data, JUMP) is not None:
        found["jumps"] = float(len(jumps(data)))
    found["failed_steps"] = float((data["status"].values != 0).sum())
    return found


def _channel_measures(data: xr.Dataset) -> dict[str, float]:
    """Return root mean square one-step errors: of all channels, each role and each channel."""
    channels = channel_errors(data)
    pools = {"rmse": ROLES} | {f"rmse.{role}": (role,) for role in ROLES}
    found = {}
    for name, roles in pools.items():
        parts = [item.errors for item in channels.values() if item.role in roles]
        if parts or name == "rmse":
            found[name] = rmse(np.concatenate(parts or [np.empty(0)]))
    return found | {f"rmse.{name}": rmse(item.errors) for name, item in channels.items()}


def checks_of(expected: Mapping[str, tuple[Sense, Bound]], data: xr.Dataset) -> list[Check]:
    """Return a check for each expected number; the check of a missing number fails."""
    found = measures(data)
    return [
        Check(name, found.get(name, math.nan), bound, sense)
        for name, (sense, bound) in expected.items()
    ]


def tables(data: xr.Dataset) -> list[Table]:
    """Return the tables of a run.

    The tables are: estimates with references, resistance of a wall, estimated fields, errors of
    each channel, identifiability, and jumps. Errors over all samples include the initial transient
    of learning; errors over the second half can be compared with the noise.
    """
    labels = scalars(data) if data.sizes["time"] else []
    channels = _channels(data)
    found = [
        _estimates(data, labels),
        _wall(data),
        _fields(data),
        channels,
        _told(data, labels),
        _jumped(data),
    ]
    return [table for table in found if table.rows or table is channels]


def _estimates(data: xr.Dataset, labels: Sequence[str]) -> Table:
    """Return the table of the final estimates, with their references if there are any."""
    errors, known = model_errors(data), estimates(data)
    differ = errors is not None and errors.differ
    rows: list[tuple[Any, ...]] = []
    for label, row in known.iterrows():
        value, deviation = digits(row["value"], row["std"])
        plain = interval(row["low"], row["high"], row["std"])
        allowed = interval(row["model_low"], row["model_high"], row["std"])
        # The wider interval comes first. The plain interval makes the standard deviation redundant.
        # A relative error is not shown if the interval contains zero.
        zero = row["model_low"] <= 0.0 <= row["model_high"]
        off = in_percent(row["effect"]) if not zero and row["effect"] < MOST else "–"
        wide = (allowed, off) if differ else (deviation,)
        rows.append((label, value, *wide, plain, row["unit"]))
        if "reference" in row:
            error = shown(100 * row["error"], ".2g", " %")
            rows[-1] += (shown(row["reference"], ".5g"), error)
    beside = ("with model errors", "error up to") if differ else ("± std. dev.",)
    columns = ("unknown", "value", *beside, "95 %", "unit")
    title = f"Estimates{_first_order(data, labels)}"
    if "reference" not in known:
        return Table(title, columns, rows)
    source = str(data.attrs.get("reference_source", ""))
    title = f"{title}; reference: {source}" if source else title
    return Table(title, (*columns, "reference", "error"), rows)


def _wall(data: xr.Dataset) -> Table:
    """Return the table of R and U of a wall with 95 % intervals; empty if there is no wall."""
    found, rows = resistance(data), list[tuple[Any, ...]]()
    errors = model_errors(data)
    differ = errors is not None and errors.differ
    if found is not None:
        surfaces, more = "without surface resistances", found.surfaces or 0.0
        if found.surfaces is not None:
            surfaces = f"with {found.surfaces:g} m^2 K/W of surface resistances"
        R, U = (found.low, found.high), tuple(1.0 / (end + more) for end in (found.high, found.low))
        for name, value, relative, (least, most), unit in (
            ("R, without surface resistances", found.R, found.relative, R, "m^2 K/W"),
            (f"U, {surfaces}", found.U, found.relative_U, U, "W/(m^2 K)"),
        ):
            std = value * relative
            low, high = (value * math.exp(sign * NORMAL_95 * relative) for sign in (-1.0, 1.0))
            number, deviation = digits(value, std)
            wide = interval(least, most, std) if differ else deviation
            rows.append((name, number, wide, interval(low, high, std), unit))
    beside = "with model errors" if differ else "± std. dev."
    columns = ("quantity", "value", beside, "95 %", "unit")
    return Table("Wall: R = sum of thickness/k, U = 1/(R + surfaces)", columns, rows)


def _first_order(data: xr.Dataset, names: Sequence[str]) -> str:
    """Return the part of a title that lists the values that are medians, or an empty string."""
    found = [name for name in names if "comment" in data[name].attrs]
    if not found:
        return ""
    whose = "" if len(found) == len(names) else f"{', '.join(found)}: "
    return f" ({whose}median, std. dev. to first order)"


def _fields(data: xr.Dataset) -> Table:
    """Return the table of the final snapshots of the unknown fields."""
    rows: list[tuple[Any, ...]] = []
    names = [name for name in field_names(data) if name in data]
    for name in names:
        last = data[name].values[-1]
        known = f"{name}_std" in data
        std = float(np.mean(data[f"{name}_std"].values[-1])) if known else math.nan
        numbers = [f"{number:.4g}" for number in (last.min(), last.mean(), last.max())]
        share = float(data[f"{name}_left_out"][-1]) if f"{name}_left_out" in data else math.nan
        left_out, unit = shown(100 * share, ".2g", " %"), data[name].attrs.get("units", "")
        rows.append((name, *numbers, shown(std, ".2g"), left_out, unit))
    columns = ("field", "least", "mean", "largest", "mean std. dev.", "left-out modes", "unit")
    return Table(f"Estimated fields{_first_order(data, names)}", columns, rows)


def _channels(data: xr.Dataset) -> Table:
    """Return the table of one-step errors of each channel and its number of refused readings."""
    channels = _grouped(channel_errors(data))
    refuses = any(item.refused for item in channels.values())
    errors = model_errors(data)
    fits = {} if errors is None else errors.sensors
    fitted, units = not fits.keys().isdisjoint(channels), _channel_units(data)
    rows = [
        (
            name,
            role,
            f"{rmse(own):.4g}",
            shown(rmse(later), ".4g"),
            shown(float(own.mean()) if len(own) else math.nan, "+.3g"),
            len(own),
            *([refused] if refuses else []),
            *([shown(fits.get(name, math.nan), ".2g")] if fitted else []),
            units[name],
        )
        for name, (role, own, later, refused) in channels.items()
    ]
    more = ["refused"] if refuses else []
    more += ["/ noise"] if fitted else []
    columns = ("channel", "role", "RMSE", "2nd half", "mean", "samples", *more, "unit")
    return Table("Measured minus predicted, one step ahead", columns, rows)


def _channel_units(data: xr.Dataset) -> defaultdict[str, str]:
    """Return the unit of each channel; default: the unit of the innovations."""
    common = str(data["innovation"].attrs.get("units", "")) if "innovation" in data else ""
    found: defaultdict[str, str] = defaultdict(lambda: common)
    for _, dimension in ERRORS:
        if f"{dimension}_unit" in data.coords:
            units = data[f"{dimension}_unit"].values
            found.update(zip(map(str, data[dimension].values), map(str, units), strict=True))
    return found


def _told(data: xr.Dataset, labels: Sequence[str]) -> Table:
    """Return the table of posterior over prior standard deviations of all unknowns."""
    rows: list[tuple[Any, ...]] = []
    for label in labels:
        left = prior_left(data, label)
        if not math.isfinite(left):
            continue
        state = determination(data[label].attrs, float(data[label][-1]), left)
        others, words = _traded(data, label), STATES[state]
        if others and state != "pinned":
            words += f", correlated with {', '.join(others)}"
        rows.append((label, in_percent(left), words))
    for name in field_names(data):
        if f"{name}_modes" in data:
            known, count, left = modes_determined(data, name)
            rows.append((name, in_percent(left), f"{known:.1f} of {count} modes determined"))
    return Table("Identifiability", ("unknown", "std. dev. / prior", "state"), rows)


def determination(attrs: Mapping[Any, Any], value: float, left: float) -> str:
    """Return how well the data determine a number: a verdict of `InformationGain`, or "moves".

    `attrs`: attributes of the number in the dataset.
    `value`, `left`: its value, and its posterior over prior standard deviation.
    """
    # Laws clip to the bounds, so a number at its bound has exactly the value of the bound.
    bounds = [attrs[end] for end in ("lower_bound", "upper_bound") if attrs.get(end) == value]
    moves = "prior_std" not in attrs  # a number with an evolution has no fixed prior
    known = InformationGain("", left, bound=bounds[0] if bounds else math.nan, moves=moves)
    return "moves" if moves and known.verdict == "partly" else known.verdict


def _traded(data: xr.Dataset, label: str) -> list[str]:
    """Return the unknowns that the data determine only in combination with this unknown."""
    if "correlation" not in data or data["correlation"].dims != ("unknown", "other"):
        return []
    names = [str(name) for name in data["unknown"].values]
    row = data["correlation"].values[names.index(label)]
    return [name for name, r in zip(names, row, strict=True) if name != label and abs(r) > TRADED]


def _jumped(data: xr.Dataset) -> Table:
    rows: list[tuple[Any, ...]] = []
    for jump in jumps(data):
        at = when(data, jump.t)
        rows += [
            (at, label, digits(before, std)[0], " ± ".join(digits(after, std)))
            for label, (before, after, std) in jump.moved.items()
        ] or [(at, "–", "–", "–")]
    return Table("Jumps", ("time", "unknown", "before", "after"), rows)


def arrivals(journal: Journal) -> list[Table]:
    """Return the table of refused, missing and unordered rows and values, if there are any."""
    rows = [(kind, channel or "(row)", n) for (kind, channel), n in journal.counts.items()]
    if not rows:
        return []
    return [Table("Irregular rows and values", ("event", "channel", "number"), rows)]
