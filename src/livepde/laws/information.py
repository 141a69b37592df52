"""The metric of `GradientLaw(gain="auto")`: the information that the data have given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.laws.coupled import Metric
from livepde.laws.coupled.forms import StageForms
from livepde.laws.memory import PULL, Learned, Learning
from livepde.laws.metrics import HOLD, MetricRule, MetricStep, Transition
from livepde.linalg import Array

__all__ = ["InformationMetric"]


@dataclass(frozen=True, eq=False)
class InformationMetric(MetricRule[Learned]):
    """(S G_Q + J)/PULL in the place of G_Q/gain; see `livepde.laws.memory`."""

    learning: Learning

    def init(self, q0: Array) -> Learned:
        return self.learning.init(q0)

    def step(self, state: Learned, forms: StageForms, before: Transition) -> MetricStep:
        learning, h, q = self.learning, before.length, before.q
        seen = learning.coupling(forms, before.w, q, before.moment)
        spread = learning.spread(state, seen, h)
        shift = learning.shift(state, spread, q, h)
        return lambda c, h: Metric(
            spread / PULL, 0.0, -h * shift / PULL, state.information / PULL, PULL / h
        )

    def frozen(self, state: Learned, forms: StageForms, before: Transition) -> MetricStep:
        learning, h = self.learning, before.length
        seen = learning.coupling(forms, before.w, before.q, before.moment)
        spread = HOLD * learning.spread(state, seen, h)
        zero = np.zeros_like(before.q)
        return lambda c, h: Metric(spread / PULL, 0.0, zero, state.information / PULL, PULL / h)

    def learn(self, state: Learned, after: Transition) -> Learned:
        learning, h = self.learning, after.length
        seen = learning.coupling(after.forms, after.w, after.q, after.moment)
        spread = learning.spread(state, seen, h)
        return learning.learn(state, spread, seen, after.r, h, after.same)

    def notes(self, state: Learned, q: Array, length: float) -> Mapping[str, Any]:
        spread = state.spread or 1.0
        return {
            "gain": PULL / (spread * length),
            "information": state.total / spread,
            "departure": lambda: self.learning.departure(state, spread, q),
        }
