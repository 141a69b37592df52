"""Every finding appears in a run with its fault, and not in a correct run.

The list of findings is read from the source: a new one without its two runs fails here.
"""

import ast
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import test_broken_sensors as broken
import test_guards as guarded
import test_jumps as jumping
import test_latent_ends as latent
import test_modes_left_out as modes
import test_refit as refits
import test_run_warnings as warned
import test_step_choice as fronts
import test_verdict as rods
from factories import driven_rod, line, short_rod

import livepde as lp
from benchmarks.silent import unjudged
from livepde import cases
from livepde.cases.remedies import start_missed
from livepde.runs import clock_findings, input_findings, sampling_findings, verdict
from livepde.stepping import Advance, simulate
from livepde.verdict import Cause, Finding, Verdict, flat

SOURCE = Path(lp.__file__).parent
ISSUE = ("Finding", "_each")  # calls with the kind of a finding as their first argument


def issued() -> set[str]:
    """Return module and kind of each finding that the source can issue."""
    found = set()
    for path in SOURCE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if not any(f"{name}(" in text for name in ISSUE):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ISSUE and node.args:
                kind = node.args[0]
                if isinstance(kind, ast.Constant):
                    found.add(f"{path.stem}: {kind.value}")
    return found


# --- runs ----------------------------------------------------------------------------------------
# Each returns the kinds of findings of a run.


def kinds(found: Any) -> list[str]:
    return [finding.what for finding in found.findings]


def of_data(data: Any) -> list[str]:
    """Return the findings that the dataset of a run adds to those of its law."""
    return kinds(verdict(data))


@cache
def rod(change: str = "", **options: Any) -> list[str]:
    """Return the findings on the rod of `test_verdict`, with something done to its readings."""
    z = rods.shown() + rods.errors()
    places, names = None, {}
    if "gate" in options:
        options["law"] = lp.SensitivityLaw(gate=options.pop("gate"))
    match change:
        case "offset":
            z[:, 1] += 0.08
        case "spikes":
            z[40::12, 0] += 50.0
        case "stuck":
            z[100:, 0] = z[100, 0]
        case "slow noise":
            rng = np.random.default_rng(3)
            e = rng.standard_normal(z.shape)
            for k in range(1, len(e)):
                e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.81) * e[k]
            z = rods.shown() + rods.NOISE * e
        case "drifting unknown":
            part = np.linspace(0.0, 0.3, len(z))[:, None]
            z += part * (rods.shown(k=0.16) - rods.shown())
        case "another k at one sensor":
            z[:, 2] += (rods.shown(k=0.14) - rods.shown())[:, 2]
        case "far from the prior":
            z = rods.shown(k=0.4) + rods.errors()
        case "validation" | "validation in degF":
            clean = rods.shown(places=(0.25, 0.75, 0.5)) + rods.errors()
            W = 32.0 + 1.8 * clean[:, 2] if change.endswith("F") else clean[:, 2]
            names = {"A": clean[:, 0], "C": clean[:, 1], "W": W}
            places = {"A": 0.25, "C": 0.75}
            options["validation"] = lp.Points({"W": 0.5}, noise=rods.NOISE)
    return kinds(rods.run(names or z, places=places, **options)[1].verdict)


@cache
def mended(*, fault: bool) -> list[str]:
    count, rng = 700, np.random.default_rng(1)
    z = rods.shown(count=count) + rods.NOISE * rng.standard_normal((count, len(rods.PLACES)))
    if fault:
        z[150:300, 1] += 0.08
    identifier = rods.judged()
    for k in range(count):
        t = float(rods.TIMES[1] * k)
        estimate = identifier.step(t, z[k], {"T_left": rods.driven(t)})
    return kinds(estimate.verdict)


def ended(offset: float = 0.0) -> list[str]:
    """Return the findings at the end of a run with an offset of one sensor."""
    z = rods.shown() + rods.errors()
    z[:, 1] += offset
    result = rods.judged().run(rods.samples(z))
    assert result.last is not None
    return kinds(result.last.verdict)


def one_column(share: float) -> list[str]:
    """Return the findings of a run without a misfit, where a column explains a share of it."""
    cause = Cause("lag", "T", "sensor T is 3 late", share)
    return kinds(Verdict.of([]).with_causes([cause]))


