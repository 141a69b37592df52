"""livepde inside of other programs: co-simulation units (FMI), online learners."""

from __future__ import annotations

from livepde.exchange.export import export_fmu
from livepde.exchange.verify import compare_fmu

__all__ = ["compare_fmu", "export_fmu"]
