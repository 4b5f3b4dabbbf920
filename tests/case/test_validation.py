"""Validation of cases: errors name the address and the remedy, before anything compiles."""

import dataclasses
import inspect
import re
import time
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

import jaxbeam as jb
from jaxbeam.case.actuators.base import Patch, PointForce, Shaker, SpringDamper
from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support
from jaxbeam.case.case import (
    Case,
    Run,
    own_addresses,
    part_classes,
    replace,
    unit_at,
    value_at,
)
from jaxbeam.case.loads.base import MovingForce, MovingMass
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.toml_file import MAX_COUNTS, MAX_ENTRIES, MAX_WHEELS
from jaxbeam.case.trajectory import NEVER, BrakingTrajectory, TabulatedTrajectory
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedback import Feedback
from jaxbeam.files.case_file import case_from_dict, with_settings
from jaxbeam.files.json_schema import table_classes, table_keys, tables
from jaxbeam.model.load_set import LoadSet, WheelSet
from tests.differences import central
from tests.strategies import cases

SECTION = {"length": 0.6, "flexural_rigidity": 11.68, "mass_per_length": 0.535}
BEAM = Beam(**SECTION, damping_ratio=[0.03, 0.02, 0.01])
CASE = Case(
    BEAM,
    supports=[Support(0.3), Support(0.5, 2e6)],
    actuators=[
        Shaker(position=0.5, limits=[-10, 10]),
        Patch(start=0.2, end=0.3, moment_per_volt=1e-3),
        PointForce(position=0.1),
        Electrodynamic(position=0.5, resistance=0.82, inductance=5e-5, force_constant=4.2),
    ],
    sensors=[Sensor(0.25), Sensor(0.25, "strain", fibre_distance=0.002)],
    loads=[
        MovingMass(0.5, 0.55),
        MovingForce(force=2.0, times=[0.0, 1.0, 2.0], positions=[0.0, 0.4, 0.6]),
    ],
    run=Run(2.0),
)


@given(cases())
def test_valid_cases_pass(case):
    check_case(case)


def test_example_case_passes():
    check_case(CASE)


@pytest.mark.parametrize("left", END_CONDITIONS)
@pytest.mark.parametrize("right", END_CONDITIONS)
def test_all_end_conditions_pass(left, right):
    check_case(Case(Beam(**SECTION, ends=f"{left}-{right}")))


