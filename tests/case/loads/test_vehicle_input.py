"""Loads with suspensions and axles in case files: what is read, written and refused."""

import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, load_case, save_case

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
            "tyre_damping has 1 entries and axle_positions has 2",
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


def test_axles_beside_a_table_of_times():
    table = {"times": [0.0, 2.0], "positions": [0.0, 30.0]}
    case = case_with("axles", table, without=["speed"])
    check_case(case)
    np.testing.assert_array_equal(case.loads[0].vehicle(np.float64(9.81)).offsets, [0.0, 3.0])
    with pytest.raises(ValueError, match="loads.0.offsets is missing; beside a table"):
        check_case(case_with("axles", table, without=["speed", "offsets"]))


def test_masses_of_axles_weigh():
    load = case_with("axles", {"masses": 1e4}, without=["forces"]).loads[0]
    vehicle = load.vehicle(np.float64(9.81))
    np.testing.assert_allclose(vehicle.static_loads, [98100.0, 98100.0])
    np.testing.assert_array_equal(vehicle.wheel_masses, [1e4, 1e4])
    both = case_with("axles", {"masses": [1e3, 2e3]}).loads[0].vehicle(np.float64(9.81))
    np.testing.assert_array_equal(both.static_loads, [1e5, 2e5])
    np.testing.assert_array_equal(both.wheel_masses, [1e3, 2e3])
