"""Identifiers in separate threads give the bits of identifiers that run one after another.

Threads take turns as often as the interpreter lets them, and each sleeps now and then where the
package calls a function or one of its own returns: so it is between any two of them that another
one comes in. That finds what is shared in a few trials, each of which sleeps elsewhere. To look
harder, with 100 trials of each law: `make test-threads`.
"""

import copy
import inspect
import os
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Any

import factories
import numpy as np
import pytest
from factories import driven_rod, line, reaction
from skfem import ElementLineP1, ElementTriP1, MeshTri

import livepde as lp
from livepde import laws
from livepde.fem import measure

pytestmark = pytest.mark.slow

TRIALS = int(os.environ.get("LIVEPDE_THREAD_TRIALS", "1"))
SWITCH = 1e-6  # seconds until another thread may run: the default of 5e-3 hides most races
SLEEPS = 0.02  # share of the calls and returns of the package at which a thread sleeps
PATIENCE = 100.0  # seconds after which a thread counts as stuck
PERIOD = 0.1  # from one sample to the next
BEFORE = 2  # samples that an identifier takes before it is copied

Numbers = list[tuple[Any, ...]]


@pytest.fixture(autouse=True)
def often() -> Iterator[None]:
    """Let threads take turns as often as the interpreter can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH)
    yield
    sys.setswitchinterval(before)


# --- models --------------------------------------------------------------------------------------


def conduction(q: Any, u: Any, v: Any, x: Any) -> Any:
    return q.a * lp.dot(lp.grad(u), lp.grad(v)) + q.b * u * v


def heating(x: Any, t: float) -> Any:
    return 1.0 + np.sin(3.0 * t) * np.sin(np.pi * x[0])


def powered(x: Any, _: float) -> Any:
    return x.inputs["power"] * x[0]


def rod(cells: int = 16, **options: Any) -> lp.Model:
    """Return a rod with two unknowns, whose left end and source change with time."""
    unknowns = {"a": lp.Normal(0.2, 0.1), "b": lp.Normal(1.0, 0.5)}
    given = {"unknowns": unknowns, "A": conduction, "f": heating, **options}
    return driven_rod(left=lambda t: np.sin(2.0 * t), mesh=line(cells), **given)


def powered_rod() -> lp.Model:
    return rod(f=powered, inputs=("power",))


def positive_rod() -> lp.Model:
    """Return a rod with unknowns that stay positive, so that A is not linear in the latent ones."""
    unknowns = {"a": lp.LogNormal(0.2, 0.1), "b": lp.Normal(1.0, 0.5)}
    return rod(unknowns=unknowns)


def nonlinear_rod() -> lp.Model:
    """Return a rod in which A and B are not linear in u, and B reads the time."""
    return rod(
        A=lambda q, u, v, x: conduction(q, u, v, x) + 0.1 * q.b * u**3 * v,
        B=lambda u, v, x: (0.1 + 0.05 * np.sin(x.t)) * u**2 * v,
    )


def field_rod() -> lp.Model:
    return reaction(line(16), ElementLineP1(), f=heating)


def powered_field() -> lp.Model:
    return reaction(line(16), ElementLineP1(), f=powered, inputs=("power",))


def square() -> lp.Model:
    """Return a square of 289 nodes: the products with its A are sparse."""
    return reaction(MeshTri().refined(4), ElementTriP1(), f=heating)


def large_square() -> lp.Model:
    """Return a square of 2401 nodes: its coupled stages are solved by blocks."""
    return reaction(factories.square(48), ElementTriP1(), f=heating)


def plate() -> lp.Model:
    """Return a square of 81 nodes with a nonlinear A and two unknown numbers."""
    field = lp.Field(MeshTri().refined(3), ElementTriP1(), dirichlet={"boundary": 0.0})
    unknowns = {"a": lp.Normal(0.2, 0.1), "b": lp.Normal(1.0, 0.5)}
    return lp.Model(
        field,
        unknowns,
        A=lambda q, u, v, x: conduction(q, u, v, x) + 0.1 * q.b * u**3 * v,
        f=heating,
    )


# --- cases ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A law with a model and sensors.

    Attributes
    ----------
    missing
        Share of readings that are missing.
    samples
        How many are taken.
    """

    law: lp.laws.Law[Any, Any]
    model: Callable[[], lp.Model] = rod
    sensors: Callable[[], lp.observation.Observation] = lambda: lp.Points(
        [0.25, 0.5, 0.75], noise=0.05
    )
    missing: float = 0.0
    samples: int = 4

    def identifier(self, model: lp.Model) -> lp.Identifier:
        return lp.Identifier(model, self.sensors(), self.law, u0=0.0, halvings=0)


