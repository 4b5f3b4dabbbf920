"""Factorisations of traced matrices: values, derivatives, one matrix for a call of LAPACK."""

import ast
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

from jaxbeam.numerics.matrices import expm
from jaxbeam.runtime import lapack
from jaxbeam.runtime.arrays import solve_tridiagonal, xp
from tests.differences import central

RANDOM = np.random.default_rng(1)
BATCH, SIZE, LARGE = 5, 4, lapack.MAX_ELIMINATED_ROWS + 2
ROOT = Path(__file__).parents[2]


def matrices(size=SIZE):
    """Matrices (batch, size, size) without a large diagonal: they need pivots."""
    found = RANDOM.normal(size=(BATCH, size, size))
    found[:, 0, 0] = 0.0
    return found


def definite(size=SIZE):
    half = RANDOM.normal(size=(BATCH, size, size))
    return half @ half.mT + np.eye(size)


FUNCTIONS = {
    "solve": (lapack.solve, np.linalg.solve, (matrices(), RANDOM.normal(size=(BATCH, SIZE, 2)))),
    "solve, large": (
        lapack.solve,
        np.linalg.solve,
        (matrices(LARGE), RANDOM.normal(size=(BATCH, LARGE, 2))),
    ),
    "solve, complex": (
        lapack.solve,
        np.linalg.solve,
        (matrices() + 1j * matrices(), RANDOM.normal(size=(BATCH, SIZE, 2))),
    ),
    "inverse": (lapack.inv, np.linalg.inv, (matrices(),)),
    "cholesky": (lapack.cholesky, np.linalg.cholesky, (definite(),)),
    "eigenvalues": (lapack.eigvalsh, np.linalg.eigvalsh, (definite(),)),
    "singular values": (
        lambda matrix: lapack.svd(matrix, compute_uv=False),
        lambda matrix: np.linalg.svd(matrix, compute_uv=False),
        (RANDOM.normal(size=(BATCH, 3, SIZE)),),
    ),
    "pseudo-inverse": (lapack.pinv, np.linalg.pinv, (RANDOM.normal(size=(BATCH, 3, SIZE)),)),
    "log determinant": (
        lambda matrix: lapack.slogdet(matrix)[1],
        lambda matrix: np.linalg.slogdet(matrix)[1],
        (matrices(),),
    ),
    "exponential": (
        expm,
        lambda matrix: np.stack([scipy.linalg.expm(part) for part in matrix]),
        (4 * matrices(),),
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_of_a_batch_and_of_each_matrix(name):
    function, known, args = FUNCTIONS[name]
    expected = known(*args)
    scale = np.max(np.abs(expected))
    batched = jax.vmap(function)(*map(jnp.asarray, args))
    assert_allclose(batched, expected, rtol=1e-11, atol=1e-11 * scale)
    single = function(*(jnp.asarray(part[0]) for part in args))
    assert_allclose(single, expected[0], rtol=1e-11, atol=1e-11 * scale)


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "solve, complex"])
def test_derivatives_in_both_modes(name):
    function, _, args = FUNCTIONS[name]
    args = [jnp.asarray(part[:2]) for part in args]
    change = jnp.asarray(RANDOM.normal(size=args[0].shape))

    def result(x):
        changed = args[0] + x[:, None, None] * (change + change.mT if name in SYMMETRIC else change)
        return jax.vmap(function)(changed, *args[1:])

    point = np.array([0.01, -0.02])
    expected = central(result, point, 1e-4)
    scale = np.max(np.abs(expected))
    assert_allclose(jax.jacfwd(result)(point), expected, rtol=1e-6, atol=1e-7 * scale)
    assert_allclose(jax.jacrev(result)(point), expected, rtol=1e-6, atol=1e-7 * scale)


SYMMETRIC = {"cholesky", "eigenvalues"}


