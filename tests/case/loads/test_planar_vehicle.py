"""General planar vehicles: closed forms, hinges and stiff springs, statics, bad descriptions."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxbeam.case.loads.vehicles.vehicle import PlanarVehicle, check_vehicle, load_vehicle
from jaxbeam.case.loads.vehicles.vehicle_parts import (
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSpring,
)
from tests.case.loads.reference import LOADS

GRAVITY = np.float64(9.81)


def axle(body, position, **springs):
    """Axle on a suspension and a tyre, unless springs are given."""
    defaults = {
        "mass": 500.0,
        "suspension_stiffness": 4e5,
        "suspension_damping": 1e4,
        "tyre_stiffness": 1.5e6,
        "tyre_damping": 2e3,
    }
    return VehicleAxle(body, position, **(springs or defaults))


TRACTOR, TRAILER, DOLLY = (
    VehicleBody("tractor", 5000.0, 4000.0, 0.0),
    VehicleBody("trailer", 20000.0, 60000.0, -8.0),
    VehicleBody("dolly", 900.0, 700.0, -14.5),
)
ROAD_TRAIN = PlanarVehicle(
    bodies=[TRACTOR, TRAILER, DOLLY],
    hinges=[VehicleHinge("trailer", "tractor", -2.0), VehicleHinge("dolly", "trailer", -13.0)],
    axles=[
        axle("tractor", 0.5),
        axle("tractor", -2.5),
        axle("trailer", -10.0),
        axle("dolly", -15.0, tyre_stiffness=2e6),
    ],
)


def test_body_on_two_tyres_has_the_frequencies_of_the_closed_form():
    """f = sqrt(2 k/m)/(2 pi) of bounce, sqrt(2 k a^2/I)/(2 pi) of pitch."""
    vehicle = PlanarVehicle(
        bodies=[VehicleBody("cart", 800.0, 500.0, 3.0)],
        axles=[axle("cart", 4.5, tyre_stiffness=2e5), axle("cart", 1.5, tyre_stiffness=2e5)],
    )
    check_vehicle(vehicle)
    model = vehicle.model(GRAVITY)
    expected = np.sqrt([4e5 / 800, 4e5 * 1.5**2 / 500]) / (2 * np.pi)
    np.testing.assert_allclose(model.natural_frequencies(), expected, rtol=1e-12)
    np.testing.assert_allclose(model.static_loads, 400 * GRAVITY, rtol=1e-12)
    assert model.names == ("cart", "cart pitch")


def test_lever_gives_the_static_loads_of_a_body_on_two_axles():
    """Moments about an axle: P_2 = m g (x_1 - x_c)/(x_1 - x_2), plus the axles' own weight."""
    vehicle = PlanarVehicle(
        bodies=[VehicleBody("body", 9000.0, 20000.0, 0.7)],
        axles=[axle("body", 3), axle("body", -1)],
    )
    weight = 9000 * GRAVITY
    expected = [weight * 1.7 / 4 + 500 * GRAVITY, weight * 2.3 / 4 + 500 * GRAVITY]
    np.testing.assert_allclose(vehicle.model(GRAVITY).static_loads, expected, rtol=1e-12)


def test_hinges_are_the_limit_of_stiff_springs():
    check_vehicle(ROAD_TRAIN)
    hinged = ROAD_TRAIN.model(GRAVITY)
    springs = [VehicleSpring(h.first, h.second, h.position, 1e11) for h in ROAD_TRAIN.hinges]
    sprung = dataclasses.replace(ROAD_TRAIN, hinges=(), springs=springs).model(GRAVITY)
    assert len(sprung.names) == len(hinged.names) + 2 == 9
    assert hinged.names[:4] == ("tractor", "tractor pitch", "trailer pitch", "dolly pitch")
    np.testing.assert_allclose(sprung.static_loads, hinged.static_loads, rtol=1e-9)
    np.testing.assert_allclose(
        sprung.natural_frequencies()[:-2], hinged.natural_frequencies(), rtol=1e-4
    )
    assert np.all(sprung.natural_frequencies()[-2:] > 100)


def test_order_and_origin_do_not_matter():
    moved = jax.tree.map(lambda x: x, ROAD_TRAIN)
    shift = 100.0
    moved = dataclasses.replace(
        ROAD_TRAIN,
        bodies=[
            dataclasses.replace(b, position=b.position + shift) for b in (DOLLY, TRAILER, TRACTOR)
        ],
        hinges=[
            dataclasses.replace(h, position=h.position + shift) for h in ROAD_TRAIN.hinges[::-1]
        ],
        axles=[dataclasses.replace(a, position=a.position + shift) for a in ROAD_TRAIN.axles],
    )
    check_vehicle(moved)
    one, other = ROAD_TRAIN.model(GRAVITY), moved.model(GRAVITY)
    np.testing.assert_allclose(one.static_loads, other.static_loads, rtol=1e-9)
    np.testing.assert_allclose(one.natural_frequencies(), other.natural_frequencies(), rtol=1e-9)
    assert np.sum(one.static_loads) == pytest.approx((25900 + 1500) * GRAVITY, rel=1e-12)


