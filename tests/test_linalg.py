"""Fixed patterns, block assembly, and engines that agree with dense algebra."""

from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from threading import Event, Thread

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp

from livepde.errors import LinearAlgebraError
from livepde.linalg import (
    Assembler,
    BandedSolver,
    CholmodSolver,
    MultigridSolver,
    PardisoSolver,
    Pattern,
    SuperLUSolver,
    analyse,
    choose,
    conjugate_gradients,
    gmres,
    nonfinite_allowed,
    positive_definite,
    row_product,
    sandwich,
    solvers,
)

NUMBERS = st.floats(-10, 10, allow_nan=False, width=32)


@st.composite
def matrices(draw, rows, cols):
    """A dense matrix with many zeros."""
    values = draw(hnp.arrays(float, (rows, cols), elements=NUMBERS))
    return values * draw(hnp.arrays(bool, (rows, cols)))


SIZES = st.integers(1, 6)


@pytest.mark.slow
@given(st.data(), SIZES, SIZES, SIZES, SIZES)
@settings(max_examples=60, deadline=None)
def test_sandwich_is_the_product_for_any_data(data, p, n, m, k):
    left, right = data.draw(matrices(p, n)), data.draw(matrices(m, k))
    pattern = Pattern.of(sp.csr_array(data.draw(matrices(n, m))))
    values = data.draw(hnp.arrays(float, pattern.nnz, elements=NUMBERS))
    rows, cols, weights = sandwich(sp.csr_array(left), pattern, sp.csr_array(right))
    found = np.zeros((p, k))
    np.add.at(found, (rows, cols), weights @ values)
    expected = left @ pattern.matrix(values).toarray() @ right
    np.testing.assert_allclose(found, expected, atol=1e-10 * (1 + abs(expected).max(initial=0)))


@pytest.mark.slow
@given(st.data(), SIZES, SIZES)
@settings(max_examples=60, deadline=None)
def test_assembler_is_the_dense_block_matrix(data, n, m):
    inner, other = data.draw(matrices(n, m)), data.draw(matrices(m, m))
    left, right = data.draw(matrices(n, n)), data.draw(matrices(m, m))
    K, H = Pattern.of(sp.csr_array(inner)), Pattern.of(sp.csr_array(other))
    whole = Assembler(n + m)
    whole.add("K", K, sp.csr_array(left), sp.csr_array(right), at=(0, n))
    whole.add("K", K, sp.csr_array(right.T), sp.csr_array(left.T), at=(n, 0), transposed=True)
    whole.add("H", H, at=(n, n))
    pattern, maps = whole.build()
    k = data.draw(hnp.arrays(float, K.nnz, elements=NUMBERS))
    h = data.draw(hnp.arrays(float, H.nnz, elements=NUMBERS))
    found = pattern.matrix(maps["K"] @ k + maps["H"] @ h).toarray()
    corner = left @ K.matrix(k).toarray() @ right
    expected = np.block([[np.zeros((n, n)), corner], [corner.T, H.matrix(h).toarray()]])
    np.testing.assert_allclose(found, expected, atol=1e-10 * (1 + abs(expected).max()))


def test_assembler_with_diagonal_factors():
    """Entries that are multiplied by zero drop out, and blocks that are alike share their map."""
    rng = np.random.default_rng(0)
    dense = rng.standard_normal((6, 6)) * (rng.random((6, 6)) < 0.5)
    K = Pattern.of(sp.csr_array(dense))
    left, right = (
        np.array([1.0, 0.0, 2.0, 1.0, 0.0, -1.0]),
        np.array([1.0, 1.0, 0.0, 1.0, 3.0, 1.0]),
    )
    a, b = sp.diags_array(left), sp.diags_array(right)
    whole = Assembler(12)
    whole.add("K", K, a, b)
    whole.add("same", K, a, b)
    whole.add("T", K, a, b, at=(6, 0), transposed=True)
    whole.add("sparse", K, sp.csr_array(a), sp.csr_array(b), at=(6, 6))
    pattern, maps = whole.build()
    assert maps["same"] is maps["K"]
    values = dense[np.nonzero(dense)]
    corner, turned = left[:, None] * dense * right, left[:, None] * dense.T * right
    expected = np.block([[corner, np.zeros((6, 6))], [turned, corner]])
    found = pattern.matrix(sum(maps[name] @ values for name in ("K", "T", "sparse")))
    np.testing.assert_array_equal(found.toarray(), expected)
    assert pattern.nnz == np.count_nonzero(expected + np.eye(12))