def batched_calls(function, *args) -> list[str]:
    """Calls of LAPACK with more than one matrix in the program of a function."""
    program = jax.jit(function).lower(*args).as_text()
    calls = re.findall(r"custom_call @lapack\w+.*", program)
    return [call for call in calls if re.search(r"tensor<(\d+x){3,}[fc]", call)]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_batch_reaches_lapack(name):
    function, _, args = FUNCTIONS[name]
    args = [jnp.asarray(part) for part in args]
    assert batched_calls(lambda *args: jnp.linalg.cholesky(args[0][:, :3, :3]), *args)
    assert not batched_calls(jax.vmap(function), *args)
    doubled = [jnp.stack([part, part]) for part in args]
    assert not batched_calls(jax.vmap(jax.vmap(function)), *doubled)


def test_one_factorisation_serves_all_right_sides():
    matrix, right = jnp.asarray(matrices()[0]), jnp.asarray(RANDOM.normal(size=(BATCH, SIZE, 2)))
    found = jax.vmap(lapack.solve, (None, 0))(matrix, right)
    assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-11)
    vectors = lapack.solve(matrix, right[0, :, 0])
    assert_allclose(vectors, np.linalg.solve(matrix, right[0, :, 0]), rtol=1e-11)


def test_tridiagonal_systems_of_a_batch():
    lower, upper = RANDOM.normal(size=(2, BATCH, SIZE - 1))
    diagonal, right = 4 + RANDOM.normal(size=(BATCH, SIZE)), RANDOM.normal(size=(BATCH, SIZE))
    bands = [jnp.asarray(part) for part in (lower, diagonal, upper, right)]
    assert not batched_calls(jax.vmap(solve_tridiagonal), *bands)
    found = jax.vmap(solve_tridiagonal)(*bands)
    dense = [
        np.diag(d) + np.diag(low, -1) + np.diag(up, 1)
        for d, low, up in zip(diagonal, lower, upper, strict=True)
    ]
    assert_allclose(found, np.linalg.solve(dense, right[..., None])[..., 0], rtol=1e-11)

    def loss(x):
        return jnp.sum(solve_tridiagonal(bands[0][0] * x, bands[1][0] + x, bands[2][0], right[0]))

    assert_allclose(jax.grad(loss)(1.1), central(loss, 1.1, 1e-4), rtol=1e-6)


def test_eigenvalues_without_derivative_and_least_squares():
    some = matrices()
    values = jax.vmap(lambda matrix: xp.linalg.eig(matrix)[0])(jnp.asarray(some))
    for found, matrix in zip(values, some, strict=True):
        assert_allclose(np.sort_complex(found), np.sort_complex(np.linalg.eigvals(matrix)))
    right = RANDOM.normal(size=(BATCH, SIZE))
    found = jax.vmap(lambda *system: xp.linalg.lstsq(*system)[0])(some, right)
    assert_allclose(found, np.linalg.solve(some, right[..., None])[..., 0], rtol=1e-9)

    def loss(share):
        return xp.sum(xp.linalg.lstsq(some[0][:, :2] + share * some[1][:, :2], right[0])[0] ** 2)

    assert_allclose(jax.grad(loss)(0.3), central(loss, 0.3, 1e-5), rtol=1e-6)


def test_matrices_are_factorised_here_only():
    """`xp.linalg` is `lapack` for traced numbers; other routes would send batches to LAPACK."""
    found = []
    for package in ("jaxbeam", "tuning"):
        for path in (ROOT / package).rglob("*.py"):
            if path.name == "lapack.py":
                continue
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Attribute) and node.attr not in ("norm", "block_diag"):
                    name = ast.unparse(node)
                    if re.match(r"(jnp|jax\.(numpy|scipy|lax))\.linalg\.", name):
                        found.append(f"{path.relative_to(ROOT)}: {name}")
                if isinstance(node, ast.ImportFrom) and re.match(
                    r"jax\..*linalg", node.module or ""
                ):
                    found.append(f"{path.relative_to(ROOT)}: from {node.module}")
    assert not found
