"""Reduced models that keep the unknown numbers as parameters, by Galerkin projection."""

from livepde.control.reduction.galerkin import Discrete, Output
from livepde.control.reduction.reduced import ReducedModel, reduce

__all__ = ["Discrete", "Output", "ReducedModel", "reduce"]
