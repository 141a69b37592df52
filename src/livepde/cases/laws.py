"""The update law of a case."""

from __future__ import annotations

from typing import TypeVar

from livepde.cases.case_channels import noise_of, unknowns_of
from livepde.cases.case_content import CaseContent
from livepde.cases.schema import GradientSpec, SensitivitySpec
from livepde.errors import LawError
from livepde.laws import (
    AnyLaw,
    ConstantDamping,
    Damping,
    GradientLaw,
    Guards,
    Jumps,
    Refit,
    ResidualDamping,
    SensitivityLaw,
    Shadows,
)

Options = TypeVar("Options")


def law_of(case: CaseContent) -> AnyLaw:
    """Return the law; raises `CaseError`."""
    spec = case.spec.law
    with case.located("law", LawError):
        if isinstance(spec, GradientSpec):
            return _gradient(spec)
        return _sensitivity(case, spec)


def _gradient(spec: GradientSpec) -> GradientLaw:
    damping: Damping = ResidualDamping(1.0 if spec.c1 is None else spec.c1)
    if spec.mu is not None:
        damping = ConstantDamping(spec.mu)
    return GradientLaw(spec.gain, damping, nu=spec.nu, sigma=spec.sigma)


def _sensitivity(case: CaseContent, spec: SensitivitySpec) -> SensitivityLaw:
    time = case.equation.time_unit
    memory = case.positive(spec.memory, time, "law.memory", SensitivityLaw.memory)
    drift = case.convert(spec.drift, f"1/{time}" if time else "", "law.drift")
    return SensitivityLaw(
        modes=spec.modes,
        noise=_noise(case, spec),
        drift=drift,
        memory=memory,
        refit=_chosen(Refit, spec.refit),
        rank=spec.rank,
        gate=spec.gate,
        gate_patience=spec.gate_patience,
        jumps=_jumps(case, spec),
        guards=_chosen(Guards, spec.guards),
        shadows=_chosen(Shadows, spec.shadows),
        verdict=spec.verdict,
    )


def _jumps(case: CaseContent, spec: SensitivitySpec) -> Jumps | None:
    """Return the test for jumps: of all unknowns (true), of some (names), or with options."""
    given = spec.jumps
    found = Jumps(unknowns=given) if isinstance(given, tuple) else _chosen(Jumps, given)
    known = [*case.spec.unknowns, *unknowns_of(case)]
    key = "law.jumps" if isinstance(given, tuple) else "law.jumps.unknowns"
    for name in (found.unknowns if found is not None else None) or ():
        case.require(name, known, key, f"there is no unknown '{name}'")
    return found


def _chosen(kind: type[Options], given: bool | Options) -> Options | None:
    """Return options of a law that a case has as true (the defaults), false or a table."""
    if isinstance(given, bool):
        return kind() if given else None
    return given


def _noise(case: CaseContent, spec: SensitivitySpec) -> float | str | None:
    """Return the noise of the law, which needs it here or from every sensor."""
    if spec.noise is not None and spec.noise != "auto":
        return _level(case, spec.noise)
    if noise_of(case, "sensor") is None:
        if spec.noise == "auto":
            text = "got 'auto', which begins with a guess: give every sensor its noise."
            raise case.error("law.noise", text)
        raise case.missing(
            "law.noise",
            "the sensitivity law weighs the sensors by their noise (a standard deviation); "
            "give it here or with every sensor.",
        )
    return None if spec.noise is None else "auto"


def _level(case: CaseContent, noise: float | str) -> float:
    return case.positive(noise, case.equation.state.unit, "law.noise")
