"""Figures of a run's dataset; the only room that knows matplotlib."""

from __future__ import annotations

from typing import Any

import xarray as xr

__all__ = ["overview"]


def overview(data: xr.Dataset, **options: Any) -> Any:
    raise NotImplementedError
