"""Cost of a sample of the sensitivity law on rods, in forward steps, and of a lean reference.

A run times each of the first samples of a stream, and then as many forward steps of the same model
with a known parameter. Runs of all candidates alternate. The median of a run describes usual
samples; the mean includes the first sample and the refits of the start. Both are divided by the
median forward step. The tables show medians over the runs.

Bounds are in forward steps of an earlier version, so that a faster forward step does not tighten
them. `EARLIER` lists the forward step of that version in forward steps of the lean reference. These
depend only on NumPy, SciPy and the processor, and are timed in the same runs.
`python -m benchmarks.earlier` measures `EARLIER`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from time import process_time
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse.linalg as spla

from benchmarks import lean
from benchmarks.layered import ENDS, POINTS, STEP, ends_at, plate, rod
from livepde.diagnostics.check_report import Check, Table
from livepde.fem import Inputs, Moment
from livepde.fleet import Fleet
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Points
from livepde.runs import Outcome
from livepde.stepping import Advance, ImplicitEuler, simulate

SIZES = (31, 200, 1_000, 10_000)
SQUARE = 10_000  # number of nodes from which the process is a square
FIRST = 100  # samples of a run, including the first one
RUNS = 5
NOISE = 0.01
COMMIT = "51ef98c"
SENSITIVITY, LEAN = "SensitivityLaw", "lean reference"

BOUNDS: dict[tuple[int, int], float] = {
    (31, 2): 5.0,
    (200, 2): 4.0,
    (1_000, 2): 4.5,
    (31, 10): 6.0,
    (200, 10): 6.0,
    (1_000, 10): 9.0,
    (SQUARE, 4): 5.0,
}
"""Nodes, unknowns -> bound on the cost of a sample, in forward steps of the earlier version."""

EARLIER: dict[tuple[int, str], float] = {
    (31, "source"): 3.83,
    (31, "channels"): 4.41,
    (200, "source"): 2.46,
    (200, "channels"): 2.69,
    (1_000, "source"): 1.29,
    (1_000, "channels"): 1.37,
    (SQUARE, "source"): 0.925,
}
"""Nodes, ends -> forward step of the earlier version, in forward steps of the lean reference."""

FLEET = 1.5  # bound on the cost of a fleet relative to the lean reference
MEMBERS, MEMBERS_NODES = 50, 31

Row: TypeAlias = tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Rod:
    """Rod or square with a stream of samples.

    Parameters
    ----------
    nodes, unknowns
        Number of nodes of the mesh, and of layers of the rod; a square has four quarters.
    ends
        "source" or "channels", see `benchmarks.layered`.
    """

    nodes: int
    unknowns: int
    ends: str

    @cached_property
    def model(self) -> Model:
        """Model of the process."""
        if self.nodes >= SQUARE:
            return plate(self.nodes)
        return rod(self.nodes, self.unknowns, self.ends)

    @cached_property
    def sensors(self) -> Points:
        """Four point sensors on a rod, nine on a square."""
        square = [(x, y) for x in (0.2, 0.5, 0.8) for y in (0.2, 0.5, 0.8)]
        return Points(square if self.nodes >= SQUARE else list(POINTS), noise=NOISE)

    def forward(self, q: Array, count: int) -> Iterator[tuple[float, Array]]:
        """Simulate, and yield times and states, starting with the initial state."""
        times = (STEP * np.arange(count + 1)).tolist()
        inputs = {t: ends_at(self.ends, t) for t in times}.__getitem__
        return simulate(self.model, q, 0.0, times, Advance(ImplicitEuler()), inputs)

    def samples(self, count: int, seed: int = 0) -> list[tuple[float, Array, dict[str, float]]]:
        """Return time, measurements and channels of the start and of `count` samples."""
        rng, latent = np.random.default_rng(seed), self.model.latent
        q = latent.prior + latent.deviations * rng.standard_normal(latent.dim)
        G = self.sensors.matrix(self.model.state_space)
        return [
            (t, G @ u + NOISE * rng.standard_normal(G.shape[0]), ends_at(self.ends, t))
            for t, u in self.forward(q, count)
        ]

    def samples_of_members(
        self, members: int, count: int
    ) -> list[tuple[float, Array, dict[str, float]]]:
        """Return samples of a fleet with measurements of shape (members, sensors)."""
        streams = [self.samples(count, seed) for seed in range(members)]
        return [
            (row[0][0], np.array([z for _, z, _ in row]), row[0][2])
            for row in zip(*streams, strict=True)
        ]

    @cached_property
    def matrices(self) -> lean.Matrices:
        """Matrices of the lean reference for the process."""
        return lean.Matrices.of(self.model, np.diag(self.model.latent.deviations), STEP)

    @property
    def title(self) -> str:
        """Name of the process in checks."""
        kind = "square" if self.nodes >= SQUARE else "rod"
        return f"{kind} of {self.nodes} nodes, {self.unknowns} unknowns, {self.ends}"


RODS: tuple[Rod, ...] = (
    *(Rod(nodes, m, ends) for nodes in SIZES[:3] for m in (2, 10) for ends in ENDS),
    Rod(SQUARE, 4, "source"),
)
"""Timed processes."""


# --- candidates: functions that return the times of the samples of a run, in s -------------------


def _law(given: Rod, samples: Sequence[Any]) -> list[float]:
    """Time samples of the sensitivity law."""
    identifier = Identifier(given.model, given.sensors, SensitivityLaw(), u0=0.0)
    identifier.step(*samples[0])
    spent = []
    for sample in samples[1:]:
        begun = process_time()
        identifier.step(*sample)
        spent.append(process_time() - begun)
    return spent


def forward_times(given: Rod, count: int) -> list[float]:
    """Time forward steps of the model at its prior."""
    states, spent = given.forward(given.model.latent.prior, count), []
    next(states)
    for _ in range(count):
        begun = process_time()
        next(states)
        spent.append(process_time() - begun)
    return spent


def _lean(given: Rod, samples: Sequence[Any]) -> list[float]:
    """Time samples of the lean reference."""
    spent, matrices = [], given.matrices
    G = given.sensors.matrix(given.model.state_space).toarray()[:, matrices.order] / NOISE
    start = given.model.initial(0.0, _moment(samples[0]))
    state = lean.initial(matrices, start, 1, given.unknowns)
    for sample in samples[1:]:
        begun = process_time()
        z = sample[1][None] / NOISE
        state = lean.step(matrices, G, state, matrices.forcing(_moment(sample)), z)
        spent.append(process_time() - begun)
    return spent


def _moment(sample: Any) -> Moment:
    return Moment(sample[0], Inputs(sample[2]))


def lean_forward(given: Rod, count: int) -> list[float]:
    """Time forward steps in NumPy and SciPy, with a stored factorisation and a constant source."""
    solve, mass = _stepper(given)
    f, u, spent = given.model.F(), np.zeros(given.model.X.dim), []
    for _ in range(count):
        begun = process_time()
        u = solve(mass @ u + f)
        spent.append(process_time() - begun)
    return spent


def _stepper(given: Rod) -> tuple[Callable[[Array], Array], Any]:
    """Return a solver for the right-hand side of a step, and the mass matrix over the time step."""
    if given.nodes < SQUARE:
        matrices = given.matrices
        lu = matrices.factorise(np.zeros((1, given.unknowns)))
        return lambda known: matrices.solve(lu, known[None])[0], matrices.M
    mass, S = lean.assembled(given.model, given.model.latent.prior, STEP)
    return spla.splu(S.tocsc(), permc_spec="MMD_AT_PLUS_A").solve, mass


# --- tables --------------------------------------------------------------------------------------


def rods(only: Iterable[Rod] = RODS, *, runs: int = RUNS, first: int = FIRST) -> Outcome:
    """Time the filter law and the lean reference in forward steps.

    Parameters
    ----------
    only
        Timed processes.
    runs, first
        Number of runs of each process, and of samples of a run.
    """
    rows: list[Row] = []
    checks: list[Check] = []
    for given in only:
        large = given.nodes >= SQUARE
        for row, check in _timed(given, min(runs, 2) if large else runs, first):
            rows.append(row)
            checks += [check] if check is not None else []
    if not rows:
        return Outcome()
    columns = ("nodes", "unknowns", "ends", "law", "median", "mean", f"over {COMMIT}", "bound")
    title = f"One sample over one forward step, the first {first} samples"
    return Outcome(tables=[Table(title, columns, rows)], checks=checks, notes=NOTES)


def _timed(given: Rod, runs: int, first: int) -> Iterator[tuple[Row, Check | None]]:
    """Yield a row and a check, or None, for each candidate."""
    samples, large = given.samples(first), given.nodes >= SQUARE
    spent: dict[str, list[list[float]]] = {SENSITIVITY: [], LEAN: []}
    units, lean_units = [], []
    for _ in range(runs):
        spent[SENSITIVITY].append(_law(given, samples))
        if not large:  # the lean filter factorises at each step, which is slow on a large square
            spent[LEAN].append(_lean(given, samples))
        units.append(float(np.median(forward_times(given, first))))
        lean_units.append(float(np.median(lean_forward(given, first))))
    earlier = EARLIER.get((given.nodes, given.ends))
    for name, times in spent.items():
        if not times:
            continue
        each = np.array(times)
        median = float(np.median(np.median(each, axis=1) / units))
        mean = float(np.median(each.mean(axis=1) / units))
        kind = each.mean(axis=1) if large else np.median(each, axis=1)
        over = np.nan
        if earlier is not None:
            over = float(np.median(kind / (earlier * np.array(lean_units))))
        bound = None
        if name == SENSITIVITY and given.ends == ENDS[0]:
            bound = BOUNDS.get((given.nodes, given.unknowns))
        cells = (given.nodes, given.unknowns, given.ends, name, median, mean)
        check = None
        if bound is not None:
            what = "mean" if large else "median"
            text = f"{given.title}, {name}: sample / forward step of {COMMIT}, {what}"
            check = Check(text, over, bound, "<=")
        yield (*cells, None if np.isnan(over) else over, bound), check


def fleet(members: int = MEMBERS, *, runs: int = RUNS, first: int = FIRST) -> Outcome:
    """Time a fleet of rods of 31 nodes relative to the lean reference with as many members."""
    rows: list[Row] = []
    checks: list[Check] = []
    for ends in ENDS:
        given = Rod(MEMBERS_NODES, 2, ends)
        samples = given.samples_of_members(members, first)
        ratios = np.array([_fleet_pair(given, members, samples) for _ in range(runs)])
        median, mean, apart = np.median(ratios, axis=0)
        rows.append((ends, float(median), float(mean)))
        text = f"fleet of {members} rods of {given.nodes} nodes, {ends}"
        checks.append(Check(f"{text}: sample / lean reference", float(median), FLEET, "<="))
        checks.append(Check(f"{text}: difference of the estimates", float(apart), 1e-8, "<="))
    title = f"A fleet of {members} rods of {MEMBERS_NODES} nodes over the lean reference"
    columns = ("ends", "median", f"mean of the first {first}")
    return Outcome(tables=[Table(title, columns, rows)], checks=checks)


def _fleet_pair(given: Rod, members: int, samples: Sequence[Any]) -> tuple[float, float, float]:
    """Return median and mean cost relative to the reference, and the relative difference of q."""
    law = SensitivityLaw(guards=None, refit=None, shadows=None)  # options of the lean reference
    together = Fleet(
        given.model, given.sensors, law, members, u0=0.0, scheme=ImplicitEuler(), halvings=0
    )
    matrices, spent, reference = given.matrices, [], []
    G = given.sensors.matrix(given.model.state_space).toarray()[:, matrices.order] / NOISE
    start = given.model.initial(0.0, _moment(samples[0]))
    state = lean.initial(matrices, start, members, given.unknowns)
    together.step(*samples[0])
    for sample in samples[1:]:
        begun = process_time()
        estimate = together.step(*sample)
        spent.append(process_time() - begun)
    for sample in samples[1:]:
        begun = process_time()
        f = matrices.forcing(_moment(sample))
        state = lean.step(matrices, G, state, f, sample[1] / NOISE)
        reference.append(process_time() - begun)
    q = given.model.latent.prior + state.y[:, :, 0] * given.model.latent.deviations
    apart = float(np.abs(estimate.q / q - 1.0).max())
    unit = float(np.median(reference))
    return float(np.median(spent)) / unit, float(np.mean(spent)) / unit, apart


NOTES = (
    "median, mean: cost of the samples of a run, in forward steps of this version (median "
    "processor time of livepde.simulate, with a stored factorisation). The mean includes the first "
    f"sample. over {COMMIT}: cost in forward steps of that commit, for which the bounds are "
    "defined: the median for rods, the mean for the square.",
    "ends: 'source' has constant values at both ends and a constant source; 'channels' reads both "
    "temperatures from the stream.",
)
