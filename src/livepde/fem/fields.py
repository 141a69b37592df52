"""Declarations of unknowns, and functions for weak forms: branches and upwinding.

NumPy's abs of a complex number is its modulus, and max also compares imaginary parts, so that both
lose the derivative of a complex step. The functions here select the branch by the real part, and
the complex step differentiates this branch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from inspect import signature
from itertools import chain
from typing import Any, TypeAlias

import numpy as np
from skfem import Mesh, MeshLine
from skfem.element import Element

from livepde.errors import ModelError, SpaceError
from livepde.fem.measure import Measure, unweighted
from livepde.fem.priors import CONSTANT, Evolution, Normal, Prior, RandomWalk
from livepde.fem.sobolev import Sobolev
from livepde.linalg import Array
from livepde.showing import expression

# Half width of the default trust region in prior standard deviations: the probability that a
# Gaussian value exceeds it is 2e-23.
WITHIN = 10.0
STANDARD = Normal()
# Complex step: its square is below the rounding error of any value, and no digits are cancelled.
STEP = 1e-30
RADIAL = 2  # degree of the volume element in spherical coordinates, x[0]**2

Integrand: TypeAlias = Callable[..., Any]
"""Integrand of a weak form; see `Model` for the arguments."""

Source: TypeAlias = float | Callable[[Any, float], Any] | Mapping[str, Any]
"""A source density: a number or f(x, t); for several components, a mapping from name to density."""

Predicate: TypeAlias = Callable[[Array], Any]
"""A subset of the domain: x of shape (d, ...) -> booleans of shape (...)."""


def stepped_by(value: Callable[[], Any], name: str) -> Array:
    """Return the derivative from the value of a function at arguments with a complex step.

    Raises
    ------
    ModelError
        The function does not accept complex numbers.
    """
    try:
        return np.asarray(np.imag(np.asarray(value()))) / STEP
    except TypeError as error:
        raise ModelError(
            f"{name} has no derivative by a complex step: {error}. Use functions that accept "
            "complex arrays, which np.interp and math.exp do not, or give the derivative (dA=, dB= "
            "of a model, derivative= of sensors)."
        ) from error


@dataclass(frozen=True)
class Channel:
    """A value from the stream, identified by the name of its channel.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> ends = {"left": lp.Channel("T_left")}
    >>> heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), ends).channels
    ('T_left',)
    """

    name: str


PlainValue: TypeAlias = float | Callable[[Any, float], Any] | Channel
BoundaryValue: TypeAlias = PlainValue | Sequence[PlainValue | None]


@dataclass(frozen=True)
class On:
    """A form on a named boundary or subdomain of the mesh instead of the whole domain.

    >>> flux = On("left", lambda v, x: x.inputs["Q"] * v)
    """

    name: str | Measure
    form: Integrand


def placed(integrand: Integrand | On) -> tuple[Integrand, str | Measure | None]:
    """Return an integrand, and the boundary or subdomain of its integral; None: all cells."""
    return (integrand.form, integrand.name) if isinstance(integrand, On) else (integrand, None)


def ignores(function: Any, position: int) -> bool:
    """Return whether a function ignores an argument, which it declares by the name `_`.

    Evaluation could not determine this, because a term may use an argument only at some times.

    >>> ignores(lambda u, v, x: -x.t * v, 0), ignores(lambda _, v, x: -x.t * v, 0)
    (False, True)
    """
    try:
        names = [*signature(function).parameters]
    except (TypeError, ValueError):  # the function is not written in Python
        return False
    return position < len(names) and names[position] == "_"


SIDES = (
    (("left", "right"),),
    (("left", "right"), ("bottom", "top")),
    (("left", "right"), ("front", "back"), ("bottom", "top")),
)


def with_sides(mesh: Any, regions: Mapping[str, Predicate] | None = None) -> Any:
    """Return a mesh of an interval, rectangle or box with named sides and regions."""
    ends = list(zip(mesh.p.min(axis=1), mesh.p.max(axis=1), strict=True))

    def at(axis: int, end: float) -> Predicate:
        # The tolerance is at rounding level. A share of the coordinate would include other nodes if
        # coordinates are large, as on a map, or if the mesh is small.
        low, high = ends[axis]
        slack = 1e-9 * (high - low) + 8 * float(np.finfo(float).eps) * max(abs(low), abs(high))
        return lambda p: np.abs(p[axis] - end) <= slack

    named = mesh.with_boundaries(
        {
            name: at(axis, end)
            for axis, names in enumerate(SIDES[len(ends) - 1])
            for name, end in zip(names, ends[axis], strict=True)
        }
    )
    return named.with_subdomains(dict(regions)) if regions else named


def interval(
    start: float,
    stop: float,
    cells: int,
    *,
    regions: Mapping[str, Predicate] | None = None,
    geometric: bool = False,
    through: Sequence[float] = (),
) -> MeshLine:
    """Return a mesh of [start, stop] with boundaries "left" and "right".

    Parameters
    ----------
    regions
        Named subdomains, each a predicate on the midpoints of the elements.
    geometric
        Whether elements grow by a constant ratio, as in radial problems; requires start > 0.
    through
        Points that must be nodes of the mesh: the nearest inner node is moved to each point, so
        that a `Subdomain` or a layer ends at a node, or a sensor is at a node.

    Examples
    --------
    >>> import livepde as lp
    >>> lp.interval(0.0, 0.4, 40).nelements
    40
    >>> graded = lp.interval(0.1, 1000.0, 60, geometric=True)
    """
    if not stop > start or cells < 1 or cells != int(cells):
        raise SpaceError(
            f"interval({start}, {stop}, {cells}): needs stop > start and cells >= 1, whole."
        )
    if geometric and not start > 0:
        raise SpaceError(f"interval({start}, {stop}, geometric=True): needs start > 0.")
    spaced = np.geomspace if geometric else np.linspace
    return with_sides(MeshLine(_moved(spaced(start, stop, int(cells) + 1), through)), regions)


def _moved(nodes: Array, through: Sequence[float]) -> Array:
    """Return the nodes with the nearest inner node moved to each of the points."""
    fitted = nodes.copy()
    nearest = [1 + int(np.abs(nodes[1:-1] - x).argmin()) if len(nodes) > 2 else 0 for x in through]
    inside = all(nodes[0] < x < nodes[-1] for x in through)
    if not inside or len(set(nearest)) < len(nearest) or 0 in nearest:
        raise SpaceError(
            f"interval: through={list(through)} needs points between {nodes[0]:g} and "
            f"{nodes[-1]:g}, each near its own inner node: use more cells."
        )
    fitted[nearest] = through
    return fitted


def line(nodes: Sequence[float]) -> MeshLine:
    """Return a mesh of an interval with the given nodes and boundaries "left" and "right"."""
    x = np.asarray(nodes, dtype=float)
    if x.ndim != 1 or len(x) < 2 or not (np.diff(x) > 0).all():
        raise SpaceError(f"line: needs at least two increasing nodes; got {x.tolist()}.")
    return with_sides(MeshLine(x))


def is_nodal(element: Element) -> bool:
    """Return whether coefficients are values at vertices or in cells: elements of first order."""
    inner = element.facet_dofs + element.edge_dofs
    return not inner and element.nodal_dofs + element.interior_dofs == 1


class _Declared:
    """Base class of all declarations: prior, evolution, trust region."""

    prior: Prior
    evolution: Evolution
    within: float

    @property
    def reach(self) -> float:
        """Largest distance of a latent value from the prior mean, in prior standard deviations."""
        return np.inf if isinstance(self.evolution, RandomWalk) else self.within

    @property
    def point_std(self) -> float:
        """Largest prior standard deviation of a latent value at a point; inf if unknown."""
        return self.prior.latent_std

    @cached_property
    def _ends(self) -> tuple[Array, Array]:
        """Values of q at latent values `reach` prior standard deviations from their mean."""
        farthest, mean = self.reach * self.point_std, self.prior.latent_mean
        with np.errstate(over="ignore"):
            low, high = (
                self.prior.transform.value(np.array(mean + s)) for s in (-farthest, farthest)
            )
        return low, high

    def interval(self, value: Any, std: Any, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends of the central interval with probability `level`.

        `value` and `std` are estimates and their standard deviations. The ends follow from the kind
        of distribution of the prior (`Prior.interval`). For `LogNormal` and `LogitNormal` they are
        also clipped to the trust region (`within`).
        """
        low, high = self.prior.interval(value, std, level)
        if not isinstance(self.prior, Normal):
            # Another law may report a value beyond the trust region; the interval must include it.
            value = np.asarray(value, dtype=float)
            lowest, largest = self._ends
            low = np.maximum(low, np.minimum(lowest, value))
            high = np.minimum(high, np.maximum(largest, value))
        return low, high

    def _check(self) -> None:
        kind = type(self).__name__
        if not isinstance(self.prior, Prior):
            raise SpaceError(f"{kind}: prior={self.prior!r:.60}; {_expected(self.prior)}.")
        if not isinstance(self.evolution, Evolution):
            raise SpaceError(
                f"{kind}: evolution={self.evolution!r}; expected RandomWalk(rate), "
                "MeanReverting(time) or Periodic(period), or nothing."
            )
        if not self.within > 0:
            raise SpaceError(f"{kind}: within must be a positive number; got {self.within}.")
        if self.evolution.copies > 1 and not self.prior.symmetric:
            raise SpaceError(
                f"{kind}: Periodic needs a prior without bounds and transform: a Normal."
            )