@cache
def fed(*, gaps: bool = False, between: str = "line") -> list[str]:
    values = rods.driven(rods.TIMES)
    if gaps:
        values[1:][np.random.default_rng(5).random(len(values) - 1) < 0.3] = np.nan
    return kinds(rods.fed(values, between=between).verdict)


@cache
def disturbed(change: float) -> list[str]:
    """Return the findings while the diffusivity of a rod, a constant, has changed by a factor."""
    z = broken.readings(broken.FIRST + 40, change=change, after=broken.FIRST)
    return kinds(broken.run(z)[-1].verdict)


def counted(channel: str = "T", **counts: int) -> list[str]:
    """Return the findings on a channel, or on the rows, of a journal with 100 rows."""
    rows: Any = type("Rows", (list,), {})(range(100))
    rows.counts = {(kind, channel): number for kind, number in counts.items()}
    found = [*clock_findings(rows), *input_findings(rows, ["T"])]
    return [finding.what for finding in found]


def paused(gap: int = 0) -> list[str]:
    """Return the findings on the sampling of a run without so many of its rows."""
    samples = rods.samples(rods.shown() + rods.errors())
    del samples[40 : 40 + gap]
    result = rods.judged().run(samples)
    return [finding.what for finding in sampling_findings(result.to_xarray())]


@cache
def warned_of(prior: Any, **options: Any) -> list[str]:
    """Return the findings on the rod of `test_run_warnings` with some priors."""
    return of_data(warned.run(warned.rod(dict(prior)), warned.rod(lp.Normal(0.2)), **options))


ONE = (("a", lp.Normal(0.2, 0.1)),)
NARROW = (("a", lp.Normal(0.2, 0.1, bounds=(0.0, 0.25))),)
BESIDE = (*ONE, ("b", lp.Normal(1.0, 0.5)))
FAR = (("a", lp.LogNormal(3.0, 3.0)),)


@cache
def meshed(cells: int) -> list[str]:
    """Return the findings on a rod with some cells, and readings of one with 160."""
    unknowns = {"a": lp.Normal(0.2, 0.1)}
    fine, coarse = (driven_rod(unknowns, lambda t: 5 * np.sin(t), line(n)) for n in (160, cells))
    G = lp.Points(rods.PLACES).matrix(fine.state_space)
    truth = fine.initial_parameter({"a": 0.3})
    control = Advance(lp.Alexander2(), dt_max=0.01)
    rng, times = np.random.default_rng(0), (0.05 * np.arange(81)).tolist()
    samples = [
        (t, G @ u + 0.01 * rng.standard_normal(3))
        for t, u in simulate(fine, truth, 0.0, times, control)
    ]
    points = lp.Points(rods.PLACES, noise=0.01)
    return kinds(lp.Identifier(coarse, points, lp.SensitivityLaw(), u0=0.0).run(samples).verdict)


@cache
def unjudged_readings(*, spoiled: bool) -> list[str]:
    """Return the findings on a run without a verdict, in which a gate may refuse readings."""
    stream = jumping.samples(lambda t: 0.3, 120, 0)
    if spoiled:
        stream = [(t, z + 50.0 * (k % 15 == 14)) for k, (t, z) in enumerate(stream)]
    law = lp.SensitivityLaw(verdict=False, shadows=None)
    points = lp.Points(jumping.POINTS, noise=jumping.NOISE)
    return of_data(lp.Identifier(jumping.rod(), points, law, u0=0.0).run(stream).to_xarray())


@cache
def decayed(deviation: float, *, in_python: bool = False) -> list[str]:
    """Return the findings on a decay four times as fast as its prior, of some width."""
    far = [np.exp(-2.0 * (k + 1) * 0.1) for k in range(24)]
    unknown = lp.LogNormal(0.5, deviation)
    result = latent.run(latent.decay(unknown), latent.stream(far))
    if in_python:
        return [one.what for one in result.verdict.findings]
    return of_data(result.to_xarray())


@cache
def exploded(*, spoiled: bool) -> list[str]:
    """Return the findings on a law that has to guard itself against spoiled readings."""
    model = guarded.explosive()
    stream = [
        (t, z + 3.0 * (spoiled and 60 <= k < 70))
        for k, (t, z) in enumerate(guarded.samples(model, 2.0, 80))
    ]
    law = guarded.filter_alone(drift=0.1, gate=np.inf)
    return of_data(lp.Identifier(model, guarded.POINTS, law, u0=0.0).run(stream).to_xarray())