def test_hinge_carries_the_trailer_on_the_tractor():
    """Moments about the hinge: an axle at -10 m carries 6/8 of a trailer with its mass at -8 m."""
    vehicle = dataclasses.replace(
        ROAD_TRAIN,
        bodies=[TRACTOR, TRAILER],
        hinges=ROAD_TRAIN.hinges[:1],
        axles=ROAD_TRAIN.axles[:3],
    )
    loads = vehicle.model(GRAVITY).static_loads
    assert loads[2] == pytest.approx((20000 * 6 / 8 + 500) * GRAVITY, rel=1e-9)


def test_rotational_spring_and_damper_act_between_pitches():
    spring = VehicleSpring(
        "tractor", "trailer", 0.0, rotational_stiffness=7e4, rotational_damping=3e2
    )
    stiffer = dataclasses.replace(ROAD_TRAIN, springs=[spring])
    change = stiffer.model(GRAVITY).stiffness - ROAD_TRAIN.model(GRAVITY).stiffness
    pitches = np.zeros(len(change))
    pitches[1:3] = [1.0, -1.0]
    np.testing.assert_allclose(change, 7e4 * np.outer(pitches, pitches), atol=1e-6)
    change = stiffer.model(GRAVITY).damping - ROAD_TRAIN.model(GRAVITY).damping
    np.testing.assert_allclose(change, 3e2 * np.outer(pitches, pitches), atol=1e-8)


def test_wagon_of_a_file_is_the_wagon():
    of_file, load = load_vehicle("manchester-wagon").model(GRAVITY), LOADS["wagon"]
    for one, other in zip(
        jax.tree.leaves(of_file), jax.tree.leaves(load.vehicle(GRAVITY)), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)
    assert of_file.names == load.vehicle(GRAVITY).names


def with_axle(i, **changes):
    """The road train with another axle."""
    axles = list(ROAD_TRAIN.axles)
    axles[i] = dataclasses.replace(axles[i], **changes)
    return dataclasses.replace(ROAD_TRAIN, axles=axles)


HINGE = VehicleHinge("dolly", "tractor", -3.0)
WRONG = {
    "bodies is missing; a vehicle needs bodies on axles": {"bodies": ()},
    "axles is missing": {"axles": ()},
    "bodies has 2 bodies of the name 'tractor'": {"bodies": [TRACTOR, TRACTOR, TRAILER, DOLLY]},
    "bodies.0.name cannot be 'pitch', which reads": {"bodies": [VehicleBody("pitch", 1.0)]},
    "hinges.0.first cannot be 'traler', which is no body; did you mean 'trailer'": {
        "hinges": [VehicleHinge("traler", "tractor", 0.0)]
    },
    "springs.0 joins 'dolly' to itself": {"springs": [VehicleSpring("dolly", "dolly", 0.0)]},
    "hinges.2 closes a ring of hinged bodies": {"hinges": [*ROAD_TRAIN.hinges, HINGE]},
    "static equilibrium: its springs hold 'dolly": {"hinges": ROAD_TRAIN.hinges[:1]},
    "bodies.0.mass must be positive": {"bodies": [dataclasses.replace(TRACTOR, mass=-1.0)]},
    "bodies.0 holds 3.0; it takes a table": {"bodies": [3.0]},
}
WRONG_AXLES = {
    "axles.2.body cannot be 'van'": (2, {"body": "van"}),
    "axles.2.position must be below that of the axle before it": (2, {"position": -1.0}),
    "axles.1 has neither suspension_stiffness nor tyre_stiffness": (
        1,
        {"suspension_stiffness": None, "tyre_stiffness": None},
    ),
    "axles.1.mass must be positive between": (1, {"mass": 0.0}),
    "axles.1.mass belongs to 'tractor'": (1, {"suspension_stiffness": None}),
    "axles.1.tyre_damping would have no effect": (1, {"tyre_stiffness": None}),
    "axle 1 of the vehicle would carry a negative static load": (1, {"position": -0.9}),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_descriptions_are_refused(message):
    with pytest.raises(ValueError, match=message):
        check_vehicle(dataclasses.replace(ROAD_TRAIN, **WRONG[message]))


@pytest.mark.parametrize("message", WRONG_AXLES)
def test_wrong_axles_are_refused(message):
    i, changes = WRONG_AXLES[message]
    with pytest.raises(ValueError, match=message):
        check_vehicle(with_axle(i, **changes))
