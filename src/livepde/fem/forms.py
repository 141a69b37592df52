"""Weak forms: evaluation, differentiation and assembly of integrands.

A form is a scalar functional of several functions, `integral of a(q, u, v, x)`. Each function is
evaluated with the shape functions of *its own* space, so that exchanged spaces of equal size do not
go unnoticed. Laws only require a first derivative (`vector`) or a mixed second derivative (`data`)
of this functional:

    A(u) q          = vector("v", q=q, u=u)
    A(u)            = data("v", "q", u=u)          its transpose has the same data: exact
    d(A(u) q)/du    = data("v", "u", q=q, u=u)
    d(A(u)^T r)/du  = data("q", "u", u=u, v=r)

Arguments in which the form is linear are replaced by unit jets. Derivatives in other arguments use
a complex step at the quadrature points. It is exact up to rounding if the integrand is analytic,
and requires no library for automatic differentiation. For abs, max or comparison of u, the user
provides a form of the derivative; `check_model` reports if it is missing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from livepde.errors import LivepdeError, ModelError
from livepde.fem.elementwise import ElementTensor, Scatter, TensorTerm, scatter
from livepde.fem.fields import STEP, Integrand, On, ignores, placed, stepped_by
from livepde.fem.measure import START, Inputs, Measure, Moment, Place
from livepde.fem.space import FunctionSpace, LocalSpace, volume_element
from livepde.linalg import Array, IntArray, Pattern

Tensor: TypeAlias = sp.csr_array | ElementTensor

# Magnitude below which a value is not the scale of a difference, relative to the largest value or
# the prior standard deviation of its component.
SMALL = 1e-3
# Relative step of a central difference of fourth order: truncation and rounding errors are about
# 1e-13.
SHIFT = 1e-3
# Sizes of random arguments for tests of an integrand, up to 1e9 to detect saturation and thresholds
# far from one; and times for these tests, because a term may act only temporarily.
MAGNITUDES = (1e-3, 1.0, 1e3, 1e6, 1e9)
PROBED = (0.0, 0.3, 1.0, 1e3, 1e6)
# Largest number of products of local functions for which a trilinear form is stored as a sparse
# matrix. Beyond, element tensors require less memory.
LARGEST_TENSOR = 5_000_000
FEW = 12  # most unknown numbers for which a form that is nonlinear in them is cached for fixed q


@dataclass(frozen=True, eq=False)
class _Term:
    """One integrand on one measure, with the local space of every argument.

    `derivative`: integrand of the derivative in the nonlinear argument, or None.
    """

    integrand: Integrand
    measure: Measure
    over: Mapping[str, FunctionSpace]
    derivative: Integrand | None

    @cached_property
    def spaces(self) -> dict[str, LocalSpace]:
        """Local space of each argument; arguments of the same space share one object."""
        by_space = {id(space): space.local(self.measure) for space in self.over.values()}
        return {key: by_space[id(space)] for key, space in self.over.items()}

    def pieces(self) -> Iterator[tuple[slice, _Term]]:
        """Yield (slice of elements, term on them), small enough to evaluate at once."""
        if self.measure.kept:
            yield slice(0, self.measure.shape[0]), self
            return
        for at, piece in self.measure.pieces():
            yield at, replace(self, measure=piece)

    def samples(self) -> Iterator[_Term]:
        """Yield the term at one or all points of every element, for tests of the integrand."""
        thin = (
            self if self.measure.kept else replace(self, measure=replace(self.measure, thin=True))
        )
        for _, piece in thin.pieces():
            yield piece

    def drawn(self, rng: np.random.Generator) -> dict[str, Array]:
        """Return argument -> random component values at all points."""
        return {
            key: rng.standard_normal((local.components, *local.shape))
            for key, local in self.spaces.items()
        }

    def along(
        self, slot: str, values: Mapping[str, Array], moment: Moment
    ) -> Callable[[Array], Array]:
        """Return the integrand as a function of component values of one argument."""
        return lambda x: np.asarray(self.evaluate({**values, slot: x}, moment)[0])

    def evaluate(self, values: Mapping[str, Array], moment: Moment) -> tuple[Any, Place]:
        place = self.measure.place(moment)
        jets = [self.spaces[name].jets(array) for name, array in values.items()]
        return self.integrand(*jets, place), place


class FormMatrices(ABC):
    """Abstract class of matrices of mixed derivatives with fixed sparsity."""

    @abstractmethod
    def pattern(self, rows: str, cols: str) -> Pattern:
        """Return the sparsity pattern of the matrices `data(rows, cols)`."""

    @abstractmethod
    def data(self, rows: str, cols: str, moment: Moment = START, **coefficients: Array) -> Array:
        """Return the mixed derivative in `rows` and `cols`, as data of `pattern(rows, cols)`."""

    def matrix(
        self, rows: str, cols: str, moment: Moment = START, **coefficients: Array
    ) -> sp.csr_array:
        """Return `data(...)` as a CSR matrix."""
        return self.pattern(rows, cols).matrix(self.data(rows, cols, moment, **coefficients))

    def product(
        self, rows: str, cols: str, x: Array, moment: Moment = START, **coefficients: Array
    ) -> Array:
        """Return `matrix(...) @ x` for x of shape (m,) or (m, k)."""
        data = self.data(rows, cols, moment, **coefficients)
        return self.pattern(rows, cols).product(data, x)


class Form(FormMatrices):
    """A sum of integrals, linear in every argument not named in `nonlinear`.

    Parameters
    ----------
    name
        Letter for messages: A, B, M, ...
    integrands
        One or several integrands; `On` restricts an integrand to a boundary or subdomain. Each is
        called with one jet per argument, in the order of `spaces`, and the place x.
    spaces
        Mapping from argument to function space.
    order
        Quadrature order.
    nonlinear
        The argument u, in which the form may be nonlinear.
    parameter
        The argument q; a numerical test determines whether the form is linear in it.
    derivative
        Optional integrand of the derivative in the nonlinear argument. The direction follows this
        argument, as in dB(u, du, v, x).
    inputs
        Names of the input channels that integrands may use.
    """

    def __init__(
        self,
        name: str,
        integrands: Integrand | On | Sequence[Integrand | On],
        spaces: Mapping[str, FunctionSpace],
        mesh: Any,
        order: int,
        nonlinear: str | None = None,
        derivative: Integrand | Sequence[Integrand] | None = None,
        inputs: Sequence[str] = (),
        parameter: str | None = None,
    ) -> None:
        items = integrands if isinstance(integrands, Sequence) else [integrands]
        derivatives = derivative if isinstance(derivative, Sequence) else [derivative] * len(items)
        if len(derivatives) != len(items):
            raise ModelError(
                f"Form {name}: give one derivative for each of its {len(items)} terms."
            )
        self.name = name
        self.spaces = dict(spaces)
        self.nonlinear = nonlinear
        self.parameter = parameter
        self.terms: list[_Term] = []
        weight = volume_element(spaces.values())
        for item, derivative_of_item in zip(items, derivatives, strict=True):
            integrand, where = placed(item)
            at = where if isinstance(where, Measure) else Measure(mesh, order, where, weight=weight)
            self.terms.append(_Term(integrand, at, self.spaces, derivative_of_item))
        self._inputs = Inputs(dict.fromkeys(inputs, 1.0))
        self._forget()
        self._moving: list[bool] = []  # whether a term uses time or inputs, and the state
        self.uses: frozenset[str] = self._probe()
        for slot in self.spaces:
            if slot not in (nonlinear, parameter):
                self._check_linear(slot)
        self.linear_in_parameter = parameter is None or self._affine(parameter, homogeneous=True)
        self._curved = {nonlinear} if self.linear_in_parameter else {nonlinear, parameter}

    def _forget(self) -> None:
        self._constants: dict[tuple[str, str], Array] = {}
        self._affine_parts: dict[tuple[str, str], tuple[sp.csr_array, Array]] = {}
        self._tensors: dict[tuple[str, str], Tensor] = {}
        self._scatters: dict[tuple[str, str], Scatter] = {}
        self._products: list[TensorTerm] | None = None
        self._about: FormAbout | None = None

    def on(self, cells: IntArray) -> Form:
        """Return the form restricted to given cells of the mesh, and to their facets.

        Terms without such cells are omitted. Coefficients refer to the whole mesh; patterns contain
        only the couplings of these cells.
        """
        part = copy(self)
        terms = [replace(term, measure=term.measure.on(cells)) for term in self.terms]
        part.terms = [term for term in terms if term.measure.shape[0]]
        part._forget()
        return part

    def _probe(self) -> frozenset[str]:
        """Evaluate once, to detect errors early; return which of "t" and "inputs" are used."""
        rng = np.random.default_rng(0)
        used: set[str] = set()
        for term in self.terms:
            read = set().union(*(self._read(piece, rng) for piece in term.samples()))
            used |= read
            # A term that ignores the nonlinear argument does not affect the derivative in it.
            moves = self.nonlinear is not None and not ignores(
                term.integrand, list(self.spaces).index(self.nonlinear)
            )
            self._moving.append(bool(read) and moves)
        return frozenset(used)

    def _read(self, term: _Term, rng: np.random.Generator) -> set[str]:
        """Evaluate a term at random values; return which of "t" and "inputs" it uses."""
        try:
            with np.errstate(all="ignore"):  # roots and logarithms of random numbers
                density, place = term.evaluate(term.drawn(rng), Moment(0.0, self._inputs))
            shape = np.broadcast_shapes(np.shape(density), term.measure.shape)
        except LivepdeError:
            raise
        except Exception as error:
            raise ModelError(
                f"Form {self.name}({', '.join(self.spaces)}, x) failed at its first "
                f"evaluation, for arrays (elements, points): {type(error).__name__}: {error}"
            ) from error
        if shape != term.measure.shape:
            raise ModelError(
                f"Form {self.name}({', '.join(self.spaces)}, x) gave shape "
                f"{np.shape(density)} where a scalar per point is expected: is a dot(...) "
                "or a component index missing?"
            )
        return place.used

    def _check_linear(self, slot: str) -> None:
        """Raise an error if a term is not linear in an argument, such as the test function."""
        rng = np.random.default_rng(3)
        for number, piece in enumerate(self.terms):
            for term in piece.samples():
                values = term.drawn(rng)
                at, value = term.along(slot, values, Moment(0.3, self._inputs)), values[slot]
                second = rng.standard_normal(value.shape)
                with np.errstate(all="ignore"):  # roots and logarithms of random numbers
                    parts = at(value), at(second), at(value + second)
                    size = np.abs(parts[0]) + np.abs(parts[1]) + np.abs(parts[2])
                    wrong = np.abs(parts[2] - parts[0] - parts[1]) > 1e-9 * size  # false for NaN
                    if not wrong.any():
                        continue
                    lacks = np.abs(at(np.zeros_like(value)))[wrong].any()
                which = f", term {number + 1}" if len(self.terms) > 1 else ""
                why = f"has a part without {slot}" if lacks else f"is not linear in {slot}"
                raise ModelError(
                    f"Form {self.name}({', '.join(self.spaces)}, x){which} {why}: every part needs "
                    f"{slot} or a derivative of it as one factor, as in `u * v`."
                )

    def owners(self, slot: str) -> list[tuple[int, str]]:
        """Return `LocalSpace.owners` of an argument."""
        return self.terms[0].spaces[slot].owners

    def factor(self, of: int, tested: int, u: float, **coefficients: Array) -> Array:
        """Return the factor of component `of` of u and `tested` of v, at points of all elements.

        It is the factor in terms on the whole mesh if the fields of the state have the value u and
        zero derivatives. `coefficients` are for the other arguments. See `LocalSpace.owners` for
        components.
        """
        moment, total = Moment(0.3, self._inputs), np.zeros(1)
        for parent in (term for term in self.terms if term.measure.name is None):
            factors: list[Array] = []
            for term in parent.samples():
                local = term.spaces["u"]
                given = {key: term.spaces[key].values(x) for key, x in coefficients.items()}
                level, raised, test = local.zeros(), local.zeros(), local.zeros()
                level[~local.derivatives] = u
                raised[of] = test[tested] = 1.0
                with np.errstate(all="ignore"):  # such as a root of u
                    steep, flat = (
                        term.evaluate(
                            {key: {**given, "u": at, "v": test}[key] for key in self.spaces}, moment
                        )[0]
                        for at in (level + raised, level)
                    )
                    factors.append(np.broadcast_to(steep - flat, local.shape).ravel())
            total = total + np.concatenate(factors)
        return total

    @property
    def constant(self) -> bool:
        """Whether the form uses neither time nor inputs."""
        return not self.uses

    @property
    def steady(self) -> bool:
        """Whether the derivative in the nonlinear argument uses neither time nor inputs."""
        return not any(self._moving)

    @cached_property
    def affine(self) -> bool:
        """Whether the form is affine in its nonlinear argument (tested at several magnitudes)."""
        return self.nonlinear is None or self._affine(self.nonlinear, homogeneous=False)

    @cached_property
    def affine_in_parameter(self) -> bool:
        """Whether the form is affine in the parameter (tested at several magnitudes)."""
        if self.linear_in_parameter or self.parameter is None:
            return True
        return self._affine(self.parameter, homogeneous=False)

    def _affine(self, slot: str, homogeneous: bool) -> bool:
        """Return whether the form is affine (linear, if homogeneous) in an argument."""
        # The fixed seed makes the result reproducible between runs.
        rng = np.random.default_rng(1)
        for term in (piece for parent in self.terms for piece in parent.samples()):
            values = term.drawn(rng)
            at = term.along(slot, values, Moment(0.3, self._inputs))
            for scale in MAGNITUDES:
                a, b = scale * rng.standard_normal((2, *values[slot].shape))
                with np.errstate(all="ignore"):
                    zero = at(0 * a)
                    change = at(a + b) - at(a) - at(b) + (0 * zero if homogeneous else zero)
                    sizes = np.abs(np.concatenate([at(a).ravel(), at(b).ravel()]))
                    size = max(sizes[np.isfinite(sizes)].max(initial=0.0), 1e-300)
                # Points at which the form is not finite, such as a root of a negative number, are
                # not informative.
                finite = np.isfinite(change)
                if not finite.any() or np.abs(change[finite]).max() > 1e-11 * size:
                    return False
        return True

    def differentiates(self, slot: str, test: str = "v") -> bool:
        """Return whether the form contains derivatives of an argument after integration by parts.

        Its integrand then uses a derivative of the argument, or the argument itself in a term with
        a derivative of the test function, such as the flux q u in `q * u * grad(v)`. This is tested
        at several magnitudes and times, with independent values and derivatives.
        """
        rng = np.random.default_rng(2)
        return any(
            self._reads(term, slot, test, scale, rng)
            for parent in self.terms
            for term in parent.samples()
            for scale in MAGNITUDES
        )

    def _reads(
        self, term: _Term, slot: str, test: str, scale: float, rng: np.random.Generator
    ) -> bool:
        """Return whether derivatives of an argument affect a term at one magnitude."""
        values = term.drawn(rng)
        here, there = scale * values[slot], scale * rng.standard_normal(values[slot].shape)
        steep = np.where(term.spaces[slot].derivatives[:, None, None], there, here)
        flux = np.where(term.spaces[test].derivatives[:, None, None], values[test], 0.0)

        def differ(first: Array, second: Array, v: Array, t: float) -> bool:
            moment = Moment(t, self._inputs)
            pair = ({**values, slot: u, test: v} for u in (first, second))
            change = np.subtract(*(term.evaluate(given, moment)[0] for given in pair))
            return bool(change[np.isfinite(change)].any())  # other points are not informative

        with np.errstate(all="ignore"):  # roots and logarithms of random numbers
            return any(
                differ(here, steep, values[test], t) or differ(here, there, flux, t) for t in PROBED
            )

    @property
    def _trilinear(self) -> bool:
        """Whether the form is constant, affine in u and linear in all other arguments."""
        return self.constant and self.linear_in_parameter and self.affine

    def vector(self, slot: str, moment: Moment = START, **coefficients: Array) -> Array:
        """Return the derivative in the linear argument `slot`, shape (dim of its space,)."""
        others = [key for key in self.spaces if key != slot]
        if not (self._trilinear and others):
            return self.traced(slot, moment, **coefficients)[0]
        if others == [self.nonlinear]:  # B(u) = B(0) + B' u
            slope, offset = self._affine_part(slot, others[0])
            return slope @ coefficients[others[0]] + offset
        linear = next(key for key in others if key != self.nonlinear)
        fixed = {key: coefficients[key] for key in others if key != linear}
        return self.product(slot, linear, coefficients[linear], moment, **fixed)

    def _affine_part(self, slot: str, other: str) -> tuple[sp.csr_array, Array]:
        """Return the slope and the offset of an affine form of one argument; they are cached."""
        if (slot, other) not in self._affine_parts:
            zero = {key: np.zeros(space.dim) for key, space in self.spaces.items()}
            offset = self.traced(slot, START, **zero)[0]
            self._affine_parts[slot, other] = self.matrix(slot, other), offset
        return self._affine_parts[slot, other]

    def traced(
        self, slot: str, moment: Moment = START, **coefficients: Array
    ) -> tuple[Array, frozenset[str]]:
        """Return `vector` by quadrature, and which of "t" and "inputs" were used.

        The result can be reused while their values are unchanged, on any branch of the integrand.
        """
        read: set[str] = set()
        result = np.zeros(self.spaces[slot].dim)
        for term in (piece for parent in self.terms for _, piece in parent.pieces()):
            place = term.measure.place(moment)
            jets = [
                local.unit_jets(0, 1)
                if key == slot
                else local.jets(local.values(coefficients[key]))
                for key, local in term.spaces.items()
            ]
            density = np.asarray(term.integrand(*jets, place))
            read |= place.used
            result += term.spaces[slot].tested(density, term.measure.weights)
        return result, frozenset(read)

    def _scatter(self, rows: str, cols: str) -> Scatter:
        if (rows, cols) not in self._scatters:
            i, j = self.spaces[rows], self.spaces[cols]
            pairs = [(i.dofs_on(term.measure), j.dofs_on(term.measure)) for term in self.terms]
            self._scatters[rows, cols] = scatter(pairs, (i.dim, j.dim))
        return self._scatters[rows, cols]

    def pattern(self, rows: str, cols: str) -> Pattern:
        return self._scatter(rows, cols).pattern

    def data(self, rows: str, cols: str, moment: Moment = START, **coefficients: Array) -> Array:
        """Return the mixed derivative in `rows` and `cols`, as data of `pattern(rows, cols)`.

        For rows = cols, it is the second derivative in one argument. Constant bilinear forms are
        assembled once; for constant trilinear forms, the data are a sparse product with the third
        coefficients.
        """
        if rows == cols and rows not in self._curved:
            return np.zeros(self.pattern(rows, cols).nnz)
        others = [key for key in self.spaces if key not in (rows, cols)]
        if self._trilinear:
            if not others:
                return self._constant(rows, cols)
            if len(others) == 1:
                # A constant trilinear form requires no quadrature in a step, because its matrix is
                # linear in the third coefficients.
                product: Array = self._tensor(rows, cols, others[0]) @ coefficients[others[0]]
                if others[0] == self.nonlinear:
                    product += self._constant(rows, cols)
                return product
        return self._quadrature(rows, cols, moment, coefficients)

    @cached_property
    def fixed_by_numbers(self) -> bool:
        """Whether the form is constant and affine in u for fixed values of a few unknowns."""
        small = self.parameter is not None and self.spaces[self.parameter].dim <= FEW
        curved = small and not self.linear_in_parameter and self._stores_products
        return curved and self.constant and self.affine

    def about(self, q: Array) -> FormAbout:
        """Return the form for fixed q, cached for the last q; see `fixed_by_numbers`.

        Many steps have the same q, and each would otherwise integrate the form.
        """
        cached = self._about  # read only once: copies of an identifier may step in other threads
        if cached is None or not np.array_equal(cached.q, q):
            self._about = cached = FormAbout(self, q.copy())
        return cached

    def product(
        self, rows: str, cols: str, x: Array, moment: Moment = START, **coefficients: Array
    ) -> Array:
        third = [key for key in self.spaces if key not in (rows, cols)]
        if len(third) == 1 and x.ndim == 1:
            tensor = self.tensor(rows, cols)
            if isinstance(tensor, ElementTensor):
                return tensor.apply(coefficients[third[0]], x)
        return super().product(rows, cols, x, moment, **coefficients)

    def _quadrature(
        self,
        rows: str,
        cols: str,
        moment: Moment,
        coefficients: Mapping[str, Array],
        keep: bool = True,
    ) -> Array:
        places = self._scatter(rows, cols)
        result = np.zeros(places.pattern.nnz)
        for number, parent in enumerate(self.terms):
            for at, term in parent.pieces():
                density = self._density(term, rows, cols, moment, coefficients)
                r, c = term.spaces[rows], term.spaces[cols]
                local = r.paired(density, term.measure.weights, c)
                places.add(result, number, at, local, keep or parent.measure.kept)
        return result

    def _density(
        self,
        term: _Term,
        rows: str,
        cols: str,
        moment: Moment,
        coefficients: Mapping[str, Array],
    ) -> Array:
        """Return the integrand's derivative in `rows`, `cols`: (components, components, E, P).

        It uses unit jets in arguments in which the form is linear, and a complex step in a
        nonlinear argument. If both are nonlinear, which only Jacobians of iterations require, it is
        a central difference of complex steps. The difference is exact if the form is affine in its
        argument, which is chosen accordingly.
        """
        place = term.measure.place(moment)
        derivative = term.derivative if self.nonlinear in (rows, cols) else None
        stepped, shifted = self._differenced(rows, cols, derivative)

        def evaluate(shift: float) -> Array:
            jets: list[Any] = []
            for key, local in term.spaces.items():
                axes = [axis for axis, name in enumerate((rows, cols)) if name == key]
                if axes and key not in self._curved:
                    jets.append(local.unit_jets(axes[0], 2))
                    continue
                here = local.values(coefficients[key]) if key in coefficients else local.zeros()
                if not axes:
                    jets.append(local.jets(here))
                    continue
                value: Any = here[:, None, None]
                if shifted in axes:
                    value = value + shift * self._scale(key, local, here) * local.units(axes[0], 2)
                if stepped in axes:
                    value = value + 1j * STEP * local.units(axes[-1], 2)
                jets.append(local.jets(value))
                if derivative is not None and key == self.nonlinear:
                    jets.append(local.unit_jets(axes[0], 2))
            density = partial(term.integrand if derivative is None else derivative, *jets, place)
            return (
                np.asarray(density())
                if stepped is None
                else stepped_by(density, f"Form {self.name}")
            )

        if shifted is None:
            return evaluate(0.0)
        key = (rows, cols)[shifted]
        local = term.spaces[key]
        here = local.values(coefficients[key]) if key in coefficients else local.zeros()
        # Fourth order in SHIFT. Complex steps are exact up to rounding, so few digits are lost.
        single = evaluate(SHIFT) - evaluate(-SHIFT)
        double = evaluate(2.0 * SHIFT) - evaluate(-2.0 * SHIFT)
        difference = (8.0 * single - double) / (12.0 * SHIFT)
        return difference / np.swapaxes(self._scale(key, local, here)[:, 0], 0, shifted)

    def _differenced(
        self, rows: str, cols: str, given: Integrand | None
    ) -> tuple[int | None, int | None]:
        """Return the axes of the complex step and of the central difference; 0 for rows."""
        # The user's derivative replaces the complex step in the nonlinear argument.
        curved = [
            axis
            for axis, key in enumerate((rows, cols))
            if key in self._curved and (given is None or key != self.nonlinear)
        ]
        if len(curved) == 2 and rows != cols == self.nonlinear and self.affine:
            curved.reverse()
        return (curved[-1] if curved else None), (curved[0] if len(curved) == 2 else None)

    def _scale(self, key: str, local: LocalSpace, values: Array) -> Array:
        """Return the scale of the step for each component and point: (components, 1, 1, E, P).

        It is bounded from below; for the parameter, the prior standard deviation contributes.
        """
        size = np.abs(values)
        largest = size.max(axis=(1, 2), keepdims=True)
        if key == self.parameter:
            unknowns = [local.space.unknowns[name] for name in local.blocks]
            counts = [item.components for item in local.locals]
            std = np.repeat([float(item.prior.std) for item in unknowns], counts)
            largest = np.maximum(largest, std[:, None, None])
        largest = np.where(largest > 0.0, largest, 1.0)
        return np.where(size > SMALL * largest, size, largest)[:, None, None]

    def _constant(self, rows: str, cols: str) -> Array:
        """Return data(rows, cols) of an affine form at zero, which are cached."""
        if (rows, cols) not in self._constants:
            data = self._quadrature(rows, cols, START, {}, keep=False)
            self._constants[rows, cols] = data if data.any() else np.broadcast_to(0.0, data.shape)
        return self._constants[rows, cols]

    def tensor(self, rows: str, cols: str) -> Tensor | None:
        """Return T with data(rows, cols) = T @ (coefficients of the third argument).

        T is a sparse matrix, or an `ElementTensor` for large meshes. It is None unless the form is
        trilinear and constant.
        """
        (third,) = [key for key in self.spaces if key not in (rows, cols)]
        if not self._trilinear:
            return None
        if third == self.nonlinear and np.any(self._constant(rows, cols)):
            return None
        return self._tensor(rows, cols, third)

    @property
    def _stores_products(self) -> bool:
        """Whether the products of local functions are few enough for a sparse matrix."""
        sizes = [
            int(np.prod([len(space.dofs_on(term.measure)) for space in term.over.values()]))
            * term.measure.shape[0]
            for term in self.terms
        ]
        return sum(sizes) <= LARGEST_TENSOR

    def _tensor(self, rows: str, cols: str, third: str) -> Tensor:
        if (rows, cols) not in self._tensors:
            make = self._sparse if self._stores_products else self._elementwise
            self._tensors[rows, cols] = make(rows, cols, third)
        return self._tensors[rows, cols]

    def _sparse(self, rows: str, cols: str, third: str, q: Array | None = None) -> sp.csr_array:
        places = self._scatter(rows, cols)
        total = sp.csr_array((places.pattern.nnz, self.spaces[third].dim))
        for number, term in enumerate(self.terms):
            parts = [local for _, local in self._trilinear_parts(term, rows, cols, third, q=q)]
            local = np.concatenate(parts, axis=-1)
            at = np.broadcast_to(places.places(number)[:, :, None], local.shape).ravel()
            dofs = self.spaces[third].dofs_on(term.measure)
            n = np.broadcast_to(dofs, local.shape).ravel()
            total = total + sp.csr_array((local.ravel(), (at, n)), shape=total.shape)
        total = sp.csr_array(total)
        total.eliminate_zeros()
        return total

    def _elementwise(self, rows: str, cols: str, third: str) -> ElementTensor:
        if self._products is None:
            self._products = [
                TensorTerm.of(
                    [space.dofs_on(term.measure) for space in term.over.values()],
                    self._trilinear_parts(term, *self.spaces),
                )
                for term in self.terms
            ]
        order = list(self.spaces)
        slots = order.index(rows), order.index(cols), order.index(third)
        return ElementTensor(self._products, slots, self._scatter(rows, cols))

    def _trilinear_parts(
        self, whole: _Term, first: str, second: str, third: str, *, q: Array | None = None
    ) -> Iterator[tuple[slice, Array]]:
        """Yield elements and integrals of triples of local functions, (i, j, n, E), about q."""
        axes = {first: 0, second: 1, third: 2}
        for at, term in whole.pieces():
            values = {key: local.units(axes[key], 3) for key, local in term.spaces.items()}
            if q is not None and self.parameter is not None:
                parameter_values = term.spaces[self.parameter].values(q)[:, None, None, None]
                values[self.parameter] = parameter_values + 1j * STEP * values[self.parameter]
            density, _ = term.evaluate(values, START)
            if self.nonlinear is not None:
                values[self.nonlinear] = 0.0 * values[self.nonlinear]
                density = density - term.evaluate(values, START)[0]
            density = np.asarray(density) if q is None else np.imag(density) / STEP
            a, b, c = (term.spaces[key] for key in (first, second, third))
            yield at, a.tripled(density, term.measure.weights, b, c)


@dataclass(frozen=True, eq=False)
class FormAbout:
    """A form A(q, u, v) for fixed numbers q, affine in u."""

    form: Form
    q: Array

    @cached_property
    def at_zero(self) -> Array:
        """Derivative in v at u = 0, shape (n,)."""
        return self.form.vector("v", q=self.q, u=np.zeros(self.form.spaces["u"].dim))

    @cached_property
    def by_state(self) -> Array:
        """Data of the derivative in v and u."""
        return self.form.data("v", "u", q=self.q)

    @cached_property
    def _by_numbers(self) -> tuple[Array, sp.csr_array]:
        """Data of the derivative in v and q at u = 0, and their slope in u."""
        slope = self.form._sparse("v", "q", "u", self.q)
        return self.form.data("v", "q", q=self.q), slope

    def product(self, x: Array, u: Array) -> Array:
        """Return the derivative in v and q at u, times x of shape (m, k)."""
        at_zero, slope = self._by_numbers
        return self.form.pattern("v", "q").product(at_zero + slope @ u, x)
