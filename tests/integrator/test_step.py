"""Rows of steps without commands: their derivative by hand against that of every operation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.integrator.step import advance, undriven
from jaxbeam.integrator.step_matrices import Tables
from jaxbeam.simulation.simulate import simulate_readings
from tests.runs import plan_of

STEPS, LANES = 5, 3


def random_steps(blocks: int, side: int, rows: int):
    """Tables of a few steps, the last but one without a load, and loads; changes of all of them."""
    rng, states = np.random.default_rng(blocks * side), blocks * side
    root = rng.normal(size=(STEPS, rows, rows))
    sizes = {
        "respond": (rows, states),
        "drift": (blocks, side, side),
        "push": (states, rows),
    }
    parts = {name: rng.normal(size=(STEPS, *shape)) for name, shape in sizes.items()}
    active = np.arange(STEPS) != STEPS - 2
    tables = Tables(
        **jax.tree.map(jnp.asarray, parts),
        gains=jnp.asarray(root @ root.swapaxes(1, 2)),
        watch=None,
        commands=None,
        inner=None,
        active=jnp.asarray(active),
    )
    on = active[:, None, None]
    loads = tuple(on * rng.uniform(0.1, 1.0, (STEPS, rows, LANES)) for _ in range(2))
    given = tables, *loads, rng.normal(size=(states, LANES))

    def changed(leaf):
        if leaf.dtype == bool:
            return np.zeros(leaf.shape, jax.dtypes.float0)
        # What is no load stays none.
        here = on if leaf.shape == loads[0].shape else 1.0
        return jnp.asarray(here * rng.normal(size=leaf.shape))

    given = jax.tree.map(jnp.asarray, given)
    return given, jax.tree.map(changed, given)


def one_by_one(tables, inertia, weight, state):
    """The same steps, differentiated operation by operation."""
    after, (states, forces) = jax.lax.scan(advance, state, (tables, inertia, weight, None))
    return after, states, forces


# One block a mode, more terms than are spelt out, and a rig whose modes are coupled.
SHAPES = [(3, 2, 6), (8, 2, 12), (1, 7, 6)]


@pytest.mark.parametrize("shape", SHAPES)
def test_changes_of_steps(shape):
    given, changes = random_steps(*shape)
    found = jax.jvp(undriven, given, changes)
    wanted = jax.jvp(one_by_one, given, changes)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_changes_of_steps_are_differences(shape):
    given, changes = random_steps(*shape)
    size = 1e-6

    def moved(by):
        def shifted(a, b):
            return a if a.dtype == bool else a + by * b

        return undriven(*jax.tree.map(shifted, given, changes))

    found = jax.jvp(undriven, given, changes)[1]
    for a, up, down in zip(found, moved(size), moved(-size), strict=True):
        change = (up - down) / (2 * size)
        np.testing.assert_allclose(a, change, rtol=1e-6, atol=1e-7 * np.abs(change).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_backward_is_forward_turned_round(shape):
    """Along a change the slope is the same in both modes, and so is the slope of the slope."""
    (tables, *rest), (tables_change, *rest_change) = random_steps(*shape)
    wanted = [np.random.default_rng(7).normal(size=part.shape) for part in undriven(tables, *rest)]

    def misfit(respond, gains, drift, push, *rest):
        moved = Tables(respond, gains, drift, push, None, None, None, tables.active)
        found = undriven(moved, *rest)
        return sum(jnp.sum((a - b) ** 2) for a, b in zip(found, wanted, strict=True))

    names = "respond", "gains", "drift", "push"
    given = (*(getattr(tables, name) for name in names), *rest)
    changes = (*(getattr(tables_change, name) for name in names), *rest_change)
    slope = jax.grad(misfit, argnums=tuple(range(len(given))))

    def along(*given):
        return sum(jnp.sum(a * b) for a, b in zip(slope(*given), changes, strict=True))

    forward, bend = jax.jvp(lambda *g: jax.jvp(misfit, g, changes)[1], given, changes)
    np.testing.assert_allclose(along(*given), forward, rtol=1e-10)
    np.testing.assert_allclose(jax.jvp(along, given, changes)[1], bend, rtol=1e-9)


def test_backward_keeps_little_of_each_step():
    """Its state and its forces, 12 numbers, and what the result has; its matrices alone are 150."""
    beam = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3)
    load = jb.MovingMass(mass=0.5, speed=1.0)
    case = jb.Case(beam, sensors=[jb.Sensor(0.3)], loads=[load], run=jb.Run(0.5))

    def memory(count):
        times = jnp.linspace(0.0, 0.5, count)
        plan = plan_of(case, substeps=1)

        def misfit(mass):
            varied = jb.replace(case, {"loads.0.mass": mass})
            return jnp.sum(simulate_readings(varied, times, plan) ** 2)

        return jax.jit(jax.grad(misfit)).lower(0.5).compile().memory_analysis().temp_size_in_bytes

    assert (memory(3201) - memory(1601)) / 1600 < 8 * 40
