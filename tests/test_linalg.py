"""Fixed patterns, block assembly, and engines that agree with dense algebra."""

from __future__ import annotations

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
    Pattern,
    SuperLUSolver,
    analyse,
    positive_definite,
    sandwich,
)

NUMBERS = st.floats(-10, 10, allow_nan=False, width=32)


@st.composite
def matrices(draw, rows, cols):
    """A dense matrix with many zeros."""
    values = draw(hnp.arrays(float, (rows, cols), elements=NUMBERS))
    return values * draw(hnp.arrays(bool, (rows, cols)))


SIZES = st.integers(1, 6)


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


@given(st.data(), SIZES, SIZES)
@settings(max_examples=40, deadline=None)
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


def test_position_outside_of_the_pattern():
    pattern = Pattern.of(sp.eye_array(3))
    with pytest.raises(IndexError, match="outside"):
        pattern.positions(np.array([0]), np.array([1]))
    with pytest.raises(IndexError, match="outside"):
        pattern.positions(np.array([2]), np.array([5]))


def regular(n, rng, spd=False):
    """A sparse, well-conditioned matrix."""
    matrix = sp.random_array((n, n), density=0.15, rng=rng)
    if spd:
        matrix = matrix + matrix.T
    return sp.csr_array(matrix + sp.diags_array(np.full(n, 4.0)))


def engines(pattern):
    return {
        "banded": BandedSolver(pattern),
        "general": SuperLUSolver(pattern),
        "symmetric": SuperLUSolver(pattern, symmetric=True),
    }


@pytest.mark.parametrize("engine", ["banded", "general", "symmetric"])
@pytest.mark.parametrize("seed", range(3))
def test_engines_agree_with_dense_algebra(engine, seed):
    rng = np.random.default_rng(seed)
    matrix = regular(25, rng, spd=engine == "symmetric")
    pattern = Pattern.of(matrix)
    solver = engines(pattern)[engine]
    assert solver.pattern is pattern
    assert solver.name
    factor = solver.factorise(pattern.gather(*matrix.tocoo().coords) @ matrix.tocoo().data)
    for shape in ((25,), (25, 1), (25, 4)):
        b = rng.standard_normal(shape)
        kept = b.copy()
        np.testing.assert_allclose(matrix @ factor.solve(b), b, atol=1e-12)
        np.testing.assert_array_equal(b, kept)  # right-hand sides are not written over


@pytest.mark.parametrize("engine", ["banded", "general", "symmetric"])
def test_engines_refuse_singular_and_infinite_matrices(engine):
    pattern = Pattern.of(sp.diags_array([np.ones(4), np.ones(5), np.ones(4)], offsets=[-1, 0, 1]))
    solver = engines(pattern)[engine]
    with pytest.raises(LinearAlgebraError, match="singular"):
        solver.factorise(np.zeros(pattern.nnz))
    for bad in (np.nan, np.inf):
        data = pattern.matrix(np.ones(pattern.nnz)).data.copy()
        data[4] = bad
        with pytest.raises(LinearAlgebraError, match="finite"):
            solver.factorise(data)


def test_engine_is_chosen_by_the_band():
    narrow = Pattern.of(sp.diags_array([np.ones(99), np.ones(100)], offsets=[1, 0]))
    wide = Pattern.of(sp.csr_array(np.ones((100, 100))))
    assert isinstance(analyse(narrow), BandedSolver)
    assert "band" in analyse(narrow).name
    assert isinstance(analyse(wide), SuperLUSolver)
    assert "symmetric" in analyse(wide, symmetric=True).name
    assert "symmetric" not in analyse(wide).name


def test_banded_engine_finds_a_narrow_order():
    order = np.random.default_rng(0).permutation(200)
    chain = sp.diags_array([np.ones(199), 4 * np.ones(200), np.ones(199)], offsets=[-1, 0, 1])
    shuffled = sp.csr_array(sp.csr_array(chain)[order][:, order])
    assert max(BandedSolver(Pattern.of(shuffled)).band) <= 2


@given(st.integers(1, 12), st.integers(0, 2**32 - 1), st.floats(-0.5, 2.0))
@settings(max_examples=80, deadline=None)
def test_positive_definite_is_the_sign_of_the_smallest_eigenvalue(n, seed, shift):
    rng = np.random.default_rng(seed)
    matrix = sp.random_array((n, n), density=0.3, rng=rng)
    matrix = sp.csr_array(matrix + matrix.T + sp.diags_array(shift + rng.random(n)))
    smallest = np.linalg.eigvalsh(matrix.toarray()).min()
    if abs(smallest) > 1e-9:
        assert positive_definite(matrix) == (smallest > 0)


def test_a_zero_matrix_is_not_positive_definite():
    assert not positive_definite(sp.csr_array((3, 3)))
