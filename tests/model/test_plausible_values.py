"""Quantities that are judged for plausibility, against closed forms of numbers of the cases."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.model.modes import modes
from jaxbeam.model.plausibility import loads, structure
from jaxbeam.model.plausibility.facts import Facts, plausible_numbers
from tests.model.test_plausibility import BASES, BUMP, changed, parsed

G = 9.81


def facts_of(base: str, changes: dict) -> Facts:
    """Facts of a case to begin with, of which entries are changed."""
    case = parsed(BASES[base])
    for entry, value in changes.items():
        case = changed(case, entry, value)
    found = modes(case)
    return Facts(case, found, plausible_numbers(case, found))


class Pinned:
    """Sines of a pinned beam: E I (N m^2), m (kg/m), L (m), of some modes."""

    def __init__(self, rigidity: float, density: float, length: float, count: int = 3):
        self.rigidity, self.density, self.length = rigidity, density, length
        self.wave = np.arange(1, count + 1) * math.pi / length
        self.rate = self.wave**2 * math.sqrt(rigidity / density)  # rad/s
        self.first = self.rate[0] / (2 * math.pi)

    def shapes(self, x) -> np.ndarray:
        """Shapes at x (m), of a modal mass of 1 kg."""
        return math.sqrt(2 / (self.density * self.length)) * np.sin(np.multiply.outer(x, self.wave))

    def slopes(self, x: float) -> np.ndarray:
        factor = math.sqrt(2 / (self.density * self.length))
        return factor * self.wave * np.cos(self.wave * x)

    def sag(self, on_modes: np.ndarray) -> float:
        """Largest static deflection (m) under generalised forces."""
        every = self.shapes(np.linspace(0.0, self.length, 2001))
        return float(np.max(np.abs(every @ (on_modes / self.rate**2))))

    def damping(self, c: float, x: float) -> float:
        """Largest damping ratio that a damper at x adds to a mode."""
        return float(np.max(c * self.shapes(x) ** 2 / (2 * self.rate)))


BRIDGE, RIG, COIL = Pinned(30e9, 15e3, 25.0), Pinned(11.68, 0.535, 0.6), Pinned(60.0, 1.2, 1.5)
TRACK, RAIL, FOOTBRIDGE = (
    Pinned(20e9, 9e3, 24.0),
    Pinned(6.4e6, 60.0, 60.0),
    Pinned(1.8e9, 1.2e3, 30),
)
IN_SERIES = 1 / (1 / 65e6 + 1 / 137.75e6) / 0.6  # N/m^2
SLEEPER = 2 * math.sqrt((65e6 + 137.75e6) * 251.0)
WAVE = (40e6 / (4 * 6.4e6)) ** 0.25  # 1/m
OF_COIL, OF_PATCH = 8.0 * 5.0 / 3.0, 2e-3 * 100.0 * 12.0
SAG_OF_COIL = COIL.sag(OF_COIL * COIL.shapes(0.6))
SAG_OF_PATCH = COIL.sag(OF_PATCH * (COIL.slopes(0.9) - COIL.slopes(0.8)))
SAG = RIG.sag(0.5 * G * RIG.shapes(0.3))  # under the mass at midspan
SLOPE = math.pi / 0.6
TUNED = {"position": 12.5, "mass": 2e3, "frequency": 4.2, "damping": 500.0}
SETTLED = {"position": 10.0, "settlement": -0.02}
RATE_OF_WAVES = 2 * math.pi * 20.0 / 40.0  # rad/s

# A quantity, the case with its changes, and the values by their addresses.
VALUES = [
    ("slenderness", "bridge", {}, {"beam.flexural_rigidity": 25 * 5000 / math.sqrt(30e9 / 15e3)}),
    ("first_frequency", "bridge", {}, {"beam.flexural_rigidity": BRIDGE.first}),
    ("sag_of_loads", "rig", {}, {"beam.flexural_rigidity": 0.6 / SAG}),
    ("rigid_motions", "bridge", {}, {"beam.ends": 0.0}),
    ("rigid_motions", "bridge", {"beam.ends": "free-pinned"}, {"beam.ends": 1.0}),
    ("rigid_motions", "bridge", {"beam.ends": "free-free"}, {"beam.ends": 2.0}),
    (
        "rigidity_over_shear",
        "bridge",
        {"beam.shear_stiffness": 2e9},
        {"beam.shear_stiffness": 30e9 / 2e9 / 25**2},
    ),
    (
        "radius_of_rotary_inertia",
        "bridge",
        {"beam.rotary_inertia": 5e3},
        {"beam.rotary_inertia": math.sqrt(5e3 / 15e3) / 25},
    ),
    (
        "axial_over_buckling",
        "damped",
        {},
        {"beam.axial_force": 5e6 * 25**2 / (math.pi**2 * 30e9)},
    ),
    ("settlement", "bridge", {"supports.0": SETTLED}, {"supports.0.settlement": 0.02 / 25}),
    ("clamping_distance", "damped", {}, {"supports.0.position": 15 / 25}),
    (
        "support_over_bending",
        "damped",
        {},
        {
            "supports.0.stiffness": 2e9 * 2 * 25**3 / (30e9 * math.pi**4),
            "supports.0.rotational_stiffness": 1e8 * 25 / 30e9,
        },
    ),
    (
        "foundation_over_bending",
        "rail",
        {},
        {"beam.foundation_stiffness": 40e6 * 60**4 / (6.4e6 * math.pi**4)},
    ),
    (
        "sag_on_foundation",
        "rail",
        {},
        {"beam.foundation_stiffness": 100e3 * WAVE**2 / (2 * 40e6)},
    ),
    (
        "sinking_of_rail",
        "track",
        {},
        {"track.pad_stiffness": 10e3 * G / 2 / (4 * 13.25e6 * IN_SERIES**3) ** 0.25},
    ),
    ("sleepers_over_rail", "track", {}, {"track.sleeper_mass": 251 / 0.6 / 121.3}),
    (
        "damping_of_sleepers",
        "track",
        {},
        {"track.pad_damping": 75e3 / SLEEPER, "track.ballast_damping": 58.8e3 / SLEEPER},
    ),
    # Absorbers
    (
        "absorber_over_first_frequency",
        "bridge",
        {"absorbers.0": TUNED},
        {"absorbers.0.frequency": 4.2 / BRIDGE.first},
    ),
    (
        "frequency_off_modes",
        "bridge",
        {"absorbers.0": TUNED},
        {
            "absorbers.0.frequency": math.log(4.2 / BRIDGE.first * (1 + 2 * 2e3 / (15e3 * 25)))
            / math.log(1.4)
        },
    ),
    ("mass_of_absorber", "bridge", {"absorbers.0": TUNED}, {"absorbers.0.mass": 2 / 15 / 25}),
    (
        "damping_of_absorber",
        "bridge",
        {"absorbers.0": TUNED},
        {"absorbers.0.damping": 500.0 / (2 * 2e3 * 2 * math.pi * 4.2)},
    ),
    # Actuators
    (
        "influence_of_actuator",
        "rig",
        {},
        {"actuators.1.position": 1.0, "actuators.2.position": math.sqrt(3) / 2},
    ),
    (
        "least_command",
        "rig",
        {"actuators.2.limits": [1.0, 5.0]},
        {"actuators.0.limits": 0.0, "actuators.1.limits": 0.0, "actuators.2.limits": 1.0},
    ),
    (
        "sag_of_command",
        "coil",
        {},
        {
            "actuators.0.force_constant": SAG_OF_COIL / 1.5,
            "actuators.1.moment_per_volt": SAG_OF_PATCH / 1.5,
        },
    ),
    (
        "spring_of_actuator",
        "rig",
        {},
        {"actuators.1.stiffness": 3500 * np.sum(RIG.shapes(0.5) ** 2 / RIG.rate**2)},
    ),
    (
        "damping_at_places",
        "coil",
        {},
        {
            "actuators.0.damping": COIL.damping(1.0, 0.6),
            "actuators.0.back_emf": COIL.damping(8.0 * 8.0 / 3.0, 0.6),
            "actuators.2.damping": COIL.damping(0.5, 1.0),
        },
    ),
    ("rate_of_commands", "coil", {}, {"actuators.1.rate_limit": 2e3 / (COIL.rate[0] * 16)}),
    ("lag_of_actuator", "coil", {}, {"actuators.0.inductance": 3.0 / 1e-3 / COIL.rate[0]}),
    # Vehicles
    (
        "sag_of_spring",
        "cars",
        {},
        {
            "loads.0.tyre_stiffness": 17.6e3 * G / 1.75e6,
            "loads.0.suspension_stiffness": 17e3 * G / 4e5,
            "loads.1.tyre_stiffness.0": (8300 + 700) * G / 1.75e6,
            "loads.1.tyre_stiffness.1": (8300 + 1100) * G / 3.5e6,
            "loads.1.suspension_stiffness.0": 8300 * G / 4e5,
            "loads.1.suspension_stiffness.1": 8300 * G / 1e6,
            "loads.2.stiffness": 17e3 * G / 1.6e6,
        },
    ),
    (
        "sag_of_spring",
        "railway",
        {},
        {
            "loads.0.primary_stiffness": (32e3 + 2 * 2600) / 4 * G / 2.4e6,
            "loads.0.secondary_stiffness": 32e3 / 2 * G / 8.6e5,
            "loads.2.axles.0.suspension_stiffness": 34e3 / 2 * G / 2e6,
            "loads.2.axles.1.suspension_stiffness": 34e3 / 2 * G / 2e6,
            "loads.2.springs.0.stiffness": 30e3 / 2 * G / 1e6,
            "loads.2.springs.1.stiffness": 30e3 / 2 * G / 1e6,
        },
    ),
    (
        "stage_damping",
        "railway",
        {},
        {
            "loads.0.primary_damping": 8e3 / 2 / math.sqrt(2.4e6 * (32e3 + 2 * 2600) / 4),
            "loads.0.secondary_damping": 4e4 / 2 / math.sqrt(8.6e5 * 32e3 / 2),
            "loads.2.springs.0.damping": 2e4 / 2 / math.sqrt(1e6 * 15e3),
            "loads.2.springs.1.damping": 2e4 / 2 / math.sqrt(1e6 * 15e3),
        },
    ),
    (
        "tyre_over_suspension_stiffness",
        "cars",
        {},
        {"loads.0.suspension_stiffness": 1.75e6 / 4e5, "loads.1.suspension_stiffness": 4.375},
    ),
    (
        "tyre_over_suspension_damping",
        "cars",
        {},
        {"loads.0.suspension_damping": 0.1, "loads.1.suspension_damping": 0.1},
    ),
    (
        "primary_over_secondary_stiffness",
        "railway",
        {},
        {"loads.0.secondary_stiffness": 2 * 2.4e6 / 8.6e5},
    ),
    (
        "unsprung_over_sprung",
        "railway",
        {},
        {
            "loads.0.bogie_mass": 2600 / 32e3,
            "loads.0.wheelset_mass": 1800 / 32e3,
            "loads.2.axles.0.mass": 2 * 900 / 34e3,
            "loads.2.axles.1.mass": 2 * 900 / 34e3,
        },
    ),
    (
        "unsprung_over_sprung",
        "cars",
        {},
        {"loads.0.axle_mass": 6 / 170, "loads.1.axle_masses": 9 / 83},
    ),
    (
        "gyration_over_wheelbase",
        "railway",
        {},
        {
            "loads.0.body_inertia": math.sqrt(2e6 / 32e3) / 9.5,
            "loads.0.bogie_inertia": math.sqrt(1400 / 2600) / 1.25,
            "loads.2.bodies.0.inertia": math.sqrt(1e6 / 30e3) / 2,
            "loads.2.bodies.1.inertia": math.sqrt(1e4 / 4e3) / 2,
        },
    ),
    (
        "gyration_over_wheelbase",
        "cars",
        {},
        {"loads.1.body_inertia": math.sqrt(95765 / 16600) / 2.4},
    ),
    (
        "distance_of_axles",
        "railway",
        {},
        {
            "loads.0.bogie_distance": 19.0 - 2.5,
            "loads.1.offsets": 8.0,
            "loads.2.axles": 4.0,
            "loads.2.spacing": 20.0,
        },
    ),
    (
        "weight_of_axle",
        "cars",
        {},
        {"loads.0.body_mass": 17.6 * G, "loads.1.body_mass": 9.4 * G},
    ),
    ("weight_of_load", "cars", {}, {"loads.2.mass": 17 * G}),
    ("weight_over_force", "railway", {}, {"loads.1.masses": 1800 * G / 170e3}),
    (
        "mass_on_foot",
        "bridge",
        {"loads.0.speed": 1.4, "loads.0.mass": 90.0},
        {"loads.0.mass": 90.0},
    ),
    ("amplitude_of_forces", "footbridge", {}, {"loads.1.amplitudes": 300 / G / (1200 * 30)}),
    ("mass_ratio", "cars", {}, {"loads.0.body_mass": 18400 / (15e3 * 25)}),
    # Travel
    (
        "entry_over_duration",
        "railway",
        {},
        {"loads.0": 0.0, "loads.1": 2.0 / 4, "loads.2": 3.0 / 4},
    ),
    (
        "exit_over_duration",
        "railway",
        {},
        {
            "loads.0": (25 + 19 + 2.5) / 60 / 4,
            "loads.1": (2 + (25 + 14) / 60) / 4,
            "loads.2": (3 + (25 + 20 + 4) / 60) / 4,
        },
    ),
    ("exit_before_run", "bridge", {"loads.0.entry_time": -3.0}, {"loads.0.entry_time": 2.0}),
    ("braking_to_stop", "bridge", {"loads.0.deceleration": 15.0}, {"loads.0.deceleration": 1.0}),
    ("braking_to_stop", "bridge", {"loads.0.deceleration": 12.0}, {}),
    ("duration_over_crossing", "bridge", {}, {"run.duration": 2.0}),
    ("speed_over_traffic", "cars", {}, {"loads.2.speed": 20 / 60}),
    ("speed_over_traffic", "bridge", {}, {"loads.0.speed": 25 / 120}),
    ("speed_ratio", "bridge", {}, {"loads.0.speed": 25 / (2 * BRIDGE.first * 25)}),
    # Profile
    ("height_of_profile", "cars", {}, {"profile.amplitude": 2 * 0.002 / 25}),
    ("rise_of_waves", "cars", {}, {"profile.amplitude": 2 * 0.002}),
    (
        "slope_of_profile",
        "cars",
        {},
        {"profile.amplitude": 0.002 * math.sin(math.pi / 2 * 0.25) / 0.25},
    ),
    ("length_of_waves", "cars", {}, {"profile.wavelength": 4 / 25}),
    ("acceleration_of_waves", "cars", {}, {}),
    (
        "acceleration_of_waves",
        "cars",
        {"profile.wavelength": 40.0},
        {"profile.wavelength": 0.002 * RATE_OF_WAVES**2 / G},
    ),
    ("bump_under_loads", "cars", {"profile": BUMP}, {"profile.start": 1.0}),
    ("bump_under_loads", "cars", {"profile": BUMP | {"height": 0.0}}, {"profile.start": 0.0}),
    ("bump_under_loads", "cars", {"profile": BUMP | {"start": 1.0, "end": 2.0}}, {}),
    ("largest_phase", "cars", {"profile.phase": -1.5}, {"profile.phase": 1.5}),
    # Sensors, controller, run
    (
        "error_over_reading",
        "rig",
        {},
        {
            "sensors.0.noise": 1e-5 / SAG,
            "sensors.0.resolution": 1e-6 / SAG,
            "sensors.0.offset": 0.0,
            "sensors.1.noise": 1e-6 / (SAG * SLOPE**2 * 1.5e-3),
            "sensors.1.offset": 0.0,
            "sensors.2.offset": 0.0,
        },
    ),
    (
        "readings_over_range",
        "rig",
        {"sensors.2.range": [-2e7, 1e7], "sensors.2.offset": 1e6},
        {"sensors.2.range": SAG * SLOPE**2 * 11.68 / 7.5e-8 / 2.1e7},
    ),
    (
        "rest_off_range",
        "rig",
        {"sensors.0.range": [-1e-3, 1e-3], "sensors.0.offset": -3e-3},
        {"sensors.0.range": 2e-3},
    ),
    (
        "size_of_section_modulus",
        "rig",
        {},
        {"sensors.2.section_modulus": 7.5e-8 ** (1 / 3) / 0.6},
    ),
    (
        "cutoff_over_crossing",
        "rig",
        {"sensors.0.filter": {"cutoff": 50.0}},
        {"sensors.0.filter.cutoff": 50.0 * 0.6 / 0.6},
    ),
    (
        "delay_over_duration",
        "rig",
        {},
        {"sensors.0.delay": 1e-3 / 1.2, "controller.delay": 1e-3 / 1.2},
    ),
    (
        "delay_over_period",
        "rig",
        {},
        {"sensors.0.delay": 1e-3 * RIG.first, "controller.delay": 1e-3 * RIG.first},
    ),
    ("samples_in_period", "rig", {}, {"controller.period": 1 / (0.005 * RIG.first)}),
    (
        "effect_of_gains",
        "coil",
        {},
        {
            "controller.gains": 100.0 * SAG_OF_COIL / 5.0,
            "controller.rate_gains": 5.0 * SAG_OF_COIL / 5.0 * COIL.rate[0],
        },
    ),
    ("step_of_commands", "coil", {}, {"controller.resolution": 0.005 / 10}),
    ("lag_of_controller", "coil", {}, {"controller.lag": 0.002 * COIL.rate[0]}),
    ("samples_of_record", "bridge", {}, {"run.sample_rate": 1000 / BRIDGE.first}),
    ("samples_of_record", "railway", {}, {"run.sample_rate": 1000 / (9 * BRIDGE.first)}),
    ("samples_of_force", "footbridge", {}, {"loads.1.frequencies": 500.0}),
    ("gravity", "bridge", {"run.gravity": 0.6}, {"run.gravity": 0.6}),
    ("gravity", "bridge", {"run.gravity": 0.0}, {}),
]


@pytest.mark.parametrize(
    ("quantity", "base", "changes", "expected"),
    VALUES,
    ids=[f"{quantity}-{base}-{i}" for i, (quantity, base, *_) in enumerate(VALUES)],
)
def test_values_are_those_of_closed_forms(quantity, base, changes, expected):
    """Each of them, and no more; deflections are found at 201 positions."""
    facts = facts_of(base, changes)
    module = structure if hasattr(structure, quantity) else loads
    found = {value.address: float(value.value) for value in getattr(module, quantity)(facts)}
    assert found.keys() == expected.keys()
    for address, value in expected.items():
        assert_allclose(found[address], value, rtol=2e-4, atol=1e-12, err_msg=address)


def test_a_beam_on_soft_springs_is_held():
    """Statics of a beam on a spring at each end, much softer than the beam, and its bounce."""
    length, rigidity, density, k, force = 25.0, 30e12, 15e3, 1e5, 170e3
    case = jb.Case(
        jb.Beam(length, rigidity, density, ends="free-free", damping_ratio=0.01, modes=6),
        supports=[jb.Support(x, stiffness=k) for x in (0.0, length)],
        loads=[jb.MovingForce(force=force, speed=10.0)],
        run=jb.Run(4.0),
    )
    found = plausible_numbers(case, modes(case))
    weight = density * G
    own = weight * (length / (2 * k) + 5 * length**4 / (384 * rigidity))
    assert_allclose(found.own_deflection, own, rtol=1e-4)
    assert_allclose(found.deflection, force / k, rtol=1e-4)  # below a force at an end
    bounce = math.sqrt(2 * k / (density * length)) / (2 * math.pi)
    assert_allclose(found.first_frequency, bounce, rtol=1e-4)