def _expected(given: Any) -> str:
    """Return advice for an error message on a value that is not a prior."""
    number = f"{given}" if isinstance(given, int | float) else "mean"
    return f"write Normal({number}, std), or LogNormal or LogitNormal with a median and a std"


@dataclass(frozen=True, eq=False)
class Field(_Declared):
    """A function on a mesh: the state u, or a parameter q(x).

    Parameters
    ----------
    mesh, element
        Any scikit-fem mesh and element; `quadrature` is the integration order (default: exact for
        A(u)q with polynomial factors).
    inner
        Inner product of a parameter: "L2", "H1", "H2", a `Sobolev(s, length)` for H^s of any order,
        or a symmetric bilinear form (u, v, x).
    dirichlet
        Essential boundary values: name of a boundary ("boundary" for the whole boundary) -> a
        number, a function g(x, t), or a `Channel` of the stream. A parameter admits only 0 (H^1_0).
        In a vector field the value is for all components, and g may return one array for each; a
        sequence has one value for each component, None if it is free.
    clamped
        Whether all coefficients on the boundaries of `dirichlet` are zero, including slopes.
        Otherwise only values are prescribed.
    prior
        Prior of a parameter: the inner product is divided by std**2, so that the prior covariance
        is the inverse Gram matrix. A `Normal` must not have bounds. A `LogNormal` or `LogitNormal`
        requires an element of first order, because it applies to values at nodes.
    evolution, within
        See `Scalar`.
    unit, name
        Unit and name in tables and plots.
    periodic
        Pairs of boundaries of equal shape, as in (("left", "right"),), whose coefficients are
        identified.
    weight
        Volume element of the coordinates of a state: `lambda x: x[0]` if x[0] is the distance from
        an axis, its square if it is the distance from a point. All integrals have this factor,
        including boundary integrals. Forms, means over regions and functionals are written without
        it, as in Cartesian coordinates.

    Examples
    --------
    >>> import livepde as lp
    >>> mesh = lp.interval(0.0, 1.0, 20)
    >>> state = lp.Field(
    ...     mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T_left")}, unit="degC"
    ... )
    >>> source = lp.Field(mesh, lp.linear(mesh), prior=lp.Normal(0.0, std=1.0), inner="H1")
    """

    mesh: Mesh
    element: Element
    inner: str | Sobolev | Integrand = "L2"
    dirichlet: Mapping[str, BoundaryValue] = field(default_factory=dict)
    prior: Prior = STANDARD
    unit: str = ""
    name: str = ""
    quadrature: int | None = None
    evolution: Evolution = CONSTANT
    periodic: Sequence[tuple[str, str]] = ()
    clamped: bool = False
    within: float = WITHIN
    weight: Callable[[Any], Any] = unweighted

    @property
    def order(self) -> int:
        """Quadrature order for a product of two such functions with the volume element."""
        if self.quadrature is not None:
            return self.quadrature
        return 2 * int(self.element.maxdeg) + (0 if self.weight is unweighted else RADIAL)

    @property
    def boundary_values(self) -> list[Any]:
        """The individual Dirichlet values: numbers, functions, channels."""
        return [item for value in self.dirichlet.values() for item in _each_value(value)]

    @property
    def boundary_text(self) -> str:
        """The Dirichlet values as text."""

        def shown(value: Any) -> str:
            if isinstance(value, Channel):
                return f"channel {value.name}"
            return expression(value) if callable(value) else f"{value}"

        return ", ".join(f"{name} = {shown(value)}" for name, value in self.dirichlet.items())

    @property
    def point_std(self) -> float:
        pointwise = isinstance(self.inner, Sobolev) and self.inner.factor != 1.0
        return math.sqrt(2.0) * self.prior.latent_std if pointwise else math.inf

    def __post_init__(self) -> None:
        if isinstance(self.inner, str) and self.inner not in ("L2", "H1", "H2"):
            raise SpaceError(
                f"inner='{self.inner}': expected 'L2', 'H1', 'H2', a Sobolev(s) or a symmetric "
                "form (u, v, x)."
            )
        boundaries = set(self.mesh.boundaries or {}) | {"boundary"}
        self._check_dirichlet(boundaries)
        # Arrays are stored as tuples, because comparison of arrays is elementwise.
        stated: Mapping[str, Any] = self.dirichlet
        hashable = {name: v if _is_plain(v) else tuple(v) for name, v in stated.items()}
        object.__setattr__(self, "dirichlet", hashable)
        if self.clamped and (not hashable or any(value != 0.0 for value in hashable.values())):
            raise SpaceError(
                'clamped=True fixes values and slopes to zero: give dirichlet={"boundary": 0.0}, '
                "and no other value."
            )
        self._check_periodic(boundaries)
        self._check()
        self._check_pointwise()

    def _check_dirichlet(self, known: set[str]) -> None:
        for name, value in self.dirichlet.items():
            if name not in known:
                raise SpaceError(
                    f"dirichlet: the mesh has no boundary '{name}'; it has {sorted(known)}."
                )
            if any(isinstance(item, _Declared | Prior) for item in _each_value(value)):
                raise SpaceError(
                    f"dirichlet: the value on '{name}' is unknown; let it enter weakly, by a "
                    f"penalty: On('{name}', lambda q, u, v, x: 100 * D / x.h * (u - q.value) * v)."
                )
            for item in _each_value(value):
                if isinstance(item, str):
                    raise SpaceError(
                        f"dirichlet: the value on '{name}' is the text {item!r}; for a channel of "
                        f"the stream, give Channel({item!r})."
                    )

    def _check_periodic(self, known: set[str]) -> None:
        for name in chain.from_iterable(self.periodic):
            if name not in known - {"boundary"}:
                raise SpaceError(
                    f"periodic: the mesh has no boundary '{name}'; it has {sorted(known)}."
                )
            if {name, "boundary"} & set(self.dirichlet):
                raise SpaceError(
                    f"'{name}' is periodic and has a Dirichlet value: leave one of both out, and "
                    'name the other boundaries instead of "boundary".'
                )

    def _check_pointwise(self) -> None:
        # A bound on q(x) holds everywhere only if coefficients are values at nodes.
        if isinstance(self.prior, Normal):
            if not self.prior.symmetric:
                raise SpaceError("Field: bounds need a LogNormal or LogitNormal, which keeps them.")
        elif not is_nodal(self.element) or self.dirichlet:
            raise SpaceError(
                f"Field: a {type(self.prior).__name__} holds for values at nodes: take an element "
                "of first order and no boundary values."
            )