# Address, its new value, and a part of the error message.
NUMBERS = [
    ("beam.length", 0.0, "beam.length must be positive; it is 0 m"),
    ("beam.length", jnp.nan, "beam.length must be a finite number; it is nan"),
    ("beam.flexural_rigidity", -1.0, "beam.flexural_rigidity must be positive; it is -1 N m^2"),
    ("beam.mass_per_length", jnp.inf, "beam.mass_per_length must be a finite number; it is inf"),
    ("beam.damping_ratio.1", -0.1, "beam.damping_ratio.1 must not be negative; it is -0.1"),
    ("supports.0.position", 0.7, "supports.0.position must lie on the beam, between 0 and 0.6 m"),
    ("supports.1.stiffness", -1.0, "supports.1.stiffness must not be negative; it is -1 N/m"),
    ("actuators.0.position", -0.1, "actuators.0.position must lie on the beam"),
    ("actuators.0.bandwidth", 0.0, "actuators.0.bandwidth must be positive; it is 0 1/s"),
    ("actuators.0.limits", [10.0, -10.0], "actuators.0.limits.1 must be above the entry before"),
    ("actuators.0.limits", [1e99, -1e99], "actuators.0.limits.1 must be above the entry before"),
    ("actuators.1.end", 0.2, "actuators.1.end must lie to the right of actuators.1.start; 0.2 m"),
    ("actuators.1.end", 0.65, "actuators.1.end must lie on the beam"),
    ("actuators.1.amplifier_gain", 0.0, "actuators.1.amplifier_gain must be positive; it is 0"),
    ("actuators.1.amplifier_gain", 5e-324, "must be at least 1e-100; it is"),
    ("loads.0.mass", 1e101, "loads.0.mass must be at most 1e+100 kg; it is 1e+101 kg"),
    ("actuators.1.depolarisation", [1500.0, -500.0], "depolarisation.1 must be above the entry"),
    ("actuators.3.resistance", 0.0, "actuators.3.resistance must be positive; it is 0 ohm"),
    ("actuators.3.inductance", -1e-5, "actuators.3.inductance must be positive; it is -1e-05 H"),
    ("actuators.3.mass", -0.02, "actuators.3.mass must not be negative; it is -0.02 kg"),
    ("actuators.3.force_constant", jnp.nan, "actuators.3.force_constant must be a finite number"),
    ("sensors.1.position", 0.61, "sensors.1.position must lie on the beam, between 0 and 0.6 m;"),
    ("loads.0.mass", -0.5, "loads.0.mass must not be negative; it is -0.5 kg"),
    ("loads.0.speed", 0.0, "loads.0.speed must not be 0: the load would never enter"),
    ("loads.0.entry_time", jnp.nan, "loads.0.entry_time must be a finite number; it is nan"),
    ("loads.1.times.2", 1.0, "loads.1.times.2 must be above the entry before it; 1 s follows 1 s"),
    ("loads.1.positions.0", jnp.nan, "loads.1.positions.0 must be a finite number; it is nan"),
    ("loads.1.entry_time", 1.0, "loads.1.entry_time would have no effect"),
    ("run.duration", 0.0, "run.duration must be positive; it is 0 s"),
    ("run.sample_rate", -1.0, "run.sample_rate must be positive; it is -1 Hz"),
]


@pytest.mark.parametrize(("address", "value", "message"), NUMBERS)
def test_invalid_numbers_are_refused(address, value, message):
    assert_refused(replace(CASE, {address: value}), message)


