"""Fixtures of all tests."""

import os
import signal
from importlib.util import find_spec
from pathlib import Path

import pytest
from broker import MOSQUITTO, Server
from commands import unchanged_logging

PROJECT = Path(__file__).resolve().parents[1]

# A program started by test_petsc.py. It imports DOLFINx, so doctests must not collect it.
collect_ignore = ["petsc_ranks.py"]

if find_spec("hypothesis"):
    from hypothesis import HealthCheck, settings

    # Each run has the same examples; `--hypothesis-profile default` draws other examples.
    slow = [HealthCheck.too_slow]
    settings.register_profile("same", derandomize=True, deadline=None, suppress_health_check=slow)
    settings.load_profile("same")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of measured data: $LIVEPDE_DATA, or shared/data next to the project."""
    named = os.environ.get("LIVEPDE_DATA")
    folder = Path(named) if named else PROJECT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real measurements: set LIVEPDE_DATA to their folder (looked in {folder})")
    return folder


@pytest.fixture
def server(tmp_path):
    """Provide a running MQTT broker."""
    if MOSQUITTO is None:
        pytest.skip("needs the broker mosquitto")
    folder = tmp_path / "broker"
    folder.mkdir()
    running = Server(folder)
    yield running
    running.close()


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Change to an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def logs():
    """Restore logging after each test, because a live run configures it for its process."""
    with unchanged_logging():
        yield


@pytest.fixture
def ctrl_c():
    """Let child processes receive Ctrl-C, even if the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
