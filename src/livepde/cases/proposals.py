"""Variants of a case that are worth a try: likely causes of its verdict, and usual suspects."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from livepde.cases.read import settings_in, toml_key, toml_value
from livepde.cases.remedies import freed
from livepde.cases.variants import Variant, VariantRun
from livepde.streams import DataTable
from livepde.verdict import Cause, channel_setting

if TYPE_CHECKING:
    from livepde.cases.case import Case, Prepared

MOST = 12  # variants that the program chooses
PLACE = 0.01  # of the length of the domain: how far off a sensor may be
SAMPLES = 64  # in which a source moves the state by the usual error
NAMES = {  # kind of cause -> name of the variant
    "offset": "offset of {}",
    "gain": "gain of {}",
    "position": "position of {}",
    "jump": "jumps of {}",
    "source": "source",
    "loss": "loss",
    "flux": "flux at {}",
    "boundary": "offset of {}",
    "initial": "uncertain start",
    "sensor": "without {}",
    "stuck": "without {}",
    "unit": "unit of {}",
}


def proposed(prepared: Prepared, base: VariantRun, most: int = MOST) -> list[Variant]:
    """Return variants of a case, the likely causes of its verdict first, each once.

    Parameters
    ----------
    base
        The run of the case itself.
    """
    found: dict[frozenset[str], Variant] = {}
    for variant in (*_of_causes(base), *_usual(prepared, base)):
        if variant.settings:
            # The same keys with another prior are no other variant.
            keys = frozenset(setting.partition("=")[0] for setting in variant.settings)
            found.setdefault(keys, variant)
    return list(found.values())[:most]


def _of_causes(base: VariantRun) -> Iterator[Variant]:
    for cause in base.causes:
        name = NAMES.get(cause.kind, cause.kind + " of {}").format(cause.subject)
        yield Variant(name, settings_in(cause.setting))


def _usual(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over what is often missing or too much in a case."""
    case = prepared.case
    if case.spec.law.kind != "sensitivity":
        return
    yield from _process(prepared, base)
    yield from _sensors(prepared, base)
    yield from _fewer(case)
    yield from _layers(case)
    known = {name: size for name, size in base.misfits.items() if math.isfinite(size)}
    if len(known) > 2:
        worst = max(known, key=lambda name: known[name])
        yield Variant(f"without {worst}", (channel_setting(worst, "role", '"ignored"'),))
    if not case.spec.law.jumps and base.estimates:
        yield Variant("jumps", ("law.jumps=true",))


def _usual_error(base: VariantRun) -> float:
    """Return the median error of the assimilated sensors."""
    known = [size for size in base.errors.values() if math.isfinite(size)]
    return float(np.median(known)) if known else math.nan


def _process(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over terms that the process may lack."""
    error, table = _usual_error(base), prepared.raw
    if not (isinstance(table, DataTable) and len(table) > 1 and error > 0.0):
        return
    time = SAMPLES * float(np.median(np.diff(table.t)))
    for kind, size in (("source", error / time), ("loss", 0.1 / time)):
        yield Variant(kind, freed(prepared, Cause(kind, "", "", size=size)))
    values = [Cause("boundary", name, "", size=error) for name in prepared.case.roles("boundary")]
    offsets = [setting for cause in values for setting in freed(prepared, cause)]
    if offsets:
        yield Variant("offsets of the boundary values", tuple(offsets))
    for name in map(str, prepared.case.mesh.boundaries or {}):
        flux = freed(prepared, Cause("flux", name, "", size=error / time))
        yield Variant(f"flux at {name}", flux)


def _sensors(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over errors that all sensors may have."""
    error = _usual_error(base)
    length = float(np.ptp(prepared.case.mesh.p, axis=1).max())
    sizes = {"offset": error, "position": PLACE * length}
    words = {"offset": "offsets of all sensors", "position": "positions of all sensors"}
    for kind, size in sizes.items():
        causes = [Cause(kind, name, "", size=size) for name in prepared.case.sensors]
        settings = [setting for cause in causes for setting in freed(prepared, cause)]
        if settings and len(causes) > 1:
            yield Variant(words[kind], tuple(settings))


def _fewer(case: Case) -> Iterator[Variant]:
    """Iterate over the case with fewer unknowns."""
    for key, word in (("offset", "offsets"), ("gain", "gains"), ("at_std", "uncertain positions")):
        stated = [n for n, one in case.roles("sensor").items() if getattr(one, key) is not None]
        yield Variant(f"no {word}", tuple(channel_setting(name, key, "") for name in stated))
    used = {
        value
        for item in (*case.spec.boundary.values(), *case.spec.sources.values())
        for value in vars(item).values()
        if isinstance(value, str)
    }
    for name, unknown in case.spec.unknowns.items():
        key = f"unknowns.{toml_key(name)}"
        if unknown.regions:
            yield Variant(f"one {name} everywhere", (f"{key}.regions=",))
        known = case.equation.unknowns.get(name)
        if known is not None and known.optional and name not in used and name != "C":
            yield Variant(f"no {name}", (f"{key}=",))


def _layers(case: Case) -> Iterator[Variant]:
    """Iterate over unknowns with two layers, with their border at the middle of the sensors."""
    if len(case.mesh.p) != 1:
        return
    low, high = float(case.mesh.p.min()), float(case.mesh.p.max())
    places = getattr(case.observation, "positions", None)
    inner = np.asarray(places, dtype=float).ravel() if places is not None else np.empty(0)
    middle = float(np.median(inner)) if len(inner) else 0.5 * (low + high)
    nodes = np.sort(case.mesh.p[0])[1:-1]
    if not len(nodes):
        return
    border = float(nodes[np.abs(nodes - middle).argmin()])
    for name, unknown in case.spec.unknowns.items():
        own = next(iter(case.equation.unknowns), "") == name
        if own and not unknown.regions and not unknown.field:
            layers = {"lower": [low, border], "upper": [border, high]}
            setting = f"unknowns.{toml_key(name)}.regions={toml_value(layers)}"
            yield Variant(f"two layers of {name}", (setting,))
