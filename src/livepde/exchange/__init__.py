"""Integration into other programs: co-simulation units (FMI) and online learners."""

from livepde.exchange.fmu_export import export_fmu
from livepde.exchange.regressor import OnlineRegressor, river_regressor

__all__ = ["OnlineRegressor", "export_fmu", "river_regressor"]