# Inconsistent cases, and a part of the error message.
TABLE = {"times": [0.0, 1.0], "positions": [0.0, 0.6]}
CASES = [
    (Case(Beam(length=1.0)), "beam.flexural_rigidity is missing; give it, or all of width, height"),
    (Case(Beam(1.0, 1.0)), "beam.mass_per_length is missing; give it, or all of width"),
    (
        Case(Beam(1.0, width=1.0, youngs_modulus=1.0, density=1.0)),
        "(of which height is missing)",
    ),
    (
        Case(Beam(**SECTION, youngs_modulus=2e11)),
        "beam.flexural_rigidity and beam.youngs_modulus contradict each other; leave one out",
    ),
    (Case(Beam(**SECTION, density=7850.0)), "beam.mass_per_length and beam.density contradict"),
    (Case(Beam(**SECTION, height=0.01)), "beam.height would have no effect: leave it out"),
    (
        Case(Beam(**SECTION, damping_ratio=[0.1, 0.1])),
        "lists 2 values for 3 modes; give one for each",
    ),
    (
        Case(Beam(**SECTION, damping_ratio=0.1, rayleigh_damping=[0.1, 0.0])),
        "beam has both damping_ratio and rayleigh_damping; leave one out",
    ),
    (Case(Beam(**SECTION, modes=0)), "beam.modes must be a whole number, 1 or more; it is 0"),
    (
        Case(Beam(**SECTION, ends="pinned-fixed")),
        "no end is called 'fixed'; it may be pinned, clamped",
    ),
    (
        Case(Beam(**SECTION, ends="clampd-free")),
        "no end is called 'clampd'; did you mean 'clamped'?",
    ),
    (Case(Beam(**SECTION, ends="pinned")), "must name the left and the right end, such as"),
    (
        Case(BEAM, [Support(0.2), Support(0.4, 10.0), Support(0.4), Support(0.2)]),
        "supports.0 and supports.3 both hold the beam rigidly at 0.2 m; remove one",
    ),
    (
        Case(BEAM, actuators=[Patch(0.2, 0.3)]),
        "actuators.0.moment_per_volt is missing; give it, or all of d33, modulus,",
    ),
    (
        Case(BEAM, actuators=[Patch(0.2, 0.3, d33=460e-12, modulus=30e9)]),
        "(of which electrode_spacing, beam_height, patch_height, patch_width are missing)",
    ),
    (
        Case(BEAM, actuators=[Patch(0.2, 0.3, 1e-3, d33=460e-12)]),
        "actuators.0.moment_per_volt and actuators.0.d33 contradict each other; leave one out",
    ),
    (
        Case(BEAM, actuators=[Patch(0.2, 0.3, 1e-3, amplifier_gain=200.0, limits=[7.5, 10.0])]),
        "actuators.0.limits leave no command that the patch takes: its depolarisation limits over"
        " its amplifier_gain allow -2.5 to 7.5 V",
    ),
    (Case(BEAM, sensors=[Sensor(0.2, "strain")]), "sensors.0.fibre_distance is missing: strain"),
    (
        Case(BEAM, sensors=[Sensor(0.2, fibre_distance=0.1)]),
        "sensors.0.fibre_distance would have no effect on a sensor of deflection",
    ),
    (Case(BEAM, sensors=[Sensor(0.2, "torsion")]), "sensors.0.quantity cannot be 'torsion'; it ma"),
    (Case(BEAM, sensors=[Sensor(0.2, "stress")]), "sensors.0.section_modulus is missing: stress"),
    (
        Case(BEAM, sensors=[Sensor(0.2, "stress", section_modulus=0.0)]),
        "sensors.0.section_modulus must not be zero",
    ),
    (
        Case(BEAM, sensors=[Sensor(0.2, section_modulus=1e-3)]),
        "sensors.0.section_modulus would have no effect on a sensor of deflection",
    ),
    (
        Case(BEAM, sensors=[Sensor(0.2, name="a"), Sensor(0.3), Sensor(0.1, name="a")]),
        "sensors.0 and sensors.2 are both called 'a' in results; give sensors.2 another name",
    ),
    (
        Case(
            BEAM,
            actuators=[Patch(0.1, 0.3, 1e-3)],
            sensors=[Sensor(0.2, "moment")],
            controller=Feedback(gains=[1.0]),
        ),
        "sensors.0 reads the moment of a section on which actuators.0 acts, which no controller",
    ),
    (Case(BEAM, loads=[MovingMass(1.0)]), "loads.0 has neither speed nor times; give one of them"),
    (Case(BEAM, loads=[MovingMass(1.0, 1.0, **TABLE)]), "loads.0 has both speed and times"),
    (Case(BEAM, loads=[MovingMass(1.0, times=[0.0, 1.0])]), "loads.0.positions is missing"),
    (Case(BEAM, loads=[MovingMass(1.0, positions=[0.0, 1.0])]), "loads.0.times is missing"),
    (Case(BEAM, loads=[MovingForce(speed=1.0)]), "loads.0 has neither force nor mass; give one"),
    (
        Case(BEAM, loads=[MovingForce(mass=1.0, force=1.0, speed=1.0)]),
        "loads.0 has both force and mass; leave one out",
    ),
    (
        Case(BEAM, loads=[MovingMass(1.0, times=[0.0, 1.0, 2.0], positions=[0.0, 1.0])]),
        "loads.0 has 3 times and 2 positions; a table needs one position for each time",
    ),
    (
        Case(BEAM, loads=[MovingMass(1.0, times=[0.0], positions=[0.0])]),
        "loads.0.times needs at least two points; it has 1",
    ),
    (
        Case(BEAM, sensors=[Support(0.2)]),
        "sensors.0 holds a Support; it takes objects of type Sensor",
    ),
    (
        Case(BEAM, loads=[Shaker(0.2)]),
        "loads.0 holds a Shaker; it takes objects of type AbstractLoad",
    ),
    (
        Case(BEAM, absorbers=[jb.Absorber]),
        "absorbers.0 holds the class Absorber; it takes objects of type Absorber",
    ),
]


