"""Case files: a whole identification in one TOML file, units and data checked."""

from livepde.cases.case import Case, Prepared, load
from livepde.cases.live_case import LiveCase

__all__ = ["Case", "LiveCase", "Prepared", "load"]
