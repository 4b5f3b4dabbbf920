"""Counts of what a case has are limited, and a case beyond a limit is refused at once."""

import time

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

import jaxbeam as jb
from jaxbeam.case.case import part_classes
from jaxbeam.case.limits import MAX_COUNTS, MAX_ENTRIES, MAX_WHEELS
from jaxbeam.case.trajectory import NEVER, BrakingTrajectory, TabulatedTrajectory
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.files.json_schema import table_classes, table_keys, tables
from jaxbeam.model.load_set import LoadSet, WheelSet

BEAM = {"length": 20.0, "flexural_rigidity": 1e10, "mass_per_length": 12e3}
CONVOY = {"kind": "vehicle", "model": "half-truck", "speed": 1.0, "count": 10**9}


def test_200_000_sensors_are_refused_at_once():
    start = time.process_time()
    with pytest.raises(ValueError, match="sensors has 200000 entries; 10000 are the most"):
        case_from_dict({"beam": BEAM, "sensors": [{"position": 1.0}] * 200_000})
    case = jb.Case(jb.Beam(**BEAM), sensors=[jb.Sensor(1.0)] * 200_000, run=jb.Run(1.0))
    with pytest.raises(ValueError, match="sensors has 200000 entries"):
        check_case(case)
    assert time.process_time() - start < 5.0


@pytest.mark.parametrize("key", [k for k, found in part_classes().items() if found.listed])
def test_all_lists_of_a_case_are_limited(key):
    with pytest.raises(ValueError, match=f"^{key} has .* entries; {MAX_COUNTS[key]} are the most"):
        case_from_dict({"beam": BEAM, key: [{}] * (MAX_COUNTS[key] + 1)})


def test_lists_of_parts_and_counts_are_declared():
    """Every list of parts in a part has a limit, and every whole number but seeds and indices."""
    free = {"seed", "load", "vehicle", "absorber"}
    for part_class, _ in tables().values():
        for each in table_classes(part_class).values():
            for key in table_keys(each):
                if key.listed or (key.is_count and key.name not in free):
                    assert key.name in MAX_COUNTS, f"{each.__name__}.{key.name}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"beam": BEAM | {"modes": 1001}}, "beam.modes must not exceed 1000; it is 1001"),
        (
            {"beam": BEAM | {"segments": [{}] * 2001}},
            "beam.segments has 2001 entries; 2000 are the most",
        ),
        (
            {
                "beam": BEAM,
                "loads": [{"kind": "vehicle", "model": "half-truck", "speed": 1.0, "count": 10**9}],
            },
            "loads.0.count must not exceed 2000; it is 1000000000",
        ),
        (
            {
                "beam": BEAM,
                "profile": {
                    "kind": "table",
                    "positions": [0.0] * (MAX_ENTRIES + 1),
                    "heights": [0.0, 1.0],
                },
            },
            f"profile.positions has {MAX_ENTRIES + 1} numbers; {MAX_ENTRIES} are the most",
        ),
    ],
)
def test_limits_within_parts(content, message):
    with pytest.raises(ValueError, match=message):
        check_case(case_from_dict(content))


def test_all_wheels_together_are_limited():
    axles = jb.Axles(
        offsets=np.arange(100.0), forces=np.ones(100), speed=20.0, count=300, spacing=200.0
    )
    case = jb.Case(jb.Beam(**BEAM), sensors=[jb.Sensor(10.0)], loads=[axles], run=jb.Run(1.0))
    with pytest.raises(ValueError, match=f"loads have 30000 wheels in all; {MAX_WHEELS} are"):
        check_case(case)


def test_samples_of_all_sensors_are_limited():
    case = jb.Case(
        jb.Beam(**BEAM), sensors=[jb.Sensor(10.0)] * 1000, run=jb.Run(1e4, sample_rate=1e3)
    )
    named = [jb.Sensor(10.0, name=str(i)) for i in range(1000)]
    case = jb.Case(case.beam, sensors=named, run=case.run, loads=[jb.MovingForce(1.0, speed=1.0)])
    with pytest.raises(ValueError, match="1e\\+07 samples of 1000 sensors, more than 4e\\+06"):
        jb.simulate(case)


# Trajectories of loads: kinematics against their cubics, splines against scipy.