def _is_plain(value: Any) -> bool:
    """Return whether a boundary value is a single value instead of one for each component."""
    return callable(value) or isinstance(value, Channel | _Declared | Prior) or np.ndim(value) == 0


def _each_value(value: Any) -> Sequence[Any]:
    """Return the given values of a boundary, without None."""
    return [value] if _is_plain(value) else [item for item in value if item is not None]


@dataclass(frozen=True, eq=False)
class Scalar(_Declared):
    """One unknown number. A prior alone is equivalent, with default options.

    Parameters
    ----------
    prior
        `Normal`, `LogNormal` or `LogitNormal`, in `unit`.
    evolution
        Model of the change in time: `RandomWalk`, `MeanReverting`, `Periodic`; default constant.
    within
        Trust region of the sensitivity law: maximum distance of the latent value (q itself, its
        logarithm or its logit) from the prior mean, in prior standard deviations. It limits the
        linearisation point and the reported estimate, and the note "bounded" counts the values at
        the limit. inf: no limit. A `RandomWalk` has no limit, because its prior does not apply to
        later values.
    corrects
        Whether it is a correction of an input, such as an offset of a boundary value. Its
        uncertainty does not affect the level of a verdict, as with sensor errors.

    Examples
    --------
    >>> import livepde as lp
    >>> lp.Scalar(lp.LogNormal(1e-4, std=5e-5), unit="m^2/s").unit
    'm^2/s'
    """

    prior: Prior
    unit: str = ""
    evolution: Evolution = CONSTANT
    within: float = WITHIN
    corrects: bool = False

    def __post_init__(self) -> None:
        self._check()


