"""Reading of the data of `Identifier.run`: a table, a dataset, or a file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from livepde.errors import ConfigurationError, SampleError
from livepde.samples import is_dataset, is_frame, noise_channel
from livepde.streams import table as tables
from livepde.streams.clock import CALLED_TIME, Clock
from livepde.streams.csvfile import how_written, read_csv
from livepde.units import Affine, conversion, other_time_unit

INDEX = "__index_level_0__"  # name by pandas of an unnamed index in a Parquet file
TEMPERATURE = re.compile(r"T\b")  # not a time; `CALLED_TIME` ignores case


def _is_time(name: str) -> bool:
    """Return whether the name of a column indicates times."""
    return bool(CALLED_TIME.match(name)) and not TEMPERATURE.match(name)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Reader of the channels of an identifier from tabular data."""

    channels: Sequence[str]  # channels that need a column
    optional: Sequence[str]  # channels that are read if they have a column: noise, places
    unit: str  # the model's unit of time; empty if it has none
    channel_units: Mapping[str, str]  # sensor or input -> its unit in the model
    # The column of times. Default: the index of a table, the coordinate of a dataset, else the only
    # column with a name such as time, t or date.
    time: str | None = None
    time_unit: str | None = None  # unit of numeric times; None: the model's unit
    columns: Mapping[str, str] = field(default_factory=dict)  # channel -> column if names differ
    units: Mapping[str, str] = field(default_factory=dict)  # channel -> unit of its column
    strict: bool = False  # whether other columns are an error; else they are ignored

    def table(self, data: Any) -> tables.DataTable:
        """Return the samples of the data.

        Raises `DataError`: a column is missing, unknown or contains text; times do not increase; or
        a file cannot be read.
        Raises `ConfigurationError`: options do not fit the identifier, or times are dates and the
        model has no unit of time.
        """
        self._check()
        if is_dataset(data):
            table = self._dataset(data)
        elif is_frame(data):
            table = self._frame(data)
        else:
            table = self._file(Path(data))
        if table.origin is not None:
            self._need_unit("the times are dates")
        return table

    def _check(self) -> None:
        """Refuse options for unknown channels, and units for a model without units."""
        known = [*self.channels, *self.optional]
        for option, given in (("columns", self.columns), ("units", self.units)):
            for name in given:
                if name not in known:
                    raise ConfigurationError(
                        f"{option}: there is no channel '{name}'{tables.hint(name, known)}"
                    )
        for name in self.units:
            if not self.channel_units.get(name):
                raise ConfigurationError(
                    f"units: the model has no unit for '{name}': name it where sensors, state or "
                    'inputs are defined, as in Points(..., unit="degC") or inputs={"Q": "W"}.'
                )
        if self.time_unit is not None:
            self._need_unit("time_unit is given")

    def _need_unit(self, why: str) -> None:
        if not self.unit:
            raise ConfigurationError(
                f"{why}, and the model has no unit of time: name it, as in "
                'Model(..., time_unit="s").'
            )

    def _clock(self, time: str, unit: str | None, **written: Any) -> Clock:
        """Return the clock that converts times; `unit`: unit of numeric times, if it is known."""
        if not self.unit:
            return Clock(time, **written)
        factor, second = (
            conversion(given, self.unit, "time_unit").factor for given in (unit or self.unit, "s")
        )
        doubt = "" if unit else other_time_unit(time, self.unit)
        return Clock(time, factor, second=second, doubt=doubt, **written)

    @cached_property
    def _names(self) -> dict[str, str]:
        """Channel -> its column, which may be absent for an optional channel."""
        return {name: self.columns.get(name, name) for name in (*self.channels, *self.optional)}

    def _columns(
        self,
        where: str,
        time: str,
        names: Sequence[str],
        units: Mapping[str, str],
        decimal: str = ".",
    ) -> dict[str, tables.Column]:
        """Return the column of each channel; a missing one is refused unless it is optional.

        `names`: columns of the data.
        `units`: column -> its unit, if the data contain units.
        """
        noise_of = dict(zip(map(noise_channel, self.channels), self.channels, strict=True))
        found: dict[str, tables.Column] = {}
        for name, column in self._names.items():
            if column not in names:
                if name in self.optional and name not in self.columns:
                    continue
                raise self._missing(where, name, column, names)
            of = noise_of.get(name, "")  # channel whose noise this column contains
            unit = self.units.get(name, units.get(column, ""))
            rule = self._rule(name, unit, self.channel_units.get(of or name))
            scale = rule.factor, rule.offset
            if of:  # the default unit of noise is the unit of the readings
                scale = rule.factor if unit else found[of].factor, 0.0
            found[name] = tables.Column((column,), *scale, decimal=decimal, noise_of=of)
        if self.strict:
            self._refuse_more(where, names, {time, *(one.names[0] for one in found.values())})
        return found

    @staticmethod
    def _rule(name: str, unit: str, own: str | None) -> Affine:
        """Return the conversion from a unit, by default the model's unit, to the model's unit."""
        return conversion(unit or own, own, f"units of '{name}'") if own else Affine()

    def _refuse_more(self, where: str, names: Sequence[str], used: set[str]) -> None:
        """Refuse a column that is not used."""
        for name in (name for name in names if name not in used):
            raise SampleError(
                f"{where}: column '{name}' is not a channel of this identifier, which has "
                f"{list(self.channels)}: remove it, or leave out strict."
            )

    def _missing(self, where: str, name: str, column: str, names: Sequence[str]) -> SampleError:
        """Return the error for a channel without a column."""
        hint = tables.hint(column, list(names))
        return SampleError(
            f"{where}: there is no column '{column}'{hint} If it has another name, give "
            f"columns={{'{name}': ...}}."
        )

    def _time(self, where: str, names: Sequence[str]) -> str:
        """Return the name of the column of times."""
        if self.time is not None:
            tables.check_columns(where, [self.time], list(names))
            return self.time
        free = [name for name in names if name not in self._names.values()]
        called = list(filter(_is_time, free))
        if len(called) == 1:
            return called[0]
        if not called and (INDEX in free or names[:1] == [""]):  # index written by pandas
            return INDEX if INDEX in free else ""
        what = "no column is called time"
        if called:
            what = f"{' and '.join(map(repr, called))} may be the column of times"
        time = [*called, *free, "t"][0]
        raise SampleError(f"{where}: {what}; specify it, as in time={time!r}.")

    def _frame(self, data: Any) -> tables.DataTable:
        """Return the samples of a pandas table."""
        names = [str(name) for name in data.columns]
        if twice := [name for name in names if names.count(name) > 1]:
            raise SampleError(f"data: two columns are called '{twice[0]}'; rename one.")
        series = {name: data.iloc[:, k] for k, name in enumerate(names)}
        if self._uses_index(data.index, names):
            return self._tabulated(str(data.index.name or "index"), data.index, series, {})
        time = self._time("data", names)
        return self._tabulated(time, series[time], series, {})

    def _uses_index(self, index: Any, names: Sequence[str]) -> bool:
        """Return whether the index of a pandas table contains times, not only row numbers."""
        if self.time is not None:
            return False
        counts = hasattr(index, "step") and index.name is None  # a RangeIndex
        if not counts:
            return True
        if any(map(_is_time, names)):
            return False
        if self.time_unit is None:
            raise SampleError(
                "data: the index only counts the rows, and no column is called time: set the "
                "times as index, name their column with time=, or give time_unit if one row is "
                "one unit of time."
            )
        return True

    def _dataset(self, data: Any) -> tables.DataTable:
        """Return the samples of an xarray dataset, whose variables may have units."""
        dims = set(data[list(data.data_vars.keys() & self._names.values())].dims)
        if len(dims) > 1:
            raise SampleError(
                f"data: the channels have the dimensions {sorted(map(str, dims))}; expected one, "
                "that of time: select along the others first."
            )
        names = [name for name in data.data_vars if set(data[name].dims) == dims]
        series = {str(name): data[name].to_series() for name in names}
        units = {str(name): str(data[name].attrs.get("units", "")) for name in names}
        if not dims:
            self._columns("data", "", list(map(str, data.data_vars)), {})  # raises an error
        time = self.time or str(*dims)
        if time not in data.coords:
            raise SampleError(f"data: there is no coordinate '{time}' with the times: assign it.")
        units[time] = str(data[time].attrs.get("units", ""))
        return self._tabulated(time, data[time].to_series(), series, units)

    def _tabulated(
        self, time: str, times: Any, series: Mapping[str, Any], units: Mapping[str, str]
    ) -> tables.DataTable:
        """Return the samples in the columns of a pandas table."""
        unit = self.time_unit or units.get(time)
        if times.dtype.kind == "m":
            self._need_unit("the times are durations")
            times, unit = np.asarray(times) / np.timedelta64(1, "s"), "s"
        columns = self._columns("data", time, list(series), units)
        return tables.tabulated(times, series, columns, self._clock(time, unit), where="data")

    def _file(self, path: Path) -> tables.DataTable:
        """Return the samples of a file; its suffix determines the format."""
        where = str(path)
        if path.suffix in (*tables.JSON_LINES, ".parquet"):
            if path.suffix == ".parquet":
                read = tables.read_parquet
                with tables.parquet_file(path) as file:
                    names = list(file.schema_arrow.names)
            else:
                read, names = tables.read_json_lines, _first_keys(path)
            time = self._time(where, names)
            columns = self._columns(where, time, names, {})
            return read(path, columns, self._clock(time, self.time_unit))
        written = how_written(path)
        time = self._time(where, written.header)
        if len(written.time_formats) > 1:
            raise SampleError(
                f"{where}: the order of day, month and year in '{time}' is ambiguous: read the "
                "table with pandas.read_csv and a date_format, and give the table."
            )
        columns = self._columns(where, time, written.header, {}, written.decimal)
        clock = self._clock(
            time, self.time_unit, format=written.time_format, decimal=written.decimal
        )
        return read_csv(
            path,
            columns,
            clock,
            separator=written.separator,
            encoding=written.encoding,
            skip=written.skip,
        )


def _first_keys(path: Path) -> list[str]:
    """Return the keys of the first line in a file of JSON lines."""
    try:
        with path.open(encoding="utf-8") as file:
            first = json.loads(next((line for line in file if line.strip()), "{}"))
    except FileNotFoundError:
        raise tables.no_file(path) from None
    except (OSError, ValueError) as error:
        raise SampleError(f"{path}, line 1: is not JSON ({error}).") from error
    return list(first) if isinstance(first, dict) else []
