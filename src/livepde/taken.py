"""Last sample of an identifier, and counts of all its samples for the verdict."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde import checkpoint
from livepde.dates import stamp_of
from livepde.errors import ConfigurationError, SampleError, TimeOrderError
from livepde.fem import Inputs
from livepde.laws import Status
from livepde.laws.verdict import StepLedger
from livepde.linalg import Array
from livepde.linalg.member_arrays import changed
from livepde.samples import number
from livepde.stepping import Advance, End
from livepde.units import conversion
from livepde.verdict import InputLedger, ValidationLedger

INPUTS = ("inputs", "known")


@dataclass(frozen=True, eq=False, kw_only=True)
class TakenSamples:
    """Time and values of the last accepted sample, and counts of all samples for the verdict."""

    t: float
    z: Array
    inputs: Inputs
    known: Inputs  # last known inputs; inputs with "hold" also from samples of failed steps
    samples: int  # number of samples, including failed steps
    origin: float  # seconds from 1970 to t = 0 if times are dates; NaN if they are numbers
    validation: ValidationLedger
    gaps: InputLedger
    steps: StepLedger

    @classmethod
    def start(cls, t0: float, sensors: int, validation: int, inputs: int) -> TakenSamples:
        """Return the value before the first sample."""
        missing = Inputs({})
        return cls(
            t=float(t0),
            z=np.full(sensors, np.nan),
            inputs=missing,
            known=missing,
            samples=0,
            origin=math.nan,
            validation=ValidationLedger.start(validation),
            gaps=InputLedger.start(inputs),
            steps=StepLedger.start(),
        )

    def placed(
        self, ends: Mapping[str, Array], names: tuple[str, ...], samples: int
    ) -> TakenSamples:
        """Return the value for a member of a fleet from its `Fleet.ends`; `names`: its inputs."""
        counts = ends["held_counts"].astype(np.int64)
        return changed(
            self,
            t=float(ends["t"]),
            z=ends["z"],
            samples=samples,
            gaps=InputLedger(counts, ends["held"], ends["unstated"]),
            steps=StepLedger(ends["steps"].astype(np.int64), np.zeros(2)),
            **{part: _named(names, ends[part], strict=bool(names)) for part in INPUTS},
        )

    @property
    def last(self) -> End:
        """The last accepted sample, at which the next interval begins."""
        return End(t=self.t, inputs=self.inputs, z=self.z)

    def counted(self, t: Any, unit: str) -> tuple[Any, float]:
        """Return a number or date as a time in the unit of the model, and the origin of dates."""
        if type(t) is float or (stamp := stamp_of(t)) is None:
            return t, self.origin
        return self.since(stamp, unit)

    def since(self, stamp: float, unit: str) -> tuple[float, float]:
        """Return the time of a date, given in seconds since 1970, and the origin of dates."""
        if not unit:
            raise ConfigurationError(
                "the time is a date, and the model has no unit of time: name it, as in "
                'Model(..., time_unit="s").'
            )
        second = conversion("s", unit, "time_unit").factor
        if not self.samples:
            return self.t, stamp - self.t / second
        if math.isnan(self.origin):
            raise SampleError(
                "the time is a date, and those of the samples before are numbers: give numbers."
            )
        return (stamp - self.origin) * second, self.origin

    def time_of_next(self, t: float) -> float:
        """Return the validated time of the next sample; only the first may be at t0."""
        if type(t) is not float or not math.isfinite(t):
            t = number(t, "time t")
            if math.isnan(t):
                raise SampleError("time t is NaN; give the time of the sample.")
        if t < self.t and not self.samples:
            raise TimeOrderError(
                f"the sample at t = {t!r} is before the initial time t0 = {self.t!r}: set `t0`."
            )
        if t < self.t or (t == self.t and self.samples):
            raise TimeOrderError(
                f"the sample at t = {t!r} is not later than the last one at t = {self.t!r}: "
                "sort the stream, and drop repeated samples."
            )
        return t

    def begun(
        self, inputs: Inputs, unstated: Collection[str], names: tuple[str, ...]
    ) -> TakenSamples:
        """Return the value at the start; `unstated`: names of inputs without an initial value."""
        mask = np.array([name in unstated for name in names], dtype=float)
        gaps = InputLedger(self.gaps.counts, self.gaps.held, mask)
        return changed(self, inputs=inputs, known=inputs, gaps=gaps)

    def after(
        self, end: End, status: Status, missing: Array, control: Advance, origin: float
    ) -> TakenSamples:
        """Return the value after a step; `missing`: 1 for each input that holds its last value."""
        length = end.t - self.t
        steps = self.steps.add(status.code, length, control.stretches(length))
        counted = changed(self, samples=self.samples + 1, origin=origin, steps=steps)
        if not status.taken:  # an input with "hold" may have no further reading
            held = {name: end.inputs[name] for name in control.held.last}
            return changed(counted, known=Inputs({**self.known, **held}))
        gaps = self.gaps.add(length, missing) if len(missing) else self.gaps
        return changed(counted, t=end.t, z=end.z, inputs=end.inputs, known=end.inputs, gaps=gaps)

    @property
    def leaves(self) -> dict[str, Any]:
        """Leaves for a checkpoint."""
        return {
            "t": self.t,
            "z": self.z,
            "samples": self.samples,
            **{part: np.array(list(getattr(self, part).values())) for part in INPUTS},
            "validation": self.validation.sums,
            "validation_last": self.validation.last,
            "held_counts": self.gaps.counts,
            "held": self.gaps.held,
            "steps": self.steps.counts,
            "lengths": self.steps.lengths,
            "origin": self.origin,
            "unstated": self.gaps.unstated,
        }

    def restored(self, leaves: Mapping[str, Array], names: tuple[str, ...]) -> TakenSamples:
        """Return the value stored in leaves of a checkpoint; raise `KeyError` or `ValueError`."""
        names = names if len(leaves["inputs"]) else ()
        counts = leaves["held_counts"].astype(np.int64)
        return TakenSamples(
            t=float(leaves["t"]),
            samples=int(leaves["samples"]),
            origin=float(leaves["origin"]),
            z=checkpoint.rebuild(self.z, leaves, "z"),
            validation=ValidationLedger(leaves["validation"], leaves["validation_last"]),
            gaps=InputLedger(counts, leaves["held"], leaves["unstated"]),
            steps=StepLedger(leaves["steps"].astype(np.int64), leaves["lengths"]),
            **{part: _named(names, leaves[part], strict=True) for part in INPUTS},
        )


def _named(names: tuple[str, ...], values: Array, *, strict: bool) -> Inputs:
    return Inputs(dict(zip(names, values.tolist(), strict=strict)))