@pytest.mark.parametrize(("case", "message"), CASES)
def test_contradictions_are_refused(case, message):
    assert_refused(case, message)


@pytest.mark.parametrize("key", [key for key, of in part_classes().items() if not of.listed])
def test_one_part_of_another_class_is_refused(key):
    """By every function of a case, before it reads anything of the part."""
    for wrong, what in (("x", "'x'"), (3.0, "3.0"), (jb.Absorber(0.1), "an Absorber")):
        case = eqx.tree_at(
            lambda c: getattr(c, key), CASE, wrong, is_leaf=lambda part: part is None
        )
        for function in (jb.simulate, jb.Simulator, jb.modes):
            with pytest.raises(ValueError, match=f"^{key} holds {what}; it takes objects of type"):
                function(case)


@pytest.mark.parametrize("key", [key for key, of in part_classes().items() if of.listed])
def test_parts_that_are_no_list_are_refused(key):
    unchecked = inspect.unwrap(Case.__init__)  # types of arguments are checked in tests alone
    for wrong, what in ((jb.Absorber(0.1), "an Absorber"), (jb.Absorber, "the class Absorber")):
        with pytest.raises(ValueError, match=f"^{key} takes a list of parts, not {what}$"):
            unchecked(types.SimpleNamespace(), BEAM, **{key: wrong})


def test_wrong_shapes_and_types_are_refused():
    """Constructors do not check shapes outside of tests; `tree_at` goes past them here."""
    lengths = eqx.tree_at(lambda c: c.beam.length, CASE, jnp.ones(2))
    assert_refused(lengths, "beam.length must be one number, not an array of shape (2,)")
    nothing = eqx.tree_at(lambda c: c.beam.length, CASE, None)
    assert_refused(nothing, "beam.length is missing; give the total length in m")
    word = eqx.tree_at(lambda c: c.loads[0].mass, CASE, "heavy")
    assert_refused(word, "loads.0.mass must be one number, not 'heavy'")
    for value, what in ((np.array(1j), "an array of complex128"), (jnp.array(1j), "an array of")):
        complex_mass = eqx.tree_at(lambda c: c.loads[0].mass, CASE, value)
        assert_refused(complex_mass, f"loads.0.mass must be one number, not {what}")
    limit = eqx.tree_at(lambda c: c.actuators[0].limits, CASE, jnp.ones(()))
    assert_refused(limit, "actuators.0.limits must be a list of 2 numbers, not one number")


@pytest.mark.parametrize("value", ["heavy", 1j, np.array(1j), jnp.array(1j), np.array("heavy")])
def test_only_real_numbers_are_taken(value):
    """Imaginary parts were dropped, and texts gave errors of NumPy without an address."""
    with pytest.raises(ValueError, match="loads.0.mass takes real numbers, not "):
        jb.replace(CASE, {"loads.0.mass": value})
    case = eqx.tree_at(lambda c: c.loads[0], CASE, jb.MovingMass(mass=value, speed=2.0))
    with pytest.raises(ValueError, match=r"loads.0.mass must be (a real|one) number, not "):
        jb.simulate(case)


def test_negative_speed_and_rounded_positions_pass():
    check_case(replace(CASE, {"loads.0.speed": -0.5, "sensors.0.position": 3 * 0.2}))
    check_case(Case(BEAM, actuators=[SpringDamper(0.0, 1.0)], supports=[Support(0.6)]))


def test_traced_numbers_are_skipped():
    """Inside jit and vmap a case is validated as far as its numbers are concrete."""

    def length(value):
        case = replace(CASE, {"beam.length": value, "loads.0.speed": 0 * value})
        check_case(case)
        return case.beam.length

    assert jax.jit(length)(-1.0) == -1.0
    assert (jax.vmap(length)(jnp.array([-1.0, 1.0])) == jnp.array([-1.0, 1.0])).all()
    with pytest.raises(ValueError, match="beam.length must be positive"):
        jax.grad(length)(-1.0)


