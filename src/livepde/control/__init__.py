"""Control with an identified model: reduced models, trust in estimates, controllers, loops."""

from livepde.control.controllers import LQ, MPC, Controller, Decision, Goal, Known, Plan
from livepde.control.estimators import Estimator, Kalman, Learned, Trust
from livepde.control.loop import Action, Loop
from livepde.control.reduction import Discrete, Output, ReducedModel, reduce

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
