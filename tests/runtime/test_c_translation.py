"""Programs of JAX in C: the numbers of JAX itself, in several runs at once."""

import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from numpy.testing import assert_allclose

from jaxbeam.runtime.c_translation import Translation
from jaxbeam.runtime.c_writer import HEADERS, CArray, UntranslatedError, kind_of
from jaxbeam.runtime.native_library import C_FOLDER, find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")

RUNS = 8  # as many as the widest register holds; narrower ones take several turns
RNG = np.random.default_rng(3)
X, Y = RNG.normal(size=(RUNS, 4)), RNG.normal(size=4)
MATRIX = RNG.normal(size=(4, 4))
SQUARE = MATRIX @ MATRIX.T + np.eye(4)
HEAD = (
    "\nint width(void) { return REGISTER_WIDTH; }\nvoid program(const Register *x, Register *y) {"
)


def translated(function, *shared):
    """C of a function of four numbers, which differ between runs, and of what all runs share."""
    closed = jax.make_jaxpr(function)(X[0], *shared)
    writer = Translation()
    inputs = [CArray("d", X[0].shape, "x", True), *map(writer.constant, map(np.asarray, shared))]
    place = 0
    for value in writer.run(closed, inputs):
        found = writer.converted(value, "d")
        writer.copy(CArray("d", found.shape, f"(y + {place})", True), found)
        place += found.size
    return "\n".join([HEADERS + HEAD, *writer.lines, "}"])


def found_by_c(text: str, size: int, folder) -> np.ndarray:
    """What the C of a program finds in all runs."""
    (folder / "program.c").write_text(text)
    command = [find_compiler(), "-O1", "-march=native", "-fPIC", "-shared", f"-I{C_FOLDER}"]
    command += ["-Wall", "-Werror", "-Wno-unused", str(folder / "program.c")]
    subprocess.run([*command, "-o", str(folder / "program.so"), "-lm"], check=True)
    library = ctypes.CDLL(str(folder / "program.so"))
    width, parts = library.width(), []
    for first in range(0, RUNS, width):
        given, found = aligned(4, width), aligned(size, width)
        given[:] = X[first : first + width].T
        library.program(*(ctypes.c_void_p(array.ctypes.data) for array in (given, found)))
        parts.append(found.copy())
    return np.concatenate(parts, axis=1).T


def aligned(rows: int, width: int) -> np.ndarray:
    """Memory for registers."""
    room = np.zeros(rows * width + 8)
    first = -room.ctypes.data % 64 // 8
    return room[first : first + rows * width].reshape(rows, width)


def searched(x):
    return jnp.searchsorted(jnp.sort(Y), x), jnp.argmax(x), jnp.argmin(x), jnp.argsort(x)


def loops(x):
    after, sums = lax.scan(lambda c, row: (c * 0.5 + row, c @ row), x, jnp.outer(x, Y))
    _, backwards = lax.scan(lambda c, row: (c + row, c), 0.0, Y, reverse=True)
    halved = lax.while_loop(lambda c: jnp.sum(c[0] ** 2) > 0.01, halve, (x, 0))
    turns = lax.fori_loop(0, 5, lambda i, c: c.at[i % 4].add(i * x[0]), x)
    return after, sums, backwards, *halved, turns


def halve(carry):
    x, count = carry
    return jnp.where(x > 0, 0.5 * x, 0.4 * x), count + 1


def branches(x):
    own = lax.cond(x[0] > 0, lambda x: (x, 1), lambda x: (2 * x[::-1], 2), x)
    third = lax.switch(jnp.floor(2 * x[1]).astype(int), [jnp.sin, jnp.exp, lambda x: x], x)
    known = lax.cond(jnp.asarray(Y)[0] > 0, lambda x: x, lambda x: -x, x)
    return *own, third, known


def places(x):
    index = jnp.floor(2 * jnp.abs(x)).astype(int)
    table = jnp.asarray(MATRIX)
    outside = table.at[index, 0].get(mode="fill")
    kept = x.at[index[0]].set(5.0, mode="drop"), x.at[np.array([0, 2, 2])].add(Y[:3])
    kept += x.at[index[1] % 4].subtract(Y[0]), x.at[np.array([1, 3])].multiply(Y[:2])
    window = (
        lax.dynamic_slice(x, (index[0],), (2,)),
        lax.dynamic_update_slice(x, Y[:2], (index[1],)),
    )
    rows = jax.vmap(lambda i, row: row[i])(index % 4, jnp.outer(x, Y))
    return table[index % 4], x[index % 4], outside, *kept, *window, rows


