"""Kinds of vehicles: matrices, static loads and frequencies against the reference; gradients."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbeam.case.loads.vehicles.cars import Oscillator, QuarterCar
from jaxbeam.case.loads.vehicles.vehicle_parts import VehicleSpring
from tests.case.loads.reference import COORDINATES, LOADS, REFERENCE, coordinate_map
from tests.differences import central

GRAVITY = np.float64(9.81)
TRAJECTORY = (".speed", ".entry_time", ".deceleration")


@pytest.mark.parametrize("name", LOADS)
def test_matrices_are_those_of_the_reference(name):
    vehicle, expected = LOADS[name].vehicle(GRAVITY), REFERENCE[name]
    change = coordinate_map(vehicle.names, COORDINATES[name])
    for key, matrix in zip("MCK", (vehicle.mass, vehicle.damping, vehicle.stiffness), strict=True):
        np.testing.assert_allclose(matrix, change.T @ expected[key] @ change, atol=1e-6)
    np.testing.assert_allclose(vehicle.wheel_map, expected["N"] @ change, atol=1e-12)
    for key, values in {
        "kw": vehicle.contact_stiffness,
        "cw": vehicle.contact_damping,
        "mw": vehicle.wheel_masses,
        "axle_offset_behind_first": vehicle.offsets,
        "P_static": vehicle.static_loads,
    }.items():
        np.testing.assert_allclose(values, expected[key], rtol=1e-12)
    np.testing.assert_allclose(
        vehicle.natural_frequencies(), expected["frequencies_on_rigid_track_Hz"], rtol=4e-7
    )


@pytest.mark.parametrize("name", LOADS)
def test_static_loads_are_the_weight_and_balance_about_the_first_axle(name):
    vehicle = LOADS[name].vehicle(GRAVITY)
    heights = [not one.endswith("pitch") for one in vehicle.names]
    weight = GRAVITY * (np.sum(vehicle.mass[heights][:, heights]) + np.sum(vehicle.wheel_masses))
    assert np.sum(vehicle.static_loads) == pytest.approx(weight, rel=1e-13)


@pytest.mark.parametrize("name", LOADS)
def test_known_and_traced_numbers_give_the_same(name):
    load = LOADS[name]
    known = load.vehicle(GRAVITY)
    traced = eqx.filter_jit(lambda load: load.vehicle(GRAVITY))(load)
    assert not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(known))
    for one, other in zip(jax.tree.leaves(known), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-9 * np.max(np.abs(one)))


def summary(load):
    """All that a vehicle gives, in numbers of order one."""
    vehicle = load.vehicle(GRAVITY)
    parts = [
        vehicle.static_loads / 1e5,
        vehicle.natural_frequencies()[:2],
        vehicle.full_stiffness.ravel() / 1e6,
        vehicle.full_damping.ravel() / 1e4,
        vehicle.mass.ravel() / 1e4,
        vehicle.wheel_map.ravel(),
        vehicle.offsets,
    ]
    return jnp.concatenate(parts)


TRUCK = LOADS["truck of five axles"]
COUPLER = VehicleSpring("tractor", "trailer", -3.0, 2e4, 3e2, 4e4, 5e2)
COUPLED = {"a spring beside the hinge": dataclasses.replace(TRUCK, springs=[COUPLER])}


@pytest.mark.parametrize("name", [*LOADS, *COUPLED])
def test_gradients_by_every_number_match_differences(name):
    paths, structure = jax.tree_util.tree_flatten_with_path((LOADS | COUPLED)[name])
    own = [jax.tree_util.keystr(path[:1]) not in TRAJECTORY for path, _ in paths]
    start = np.concatenate(
        [np.ravel(x) for (_, x), is_own in zip(paths, own, strict=True) if is_own]
    )
    scale = np.where(start == 0, 1.0, start)

    def of_factors(factors):
        values, leaves, used = factors * scale, [], 0
        for (_, leaf), is_own in zip(paths, own, strict=True):
            size = np.size(leaf) if is_own else 0
            leaves.append(values[used : used + size].reshape(np.shape(leaf)) if is_own else leaf)
            used += size
        return summary(jax.tree.unflatten(structure, leaves))

    point = start / scale
    exact = jax.jit(jax.jacfwd(of_factors))(jnp.asarray(point))
    expected = central(lambda p: np.asarray(of_factors(p)), point, step=1e-2)
    np.testing.assert_allclose(exact, expected, atol=1e-8 * np.max(np.abs(expected)))
    assert np.all(np.any(exact != 0, axis=0))


def test_stiff_suspension_moves_with_the_axle():
    """Two masses on one another become one: f = sqrt(k_t/(m_b + m_a))/(2 pi)."""
    car = QuarterCar(9000.0, 1000.0, 1e12, 0.0, 2e6, speed=1.0)
    frequency = car.vehicle(GRAVITY).natural_frequencies()[0]
    assert frequency == pytest.approx(np.sqrt(2e6 / 1e4) / (2 * np.pi), rel=2e-6)


def test_quarter_car_on_a_rigid_tyre_is_an_oscillator():
    car = QuarterCar(9000.0, 1.0, 1e6, 2e4, 1e12, speed=1.0)
    sprung = Oscillator(9000.0, 1e6, 2e4, speed=1.0)
    first, second = car.vehicle(GRAVITY), sprung.vehicle(GRAVITY)
    assert first.natural_frequencies()[0] == pytest.approx(second.natural_frequencies()[0], 1e-6)
