"""Steps: as maps, one operation after the other, of many states, of modes without coupling."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.integrator import step_matrices
from jaxbeam.simulation.integrator.step import advance, advance_unforced
from jaxbeam.simulation.integrator.step_matrices import StepMatrices
from jaxbeam.simulation.integrator.step_size import static_shapes
from jaxbeam.simulation.integrator.vehicles import StepInput
from jaxbeam.simulation.simulate import simulate_readings
from tests.differences import plan_of

STEPS, BATCH_SIZE = 5, 1


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
        springs=None,
        loaded=jnp.asarray(active),
    )
    on = active[:, None, None]
    loads = tuple(on * rng.uniform(0.1, 1.0, (STEPS, rows, BATCH_SIZE)) for _ in range(2))
    arguments = matrices, *loads, rng.normal(size=(states, BATCH_SIZE))

    def tangent(leaf):
        if leaf.dtype == bool:
            return np.zeros(leaf.shape, jax.dtypes.float0)
        # Tangents do not add a load to a step without one.
        factor = on if leaf.shape == loads[0].shape else 1.0
        return jnp.asarray(factor * rng.normal(size=leaf.shape))

    arguments = jax.tree.map(jnp.asarray, arguments)
    return arguments, jax.tree.map(tangent, arguments)


def advance_plain_wheels(matrices, inertia, weight, state):
    return advance_unforced(StepInput(matrices, inertia, weight, None), state, None)


def advance_by_operations(matrices, inertia, weight, state):
    """The same steps, one after the other."""
    steps = StepInput(matrices, inertia, weight, None)
    after, (states, forces) = jax.lax.scan(advance, state, steps)
    return after, states, forces


# One block for each mode, more terms than are unrolled, and coupled modes.
SHAPES = [(3, 2, 6), (8, 2, 12), (1, 7, 6)]


@pytest.mark.parametrize("shape", SHAPES)
def test_tangents_of_steps_are_those_of_every_operation(shape):
    arguments, tangents = random_steps(*shape)
    found = jax.jvp(advance_plain_wheels, arguments, tangents)
    expected = jax.jvp(advance_by_operations, arguments, tangents)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_tangents_of_steps_are_differences(shape):
    arguments, tangents = random_steps(*shape)
    size = 1e-6

    def result_after(by):
        def shifted(a, b):
            return a if a.dtype == bool else a + by * b

        return advance_plain_wheels(*jax.tree.map(shifted, arguments, tangents))

    found = jax.jvp(advance_plain_wheels, arguments, tangents)[1]
    for a, up, down in zip(found, result_after(size), result_after(-size), strict=True):
        change = (up - down) / (2 * size)
        np.testing.assert_allclose(a, change, rtol=1e-6, atol=1e-7 * np.abs(change).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_reverse_mode_is_the_transpose_of_forward_mode(shape):
    """First and second derivatives along a direction are the same in both modes."""
    (matrices, *rest), (matrix_tangents, *rest_tangents) = random_steps(*shape)
    found = advance_plain_wheels(matrices, *rest)
    targets = [np.random.default_rng(7).normal(size=part.shape) for part in found]

    names = "contact_response", "contact_compliance", "transition", "force_response"

    def misfit(*parts):
        parts, rest = parts[: len(names)], parts[len(names) :]
        varied = StepMatrices(*parts, None, None, None, None, matrices.loaded)
        found = advance_plain_wheels(varied, *rest)
        return sum(jnp.sum((a - b) ** 2) for a, b in zip(found, targets, strict=True))

    arguments = (*(getattr(matrices, name) for name in names), *rest)
    tangents = (*(getattr(matrix_tangents, name) for name in names), *rest_tangents)
    gradient = jax.grad(misfit, argnums=tuple(range(len(arguments))))

    def directional_derivative(*arguments):
        return sum(jnp.sum(a * b) for a, b in zip(gradient(*arguments), tangents, strict=True))

    forward, second_derivative = jax.jvp(
        lambda *g: jax.jvp(misfit, g, tangents)[1], arguments, tangents
    )
    np.testing.assert_allclose(directional_derivative(*arguments), forward, rtol=1e-10)
    np.testing.assert_allclose(
        jax.jvp(directional_derivative, arguments, tangents)[1], second_derivative, rtol=1e-9
    )


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


CASE = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, 0.02, modes=5),
    sensors=[jb.Sensor(0.45)],
    loads=[
        jb.MovingMass(mass=0.3, speed=6.0),
        jb.MovingForce(mass=0.2, speed=-5.0, entry_time=0.01),
    ],
    run=jb.Run(0.2, sample_rate=100.0),
)
CASES = {
    "one block a mode": CASE,
    "coupled modes": jb.Case(
        CASE.beam,
        supports=[jb.Support(0.7, stiffness=500.0, damping=20.0)],
        sensors=CASE.sensors,
        loads=CASE.loads,
        run=CASE.run,
    ),
    "without inertia": jb.Case(CASE.beam, sensors=CASE.sensors, loads=CASE.loads[1:], run=CASE.run),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_both_ways_give_the_same_run(name, monkeypatch):
    by_matrices = jb.simulate(CASES[name])
    monkeypatch.setattr(step_matrices, "MANY_STATES", 0)
    by_forces = jb.simulate(CASES[name])
    assert by_forces.steps == by_matrices.steps
    for field in ("coordinates", "contact_force", "peak_deflection", "lowest_contact_force"):
        found, expected = getattr(by_forces, field), getattr(by_matrices, field)
        assert_allclose(found, expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max())


def test_many_modes_take_no_matrix_of_all_states(monkeypatch):
    """Chunks of steps are as long as their largest matrices, of rows and states, allow."""
    lengths, chunk_length = [], step_matrices.chunk_length

    def recorded(*arguments):
        lengths.append(chunk_length(*arguments))
        return lengths[-1]

    monkeypatch.setattr("jaxbeam.simulation.integrator.integrate.chunk_length", recorded)
    case = jb.replace(CASES["without inertia"], {"run.duration": 0.001, "run.sample_rate": 1e6})
    jb.simulate(jb.Case(jb.Beam(1.2, 11.68, 0.535, modes=80), loads=case.loads, run=case.run))
    monkeypatch.setattr(step_matrices, "MANY_STATES", 10**9)
    jb.simulate(jb.Case(jb.Beam(1.2, 11.68, 0.535, modes=80), loads=case.loads, run=case.run))
    assert max(lengths) > 5 * min(lengths)


BEAM = jb.Beam(1.2, 12.0, 0.5, damping_ratio=0.02, modes=4)
LOADS = [jb.MovingMass(mass=0.2, speed=3.0)]
COUPLED = jb.Case(BEAM, [jb.Support(0.5)], sensors=[jb.Sensor(0.3)], loads=LOADS, run=jb.Run(0.5))


def with_support(**parts) -> jb.Case:
    return dataclasses.replace(COUPLED, supports=(jb.Support(0.5, **parts),))


@pytest.mark.parametrize(
    ("parts", "coupled"),
    [
        ({}, False),
        ({"stiffness": 4e3}, False),
        ({"stiffness": 4e3, "mass": 0.1, "rotational_stiffness": 2.0}, False),
        ({"damping": 0.0}, False),  # of a rigid support, which does not move
        ({"stiffness": 4e3, "damping": 5.0}, True),
        ({"stiffness": 4e3, "damping": 0.0}, True),  # it has derivatives
    ],
)
def test_dampers_couple_the_modes(parts, coupled):
    assert static_shapes(with_support(**parts)).coupled == coupled


@pytest.mark.parametrize("parts", [{}, {"stiffness": 4e3}])
def test_runs_are_the_same_with_one_block_and_with_many(parts):
    case = with_support(**parts)
    plan = integration_plan(case)
    coupled = dataclasses.replace(plan, shapes=dataclasses.replace(plan.shapes, coupled=True))
    found, expected = (jb.simulate(case, plan=one) for one in (plan, coupled))
    scale = np.abs(expected.deflection).max()
    assert_allclose(found.deflection, expected.deflection, rtol=0, atol=1e-10 * scale)


def test_a_damper_that_is_left_out_has_no_address():
    with pytest.raises(ValueError, match="'supports.0.damping', as it is left out there: give"):
        jb.replace(COUPLED, {"supports.0.damping": 1.0})


def test_a_damper_of_a_rigid_support_is_refused():
    with pytest.raises(ValueError, match=r"supports.0.damping would have no effect.*rigid"):
        jb.simulate(with_support(damping=3.0))
