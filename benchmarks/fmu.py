"""Compare a co-simulation unit (FMU), run by FMPy, with the identifier it was created from.

Both process the samples of a case, and all outputs are compared after each sample.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from livepde.cases import Case, load
from livepde.cases.new_case import write_template
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import ConfigurationError, RunError
from livepde.exchange import export_fmu
from livepde.exchange.unit_process import UnitProcess, of_case
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.progress import watched
from livepde.records import STATUS_CODES
from livepde.runs import Outcome
from livepde.samples import Sample

CLOSE = 1e-10  # largest relative difference of an output between unit and identifier


def fmu(
    case: Case | None = None,
    unit: Path | None = None,
    *,
    fmi: Literal[2, 3] = 2,
    samples: int | None = None,
    progress: bool = False,
) -> Outcome:
    """Compare the unit of a case with the identifier of the case.

    Parameters
    ----------
    case
        Default: the case that `livepde init` writes.
    unit
        Unit of the case; by default a new unit is written.
    fmi
        Version of the standard for a new unit.
    samples
        Number of samples; default all samples of the case.
    progress
        Show the progress of both runs, if standard error is a terminal.
    """
    with TemporaryDirectory() as folder:
        if case is None:
            case = load(write_template(Path(folder) / "rod")[0])
        if unit is None:
            unit = export_fmu(case, Path(folder) / "unit.fmu", fmi=fmi)
        comparison = compare_fmu(unit, case, samples=samples, progress=progress)
    rows = [[name, value] for name, value in comparison.differences.items()]
    title = f"Unit and identifier after each of {comparison.samples} samples"
    table = Table(title, ["output", "largest relative difference"], rows)
    check = Check("largest relative difference", comparison.largest, CLOSE, "<=")
    return Outcome(tables=[table], checks=[check])


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences between a unit and the identifier it was created from.

    Attributes
    ----------
    samples
        Number of samples that both processed.
    differences
        Output -> largest difference over all samples, relative to the largest value; NaN if a value
        is NaN in only one of the two.
    """

    samples: int
    differences: dict[str, float]

    @property
    def largest(self) -> float:
        """Largest difference of all outputs; NaN if a difference is NaN."""
        return float(np.max(list(self.differences.values())))


def compare_fmu(
    unit: str | Path, case: Case, *, samples: int | None = None, progress: bool = False
) -> Comparison:
    """Run a case in its unit and in an identifier, and compare their outputs.

    Parameters
    ----------
    samples
        Number of samples; default all.
    progress
        Show the progress of both runs, if standard error is a terminal.

    Raises
    ------
    ConfigurationError
        FMPy is missing, or the case reads a live source.
    RunError
        The unit does not run.
    """
    if case.live:
        raise ConfigurationError(
            f"{case.path}: the comparison requires data that end, and the case reads a live "
            "source. Set another data.file."
        )
    prepared = case.prepare()
    process = of_case(case, prepared.origin)
    given = list(islice(prepared.stream, samples))
    names = [*(item.name for item in process.outputs()), "status"]

    def collect(rows: Iterator[list[float]], what: str) -> Array:
        return np.array(list(watched(rows, len(given), what) if progress else rows))

    expected = collect(_stepped(prepared.identifier, process, given), "in Python")
    actual = collect(_driven(unit, process, given), "in the unit")
    return Comparison(len(given), dict(zip(names, _apart(expected, actual), strict=True)))


def _apart(expected: Array, actual: Array) -> list[float]:
    """Return the largest difference of each column, relative to its largest value."""
    both = np.isnan(expected) & np.isnan(actual)
    apart = np.where(both, 0.0, np.abs(actual - expected)).max(axis=0)
    size = np.where(np.isnan(expected), 0.0, np.abs(expected)).max(axis=0)
    relative: list[float] = (apart / np.where(size > 0.0, size, 1.0)).tolist()
    return relative


def _stepped(
    identifier: Identifier, process: UnitProcess, samples: list[Sample]
) -> Iterator[list[float]]:
    """Yield the expected outputs, those of the identifier, after each sample."""
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z)
        yield [*process.shown(identifier, estimate), STATUS_CODES.index(estimate.status.code)]


def _driven(unit: str | Path, process: UnitProcess, samples: list[Sample]) -> Iterator[list[float]]:
    """Run the unit, and yield its outputs after each sample."""
    inputs = [port.name for port in process.inputs]
    outputs = [*(item.name for item in process.outputs()), "status"]
    times = [sample.t / process.second for sample in samples]
    steps = [*np.diff(times).tolist(), 1.0]
    with running(unit, times[0]) as instance:
        for sample, t, step in zip(samples, times, steps, strict=True):
            z = dict(sample.z)  # type: ignore[arg-type]
            values = [port.given(z.get(port.name, math.nan)) for port in process.inputs]
            instance.set(inputs, values)
            instance.step(t, step)
            yield instance.get(outputs)


class Instance:
    """Running unit whose variables are accessed by name.

    Attributes
    ----------
    fmu, description
        FMPy's objects for the unit and for its model description.
    messages
        Messages that the unit logged.
    """

    def __init__(self, fmu: Any, description: Any, messages: list[str]) -> None:
        self.fmu = fmu
        self.description = description
        self.messages = messages
        self._variables = {item.name: item for item in description.modelVariables}
        self._set = fmu.setReal if description.fmiVersion == "2.0" else fmu.setFloat64

    def set(self, names: Sequence[str], values: Sequence[float]) -> None:
        """Set input variables."""
        self._set([self._variables[name].valueReference for name in names], list(values))

    def get(self, names: Sequence[str]) -> list[float]:
        """Return the values of output variables."""
        values = []
        for name in names:
            variable = self._variables[name]
            read = getattr(self.fmu, f"get{variable.type}")
            values.append(float(read([variable.valueReference])[0]))
        return values

    def step(self, t: float, size: float) -> None:
        """Take a communication step."""
        self.fmu.doStep(currentCommunicationPoint=t, communicationStepSize=size)


@contextmanager
def running(unit: str | Path, start: float) -> Iterator[Instance]:
    """Provide a running unit that starts at a time. Requires FMPy.

    Raises
    ------
    ConfigurationError
        FMPy is missing.
    RunError
        The unit cannot be read, or does not run.
    """
    try:
        import fmpy
        from fmpy.fmi1 import FMICallException
    except ImportError:
        raise ConfigurationError("Running a unit requires FMPy: pip install fmpy.") from None
    messages: list[str] = []

    def log(*entry: Any) -> None:
        messages.append(entry[-1].decode())

    folder = fmpy.extract(str(unit))
    try:
        try:
            description = fmpy.read_model_description(folder)
            fmu = fmpy.instantiate_fmu(
                folder, description, "CoSimulation", debug_logging=True, logger=log
            )
        except Exception as error:
            raise RunError(f"{unit} does not run: {' '.join([*messages, str(error)])}.") from error
        try:
            if description.fmiVersion == "2.0":
                fmu.setupExperiment(startTime=start)
                fmu.enterInitializationMode()
            else:
                fmu.enterInitializationMode(startTime=start)
            fmu.exitInitializationMode()
            yield Instance(fmu, description, messages)
            fmu.terminate()
        finally:
            fmu.freeInstance()
    except FMICallException as error:
        raise RunError(f"{unit} does not run: {' '.join([*messages, str(error)])}.") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
