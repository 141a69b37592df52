"""Run a co-simulation unit as another program does, beside the identifier it was made of.

Both take the samples of a case, and all outputs are compared after each of them.
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

CLOSE = 1e-10  # relative difference of any output, between the unit and the identifier


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
        Default the one that `livepde init` writes.
    unit
        Of the case; default one that is written for the purpose.
    fmi
        Version of the standard of a unit that is written.
    samples
        How many of the case are taken; default all.
    progress
        Show how far each of both is, if standard error is a terminal.
    """
    with TemporaryDirectory() as folder:
        if case is None:
            case = load(write_template(Path(folder) / "rod")[0])
        if unit is None:
            unit = export_fmu(case, Path(folder) / "unit.fmu", fmi=fmi)
        found = compare_fmu(unit, case, samples=samples, progress=progress)
    rows = [[name, value] for name, value in found.differences.items()]
    title = f"Unit and identifier after each of {found.samples} samples"
    table = Table(title, ["output", "largest relative difference"], rows)
    check = Check("largest relative difference", found.largest, CLOSE, "<=")
    return Outcome(tables=[table], checks=[check])


@dataclass(frozen=True, eq=False)
class Comparison:
    """How far a unit is from the identifier it was made of.

    Attributes
    ----------
    samples
        How many both took.
    differences
        Output -> largest difference over all samples, relative to the largest value; NaN if only
        one of both is NaN somewhere.
    """

    samples: int
    differences: dict[str, float]

    @property
    def largest(self) -> float:
        """The largest of all, NaN if one is."""
        return float(np.max(list(self.differences.values())))


def compare_fmu(
    unit: str | Path, case: Case, *, samples: int | None = None, progress: bool = False
) -> Comparison:
    """Give samples of a case to its unit, by FMPy, and to an identifier: two runs of the case.

    Parameters
    ----------
    samples
        How many; default all.
    progress
        Show how far each of both is, if standard error is a terminal.

    Raises
    ------
    ConfigurationError
        FMPy is missing, or the case has no data of its own.
    RunError
        The unit does not run.
    """
    if case.live:
        raise ConfigurationError(
            f"{case.path}: the unit is compared on the data of the case, and its source goes "
            "on: set another data.file."
        )
    prepared = case.prepare()
    process = of_case(case, prepared.origin)
    given = list(islice(prepared.stream, samples))
    names = [*(item.name for item in process.outputs()), "status"]

    def taken(rows: Iterator[list[float]], what: str) -> Array:
        return np.array(list(watched(rows, len(given), what) if progress else rows))

    expected = taken(_stepped(prepared.identifier, process, given), "in Python")
    found = taken(_driven(unit, process, given), "in the unit")
    return Comparison(len(given), dict(zip(names, _apart(expected, found), strict=True)))


def _apart(expected: Array, found: Array) -> list[float]:
    """Return by how much columns differ, relative to their largest value."""
    both = np.isnan(expected) & np.isnan(found)
    apart = np.where(both, 0.0, np.abs(found - expected)).max(axis=0)
    size = np.where(np.isnan(expected), 0.0, np.abs(expected)).max(axis=0)
    relative: list[float] = (apart / np.where(size > 0.0, size, 1.0)).tolist()
    return relative


def _stepped(
    identifier: Identifier, process: UnitProcess, samples: list[Sample]
) -> Iterator[list[float]]:
    """Yield what the outputs have to be after each sample."""
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z)
        yield [*process.shown(identifier, estimate), STATUS_CODES.index(estimate.status.code)]


def _driven(unit: str | Path, process: UnitProcess, samples: list[Sample]) -> Iterator[list[float]]:
    """Yield the outputs after each sample."""
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
    """A unit that FMPy runs, its variables by name.

    Attributes
    ----------
    fmu, description
        As FMPy has them.
    messages
        What the unit has logged.
    """

    def __init__(self, fmu: Any, description: Any, messages: list[str]) -> None:
        self.fmu = fmu
        self.description = description
        self.messages = messages
        self._variables = {item.name: item for item in description.modelVariables}
        self._set = fmu.setReal if description.fmiVersion == "2.0" else fmu.setFloat64

    def set(self, names: Sequence[str], values: Sequence[float]) -> None:
        """Set inputs."""
        self._set([self._variables[name].valueReference for name in names], list(values))

    def get(self, names: Sequence[str]) -> list[float]:
        """Return outputs."""
        found = []
        for name in names:
            variable = self._variables[name]
            read = getattr(self.fmu, f"get{variable.type}")
            found.append(float(read([variable.valueReference])[0]))
        return found

    def step(self, t: float, size: float) -> None:
        """Take a step."""
        self.fmu.doStep(currentCommunicationPoint=t, communicationStepSize=size)


@contextmanager
def running(unit: str | Path, start: float) -> Iterator[Instance]:
    """Run a unit from a time on; needs FMPy.

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
        raise ConfigurationError("Running a unit needs FMPy: pip install fmpy.") from None
    messages: list[str] = []

    def heard(*told: Any) -> None:
        messages.append(told[-1].decode())

    folder = fmpy.extract(str(unit))
    try:
        try:
            description = fmpy.read_model_description(folder)
            fmu = fmpy.instantiate_fmu(
                folder, description, "CoSimulation", debug_logging=True, logger=heard
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