LENGTH = jnp.asarray(2.0)
TIMES = np.array([0.0, 0.3, 0.7, 0.8, 1.5])
POSITIONS = np.array([-0.2, 0.4, 0.9, 0.7, 2.1])  # the load turns round twice


def kinematics_of_cubics(trajectory, times):
    """Position, speed and acceleration from the cubics of a trajectory."""
    breakpoints, cubics = (np.asarray(part) for part in trajectory.cubics())
    piece = np.clip(np.searchsorted(breakpoints, times, side="right") - 1, 0, None)
    curves = [np.polynomial.Polynomial(cubics[i]) for i in piece]
    elapsed = times - breakpoints[piece]
    return np.array(
        [[curve.deriv(d)(t) for curve, t in zip(curves, elapsed, strict=True)] for d in range(3)]
    )


def assert_cubics_agree(trajectory, times):
    expected = trajectory.kinematics(jnp.asarray(times))
    assert_allclose(kinematics_of_cubics(trajectory, times), expected, atol=1e-12)


@given(
    speed=st.floats(0.2, 20.0),
    direction=st.sampled_from([-1.0, 1.0]),
    entry=st.floats(-1.0, 3.0),
    braking=st.floats(-5.0, 50.0),
)
def test_cubics_of_a_braking_trajectory(speed, direction, entry, braking):
    """Loads that stop on the beam, that cross it, and that accelerate."""
    numbers = (jnp.asarray(x) for x in (direction * speed, entry, braking))
    trajectory = BrakingTrajectory(*numbers, LENGTH)
    exit_time = float(trajectory.entry_exit_times()[1])
    times = entry + np.linspace(0.0, min(exit_time - entry, 5.0), 23)[1:-1]
    assert_cubics_agree(trajectory, times)


@pytest.mark.parametrize("points", [2, 3, 5])
def test_cubics_of_a_table_are_those_of_a_spline(points):
    breakpoints, positions = TIMES[:points], POSITIONS[:points]
    trajectory = TabulatedTrajectory(jnp.asarray(breakpoints), jnp.asarray(positions), LENGTH)
    times = np.linspace(breakpoints[0], breakpoints[-1], 40)[1:-1]
    assert_cubics_agree(trajectory, times)
    spline = CubicSpline(breakpoints, positions)  # not-a-knot; of few points a parabola or a line
    expected = [spline(times, d) for d in range(3)]
    assert_allclose(kinematics_of_cubics(trajectory, times), expected, atol=1e-11)
    assert_cubics_agree(trajectory, np.array([breakpoints[-1] + 0.5]))  # where the load stays


@pytest.mark.parametrize("left", [False, True])
def test_a_table_that_ends_at_the_end_of_the_beam_leaves_it_then(left):
    """A wheel behind the first is on the beam still, and stays there."""
    positions = 2.0 * np.array([0.1, 0.4, 1.0])
    positions = 2.0 - positions if left else positions
    path = TabulatedTrajectory(np.array([0.2, 0.5, 1.1]), positions, LENGTH)
    entry, leave = path.entry_exit_times(np.array([0.0, 0.1]))
    assert_allclose(entry, 0.2)
    assert_allclose(leave, [1.1, NEVER])


def test_cubics_of_a_load_set_are_padded_to_the_same_number():
    trajectories = (
        BrakingTrajectory(jnp.asarray(1.0), jnp.asarray(0.2), jnp.asarray(0.5), LENGTH),
        TabulatedTrajectory(jnp.asarray(TIMES), jnp.asarray(POSITIONS), LENGTH),
    )
    zeros = jnp.zeros((2, 1))
    wheels = WheelSet(zeros, zeros)
    breakpoints, cubics = LoadSet(trajectories, wheels, (np.zeros(1),) * 2).cubics()
    assert breakpoints.shape == (2, 5) and cubics.shape == (2, 5, 4)
    assert_allclose(breakpoints[0], [0.2, 2.2, np.inf, np.inf, np.inf])
    assert_allclose(cubics[1], trajectories[1].cubics()[1])
    none = LoadSet((), WheelSet(zeros[:0], zeros[:0]), ()).cubics()
    assert [part.shape for part in none] == [(0, 1), (0, 1, 4)]
