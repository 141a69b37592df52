"""Control with an identified model: reduced models, trust in estimates, controllers, loops."""

from __future__ import annotations

from livepde.control.estimators import Estimator, Learned, Trust
from livepde.control.goal import Controller, Decision, Goal, Known, Plan
from livepde.control.kalman import Kalman
from livepde.control.linear import Discrete, Output
from livepde.control.loop import Action, Loop
from livepde.control.lq import LQ
from livepde.control.mpc import MPC
from livepde.control.reduced import ReducedModel, reduce

__all__ = [
    "LQ",
    "MPC",
    "Action",
    "Controller",
    "Decision",
    "Discrete",
    "Estimator",
    "Goal",
    "Kalman",
    "Known",
    "Learned",
    "Loop",
    "Output",
    "Plan",
    "ReducedModel",
    "Trust",
    "reduce",
]