def shapes(x):
    both = jnp.stack([x, 2 * x], axis=1)
    padded = lax.pad(x, 0.5, [(1, 2, 1)])
    parts = jnp.split(jnp.concatenate([x, Y]), [3])
    tiled = jnp.tile(both, (2, 1)), both.T, jnp.pad(both, 1), jnp.flip(x), x[::2], x[1:3]
    rows = *both, *jnp.unstack(jnp.outer(x, Y), axis=1)
    return both, padded, *parts, *tiled, *rows, jnp.outer(x, Y)[:, ::-1], jnp.arange(4) + x


def reductions(x):
    table = jnp.outer(x, Y)
    sums = jnp.sum(table, 0), jnp.prod(x), jnp.max(table, 1), jnp.min(x), jnp.cumsum(x)
    return *sums, jnp.any(x > 1), jnp.all(x < 1), jnp.cumsum(table, 1)[:, ::-1]


def elementary(x):
    positive = jnp.abs(x) + 0.1
    of_all = jnp.sqrt(positive), jnp.exp(x), jnp.log(positive), jnp.expm1(x), jnp.tanh(x)
    more = jnp.sin(x), jnp.arctan2(x, Y), positive**1.5, x**3, x**-2, jnp.round(3 * x)
    rest = jnp.floor(x), jnp.sign(x), jnp.clip(x, -0.5, 0.5), jnp.isfinite(x / 0.0), x % 0.7
    kept = jnp.maximum(x, jnp.nan), jnp.minimum(jnp.nan, x), jnp.where(x > 0, x, Y)
    smooth = jnp.polyval(Y, x), jnp.polyval(x, 0.3), jax.vmap(jax.grad(jnp.tanh))(x)
    return *of_all, *more, *rest, *kept, *smooth, (x > 0) & ~(x > 1), (5 * x).astype(int) // 2


def systems(x):
    matrix = SQUARE + jnp.outer(x, x)
    factor = jnp.linalg.cholesky(matrix)
    solved = [
        lax.linalg.triangular_solve(factor, b, left_side=left, lower=True, transpose_a=turned)
        for left, b in ((True, jnp.outer(x, Y)[:, :2]), (False, jnp.outer(x, Y)[:2]))
        for turned in (False, True)
    ]
    alone = jnp.linalg.cholesky(jnp.asarray(SQUARE)), jax.scipy.linalg.cho_solve((factor, True), x)
    return factor, *solved, *alone, SQUARE @ x, jnp.einsum("ij,ik,kl->jl", matrix, matrix, SQUARE)


def general_systems(x):
    """Matrices without symmetry, whose rows change places; some are the same in all runs."""
    matrix, table = MATRIX + jnp.outer(x, Y), jnp.asarray(MATRIX)
    several = jnp.stack([matrix, matrix.T @ SQUARE, table])
    solved = jnp.linalg.solve(matrix, x), jnp.linalg.solve(matrix.T, SQUARE)
    factors, _, order = lax.linalg.lu(matrix)
    return *solved, jnp.linalg.solve(table, x), jnp.linalg.inv(several), factors, order


@pytest.mark.parametrize(
    "function",
    [general_systems, elementary, shapes, reductions, systems, places, branches, loops, searched],
)
def test_programs_give_the_numbers_of_jax(function, tmp_path):
    def flat(x):
        return jnp.concatenate([jnp.ravel(part).astype(float) for part in function(x)])

    expected = jax.vmap(flat)(X)
    found = found_by_c(translated(lambda x: function(x)), expected.shape[1], tmp_path)
    assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_other_primitives_are_named():
    with pytest.raises(UntranslatedError, match="lgamma"):
        translated(lambda x: (lax.lgamma(x),))
    with pytest.raises(UntranslatedError, match="float32"):
        kind_of(np.zeros(1, np.float32))
