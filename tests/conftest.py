"""Fixtures of all tests."""

import os
import signal
from importlib.util import find_spec
from pathlib import Path

import pytest
from broker import MOSQUITTO, Server
from commands import unchanged_logging

PROJECT = Path(__file__).resolve().parents[1]

# A program of test_petsc.py, which imports DOLFINx: no module with doctests.
collect_ignore = ["petsc_ranks.py"]

if find_spec("hypothesis"):
    from hypothesis import HealthCheck, settings

    # The same examples each time, on a slow machine too; --hypothesis-profile default: others.
    slow = [HealthCheck.too_slow]
    settings.register_profile("same", derandomize=True, deadline=None, suppress_health_check=slow)
    settings.load_profile("same")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real measurements: $LIVEPDE_DATA, or shared/data beside the project."""
    named = os.environ.get("LIVEPDE_DATA")
    folder = Path(named) if named else PROJECT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real measurements: set LIVEPDE_DATA to their folder (looked in {folder})")
    return folder


@pytest.fixture
def server(tmp_path):
    """A message broker."""
    if MOSQUITTO is None:
        pytest.skip("needs the broker mosquitto")
    folder = tmp_path / "broker"
    folder.mkdir()
    running = Server(folder)
    yield running
    running.close()


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def logs():
    """Leave logging as it was: a live run configures it for its process."""
    with unchanged_logging():
        yield


@pytest.fixture
def ctrl_c():
    """Let children hear Ctrl-C, also where tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