@cache
def jumped(change: float) -> list[str]:
    stream = jumping.samples(lambda t: 0.3 if t < 7.5 else 0.3 * change, 250, 0)
    law = lp.SensitivityLaw(jumps=lp.laws.Jumps(), shadows=None, verdict=False)
    points = lp.Points(jumping.POINTS, noise=jumping.NOISE)
    return of_data(lp.Identifier(jumping.rod(), points, law, u0=0.0).run(stream).to_xarray())


@cache
def fitted(**options: int) -> list[str]:
    """Return the findings on a column that a refit finds, unless it may take few passes."""
    refit = lp.laws.Refit(**options)
    who = refits.column(refits.PRIORS["far above"], refit=refit)
    return kinds(who.run(refits.stream()).last.verdict)


@cache
def guessed(factor: float) -> list[str]:
    """Return the findings on a law without refit that finds the noise, from a first guess."""
    law = lp.SensitivityLaw(noise="auto", refit=None, shadows=None)
    points = lp.Points(jumping.POINTS, noise=factor * jumping.NOISE)
    stream = jumping.samples(lambda t: 0.3, 60, 0)
    return kinds(lp.Identifier(jumping.rod(), points, law, u0=0.0).run(stream).verdict)


@cache
def stepped(**options: Any) -> list[str]:
    """Return the findings on a pipe with a front, of which some steps have to be short."""
    law = lp.SensitivityLaw(shadows=lp.laws.Shadows(**options))
    given = fronts.identifier(law)
    return kinds([given.step(*row) for row in fronts.rows()[:30]][-1].verdict)


def begun(t0: float) -> list[str]:
    """Return the findings on a rod with 30 samples a second apart, and an initial time."""
    model = lp.models.heat(lp.interval(0.0, 1.0, 10), lp.Normal(0.1, std=0.05))
    rod = lp.Identifier(model, lp.Points({"a": 0.5}, noise=0.1), lp.SensitivityLaw(), u0=0.0, t0=t0)
    return kinds([rod.step(1000.0 + k, [0.0]) for k in range(30)][-1].verdict)


def filled(*, rests: bool = False, gain: float = 1.0) -> list[str]:
    """Return the findings on the gradient law, with readings of all of a rod at 1 % of noise."""
    drive = (lambda t: 1.0 * (t < 5.0)) if rests else (lambda t: 1.0)
    model = guarded.reaction(drive)
    return of_data(guarded.learned(model, guarded.full(model, 300), gain=gain))


@cache
def gradient(diffusivity: float) -> list[str]:
    """Return the findings on a model with some D, and readings of finite differences with D = 1."""
    law = lp.GradientLaw(gain="auto")
    return kinds(unjudged.judged(law, 0.01, 0, unjudged.model(diffusivity)).verdict)


@dataclass(frozen=True)
class Pair:
    """A run in which a finding appears, and one in which it does not."""

    appears: Callable[[], list[str]]
    not_here: Callable[[], list[str]]


def missing(loss: float) -> list[str]:
    """Return the findings on a run without a verdict whose model lacks a loss."""
    truth = warned.rod(lp.Normal(0.2), loss=loss)
    return of_data(warned.run(warned.rod(lp.Normal(0.2, 0.1)), truth, verdict=False))


def started(initial: str) -> list[str]:
    """Return the finding on the start of a case that is doubted, and states an initial state."""
    with TemporaryDirectory() as folder:
        settings = {"initial": initial}
        prepared = cases.load(short_rod(Path(folder), 10), settings=settings).prepare()
        doubted = Verdict.of([Finding("misfit", "caution", "It misfits.")])
        return [finding.what for finding in start_missed(prepared, doubted)]