@dataclass(frozen=True, eq=False)
class Piecewise(_Declared):
    """One unknown number for each named region, with common or separate priors.

    Parameters
    ----------
    regions
        Name -> predicate on x, or the name of a subdomain of the mesh. The value is zero at a point
        in no region, and the sum at a point in several regions.
    prior, unit, evolution, within
        See `Scalar`.
    own
        Name of a region -> separate prior of a constant there, or a `Scalar` with prior, evolution
        and within. The unknown then requires a name: parameter={"k": Piecewise(...)}.

    Examples
    --------
    >>> import livepde as lp
    >>> layers = {"sand": lambda x: x[0] < 0.2, "clay": lambda x: x[0] >= 0.2}
    >>> k = lp.Piecewise(layers, lp.LogNormal(1.5, std=0.5), unit="W/(m K)")
    >>> list(k.regions)
    ['sand', 'clay']
    """

    regions: Mapping[str, Predicate | str]
    prior: Prior
    unit: str = ""
    evolution: Evolution = CONSTANT
    within: float = WITHIN
    own: Mapping[str, Prior | Scalar] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.regions:
            raise SpaceError("Piecewise: needs at least one region.")
        for name, unknown in self.own.items():
            if name not in self.regions or not isinstance(unknown, Prior | Scalar):
                raise SpaceError(
                    f"Piecewise: own={{'{name}': {unknown!r:.60}}}; expected the name of a region, "
                    f"one of {list(self.regions)}, and a prior or a Scalar."
                )
        self._check()

    def separated(self, name: str) -> dict[str, Piecewise]:
        """Return name -> unknown for each region, such as "k[soil]"; itself with a common prior."""
        if not self.own:
            return {name: self}
        pieces = {}
        for region, where in self.regions.items():
            stated = self.own.get(region, self)
            part = Scalar(stated) if isinstance(stated, Prior) else stated
            pieces[f"{name}[{region}]"] = Piecewise(
                {region: where}, part.prior, part.unit or self.unit, part.evolution, part.within
            )
        return pieces


