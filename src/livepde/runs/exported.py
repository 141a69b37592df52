"""Export of a run to the formats of other programs: netCDF, Zarr, CSV, Parquet, XDMF and VTK.

The dataset of a run has the names and units of the model. An exported dataset follows the CF
conventions (units for UDUNITS, times with a date, ancillary variables), and UGRID for the mesh.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import xarray as xr

from livepde.dates import instants, since
from livepde.errors import ConfigurationError, RunError
from livepde.records import STATUS_CODES, field_names, interval_95, scalars
from livepde.runs.directory import Run, plain, write_dataset
from livepde.units import NOT_A_UNIT, parsed_unit, pint_registry

CONVENTIONS = "CF-1.11"
BESIDE = {  # suffix of a name -> long name of the variable, given the name without the suffix
    "_std": "standard deviation of {}",
    "_low": "lower end of the 95 % interval of {}",
    "_high": "upper end of the 95 % interval of {}",
    "_left": "standard deviation of {}, as a share of the prior's",
    "_modes": "number of modes of {} that the data determine",
    "_left_out": "share of modes that the law leaves out in the variance of {}",
}
LONG_NAMES = {
    "snapshot": "time of the fields",
    "x": "x of the vertices",
    "y": "y of the vertices",
    "z": "z of the vertices",
    "sensor": "assimilated channel",
    "validation": "validation channel",
    "innovation": "measured minus predicted, one step ahead",
    "validation_error": "measured minus predicted of validation channels, one step ahead",
    "status": "outcome of the step",
    "correlation": "correlation of the last estimates",
}
DIFFERENCES = ("innovation", "validation_error")
CLOCKS = ("time", "snapshot")
NO_LEAPS = "leap_seconds: none"
SYMBOLS = {  # unit symbol of pint -> symbol of UDUNITS, if they differ
    "°C": "degC",
    "°F": "degF",
    "Δ°C": "K",
    "Δ°F": "degR",
    "Ω": "ohm",
    "a": "year",
    "deg": "degree",
}
SCALES = ("degC", "degF")  # units whose zero is not absolute zero
Writer: TypeAlias = Callable[[Run, Path, float | None], object]
NEEDS = {
    ".parquet": ["pyarrow"],
    ".zarr": ["zarr"],
    ".xdmf": ["meshio", "h5py"],
    ".vtu": ["meshio"],
    ".vtk": ["meshio"],
}
AT_ONE_TIME = (".vtu", ".vtk")


@dataclass(frozen=True)
class Kind:
    """A kind of mesh cell."""

    dimension: int  # of the mesh
    role: str  # name of such a cell in UGRID
    # Corners that share an edge with the first corner, in right-handed order.
    edges: tuple[int, ...]
    turned: tuple[int, ...]  # permutation of the corners that reverses the orientation of a cell


KINDS = {
    "triangle": Kind(2, "face", (1, 2), (0, 2, 1)),
    "quad": Kind(2, "face", (1, 3), (0, 3, 2, 1)),
    "tetra": Kind(3, "volume", (1, 2, 3), (0, 2, 1, 3)),
    "hexahedron": Kind(3, "volume", (1, 3, 4), (4, 5, 6, 7, 0, 1, 2, 3)),
}


@cache
def udunits(unit: str) -> str | None:
    """Return a unit in the notation of UDUNITS; None if it has no such unit, such as a root.

    >>> udunits("m^2/s"), udunits("J/(m^3 K)"), udunits("degC"), udunits("")
    ('m2 s-1', 'J m-3 K-1', 'degC', '1')
    """
    from pint.util import to_units_container

    registry = pint_registry()
    try:
        found = to_units_container(parsed_unit(registry, unit))
    except NOT_A_UNIT:
        return None
    parts = {name: float(str(power)) for name, power in found.items()}
    if not all(power.is_integer() for power in parts.values()):
        return None
    words = []
    # Positive powers come first, as in m2 s-1.
    for name, power in sorted(parts.items(), key=lambda part: part[1] < 0.0):
        symbol = registry.get_symbol(name)
        symbol = SYMBOLS.get(symbol, symbol.replace("µ", "u"))
        words.append(symbol if power == 1 else f"{symbol}{int(power)}")
    return " ".join(words) or "1"


def cf(
    data: xr.Dataset, *, title: str = "", source: str = "livepde", history: str = ""
) -> xr.Dataset:
    """Return a run's dataset with names, units and relations that follow the CF conventions.

    Parameters
    ----------
    data
        Dataset of the run, see `Result.to_xarray`.
    title, source, history
        Global attributes; the title of the dataset takes precedence over `title`.

    Returns
    -------
    Dataset
        If the run has a date, `time` and `snapshot` count from it, so that xarray decodes them as
        dates. Units have the notation of UDUNITS. Names consist of letters, digits and underscores;
        `long_name` is the original name. Standard deviations and ends of intervals are
        `ancillary_variables`. A mesh in two or three dimensions follows UGRID. Only times have
        standard names, since CF defines the others for the atmosphere and the ocean.
    """
    found = bounded(data)
    names = free_names(map(str, found.variables))
    clock = str(data["time"].attrs.get("units", ""))
    # A time coordinate of CF requires a date. Without a date, times have a unit only.
    counted = since(clock, data.attrs.get("origin"))
    about = _unit_attrs("time", clock)
    if counted:
        about = {"standard_name": "time", "axis": "T", **counted, "units_metadata": NO_LEAPS}
    for name in names:
        _describe(found, name, about)
        _relate(found, name, names)
    state = str(data.attrs.get("state", "")).split()
    lists = {"scalars": scalars(data), "fields": field_names(data), "state": state}
    found.attrs = plain(data.attrs) | {
        key: " ".join(names[name] for name in some if name in names) for key, some in lists.items()
    }
    found.attrs |= {"Conventions": CONVENTIONS, "source": source, "history": history}
    found.attrs["title"] = str(data.attrs.get("title", "")) or title
    found = found.rename(names)
    for kind in kinds_of(found):
        _add_topology(found, kind)
    return found


def bounded(data: xr.Dataset) -> xr.Dataset:
    """Return a copy with the 95 % interval of each scalar next to its standard deviation."""
    found = {}
    for name, variable in data.data_vars.items():
        found[name] = variable.copy(deep=False)
        label = str(name).removesuffix("_std")
        if label != name and label in scalars(data) and f"{label}_low" not in data:
            unit = {"units": variable.attrs.get("units", "")}
            for end, values in zip(("_low", "_high"), interval_95(data, label), strict=True):
                found[f"{label}{end}"] = xr.DataArray(values, dims="time", attrs=unit)
    return xr.Dataset(found, data.coords, data.attrs)


def free_names(wanted: Iterable[str]) -> dict[str, str]:
    """Map each name to a unique name of letters, digits and underscores."""
    found: dict[str, str] = {}
    for name in wanted:
        stem = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
        # CF requires that a name begins with a letter.
        stem = stem if stem[:1].isalpha() else f"v{stem}"
        free, number = stem, 2
        while free in found.values():
            free, number = f"{stem}_{number}", number + 1
        found[name] = free
    return found


def _unit_attrs(name: str, own: str) -> dict[str, str]:
    """Return the CF attributes of a variable with the unit `own`."""
    unit = udunits(own)
    if unit is None:
        return {"comment": f"unit: {own}"}
    if unit not in SCALES:
        return {"units": unit}
    # A difference of 5 degC is 5 K, but a temperature of 5 degC is 278.15 K.
    kind = "difference" if name.endswith("_std") or name in DIFFERENCES else "on_scale"
    return {"units": unit, "units_metadata": f"temperature: {kind}"}


def _relate(data: xr.Dataset, name: str, names: Mapping[str, str]) -> None:
    """List the ancillary variables of a variable, such as its standard deviation, as attribute."""
    beside = [names[other] for end in BESIDE if (other := f"{name}{end}") in data]
    if beside:
        data[name].attrs["ancillary_variables"] = " ".join(beside)


def _describe(data: xr.Dataset, name: str, clock: Mapping[str, str]) -> None:
    """Set the CF attributes of a variable: long name, unit, axis and type of flags.

    `clock`: attributes of time variables.
    """
    variable = data[name]
    attrs = variable.attrs
    attrs.setdefault("long_name", LONG_NAMES.get(name, name))
    for end, text in BESIDE.items():
        base = name.removesuffix(end)
        if base != name and base in data:
            attrs["long_name"] = text.format(base)
            attrs.setdefault("units", "")
    if name in data.coords:
        variable.encoding["_FillValue"] = None  # coordinates have no missing values
    own = attrs.pop("units", None)
    if name in CLOCKS:
        attrs |= clock
    elif own is not None:
        attrs |= _unit_attrs(name, str(own))
    if "flag_values" in attrs:
        attrs["flag_values"] = np.array(attrs["flag_values"], dtype=variable.dtype)


def kinds_of(data: xr.Dataset) -> list[str]:
    """Return the kinds of the cells in a dataset."""
    return [kind for kind in KINDS if kind in data and data[kind].dims == ("cell", "corner")]


def oriented(data: xr.Dataset, kind: str) -> Any:
    """Return the corners of each cell in positive orientation, which other programs expect."""
    corners = np.array(data[kind].values)
    about = KINDS[kind]
    axes = "xyz"[: about.dimension]
    points = np.column_stack([data[axis].values for axis in axes])
    edges = [points[corners[:, k]] - points[corners[:, 0]] for k in about.edges]
    wrong = np.linalg.det(np.stack(edges, axis=1)) < 0.0
    corners[wrong] = corners[wrong][:, about.turned]
    return corners


def _add_topology(data: xr.Dataset, kind: str) -> None:
    """Add the mesh topology of vertices and cells according to UGRID."""
    dimension, cell = KINDS[kind].dimension, KINDS[kind].role
    name = "mesh"
    while name in data:
        name += "_"
    corners = f"{cell}_node_connectivity"
    axes = [axis for axis in "xyz" if axis in data.coords]
    data[kind].values = oriented(data, kind)
    data[kind].attrs |= {"cf_role": corners, "start_index": np.int32(0)}
    data[kind].attrs["long_name"] = f"vertices of each {kind}"
    for variable in data.data_vars.values():
        if variable.dims[-1:] == ("vertex",):
            variable.attrs |= {"mesh": name, "location": "node"}
    about = {
        "cf_role": "mesh_topology",
        "long_name": "mesh",
        "topology_dimension": np.int32(dimension),
        "node_coordinates": " ".join(axes),
        corners: kind,
    }
    if dimension == 2:
        about["face_dimension"] = "cell"
    data[name] = ((), np.int32(0), about)
    data.attrs["Conventions"] = f"{CONVENTIONS} UGRID-1.0"


def export(run: Run, target: Path, *, at: float | None = None, force: bool = False) -> None:
    """Write a run to a file atomically; its suffix determines the format, see `FORMATS`.

    A run that is still in progress is exported up to now.

    Parameters
    ----------
    at
        Time at which fields are written in a format of one time (`AT_ONE_TIME`); default the last.
    force
        Replace an existing file.

    Raises
    ------
    RunError
        The target exists; it cannot be written; there is nothing to write.
    ConfigurationError
        The format is unknown, or requires a package that is not installed.
    """
    check_target(target, FORMATS)
    ending = target.suffix.lower()
    if at is not None and ending not in AT_ONE_TIME:
        raise ConfigurationError(
            f"{target}: contains all times; a time is only chosen for {' and '.join(AT_ONE_TIME)}."
        )
    if not run.dataset.sizes["time"]:
        raise RunError(f"{run.path} contains no estimates yet, so there is nothing to export.")
    into_place(target, lambda path: FORMATS[ending](run, path, at), force=force)


def check_target(target: Path, known: Collection[str]) -> None:
    """Raise `ConfigurationError` if a format is unknown or its package is not installed."""
    ending = target.suffix.lower()
    if ending not in known:
        raise ConfigurationError(
            f"{target}: there is no format '{target.suffix}'; expected one of {', '.join(known)}."
        )
    need(target, NEEDS.get(ending, []))


def need(target: Path, packages: Iterable[str], extra: str = "formats") -> None:
    """Raise `ConfigurationError` if a required package is not installed."""
    import importlib.util

    for name in packages:
        if importlib.util.find_spec(name) is None:
            raise ConfigurationError(
                f"{target}: this format needs {name}: pip install 'livepde[{extra}]'."
            )


def into_place(target: Path, write: Callable[[Path], object], *, force: bool = False) -> None:
    """Write a file or folder in a temporary folder, and move it to the target when complete.

    `write`: called with a temporary path of the same name; other files next to it are also moved.
    Raises `RunError`: the target exists and `force` is not set; the target cannot be written.
    """
    try:
        refuse_file(target, force)
        with TemporaryDirectory(dir=target.parent, prefix=".livepde-") as folder:
            write(Path(folder) / target.name)
            made = sorted(Path(folder).iterdir())
            for path in made:
                refuse_file(target.parent / path.name, force)
            for path in made:
                place = target.parent / path.name
                if place.is_dir():
                    shutil.rmtree(place)
                path.replace(place)
    except RunError:
        raise
    except OSError as error:
        raise RunError(f"{target} cannot be written: {error.strerror or error}.") from error


def refuse_file(target: Path, force: bool) -> None:
    """Raise `RunError` if a target must not be replaced; a folder may be, if a Zarr store."""
    if not target.exists():
        return
    if target.is_dir() and not {".zgroup", "zarr.json"} & {path.name for path in target.iterdir()}:
        raise RunError(f"{target} is a folder. Specify a file.")
    if not force:
        raise RunError(f"{target} exists. Choose another file, or add --force to replace it.")


def _conventional(run: Run) -> xr.Dataset:
    record = run.record
    command = " ".join(str(word) for word in record.get("command", []))
    return cf(
        run.dataset,
        title=run.title,
        source=f"livepde {record.get('livepde', '')}".strip(),
        history=f"{record.get('started', '')} {command}".strip(),
    )


def _over_time(run: Run) -> pd.DataFrame:
    """Return all variables over time, one row for each sample, with units in column names."""
    data = bounded(run.dataset)
    times = data["time"].values
    columns: dict[str, Any] = {}
    dates = instants(data, times)
    if dates is not None:
        columns["date"] = dates
    # Estimates come first; innovations and errors of validation channels last.
    for name in ("time", *sorted(map(str, data.data_vars), key=DIFFERENCES.__contains__)):
        variable = data[name]
        own = str(variable.attrs.get("units", ""))
        unit = udunits(own) or own
        end = "" if unit == "1" else f" [{unit}]"
        if name == "status":
            columns[name] = np.array(STATUS_CODES)[variable.values]
        elif variable.dims == ("time",):
            columns[f"{name}{end}"] = variable.values
        elif variable.dims[:1] == ("time",) and variable.ndim == 2:
            for k, label in enumerate(variable[variable.dims[1]].values):
                columns[f"{name}:{label}{end}"] = variable.values[:, k]
    return pd.DataFrame(columns)


def _series(run: Run, path: Path, at: float | None) -> None:
    """Write the fields of all times as XDMF, with their values in an HDF5 file next to it."""
    import h5py  # type: ignore[import-untyped]
    from meshio.xdmf import TimeSeriesWriter

    class Writer(TimeSeriesWriter):  # type: ignore[misc]
        """Writer that puts the HDF5 file next to the XDMF file, not into the current folder."""

        def __enter__(self) -> Any:
            self.h5_filename = str(self.filename.with_suffix(".h5"))
            self.h5_file = h5py.File(self.h5_filename, "w")
            return self

    data = _with_fields(run)
    with Writer(path) as writer:
        writer.write_points_cells(*_mesh(data))
        for k, t in enumerate(data["snapshot"].values.tolist()):
            writer.write_data(t, point_data=_fields(data, k))


def _vtk(run: Run, path: Path, at: float | None) -> None:
    """Write the fields of one time in a VTK format."""
    import meshio

    data = _with_fields(run)
    k = -1
    if at is not None:
        first = min(float(data["snapshot"][0]), float(data["time"].min()))
        last = float(data["time"].max())
        if not first <= at <= last:
            raise ConfigurationError(
                f"{path.name}: t = {at:g} is outside the run, from {first:g} to {last:g}."
            )
        k = int(np.abs(data["snapshot"].values - at).argmin())
    meshio.write(path, meshio.Mesh(*_mesh(data), point_data=_fields(data, k)))


def _with_fields(run: Run) -> xr.Dataset:
    if not run.dataset.sizes.get("snapshot"):
        raise RunError(f"{run.path} contains no fields, so there is nothing to draw.")
    return run.dataset


def _mesh(data: xr.Dataset) -> tuple[Any, list[tuple[str, Any]]]:
    """Return points, shape (vertices, 3), and cells; in 1D, lines between adjacent vertices."""
    count = data.sizes["vertex"]
    axes = [data[axis].values if axis in data.coords else np.zeros(count) for axis in "xyz"]
    cells = [(kind, oriented(data, kind)) for kind in kinds_of(data)]
    order = np.arange(count, dtype=np.int32)
    return np.column_stack(axes), cells or [("line", np.column_stack([order[:-1], order[1:]]))]


def _fields(data: xr.Dataset, k: int) -> dict[str, Any]:
    """Return the values at the vertices of one snapshot."""
    names = free_names(
        str(n) for n, v in data.data_vars.items() if v.dims == ("snapshot", "vertex")
    )
    return {free: data[name].values[k] for name, free in names.items()}


FORMATS: dict[str, Writer] = {
    ".nc": lambda run, path, at: write_dataset(_conventional(run), path),
    # Version 3 of Zarr has no standard for text of fixed length yet.
    ".zarr": lambda run, path, at: _conventional(run).to_zarr(
        path, zarr_format=2, consolidated=True
    ),
    ".csv": lambda run, path, at: _over_time(run).to_csv(path, index=False),
    ".parquet": lambda run, path, at: _over_time(run).to_parquet(path, index=False),
    ".xdmf": _series,
    ".vtu": _vtk,
    ".vtk": _vtk,
}
