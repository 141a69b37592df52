"""Comparison of the paper's law with two related laws on the same data.

Exact discrete data of the paper's example and the excited twin, with full and partial observation.
The laws are Boiger and Kaltenbacher (2016), and Baumeister et al. (1997) and Kügler (2010) as their
paper describes them. They share model, observation and coupled stage; each has one gain and three
pulls, and the strict steps of `livepde.paper`. Slopes at the ends of the interval are free.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from experiments.related_laws import BaumeisterLaw, KueglerLaw
from livepde import paper, plots
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import LawError
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, ResidualDamping
from livepde.observation import Full, Observation, Subdomain
from livepde.reproduce import seed, seed_excited
from livepde.reproduce.experiment import Track, failures, track
from livepde.runs import Outcome

PULLS = (0.1, 1.0, 10.0)
SOURCES: dict[str, tuple[Any, float]] = {  # problem -> (module, gain)
    "seed": (seed, 1e4),
    "seed-excited": (seed_excited, 1e3),
}
LAWS = ("Boiger, Kaltenbacher", "Baumeister et al.", "Kügler")
Key = tuple[str, str, str, float]
"""Problem, observation, law, pull."""


def law(name: str, gain: float, pull: float) -> AnyLaw:
    """Return a law by its name; the pull is c_1 of the paper's rule, or mu."""
    if name == LAWS[0]:
        return paper.law(gain, ResidualDamping(pull))
    return (BaumeisterLaw if name == LAWS[1] else KueglerLaw)(gain, pull, paper.STRICT)


def observations() -> dict[str, Observation]:
    """Return full and partial observation by name."""
    return {"full": Full(), "partial": Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))}


def compare(
    problems: Iterable[str], progress: bool = False
) -> tuple[dict[Key, Track], list[list[Any]], str]:
    """Run every law on each problem; return runs, table rows, and the message of the refusal."""
    tracks: dict[Key, Track] = {}
    rows: list[list[Any]] = []
    refusal = ""
    for problem in problems:
        source, gain = SOURCES[problem]
        full = source.twin_of(observation=Full())
        for seen, observation in observations().items():
            twin = replace(full, observation=observation)
            for name in LAWS:
                for pull in PULLS:
                    head = [problem, seen, name, gain, pull, twin.baseline(0.0)]
                    try:
                        identifier = Identifier(
                            full.model,
                            observation,
                            law(name, gain, pull),
                            q0=0.0,
                            u0=source.start,
                            halvings=0,
                        )
                    except LawError as error:
                        refusal = str(error)
                        rows.append([*head, "refused", *[None] * 5])
                        break
                    run = track(identifier, twin, f"{name}, {problem}, {seen}", progress)
                    tracks[problem, seen, name, pull] = run
                    errors = [run.error(t) for t in (1.0, 6.0, 60.0)]
                    rows.append([*head, *errors, run.u_error, run.divided, run.failed])
    return tracks, rows, refusal


def relatives(*, quick: bool = False, progress: bool = False) -> Outcome:
    """Compare the three laws, and check their errors.

    Parameters
    ----------
    quick
        Use only the data of the paper's example.
    progress
        Show a progress bar for every run.
    """
    tracks, rows, refusal = compare(["seed"] if quick else SOURCES, progress)
    columns = ["data", "seen", "law", "gain", "pull", "q = 0", "t = 1", "t = 6", "t = 60"]
    table = Table(
        "relative L2 error of q; pull: c1 (Boiger, Kaltenbacher) or mu",
        [*columns, "error of u", "divided steps", "failed steps"],
        rows,
    )
    checks = [
        Check(
            f"largest error of q at t = 60, {problem}, {seen}, {name}",
            max(tracks[problem, seen, name, pull].error(60.0) for pull in PULLS),
            bound,
            "<=",
        )
        for (problem, seen, name), bound in EXPECTED.items()
        if problem == "seed" or not quick
    ]
    checks.append(failures(tracks.values()))
    checks.append(Check("Baumeister et al. refuse partial data", float(bool(refusal)), 1.0, ">="))
    return Outcome(
        tables=[table],
        checks=checks,
        notes=[
            "With all of the state observed, Baumeister's law is the paper's with a pull of fixed "
            "size, theta = mu instead of c1 ||r||_X^2 / ||r||_VX~^2 <= c1: the paper's rule pulls "
            "rough residuals less, so that q learns from more of r.",
            "Kügler's law evaluates C at u^, not at the data: the diffusion itself damps the error "
            "of the state, so its mu hardly matters, and u is estimated better; q learns from "
            "smaller residuals, hence more slowly.",
            "At mu = 1 the two relatives nearly coincide when D = 1: B(z) + A_0(u^ - z) = "
            "B(u^) + (u^ - z) for A_0 = B + 1; what remains is A(z) against A(u^).",
            f"Refused: {refusal}",
        ],
        dataset=next(iter(tracks.values())).result.to_xarray(),
        figures={"error": partial(_figure, tracks)},
    )


def _figure(tracks: dict[Key, Track]) -> Any:
    """Plot the error of q over time for pull 1, one panel per problem and observation."""
    panels = list(dict.fromkeys((problem, seen) for problem, seen, *_ in tracks))
    drawn, axes = plots.figure(len(panels) // 2, 2, "Relative L2 error of q, pull 1")
    for ax, (problem, seen) in zip(axes, panels, strict=True):
        series = {
            name: (found.times, found.errors)
            for name in LAWS
            if (found := tracks.get((problem, seen, name, 1.0))) is not None
        }
        plots.history(series, ylabel="error of q", levels={"q = 0": 1.0}, ax=ax)
        ax.set_title(f"{problem}, {seen} data")
    return drawn


# Upper bounds on the largest relative L2 error of q at t = 60 over the pulls 0.1, 1 and 10. The
# paper's law with partial data of `seed` measured 0.072, with the splitting by integrals.
EXPECTED = {
    ("seed", "full", "Boiger, Kaltenbacher"): 0.05,
    ("seed", "full", "Baumeister et al."): 0.10,
    ("seed", "full", "Kügler"): 0.07,
    ("seed", "partial", "Boiger, Kaltenbacher"): 0.075,
    ("seed", "partial", "Kügler"): 0.12,
    ("seed-excited", "full", "Boiger, Kaltenbacher"): 0.05,
    ("seed-excited", "full", "Baumeister et al."): 0.25,
    ("seed-excited", "full", "Kügler"): 0.08,
    ("seed-excited", "partial", "Boiger, Kaltenbacher"): 0.20,
    ("seed-excited", "partial", "Kügler"): 0.25,
}
