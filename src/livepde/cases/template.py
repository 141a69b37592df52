"""Files that `livepde init` writes: a case with made-up data of a rod, or one for a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from livepde.cases.from_table import PLACES, case_for, channels_in, places_for
from livepde.cases.measured import Measured, measured
from livepde.errors import RunError
from livepde.fem import Channel, Normal, interval
from livepde.models import EQUATIONS, Equation, heat
from livepde.stepping import Advance, Alexander2, simulate

__all__ = ["check_free", "files_for", "write_files", "write_template"]

TRUE_ALPHA = 9.7e-5  # aluminium; m^2/s
NOISE = 0.05
CASE = """\
# A case of livepde: which process, what is unknown, which channel is what.
#   livepde check {0}     what is in here, and what its sensors can tell
#   livepde run {0}       identify; writes a run directory
# Numbers are in the model's units (m, s, degC); text may carry any unit of the same kind.
# With data of your own: 'livepde init DIR --data FILE.csv' fills in what they tell.
title = "A metal rod, heated and cooled at its left end"
equation = "heat"              # u_t = div(alpha grad u); also: borehole, reaction_diffusion,
                               # or your own as "file.py:function" (run it with --allow-code)
initial = "interpolate"        # from the first sample; or a number such as "20 degC"

[mesh]
from = 0
to = "40 cm"
cells = 40                     # for a rectangle: x = [0, 1], y = [0, 1], cells = [20, 20]

[data]
file = "rod.csv"               # beside this file; ${{LIVEPDE_DATA}} may stand in it
time = "time_s"                # the column of times: numbers, or dates (2025-04-01 12:00)
time_unit = "s"
# dates as 01.04.2025 12:00: time_format = "%d.%m.%Y %H:%M", zone = "Europe/Berlin"
# as a German Excel writes it: separator = ";", decimal = ",", encoding = "cp1252"
# start, stop, assimilate_from = "10 min"; every = 2 keeps every second row; missing = [-9999]

[unknowns.alpha]               # names are those of the equation
prior = "5e-5 m^2/s"           # what you would have said without data ...
std = "3e-5 m^2/s"             # ... and how far off that may be
bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]
# by layer:  regions = {{ left = [0, "20 cm"], right = ["20 cm", "40 cm"] }}
# as a field: field = true, length = "10 cm"   (and no bounds)

[channels]                     # name = {{ role, column, ... }}; unit = "degF": that of the column
T_left = {{ role = "boundary", column = "T_left", at = "left" }}
T_10 = {{ role = "sensor", column = "T_10", at = "10 cm", noise = "0.05 K" }}
T_20 = {{ role = "withheld", column = "T_20", at = "20 cm" }}    # only scored
T_30 = {{ role = "sensor", column = "T_30", at = "30 cm", noise = "0.05 K" }}
T_right = {{ role = "boundary", column = "T_right", at = "right" }}

[law]
kind = "sensitivity"           # for few, noisy sensors; "gradient" for observed subdomains
replay = true                  # constant unknowns; for drifting ones drift = "0.1 1/h" instead;
                               # kind = "auto" finds out, and needs no noise either

[steps]
scheme = "alexander2"          # second order; or "implicit-euler"
dt_max = "20 s"                # longer intervals between samples are divided

[expect]                       # of these very data: drop it, or say what you expect of yours
alpha = [9e-5, 1.05e-4]        # the rod's data were made with 9.7e-05 m^2/s
rmse = "<= 0.15"           # its noise is 0.05 K; the rest is learning
"""


def write_template(
    folder: Path, table: Measured | Path | None = None, equation: Equation = EQUATIONS["heat"]
) -> tuple[Path, Path]:
    """Write a commented case into a folder, and return the paths of case and data.

    Parameters
    ----------
    table
        A CSV file of measurements that the case is for; it stays where it is. Else data are made
        up and written beside the case.
    equation
        Of the case for that table.

    Raises
    ------
    RunError
        A file that would be written is there already, or the folder is none or cannot be written.
    DataError
        The table cannot be used as it is.
    """
    if table is None:
        check_free(folder, ["rod.csv", "case.toml"])  # before the simulation, which takes a while
        text = CASE.format(folder / "case.toml")
        write_files(folder, {"rod.csv": _measurements(), "case.toml": text})
        return folder / "case.toml", folder / "rod.csv"
    check_free(folder, ["case.toml"])
    found = table if isinstance(table, Measured) else measured(table, equation.time_unit)
    write_files(folder, files_for(found, folder, equation))
    return folder / "case.toml", found.path


def files_for(table: Measured, folder: Path, equation: Equation) -> dict[str, str]:
    """Return name -> text of the files of a case for a table."""
    places = places_for(channels_in(table, equation), equation)
    return {"case.toml": case_for(table, folder, equation), **({PLACES: places} if places else {})}


def check_free(folder: Path, names: Iterable[str]) -> None:
    """Refuse a folder that is a file or holds one of these files: `RunError`."""
    if folder.is_file():
        raise RunError(f"{folder} is a file: 'livepde init DIR --data {folder}' takes a table.")
    for path in (folder / name for name in names):
        if path.exists():
            raise RunError(f"{path} is there already: choose another folder, nothing was written.")


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write files that are not there yet, or none."""
    check_free(folder, files)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunError(f"{folder}: cannot be written: {error.strerror or error}.") from error


def _measurements() -> str:
    """Return noisy temperatures of a rod, simulated on a finer mesh than the case uses."""
    times = np.arange(0.0, 3601.0, 20.0)

    def ends(t: float) -> dict[str, float]:
        left = 20.0 + 15.0 * np.sin(2 * np.pi * t / 1200.0) + 10.0 * (t / 3600.0)
        return {"T_left": left, "T_right": 20.0 + 1.0 * np.sin(2 * np.pi * t / 3600.0)}

    values = {"left": Channel("T_left"), "right": Channel("T_right")}
    model = heat(interval(0.0, 0.4, 80), Normal(TRUE_ALPHA), values)
    at = {"T_10": 20, "T_20": 40, "T_30": 60}  # vertices
    rng = np.random.default_rng(1)
    lines = ["time_s,T_left,T_10,T_20,T_30,T_right"]
    block, q = model.state_block, model.initial_parameter({"alpha": TRUE_ALPHA})
    control = Advance(Alexander2(), 5.0)
    for t, u in simulate(model, q, 20.0, times.tolist(), control, ends):
        profile = block.at_vertices @ u
        inner = [profile[k] + NOISE * rng.standard_normal() for k in at.values()]
        cells = [f"{value:.3f}" for value in (ends(t)["T_left"], *inner, ends(t)["T_right"])]
        if t in (600.0, 620.0):
            cells[1] = ""  # a sensor may fail for a while: an empty cell is a missing sample
        lines.append(",".join([f"{t:g}", *cells]))
    return "\n".join(lines) + "\n"
