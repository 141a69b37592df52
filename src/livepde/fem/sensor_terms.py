"""Terms of slow sensors in the forms of a model."""

from __future__ import annotations

from collections.abc import Mapping

from livepde.fem.fields import Integrand, On
from livepde.fem.forms import Form
from livepde.fem.sensor_states import SensorMeasure, SensorState


class SensorTerms:
    """Terms of slow sensors in the forms of a model, M u' + B(u) + A(u) q = F.

    `form_M`: mass form of the fields.
    """

    def __init__(self, sensors: Mapping[str, SensorState], form_M: Form) -> None:
        self.mass: list[On] = []
        self.response: list[On] = []  # for known time constants
        self.unknown_response: list[On] = []
        if not sensors:
            return
        # The mass of a sensor state is the mean mass of a coefficient of the fields.
        weight = float(form_M.matrix("v", "u").diagonal().sum()) / form_M.spaces["u"].dim
        mesh, order = form_M.terms[0].measure.mesh, form_M.terms[0].measure.order
        for name, sensor in sensors.items():
            measure = SensorMeasure(mesh, order, name, sensor=name)
            self.mass.append(On(measure, lambda u, v, x: weight * u.shown * v.shown))
            if sensor.time_constant is None:
                self.unknown_response.append(On(measure, _unknown_response(name, weight)))
            else:
                self.response.append(On(measure, _response(weight / sensor.time_constant)))


def _response(rate: float) -> Integrand:
    return lambda u, v, x: rate * (u.shown - u.seen) * v.shown


def _unknown_response(sensor: str, weight: float) -> Integrand:
    return lambda q, u, v, x: weight * (u.shown - u.seen) * v.shown / q.time_constant[sensor]
