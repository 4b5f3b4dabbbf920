"""Steps without commands: their own derivative rule against that of every operation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.integrator.step import advance, advance_unforced
from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.simulation.simulate import simulate_readings
from tests.runs import plan_of

STEPS, BATCH_SIZE = 5, 3


def random_steps(blocks: int, side: int, rows: int):
    """Step matrices, inertia, weight and state, with tangents of all of them.

    The last step but one is without a load.
    """
    rng, states = np.random.default_rng(blocks * side), blocks * side
    root = rng.normal(size=(STEPS, rows, rows))
    sizes = {
        "contact_response": (rows, states),
        "transition": (blocks, side, side),
        "force_response": (states, rows),
    }
    parts = {name: rng.normal(size=(STEPS, *shape)) for name, shape in sizes.items()}
    active = np.arange(STEPS) != STEPS - 2
    matrices = StepMatrices(
        **jax.tree.map(jnp.asarray, parts),
        contact_compliance=jnp.asarray(root @ root.swapaxes(1, 2)),
        monitored=None,
        commands=None,
        nodes=None,
        loaded=jnp.asarray(active),
    )
    on = active[:, None, None]
    loads = tuple(on * rng.uniform(0.1, 1.0, (STEPS, rows, BATCH_SIZE)) for _ in range(2))
    given = matrices, *loads, rng.normal(size=(states, BATCH_SIZE))

    def changed(leaf):
        if leaf.dtype == bool:
            return np.zeros(leaf.shape, jax.dtypes.float0)
        # A step without a load stays without.
        here = on if leaf.shape == loads[0].shape else 1.0
        return jnp.asarray(here * rng.normal(size=leaf.shape))

    given = jax.tree.map(jnp.asarray, given)
    return given, jax.tree.map(changed, given)


def one_by_one(matrices, inertia, weight, state):
    """The same steps, differentiated operation by operation."""
    after, (states, forces) = jax.lax.scan(advance, state, (matrices, inertia, weight, None))
    return after, states, forces


# One block a mode, more terms than are spelt out, and a model whose modes are coupled.
SHAPES = [(3, 2, 6), (8, 2, 12), (1, 7, 6)]


@pytest.mark.parametrize("shape", SHAPES)
def test_tangents_of_steps_are_those_of_every_operation(shape):
    given, changes = random_steps(*shape)
    found = jax.jvp(advance_unforced, given, changes)
    wanted = jax.jvp(one_by_one, given, changes)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_tangents_of_steps_are_differences(shape):
    given, changes = random_steps(*shape)
    size = 1e-6

    def moved(by):
        def shifted(a, b):
            return a if a.dtype == bool else a + by * b

        return advance_unforced(*jax.tree.map(shifted, given, changes))

    found = jax.jvp(advance_unforced, given, changes)[1]
    for a, up, down in zip(found, moved(size), moved(-size), strict=True):
        change = (up - down) / (2 * size)
        np.testing.assert_allclose(a, change, rtol=1e-6, atol=1e-7 * np.abs(change).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_reverse_mode_is_the_transpose_of_forward_mode(shape):
    """First and second derivatives along a direction are the same in both modes."""
    (matrices, *rest), (matrix_tangents, *rest_tangents) = random_steps(*shape)
    found = advance_unforced(matrices, *rest)
    wanted = [np.random.default_rng(7).normal(size=part.shape) for part in found]

    names = "contact_response", "contact_compliance", "transition", "force_response"

    def misfit(*parts):
        parts, rest = parts[: len(names)], parts[len(names) :]
        moved = StepMatrices(*parts, None, None, None, matrices.loaded)
        found = advance_unforced(moved, *rest)
        return sum(jnp.sum((a - b) ** 2) for a, b in zip(found, wanted, strict=True))

    given = (*(getattr(matrices, name) for name in names), *rest)
    changes = (*(getattr(matrix_tangents, name) for name in names), *rest_tangents)
    slope = jax.grad(misfit, argnums=tuple(range(len(given))))

    def along(*given):
        return sum(jnp.sum(a * b) for a, b in zip(slope(*given), changes, strict=True))

    forward, bend = jax.jvp(lambda *g: jax.jvp(misfit, g, changes)[1], given, changes)
    np.testing.assert_allclose(along(*given), forward, rtol=1e-10)
    np.testing.assert_allclose(jax.jvp(along, given, changes)[1], bend, rtol=1e-9)


def test_reverse_mode_stores_states_and_forces_of_each_step_only():
    """12 numbers, and those of the result; the matrices of a step alone are 150."""
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