@given(st.data(), SIZES, SIZES)
@settings(max_examples=40, deadline=None)
@pytest.mark.slow
def test_pattern_keeps_structure_and_positions(data, n, m):
    dense = data.draw(matrices(n, m))
    pattern = Pattern.of(sp.csr_array(dense))
    rows, cols = np.nonzero(dense)
    values = dense[rows, cols]
    np.testing.assert_array_equal(pattern.matrix(values).toarray(), dense)
    np.testing.assert_array_equal(pattern.transposed(values).toarray(), dense.T)
    np.testing.assert_array_equal(pattern.rows, rows)
    np.testing.assert_array_equal(pattern.positions(rows, cols), np.arange(pattern.nnz))
    twice = pattern.gather(np.tile(rows, 2), np.tile(cols, 2)) @ np.tile(values, 2)
    np.testing.assert_array_equal(twice, 2 * values)


def regular(n, rng, spd=False):
    """A sparse, well-conditioned matrix."""
    matrix = sp.random_array((n, n), density=0.15, rng=rng)
    if spd:
        matrix = matrix + matrix.T
    return sp.csr_array(matrix + sp.diags_array(np.full(n, 4.0)))


def installed(*modules):
    """Skip a parameter visibly where a module is missing."""
    missing = [module for module in modules if find_spec(module) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{missing} not installed")


BUILD = {
    "banded": BandedSolver,
    "general": SuperLUSolver,
    "symmetric": lambda pattern: SuperLUSolver(pattern, symmetric=True),
    "cholmod": CholmodSolver,
    "cholmod blocks": lambda pattern: CholmodSolver(pattern, blocks=True),
    "pardiso": PardisoSolver,
    "pardiso symmetric": lambda pattern: PardisoSolver(pattern, symmetric=True),
    "multigrid": MultigridSolver,
}
OPTIONAL = {
    "cholmod": "sksparse",
    "cholmod blocks": "sksparse",
    "multigrid": "pyamg",
} | dict.fromkeys(("pardiso", "pardiso symmetric"), "pypardiso")
ENGINES = [
    pytest.param(name, marks=installed(OPTIONAL[name]) if name in OPTIONAL else ())
    for name in BUILD
]
DEFINITE = ("symmetric", "cholmod", "cholmod blocks", "pardiso symmetric", "multigrid")


def test_whether_a_matrix_is_symmetric_may_be_told_by_numpy():
    solver = SuperLUSolver(Pattern.of(sp.eye_array(3, format="csr")), symmetric=np.False_)
    np.testing.assert_array_equal(solver.factorise(np.full(3, 2.0)).solve(np.ones(3)), 0.5)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.slow
def test_engines_agree_with_dense_algebra(engine):
    rng = np.random.default_rng(0)
    matrix = regular(25, rng, spd=engine in DEFINITE)
    pattern = Pattern.of(matrix)
    solver = BUILD[engine](pattern)
    assert solver.pattern is pattern
    assert solver.name
    data = pattern.gather(*matrix.tocoo().coords) @ matrix.tocoo().data
    factor = solver.factorise(data)
    other = solver.factorise(2.0 * data)  # leaves the first as it is
    for shape in ((25,), (25, 1), (25, 4), (25, 21)):
        b = rng.standard_normal(shape)
        kept = b.copy()
        np.testing.assert_allclose(matrix @ factor.solve(b), b, atol=1e-9)
        np.testing.assert_allclose(2.0 * (matrix @ other.solve(b)), b, atol=1e-9)
        np.testing.assert_array_equal(b, kept)  # right-hand sides are not written over


def test_cholmod_solves_for_some_columns_at_a_time():
    """Many columns at once leave the cache; the numbers are the same."""
    pytest.importorskip("sksparse")
    rng = np.random.default_rng(1)
    matrix = regular(25, rng, spd=True)
    pattern = Pattern.of(matrix)
    data = pattern.gather(*matrix.tocoo().coords) @ matrix.tocoo().data
    factor = CholmodSolver(pattern).factorise(data)
    whole, widths = factor.solve.args[0], []

    def noted(b):
        widths.append(b.shape[1])
        return whole(b)

    b = rng.standard_normal((25, 21))
    found = replace(factor, solve=partial(factor.solve.func, noted)).solve(b)
    assert widths == [8, 8, 5]
    np.testing.assert_array_equal(found, whole(b))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_engines_refuse_singular_and_infinite_matrices(engine):
    pattern = Pattern.of(sp.diags_array([np.ones(4), np.ones(5), np.ones(4)], offsets=[-1, 0, 1]))
    solver = BUILD[engine](pattern)
    if engine != "pardiso":  # exchanges a pivot of zero for a tiny one, and goes on
        with pytest.raises(LinearAlgebraError, match="singular"):
            solver.factorise(np.zeros(pattern.nnz))
    for bad in (np.nan, np.inf):
        data = pattern.matrix(np.ones(pattern.nnz)).data.copy()
        data[4] = bad
        with pytest.raises(LinearAlgebraError, match="finite"):
            solver.factorise(data)


@pytest.mark.slow
@pytest.mark.parametrize("engine", [e for e in ENGINES if e.values[0] in DEFINITE[1:]])
def test_engines_that_prove_it_refuse_an_indefinite_matrix(engine):
    matrix = sp.diags_array([np.ones(19), np.full(20, 1.5), np.ones(19)], offsets=[-1, 0, 1])
    matrix = sp.csr_array(matrix)  # its smallest eigenvalue is about -1/2
    solver = BUILD[engine](Pattern.of(matrix))
    assert solver.definite
    with pytest.raises(LinearAlgebraError, match="definite"):
        solver.factorise(matrix.data).solve(np.random.default_rng(0).standard_normal(20))


def grid(n, reaction=0.0):
    """Five-point Laplacian of n by n nodes, with a reaction coefficient."""
    line = sp.diags_array([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
    one = sp.eye_array(n)
    matrix = sp.kron(line, one) + sp.kron(one, line) + (1e-3 + reaction) * sp.eye_array(n * n)
    return sp.csr_array(matrix)


def test_conjugate_gradients_solve_every_column_to_the_tolerance():
    A, rng = grid(12), np.random.default_rng(0)
    b = rng.standard_normal((144, 3)) * [1.0, 1e6, 0.0]
    x, iterations = conjugate_gradients(A.__matmul__, np.copy, b, 1e-9, 200, "")
    left = np.linalg.norm(A @ x - b, axis=0)
    assert np.all(left <= 2e-9 * np.linalg.norm(b, axis=0))
    assert iterations > 10
    assert conjugate_gradients(A.__matmul__, np.copy, 0 * b, 1e-9, 200, "")[1] == 0


def test_gmres_solves_an_unsymmetric_system():
    rng = np.random.default_rng(1)
    A = regular(60, rng)
    b = rng.standard_normal(60)
    x, iterations = gmres(A.__matmul__, lambda r: r / 4.0, b, 1e-10, 60, "")
    assert np.linalg.norm(A @ x - b) <= 1e-9 * np.linalg.norm(b)
    assert 1 < iterations < 60
    assert gmres(A.__matmul__, np.copy, 0 * b, 1e-10, 60, "")[1] == 0


@pytest.mark.parametrize("method", [conjugate_gradients, gmres])
def test_krylov_methods_say_what_to_do_if_they_do_not_converge(method):
    A = grid(30)
    b = np.random.default_rng(0).standard_normal(900)
    with pytest.raises(LinearAlgebraError, match=r"3 iterations.*take a smaller step"):
        method(A.__matmul__, np.copy, b, 1e-10, 3, "take a smaller step")


def test_engine_is_chosen_by_the_band(monkeypatch):
    monkeypatch.setattr(solvers, "_installed", lambda module: False)
    narrow = Pattern.of(sp.diags_array([np.ones(99), np.ones(100)], offsets=[1, 0]))
    wide = Pattern.of(sp.csr_array(np.ones((100, 100))))
    assert isinstance(analyse(narrow), BandedSolver)
    assert "band" in analyse(narrow).name
    assert isinstance(analyse(wide), SuperLUSolver)
    assert "symmetric" in analyse(wide, symmetric=True).name
    assert "symmetric" not in analyse(wide).name


@pytest.mark.parametrize(
    ("modules", "symmetric", "expected"),
    [
        ("", True, ["SuperLU", "SuperLU", "SuperLU"]),
        ("", False, ["SuperLU", "SuperLU", "SuperLU"]),
        ("pyamg", True, ["SuperLU", "SuperLU", "multigrid"]),
        ("pyamg", False, ["SuperLU", "SuperLU", "SuperLU"]),
        ("pypardiso", True, ["SuperLU", "SuperLU", "Pardiso"]),
        ("pypardiso", False, ["SuperLU", "Pardiso", "Pardiso"]),
        (
            "pypardiso sksparse",
            True,
            [f"CHOLMOD (scikit-sparse), {kind}" for kind in ("simpl", "simpl", "supern")],
        ),
        ("sksparse", False, ["SuperLU", "SuperLU", "SuperLU"]),
        ("pyamg pypardiso", True, ["SuperLU", "SuperLU", "Pardiso"]),
    ],
)
def test_engine_is_chosen_by_the_band_and_by_what_is_installed(
    modules, symmetric, expected, monkeypatch
):
    monkeypatch.setattr(solvers, "_installed", lambda module: module in modules.split())
    for band, name in zip((100, 400, 600), expected, strict=True):
        diagonals = [np.ones(3000 - k) for k in (0, band, band)]
        pattern = Pattern.of(sp.diags_array(diagonals, offsets=[0, band, -band]))
        # Reverse Cuthill and McKee would find the chains: the rule is about the band it leaves.
        monkeypatch.setattr(BandedSolver, "band", (band, band))
        chosen = choose(pattern, symmetric=symmetric)
        assert chosen.solver.name.startswith(name)
        assert str(band) in chosen.reason
        rough = choose(pattern, symmetric=symmetric, approximate=True).solver
        expects_cycle = symmetric and band > 500 and "pyamg" in modules
        assert isinstance(rough, MultigridSolver) == (expects_cycle or name == "multigrid")


def test_multigrid_iterations_do_not_grow_with_the_mesh():
    for n in (20, 60):
        A = grid(n)
        factor = MultigridSolver(Pattern.of(A)).factorise(A.data)
        b = np.random.default_rng(0).standard_normal(n * n)
        _, iterations = conjugate_gradients(A.__matmul__, factor.precondition, b, 1e-8, 50, "")
        assert iterations <= 12


def test_banded_engine_finds_a_narrow_order():
    order = np.random.default_rng(0).permutation(200)
    chain = sp.diags_array([np.ones(199), 4 * np.ones(200), np.ones(199)], offsets=[-1, 0, 1])
    shuffled = sp.csr_array(sp.csr_array(chain)[order][:, order])
    assert max(BandedSolver(Pattern.of(shuffled)).band) <= 2


@pytest.mark.slow
@given(st.integers(1, 12), st.integers(0, 2**32 - 1), st.floats(-0.5, 2.0))
@settings(max_examples=80, deadline=None)
def test_positive_definite_is_the_sign_of_the_smallest_eigenvalue(n, seed, shift):
    rng = np.random.default_rng(seed)
    matrix = sp.random_array((n, n), density=0.3, rng=rng)
    matrix = sp.csr_array(matrix + matrix.T + sp.diags_array(shift + rng.random(n)))
    smallest = np.linalg.eigvalsh(matrix.toarray()).min()
    if abs(smallest) > 1e-9:
        assert positive_definite(matrix) == (smallest > 0)


def test_units_spare_the_banded_engine_its_exchanges_of_rows():
    """Rows of different size are exchanged without need; in units of the diagonal they are not."""
    n = 400
    sizes = np.exp2(2 * (np.arange(n) % 4))
    even = sp.diags_array([-np.ones(n - 1), 3.0 * np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1])
    matrix = sp.csr_array(sp.diags_array(sizes) @ even @ sp.diags_array(sizes))
    matrix.sort_indices()
    pattern = Pattern.of(matrix)
    plain = BandedSolver(pattern).factorise(matrix.data)
    scaled = BandedSolver(pattern, units=1.0 / sizes).factorise(matrix.data)
    assert plain._triangles is None
    assert scaled._triangles is not None
    x = np.random.default_rng(0).standard_normal((n, 2))
    for b in (matrix @ x[:, 0], matrix @ x):
        expected = x[:, 0] if b.ndim == 1 else x
        for solver in (scaled, plain):  # rounding is relative to the norm, not to each entry
            np.testing.assert_allclose(solver.solve(b), expected, rtol=0, atol=1e-11)


def test_the_error_state_of_a_thread_is_its_own():
    """As a decorator, `np.errstate` gives a thread the state of another one with NumPy 1."""
    entered, left = Event(), Event()

    @nonfinite_allowed()
    def waits():
        if entered.is_set():  # the second one, while the first one waits
            left.set()
        entered.set()
        assert left.wait(10.0)

    def other():
        assert entered.wait(10.0)
        waits()

    thread = Thread(target=other)
    with np.errstate(over="raise"):
        thread.start()
        waits()
        assert np.geterr()["over"] == "raise"
    thread.join()


@pytest.mark.parametrize(
    ("shape", "offsets", "separate"),
    [
        ((8, 8), (-1, 0, 1), False),
        ((90, 90), (-2, 0, 1), True),
        ((90, 90), (-1, 1), True),
        ((400, 300), (0, 5), False),
        ((200, 200), range(-4, 5), False),
    ],
    ids=["dense", "diagonals", "no main diagonal", "sparse", "many diagonals"],
)
def test_a_matrix_is_multiplied_by_rows(shape, offsets, separate):
    rng = np.random.default_rng(0)
    matrix = sp.csr_array(
        sp.diags_array(
            [rng.standard_normal(shape[1]) for _ in offsets], offsets=[*offsets], shape=shape
        )
    )
    product, x = row_product(matrix), rng.standard_normal((5, shape[1]))
    assert product.separate == separate
    wanted = x @ matrix.toarray().T
    np.testing.assert_allclose(product(x), wanted, rtol=0, atol=1e-13)
    np.testing.assert_allclose(product(x[:1]), wanted[:1], rtol=0, atol=1e-13)
    out = np.full(wanted.shape, np.nan)
    product(x[:4], out[:4])
    np.testing.assert_allclose(out[:4], wanted[:4], rtol=0, atol=1e-13)
    assert np.isnan(out[4]).all()
    if separate:
        np.testing.assert_array_equal(product(x)[2:3], product(x[2:3]))
