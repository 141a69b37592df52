"""Cost of a usual sample of the default `SensitivityLaw` on rods, in forward steps.

Samples 100 to 300 of a stream are timed individually. Afterwards, forward steps of the same model
are timed, with implicit Euler, a known parameter and a stored factorisation. Between samples, they
would miss the processor's caches. A sample is the same work in each run. Therefore its shortest
time over all runs counts, which excludes other load on the machine. A sample includes a refit if it
changes `Estimate.fit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import process_time
from typing import Any, TypeAlias

import numpy as np

from benchmarks.rods import Rod, forward_times
from livepde.diagnostics.check_report import Check, Table
from livepde.fleet import Fleet
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.linalg import Array, Mask
from livepde.runs import Outcome

BOUNDS: dict[tuple[int, int], float] = {
    (31, 2): 9.0,
    (200, 2): 9.0,
    (1_000, 2): 12.0,
    (31, 10): 12.0,
    (200, 10): 14.0,
    (1_000, 10): 24.0,
}
"""Nodes, unknowns -> bound on the median cost of a sample, in forward steps."""

FIRST, LAST = 100, 300  # first and last timed sample
MEAN = 1.3  # bound on the mean over the median
LARGEST = 60.0  # bound on the cost of a sample without a refit, in forward steps
RUNS = 5
MEMBERS, MEMBERS_NODES = 1_000, 31
MEMBER = 3.0  # bound on the mean cost of a sample of a fleet's member, in forward steps
NOTE = (
    "Default law: a forward step is livepde.simulate with implicit Euler and a stored "
    "factorisation. The shortest time of each sample over all runs counts, since its work is the "
    "same in each run. mean: with refits; largest: without refits."
)

Times: TypeAlias = tuple[Array, Mask, Array]
"""Times of samples, whether each sample had a refit, and times of forward steps."""


def usual_step(sizes: Sequence[int] = (), *, runs: int = RUNS, members: int = MEMBERS) -> Outcome:
    """Time samples of the default law on rods, and on a fleet.

    Parameters
    ----------
    sizes
        Numbers of nodes; empty: all numbers in `BOUNDS`.
    runs
        Number of runs of each rod.
    members
        Number of members of a fleet of rods with 31 nodes; 0: no fleet.
    """
    rows: list[tuple[Any, ...]] = []
    checks: list[Check] = []
    for (nodes, unknowns), bound in BOUNDS.items():
        if sizes and nodes not in sizes:
            continue
        given = Rod(nodes, unknowns, "source")
        spent, refits, forward = _timed(given, runs)
        costs = spent / np.median(forward)
        median, mean, usual = float(np.median(costs)), float(costs.mean()), costs[~refits]
        largest = float(usual.max())
        rows.append((nodes, unknowns, median, mean, float(usual.mean()), largest, bound))
        text = f"{given.title}, defaults: sample / forward step"
        checks += [
            Check(f"{text}, median", median, bound, "<="),
            Check(f"{text}, mean over median", mean / median, MEAN, "<="),
            Check(f"{text}, largest without a refit", largest, LARGEST, "<="),
        ]
    columns = ("nodes", "unknowns", "median", "mean", "mean, no refits", "largest", "bound")
    title = f"One sample of the default law over one forward step, samples {FIRST} to {LAST}"
    tables = [Table(title, columns, rows)] if rows else []
    if members and (not sizes or MEMBERS_NODES in sizes):
        median, mean = _fleet(members)
        text = f"fleet of {members} rods of {MEMBERS_NODES} nodes, defaults"
        checks.append(Check(f"{text}: sample of a member / forward step", mean, MEMBER, "<="))
        title = "One sample of a member of a fleet over one forward step"
        row = [(members, median, mean, MEMBER)]
        tables.append(Table(title, ("members", "median", "mean", "bound"), row))
    return Outcome(tables=tables, checks=checks, notes=[NOTE] if tables else [])


def _timed(given: Rod, runs: int) -> Times:
    """Return the shortest times of samples and forward steps over all runs."""
    samples, spent, forward = given.samples(LAST), [], []
    refits = np.zeros(LAST - FIRST + 1, dtype=bool)
    for _ in range(runs):
        identifier = Identifier(given.model, given.sensors, SensitivityLaw(), u0=0.0)
        fit, times = None, []
        for number, sample in enumerate(samples):
            begun = process_time()
            estimate = identifier.step(*sample)
            if number >= FIRST:
                times.append(process_time() - begun)
                refits[number - FIRST] |= estimate.fit != fit
            fit = estimate.fit
        spent.append(times)
        forward.append(forward_times(given, LAST))
    return np.min(spent, axis=0), refits, np.min(forward, axis=0)


def _fleet(members: int) -> tuple[float, float]:
    """Return median and mean cost of a sample per member of a fleet, in forward steps."""
    given = Rod(MEMBERS_NODES, 2, "source")
    fleet = Fleet(given.model, given.sensors, SensitivityLaw(), members, u0=0.0)
    spent = []
    for sample in given.samples_of_members(members, LAST):
        begun = process_time()
        fleet.step(*sample)
        spent.append(process_time() - begun)
    costs = np.array(spent[FIRST:]) / (members * np.median(forward_times(given, LAST)))
    return float(np.median(costs)), float(costs.mean())
