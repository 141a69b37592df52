"""Samples of a stream, and what they may contain."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import SampleError
from livepde.linalg import Array
from livepde.observation import Observed
from livepde.stepping import own_noise

Readings: TypeAlias = ArrayLike | Mapping[str, Any]


@dataclass(frozen=True)
class Sample:
    """One moment of a stream.

    Attributes
    ----------
    t
        Time, in the unit of the model.
    z
        Measurements: an array of shape (sensors,), or channel name -> value for everything that
        was measured at t (sensors, inputs, withheld channels). NaN or absent: missing. A sensor
        may have a pair (value, standard deviation of its noise), an array the shape (sensors, 2),
        and a mapping the noise by itself: "noise of T_1". NaN: the noise that the sensor states.
    inputs
        Input and boundary channels, if they are not in z.
    """

    t: float
    z: Readings
    inputs: Mapping[str, float] | None = None


def sample_of(item: Any) -> Sample:
    """Return an item of a stream as a sample: it is one, (t, z), or (t, z, inputs)."""
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


def is_frame(data: Any) -> bool:
    """Return whether data are a pandas table."""
    return all(hasattr(data, name) for name in ("columns", "index", "iterrows"))


def is_dataset(data: Any) -> bool:
    """Return whether data are an xarray dataset."""
    return hasattr(data, "data_vars")


def is_tabular(data: Any) -> bool:
    """Return whether data are a table, a dataset or the name of a file, and no stream of samples.

    >>> is_tabular("rod.csv"), is_tabular([(0.0, 20.0)])
    (True, False)
    """
    return isinstance(data, str | os.PathLike) or is_frame(data) or is_dataset(data)


def noise_channel(name: str) -> str:
    """Return by which name a sample has the noise of a reading.

    >>> noise_channel("T_1")
    'noise of T_1'
    """
    return f"noise of {name}"


def check_noise(name: str, value: Any) -> float:
    """Return the standard deviation of a reading, NaN if it is that of the sensor."""
    found = number(value, noise_channel(name))
    if found <= 0.0:
        raise SampleError(
            f"{noise_channel(name)}: got {found:g}; a standard deviation must be positive (NaN: "
            "that of the sensor)."
        )
    return found


def by_name(z: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return readings as channel -> number, with noise under a separate name.

    Parameters
    ----------
    z
        Readings of a sample.
    names
        Sensors whose values an array holds.
    """
    if not isinstance(z, Mapping):
        z = dict(zip(names, np.atleast_1d(z).tolist(), strict=True))
    found = {}
    for name, value in z.items():
        if isinstance(value, tuple | list) and len(value) == 2:
            found[name], found[noise_channel(name)] = value
        else:
            found[name] = value
    return found


def labelled(z: Any) -> Any:
    """Return a row of a pandas table as a mapping: its names count, not its order."""
    if isinstance(z, Mapping) or not (hasattr(z, "to_dict") and hasattr(z, "keys")):
        return z  # an xarray.Dataset is a mapping already, a DataArray has no names
    if not all(isinstance(name, str) for name in z.keys()):  # noqa: SIM118
        return z
    named: dict[str, Any] = z.to_dict()
    if len(named) < len(z):
        raise SampleError("two values of the sample have the same name; rename one.")
    return named


def number(value: Any, what: str) -> float:
    """Return a float; None is missing (NaN). `what` names it in messages."""
    if type(value) is float and math.isfinite(value):
        return value
    if value is None:
        return np.nan
    if isinstance(value, str | bytes | bool):
        raise SampleError(f"{what}: got {value!r}; expected a number (NaN if it is missing).")
    try:
        found = float(value)
    except (TypeError, ValueError):
        raise SampleError(f"{what}: got {value!r}; expected a number (NaN if missing).") from None
    if np.isinf(found):
        raise SampleError(f"{what}: got {found}; send NaN for a missing sample, never infinity.")
    return found


def numbers(values: Any, what: str) -> Array:
    """Return an array of floats. `what` names it in messages."""
    try:
        array: Array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise SampleError(f"{what} = {values!r} holds something that is not a number.") from None
    return array


def plan(name: str, values: Any, count: int) -> Array:
    """Return the values of an input at each of some times."""
    found = numbers(values, f"input '{name}'")
    if found.shape not in ((), (count,)):
        raise SampleError(
            f"input '{name}' has shape {found.shape}; needs one number, or {count}: one for each "
            "time."
        )
    return np.broadcast_to(found, (count,))


def _are_pairs(z: Any, size: int) -> bool:
    """Return whether z holds a pair for each of so many sensors."""
    try:
        return bool(np.shape(z) == (size, 2))
    except ValueError:  # rows of several lengths
        return False


def _array(z: Any) -> Array:
    """Return an array of floats; refuses text and truth values, which NumPy would convert."""
    if isinstance(z, list | tuple):
        text = any(isinstance(value, str | bytes | bool) for value in z)
    else:
        text = np.asarray(z).dtype.kind in "USb"
    if text:
        raise SampleError(f"z = {z!r} is not an array of numbers.")
    return numbers(z, "z")


def readings(z: Any, observed: Observed) -> tuple[Array, Array | None]:
    """Return the measurements of all sensors, shape (sensors,), as a new array.

    And the noise of each, None if none has one of its own.
    """
    # Most samples are arrays as they should be: they pass without the slower checks below.
    usual = type(z) is np.ndarray and z.dtype == float and z.shape == (observed.size,)
    if usual and np.count_nonzero(np.isfinite(z)) == z.size:
        return np.array(z), None
    if _are_pairs(z, observed.size):
        values, stds = np.array(z, dtype=object).T.tolist()
        noise = own_noise(list(map(check_noise, observed.names, stds)))
        return readings(values, observed)[0], noise
    array = _array(z)
    if array.ndim == 0 and observed.size == 1:
        array = array.reshape(1)
    if array.shape != (observed.size,):
        raise SampleError(
            f"z has shape {array.shape}; the observation has {observed.size} sensors, so it "
            f"needs ({observed.size},), NaN where a sample is missing, or ({observed.size}, 2): "
            "each with its noise."
        )
    if np.isinf(array).any():
        where = observed.names[int(np.flatnonzero(np.isinf(array))[0])]
        raise SampleError(f"channel '{where}' is infinite; send NaN for a missing sample.")
    return array.copy(), None