def test_validation_takes_milliseconds():
    check_case(CASE)
    start = time.perf_counter()
    for _ in range(10):
        check_case(CASE)
    assert time.perf_counter() - start < 0.5, "ten should take far less than 50 ms"


def assert_refused(case, message):
    """Assert that the case is refused with one line that contains the message."""
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        check_case(case)
    assert "\n" not in str(caught.value)


# Addresses that stand for a number of all loads, `loads.*.speed`.

JOINT_CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    sensors=[jb.Sensor(0.15), jb.Sensor(0.3)],
    loads=[
        jb.MovingMass(mass=0.4, speed=2.0),
        jb.MovingForce(force=3.0, speed=2.0, entry_time=0.1),
    ],
    run=jb.Run(duration=0.5),
)


def test_one_address_stands_for_all_loads():
    assert own_addresses(JOINT_CASE, "loads.*.speed") == ["loads.0.speed", "loads.1.speed"]
    assert own_addresses(JOINT_CASE, "loads.1.speed") == ["loads.1.speed"]
    assert value_at(JOINT_CASE, "loads.*.speed") == 2.0
    assert unit_at(JOINT_CASE, "loads.*.speed") == "m/s"
    for changed in (
        jb.replace(JOINT_CASE, {"loads.*.speed": 3.0}),
        with_settings(JOINT_CASE, {"loads.*.speed": 3.0}),
    ):
        assert [float(load.speed) for load in changed.loads] == [3.0, 3.0]
    moved = jb.replace(JOINT_CASE, {"sensors.*.position": 0.2})
    assert_allclose(moved.sensor_positions, [0.2, 0.2])


def test_gradient_is_that_of_all_speeds_together():
    def peak(speed):
        return jb.simulate(jb.replace(JOINT_CASE, {"loads.*.speed": speed})).deflection[-1, 0]

    def by_two_names(speed):
        both = {"loads.0.speed": speed, "loads.1.speed": speed}
        return jb.simulate(jb.replace(JOINT_CASE, both)).deflection[-1, 0]

    assert float(peak(2.5)) == float(by_two_names(2.5))
    (slope,) = central(lambda speeds: by_two_names(speeds[0]), [2.5])
    assert_allclose(jax.grad(peak)(2.5), slope, rtol=1e-5)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("loads.*.mass", "a number of all loads, and loads.1 has no mass"),
        ("supports.*.position", "the case has no supports"),
        ("loads.*", r"followed by a name, as in loads\.\*\.speed"),
        (
            "*.speed",
            r"lists are supports\.\*, absorbers\.\*, actuators\.\*, sensors\.\*, loads\.\*",
        ),
        ("beam.*.length", "stands for all parts of a list"),
    ],
)
def test_addresses_that_some_part_lacks(address, message):
    for use in (value_at, unit_at, own_addresses, lambda case, a: jb.replace(case, {a: 1.0})):
        with pytest.raises(ValueError, match=message):
            use(JOINT_CASE, address)


def test_numbers_that_differ_have_no_common_value():
    different = jb.replace(JOINT_CASE, {"loads.0.speed": 5.0})
    with pytest.raises(ValueError, match=r"differ, 5.0, 2.0: set them to one value"):
        value_at(different, "loads.*.speed")
    assert jb.replace(different, {"loads.*.speed": 1.0}).loads[0].speed == 1.0


TWICE = {
    "part": (("loads.*.speed", "loads.1.speed"), "loads.1.speed"),
    "entry": (("beam.damping_ratio", "beam.damping_ratio.1"), "beam.damping_ratio.1"),
    "entry first": (("beam.damping_ratio.1", "beam.damping_ratio"), "beam.damping_ratio.1"),
}
GIVEN_TO = {
    "replace": lambda case, given: jb.replace(case, dict.fromkeys(given, 0.01)),
    "settings": lambda case, given: with_settings(case, dict.fromkeys(given, 0.01)),
    "sweep": lambda case, given: jb.sweep(case, dict.fromkeys(given, [0.01]), progress=False),
    "Simulator": lambda case, given: jb.Simulator(case, vary=given),
}