def inner() -> lp.observation.Observation:
    return lp.Subdomain(lambda x: (x[0] > 0.2) & (x[0] < 0.8))


def averages() -> lp.observation.Observation:
    return lp.Averages({"a": lambda x: x[0] < 0.4, "b": lambda x: x[0] > 0.5}, noise=0.02)


def smoothed() -> lp.observation.Observation:
    return lp.Full(noise=0.02, reconstruction=lp.observation.Tikhonov("X"))


def probe() -> lp.observation.Observation:
    return lp.Combined(
        [lp.observation.Moving({"probe": "at"}, noise=0.05), lp.Points({"fixed": 0.4}, noise=0.05)]
    )


GUARDED = lp.SensitivityLaw(guards=lp.laws.Guards(), jumps=lp.Jumps(settle=4))

CASES = {
    "gradient": Case(lp.GradientLaw(gain=10.0), rod, inner),
    "gradient, missing readings": Case(lp.GradientLaw(gain=10.0), rod, inner, missing=0.02),
    "gradient, nonlinear": Case(lp.GradientLaw(gain=10.0), nonlinear_rod, inner, samples=3),
    "gradient, positive unknown": Case(lp.GradientLaw(gain=10.0), positive_rod, inner, samples=3),
    "gradient, inputs": Case(lp.GradientLaw(gain=10.0), powered_rod, averages, missing=0.3),
    "gradient, smoothed": Case(lp.GradientLaw(gain=10.0), field_rod, smoothed, missing=0.02),
    "gradient, square": Case(lp.GradientLaw(gain=10.0), square, inner, samples=5),
    "gradient, nonlinear plate": Case(lp.GradientLaw(gain=10.0), plate, inner),
    "gradient, blocks": Case(lp.GradientLaw(gain=10.0), large_square, inner, samples=2),
    "auto gain": Case(lp.GradientLaw(gain="auto"), field_rod, inner),
    "auto gain, chosen smoothing": Case(
        lp.GradientLaw(gain="auto"), field_rod, lp.Full, missing=0.01
    ),
    "auto gain, inputs": Case(lp.GradientLaw(gain="auto"), powered_field, inner, missing=0.02),
    "auto gain, square": Case(lp.GradientLaw(gain="auto"), square, inner),
    "sensitivity": Case(lp.SensitivityLaw()),
    "sensitivity, inputs": Case(lp.SensitivityLaw(drift=0.01), powered_rod, missing=0.2),
    "sensitivity, nonlinear": Case(lp.SensitivityLaw(), nonlinear_rod, samples=3),
    "sensitivity, positive unknown": Case(lp.SensitivityLaw(), positive_rod, samples=3),
    "sensitivity, moving sensor": Case(lp.SensitivityLaw(), powered_rod, probe, samples=3),
    "sensitivity, square": Case(lp.SensitivityLaw(modes=4), square, averages, samples=3),
    "sensitivity, large square": Case(
        lp.SensitivityLaw(modes=3), large_square, averages, samples=2
    ),
    "guards and jumps": Case(GUARDED, powered_rod, samples=6),
}


def stream(case: Case, identifier: lp.Identifier, seed: int) -> list[tuple[Any, ...]]:
    """Return samples of noise about a smooth signal; what they say does not matter here."""
    rng, size, found = np.random.default_rng(seed), identifier.observed.size, []
    for k in range(1, case.samples + 1):
        t = PERIOD * k
        z = 0.2 + 0.1 * (1.0 + seed) * np.sin(t) + 0.01 * rng.standard_normal(size)
        z[rng.random(size) < case.missing] = np.nan
        values = {"power": 1.0 + np.sin(3.0 * t + seed), "at": 0.3 + 0.2 * np.sin(4.0 * t + seed)}
        inputs = {name: values[name] for name in identifier.inputs}
        found.append((t, z, inputs))
    return found


