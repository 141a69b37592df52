"""Fixtures of all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real measurements: $LIVEPDE_DATA, or shared/data beside the project."""
    named = os.environ.get("LIVEPDE_DATA")
    folder = Path(named) if named else PROJECT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real measurements: set LIVEPDE_DATA to their folder (looked in {folder})")
    return folder
