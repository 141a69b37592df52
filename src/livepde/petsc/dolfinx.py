"""A `PetscModel` from UFL integrands with DOLFINx 0.5.2, the version in Debian 12.

All calls that differ between versions of DOLFINx are in `Interface`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from livepde.errors import ModelError
from livepde.linalg import Array, IntArray
from livepde.petsc.petsc_model import gathered, petsc_module, standard_vector

OBSERVED, HIDDEN = 1, 2  # tags of cells


class DolfinxModel:
    """A process M u' + F(u, q, t) = 0 from UFL integrands.

    Parameters
    ----------
    V
        Scalar function space of the state u.
    q
        Function space of a field, or the initial values of numbers, shape (m,).
    form
        Integrand (u, q, v, x, t) of F over the cells, linear in the test function v: B(u) + A(u) q
        minus the source. For numbers, q is a tuple. x are the coordinates and t is the time.
    boundary
        Integrand of F over the boundary with the same arguments. Its u is the estimate, never data.
    mass, inner
        Integrands (u, v) of M and (p, q) of G_Q; default u v and p q + grad p . grad q.
    dirichlet
        Pairs of a marker, coordinates (3, points) -> booleans, and a value, (x, t) -> numbers.
    sensors
        Points at which u is observed, shape (sensors, dimension); None: no sensors.
    omega
        Marker of observed cells, midpoints (3, cells) -> booleans; None: all of u is observed.
    M_op, N_op
        Integrands (u, v) of M_op and N_op of (MN1), (MN2); default u v + grad u . grad v.
    symmetric
        True if M/h + dF/du is symmetric positive definite.
    """

    def __init__(
        self,
        V: Any,
        q: Any,
        form: Callable[..., Any],
        *,
        boundary: Callable[..., Any] | None = None,
        mass: Callable[..., Any] | None = None,
        dirichlet: Sequence[tuple[Callable[..., Any], Callable[..., Any]]] = (),
        sensors: Any = None,
        omega: Callable[..., Any] | None = None,
        inner: Callable[..., Any] | None = None,
        M_op: Callable[..., Any] | None = None,
        N_op: Callable[..., Any] | None = None,
        symmetric: bool = False,
    ) -> None:
        self.api = api = Interface()
        ufl = api.ufl
        self.V, self.mesh, self.symmetric = V, V.mesh, symmetric
        self.u, self.w = api.fem.Function(V), api.fem.Function(V)
        self.time = api.fem.Constant(V.mesh, 0.0)
        self._set_parameter(q)
        self.boundary, self.form = boundary, form
        self.v = ufl.TestFunction(V)
        self._measures(omega)
        trial = ufl.TrialFunction(V)
        weigh: Callable[..., Any] = mass or ufl.inner
        pull, push = M_op or self._h1, N_op or self._h1
        self.mass = api.matrix(weigh(trial, self.v) * ufl.dx)
        self.mass_observed, self.push = self.mass, None
        self.pull = api.matrix(pull(trial, self.v) * self.seen)
        if omega is not None:
            self.mass_observed = api.matrix(weigh(trial, self.v) * self.seen)
            self.push = api.matrix(push(trial, self.v) * self.rest)
        self.gram, self.mass_q = self._inner_products(inner or self._h1)
        self._dirichlet = [(*api.located(V, marker), value) for marker, value in dirichlet]
        rows = [np.zeros(0, dtype=int), *(dofs for dofs, _, _ in self._dirichlet)]
        owned = self.create_u().getOwnershipRange()[0] + np.unique(np.concatenate(rows))
        self.fixed: IntArray = owned.astype(petsc_module().IntType)
        self.sensors = self._readings(np.zeros((0, 1)) if sensors is None else sensors)
        self._forms: dict[tuple[str, bool], Any] = {}
        self._matrices: dict[tuple[str, bool], Any] = {}
        # F is affine in u if its derivative does not contain u.
        slope = ufl.algorithms.expand_derivatives(self._form("u", False))
        self.linear = self.u not in slope.coefficients()

    def create_u(self) -> Any:
        """Return a zero vector of X."""
        return standard_vector(self.mesh.comm, self.api.owned(self.V))

    def create_q(self) -> Any:
        """Return a zero vector of Q; numbers are on rank 0."""
        comm, count = self.mesh.comm, len(self.numbers)
        return standard_vector(comm, count * (comm.rank == 0) if count else self.api.owned(self.Q))

    def interpolate(self, function: Callable[[Array], Any], space: Any = None) -> Any:
        """Return the coefficients of a function of coordinates (3, points) in V, or in Q."""
        f = self.api.fem.Function(space or self.V)
        f.interpolate(lambda x: np.broadcast_to(function(x), x.shape[1]).astype(float))
        vector = self.create_u() if space is None else self.create_q()
        vector.getArray()[:] = f.x.array[: vector.getLocalSize()]
        return vector

    def parameter(self, value: Any) -> Any:
        """Return q as a vector: numbers, or a field from a function of coordinates or a number."""
        if not self.numbers:
            return self.interpolate(value if callable(value) else lambda x: value, self.Q)
        vector = self.create_q()
        vector.getArray()[:] = np.asarray(value, dtype=float)[: vector.getLocalSize()]
        return vector

    def impose(self, u: Any, t: float) -> None:
        values = u.getArray()
        for dofs, x, value in self._dirichlet:
            values[dofs] = value(x, t)

    def residual(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        self._at(u, q, t, w)
        return self._vector("F", w is not None)

    def jacobian_u(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        self._at(u, q, t, w)
        return self._assembled("u", w is not None)

    def jacobian_q(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        self._at(u, q, t, w)
        return self._columns(w is not None) if self.numbers else self._assembled("q", w is not None)

    def coupling(self, w: Any, q: Any, t: float) -> Any:
        if self.numbers:
            raise ModelError("DolfinxModel: the paper's law needs a field q: use PetscFilter.")
        self._at(w, q, t, w)
        return self._assembled("A", True)

    @cached_property
    def numbers_u(self) -> IntArray:
        return self.api.numbering(self.V)

    @cached_property
    def numbers_q(self) -> IntArray:
        if self.numbers:
            return np.arange(self.create_q().getLocalSize())
        return self.api.numbering(self.Q)

    def _h1(self, a: Any, b: Any) -> Any:
        ufl = self.api.ufl
        return ufl.inner(a, b) + ufl.inner(ufl.grad(a), ufl.grad(b))

    def _set_parameter(self, q: Any) -> None:
        api = self.api
        self.numbers: list[Any] = []
        self.Q: Any = None
        # A function space has a dofmap. Anything else is numbers, wrapped so that UFL can
        # differentiate with respect to them.
        if hasattr(q, "dofmap"):
            self.Q, self.q = q, api.fem.Function(q)
            self.given: Any = self.q
            return
        values = np.atleast_1d(np.asarray(q, dtype=float))
        self.numbers = [api.fem.Constant(self.mesh, value) for value in values.tolist()]
        self.given = tuple(api.ufl.variable(one) for one in self.numbers)

    def _measures(self, omega: Callable[..., Any] | None) -> None:
        ufl = self.api.ufl
        self.seen, self.rest = ufl.dx, None
        if omega is not None:
            tags = self.api.cell_tags(self.mesh, omega)
            dx = ufl.Measure("dx", domain=self.mesh, subdomain_data=tags)
            self.seen, self.rest = dx(OBSERVED), dx(HIDDEN)

    def _integrand(self, integrand: Callable[..., Any], u: Any) -> Any:
        x = self.api.ufl.SpatialCoordinate(self.mesh)
        return integrand(u, self.given, self.v, x, self.time)

    def _inside(self) -> Any:
        """Return the part of F over omega, evaluated at the data w."""
        return self._integrand(self.form, self.w) * self.seen

    def _F(self, split: bool) -> Any:
        """Return F at u; `split`: over omega, F is evaluated at the data w."""
        ufl, u = self.api.ufl, self.u
        F = self._inside() if split else self._integrand(self.form, u) * ufl.dx
        if split and self.rest is not None:
            F = F + self._integrand(self.form, u) * self.rest
        if self.boundary is not None:
            F = F + self._integrand(self.boundary, u) * ufl.ds
        return F

    def _inner_products(self, inner: Callable[..., Any]) -> tuple[Any, Any]:
        if self.numbers:
            ones = self.create_q()
            ones.set(1.0)
            eye = petsc_module().Mat().createAIJ((ones.getSizes(), ones.getSizes()), nnz=1)
            eye.setDiagonal(ones)
            eye.assemble()
            return eye, eye
        api, ufl = self.api, self.api.ufl
        p, r = ufl.TestFunction(self.Q), ufl.TrialFunction(self.Q)
        return api.matrix(inner(r, p) * ufl.dx), api.matrix(ufl.inner(r, p) * ufl.dx)

    def _at(self, u: Any, q: Any, t: float, w: Any) -> None:
        """Set the values at which forms are evaluated."""
        self.time.value = t
        for function, values in ((self.u, u), (self.w, w)):
            if values is not None:
                self.api.assign(function, values)
        if not self.numbers:
            self.api.assign(self.q, q)
            return
        for constant, value in zip(self.numbers, gathered(q), strict=True):
            constant.value = value

    def _form(self, name: str, split: bool) -> Any:
        """Return "F", its derivative in "u", "q" or a number (by its index), or A(w) for "A"."""
        derivative = self.api.ufl.derivative
        if name == "A":
            return derivative(self._inside(), self.q)
        F = self._F(split)
        if name in ("u", "q"):
            F = derivative(F, self.u if name == "u" else self.q)
        elif name != "F":
            ufl, number = self.api.ufl, self.given[int(name)]
            # UFL differentiates forms with respect to functions only, so that the derivative in a
            # number is computed for each integrand.
            terms = [one.reconstruct(ufl.diff(one.integrand(), number)) for one in F.integrals()]
            F = ufl.Form(terms)
        return F

    def _compiled(self, name: str, split: bool) -> Any:
        """Return a compiled form, or None if it is zero."""
        if (name, split) not in self._forms:
            form = self.api.ufl.algorithms.expand_derivatives(self._form(name, split))
            self._forms[name, split] = None if form.empty() else self.api.fem.form(form)
        return self._forms[name, split]

    def _assembled(self, name: str, split: bool) -> Any:
        """Return a matrix, which is assembled in place after the first call; None if it is zero."""
        form, key = self._compiled(name, split), (name, split)
        if form is not None:
            self._matrices[key] = self.api.matrix(form, self._matrices.get(key))
        return self._matrices.get(key)

    def _vector(self, name: str, split: bool) -> Any:
        form, vector = self._compiled(name, split), self.create_u()
        if form is not None:
            self.api.assemble(form, vector)
        return vector

    def _columns(self, split: bool) -> Any:
        """Return dF/dq for numbers, a dense matrix with distributed rows."""
        sizes = self.create_u().getSizes(), self.create_q().getSizes()
        key = ("columns", split)
        if key not in self._matrices:
            self._matrices[key] = petsc_module().Mat().createDense(sizes, comm=self.mesh.comm)
            self._matrices[key].setUp()
        matrix = self._matrices[key]
        for k in range(len(self.given)):
            matrix.getDenseArray()[:, k] = self._vector(str(k), split).getArray()
        matrix.assemble()
        return matrix

    def _readings(self, points: Any) -> Any:
        """Return G; each point is evaluated on the lowest rank with a cell that contains it."""
        x, comm = np.zeros((len(points), 3)), self.mesh.comm
        x[:, : np.shape(points)[1]] = points
        rows = self.api.readings(self.V, x)
        owners = comm.allgather([comm.size if row is None else comm.rank for row in rows])
        first = np.min(owners, axis=0)
        if (first == comm.size).any():
            lost = np.flatnonzero(first == comm.size)[0]
            raise ModelError(f"DolfinxModel: sensor {lost} at {x[lost]} lies outside the mesh.")
        G = petsc_module().Mat().createAIJ(((None, len(x)), self.create_u().getSizes()), comm=comm)
        G.setUp()
        # The number of nonzeros in a row depends on the element, so none are preallocated.
        G.setOption(petsc_module().Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        for k in np.flatnonzero(first == comm.rank).tolist():
            G.setValues([k], *(rows[k] or ([], [])))
        G.assemble()
        return G


class Interface:
    """All calls of DOLFINx that depend on its version, here for 0.5.2."""

    def __init__(self) -> None:
        petsc_module()
        self.ufl, self.dolfinx = petsc_module("ufl"), petsc_module("dolfinx")
        self.fem, self.petsc = self.dolfinx.fem, petsc_module("dolfinx.fem.petsc")

    def matrix(self, form: Any, matrix: Any = None) -> Any:
        """Return the matrix of a form, assembled in place if a matrix is given."""
        form = self.fem.form(form)
        if matrix is None:
            matrix = self.petsc.assemble_matrix(form)
        else:
            matrix.zeroEntries()
            self.petsc.assemble_matrix(matrix, form)
        matrix.assemble()
        return matrix

    def assemble(self, form: Any, vector: Any) -> None:
        """Assemble a linear form into a vector."""
        PETSc = petsc_module()
        b = self.petsc.assemble_vector(form)
        # Cells at the border of a rank contribute to coefficients of its neighbours.
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        vector.getArray()[:] = b.getArray()
        b.destroy()

    def assign(self, function: Any, vector: Any) -> None:
        """Set the coefficients of a function, including its ghosts."""
        function.x.array[: vector.getLocalSize()] = vector.getArray(readonly=True)
        function.x.scatter_forward()

    def owned(self, space: Any) -> int:
        """Return the number of owned coefficients of a space."""
        return int(space.dofmap.index_map.size_local)

    def located(self, V: Any, marker: Callable[..., Any]) -> tuple[IntArray, Array]:
        """Return owned coefficients at marked points, and their coordinates, shape (3, points)."""
        dofs = self.fem.locate_dofs_geometrical(V, marker)
        dofs = dofs[dofs < self.owned(V)]
        return dofs, V.tabulate_dof_coordinates()[dofs].T

    def cell_tags(self, mesh: Any, marker: Callable[..., Any]) -> Any:
        """Return the tags of all cells: observed, according to the midpoint, or hidden."""
        dim = mesh.topology.dim
        cells = mesh.topology.index_map(dim)
        local = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
        middle = self.dolfinx.mesh.compute_midpoints(mesh, dim, local)
        values = np.where(marker(middle.T), OBSERVED, HIDDEN).astype(np.int32)
        return self.dolfinx.mesh.meshtags(mesh, dim, local, values)

    def readings(self, V: Any, x: Array) -> list[tuple[IntArray, Array] | None]:
        """Return the global coefficients at each point and the values of their shape functions.

        A point without an owned cell has None.
        """
        geometry, dim = self.dolfinx.geometry, V.mesh.topology.dim
        f, owned = self.fem.Function(V), V.mesh.topology.index_map(dim).size_local
        if not len(x) or not owned:
            return [None] * len(x)
        tree = geometry.BoundingBoxTree(V.mesh, dim, padding=1e-10)
        hits = geometry.compute_colliding_cells(V.mesh, geometry.compute_collisions(tree, x), x)
        found: list[tuple[IntArray, Array] | None] = []
        for k, point in enumerate(x):
            cell = min((cell for cell in hits.links(k) if cell < owned), default=None)
            if cell is None:
                found.append(None)
                continue
            dofs, values = V.dofmap.cell_dofs(cell), []
            for dof in dofs:
                f.x.array[:] = 0.0
                f.x.array[dof] = 1.0
                values.append(float(np.ravel(f.eval(point, cell))[0]))
            numbers = V.dofmap.index_map.local_to_global(dofs).astype(petsc_module().IntType)
            found.append((numbers, np.array(values)))
        return found

    def numbering(self, V: Any) -> IntArray:
        """Return the numbers of owned coefficients in the original mesh, for P1 or P0."""
        mesh, owned = V.mesh, self.owned(V)
        count = len(mesh.topology.original_cell_index)
        dofs = V.dofmap.list.array.reshape(count, -1)
        corners = mesh.geometry.dofmap.array.reshape(count, -1)
        # P0 has one coefficient in each cell, P1 one at each of its corners.
        if dofs.shape[1] == 1:
            given = np.asarray(mesh.topology.original_cell_index)[:, None]
        elif dofs.shape == corners.shape:
            given = np.asarray(mesh.geometry.input_global_indices)[corners]
        else:
            raise ModelError(
                "DolfinxModel: coefficients keep their numbers on every number of ranks for "
                "linear Lagrange and piecewise constant elements on straight meshes only."
            )
        numbers = np.full(owned + V.dofmap.index_map.num_ghosts, -1, dtype=np.int64)
        numbers[dofs] = given
        return numbers[:owned]
