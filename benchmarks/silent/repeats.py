"""Checks of repeated rows, clocks set back, flipped bits, and environment variables in a case.

One end of a rod is heated and cooled; rows 200 to 299 arrive twice, by file, standard input and
broker. Estimates must equal the run without repeats to the bit, and this run must agree with a fit
without livepde (Crank-Nicolson finite differences, `scipy.optimize.least_squares`).
"""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.linalg import solve_banded
from scipy.optimize import least_squares

from benchmarks.faults.plants import BROKER, Mosquitto, Topic
from livepde.cases import Case, load
from livepde.cases.data import passwords_of
from livepde.cases.live_case import LiveCase
from livepde.diagnostics.check_report import Check
from livepde.errors import CaseError, RunError
from livepde.estimate import Estimate
from livepde.linalg import Array
from livepde.runs import RunWriter
from livepde.runs import open as open_run
from livepde.runs.backlog import Sink

COUNT, FIRST, END = 600, 200, 300  # number of rows; rows FIRST to END - 1 are repeated
ALPHA, STEP, NOISE = 2e-5, 60.0, 0.05  # m^2/s, s, K
CELLS, SUBSTEPS = 120, 4  # of the finite differences
BACK, EVERY = 3.5, 30  # steps by which the clock is set back, and rows between two setbacks
FLIPS = 200
PATIENCE = 60.0  # time limit of a run with a broker, in seconds
_CASE = """equation = "heat"
initial = "interpolate"

[mesh]
from = "0 m"
to = "1 m"
cells = 40

[data]
time = "time"
{source}

[unknowns.alpha]
prior = "3e-5 m^2/s"
std = "1e-5 m^2/s"
bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]

[channels]
left = {{ role = "boundary", column = "left", at = "left", unit = "degC" }}
T_3 = {{ role = "sensor", column = "T_3", at = "0.3 m", unit = "degC" }}
T_6 = {{ role = "sensor", column = "T_6", at = "0.6 m", unit = "degC" }}

[boundary]
right = "20 degC"

[law]
kind = "sensitivity"
noise = "{noise} K"
"""
Row = dict[str, float]


