"""Case files: an identification in one TOML file, with checks of units and data."""

from livepde.cases.case import Case, Prepared, load
from livepde.cases.live_case import LiveCase

__all__ = ["Case", "LiveCase", "Prepared", "load"]