@pytest.mark.parametrize("both, number", TWICE.values(), ids=TWICE)
@pytest.mark.parametrize("take", GIVEN_TO.values(), ids=GIVEN_TO)
def test_addresses_that_give_one_number_twice(take, both, number):
    beam = dataclasses.replace(JOINT_CASE.beam, damping_ratio=[0.01, 0.01], modes=2)
    case = dataclasses.replace(JOINT_CASE, beam=beam, sensors=[jb.Sensor(0.5)])
    with pytest.raises(ValueError) as refused:
        take(case, both)
    message = str(refused.value)
    assert "both give the number" in message and number in message
    assert all(address in message for address in both)


# Counts of what a case has are limited, and a case beyond a limit is refused at once.

BRIDGE_BEAM = {"length": 20.0, "flexural_rigidity": 1e10, "mass_per_length": 12e3}


def test_200_000_sensors_are_refused_at_once():
    start = time.process_time()
    with pytest.raises(ValueError, match="sensors has 200000 entries; 10000 are the most"):
        case_from_dict({"beam": BRIDGE_BEAM, "sensors": [{"position": 1.0}] * 200_000})
    case = jb.Case(jb.Beam(**BRIDGE_BEAM), sensors=[jb.Sensor(1.0)] * 200_000, run=jb.Run(1.0))
    with pytest.raises(ValueError, match="sensors has 200000 entries"):
        check_case(case)
    assert time.process_time() - start < 5.0


@pytest.mark.parametrize("key", [k for k, found in part_classes().items() if found.listed])
def test_all_lists_of_a_case_are_limited(key):
    with pytest.raises(ValueError, match=f"^{key} has .* entries; {MAX_COUNTS[key]} are the most"):
        case_from_dict({"beam": BRIDGE_BEAM, key: [{}] * (MAX_COUNTS[key] + 1)})


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
        ({"beam": BRIDGE_BEAM | {"modes": 1001}}, "beam.modes must not exceed 1000; it is 1001"),
        (
            {"beam": BRIDGE_BEAM | {"segments": [{}] * 2001}},
            "beam.segments has 2001 entries; 2000 are the most",
        ),
        (
            {
                "beam": BRIDGE_BEAM,
                "loads": [{"kind": "vehicle", "model": "half-truck", "speed": 1.0, "count": 10**9}],
            },
            "loads.0.count must not exceed 2000; it is 1000000000",
        ),
        (
            {
                "beam": BRIDGE_BEAM,
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
    case = jb.Case(
        jb.Beam(**BRIDGE_BEAM), sensors=[jb.Sensor(10.0)], loads=[axles], run=jb.Run(1.0)
    )
    with pytest.raises(ValueError, match=f"loads have 30000 wheels in all; {MAX_WHEELS} are"):
        check_case(case)


def test_samples_of_all_sensors_are_limited():
    case = jb.Case(
        jb.Beam(**BRIDGE_BEAM), sensors=[jb.Sensor(10.0)] * 1000, run=jb.Run(1e4, sample_rate=1e3)
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
    wheels = WheelSet(zeros, zeros, (False, False))
    breakpoints, cubics = LoadSet(trajectories, wheels, (np.zeros(1),) * 2).cubics()
    assert breakpoints.shape == (2, 5) and cubics.shape == (2, 5, 4)
    assert_allclose(breakpoints[0], [0.2, 2.2, np.inf, np.inf, np.inf])
    assert_allclose(cubics[1], trajectories[1].cubics()[1])
    none = LoadSet((), WheelSet(zeros[:0], zeros[:0], ()), ()).cubics()
    assert [part.shape for part in none] == [(0, 1), (0, 1, 4)]