def checks() -> list[Check]:
    """Return the checks of repeated rows, clocks, flipped bits and environment variables."""
    rows = rod()
    repeated = [*rows[:END], *rows[FIRST:END], *rows[END:]]
    back = [{**row, "time": row["time"] - BACK * STEP * (k // EVERY)} for k, row in enumerate(rows)]
    with TemporaryDirectory() as name:
        folder = Path(name)
        right = _from_file(folder / "right", rows)
        checks = [
            *_fitted(right, fit(rows)),
            *_repeats("file", _from_file(folder / "file", repeated), right),
            *_repeats("standard input", _from_lines(folder / "lines", repeated), right),
            *_from_topic(folder / "topic", repeated, right),
            *_went_back(_from_file(folder / "back", back), back),
        ]
        return [*checks, *_flips(folder / "flips", right.data), *_variables(folder / "variables")]


def rod() -> list[Row]:
    """Simulate a rod by finite differences; return its rows with white noise on the sensors."""
    rng = np.random.default_rng(36)
    times = STEP * np.arange(COUNT)
    left = 20.0 + 5.0 * np.sin(2e-4 * times) + 3.0 * np.sin(9e-4 * times)
    T = simulated(ALPHA, left) + NOISE * rng.standard_normal((COUNT, 2))
    columns = {"time": times, "left": left, "T_3": T[:, 0], "T_6": T[:, 1]}
    return [{name: float(values[k]) for name, values in columns.items()} for k in range(COUNT)]


def simulated(alpha: float, left: Array) -> Array:
    """Return temperatures at 0.3 and 0.6 m of a rod, initially at 20 degrees, for its left end."""
    h, dt = 1.0 / CELLS, STEP / SUBSTEPS
    r = 0.5 * alpha * dt / h**2
    bands = np.zeros((3, CELLS - 1))
    bands[0], bands[1], bands[2] = -r, 1.0 + 2.0 * r, -r
    u, readings = np.full(CELLS + 1, 20.0), []
    places = [round(0.3 * CELLS), round(0.6 * CELLS)]
    for k, end in enumerate(left):
        start = left[max(k - 1, 0)]
        for j in range(SUBSTEPS if k else 0):
            b = u[1:-1] + r * np.diff(u, 2)
            u[0] = start + (end - start) * (j + 1) / SUBSTEPS
            b[0] += r * u[0]
            b[-1] += r * u[-1]
            u[1:-1] = solve_banded((1, 1), bands, b)
        readings.append(u[places].copy())
    return np.array(readings)


def fit(rows: Sequence[Row]) -> float:
    """Estimate the diffusivity by least squares on all rows."""
    left = np.array([row["left"] for row in rows])
    measured = np.array([[row["T_3"], row["T_6"]] for row in rows])

    def residual(p: Array) -> Array:
        scaled: Array = (simulated(1e-5 * float(p[0]), left) - measured).ravel() / NOISE
        return scaled

    solution = least_squares(residual, [3.0])
    return 1e-5 * float(solution.x[0])


class _Done:
    """Dataset, counts, sample times and event messages of a finished run."""

    def __init__(self, live: Any) -> None:
        self.data = live.result.to_xarray()
        self.counts = live.journal.counts
        self.events = [event.message for event in live.journal.events]
        self.times = [record.t for record in live.journal]

    @property
    def alpha(self) -> tuple[float, float]:
        """Final estimate and its standard deviation."""
        return float(self.data["alpha"][-1]), float(self.data["alpha_std"][-1])


class _Last(Sink):
    """Sink that stops a run with a broker, which never ends by itself, at its last estimate."""

    def __init__(self, stopping: threading.Event) -> None:
        self._stopping = stopping

    def put(self, estimate: Estimate) -> None:
        """Request the stop once the last row was estimated."""
        if estimate.t >= STEP * (COUNT - 1):
            self._stopping.set()


def _case(folder: Path, source: str = "") -> Case:
    folder.mkdir(exist_ok=True)
    path = folder / "case.toml"
    path.write_text(_CASE.format(source=source, noise=NOISE))
    return load(path)


def _ran(case: Case, data: Any = None) -> _Done:
    with LiveCase(case, data) as wiring:
        live = wiring.live()
        if live is None:
            raise RunError("benchmark silent: a run did not begin.")
        live.run()
        return _Done(live)


def _from_file(folder: Path, rows: Sequence[Row]) -> _Done:
    case = _case(folder, 'file = "rows.csv"')
    lines = [",".join(rows[0]), *(",".join(map(repr, row.values())) for row in rows)]
    (folder / "rows.csv").write_text("\n".join(lines) + "\n")
    return _ran(case, str(folder / "rows.csv"))


def _from_lines(folder: Path, rows: Sequence[Row]) -> _Done:
    return _ran(_case(folder), iter([json.dumps(row) + "\n" for row in rows]))


def _from_topic(folder: Path, rows: Sequence[Row], right: _Done) -> list[Check]:
    if shutil.which("mosquitto", path=BROKER) is None:
        text = "MQTT: left out, there is no broker here (install mosquitto)"
        return [_none(text, 0)]
    folder.mkdir()
    with ExitStack() as stack:
        broker = Mosquitto(folder)
        stack.callback(broker.close)
        topic = Topic(broker, rows, "repeats")
        stack.callback(topic.close)
        topic.supply(len(rows))
        stopping = threading.Event()
        watch = threading.Timer(PATIENCE, stopping.set)
        stack.callback(watch.cancel)
        watch.start()
        wiring = stack.enter_context(LiveCase(_case(folder, topic.source)))
        live = wiring.live([_Last(stopping)], stopping)
        if live is None:
            raise RunError("benchmark silent: a run did not begin.")
        live.run()
        # The sink stops the run, so that the last estimate lacks the final fit.
        return _repeats("MQTT", _Done(live), right, compared=slice(-1))


def _fitted(right: _Done, alpha: float) -> list[Check]:
    """Check that the run without repeats agrees with the independent fit."""
    value, std = right.alpha
    error = abs(value - alpha) / std
    return [Check("no repeats: alpha, standard deviations off the fit", error, 2.0, "<=")]


def _none(what: str, value: float) -> Check:
    """Return a check that a count is zero."""
    return Check(what, value, 0, "<=")


def _repeats(source: str, found: _Done, right: _Done, compared: slice = slice(None)) -> list[Check]:
    """Check that a run with repeated rows equals the run without them, and counts the repeats."""
    invented = set(found.times) - set(right.times)
    names = ("alpha", "alpha_std", "time")
    same = [np.array_equal(found.data[n][compared], right.data[n][compared]) for n in names]
    counted = abs(found.counts.get(("repeated", ""), 0) - (END - FIRST))
    return [
        _none(f"{source}: samples too many or too few", abs(len(found.times) - COUNT)),
        _none(f"{source}: samples at times that were never measured", len(invented)),
        _none(f"{source}: estimates that differ in a bit", same.count(False)),
        _none(f"{source}: repeated rows that are not counted", counted),
        _none(f"{source}: rows called late, or other", len(found.counts) - 1),
    ]


def _went_back(found: _Done, rows: Sequence[Row]) -> list[Check]:
    """Check that the samples are the rows later than all before, and that the rest is reported."""
    newest = np.maximum.accumulate([row["time"] for row in rows])
    kept = [0.0, *newest[1:][np.diff(newest) > 0].tolist()]
    late = sum(n for (kind, name), n in found.counts.items() if name == "left")
    episodes, clock = (len(rows) - 1) // EVERY, found.counts.get(("clock", ""), 0)
    return [
        _none("clock back: times that were never stated", len(set(found.times) ^ set(kept))),
        _none("clock back: late rows that are not counted", abs(late - len(rows) + len(kept))),
        _none("clock back: episodes that are not counted", abs(clock - episodes)),
        _none("clock back: no event says so", int(not any("went back" in e for e in found.events))),
    ]


def _flips(folder: Path, data: Any) -> list[Check]:
    """Check that every changed bit in the estimates of a finished run is detected."""
    writer = RunWriter.create(folder, version="1", command=[], title="flips")
    writer.finish(status="finished", dataset=data)
    path, rng = folder / "estimates.nc", np.random.default_rng(36)
    whole, silent = path.read_bytes(), 0
    for bit in rng.integers(0, 8 * len(whole), FLIPS).tolist():
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        try:
            _ = open_run(folder).dataset
        except RunError:
            continue
        silent += 1
    return [_none(f"estimates.nc: changed bits of {FLIPS} that are not detected", silent)]


@contextmanager
def _variable(name: str) -> Iterator[None]:
    """Set an environment variable within a context."""
    os.environ[name] = "a secret"
    try:
        yield
    finally:
        del os.environ[name]


def _variables(folder: Path) -> list[Check]:
    """Check that a case never gets a variable that the command line does not allow."""
    sent = 0
    for name, allowed in (("MY_SECRET", ()), ("MY_SECRET", ("OTHER",)), ("LIVEPDE_TOKEN", ())):
        source = f'mqtt = {{ rows = ["a"], port = 1, password_env = "{name}" }}'
        with _variable(name):
            case = _case(folder, source)
            try:
                passwords_of(case, True, allowed)
            except CaseError:
                continue
            sent += 1
    return [_none("password_env: variables sent without leave", sent)]
