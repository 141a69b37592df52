"""The update law of a case."""

from __future__ import annotations

from typing import TypeVar

from livepde.cases.case_channels import noise_of, unknowns_of
from livepde.cases.case_frame import Frame
from livepde.cases.schema import AutoSpec, GradientSpec, SensitivitySpec
from livepde.errors import LawError
from livepde.laws import (
    AnyLaw,
    AutoLaw,
    ConstantDamping,
    Damping,
    GradientLaw,
    Guards,
    Jumps,
    Replay,
    ResidualDamping,
    SensitivityLaw,
    Shadows,
)

__all__ = ["law_of"]

Options = TypeVar("Options")


def law_of(frame: Frame) -> AnyLaw:
    """Return the law; raises `CaseError`."""
    spec = frame.spec.law
    with frame.located("law", LawError):
        if isinstance(spec, GradientSpec):
            return _gradient(spec)
        return _auto(frame, spec) if isinstance(spec, AutoSpec) else _sensitivity(frame, spec)


def _gradient(spec: GradientSpec) -> GradientLaw:
    damping: Damping = ResidualDamping(1.0 if spec.c1 is None else spec.c1)
    if spec.mu is not None:
        damping = ConstantDamping(spec.mu)
    return GradientLaw(spec.gain, damping, nu=spec.nu, sigma=spec.sigma)


def _auto(frame: Frame, spec: AutoSpec) -> AutoLaw:
    noise = None if spec.noise is None else _level(frame, spec.noise)
    shadows = _chosen(Shadows, spec.shadows)
    return AutoLaw(spec.modes, noise, gate=spec.gate, shadows=shadows)


def _sensitivity(frame: Frame, spec: SensitivitySpec) -> SensitivityLaw:
    time = frame.equation.time_unit
    memory = frame.positive(spec.memory, time, "law.memory", SensitivityLaw.memory)
    drift = frame.convert(spec.drift, f"1/{time}" if time else "", "law.drift")
    return SensitivityLaw(
        spec.modes,
        _noise(frame, spec),
        drift,
        memory,
        _chosen(Replay, spec.replay),
        gate=spec.gate,
        jumps=_jumps(frame, spec),
        guards=_chosen(Guards, spec.guards),
        shadows=_chosen(Shadows, spec.shadows),
        verdict=spec.verdict,
    )


def _jumps(frame: Frame, spec: SensitivitySpec) -> Jumps | None:
    """Return the test for jumps: of all unknowns (true), of some (names), or with options."""
    given = spec.jumps
    found = Jumps(unknowns=given) if isinstance(given, tuple) else _chosen(Jumps, given)
    known = [*frame.spec.unknowns, *unknowns_of(frame)]
    key = "law.jumps" if isinstance(given, tuple) else "law.jumps.unknowns"
    for name in (found.unknowns if found is not None else None) or ():
        frame.require(name, known, key, f"there is no unknown '{name}'")
    return found


def _chosen(kind: type[Options], given: bool | Options) -> Options | None:
    """Return options of a law that a case has as true (the defaults), false or a table."""
    if isinstance(given, bool):
        return kind() if given else None
    return given


def _noise(frame: Frame, spec: SensitivitySpec) -> float | str | None:
    """Return the noise of the law, which needs it here or from every sensor."""
    if spec.noise is not None and spec.noise != "auto":
        return _level(frame, spec.noise)
    if noise_of(frame, "sensor") is None:
        if spec.noise == "auto":
            text = "got 'auto', which begins with a guess: give every sensor its noise."
            raise frame.error("law.noise", text)
        raise frame.missing(
            "law.noise",
            "the sensitivity law weighs the sensors by their noise (a standard deviation); "
            "give it here or with every sensor.",
        )
    return None if spec.noise is None else "auto"


def _level(frame: Frame, noise: float | str) -> float:
    return frame.positive(noise, frame.equation.state.unit, "law.noise")
