"""The estimate after one sample: unknowns, state, diagnostics and verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.fem import FunctionSpace
from livepde.laws import Belief, Fit, Status
from livepde.laws.later import together
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array
from livepde.readout import Marginal, known_badly, marginals_at
from livepde.showing import Shown, listed
from livepde.verdict import Verdict, at_limit, discretised, held_inputs

Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Estimate(Shown):
    """Estimate of the unknowns and the state after one sample.

    Attributes
    ----------
    t
        Time of the sample.
    belief
        Coefficients of parameter and state, with their uncertainty.
    innovation
        Measured minus predicted readings before the update, shape (sensors,); NaN where missing.
        For `GradientLaw`, which corrects the state within the step, the output error after the
        step.
    validation_error
        Measured minus estimated value of each validation sensor, shape (validation,).
    status
        Status of the step; unless ok, q and u are from the last successful step.
    steps
        Number of substeps.
    diagnose
        Function that returns the diagnostics of the law; see `diagnostics`.
    held
        Input channels whose last value was held because the sample had none; at the first sample
        also channels without a value at the initial time, whose first value was held.
    space
        Function space of the unknowns.
    state_space
        Function space of the state; None for an estimate that was pickled.
    judge
        Function that returns the verdict of the law on the run so far; see `verdict`.
    fit
        Last refit of all stored samples; None before the first, and for laws that never refit.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    >>> sensors = lp.Points({"T_50": 0.5}, noise=0.01)
    >>> estimate = lp.Identifier(rod, sensors, u0=1.0).step(1.0, {"T_50": 0.81})
    >>> sorted(estimate.parameters), estimate.u.shape
    (['alpha'], (9,))
    """

    t: float
    belief: Belief
    innovation: Array
    validation_error: Array
    status: Status
    steps: int
    diagnose: Callable[[], Diagnostics[float]]
    held: tuple[str, ...]
    space: FunctionSpace
    judge: Callable[[], Verdict] = Verdict.unjudged
    fit: Fit | None = None
    state_space: FunctionSpace | None = None

    @classmethod
    def deferred(cls, read: Callable[[], Belief], **attributes: Any) -> Estimate:
        """Return an estimate whose belief is computed by `read` on first access, and cached.

        `attributes` are all other attributes. `read` must return the same numbers at any time.
        """
        estimate = object.__new__(cls)
        estimate.__dict__.update(attributes, _read=read)
        return estimate

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Python calls this only for names that are not in __dict__: the belief is read once.
            attributes = self.__dict__
            read = attributes.get("_read") if name == "belief" else None
            if read is not None:
                attributes["belief"] = read()
                attributes.pop("_read", None)  # another thread may have been faster
            if name not in attributes:
                raise AttributeError(f"an Estimate has no attribute '{name}'.")
            return attributes[name]

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for pickle and copies, with values instead of functions."""
        # Functions of a law cannot be pickled and refer to its arrays: their results are stored.
        values = {
            "belief": self.belief,
            "verdict": self.verdict,
            "diagnostics": self.diagnostics,
            "diagnose": partial(kept, self.diagnostics),
            "judge": partial(kept, self.verdict),
            "space": self.space.described,
            "state_space": None,
        }
        return {k: v for k, v in vars(self).items() if k != "_read"} | values

    def _shown(self) -> tuple[str, Mapping[str, str]]:
        rows = {}
        for label in self.space.labels:
            unit = self.space.unknown_of(label).unit
            rows[label] = f"{self[label]} {unit}".rstrip()
        for name in self.space.fields:
            values, std = self[name].median, self[name].deviation
            rows[name] = f"field, coefficients {values.min():.4g} to {values.max():.4g}"
            if np.isfinite(std).all():
                rows[name] += f", mean std. dev. {std.mean():.2g}"
        rows["status"] = self.status.code
        if self.held:
            rows["held inputs"] = listed(self.held)
        return f"Estimate at t = {self.t:g}", rows

    @cached_property
    def diagnostics(self) -> Diagnostics[float]:
        """Diagnostics of the law, such as innovation statistics and safeguards."""
        return self.diagnose()

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict on the trustworthiness of the estimates, based on all samples so far.

        It is computed on first access, which takes about a millisecond.
        """
        shifts = self.diagnostics.shifts
        found = [*known_badly(self.belief, self.space), *discretised(shifts), *held_inputs(shifts)]
        if self.diagnostics.bounded > 0.0:
            found.append(at_limit())
        return self.judge().with_findings(found)

    @property
    def q(self) -> Array:
        """Coefficients of the parameter, shape (m,)."""
        return self.belief.q

    @property
    def u(self) -> Array:
        """Coefficients of the state, shape (n,)."""
        return self.belief.u

    @property
    def q_std(self) -> Array | None:
        """Standard deviation of each coefficient of q; None for a law without covariance."""
        return self.belief.q_std

    @property
    def u_std(self) -> Array | None:
        """Standard deviation of each coefficient of u; None for a law without covariance."""
        return self.belief.u_std

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Label of each scalar unknown -> (value, standard deviation; NaN without covariance).

        Mean and standard deviation for a `Normal`. Under a transform, the median and the standard
        deviation to first order; `estimate[label]` also has the mean and its standard deviation.
        """
        std = self.q_std
        return {
            label: (float(self.q[k]), float(std[k]) if std is not None else np.nan)
            for label, k in self.space.labels.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return time, status, unknown numbers, innovations and verdict as JSON-compatible values.

        {"t", "status", "unknowns": {label: {"value", "std"}}, "innovation": [...], "verdict"}, with
        None instead of values that are not finite.
        """
        unknowns = {
            label: {"value": _number(value), "std": _number(std)}
            for label, (value, std) in self.parameters.items()
        }
        return {
            "t": self.t,
            "status": self.status.code,
            "unknowns": unknowns,
            "innovation": [_number(value) for value in self.innovation.tolist()],
            "verdict": self.verdict.level,
        }

    def __getitem__(self, name: str) -> Marginal:
        """Return the marginal of an unknown: median, mean, standard deviation and intervals.

        Parameters
        ----------
        name
            Label of an unknown number, or name of a field or a component of the state. Fields and
            components have values at points: `estimate["u"].at([0.1, 0.5])`.

        Raises
        ------
        ConfigurationError
            Unknown name.
        """
        space = self.space
        std = self.q_std if self.q_std is not None else np.full_like(self.q, np.nan)
        if name in space.labels:
            k = space.labels[name]
            return Marginal(float(self.q[k]), float(std[k]), space.unknown_of(name))
        values, at = self.q, partial(self._at, name)
        if name not in space.fields and self.state_space is not None:
            space, values = self.state_space, self.u
            std = self.u_std if self.u_std is not None else np.full_like(self.u, np.nan)
        if name in space.fields:
            part = space.part(name)
            return Marginal(values[part], std[part], space.unknown_of(name), at)
        if self.state_space is None:
            raise ConfigurationError(
                f"estimate['{name}']: this estimate was pickled, without its state; its unknowns "
                f"are {[*self.space.labels, *self.space.fields]}."
            )
        components = self.state_space.fields
        raise ConfigurationError(
            f"estimate['{name}']: there is no unknown '{name}'; there are "
            f"{[*self.space.labels, *self.space.fields, *components]}."
        )

    def _at(self, name: str, points: ArrayLike) -> Marginal:
        """Return the marginals of the values of a field at points."""
        if self.state_space is None:
            raise ConfigurationError(
                f"estimate['{name}'].at: this estimate was pickled, without its mesh: call `at` "
                "of the estimate of an identifier."
            )
        if name in self.space.fields:
            return marginals_at(name, points, self.space, self.q, self.belief.deviation)
        factor = self.belief.u_factor

        def deviation(rows: Any, part: slice) -> Array | None:
            return None if factor is None else np.linalg.norm(rows @ factor[part], axis=1)

        return marginals_at(name, points, self.state_space, self.u, deviation)


def read_together(estimates: Sequence[Estimate]) -> None:
    """Compute the deferred beliefs and diagnostics of several estimates together."""
    attributes = [vars(estimate) for estimate in estimates]
    for name, function in (("belief", "_read"), ("diagnostics", "diagnose")):
        # Another thread may read some of them at the same time.
        deferred = ((held, held.get(function)) for held in attributes if name not in held)
        unread = [(held, read) for held, read in deferred if read is not None]
        for (held, _), value in zip(unread, together([read for _, read in unread]), strict=True):
            held[name] = value
            held.pop("_read", None)


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def kept(value: Kept) -> Kept:
    """Return the value; `partial(kept, value)` is a constant function that can be pickled."""
    return value
