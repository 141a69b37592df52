"""Proposed variants of a case: likely causes of a misfit first, then common errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import chain, pairwise, product

import numpy as np

from livepde.cases.case import Case, Prepared
from livepde.cases.case_channels import noise_of
from livepde.cases.process import unread_without
from livepde.cases.read import parse, settings_in, toml_key, toml_value
from livepde.cases.remedies import (
    first_miss,
    freed,
    held,
    later_start,
    switching,
    usual_shift,
)
from livepde.cases.variants import Variant, VariantRun
from livepde.errors import ModelError
from livepde.fem.field_blocks import base_name
from livepde.streams import DataTable
from livepde.verdict import Cause, channel_setting

MOST_LAYERS = 8
MOST = 14  # default number of proposed variants
SAMPLES = 64  # samples in which a source changes the state by the usual error
NAMES = {  # kind of cause -> name of the variant
    "offset": "offset of {}",
    "gain": "gain of {}",
    "position": "position of {}",
    "response": "time constant of {}",
    "averaging": "length of {}",
    "jump": "jumps of {}",
    "layers": "layers of {}",
    "source": "source",
    "loss": "loss",
    "channel": "gain of {}",
    "flux": "flux at {}",
    "transfer": "heat transfer at {}",
    "boundary": "offset of {}",
    "initial": "uncertain start",
    "sensor": "without {}",
    "stuck": "without {}",
    "drift": "without {}",
    "unit": "unit of {}",
}


def proposed(prepared: Prepared, base: VariantRun, most: int = MOST) -> list[Variant]:
    """Return up to `most` distinct variants, the likely causes in the verdict `base` first."""
    found: dict[frozenset[str], Variant] = {}
    for variant in _candidates(prepared, base):
        if variant.settings:
            # The same keys with another prior are the same variant, unless layers differ.
            keys = (setting.partition("=")[0] for setting in variant.settings)
            layers = [setting for setting in variant.settings if ".regions=" in setting]
            found.setdefault(frozenset((*keys, *layers)), variant)
    return list(found.values())[:most]


def _candidates(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over likely causes, then over common errors of a case."""
    case = prepared.case
    # An initial state that differs from the first readings resembles many other errors.
    if first_miss(prepared) > _usual_error(base):
        yield Variant(NAMES["initial"], freed(prepared, Cause("initial", "", "")))
    # Linear interpolation of an input that switches also resembles many other errors.
    for name in _switching(prepared, base):
        yield Variant(f"{name} held", (channel_setting(name, "between", '"hold"'),))
    if later := later_start(prepared):
        yield Variant("later start", (later,))
    for cause in base.causes:
        name = NAMES.get(cause.kind, cause.kind + " of {}").format(cause.subject)
        yield Variant(name, settings_in(cause.setting))
    if case.spec.law.kind != "sensitivity":
        if noise_of(case):
            yield Variant("Kalman filter", case.with_intervals)
        return
    yield from _process(prepared, base)
    yield from _layers(case)
    yield from _sensors(prepared, base)
    yield from _fewer(case)
    yield from _without_worst(base)
    if not case.spec.law.jumps and base.estimates:
        yield Variant("jumps", ("law.jumps=true",))


def _switching(prepared: Prepared, base: VariantRun) -> list[str]:
    """Return the inputs that may switch, by their values or by a lag among the causes."""
    table = prepared.raw
    names = switching(prepared.case, table) if isinstance(table, DataTable) else []
    return names + [cause.subject for cause in base.causes if held(prepared, cause)]


def _without_worst(base: VariantRun) -> Iterator[Variant]:
    """Iterate over at most one variant: without the sensor with the largest misfit."""
    known = {name: size for name, size in base.misfits.items() if math.isfinite(size)}
    if len(known) > 2:
        worst = max(known, key=lambda name: known[name])
        yield Variant(f"without {worst}", (channel_setting(worst, "role", '"ignored"'),))


def _usual_error(base: VariantRun) -> float:
    """Return the median prediction error of the assimilated sensors; NaN if unknown."""
    known = [size for size in base.errors.values() if math.isfinite(size)]
    return float(np.median(known)) if known else math.nan