@dataclass(frozen=True, eq=False)
class Scalars(_Declared):
    """One unknown number for each name, with a common prior, such as an offset of each sensor.

    In forms and sensors it is a mapping, q.offset["T_10"]. See `Scalar` for other options.

    Examples
    --------
    >>> import livepde as lp
    >>> lp.Scalars(["T_10", "T_30"], lp.Normal(0.0, std=0.2), unit="K").names
    ['T_10', 'T_30']
    """

    names: Sequence[str]
    prior: Prior
    unit: str = ""
    evolution: Evolution = CONSTANT
    within: float = WITHIN

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) != len(self.names):
            raise SpaceError(f"Scalars: names must be given and differ; got {list(self.names)}.")
        self._check()


Declaration: TypeAlias = Field | Scalar | Piecewise | Scalars
"""An unknown with its options."""

Unknown: TypeAlias = Declaration | Prior
"""Types that a model accepts as an unknown; a prior alone declares one number."""


def declared(unknown: Unknown) -> Declaration:
    """Return an unknown with its options; a prior alone becomes a `Scalar` with defaults."""
    if isinstance(unknown, Prior):
        return Scalar(unknown)
    if not isinstance(unknown, Declaration):
        raise SpaceError(
            f"got {unknown!r:.60} as an unknown; {_expected(unknown)}, or Scalar, Piecewise, "
            "Scalars or Field."
        )
    return unknown


