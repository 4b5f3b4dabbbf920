"""Programs in NumPy, equation by equation, against the same programs compiled by XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from jax import lax
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import addresses, concrete_case, replace
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime import interpreter
from jaxbeam.runtime.arrays import add_at, is_jax, is_numpy, set_at, take, vmap, xp
from jaxbeam.runtime.interpreter import InterpretedProgram, compile_cost, run_cost
from jaxbeam.runtime.lapack import _solve as solve
from jaxbeam.runtime.vectorised import NotVectorisedError, VectorisedArray, vectorised

RANDOM = np.random.default_rng(20)
A, B = RANDOM.normal(size=(2, 3, 4)), RANDOM.normal(size=(2, 3, 4))
SQUARE = RANDOM.normal(size=(4, 3, 3)) + 3 * np.eye(3)
FLAT, WHERE = RANDOM.normal(size=6), np.array([[4, 0], [-7, 9], [2, 2]])
WHOLE, BITS = np.array([7, -7, 3]), np.array([True, False, True])


@jax.custom_vjp
def optimized(x):
    return jnp.square(x)


optimized.defvjp(lambda x: (x**2, x), lambda x, slope: 2 * x * slope)

FUNCTIONS = {
    "eigenvalues in any order": (
        lambda m: lax.linalg.eigh(m + m.mT, sort_eigenvalues=False)[1],
        SQUARE,
    ),
    "arithmetic": (lambda a, b: jnp.sign(a) * abs(b) - a / b + jnp.maximum(a, b) % 0.3, A, B),
    "whole numbers": (lambda a: [lax.div(a, 2), lax.rem(a, 2), a**3, -a, jnp.sum(a)], WHOLE),
    "bits": (lambda a, b: [a & b, a | b, a ^ b, ~a, jnp.sum(a)], BITS, BITS[::-1]),
    "bits of numbers": (lambda a: [a & 6, ~a, a == 7, a >= 3, a <= 3], WHOLE),
    "powers": (lambda a: [a**2, a**-3, a**5, abs(a) ** 1.7, jnp.exp2(a), lax.rsqrt(a**2)], A),
    "angles": (
        lambda a: [
            jnp.arcsin(a / 9),
            jnp.arccos(a / 9),
            jnp.sin(a),
            jnp.cos(a),
            jnp.tan(a),
            jnp.arctan2(a, 2.0),
            jnp.arctan(a),
        ],
        A,
    ),
    "hyperbolic": (
        lambda a: [
            jnp.tanh(a),
            jnp.sinh(a),
            jnp.cosh(a),
            jnp.arcsinh(a),
            jnp.arctanh(a / 9),
            jnp.arccosh(2 + a**2),
        ],
        A,
    ),
    "logarithms": (
        lambda a: [jnp.log1p(a**2), jnp.log(abs(a)), jnp.expm1(a), jnp.cbrt(a), jnp.sqrt(abs(a))],
        A,
    ),
    "rounding": (lambda a: [jnp.floor(a), jnp.ceil(a), jnp.isfinite(1 / (a - a)), a + 0], A),
    "choices": (
        lambda a: [jnp.where(a > 0, a, 0.0), jnp.clip(a, -0.5, 0.5), lax.select_n(a > 1, a, -a)],
        A,
    ),
    "one of three": (lambda a, k: lax.select_n(k, a, 2 * a, 3 * a), FLAT[:3], np.array([2, 0, 1])),
    "complex numbers": (
        lambda a: [(lax.complex(a, 2 * a) ** 2).real, jnp.conj(lax.complex(a, a)).imag],
        A,
    ),
    "types": (lambda a: [a.astype(int), a.astype(bool), (1j * a).real], 3 * A),
    "shapes": (
        lambda a: [a.T, a[:, ::-1], a[1, ::2, 1:3], a.reshape(4, -1), jnp.squeeze(a[:1])],
        A,
    ),
    "parts": (
        lambda a, b: [jnp.stack([a, b]), jnp.concatenate([a, b], 1), jnp.split(a, [1, 2], axis=1)],
        A,
        B,
    ),
    "one after the other": (lambda a: [*a, *jnp.unstack(a, axis=2)], A),
    "polynomials": (lambda a: [jnp.polyval(a[0, 0, :3], a), jnp.polyval(a[:, :, :2].T, 0.3)], A),
    "derivative of a saturation": (jax.grad(lambda a: jnp.tanh(a).sum()), A),
    "repeats": (lambda a: [jnp.tile(a, (1, 2, 1)), jnp.broadcast_to(a[:, None], (2, 5, 3, 4))], A),
    "padding": (
        lambda a: [
            lax.pad(a, 1.0, [(1, 0, 2), (0, -1, 0)]),
            lax.pad(a, 0.0, [(-1, 2, 1), (0,) * 3]),
        ],
        A[0],
    ),
    "counting": (lambda a: a * jnp.arange(4) + lax.broadcasted_iota(int, (3, 4), 0), A),
    "products": (
        lambda a, b: [
            jnp.einsum("abc,abd->cd", a, b),
            jnp.einsum("abc,dbc->bad", a, b),
            jnp.tensordot(a, b, 3),
            a[0] @ b[0].T,
        ],
        A,
        B,
    ),
    "products of nothing": (lambda a: jnp.einsum("ab,bc->ac", a[:, :0], a[:0]), A[0]),
    "sums": (
        lambda a: [a.sum((0, 2)), a.prod(1), a.max(), a.min(0), (a > 0).any(1), (a > 0).all()],
        A,
    ),
    "running sums": (
        lambda a: [
            jnp.cumsum(a, 1),
            lax.cumsum(a, 2, True),
            jnp.cumprod(a, 0),
            lax.cummax(a, 1),
            lax.cummin(a),
        ],
        A,
    ),
    "positions": (
        lambda a: [jnp.argmax(a, 1), jnp.argmin(a, 2), jnp.argmax(a.at[0].set(jnp.nan))],
        A,
    ),
    "order": (lambda a: [jnp.sort(a, 1), jnp.argsort(a, 0), lax.sort((a, -a), num_keys=2)], A),
    "entries": (
        lambda a, i: [a[i], a[i, 1], a[:, [0, 2]], jnp.take(a, i, mode="clip")],
        A[0],
        WHERE,
    ),
    "entries or none": (
        lambda a, i: [a.at[i].get(mode="fill"), a.at[i, 1:3].get(mode="fill", fill_value=2.0)],
        A[0],
        WHERE,
    ),
    "whole entries or none": (
        lambda a, i: [a.at[i].get(mode="fill"), (a > 0).at[i].get(mode="fill")],
        WHOLE,
        WHERE,
    ),
    "entries along an axis": (
        lambda a, i: [
            jnp.take_along_axis(a, i, axis=0),
            jax.vmap(lambda own, at: own[at])(a, i),
        ],
        A[0],
        np.array([[0, 1, 2, 1], [2, 2, 0, 0], [1, 0, 1, 2]]),
    ),
    "set entries": (
        lambda a, i: [
            a.at[i[0]].set(0.0),
            a.at[i, 1].add(2.0),
            a.at[i, 1].subtract(2.0),
            a.at[i, 1:3].multiply(2.0),
            a.at[:, 1].set(a[:, 0]),
            a.at[i[:, 0]].max(a[:3] + 1),
            a.at[i].min(0.0, mode="drop"),
            a.at[1].set(7.0),
        ],
        A[0],
        WHERE,
    ),
    "set entries of a batch": (
        jax.vmap(lambda a, i: a.at[i].add(a[i], mode="drop")),
        A[0],
        np.array([[0, 1], [9, 1], [2, 2]]),
    ),
    "windows": (
        lambda a, i: [
            lax.dynamic_slice(a, (i, 2), (2, 2)),
            lax.dynamic_update_slice(a, a[:2, :2] + 1, (i, 9)),
            jax.vmap(lambda at: lax.dynamic_slice(a, (at, 0), (2, 3)))(jnp.arange(3) + i - i),
        ],
        A[0],
        np.array(1),
    ),
    "factors": (
        lambda m: [jnp.linalg.cholesky(m @ m.mT), jnp.linalg.eigh(m + m.mT)[0]],
        SQUARE,
    ),
    "no factor": (lambda m: jnp.linalg.cholesky(-m @ m.mT), SQUARE[0]),
    "systems": (
        lambda m: [
            jnp.linalg.solve(m[0], m[1]),
            lax.linalg.triangular_solve(m, m, left_side=True, lower=True, transpose_a=True),
            lax.linalg.triangular_solve(m, m, unit_diagonal=True),
        ],
        SQUARE,
    ),
    "loops": (
        lambda a: [
            lax.scan(lambda sum_, x: (sum_ + x, sum_ * x), 0.0, a),
            lax.scan(lambda sum_, x: (sum_ - x, None), 1.0, a, reverse=True),
            lax.fori_loop(0, 5, lambda i, x: x * 0.5 + i, a),
            lax.while_loop(lambda x: x.sum() < 10, lambda x: x + 1, a),
            # Each ends by itself.
            jax.vmap(
                lambda x: lax.while_loop(
                    lambda x: x[0] < 9, lambda x: 2 * x + 3, jnp.stack([x, 1 - x])
                )
            )(a),
        ],
        FLAT,
    ),
    "branches": (
        lambda a: [
            lax.cond(a[0] > 0, jnp.sin, jnp.cos, a),
            lax.cond(a[0] < 0, jnp.sin, jnp.cos, a),
            lax.switch(7, [jnp.sin, jnp.cos], a),
            lax.platform_dependent(a, cpu=jnp.sin, default=jnp.cos),
        ],
        FLAT,
    ),
    "other programs": (
        lambda a: [
            jax.jit(jnp.sin)(a),
            jax.checkpoint(jnp.cos)(a),
            jax.nn.relu(a),
            lax.exp(a),
            solve(np.eye(6), a),
            optimized(a),
            jnp.copy(a),
            lax.stop_gradient(a),
            lax.optimization_barrier(a),
        ],
        FLAT,
    ),
    "random numbers": (lambda seed: jax.random.normal(jax.random.key(seed), (3,)), np.array(3)),
    "a derivative": (
        jax.grad(lambda a: jnp.linalg.solve(jnp.outer(a, a) + jnp.eye(6), a)[0]),
        FLAT,
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_each_primitive_is_that_of_xla(name):
    function, *arrays = FUNCTIONS[name]
    expected = jax.tree.leaves(jax.jit(function)(*arrays))
    found = InterpretedProgram(jax.make_jaxpr(function)(*arrays))(*arrays)
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert_allclose(one, other, rtol=1e-12, atol=1e-13)
        assert np.shape(one) == other.shape
        assert np.asarray(one).dtype == other.dtype


def test_all_rules_are_tested():
    tested = set()

    def note(jaxpr):
        tested.update(equation.primitive.name for equation in jaxpr.eqns)
        for equation in jaxpr.eqns:
            for part in interpreter._programs_of(equation):
                note(part)

    for function, *arrays in FUNCTIONS.values():
        note(jax.make_jaxpr(function)(*arrays).jaxpr)
    rules = {*interpreter.ELEMENTWISE, *interpreter.WITH_PARAMETERS, *interpreter.OPENED}
    # Primitives that older versions of JAX lack.
    newer = {"unstack", "polynomial", "one_minus_square"}
    assert rules - tested <= {name for name in newer if not hasattr(lax, f"{name}_p")}


def test_costs_are_those_of_all_trips():
    def loop(count):
        def function(x):
            return lax.scan(lambda y, _: (jnp.sin(y), None), x, None, count)[0]

        return jax.make_jaxpr(function)(1.0).jaxpr

    assert run_cost(loop(100)) > 40 * run_cost(loop(2))
    assert compile_cost(loop(100)) == compile_cost(loop(2))


# Functions of known arrays over a first axis: those of each element, all at once.

CONSTANT = np.arange(6.0).reshape(2, 3)
BORDERS = np.array([-1.0, 0.0, 1.0])

# Functions of an array of two rows and three columns, and of a number.
BATCHED_FUNCTIONS = {
    "broadcast": lambda a, x: x + a * CONSTANT - a[0],
    "inner axes": lambda a, x: a[:, None] * x - CONSTANT[0],
    "comparison": lambda a, x: (a < x) | (a > 2 * x),
    "where": lambda a, x: xp.where(a > x, a, 0.0),
    "list": lambda a, x: a * [1.0, 2.0, 3.0] + xp.where(x > 0, [x.dtype.itemsize, 1.0, 2.0], a),
    "clip": lambda a, x: xp.clip(a, 0.0, x),
    "concatenate": lambda a, x: xp.concatenate([a, CONSTANT, x * a], axis=1),
    "stack": lambda a, x: xp.stack([a[0], CONSTANT[1], x * a[1]], axis=-1),
    "array": lambda a, x: xp.array([x, 1.0, a[0, 1]]),
    "asarray": lambda a, x: xp.asarray(x, float) + xp.asarray(a),
    "append": lambda a, x: xp.append(a, x),
    "reshape": lambda a, x: a.reshape(3, -1) * xp.reshape(x, (1, 1)),
    "expand": lambda a, x: xp.expand_dims(a, -1) + xp.expand_dims(a, 0)[..., None],
    "broadcast to": lambda a, x: xp.broadcast_to(a[0] * x, (4, 3)),
    "moveaxis": lambda a, x: xp.moveaxis(a, 0, -1) + a.T * x,
    "search": lambda a, x: take(CONSTANT, xp.searchsorted(BORDERS, x, side="right") // 2) * x,
    "search of several": lambda a, x: take(CONSTANT, xp.searchsorted(BORDERS, a[0]) // 2),
    "pad": lambda a, x: xp.pad(a * x, [(0, 1), (2, 0)], constant_values=7.0),
    "tile": lambda a, x: xp.tile(a[1] * x, 2),
    "zeros": lambda a, x: xp.zeros_like(a) + x,
    "differences": lambda a, x: xp.diff(a) * x,
    "order": lambda a, x: a[0][xp.argsort(a[0], stable=True)] + xp.cumsum(a[1]),
    "reductions": lambda a, x: xp.max(a) - xp.min(a, axis=0) + xp.sum(a, axis=-1)[0] * x,
    "sums": lambda a, x: xp.cumsum(a) * x + xp.cumsum(a, axis=0)[-1, 0],
    "any": lambda a, x: xp.any(a > x) & xp.all(a[1] > x),
    "matrices": lambda a, x: a @ CONSTANT.T + CONSTANT @ (x * a).T,
    "vectors": lambda a, x: a @ CONSTANT[0] + CONSTANT[:, :2] @ a[:, 0] + a[0] @ a[1],
    "equations": lambda a, x: xp.linalg.solve(a[:, :2] + 20 * np.eye(2), a * x),
    "equations, a vector": lambda a, x: xp.linalg.solve(a[:, :2] + 20 * np.eye(2), a[:, 2]),
    "set": lambda a, x: set_at(set_at(CONSTANT, (1, 2), x), np.s_[0], a[1]),
    "set in": lambda a, x: set_at(a, np.s_[:, 1], x),
    "iteration": lambda a, x: sum(row[i] for i, row in enumerate(a)) + x * len(a),
    "within": lambda a, x: vmap(lambda row: xp.sum(row * x + CONSTANT), out_axes=-1)(a),
    "within, matrices": lambda a, x: vmap(lambda row: set_at(a, 0, row) @ (row - x))(a * x),
    "shape": lambda a, x: np.ones(xp.shape(a)) * xp.size(a) * xp.ndim(a) * x,
    "constant": lambda a, x: CONSTANT,
}
VALUES = st.lists(st.floats(-3.0, 3.0), min_size=21, max_size=21).map(np.array)


@pytest.mark.parametrize("name", BATCHED_FUNCTIONS)
@given(VALUES)
def test_results_are_those_of_each_element(name, values):
    function = BATCHED_FUNCTIONS[name]
    rows, numbers = values[:18].reshape(3, 2, 3), values[18:]
    found = vectorised(function)(rows, numbers)
    expected = np.stack([function(a, x) for a, x in zip(rows, numbers, strict=True)])
    assert found.shape == expected.shape and found.dtype == expected.dtype
    assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_the_axis_of_results_can_be_the_last():
    found = vectorised(lambda x: CONSTANT * x, out_axes=-1)(np.array([1.0, 2.0]))
    assert found.shape == (2, 3, 2) and np.array_equal(found[..., 1], 2 * CONSTANT)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x if x > 0 else -x,
        float,
        lambda x: np.ones(3)[x],
        lambda x: np.asarray(x) + 1,
        lambda x: np.fft.fft(xp.stack([x, x])),
        lambda x: xp.clip(x, a_min=0.0, a_max=1.0),
        lambda x: add_at(np.ones(3), 0, x),
        lambda x: x.mean(),
        lambda x: np.add.reduce(xp.stack([x, x])),
        lambda x: np.add(x, 1, where=True),
        lambda x: xp.stack([x, x])[xp.asarray(x > 0), 0],
        lambda x: xp.tile(CONSTANT * x, 2),
        lambda x: np.modf(x)[0],
        lambda x: np.sum(CONSTANT * x, keepdims=True),
        lambda x: xp.max(CONSTANT, initial=x),
        lambda x: xp.pad(np.ones(2), (0, 1), constant_values=x),
    ],
)
def test_what_cannot_be_vectorised_says_so(function):
    with pytest.raises(NotVectorisedError):
        vectorised(function)(np.array([1.0, 2.0]))


def test_what_varies_is_no_known_number():
    varying = VectorisedArray(np.ones(2))
    assert not is_numpy(varying) and not is_jax(varying)
    assert is_numpy(np.ones(2)) and not is_numpy(jax.numpy.ones(2))
    assert not hasattr(varying, "__jax_array__")


BEAM = jb.Beam(20.0, 1e10, 12e3, modes=2)
AXLES = jb.Axles(masses=[2e3, 3e3], offsets=[0.0, 4.0], speed=20.0, count=2, spacing=9.0)
LOADS = {
    "mass": jb.MovingMass(mass=5e3, speed=-20.0, deceleration=2.0),
    "force": jb.MovingForce(force=5e4, speed=3.0, deceleration=1.0, start_position=-2.0),
    "axles": AXLES,
    "oscillator": jb.Oscillator(mass=2e3, stiffness=1e5, damping=1e3, speed=20.0, wheel_mass=30.0),
}


@pytest.mark.parametrize("name", LOADS)
@settings(max_examples=20)
@given(st.data())
def test_loads_are_those_of_each_case(name, data):
    case = concrete_case(jb.Case(BEAM, loads=[LOADS[name]]))
    numbers = {
        address: value
        for address, value in addresses(case).items()
        if address.startswith("loads.") and not np.ndim(value)
    }
    address = data.draw(st.sampled_from(sorted(numbers)))
    factors = data.draw(st.lists(st.floats(0.5, 1.5), min_size=2, max_size=4))
    values = np.array(factors) * numbers[address]

    def loads_of(value):
        loads = load_set(replace(case, {address: value}))
        return loads.wheels, loads.events(np.array([5.0, 20.0])), loads.cubics()

    with np.errstate(all="ignore"):
        found = jax.tree.leaves(vectorised(loads_of)(values))
        expected = [jax.tree.leaves(loads_of(value)) for value in values]
    for part, each in zip(found, zip(*expected, strict=True), strict=True):
        assert_allclose(part, np.stack(each), rtol=1e-13, atol=1e-13)
