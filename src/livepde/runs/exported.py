"""A run in the formats of other programs: netCDF, Zarr, CSV, Parquet, XDMF and VTK.

A run's dataset has the names and units of the model. An exported one follows the CF conventions
(units that UDUNITS reads, times with their date, ancillary variables) and UGRID for the mesh.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import xarray as xr

from livepde.dates import instants
from livepde.errors import ConfigurationError, RunError
from livepde.records import STATUS_CODES
from livepde.runs.conventions import (
    DIFFERENCES,
    bounded,
    cf,
    free_names,
    kinds_of,
    oriented,
    udunits,
)
from livepde.runs.directory import Run, write_dataset


def export(run: Run, target: Path, *, at: float | None = None, force: bool = False) -> None:
    """Write a run in the format that the ending of a file names: see `FORMATS`.

    A run that is still in progress is exported up to now. The file is written atomically.

    Parameters
    ----------
    at
        For formats of one time (`AT_ONE_TIME`): the fields nearest to this time; default the last.
    force
        Replace an existing file.

    Raises
    ------
    RunError
        The target exists; it cannot be written; there is nothing to write.
    ConfigurationError
        There is no such format, or it needs a package that is not installed.
    """
    ending = target.suffix.lower()
    if ending not in FORMATS:
        raise ConfigurationError(
            f"{target}: there is no format '{target.suffix}'; expected one of {', '.join(FORMATS)}."
        )
    need(target, NEEDS.get(ending, []))
    if at is not None and ending not in AT_ONE_TIME:
        raise ConfigurationError(
            f"{target}: contains all times; a time is only chosen for {' and '.join(AT_ONE_TIME)}."
        )
    if not run.dataset.sizes["time"]:
        raise RunError(f"{run.path} contains no estimates yet, so there is nothing to export.")
    into_place(target, lambda path: FORMATS[ending](run, path, at), force=force)


def need(target: Path, packages: Iterable[str], extra: str = "formats") -> None:
    """Raise `ConfigurationError` if a package is missing that writes such a file."""
    import importlib.util

    for name in packages:
        if importlib.util.find_spec(name) is None:
            raise ConfigurationError(
                f"{target}: this format needs {name}: pip install 'livepde[{extra}]'."
            )


def into_place(target: Path, write: Callable[[Path], None], *, force: bool = False) -> None:
    """Write a file or folder next to its target, and move it there when it is complete.

    Parameters
    ----------
    write
        Called with a temporary path of the same name; files written beside it are moved, too.

    Raises
    ------
    RunError
        Something is there already and `force` is not set; it cannot be written.
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
    """Raise `RunError` if there is something, unless it may go; a folder only as a Zarr store."""
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


def _netcdf(run: Run, path: Path, at: float | None) -> None:
    write_dataset(_conventional(run), path)


def _zarr(run: Run, path: Path, at: float | None) -> None:
    # The second format has text of fixed length, which the third has not settled yet.
    _conventional(run).to_zarr(path, zarr_format=2, consolidated=True)


def _csv(run: Run, path: Path, at: float | None) -> None:
    """Write all variables over time as CSV."""
    _over_time(run).to_csv(path, index=False)


def _parquet(run: Run, path: Path, at: float | None) -> None:
    """Write all variables over time as Parquet."""
    _over_time(run).to_parquet(path, index=False)


def _over_time(run: Run) -> pd.DataFrame:
    """Return all variables over time, one row for each sample, with units in the names."""
    data = bounded(run.dataset)
    times = data["time"].values
    columns: dict[str, Any] = {}
    dates = instants(data, times)
    if dates is not None:
        columns["date"] = dates
    # Estimates come first; innovations and errors of withheld channels last.
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
    """Write the fields of all times as XDMF, with their numbers in an HDF5 file next to it."""
    import h5py  # type: ignore[import-untyped]
    from meshio.xdmf import TimeSeriesWriter

    class Writer(TimeSeriesWriter):  # type: ignore[misc]
        """Keeps the HDF5 file next to the XDMF file, not in the current folder."""

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
    """Write the fields of one time."""
    import meshio

    data = _with_fields(run)
    k = -1 if at is None else int(np.abs(data["snapshot"].values - at).argmin())
    meshio.write(path, meshio.Mesh(*_mesh(data), point_data=_fields(data, k)))


def _with_fields(run: Run) -> xr.Dataset:
    if not run.dataset.sizes.get("snapshot"):
        raise RunError(f"{run.path} contains no fields, so there is nothing to draw.")
    return run.dataset


def _mesh(data: xr.Dataset) -> tuple[Any, list[tuple[str, Any]]]:
    """Return points, shape (vertices, 3), and cells; those of an interval join its neighbours."""
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


Writer: TypeAlias = Callable[[Run, Path, float | None], None]
FORMATS: dict[str, Writer] = {
    ".nc": _netcdf,
    ".zarr": _zarr,
    ".csv": _csv,
    ".parquet": _parquet,
    ".xdmf": _series,
    ".vtu": _vtk,
    ".vtk": _vtk,
}
NEEDS = {
    ".parquet": ["pyarrow"],
    ".zarr": ["zarr"],
    ".xdmf": ["meshio", "h5py"],
    ".vtu": ["meshio"],
    ".vtk": ["meshio"],
}
AT_ONE_TIME = (".vtu", ".vtk")
