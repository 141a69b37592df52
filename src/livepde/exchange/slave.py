"""Slave class of the exporters (pythonfmu) for FMI 2.0 and 3.0."""

from __future__ import annotations

import atexit
import copy
import gc
import importlib
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from livepde import __version__
from livepde.exchange.fmu_export import FOLDER, opened
from livepde.exchange.unit_process import PERIOD, STATUS, Component, ScalarVariable, UnitProcess
from livepde.units import in_si

if not sys.orig_argv:
    # If the host program is not Python, the exporters finalise the interpreter from their own
    # thread. Its final garbage collection has crashed there, depending on the memory layout. The
    # collection is not needed, since the memory is released anyway.
    atexit.register(gc.freeze)


class IdentifierSlave:
    """Co-simulation slave; its class has `Fmi2Slave` or `Fmi3Slave` as second base.

    `fmi`: 2 or 3.
    """

    fmi: int
    log: Callable[..., None]  # method of the second base, like the next
    register_variable: Callable[..., None]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        process = opened(Path(options["resources"]) / FOLDER)
        self.component = Component(process)
        self.description = process.title
        if (times := process.experiment) is not None:
            experiment = self._kit("DefaultExperiment")
            self.default_experiment = experiment(times.start, times.stop, times.step)
        self._units: dict[str, str] = {}
        self._register(process)

    def _kit(self, name: str) -> Any:
        """Return a class of the exporter: DefaultExperiment, or {}Status such as Fmi2Status."""
        exporter = "pythonfmu" if self.fmi == 2 else "pythonfmu3"
        module = f"{exporter}.enums" if name == "{}Status" else exporter
        return getattr(importlib.import_module(module), name.format(f"Fmi{self.fmi}"))

    def _register(self, process: UnitProcess) -> None:
        causality, variability = self._kit("{}Causality"), self._kit("{}Variability")
        real, whole = (("Real", "Integer"), ("Float64", "Int32"))[self.fmi - 2]
        unit = self.component

        def put(k: int, value: float) -> None:
            unit.inputs[k] = value

        def add(kind: str, item: ScalarVariable, cause: Any, get: Any, **more: Any) -> None:
            about = {"description": item.text, "causality": cause, "getter": get, **more}
            about.setdefault("variability", variability.discrete)
            self.register_variable(self._kit(kind)(item.name, **about), nested=False)
            self._units[item.name] = item.unit

        # FMI 3.0 requires the independent variable as a variable; FMI 2.0 omits it.
        if self.fmi == 3:
            time = ScalarVariable("time", "s", "Time.")
            add(real, time, causality.independent, float, variability=variability.continuous)
        for k, port in enumerate(process.inputs):
            add(real, port, causality.input, lambda k=k: unit.inputs[k], setter=partial(put, k))
        for k, item in enumerate(process.outputs()):
            add(real, item, causality.output, lambda k=k: unit.outputs[k])
        item = ScalarVariable("status", "", STATUS)
        add(whole, item, causality.output, lambda: unit.status)
        item = ScalarVariable(PERIOD, "s", "Time between samples; 0: every step takes one.")
        about = {"setter": partial(setattr, unit, "period"), "variability": variability.fixed}
        add(real, item, causality.parameter, lambda: unit.period, **about)

    def to_xml(self, *options: Any) -> Element:
        """Return the model description, with elements that the exporter omits."""
        root: Element = super().to_xml(*options)  # type: ignore[misc]
        root.set("variableNamingConvention", "flat")
        root.set("generationTool", f"livepde {__version__} by {root.get('generationTool')}")
        if any(self._units.values()):
            # The schema of FMI requires the units directly after the kind of the interface.
            root.insert(1, _definitions(set(self._units.values()) - {""}))
        for variable in root.findall("ModelVariables/*"):
            real = variable.find("Real") if self.fmi == 2 else variable
            if real is None:
                continue
            if unit := self._units[variable.attrib["name"]]:
                real.set("unit", unit)
            if real.get("start") == "nan":
                real.set("start", "NaN")  # notation of XML
        outputs = root.find("ModelStructure/Outputs")
        if self.fmi == 2 and outputs is not None:
            # FMI 2.0 lists outputs a second time: those that have a value after initialisation.
            unknown = Element("InitialUnknowns")
            unknown.extend(copy.deepcopy(list(outputs)))
            root.find("ModelStructure").append(unknown)  # type: ignore[union-attr]
        return root

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Use the inputs as the sample of the current time; errors set the status output."""
        warning_text = self.component.take(current_time)
        if warning_text:
            self.log(warning_text, self._kit("{}Status").warning)
        return True

    def _get_fmu_state(self) -> bytes:
        return self.component.dump()

    def _set_fmu_state(self, state: bytes) -> None:
        self.component.restore(state)

    @staticmethod
    def _fmu_state_to_bytes(state: bytes) -> bytes:
        return state

    @staticmethod
    def _fmu_state_from_bytes(state: bytes) -> bytes:
        return state


def _definitions(units: Iterable[str]) -> Element:
    """Return the definitions of units of measurement in SI base units, where they exist."""
    found = Element("UnitDefinitions")
    for name in sorted(units):
        unit, si = SubElement(found, "Unit", name=name), in_si(name)
        if si is not None:
            powers = {base: str(power) for base, power in si.exponents.items()}
            SubElement(unit, "BaseUnit", powers, factor=repr(si.factor), offset=repr(si.offset))
    return found
