"""State of a co-simulation unit: an identifier with its present inputs and outputs."""

from __future__ import annotations

import math

import numpy as np

from livepde import checkpoint
from livepde.errors import LivepdeError
from livepde.exchange.unit_process import REFUSED, WAITING, UnitProcess
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.records import STATUS_CODES
from livepde.samples import Sample

# Difference of times that is attributed to rounding, relative to the period.
SAME = 1e-9


class Component:
    """Co-simulation component: one sample per communication point; bad samples set a status.

    Parameters
    ----------
    process
        UnitProcess that it runs.

    Attributes
    ----------
    inputs
        Present values of the channels, NaN if missing.
    period
        Sampling period in seconds: the first step of each period takes a sample. 0: every step.
    outputs, status
        Output values, in the order of `UnitProcess.outputs`, and status code of the last step.
    """

    def __init__(self, process: UnitProcess) -> None:
        self.process = process
        self.inputs = [math.nan] * len(process.inputs)
        self.outputs = process.unknown()
        self.status = WAITING
        self.period = 0.0
        self._next = -math.inf
        self._first = np.zeros(0)
        self._identifier: Identifier | None = None

    def take(self, seconds: float) -> str:
        """Take the present inputs as the sample of a time; return a message for the user, or ''."""
        if self.period > 0.0 and seconds < self._next:
            return ""
        process, t = self.process, seconds * self.process.second
        try:
            z = self._sample()
            if z is None:
                return ""
            if self._identifier is None:
                self._identifier = self._begun(np.array([t, *z.values()]))
            estimate = self._identifier.step(t, z)
            if self.period > 0.0:
                # Sample times are multiples of the period, with a tolerance: rounding of
                # communication times must neither skip nor repeat a sample.
                self._next = self.period * (math.floor(seconds / self.period + SAME) + 1.0 - SAME)
        except LivepdeError as error:
            if math.isnan(self.outputs[0]):  # the first one: the next may begin
                self._identifier = None
            self.status = WAITING if self._identifier is None else REFUSED
            return f"t = {seconds:g} s: {error}"
        self.status = STATUS_CODES.index(estimate.status.code)
        self.outputs = process.shown(self._identifier, estimate)
        return "" if estimate.status.ok else f"t = {seconds:g} s: {estimate.status}"

    def dump(self) -> bytes:
        """Return the complete state; `restore` continues with identical numbers."""
        leaves = {"inputs": self.inputs, "outputs": self.outputs, "status": self.status}
        leaves |= {"period": self.period, "next": self._next}
        if self._identifier is not None:
            leaves["first"] = self._first
            leaves["identifier"] = np.frombuffer(self._identifier.dump(), dtype=np.uint8)
        return checkpoint.packed({}, leaves)

    def restore(self, content: bytes) -> None:
        """Restore a state returned by `dump`; raise `RunError` if it is of another unit."""
        where = "the state of the unit"
        _, leaves = checkpoint.unpacked(content, where)
        self.inputs, self.outputs = leaves["inputs"].tolist(), leaves["outputs"].tolist()
        self.status = int(leaves["status"])
        self.period, self._next = float(leaves["period"]), float(leaves["next"])
        if "identifier" not in leaves:
            self._identifier = None
            return
        # A new identifier is built only if the state began with another sample.
        if self._identifier is None or not np.array_equal(
            self._first, leaves["first"], equal_nan=True
        ):
            self._identifier = self._begun(leaves["first"])
        self._identifier.restore(leaves["identifier"].tobytes(), where)

    def _sample(self) -> dict[str, float] | None:
        """Return the inputs in the model's units, NaN if missing; None without a needed one."""
        ports, missing = self.process.inputs, self.process.missing
        given = zip(ports, self.inputs, strict=True)
        z = {port.name: port.taken(value, missing) for port, value in given}
        # A case leaves out rows of its data without a needed channel, too.
        lost = any(math.isnan(z[port.name]) for port in ports if port.column.needed)
        return None if lost else z

    def _begun(self, first: Array) -> Identifier:
        """Return the identifier started by a first sample: its time, then the inputs."""
        self._first = first
        names = [port.name for port in self.process.inputs]
        z = dict(zip(names, first[1:].tolist(), strict=True))
        return self.process.begin(Sample(t=float(first[0]), z=z))
