"""Latent coefficients a with a Gaussian prior, the unknowns of laws: q = V T(a).

Without transforms and harmonics, the latent coefficients are the coefficients of q. `Coefficients`
are numbers computed from q in which a form is linear, such as k/C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import SpaceError
from livepde.fem.fields import STEP, Declaration, Integrand, On, Scalars, declared, placed
from livepde.fem.forms import Form, FormMatrices
from livepde.fem.measure import START, Moment
from livepde.fem.priors import Evolution, Identity, Normal, Transform
from livepde.fem.space import FunctionSpace, Named
from livepde.linalg import Array, IntArray, Pattern, sandwich


def numbers(parameter: FunctionSpace, q: Array) -> Any:
    """Return the parameter as an argument of sensor functions: numbers, arrays or mappings."""
    values: dict[str, Any] = {}
    for name in parameter.names:
        part = q[parameter.part(name)]
        unknown = parameter.unknowns.get(name)
        if isinstance(unknown, Scalars):
            values[name] = dict(zip(unknown.names, part, strict=True))
        else:
            values[name] = part[0] if len(part) == 1 else part
    if parameter.single:
        return next(iter(values.values()))
    return Named(**values)


@dataclass(frozen=True, eq=False)
class Coefficients:
    """Unknowns q, followed by numbers c(q) that forms use as q.name.

    Parameters
    ----------
    parameter
        Space of the unknowns, each with a name.
    function
        Analytic function q -> {name: value}, of numbers or of pointwise values in forms.
    typical
        Unknowns at which the function is defined, shape (m,).
    """

    parameter: FunctionSpace
    function: Callable[[Any], Mapping[str, Any]]
    typical: Array

    @cached_property
    def _computed(self) -> Mapping[str, Any]:
        """Values for typical unknowns; arrays if they depend on unknowns that vary in space."""
        named = vars(numbers(self.parameter, self.typical))
        # Reduce arrays to one entry: regions and nodes of different unknowns differ in number.
        single = {name: v[:1] if isinstance(v, np.ndarray) else v for name, v in named.items()}
        return self.function(Named(**single))

    @property
    def names(self) -> list[str]:
        """Names of the computed numbers."""
        return list(self._computed)

    @property
    def numeric(self) -> bool:
        """Whether no computed number depends on an unknown that varies in space."""
        return all(np.ndim(value) == 0 for value in self._computed.values())

    @cached_property
    def space(self) -> FunctionSpace:
        """Space of the unknowns and the computed numbers, of dimension p."""
        added = dict.fromkeys(self.names, declared(Normal(0.0, std=1.0)))
        return FunctionSpace({**self.parameter.unknowns, **added}, single=False)

    def value(self, q: Array) -> Array:
        """Return (q, c(q)), shape (p,), for unknowns of shape (m,)."""
        computed = self.function(numbers(self.parameter, q)).values()
        return np.concatenate([q, np.array([*computed], dtype=q.dtype)])

    def slopes(self, q: Array) -> Array:
        """Return the derivative of `value`, shape (p, m), by a complex step."""
        slopes = np.zeros((self.space.dim, len(q)))
        slopes[: len(q)] = np.eye(len(q))
        for column in self.parameter.labels.values():
            stepped = q.astype(complex)
            stepped[column] += 1j * STEP
            slopes[len(q) :, column] = np.imag(self.value(stepped)[len(q) :]) / STEP
        return slopes

    def expanded(self, terms: Integrand | On | Sequence[Integrand | On]) -> list[Integrand | On]:
        """Return terms that depend only on unknowns and compute the numbers at each point."""

        def one(term: Any) -> Any:
            form, where = placed(term)

            @wraps(form)  # to preserve the names of its arguments
            def integrand(q: Any, *others: Any) -> Any:
                return form(Named(**vars(q), **self.function(q)), *others)

            return integrand if where is None else On(where, integrand)

        return [one(term) for term in (terms if isinstance(terms, Sequence) else [terms])]


@dataclass(frozen=True, eq=False)
class LatentPart:
    """Latent coefficients of one unknown, in the order (copies, size).

    `unknown` and `block` are its declaration and its block in the function space. `part` is the
    slice of its coefficients among all latent coefficients.
    """

    name: str
    unknown: Declaration
    block: Any
    part: slice

    @cached_property
    def transform(self) -> Transform:
        """Transform T of the unknown."""
        return self.unknown.prior.transform

    @property
    def evolution(self) -> Evolution:
        """Evolution model of the unknown."""
        return self.unknown.evolution

    @property
    def size(self) -> int:
        """Number of coefficients of q."""
        return int(self.block.size)


class Latent:
    """Map q = V T(a) from latent to physical coefficients of a function space, and the prior.

    T acts elementwise (`Prior.transform`). V sums the components of unknowns with harmonics
    (`Periodic`).
    """

    def __init__(self, space: FunctionSpace) -> None:
        self.space = space
        self.parts: dict[str, LatentPart] = {}
        start = 0
        for name, block in space.blocks.items():
            unknown = space.unknowns[name]
            stop = start + block.size * unknown.evolution.copies
            self.parts[name] = LatentPart(name, unknown, block, slice(start, stop))
            start = stop
        self.dim = start

    @cached_property
    def plain(self) -> bool:
        """Whether the latent coefficients are the coefficients of q."""
        return self.dim == self.space.dim and self.linear

    @cached_property
    def linear(self) -> bool:
        """Whether q is linear in the latent coefficients."""
        return all(isinstance(p.transform, Identity) for p in self.parts.values())

    @cached_property
    def moves(self) -> bool:
        """Whether an unknown varies in time."""
        return any(p.evolution.moves for p in self.parts.values())

    @cached_property
    def random(self) -> tuple[str, ...]:
        """Names of the unknowns with a random evolution."""
        return tuple(name for name, p in self.parts.items() if p.evolution.growth(1.0, 1.0).any())

    @cached_property
    def V(self) -> sp.csr_array:
        """Summation matrix of the visible components, shape (m, dim)."""
        parts = self.parts.values()
        blocks = [sp.kron(p.evolution.visible[None], sp.eye_array(p.size)) for p in parts]
        return sp.csr_array(sp.block_diag(blocks, format="csr"))

    def visible(self, each: Array) -> Array:
        """Return V times an array with rows for latent coefficients, (dim,) or (dim, k)."""
        return each if self.dim == self.space.dim else self.V @ each  # V = 1 without harmonics

    def _each(self, a: Array, function: str) -> Array:
        with np.errstate(over="ignore"):
            pieces = [getattr(p.transform, function)(a[p.part]) for p in self.parts.values()]
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)

    def value(self, a: Array) -> Array:
        """Return the coefficients of q, shape (m,), from latent coefficients of shape (dim,)."""
        if self.plain:
            return a
        return self.visible(self._each(a, "value"))

    def slopes(self, a: Array) -> Array:
        """Return T' of each latent coefficient, shape (dim,)."""
        return self._each(a, "slope")

    def curvatures(self, a: Array) -> Array:
        """Return T'' of each latent coefficient, shape (dim,)."""
        return self._each(a, "curvature")

    def tangent(self, a: Array, directions: Array) -> Array:
        """Return dq/da applied to columns of shape (dim, k): shape (m, k)."""
        if self.plain:
            return directions
        return self.visible(self.slopes(a)[:, None] * directions)

    def tangents(self, a: Array, directions: Array) -> Array:
        """Return dq/da applied to columns of several a, (members, dim): shape (members, m, k)."""
        if self.plain:
            return directions
        # A contiguous copy, because NumPy may round differently for strided arrays.
        tangents = self.slopes(a.T.copy()).T[:, :, None] * directions
        if self.dim == self.space.dim:
            return np.asarray(tangents)
        return np.array([self.visible(columns) for columns in tangents])

    def deviation(self, a: Array, std: Array) -> Array:
        """Return standard deviations of q, (m,), for independent latent coefficients, (dim,)."""
        if self.plain:
            return std
        parts = self.slopes(a) * std
        if self.dim == self.space.dim:
            return parts
        deviation: Array = np.sqrt(self.V**2 @ parts**2)
        return deviation

    def inverse(self, q: Array) -> Array:
        """Return latent coefficients of q; harmonics are zero.

        Raises
        ------
        SpaceError
            q is outside the range of a transform.
        """
        if self.plain:
            return q
        a = np.zeros(self.dim)
        for p in self.parts.values():
            inside = p.transform.inverse(q[self.space.part(p.name)])
            if not np.isfinite(inside).all():
                raise SpaceError(
                    f"'{p.name}': a value is not strictly inside the bounds "
                    f"{p.unknown.prior.bounds} of its {type(p.unknown.prior).__name__} prior."
                )
            a[p.part.start : p.part.start + p.size] = inside
        return a

    def _filled(self, values: Sequence[float]) -> Array:
        """Return one number per unknown, repeated for each of its latent coefficients."""
        return np.repeat(values, [p.part.stop - p.part.start for p in self.parts.values()])

    @cached_property
    def prior(self) -> Array:
        """Prior mean of the latent coefficients, shape (dim,); zero for fixed coefficients."""
        prior = self.inverse(self.space.prior).copy()
        prior[self.fixed] = 0.0
        return prior

    @cached_property
    def origin(self) -> Array:
        """Reference of latent coefficients, shape (dim,): zero, or the prior mean with a transform.

        Zero is not a suitable reference of a logarithm, because it depends on the unit of q.
        """
        origin = self.prior.copy()
        for p in self.parts.values():
            if isinstance(p.transform, Identity):
                origin[p.part] = 0.0
        return origin

    @cached_property
    def deviations(self) -> Array:
        """Prior standard deviation of each latent coefficient, shape (dim,)."""
        return self._filled([p.unknown.prior.latent_std for p in self.parts.values()])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the latent coefficients, which laws must respect."""
        lower, upper = zip(
            *(p.unknown.prior.latent_bounds for p in self.parts.values()), strict=True
        )
        return self._filled(lower), self._filled(upper)

    @cached_property
    def bounded(self) -> bool:
        """Whether a latent coefficient has a bound."""
        return any(bool(np.isfinite(bound).any()) for bound in self.bounds)

    def clipped(self, a: Array) -> Array:
        """Return latent coefficients clipped to their bounds."""
        lower, upper = self.bounds
        return np.minimum(np.maximum(a, lower), upper) if self.bounded else a

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the coefficients of q, each of shape (m,)."""
        parts = self.parts.values()
        lower, upper = (
            np.repeat([p.unknown.prior.bounds[k] for p in parts], [p.size for p in parts])
            for k in (0, 1)
        )
        return lower, upper

    @cached_property
    def fixed(self) -> IntArray:
        """Latent coefficients fixed at zero by boundary conditions."""
        fixed_dofs = []
        for p in self.parts.values():
            if p.name in self.space.fields:
                fixed = self.space.fields[p.name].fixed
                # All components of a harmonic satisfy the boundary conditions of the field.
                fixed_dofs += [fixed + p.part.start + c * p.size for c in range(p.evolution.copies)]
        return np.concatenate(fixed_dofs) if fixed_dofs else np.zeros(0, dtype=np.int64)

    @cached_property
    def generator(self) -> sp.csr_array:
        """Drift matrix K of the evolutions, d(a - prior)/dt = K (a - prior) + noise, (dim, dim)."""
        blocks = [sp.kron(p.evolution.generator, sp.eye_array(p.size)) for p in self.parts.values()]
        return sp.csr_array(sp.block_diag(blocks, format="csr"))

    def moved(self, a: Array, h: float) -> Array:
        """Return the expected latent coefficients after a time h."""
        if not self.generator.nnz:
            return a
        # Evolutions are linear about the prior mean, so the difference to it is propagated.
        change = a - self.prior
        for p in self.parts.values():
            parts = change[p.part].reshape(p.evolution.copies, p.size)
            change[p.part] = (p.evolution.transition(h) @ parts).ravel()
        return self.prior + change


