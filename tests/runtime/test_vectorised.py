"""Functions of known arrays over a first axis: those of each element, all at once."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import addresses, concrete_case, replace
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import add_at, is_jax, is_known, set_at, vmap, xp
from jaxbeam.runtime.vectorised import NotVectorisedError, VectorisedArray, vectorised

CONSTANT = np.arange(6.0).reshape(2, 3)

# Functions of an array of two rows and three columns, and of a number.
FUNCTIONS = {
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


@pytest.mark.parametrize("name", FUNCTIONS)
@given(VALUES)
def test_results_are_those_of_each_element(name, values):
    function = FUNCTIONS[name]
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
    assert not is_known(varying) and not is_jax(varying)
    assert is_known(np.ones(2)) and not is_known(jax.numpy.ones(2))
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
