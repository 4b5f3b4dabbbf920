"""Array functions: equal results from known numbers, in NumPy, and from traced ones, in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as arrays_of
from numpy.testing import assert_allclose

from jaxbeam.numerics.matrices import expm
from jaxbeam.runtime import arrays
from jaxbeam.runtime.arrays import xp

VECTOR, MATRIX = np.array([0.3, -1.2, 2.0, 0.7]), np.arange(12.0).reshape(4, 3) - 5
FACTOR = np.tril(np.arange(1.0, 17.0).reshape(4, 4)) + 4 * np.eye(4)
REPEATED = np.array([2, 0, 2])

# Functions of arrays; each is called with known and with traced ones.
FUNCTIONS = {
    "xp of an array": (lambda a: xp.where(a > 0, xp.sin(a), 0.0), VECTOR),
    "xp of arrays in a list": (lambda a: xp.stack([a, 2 * a], axis=-1), VECTOR),
    "xp of a named array": (lambda a: xp.clip(VECTOR, max=a), VECTOR[::-1].copy()),
    "xp.linalg": (lambda a: xp.linalg.solve(FACTOR, a), MATRIX),
    "array_namespace": (lambda a: arrays.array_namespace(VECTOR, a).tanh(a), MATRIX),
    "take": (lambda i: arrays.take(MATRIX, i), 2),
    "take of several": (lambda a, i: arrays.take(a, i), MATRIX, REPEATED),
    "set_at": (lambda a, v: arrays.set_at(a, np.s_[1:3, 0], v), MATRIX, np.array([9.0, 8.0])),
    "set_at of integers": (lambda v: arrays.set_at(np.arange(4), 1, v), 0.5),
    "set_at an index": (lambda i: arrays.set_at(VECTOR, i, 7.0), 3),
    "add_at": (lambda a, v: arrays.add_at(a, np.s_[..., 1], v), MATRIX, VECTOR),
    "add_at repeatedly": (lambda i: arrays.add_at(MATRIX, i, 1.5), REPEATED),
    "put": (lambda a, v: arrays.put(a, np.array([1, 9, 0]), v), MATRIX, -MATRIX[:3]),
    "stop_gradient": (lambda a: arrays.stop_gradient({"a": a})["a"], VECTOR),
    "optimization_barrier": (lambda a: arrays.optimization_barrier((a, a))[1], VECTOR),
    "zeros": (lambda a: arrays.zeros((2, 3), like=(None, a)), VECTOR),
    "scan": (lambda a: arrays.scan(lambda c, x: (c + x, c * x), 1.0, a), VECTOR),
    "scan of pairs": (
        lambda a, b: arrays.scan(lambda c, x: (c + x[0] @ x[1], {"c": c}), 0.0, (a, b)),
        MATRIX,
        MATRIX**2,
    ),
    "scan without inputs": (lambda c: arrays.scan(lambda c, _: (2 * c, c), c, length=5), VECTOR),
    "scan without outputs": (lambda a: arrays.scan(lambda c, x: (c + x, None), 0.0, a), VECTOR),
    "map_elements": (lambda a: arrays.map_elements(lambda row: (row, row.sum()), a), MATRIX),
    "while_loop": (
        lambda a: arrays.while_loop(lambda c: c[1] < 9, lambda c: (c[0] + 1, 2 * c[1]), (0, a)),
        0.7,
    ),
    "fori_loop": (lambda a: arrays.fori_loop(1, 5, lambda i, c: i * c + 1, a), VECTOR),
    "cond, true": (lambda p, a: arrays.cond(p > 0, xp.sin, xp.cos, a), 1.0, VECTOR),
    "cond, false": (lambda p, a: arrays.cond(p > 0, xp.sin, xp.cos, a), -1.0, VECTOR),
    "vmap": (lambda a: arrays.vmap(lambda row: (row[0], row @ row))(a), MATRIX),
    "vmap, axes": (
        lambda a, b: arrays.vmap(lambda x, y, z: x * y + z, (1, None, 0), 1)(a, b, VECTOR[:3]),
        MATRIX,
        VECTOR,
    ),
    "solve_tridiagonal": (
        arrays.solve_tridiagonal,
        np.array([0.5, -1.0, 0.3]),
        np.array([2.0, 3.0, -4.0, 1.5]),
        np.array([1.0, 0.7, -0.2]),
        VECTOR,
    ),
    "solve_tridiagonal of one": (
        lambda d, r: arrays.solve_tridiagonal(d[:0], d, d[:0], r),
        VECTOR[:1],
        VECTOR[2:3],
    ),
    "solve_triangular, lower": (lambda a, b: arrays.solve_triangular(a, b, True), FACTOR, MATRIX),
    "solve_triangular, upper": (
        lambda a, b: arrays.solve_triangular(a, b, False),
        FACTOR.T.copy(),
        VECTOR,
    ),
    "solve": (arrays.solve, FACTOR, MATRIX),
    "solve, stacked": (arrays.solve, np.stack([FACTOR, FACTOR.T]), np.stack([MATRIX, MATRIX**2])),
    "solve_conditioned": (
        arrays.solve_conditioned,
        np.stack([FACTOR, FACTOR.T]),
        np.stack([MATRIX, MATRIX**2]),
    ),
    "not_differentiated": (lambda a: arrays.not_differentiated(a, "a reason"), VECTOR),
    "with_blocks": (
        lambda a, b: arrays.with_blocks((6, 9), [(np.s_[:4, :3], a), (np.s_[4:, 3:], b[:2, :6])]),
        np.ones((4, 3)),
        np.ones((4, 7)),
    ),
    "cholesky": (arrays.cholesky, FACTOR @ FACTOR.T),
    "cholesky, not positive definite": (arrays.cholesky, np.diag([1.0, -1.0])),
    "expm": (expm, FACTOR / 7 - np.eye(4)),
    "to_numpy": (lambda a: arrays.to_numpy({"a": a, "b": (1, VECTOR)}), MATRIX),
    "block_diag": (lambda a, b: arrays.block_diag(a, b, np.eye(2)), MATRIX, FACTOR),
    "slice_in_dim": (lambda a: arrays.slice_in_dim(a, 1, None, axis=-1), MATRIX),
    "index_in_dim": (lambda a, i: arrays.index_in_dim(a, i, axis=1), MATRIX, 2),
    "index_in_dim, one less": (lambda i: arrays.index_in_dim(MATRIX, i, 0, keepdims=False), 1),
    "collapse": (lambda a: arrays.collapse(a, 0, 2), MATRIX.reshape(2, 2, 3)),
    "ravel_pytree": (
        lambda a, b: arrays.ravel_pytree({"a": a, "b": b})[1](np.arange(1.0, a.size + b.size + 1)),
        MATRIX,
        VECTOR,
    ),
    "searchsorted": (lambda a, v: arrays.searchsorted(a, v), np.sort(VECTOR), VECTOR),
    "checkpoint": (
        lambda a: arrays.checkpoint(xp.sin, jax.checkpoint_policies.everything_saveable)(a),
        VECTOR,
    ),
    "without_derivative": (lambda a: arrays.without_derivative(a, a, "it jumps"), VECTOR),
}


def assert_equal_both_ways(function, *args):
    """Known arguments give known results; traced ones the same."""
    known, traced = function(*args), jax.jit(function)(*args)
    assert not arrays.any_jax(known)
    assert jax.tree.structure(known) == jax.tree.structure(traced)
    for ours, theirs in zip(jax.tree.leaves(known), jax.tree.leaves(traced), strict=True):
        assert np.shape(ours) == np.shape(theirs)
        assert_allclose(ours, theirs, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_known_and_traced_arrays_give_the_same(name):
    function, *args = FUNCTIONS[name]
    assert_equal_both_ways(function, *args)


def test_every_function_of_the_module_has_its_case():
    others = {
        "is_jax",
        "is_numpy",
        "any_jax",
        "any_traced",
        "custom_jvp",
        "Array",
        "Module",
        "Number",
    }
    functions = {
        name
        for name, value in vars(arrays).items()
        if callable(value) and not name.startswith("_") and value.__module__ == arrays.__name__
    }
    tested = {name.replace(",", "").split()[0] for name in FUNCTIONS}
    assert functions - tested - others - {"xp"} == set()


def test_arrays_are_those_of_either_library():
    found = []
    jax.jit(lambda a: found.append(isinstance(a, arrays.Array)) or a)(VECTOR)
    known = (np.zeros(2), np.float64(1.0), jax.numpy.zeros(2))
    assert found == [True] and all(isinstance(one, arrays.Array) for one in known)
    assert not any(isinstance(one, arrays.Array) for one in (1.0, [1.0], None, "a"))


def test_numbers_are_traced_in_jit_only():
    found = []
    jax.jit(lambda a: found.append(arrays.any_traced({"a": a}, VECTOR)) or a)(VECTOR)
    assert found == [True]
    assert not arrays.any_traced({"a": jnp.ones(2)}, VECTOR)


@pytest.mark.parametrize(
    "loop",
    [
        lambda a: arrays.scan(lambda c, x: (c + a * x, c), 0.0, VECTOR),
        lambda a: arrays.scan(lambda c, x: (c + x, a * c), 0.0, VECTOR),
        lambda a: arrays.map_elements(lambda x: a * x, VECTOR),
        lambda a: arrays.fori_loop(0, 3, lambda i, c: c + i * a, 1.0),
        lambda a: arrays.while_loop(lambda c: c < 9, lambda c: c + a, 0.0),
        lambda a: arrays.while_loop(lambda c: c < 9 * a, lambda c: c + 1.0, 0.0),
        lambda a: arrays.cond(True, lambda c: a * c, lambda c: c, 3.0),
        lambda a: arrays.cond(a > 0, lambda c: 2 * c, lambda c: c, 3.0),
        lambda a: arrays.vmap(lambda x: x + a)(VECTOR),
    ],
    ids=["scan", "output", "map", "fori", "while", "condition", "cond", "predicate", "vmap"],
)
def test_a_loop_over_known_numbers_may_use_a_traced_one(loop):
    assert_equal_both_ways(loop, 0.7)


@pytest.mark.parametrize("name", ["scan", "while_loop"])
def test_a_loop_that_becomes_traced_is_one_loop_of_jax(name):
    loops = {
        "scan": lambda a: arrays.scan(lambda c, x: (c + a * x, c), 0.0, np.arange(50.0)),
        "while_loop": lambda a: arrays.while_loop(lambda c: c < 50, lambda c: c + a, 0.0),
    }
    assert len(jax.make_jaxpr(loops[name])(0.7).eqns) < 5


@pytest.mark.parametrize("right", [MATRIX, np.stack([MATRIX, MATRIX])], ids=["one", "stack"])
def test_solutions_of_singular_systems_are_not_finite(right):
    singular = np.diag([1.0, 0.0, 2.0, 3.0])
    matrix = np.stack([singular, FACTOR]) if right.ndim == 3 else singular
    for solution in (arrays.solve(matrix, right), jax.jit(arrays.solve)(matrix, right)):
        solution = np.reshape(solution, (-1, 4, 3))
        assert not np.isfinite(solution[0]).all()
        if right.ndim == 3:
            assert_allclose(solution[1], np.linalg.solve(FACTOR, MATRIX), rtol=1e-12)


def test_conditions_of_known_numbers_compute_one_branch():
    def refused(_):
        raise AssertionError("the other branch")

    assert arrays.cond(False, refused, lambda a: a + 1, 1) == 2


def test_derivatives_follow_a_rule_that_known_numbers_do_not_need():
    @arrays.custom_jvp
    def cube(x):
        """The third power."""
        return x**3

    @cube.defjvp
    def _(primals, tangents):
        return cube(*primals), 5.0 * tangents[0]  # wrong, so that it is seen

    assert cube(2.0) == 8.0 and cube.__doc__ == "The third power."
    assert jax.grad(cube)(2.0) == 5.0 and jax.jit(cube)(2.0) == 8.0
    assert jax.grad(lambda x: arrays.stop_gradient(x) * x)(3.0) == 3.0


def test_arrays_of_jax_are_found():
    array = jnp.ones(2)
    assert arrays.is_jax(array) and arrays.is_jax([1.0, (array,)])
    assert not any(map(arrays.is_jax, (1.0, VECTOR, [VECTOR, None], "name", np.float64(1))))
    assert arrays.any_jax(1.0, {"a": [array]}) and not arrays.any_jax(1.0, {"a": [VECTOR]})


def test_known_arrays_are_not_changed():
    before = MATRIX.copy()
    arrays.set_at(MATRIX, 0, 1.0)
    arrays.add_at(MATRIX, 0, 1.0)
    arrays.put(MATRIX, np.array([0]), np.ones((1, 3)))
    assert np.array_equal(MATRIX, before)


numbers = st.floats(-10, 10, allow_subnormal=False)
shapes = arrays_of.array_shapes(min_dims=1, max_dims=3, min_side=1, max_side=4)


@given(arrays_of.arrays(float, shapes, elements=numbers), st.data())
def test_entries_at_any_place(array, data):
    indices = st.integers(-array.shape[0], array.shape[0] - 1)
    index = data.draw(indices | st.lists(indices, min_size=1, max_size=3, unique=True))
    index = np.asarray(index)
    value = data.draw(arrays_of.arrays(float, array[index].shape, elements=numbers))
    functions = (
        lambda a, v: arrays.set_at(a, index % array.shape[0], v),
        lambda a, v: arrays.add_at(a, index, v),
        lambda a, _: arrays.take(a, index),
    )
    for function in functions:
        known, of_jax = function(array, value), function(jnp.asarray(array), jnp.asarray(value))
        assert isinstance(known, np.ndarray | np.generic) and isinstance(of_jax, jax.Array)
        # Repeated entries are added in any order.
        assert_allclose(known, of_jax, rtol=1e-13, atol=1e-13)


@st.composite
def products(draw):
    """Subscripts of a product of two arrays with its output, and the arrays."""
    sizes = {label: draw(st.integers(1, 3)) for label in "abcd"}
    labels = st.lists(st.sampled_from("abcd"), min_size=1, max_size=4, unique=True)
    first, second = draw(labels), draw(labels)
    output = draw(st.permutations(sorted({*first, *second})))[: draw(st.integers(0, 4))]
    arguments = [
        draw(arrays_of.arrays(float, [sizes[label] for label in part], elements=numbers))
        for part in (first, second)
    ]
    return f"{''.join(first)},{''.join(second)}->{''.join(output)}", *arguments


@given(products())
def test_products_of_any_subscripts(product):
    subscripts, a, b = product
    expected = np.einsum(subscripts, a, b)
    assert_allclose(xp.einsum(subscripts, a, b), expected, rtol=1e-12, atol=1e-12)
    of_jax = xp.einsum(subscripts, jnp.asarray(a), b)
    assert isinstance(of_jax, jax.Array)
    assert_allclose(of_jax, expected, rtol=1e-12, atol=1e-12)


def test_known_numbers_of_jax_become_those_of_numpy():
    tree = arrays.to_numpy({"a": jnp.asarray(VECTOR), "b": "words"})
    assert isinstance(tree["a"], np.ndarray)
    np.testing.assert_array_equal(tree["a"], VECTOR)
    assert tree["b"] == "words"