class Composed(FormMatrices):
    """A form composed with q = V T(a): a function of latent coefficients instead of q."""

    def __init__(self, form: Form, latent: Latent) -> None:
        self.form = form
        self.latent = latent
        self._maps: dict[tuple[str, str], tuple[Pattern, sp.csr_array | None]] = {}

    def on(self, cells: IntArray) -> Composed:
        return Composed(self.form.on(cells), self.latent)

    @property
    def affine(self) -> bool:
        return self.form.affine

    @property
    def constant(self) -> bool:
        return self.form.constant

    @property
    def steady(self) -> bool:
        return self.form.steady

    @property
    def linear_in_parameter(self) -> bool:
        """Whether the form is linear in the latent coefficients."""
        return self.latent.linear and self.form.linear_in_parameter

    def differentiates(self, slot: str, test: str = "v") -> bool:
        return self.form.differentiates(slot, test)

    def _physical(self, coefficients: dict[str, Array]) -> dict[str, Array]:
        if "q" not in coefficients:
            return coefficients
        return {**coefficients, "q": self.latent.value(coefficients["q"])}

    def vector(self, slot: str, moment: Moment = START, **coefficients: Array) -> Array:
        return self.form.vector(slot, moment, **self._physical(coefficients))

    def pattern(self, rows: str, cols: str) -> Pattern:
        return self._mapped(rows, cols)[0]

    def _mapped(self, rows: str, cols: str) -> tuple[Pattern, sp.csr_array | None]:
        """Return the pattern, and the map from the data of the form in q; None: the identity."""
        if (rows, cols) not in self._maps:
            inner, V, dim = self.form.pattern(rows, cols), self.latent.V, self.latent.dim
            if (rows, cols) != ("q", "q") and dim == self.latent.space.dim:  # no harmonics
                self._maps[rows, cols] = (inner, None)
                return self._maps[rows, cols]
            left = sp.csr_array(V.T) if rows == "q" else sp.eye_array(inner.shape[0])
            right = V if cols == "q" else sp.eye_array(inner.shape[1])
            i, j, weights = sandwich(left, inner, right)
            shape = (left.shape[0], right.shape[1])
            # The second derivative in a has entries on the diagonal that the form in q may lack.
            diagonal = np.arange(dim if rows == cols == "q" else 0)
            pattern = Pattern.from_entries(np.append(i, diagonal), np.append(j, diagonal), shape)
            self._maps[rows, cols] = (pattern, sp.csr_array(pattern.gather(i, j) @ weights))
        return self._maps[rows, cols]

    def data(self, rows: str, cols: str, moment: Moment = START, **coefficients: Array) -> Array:
        pattern, mapped = self._mapped(rows, cols)
        physical = self._physical(coefficients)
        data = self.form.data(rows, cols, moment, **physical)
        if mapped is not None:
            data = mapped @ data
        if "q" not in (rows, cols):
            return data
        a = coefficients.get("q", np.zeros(self.latent.dim))
        # Chain rule: T' scales the rows and columns of q.
        if not self.latent.linear:
            slopes = self.latent.slopes(a)
            if rows == "q":
                data = data * slopes[pattern.rows]
            if cols == "q":
                data = data * slopes[pattern.indices]
        if rows == cols == "q":
            # Chain rule: T'' times the derivative of the form in q, which is zero for a linear T.
            test = {key: value for key, value in physical.items() if key != "v"}
            force = self.form.matrix("v", "q", moment, **test).T @ physical["v"]
            at = np.arange(self.latent.dim)
            curvature = self.latent.curvatures(a) * (self.latent.V.T @ force)
            data[pattern.positions(at, at)] += curvature
        return data

    def tensor(self, rows: str, cols: str) -> sp.csr_array | None:
        """Return None: the data are not linear in the third argument."""
        return None


def compose(form: Form, latent: Latent) -> Form | Composed:
    """Return the form in latent coefficients; the form itself if they are coefficients of q."""
    return form if latent.plain else Composed(form, latent)