def taken(identifier: lp.Identifier, samples: list[tuple[Any, ...]]) -> Numbers:
    """Return all numbers of all estimates, as bytes where they are arrays."""
    found: Numbers = []
    for sample in samples:
        estimate = identifier.step(*sample)
        belief = identifier._latent_belief()
        arrays = (estimate.q, estimate.u, estimate.innovation, belief.q_factor, belief.u_factor)
        seen = tuple(None if array is None else array.tobytes() for array in arrays)
        notes = {name: float(value).hex() for name, value in estimate.diagnostics.named().items()}
        found.append((estimate.status.code, estimate.steps, notes, *seen))
    return found


def ours(frame: FrameType | None) -> bool:
    return frame is not None and frame.f_globals["__name__"].startswith("livepde.")


def together(trial: int, tasks: list[Callable[[], Numbers]]) -> list[Numbers]:
    """Return what tasks return that begin at the same time, each in a thread of its own.

    Where they sleep is drawn for each trial. One that raises is a warning of pytest, and so an
    error; it returns nothing.
    """
    barrier = threading.Barrier(len(tasks))
    found: list[Numbers] = [[] for _ in tasks]

    def run(k: int) -> None:
        draw = random.Random(len(tasks) * trial + k).random

        def sleepy(frame: FrameType, *_: Any) -> None:
            # Within NumPy or SciPy nothing of the package is half done.
            if draw() < SLEEPS and (ours(frame) or ours(frame.f_back)):
                time.sleep(1e-6)

        barrier.wait(PATIENCE)
        sys.setprofile(sleepy)
        found[k] = tasks[k]()

    threads = [threading.Thread(target=run, args=(k,), daemon=True) for k in range(len(tasks))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert not any(thread.is_alive() for thread in threads)
    return found


def begun(case: Case, model: lp.Model, seed: int) -> Numbers:
    """Return the numbers of an identifier that is built, and steps, in the same thread."""
    identifier = case.identifier(model)
    return taken(identifier, stream(case, identifier, seed))


def copies(case: Case) -> tuple[list[lp.Identifier], list[list[tuple[Any, ...]]]]:
    """Return two copies of an identifier that has begun, and the samples that are left for each."""
    identifier = case.identifier(case.model())
    first, second = (stream(case, identifier, seed) for seed in (0, 1))
    taken(identifier, first[:BEFORE])
    return [copy.deepcopy(identifier) for _ in range(2)], [first[BEFORE:], second[BEFORE:]]


def test_every_law_is_among_the_cases():
    concrete = {
        item
        for item in (getattr(laws, name) for name in laws.__all__)
        if inspect.isclass(item) and issubclass(item, laws.Law) and not inspect.isabstract(item)
    }
    assert {type(case.law) for case in CASES.values()} == concrete
    assert {type(CASES[name].law) for name in COPIED} == concrete


# One of each law, and those that factorise, solve and inherit most.
OFTEN = (
    "gradient, nonlinear plate",
    "gradient, blocks",
    "auto gain",
    "sensitivity, large square",
)
RARELY = (pytest.param(name, marks=pytest.mark.long) for name in CASES if name not in OFTEN)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*OFTEN, *RARELY])
def test_identifiers_of_one_model_step_in_threads(name):
    case = CASES[name]
    model = case.model()
    expected = [begun(case, model, seed) for seed in (0, 1)]
    assert any(sample[0] == "ok" for sample in expected[0])
    for trial in range(TRIALS):
        model = case.model()
        found = together(trial, [partial(begun, case, model, seed) for seed in (0, 1)])
        assert found == expected


def test_a_search_in_a_large_mesh_leaves_the_tree_of_another_one(monkeypatch):
    block = square().state_block
    mesh, point = block.field.mesh, np.array([[0.3], [0.4]])
    monkeypatch.setattr(measure, "KEPT", 0)
    block.probe(point)
    assert "_cached_tree" not in vars(mesh)  # it would stay for good
    mesh.element_finder()
    tree = mesh._cached_tree
    block.probe(point)
    assert mesh._cached_tree is tree


# Each law once, with different models; all that a law does is in the test before.
COPIED = (
    "gradient, missing readings",
    "auto gain, chosen smoothing",
    "sensitivity, square",
    "guards and jumps",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", COPIED)
def test_copies_of_an_identifier_step_in_threads(name):
    case = CASES[name]
    expected = [taken(*pair) for pair in zip(*copies(case), strict=True)]
    for trial in range(TRIALS):
        found = together(trial, [partial(taken, *pair) for pair in zip(*copies(case), strict=True)])
        assert found == expected
