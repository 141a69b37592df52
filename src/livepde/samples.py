"""Samples of a stream, and their parsing: validation of names and values, held inputs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, repeat
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError, MissingInputError, SampleError
from livepde.fem import Inputs
from livepde.linalg import Array
from livepde.observation import Observed
from livepde.stepping import own_noise

Readings: TypeAlias = ArrayLike | Mapping[str, Any]


@dataclass(frozen=True)
class Sample:
    """Readings and inputs at one time of a stream.

    Attributes
    ----------
    t
        Time, in the unit of the model.
    z
        Measurements: an array of shape (sensors,), or channel name -> value for all values measured
        at t (sensors, inputs, validation channels). NaN or absent: missing. To specify the noise of
        a reading, use a pair (value, standard deviation), an array of shape (sensors, 2), or a key
        such as "noise of T_1" in the mapping; the default, also for NaN, is the sensor's noise.
    inputs
        Input and boundary channels that z does not contain.

    Examples
    --------
    >>> import livepde as lp
    >>> lp.Sample(60.0, {"T_10": 20.5, "T_left": 31.0}).t
    60.0
    """

    t: float
    z: Readings
    inputs: Mapping[str, float] | None = None


def sample_of(item: Any) -> Sample:
    """Convert an item of a stream, a `Sample`, (t, z) or (t, z, inputs), to a sample."""
    if isinstance(item, Sample):
        return item
    if isinstance(item, tuple | list) and len(item) in (2, 3):
        *_, last = item
        if len(item) == 2 or last is None or isinstance(last, Mapping):
            return Sample(t=item[0], z=item[1], inputs=last if len(item) == 3 else None)
    raise SampleError(
        f"a stream gives (t, z), (t, z, inputs) or livepde.Sample; got {item!r:.60}. Give a pandas "
        "table as a whole, as in run(table)."
    )


def in_order(stream: Iterable[Any], who: str) -> Iterator[Sample]:
    """Iterate over samples with increasing times; `who` names the caller in messages."""
    last_time = -math.inf
    for item in stream:
        sample = sample_of(item)
        if not sample.t > last_time:
            raise SampleError(
                f"{who}: the sample at t = {sample.t!r} is not later than the one before at "
                f"t = {last_time!r}; sort the stream and drop repeated samples."
            )
        last_time = sample.t
        yield sample


def is_frame(data: Any) -> bool:
    """Return whether data are a pandas table."""
    return all(hasattr(data, name) for name in ("columns", "index", "iterrows"))


def is_dataset(data: Any) -> bool:
    """Return whether data are an xarray dataset."""
    return hasattr(data, "data_vars")


def is_tabular(data: Any) -> bool:
    """Return whether data are a table, a dataset or a file name, rather than a stream of samples.

    >>> is_tabular("rod.csv"), is_tabular([(0.0, 20.0)])
    (True, False)
    """
    return isinstance(data, str | os.PathLike) or is_frame(data) or is_dataset(data)


def noise_channel(name: str) -> str:
    """Return the name under which a sample contains the noise of a reading.

    >>> noise_channel("T_1")
    'noise of T_1'
    """
    return f"noise of {name}"


def check_noise(name: str, value: Any) -> float:
    """Return the validated noise of a reading; NaN selects the noise of its sensor."""
    std = number(value, noise_channel(name))
    if std <= 0.0:
        raise SampleError(
            f"{noise_channel(name)}: got {std:g}; a standard deviation must be positive (NaN: "
            "that of the sensor)."
        )
    return std


def by_name(z: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return readings as channel -> number, with noise under a separate name.

    `names`: sensors in the order of an array.
    """
    if not isinstance(z, Mapping):
        z = dict(zip(names, np.atleast_1d(z).tolist(), strict=True))
    values = {}
    for name, value in z.items():
        if isinstance(value, tuple | list) and len(value) == 2:
            values[name], values[noise_channel(name)] = value
        else:
            values[name] = value
    return values


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return name -> its values in all rows, NaN if missing; noise has its own name."""
    rows = [by_name(row, ()) for row in rows]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name, np.nan) for row in rows] for name in names}


def _series(values: Any) -> Any:
    """Convert a data array with one labelled axis to a series; return other values unchanged."""
    if getattr(values, "ndim", 0) == 1 and hasattr(values, "to_series") and len(values.coords):
        return values.to_series()
    return values


def labelled(z: Any) -> Any:
    """Convert a row of a pandas table to a mapping, since its names count and not its order.

    A data array of xarray with one labelled axis is converted too; a dataset is already a mapping.
    """
    z = _series(z)
    if isinstance(z, Mapping) or not (hasattr(z, "to_dict") and hasattr(z, "keys")):
        return z
    if not all(isinstance(name, str) for name in z.keys()):  # noqa: SIM118
        return z
    named: dict[str, Any] = z.to_dict()
    if len(named) < len(z):
        raise SampleError("two values of the sample have the same name; rename one.")
    return named


def in_order_of(members: Sequence[str], values: Any, what: str) -> Any:
    """Return the labelled values of a mapping, series or data array in the order of the members.

    Values without labels are returned unchanged. `what` names them in messages.
    """
    values = _series(values)
    if isinstance(values, np.ndarray) or not (hasattr(values, "items") and hasattr(values, "keys")):
        return values
    labels, items = list(values.keys()), list(values.items())
    by_label = {str(label): value for label, value in items}
    if len(by_label) == len(items) and by_label.keys() == set(members):
        return [by_label[name] for name in members]
    if isinstance(values, Mapping) or labels != list(range(len(members))):
        raise SampleError(
            f"{what} has values for {labels}; expected one for each of the members {list(members)}."
        )
    return values  # a series with the default index


def mapped(given: Any, what: str) -> Mapping[str, Any]:
    """Convert a mapping, a row or table of pandas, or None (empty) to a mapping from names."""
    if given is None:
        return {}
    mapping = dict(given.items()) if is_frame(given) else labelled(given)
    if not isinstance(mapping, Mapping):
        raise SampleError(f"{what}: got {given!r:.80}; expected a mapping from names to values.")
    return mapping


def number(value: Any, what: str) -> float:
    """Return a float; None, NA and masked values become NaN. `what` names it in messages."""
    if type(value) is float and math.isfinite(value):
        return value
    if value is None or value is np.ma.masked or type(value).__name__ == "NAType":
        return np.nan
    if isinstance(value, str | bytes | bool):
        raise SampleError(f"{what}: got {value!r}; expected a number (NaN if it is missing).")
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise SampleError(f"{what}: got {value!r}; expected a number (NaN if missing).") from None
    if np.isinf(result):
        raise SampleError(f"{what}: got {result}; send NaN for a missing sample, never infinity.")
    return result


def numbers(values: Any, what: str) -> Array:
    """Return an array of floats, NaN where masked. `what` names it in messages."""
    try:
        if np.iscomplexobj(values):
            raise TypeError
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(float), np.nan)
        array: Array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise SampleError(f"{what} = {values!r} holds something that is not a number.") from None
    return array


def plan(name: str, values: Any, count: int) -> Array:
    """Return the values of an input at `count` times, shape (count,)."""
    array = numbers(values, f"input '{name}'")
    if array.shape not in ((), (count,)):
        raise SampleError(
            f"input '{name}' has shape {array.shape}; needs one number, or {count}: one for each "
            "time."
        )
    return np.broadcast_to(array, (count,))


def _array(z: Any) -> Array:
    """Return an array of floats; raise `SampleError` for text or bool, which NumPy converts."""
    if isinstance(z, list | tuple):
        text = any(isinstance(value, str | bytes | bool) for value in z)
    else:
        text = np.asarray(z).dtype.kind in "USb"
    if text:
        raise SampleError(f"z = {z!r} is not an array of numbers.")
    return numbers(z, "z")


def _are_pairs(z: Any, count: int) -> bool:
    """Return whether readings are `count` pairs of value and noise."""
    with suppress(ValueError):  # rows of several lengths
        return bool(np.shape(z) == (count, 2))
    return False


def readings(z: Any, observed: Observed) -> tuple[Array, Array | None]:
    """Return the measurements of all sensors as a new array, and their noise, (sensors,) each.

    The noise is None if no reading specifies its own.
    """
    # Most samples are valid arrays, which skip the slower checks below.
    plain_array = type(z) is np.ndarray and z.dtype == float and z.shape == (observed.size,)
    if plain_array and np.count_nonzero(np.isfinite(z)) == z.size:
        return np.array(z), None
    if isinstance(z, np.ma.MaskedArray):
        z = numbers(z, "z")
    if _are_pairs(z, observed.size):
        values, stds = np.array(z, dtype=object).T.tolist()
        noise = own_noise(list(map(check_noise, observed.names, stds)))
        return readings(values, observed)[0], noise
    return _values(_array(z), observed), None


def _values(array: Array, observed: Observed) -> Array:
    """Return a copy of measurements after validating their shape and that none is infinite."""
    if array.ndim == 0 and observed.size == 1:
        array = array.reshape(1)
    if array.shape != (observed.size,):
        raise SampleError(
            f"z has shape {array.shape}; the observation has {observed.size} sensors, so it "
            f"needs ({observed.size},), NaN where a sample is missing, or ({observed.size}, 2): "
            "each with its noise."
        )
    if np.isinf(array).any():
        sensor = observed.names[int(np.flatnonzero(np.isinf(array))[0])]
        raise SampleError(f"channel '{sensor}' is infinite; send NaN for a missing sample.")
    return array.copy()


@dataclass(frozen=True, eq=False)
class Channels:
    """Names of all channels; conversion of samples to validated arrays."""

    forced: tuple[str, ...]  # channels that the model reads
    observed: Observed  # assimilated sensors
    validation: Observed | None  # sensors that are only scored

    def __post_init__(self) -> None:
        shared = [name for name in self.hidden if name in self.observed.names]
        if shared:
            raise ConfigurationError(
                f"channels {shared} are both assimilated and for validation: rename the "
                'sensors, as in Points({"T_30": 0.3}).'
            )
        if used := [name for name in self.inputs if name in self.noise]:
            raise ConfigurationError(
                f"channel '{used[0]}' has the name of the noise of a reading: rename it."
            )

    @cached_property
    def hidden(self) -> tuple[str, ...]:
        """Names of the validation sensors."""
        return self.validation.names if self.validation else ()

    @cached_property
    def sensors(self) -> list[Observed]:
        """Observation operators of the assimilated sensors and, if present, for validation."""
        return [item for item in (self.observed, self.validation) if item is not None]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names that a sample may contain."""
        return tuple(dict.fromkeys([*self.observed.names, *self.hidden, *self.inputs]))

    @cached_property
    def noise(self) -> dict[str, str]:
        """Mapping from the name of a reading's noise to its sensor."""
        return {noise_channel(name): name for name in (*self.observed.names, *self.hidden)}

    @cached_property
    def _known(self) -> frozenset[str]:
        return frozenset([*self.names, *self.noise])

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Names of the input channels of the model and the sensors."""
        read = [name for item in self.sensors for name in item.observation.inputs]
        return tuple(dict.fromkeys([*self.forced, *read]))

    @cached_property
    def optional(self) -> frozenset[str]:
        """Inputs that may be missing: positions of moving sensors."""
        sensors = [item.observation for item in self.sensors]
        required = {name for item in sensors for name in set(item.inputs) - item.optional}
        optional = frozenset().union(*(item.optional for item in sensors))
        return optional - required - set(self.forced)

    def parse(
        self, z: Readings, inputs: Mapping[str, float] | None
    ) -> tuple[Array, Array | None, Array, dict[str, float]]:
        """Return validated measurements, their noise, validation values, and named values.

        The noise is None if no value specifies its own, and NaN for values that do not. The named
        values include all inputs and may include other channels.
        """
        if not isinstance(inputs, dict):
            inputs = mapped(inputs, "inputs")
        z = self.labelled(z)
        if not isinstance(z, np.ndarray) and isinstance(z, Mapping):
            measured, noise, validation, named = self._by_name(z, inputs)
        else:
            measured, noise = readings(z, self.observed)
            validation, named = np.full(len(self.hidden), np.nan), {}
        if inputs:
            named_inputs = self._named(inputs)
            self._check_once(named, named_inputs)
            named |= {n: v for n, v in named_inputs.items() if n not in named or not math.isnan(v)}
        return measured, noise, validation, named

    def labelled(self, z: Any) -> Any:
        """Convert a row of a table to a mapping from channels; return other readings unchanged."""
        if isinstance(z, (np.ndarray, dict)):
            return z
        row = labelled(z)
        return row if row is z else self._columns(row)

    def _check_once(self, named: Mapping[str, float], given: Mapping[str, float]) -> None:
        """Raise `SampleError` for an input with different values in readings and inputs."""
        sensors = {*self.observed.names, *self.hidden}
        for name, value in given.items():
            other = named.get(name, value)  # a sensor may have the name of an input
            if other != value and not (math.isnan(other) or math.isnan(value) or name in sensors):
                raise SampleError(
                    f"input '{name}' is {other:g} among the readings and {value:g} among the "
                    "inputs; give one of them."
                )

    def _columns(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Drop the columns of a row that are not channels, as `run` does for a table.

        If a channel is missing, all are kept: one may be that channel with a misspelt name.
        """
        if not (set(self.names) - self.optional).issubset(row):
            return row
        return {name: value for name, value in row.items() if name in self._known}

    def readings(self, samples: Sequence[Sample]) -> Array:
        """Return the readings of assimilated and validation sensors, shape (samples, sensors)."""
        rows = [self.parse(sample.z, sample.inputs) for sample in samples]
        shape = len(samples), self.observed.size + len(self.hidden)
        return np.reshape([[*measured, *hidden] for measured, _, hidden, _ in rows], shape)

    def _by_name(
        self, z: Mapping[str, Any], inputs: Mapping[str, float]
    ) -> tuple[Array, Array | None, Array, dict[str, float]]:
        """Parse a mapping, which may also contain inputs; return the same values as `parse`."""
        if not self._known.issuperset(chain(z, inputs)):
            unknown = next(name for name in (*z, *inputs) if name not in self._known)
            raise SampleError(
                f"unknown channel '{unknown}'; this identifier has {list(self.names)}."
            )
        values: dict[str, float] = {}
        stds: dict[str, float] = {}  # sensor -> noise of its reading
        for name, value in z.items():  # composing a message takes longer than the usual check
            if name in self.noise:
                stds[self.noise[name]] = check_noise(self.noise[name], value)
                continue
            if isinstance(value, tuple | list):
                value, stds[name] = self._pair(name, value)
            finite = type(value) is float and math.isfinite(value)
            values[name] = value if finite else number(value, f"channel '{name}'")
        noise = own_noise(_row(self.observed.names, stds)) if stds else None
        return _row(self.observed.names, values), noise, _row(self.hidden, values), values

    def _pair(self, name: str, given: Sequence[Any]) -> tuple[Any, float]:
        """Return value and noise of a reading that is a pair."""
        if len(given) != 2 or noise_channel(name) not in self.noise:
            raise SampleError(
                f"channel '{name}': got {given!r}; expected a number, or of a sensor a pair "
                "(value, standard deviation of its noise)."
            )
        value, std = given
        return value, check_noise(name, std)

    def _named(self, inputs: Mapping[str, float]) -> dict[str, float]:
        """Return inputs with validated names and values."""
        named = {}
        for name, value in inputs.items():
            if name not in self.inputs:
                raise SampleError(
                    f"unknown input '{name}'; model and sensors have {list(self.inputs)}."
                )
            named[name] = number(value, f"input '{name}'")
        return named

    def filled(self, named: Mapping[str, float], known: Inputs) -> tuple[Inputs, tuple[str, ...]]:
        """Return all inputs, and the names of missing ones that hold their last value."""
        if not self.inputs:
            return known, ()
        values, held = {}, []
        for name in self.inputs:
            value = named.get(name, np.nan)
            if math.isnan(value) and name not in self.optional:
                if name not in set(known):
                    required = [c for c in self.inputs if c not in self.optional]
                    raise MissingInputError(
                        f"input '{name}' has no value in the first sample, nor before; start where "
                        f"all of {required} have one."
                    )
                value = known[name]
                held.append(name)
            values[name] = value
        return Inputs(values), tuple(held)

    def planned(
        self,
        inputs: Mapping[str, ArrayLike] | None,
        times: Iterable[float],
        t: float,
        known: Inputs,
    ) -> list[Inputs]:
        """Return all inputs at each of several future times.

        `inputs`: channel -> one value, or one for each time. `t`, `known`: time and inputs of the
        last sample.
        """
        times, planned, last = list(times), [], known
        stated = mapped(inputs, "forecast: inputs")
        plans = {name: plan(name, values, len(times)) for name, values in stated.items()}
        for k, time in enumerate(times):
            named = self._named({name: float(values[k]) for name, values in plans.items()})
            if time == t:  # positions of moving sensors are known at the last sample
                named = {**last, **{name: v for name, v in named.items() if not np.isnan(v)}}
            last, _ = self.filled(named, last)
            planned.append(last)
        return planned


def _row(names: Sequence[str], values: Mapping[str, float]) -> Array:
    """Return the values of `names` as an array, NaN for missing names."""
    return np.array(list(map(values.get, names, repeat(math.nan))))
