"""Both laws on PETSc vectors, on several ranks; skipped where DOLFINx or mpirun is missing."""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import petsc_problems as problems
import pytest

from livepde import petsc
from livepde.errors import ConfigurationError

pytestmark = pytest.mark.process

HERE = Path(__file__).parent
MISSING = shutil.which("mpirun") is None or not all(map(find_spec, ("petsc4py", "dolfinx")))
needs_mpi = pytest.mark.skipif(MISSING, reason="DOLFINx, petsc4py or mpirun is missing: make mpi")
SETTINGS = {  # a machine of few cores, perhaps as root: what Open MPI wants to be told
    **dict.fromkeys(("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM"), "1"),
    **dict.fromkeys(("OMPI_MCA_rmaps_base_oversubscribe", "OMPI_MCA_mpi_yield_when_idle"), "1"),
    "OMP_NUM_THREADS": "1",
}
CASES = ("numbers", "modes", "full", "part", "constant", "bounded", "rest")


def mpirun(count, *command):
    paths = [str(HERE), *sys.path]
    # An exception on one rank ends all of them: mpi4py's own runner.
    done = subprocess.run(
        ["mpirun", "-n", str(count), sys.executable, "-m", "mpi4py", *map(str, command)],
        env={**os.environ, **SETTINGS, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def solved():
    return problems.solved()


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What one, two and three ranks find, by their number; each runs once."""
    known = {}

    def of(count):
        if count not in known:
            path = tmp_path_factory.mktemp("found") / "found.npz"
            mpirun(count, HERE / "petsc_ranks.py", path)
            with np.load(path) as file:
                known[count] = dict(file)
            assert known[count]["ranks"] == count
        return known[count]

    return of


def test_nothing_starts_mpi_unless_it_is_asked_for():
    code = (
        "import sys, livepde, livepde.cli\n"
        "names = livepde.petsc.__all__\n"
        "assert not {'mpi4py', 'petsc4py', 'dolfinx', 'ufl'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_petsc_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "petsc4py", None)
    with pytest.raises(ConfigurationError, match="deploy/petsc"):
        petsc.DolfinxModel(None, None, None)


@needs_mpi
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize(
    ("name", "close"),
    [
        ("numbers.q", 1e-9),
        ("numbers.std", 1e-9),
        ("numbers.u", 1e-9),
        ("modes.q", 1e-8),
        ("modes.u", 1e-8),
        *((f"{case}.{which}", 1e-8) for case in ("full", "part", "constant") for which in "qu"),
    ],
)
def test_numbers_are_those_of_the_laws_of_one_process(count, name, close, solved, found):
    """The same mesh, model, data and scheme through two implementations."""
    expected = solved[name]
    size = np.abs(expected).max()
    np.testing.assert_allclose(found(count)[name], expected, rtol=0, atol=close * size)


@needs_mpi
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("case", CASES)
def test_every_number_of_ranks_finds_the_same(count, case, found):
    """To 1e-8 (filter) and, with the tolerance that an observer has by default, to 1e-6."""
    for which in ("q", "u"):
        one, more = found(1)[f"{case}.{which}"], found(count)[f"{case}.{which}"]
        close = 1e-8 if case in ("numbers", "modes") else 1e-6
        np.testing.assert_allclose(more, one, rtol=0, atol=close * np.abs(one).max())


@needs_mpi
@pytest.mark.parametrize("count", [1, 2, 3])
def test_no_rank_has_much_more_than_its_share(count, found):
    """Coefficients, nonzeros of a matrix, and cells with their ghosts."""
    shares = found(count)["shares"]
    owned, nonzeros, cells = shares.T
    assert owned.sum() == problems.mesh().p.shape[1]
    assert cells.sum() >= problems.mesh().t.shape[1]
    for part, whole in ((owned, owned.sum()), (nonzeros, nonzeros.sum())):
        assert part.max() <= 1.3 / count * whole
    assert cells.max() <= 1.3 / count * problems.mesh().t.shape[1]


@needs_mpi
@pytest.mark.parametrize(("first", "then"), [(1, 2), (2, 3), (3, 1)])
def test_a_run_goes_on_with_another_number_of_ranks(first, then, found, tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    mpirun(first, HERE / "petsc_ranks.py", tmp_path / "begun.npz", folder)
    assert len(list(folder.glob("*.json"))) == len(CASES)
    mpirun(then, HERE / "petsc_ranks.py", tmp_path / "resumed.npz", folder)
    with np.load(tmp_path / "resumed.npz") as resumed:
        assert len(resumed["full.held"]) == len(problems.data()) // 2
        for case in CASES:
            close = 1e-8 if case in ("numbers", "modes") else 1e-6
            for which in ("q", "u"):
                expected = found(1)[f"{case}.{which}"]
                size = np.abs(expected).max()
                np.testing.assert_allclose(
                    resumed[f"{case}.{which}"], expected, rtol=0, atol=close * size
                )


@needs_mpi
def test_bounds_of_a_field_hold(found):
    free, bounded = found(1)["full.q"], found(1)["bounded.q"]
    assert free.max() > 1.2
    assert bounded.max() == 1.2
    assert bounded.min() >= 0.4


@needs_mpi
def test_the_gate_holds_q_at_rest_and_not_before(found):
    held = found(2)["rest.held"]
    assert not held[:4].any()
    assert held[-1]


@needs_mpi
def test_the_filter_refuses_outliers_for_a_while_and_keeps_to_its_bounds(found):
    used, inside = found(2)["robust.used"], found(2)["robust.inside"]
    assert used[:, 2].tolist() == [False, False, True, False, False, True]
    assert used[:3, 0].all()
    assert not used[2, 1]  # no reading
    assert inside[:, 0].min() >= 0.1
    assert inside[:, 1].max() <= 1.05
    assert (inside[:, :2] == [0.1, 1.05]).any()  # they were reached,
    assert inside[:, 2].max() < 1e-12  # and the unknowns themselves were projected


@needs_mpi
def test_a_step_that_fails_is_a_status_and_nothing_moves(found):
    status = str(found(2)["failed"])
    assert status.startswith("not_finite: the iteration left the range of finite numbers.")


@needs_mpi
def test_checks_pass_and_find_a_wrong_derivative(found):
    assert found(2)["checks"].tolist() == [True, True, False]


@needs_mpi
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("modes", "LawError: PetscFilter: needs at least one mode: see number_modes"),
        ("noise", "LawError: PetscFilter: noise must be positive; got 0.0."),
        ("filter bounds", "LawError: PetscFilter: lower must be less than upper; got 1.0 and 0.0."),
        ("z", "LawError: PetscFilter: z needs shape (3,); got (1,)."),
        ("time", "LawError: PetscFilter: t must be later than 0.0; got 0.0."),
        ("gain", "LawError: PetscObserver: gain must be a number > 0; got 0.0."),
        ("nu", "LawError: PetscObserver: nu must be a number >= 0; got -1.0."),
        ("bounds", "LawError: PetscObserver: lower must be less than upper; got 1.0 and 0.0."),
        ("sample time", "LawError: PetscObserver: t must be later than 0.0; got 0.0."),
        ("numbers", "ModelError: DolfinxModel: the paper's law needs a field q: use PetscFilter."),
        ("outside", "ModelError: DolfinxModel: sensor 0 at [2. 2. 0.] lies outside the mesh."),
        ("element", "ModelError: DolfinxModel: coefficients keep their numbers"),
        ("no checkpoint", "RunError: "),
        ("another model", "RunError: "),
    ],
)
def test_a_mistake_is_said_in_a_sentence(name, sentence, found):
    said = json.loads(str(found(2)["said"]))
    assert said[name].startswith(sentence)
    if name == "another model":
        assert "with [357, 2] coefficients; this model has [357, 357]" in said[name]


@needs_mpi
def test_examples_find_their_truth_on_two_ranks():
    examples = HERE.parent / "examples"
    lines = mpirun(2, examples / "petsc_heat.py").splitlines()
    for line, name, truth in zip(lines, "ks", (0.4, 1.5), strict=True):
        found, value, std = re.fullmatch(r"(\w) = ([\d.]+) ± ([\d.]+)", line).groups()
        assert found == name
        assert abs(float(value) - truth) < 3 * float(std) < 0.05 * truth
    (said,) = mpirun(2, examples / "petsc_reaction.py").splitlines()
    first, last = map(float, re.findall(r"\d+\.\d+", said))
    assert last < 0.002 < 0.5 < first


@needs_mpi
def test_the_benchmark_compares_numbers_of_ranks():
    command = ["petsc", "--size", "2700", "--samples", "1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", *command],
        cwd=HERE.parent,
        env={**os.environ, **SETTINGS},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["checks"]) == 5  # three shares, and q of both laws on two ranks
    (table,) = found["tables"]
    assert [row[0] for row in table["rows"]] == [1, 1, 2, 2, 2, 2]


@needs_mpi
def test_a_boundary_term_sees_the_estimate(found):
    """Then the equation is not affine in q alone, even where all of u is observed."""
    assert found(2)["open"] < 1e-7
