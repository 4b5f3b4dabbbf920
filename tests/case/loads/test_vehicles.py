"""Kinds of vehicles: matrices, static loads and frequencies against the reference; gradients."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.loads.vehicle_parts import (
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSpring,
)
from jaxbeam.case.loads.vehicles import (
    PlanarVehicle,
    check_vehicle,
    load_vehicle,
)
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, load_case, save_case
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


# General planar vehicles: closed forms, hinges and stiff springs, statics, bad descriptions.


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


# Loads with suspensions and axles in case files: what is read, written and refused.

BEAM = {"length": 25.0, "flexural_rigidity": 4.8e10, "mass_per_length": 18358.0}
TABLES = {
    "oscillator": {"mass": 25000.0, "stiffness": 3.0e6, "damping": 5.0e4, "wheel_mass": 5000.0},
    "quarter-car": {
        "body_mass": 16000.0,
        "axle_mass": 1200.0,
        "suspension_stiffness": 8.0e5,
        "suspension_damping": 2.0e4,
        "tyre_stiffness": 3.5e6,
        "tyre_damping": 1.0e4,
    },
    "half-car": {
        "body_mass": 10000.0,
        "body_inertia": 20000.0,
        "axle_positions": [2.0, -2.0],
        "axle_masses": [1000.0, 1000.0],
        "suspension_stiffness": [1.0e6, 1.0e6],
        "suspension_damping": [1.0e4, 1.0e4],
        "tyre_stiffness": [1.0e6, 1.0e6],
        "tyre_damping": [1.0e4, 1.0e4],
    },
    "wagon": {
        "body_mass": 32000.0,
        "body_inertia": 1.97e6,
        "bogie_mass": 2615.0,
        "bogie_inertia": 1476.0,
        "wheelset_mass": 1813.0,
        "primary_stiffness": 2.4e6,
        "primary_damping": 8.0e3,
        "secondary_stiffness": 8.6e5,
        "secondary_damping": 4.0e4,
        "bogie_distance": 19.0,
        "wheelset_distance": 2.56,
        "count": 4,
        "spacing": 25.0,
    },
    "axles": {"offsets": [0.0, 3.0], "forces": [1e5, 2e5]},
}

AXLES = [name for name, values in TABLES["half-car"].items() if isinstance(values, list)]


def case_with(kind, changes=None, without=()):
    """Case whose only load is the table of a kind, changed."""
    table = {"kind": kind, "speed": 20.0} | TABLES.get(kind, {}) | (changes or {})
    for key in without:
        del table[key]
    return case_from_dict({"beam": BEAM, "loads": [table]})


@pytest.mark.parametrize("kind", TABLES)
def test_case_files_keep_every_number(kind, tmp_path):
    case = case_with(kind, {"start_position": -12.5, "entry_time": 0.25, "deceleration": 0.1})
    check_case(case)
    save_case(case, tmp_path / "case.toml")
    again = load_case(tmp_path / "case.toml")
    assert jax.tree.structure(again) == jax.tree.structure(case)
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(case)))


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("oscillator", {"stiffness": 0.0}, r"loads.0.stiffness must be positive.*kind = \"mass\""),
        ("oscillator", {"mass": -1.0}, "loads.0.mass must be positive; it is -1 kg"),
        ("oscillator", {"wheel_mass": -1.0}, "loads.0.wheel_mass must not be negative"),
        ("oscillator", {"start_position": 3.0}, "loads.0.start_position is 3 m"),
        ("quarter-car", {"tyre_stiffness": 0}, r"tyre_stiffness must be positive.*\"oscillator\""),
        ("quarter-car", {"axle_mass": 0.0}, "loads.0.axle_mass must be positive"),
        (
            "half-car",
            {"tyre_damping": [1.0]},
            "tyre_damping has 1 entry and axle_positions has 2",
        ),
        ("half-car", {"tyre_stiffness": [1e6, 0.0]}, r"tyre_stiffness.1 must be positive: without"),
        (
            "half-car",
            {"axle_positions": [-2.0, 2.0]},
            "axle_positions.1 must be below.*front first",
        ),
        (
            "half-car",
            {name: [2.0, -2.0, -1.0] if name == "axle_positions" else 3 * [1e4] for name in AXLES},
            "axle_positions.2 must be below the entry before it, -2 m; it is -1 m",
        ),
        ("half-car", {"axle_positions": [2.0, 0.5]}, r"axle 1 of loads.0 would carry a negative"),
        ("half-car", {"axle_positions": [2.0]}, "needs two axles or more.*quarter-car"),
        ("wagon", {"spacing": 21.0}, "spacing must exceed the wheelbase of the wagon, 21.56 m"),
        ("wagon", {"secondary_stiffness": 0}, "secondary_stiffness must be positive: nothing"),
        ("wagon", {"wheelset_distance": 20.0}, "must be below the distance between bogie centres"),
        ("wagon", {"count": 0}, "loads.0.count must be a whole number, 1 or more"),
        ("axles", {"offsets": [0.0, 0.0]}, "offsets.1 must be above the entry before it"),
        ("axles", {"offsets": [1.0, 2.0]}, "offsets must begin with 0"),
        ("axles", {"forces": [1e5, -1e5]}, "forces.1 must not be negative"),
        ("axles", {"forces": [1e5] * 3}, "forces has 3 entries and offsets has 2"),
        ("axles", {"train": "HSLM-A1"}, "has both train and offsets; leave one out"),
        ("axles", {"count": 2}, "spacing is missing.*of the 2"),
        ("axles", {"count": 2, "spacing": 2.0}, "must exceed the wheelbase of the axles, 3 m"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(kind, changes, message):
    with pytest.raises(ValueError, match=message):
        check_case(case_with(kind, changes))


def test_what_is_left_out_is_named():
    with pytest.raises(ValueError, match="loads.0.tyre_stiffness is missing; give the spring of"):
        case_with("quarter-car", without=["tyre_stiffness"])
    with pytest.raises(ValueError, match="loads.0.spacing is missing.*of the 4"):
        check_case(case_with("wagon", without=["spacing"]))
    with pytest.raises(ValueError, match="has neither train nor positions; name a train"):
        check_case(case_with("axles", without=["offsets"]))
    with pytest.raises(ValueError, match="has neither forces nor masses"):
        check_case(case_with("axles", without=["forces"]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jb.Oscillator(speed=1.0, mass=2.0), "lacks stiffness, the spring in N/m: give it"),
        (
            lambda: jb.QuarterCar(speed=1.0, body_mass=1.0, axle_mass=1.0, tyre_stiffness=1.0),
            "suspension_stiffness, the spring of the body in N/m; suspension_damping, .*give them",
        ),
        (lambda: jb.Oscillator(2.0), "^Oscillator lacks stiffness"),
        (lambda: jb.MovingMass(mas=1.0), "MovingMass has no mas; did you mean 'mass'?"),
        (lambda: jb.PD(), "PD lacks gains, the"),
    ],
)
def test_arguments_in_python_are_named(make, message):
    with pytest.raises(TypeError, match=message):
        make()


def test_wagons_follow_at_their_spacing():
    load = case_with("wagon").loads[0]
    np.testing.assert_array_equal(load.spacings(), [0.0, 25.0, 50.0, 75.0])


def test_positions_of_axles_are_their_offsets():
    load = case_with("axles", {"positions": [0.0, 3.0]}, without=["offsets"]).loads[0]
    check_case(case_with("axles", {"positions": [0.0, 3.0]}, without=["offsets"]))
    vehicle = load.vehicle(np.float64(9.81))
    np.testing.assert_array_equal(vehicle.offsets, [0.0, 3.0])
    np.testing.assert_array_equal(vehicle.static_loads, [1e5, 2e5])
    np.testing.assert_array_equal(vehicle.wheel_masses, 0.0)


def test_axles_with_a_table_of_times():
    table = {"times": [0.0, 2.0], "positions": [0.0, 30.0]}
    case = case_with("axles", table, without=["speed"])
    check_case(case)
    np.testing.assert_array_equal(case.loads[0].vehicle(np.float64(9.81)).offsets, [0.0, 3.0])
    with pytest.raises(ValueError, match="loads.0.offsets is missing; with a table"):
        check_case(case_with("axles", table, without=["speed", "offsets"]))


def test_masses_of_axles_weigh():
    load = case_with("axles", {"masses": 1e4}, without=["forces"]).loads[0]
    vehicle = load.vehicle(np.float64(9.81))
    np.testing.assert_allclose(vehicle.static_loads, [98100.0, 98100.0])
    np.testing.assert_array_equal(vehicle.wheel_masses, [1e4, 1e4])
    both = case_with("axles", {"masses": [1e3, 2e3]}).loads[0].vehicle(np.float64(9.81))
    np.testing.assert_array_equal(both.static_loads, [1e5, 2e5])
    np.testing.assert_array_equal(both.wheel_masses, [1e3, 2e3])
