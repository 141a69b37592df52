"""One identification on several processes of MPI; skipped where petsc4py or mpirun is missing."""

import json
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import ranks
import xarray as xr

from livepde.errors import ConfigurationError
from livepde.linalg import Pattern, choose, in_use, using
from livepde.parallel.team import world

pytestmark = pytest.mark.process

HERE = Path(__file__).parent
MISSING = shutil.which("mpirun") is None or find_spec("petsc4py") is None
needs_mpi = pytest.mark.skipif(MISSING, reason="petsc4py or mpirun is missing: see .ci/run")
SETTINGS = {  # a machine of few cores, perhaps as root: what Open MPI wants to be told
    **dict.fromkeys(("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM"), "1"),
    **dict.fromkeys(("OMPI_MCA_rmaps_base_oversubscribe", "OMPI_MCA_mpi_yield_when_idle"), "1"),
    "OMP_NUM_THREADS": "1",
}


def mpirun(count: int, *command: object, cwd: Path | None = None):
    paths = [str(HERE), *sys.path]
    return subprocess.run(
        ["mpirun", "-n", str(count), sys.executable, *map(str, command)],
        env={**os.environ, **SETTINGS, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.fixture(scope="module")
def serial():
    return ranks.everything()


def test_nothing_starts_mpi_unless_it_is_asked_for():
    code = (
        "import sys, livepde, livepde.cli, livepde.parallel, livepde.laws.coupled.distributed\n"
        "assert not {'mpi4py', 'petsc4py'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_petsc_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "petsc4py", None)
    with pytest.raises(ConfigurationError, match="deploy/petsc"):
        world()


def test_an_engine_in_use_comes_before_the_rule():
    class Mine:
        reason = "mine"

        def solver(self, pattern, *, symmetric):
            return f"of {pattern.nnz}" if symmetric else None

    wide = Pattern.of(np.ones((200, 200)))
    with using(Mine()):
        assert in_use().reason == "mine"
        assert choose(wide, symmetric=True).solver == "of 40000"
        assert choose(wide, symmetric=True).reason.endswith("; mine")
        assert "mine" not in choose(wide).reason
        assert "band" in choose(Pattern.of(np.eye(200)), symmetric=True).solver.name
    assert in_use() is None


@needs_mpi
@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_number_of_ranks_gives_what_one_process_does(count, serial, tmp_path):
    done = mpirun(count, HERE / "ranks.py", tmp_path / "found.npz")
    assert done.returncode == 0, done.stderr
    assert "no facets" not in done.stderr  # scikit-fem warns where a rank has none of a boundary
    with np.load(tmp_path / "found.npz") as found:
        assert found["ranks"] == count
        for name, expected in serial.items():
            size = np.abs(expected).max()
            # The sensitivity law solves its tangents to 1e-4, by factors that are kept.
            close = 1e-5 if name.startswith("sensitivity") else 1e-6
            np.testing.assert_allclose(found[name], expected, rtol=0, atol=close * size)


@needs_mpi
def test_a_case_runs_on_two_ranks_and_only_one_of_them_writes(tmp_path):
    (tmp_path / "case.toml").write_text(ranks.CASE)
    (tmp_path / "data.csv").write_text(ranks.case_data())
    command = ("-m", "livepde", "run", "case.toml", "--json", "--out")
    alone = subprocess.run(
        [sys.executable, *command, "alone"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert alone.returncode == 0, alone.stderr
    done = mpirun(2, *command, "both", "--engine", "petsc", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    one, two = json.loads(alone.stdout), json.loads(done.stdout)
    assert any("PETSc on 2 ranks" in note for note in two["notes"])
    assert not any("PETSc" in note for note in one["notes"])
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == sorted(
        path.name for path in (tmp_path / "alone").iterdir()
    )
    assert two["status"] == one["status"] == "finished"
    fields = [
        xr.load_dataset(tmp_path / run / "estimates.nc")["alpha"] for run in ("alone", "both")
    ]
    np.testing.assert_allclose(fields[1], fields[0], rtol=1e-5)


@needs_mpi
def test_an_error_before_the_run_is_said_once_and_ends_all_ranks(tmp_path):
    done = mpirun(2, "-m", "livepde", "run", tmp_path / "none.toml", "--engine", "petsc")
    assert done.returncode == 2
    assert done.stderr.count("none.toml") == 1


BROKEN = """
from livepde.parallel import petsc

class Part:
    def __init__(self, team):
        self.team = team
    def work(self):
        if self.team.rank == 1:
            raise ValueError("one rank only")
        self.team.comm.barrier()
    def close(self):
        pass

with petsc() as engine:
    if engine:
        engine.team.share(Part)("work")
"""


@needs_mpi
def test_a_failure_on_one_rank_ends_all(tmp_path):
    (tmp_path / "broken.py").write_text(BROKEN)
    done = mpirun(2, tmp_path / "broken.py")
    assert done.returncode != 0
    assert "rank 1 of 2 failed, which ends all of them: ValueError: one rank only" in done.stderr


REFUSED = """
import ranks
from livepde.parallel import petsc

with petsc() as engine:
    if engine:
        ranks.refused()
"""


@needs_mpi
def test_the_gradient_law_of_a_subdomain_is_refused_on_several_ranks_in_a_sentence(tmp_path):
    (tmp_path / "refused.py").write_text(REFUSED)
    done = mpirun(2, tmp_path / "refused.py")
    assert done.returncode != 0
    (said,) = (line for line in done.stderr.splitlines() if line.startswith("livepde.errors.Law"))
    assert "only where all of the state is observed" in said
    assert said.endswith("run it on one rank, observe Full(), or use SensitivityLaw.")


@needs_mpi
def test_the_benchmark_counts_what_crosses():
    command = ["mpi", "--size", "2700", "--samples", "1", "--rounds", "1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", *command],
        cwd=Path(__file__).parents[1],
        env={**os.environ, **SETTINGS},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [check["ok"] for check in found["checks"]] == [True]
    (table,) = found["tables"]
    alone, both = (dict(zip(table["columns"], row, strict=True)) for row in table["rows"])
    assert alone["messages"] == alone["messages of rank 0"] == 0
    assert both["messages"] > both["messages of rank 0"] > 0
    assert both["MB sent"] > 0