RUNS = {
    "remedies: start": Pair(partial(started, "90 degC"), partial(started, "interpolate")),
    "assess: misfit": Pair(partial(rod, "offset"), rod),
    "assess: following": Pair(partial(rod, "slow noise"), rod),
    "assess: start": Pair(partial(rod, u0=0.06), rod),
    "assess: past": Pair(partial(mended, fault=True), partial(mended, fault=False)),
    "assess: constancy": Pair(partial(rod, "drifting unknown"), rod),
    "assess: disagreement": Pair(partial(rod, "another k at one sensor"), rod),
    "assess: noise": Pair(partial(rod, stated=3.0), rod),
    # A gate that refuses nothing sets no sensor aside.
    "assess: stuck": Pair(partial(rod, "stuck", gate=np.inf), partial(rod, gate=np.inf)),
    "assess: aside": Pair(partial(rod, "stuck"), rod),
    "assess: changed": Pair(partial(disturbed, 0.5), partial(disturbed, 1.0)),
    "assess: refused": Pair(partial(rod, "spikes"), rod),
    "assess: prior": Pair(partial(rod, "far from the prior"), rod),
    "ledger: input": Pair(partial(fed, gaps=True), fed),
    "ledger: validation": Pair(partial(rod, "validation in degF"), partial(rod, "validation")),
    "findings: hold": Pair(partial(fed, between="next"), fed),
    "findings: discretisation": Pair(partial(meshed, 10), partial(meshed, 80)),
    "findings: effect": Pair(partial(ended, 0.08), ended),
    "findings: bound": Pair(partial(warned_of, NARROW), partial(warned_of, ONE)),
    "findings: flat": Pair(partial(warned_of, BESIDE), partial(warned_of, ONE)),
    "run_verdict: input": Pair(partial(counted, spike=2), counted),
    "run_verdict: clock": Pair(partial(counted, "", clock=1), partial(counted, spike=2)),
    "run_verdict: misfit": Pair(partial(missing, 3.0), partial(missing, 0.0)),
    "run_verdict: refused": Pair(
        partial(unjudged_readings, spoiled=True), partial(unjudged_readings, spoiled=False)
    ),
    "run_verdict: held": Pair(partial(decayed, 0.01), partial(decayed, 0.5)),
    "findings: held": Pair(
        partial(decayed, 0.01, in_python=True), partial(decayed, 0.5, in_python=True)
    ),
    "run_verdict: left out": Pair(
        lambda: of_data(modes.ran(4).to_xarray()), lambda: of_data(modes.ran(41).to_xarray())
    ),
    "run_verdict: guards": Pair(partial(exploded, spoiled=True), partial(exploded, spoiled=False)),
    "run_verdict: gain": Pair(partial(filled, gain=1e4), filled),
    "run_verdict: pause": Pair(partial(paused, 30), paused),
    "run_verdict: jump": Pair(partial(jumped, 0.7), partial(jumped, 1.0)),
    "equation_tests: rest": Pair(partial(filled, rests=True, gain=100.0), filled),
    "equation_tests: misfit": Pair(partial(gradient, 2.0), partial(gradient, 1.0)),
    "findings: misfit": Pair(partial(one_column, 0.9), partial(one_column, 0.2)),
    "verdict: fit": Pair(partial(fitted, start=0, passes=1), fitted),
    "verdict: noise": Pair(partial(guessed, 0.1), partial(guessed, 1.0)),
    "verdict: step": Pair(partial(stepped, parts=2), stepped),
    "verdict: start": Pair(partial(begun, 0.0), partial(begun, 999.0)),
    "verdict: untested": Pair(partial(stepped, mesh=False, parts=1), stepped),
    "verdict: steps": Pair(partial(gradient, 2.0), partial(gradient, 1.0)),
}


@pytest.mark.slow
def test_every_finding_of_the_source_has_its_two_runs():
    assert issued() == set(RUNS)


# Runs that take seconds each: before a release.
LONG = {
    "assess: misfit",
    "assess: past",
    "equation_tests: misfit",
    "findings: bound",
    "findings: effect",
    "run_verdict: gain",
    "run_verdict: guards",
    "run_verdict: held",
    "run_verdict: jump",
    "run_verdict: misfit",
    "run_verdict: pause",
    "findings: discretisation",
    "verdict: step",
}
EACH = [pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in RUNS]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH)
def test_a_finding_appears_where_it_should_and_nowhere_else(name: str):
    kind = name.partition(": ")[2]
    assert kind in RUNS[name].appears()
    assert kind not in RUNS[name].not_here()


@pytest.mark.parametrize("severity", ["caution", "do not trust"])
def test_an_interval_that_a_gross_misfit_widens_does_not_ask_for_longer_data(severity):
    misfit = Finding("misfit", severity, "It misfits.")
    verdict = Verdict.of([misfit]).with_findings([flat("k", 1.0)])
    (found,) = (one for one in verdict.findings if one.what == "flat")
    assert ("longer data" in found.sentence) == (severity == "caution")
    assert ("cause of the misfit" in found.sentence) == (severity == "do not trust")
    assert verdict.with_findings([flat("k", 1.0)]) == verdict