def _process(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over variants with terms that may be missing in the process."""
    error, table = _usual_error(base), prepared.raw
    if not (isinstance(table, DataTable) and len(table) > 1 and error > 0.0):
        return
    time = SAMPLES * float(np.median(np.diff(table.t)))
    yield from _sources(prepared, error / time, time)
    yield Variant("loss", freed(prepared, Cause("loss", "", "", size=0.1 / time)))
    causes = (Cause("boundary", name, "", size=error) for name in prepared.case.roles("boundary"))
    if offsets := tuple(chain.from_iterable(freed(prepared, cause) for cause in causes)):
        yield Variant("offsets of the boundary values", offsets)
    yield from _at_boundaries(prepared, {"flux": error / time, "transfer": 0.1 / time})


def _sources(prepared: Prepared, size: float, time: float) -> Iterator[Variant]:
    """Iterate over variants with a source: constant, with jumps, or changing within `time`."""
    source, law = freed(prepared, Cause("source", "", "", size=size)), prepared.case.spec.law
    if not source:
        return
    yield Variant("source", source)
    if law.kind != "sensitivity":  # estimating changes requires a covariance
        return
    if not law.jumps:
        yield Variant("source that jumps", (*source, 'law.jumps=["source"]'))
    yield Variant("source that changes", (*source, _walking("source", source[0], time)))


def _at_boundaries(prepared: Prepared, terms: Mapping[str, float]) -> Iterator[Variant]:
    """Iterate over variants with a missing term at a boundary; `terms`: kind -> size."""
    for name, (kind, size) in product(map(str, prepared.case.mesh.boundaries or {}), terms.items()):
        settings = freed(prepared, Cause(kind, name, "", size=size))
        yield Variant(NAMES[kind].format(name), settings)


def _walking(name: str, added: str, time: float) -> str:
    """Return the setting of a random walk that changes by the prior std of the unknown in `time`.

    `added`: the setting that adds the unknown.
    """
    (spec,) = parse([added]).values()
    walk = {"kind": "random-walk", "rate": float(f"{spec['std'] / math.sqrt(time):.2g}")}
    return f"unknowns.{toml_key(name)}.evolution={toml_value(walk)}"


def _sensors(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over variants with an unknown error of every sensor."""
    # All positions share one prior, which has to be plausible for each of them.
    shifts = [usual_shift(prepared, name) for name in prepared.case.sensors]
    for kind, size in (("offset", _usual_error(base)), ("position", min(shifts, default=math.nan))):
        # Sensors of a flux are left out: `size` is an error of the state.
        sensors = [n for n, one in prepared.case.roles("sensor").items() if not one.is_flux]
        causes = [Cause(kind, name, "", size=size) for name in sensors]
        settings = [setting for cause in causes for setting in freed(prepared, cause)]
        if settings and len(causes) > 1:
            yield Variant(f"{kind}s of all sensors", tuple(settings))


def _fewer(case: Case) -> Iterator[Variant]:
    """Iterate over variants with fewer unknowns."""
    words = {"offset": "offsets", "gain": "gains", "at_std": "uncertain positions"}
    for key, word in {**words, "time_constant": "time constants"}.items():
        stated = [n for n, one in case.roles("sensor").items() if getattr(one, key) is not None]
        yield Variant(f"no {word}", tuple(channel_setting(name, key, "") for name in stated))
    optional = _optional(case)
    for name, unknown in case.spec.unknowns.items():
        key = f"unknowns.{toml_key(name)}"
        gone = _references(case, name)
        if unknown.regions:
            yield Variant(f"one {name} everywhere", (f"{key}.regions=", *gone))
        if name in optional:
            with suppress(ModelError):  # the equation requires it or an alternative to it
                unread = [f"{own}=" for own in unread_without(case, name)]
                yield Variant(f"no {name}", (f"{key}=", *unread, *gone))


def _references(case: Case, name: str) -> list[str]:
    """Return the settings that remove the references of an unknown."""
    known = [label for label in case.spec.reference if base_name(label) == name]
    return [f"reference.{toml_key(label)}=" for label in known]


def _optional(case: Case) -> set[str]:
    """Return the optional unknowns of the equation that no condition or source uses."""
    optional = {name for name, known in case.equation.unknowns.items() if known.optional}
    for item in (*case.spec.boundary.values(), *case.spec.sources.values()):
        optional -= {value for value in vars(item).values() if isinstance(value, str)}
    return optional - {"C"}


def _layers(case: Case) -> Iterator[Variant]:
    """Iterate over variants of the first unknown with two layers, or one for each sensor."""
    name = next(iter(case.equation.unknowns), "")
    unknown = case.spec.unknowns.get(name)
    if unknown is None or unknown.regions or unknown.field:
        return
    for what, layers in _divisions(case).items():
        setting = f"unknowns.{toml_key(name)}.regions={toml_value(layers)}"
        yield Variant(f"{what} of {name}", (setting, *_references(case, name)))


def _divisions(case: Case) -> dict[str, dict[str, list[float]]]:
    """Return divisions of the mesh into two layers, and into one layer for each sensor."""
    nodes = np.sort(case.mesh.p[0])[1:-1]
    if len(case.mesh.p) != 1 or not len(nodes):
        return {}
    low, high = float(case.mesh.p.min()), float(case.mesh.p.max())
    places = getattr(case.observation, "positions", None)
    inner = np.unique(np.asarray(() if places is None else places, dtype=float).ravel())
    middle = float(np.median(inner)) if len(inner) else 0.5 * (low + high)
    borders = 0.5 * (inner[1:] + inner[:-1])
    near = [float(nodes[np.abs(nodes - one).argmin()]) for one in (middle, *borders)]
    found = {"two layers": {"lower": [low, near[0]], "upper": [near[0], high]}}
    many = [low, *sorted(set(near[1:])), high]
    if 3 < len(many) <= 1 + MOST_LAYERS:
        each = enumerate(pairwise(many), 1)
        found["layers"] = {f"layer_{number}": list(ends) for number, ends in each}
    return found
