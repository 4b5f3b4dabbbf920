"""Steps of vehicles against scipy: exact under polynomial motions of the surface."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.model.load_set import load_set
from jaxbeam.simulation.integrator.discrete_model import GAUSS_NODES, NODE_COUNT
from jaxbeam.simulation.integrator.vehicles import (
    VehicleStep,
    springs_of_wheels,
    vehicle_propagators,
    vehicle_state_norm,
    vehicles_of,
)
from tests.case.loads import reference

BEAM = jb.Beam(20.0, 2e10, 1.2e4, modes=2)
VEHICLES = {
    "quarter-car": reference.quarter_car(reference.REFERENCE["quarter-car"]["input"]),
    "half-car": reference.half_car(reference.REFERENCE["half-car"]["input"]),
    "two wagons": reference.wagon(reference.REFERENCE["wagon"]["input"], count=2, spacing=25.0),
}
LENGTHS = np.array([0.02, 3e-3])


@pytest.mark.parametrize("name", VEHICLES)
def test_steps_of_no_length_have_the_derivative_of_short_ones(name):
    """Wheels that enter at one time may part."""
    group = load_set(jb.Case(BEAM, loads=[VEHICLES[name]])).wheels.vehicles[0]

    def at(length):
        return vehicle_propagators(group, length)

    step, none = 1e-8, np.zeros(1)
    value, found = jax.jvp(at, (none,), (np.ones(1),))
    after, before = at(step + none), at(none)
    for part, slope, later, start in zip(
        *map(jax.tree.leaves, (value, found, after, before)), strict=True
    ):
        assert_allclose(part, start, atol=1e-15)
        expected = (later - start) / step
        size = np.abs(expected).max()
        assert_allclose(slope, expected, rtol=1e-5, atol=2e-5 * size)


@pytest.mark.parametrize("name", VEHICLES)
def test_a_step_is_that_of_scipy(name):
    """Heights of the surface and their rates are polynomials, which the nodes determine."""
    loads = load_set(jb.Case(BEAM, loads=[VEHICLES[name]]))
    group = loads.wheels.vehicles[0]
    generator = np.random.default_rng(3)
    wheels = loads.wheel_count
    coefficients = 1e5 * generator.standard_normal((NODE_COUNT, wheels))
    states = 1e-2 * generator.standard_normal((group.count, group.A.shape[0], 1))
    propagators = vehicle_propagators(group, LENGTHS)
    A, B, H = group.A[..., 0], group.B[..., 0], group.H[..., 0]

    def surface(share):
        return np.sum(coefficients * share ** np.arange(NODE_COUNT)[:, None], axis=0)

    for i, length in enumerate(LENGTHS):
        part = jax.tree.map(lambda matrix, i=i: matrix[i], propagators)
        at_nodes = np.array([surface(share) for share in GAUSS_NODES]).T[..., None]
        own, columns = at_nodes.reshape(group.count, -1, 1), states
        forces = part.spring_surface[..., 0] @ own - part.spring_states[..., 0] @ columns
        forces = forces.reshape(-1, NODE_COUNT, 1)
        after = (part.transition[..., 0] @ columns + part.input[..., 0] @ own)[..., 0]
        for vehicle in range(group.count):
            own = slice(
                vehicle * group.wheels_per_vehicle, (vehicle + 1) * group.wheels_per_vehicle
            )
            solution = solve_ivp(
                lambda t, z, own=own, length=length: A @ z + B @ surface(t / length)[own],
                (0.0, length),
                states[vehicle, :, 0],
                method="DOP853",
                t_eval=[*(length * GAUSS_NODES), length],
                rtol=1e-12,
                atol=1e-14,
            )
            scale = np.max(np.abs(solution.y))
            assert_allclose(after[vehicle], solution.y[:, -1], rtol=0, atol=1e-9 * scale)
            expected = at_nodes[own, :, 0] - H @ solution.y[:, :-1]
            scale = np.max(np.abs(expected))
            assert_allclose(forces[own, :, 0], expected, rtol=0, atol=1e-9 * scale)


def test_springs_couple_the_wheels_of_one_vehicle_only():
    loads = load_set(jb.Case(BEAM, loads=[*VEHICLES.values(), jb.MovingMass(1.0, speed=1.0)]))
    vehicles = vehicles_of(loads, LENGTHS)
    parts = [jax.tree.map(lambda matrix: matrix[0], part) for part in vehicles.propagators]
    # Of the half-car, quarter car, second wagon, half-car, first wagon; the mass.
    wheels = np.array([[1, 0, 8, 2, 6, 11]])
    step = VehicleStep(np.zeros(1, int), wheels, np.ones((1, 6), bool), None)
    coupling = springs_of_wheels(vehicles, step, 1)[0][0, 0]
    blocks = coupling.reshape(6, NODE_COUNT, 6, NODE_COUNT)
    coupled = np.any(blocks != 0, axis=(1, 3))
    # The mass, which is the last, has no springs.
    expected = np.diag([True, True, True, True, True, False])
    expected[0, 3] = expected[3, 0] = True
    assert np.array_equal(coupled, expected)
    whole = parts[1].spring_surface[..., 0].reshape(2, NODE_COUNT, 2, NODE_COUNT)
    assert_allclose(blocks[3, :, 0], whole[1, :, 0])
    assert_allclose(blocks[0, :, 3], whole[0, :, 1])


def test_norms_limit_the_step():
    stiff = jb.Oscillator(1e3, 1e9, 1e4, speed=1.0)
    soft, hard = (
        float(vehicle_state_norm(load_set(jb.Case(BEAM, loads=[load]))))
        for load in (VEHICLES["quarter-car"], stiff)
    )
    assert 0 < soft < hard
    assert hard >= np.sqrt(1e9 / 1e3)
    assert vehicle_state_norm(load_set(jb.Case(BEAM))) == 0