SERIES = (1 / 3, -1 / 45, 2 / 945, -1 / 4725, 2 / 93555, -1382 / 638512875)
# Square of the Peclet number below which the truncated series is exact up to rounding.
SMALL = 0.01


def absolute(a: Any) -> Any:
    """Return |a|, with the sign of a as its derivative."""
    a = np.asarray(a)
    return np.where(a.real < 0.0, -a, a)


def maximum(a: Any, b: Any) -> Any:
    """Return the larger of two values, pointwise, with its derivative."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a.real >= b.real, a, b)


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two values, pointwise, with its derivative."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a.real <= b.real, a, b)


def positive(a: Any) -> Any:
    """Return max(a, 0)."""
    return maximum(a, 0.0)


def upwind(b: Any, kappa: Any, h: Any) -> Any:
    """Return the optimal artificial diffusion, |b| h/2 (coth Pe - 1/Pe) with Pe = |b| h/(2 kappa).

    If it is added to kappa, elements of first order on a uniform interval are exact at the vertices
    for the steady -kappa u'' + b u' = 0. This holds for any cell Peclet number Pe (Brooks and
    Hughes 1982, section 2). It vanishes like h^2 on fine meshes. In more dimensions it acts only
    along streamlines. It is smooth also at b = 0, so that complex steps are valid.

    Parameters
    ----------
    b
        Velocity: a number or array in 1D, otherwise a tuple or list of d components.
    kappa
        Diffusivity, positive.
    h
        Size of the cells, `x.h` in a form.

    Returns
    -------
    A number for each point in 1D, otherwise its product with b b^T/|b|^2, shape (d, d, ...).

    Examples
    --------
    >>> import livepde as lp
    >>> k = 0.01
    >>> line = lambda u, v, x: (k + upwind(2.0, k, x.h)) * lp.dot(lp.grad(u), lp.grad(v))
    >>> def plane(u, v, x):
    ...     return lp.dot(lp.fem.mul(upwind((2.0, x[0]), k, x.h), lp.grad(u)), lp.grad(v))
    >>> round(float(upwind(2.0, k, 0.1)), 6)  # nearly |b| h/2
    0.09
    """
    components = list(b) if isinstance(b, Sequence) else [b]
    square = sum(part * part for part in components)
    factor = h * h / (4.0 * kappa) * _even(square * (h / (2.0 * kappa)) ** 2)
    if not isinstance(b, Sequence):
        return factor * square
    rows = [[factor * p * q for q in components] for p in components]
    flat = np.broadcast_arrays(*(entry for row in rows for entry in row))
    return np.stack(flat).reshape(len(rows), len(rows), *flat[0].shape)


def _even(w: Any) -> Any:
    """Return (coth z - 1/z)/z with w = z^2: analytic in w, also at zero."""
    w = np.asarray(w)
    small = np.abs(w) < SMALL
    z = np.sqrt(np.where(small, 1.0, w))
    decay = np.exp(-2.0 * z)
    closed_form = ((1.0 + decay) / (1.0 - decay) - 1.0 / z) / z
    series = np.polynomial.polynomial.polyval(np.where(small, w, 0.0), SERIES)
    return np.where(small, series, closed_form)
