"""What looks wrong is said, and nothing else: planted mistakes, and cases that are right."""

import dataclasses
import math
import re
import tomllib
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.files.case_file import case_from_dict, case_to_dict, with_settings
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.plausibility.check import PlausibilityWarning
from tests.modules import ROOT

BRIDGE = dict(length=25.0, flexural_rigidity=30e9, mass_per_length=15e3, damping_ratio=0.015)
RIGHT_FILES = [
    *sorted((ROOT / "jaxbeam/case/library/rigs").glob("*.toml")),
    *sorted((ROOT / "examples").glob("*.toml")),
]


def bridge(beam=None, supports=(), load=None, run=None, sensors=None, **other) -> jb.Case:
    """A bridge of 25 m under a truck of 30 t at 90 km/h, with some numbers changed."""
    return jb.Case(
        jb.Beam(**BRIDGE | (beam or {})),
        supports=supports,
        sensors=[jb.Sensor(position=12.5)] if sensors is None else sensors,
        loads=[jb.MovingMass(**dict(mass=30e3, speed=25.0) | (load or {}))],
        run=jb.Run(**dict(duration=2.0) | (run or {})),
        **other,
    )


@pytest.mark.parametrize("path", RIGHT_FILES, ids=lambda path: path.stem)
def test_rigs_and_examples_are_plausible(path: Path):
    assert jb.check(jb.load_case(path)).warnings == ()


def test_a_weight_for_a_mass_per_length_is_noticed():
    """15 t/m given as N/m: the bridge sags by 5 w L^4 / (384 E I), and no row said so."""
    weight = BRIDGE["mass_per_length"] * 9.81
    sag = 5 * weight * 9.81 * 25.0**4 / (384 * BRIDGE["flexural_rigidity"])
    assert 10 < 25.0 / sag < 120
    (sentence,) = jb.check(bridge({"mass_per_length": weight})).warnings
    assert f"sags by {sag:.2f}" in sentence and "not a weight in N" in sentence
    on_springs = [jb.Support(12.5, stiffness=1e8)]
    assert jb.check(bridge({"mass_per_length": weight}, on_springs)).warnings == ()
    hung = {"length": 200.0, "flexural_rigidity": 1.2e12}  # 0.35 Hz, as an arch or a cable has
    assert jb.check(bridge(hung, run={"duration": 9.0})).warnings == ()


def test_the_demonstration_is_plausible():
    case = jb.load_case(ROOT / "jaxbeam/case/library/demo/rig.toml")
    assert jb.check(case).warnings == ()
    for mass, speed in ((0.05, 0.5), (0.6, 6.0)):
        loads = [jb.MovingMass(mass=mass, speed=speed)]
        assert jb.check(jb.Case(case.beam, sensors=case.sensors, loads=loads)).warnings[1:] == ()


def test_numbers_are_those_of_the_closed_forms():
    found = jb.check(bridge(beam={"modes": 30}))
    EI, m, L, P = 30e9, 15e3, 25.0, 30e3 * 9.81
    first = math.pi / 2 / L**2 * math.sqrt(EI / m)
    assert found.warnings == ()
    assert found.first_frequency == pytest.approx(first, rel=1e-9)
    assert found.deflection == pytest.approx(P * L**3 / 48 / EI, rel=1e-4)
    assert found.span_over_deflection == pytest.approx(L / (P * L**3 / 48 / EI), rel=1e-4)
    assert found.own_deflection == pytest.approx(5 / 384 * m * 9.81 * L**4 / EI, rel=1e-3)
    assert found.mass_ratio == pytest.approx(30e3 / (m * L))
    assert found.crossing_time == pytest.approx(1.0)
    assert found.critical_speed == pytest.approx(math.pi / L * math.sqrt(EI / m))
    assert found.speed_ratio == pytest.approx(25.0 / found.critical_speed)
    assert f"{first:.4g} Hz" in str(found)


def parsed(text: str) -> jb.Case:
    return case_from_dict(tomllib.loads(text))


BASES = {
    "track": """
        [beam]
        length = 24.0
        flexural_rigidity = 20e9
        mass_per_length = 9e3
        damping_ratio = 0.01
        modes = 90
        [track]
        rail_rigidity = 13.25e6
        rail_mass = 121.3
        pad_stiffness = 65e6
        pad_damping = 75e3
        sleeper_mass = 251.0
        ballast_stiffness = 137.75e6
        ballast_damping = 58.8e3
        approach = 30.0
        [[sensors]]
        position = 12.0
        [[loads]]
        kind = "mass"
        mass = 10e3
        speed = 40.0
        [run]
        duration = 3.0
        """,
    "bridge": """
        [beam]
        length = 25.0
        flexural_rigidity = 30e9
        mass_per_length = 15e3
        damping_ratio = 0.015
        modes = 5
        [[sensors]]
        position = 12.5
        [[loads]]
        kind = "mass"
        mass = 30e3
        speed = 25.0
        [run]
        duration = 2.0
        """,
    "section": """
        [beam]
        length = 2.0
        width = 0.06
        height = 0.012
        youngs_modulus = 210e9
        density = 7850.0
        damping_ratio = 0.01
        [[sensors]]
        position = 1.0
        [[loads]]
        kind = "force"
        force = 15.0
        speed = 2.0
        [run]
        duration = 1.5
        """,
    "cars": """
        [beam]
        length = 25.0
        flexural_rigidity = 30e9
        mass_per_length = 15e3
        damping_ratio = 0.015
        [[sensors]]
        position = 12.5
        [[vehicle_sensors]]
        load = 0
        body = "body"
        [[loads]]
        kind = "quarter-car"
        speed = 20.0
        body_mass = 17000.0
        axle_mass = 600.0
        suspension_stiffness = 4e5
        suspension_damping = 1e4
        tyre_stiffness = 1.75e6
        tyre_damping = 1e3
        [[loads]]
        kind = "half-car"
        speed = 20.0
        entry_time = 1.5
        body_mass = 16600.0
        body_inertia = 95765.0
        axle_positions = [2.4, -2.4]
        axle_masses = [700.0, 1100.0]
        suspension_stiffness = [4e5, 1e6]
        suspension_damping = [1e4, 1e4]
        tyre_stiffness = [1.75e6, 3.5e6]
        tyre_damping = [1e3, 1e3]
        [[loads]]
        kind = "oscillator"
        speed = 20.0
        entry_time = 3.0
        mass = 17000.0
        stiffness = 1.6e6
        damping = 2e4
        [profile]
        kind = "sine"
        amplitude = 0.002
        wavelength = 4.0
        [run]
        duration = 5.0
        """,
    "railway": """
        [beam]
        length = 25.0
        flexural_rigidity = 30e9
        mass_per_length = 15e3
        damping_ratio = 0.015
        [[sensors]]
        position = 12.5
        quantity = "acceleration"
        [[loads]]
        kind = "wagon"
        speed = 60.0
        body_mass = 32e3
        body_inertia = 2e6
        bogie_mass = 2600.0
        bogie_inertia = 1400.0
        wheelset_mass = 1800.0
        primary_stiffness = 2.4e6
        primary_damping = 8e3
        secondary_stiffness = 8.6e5
        secondary_damping = 4e4
        bogie_distance = 19.0
        wheelset_distance = 2.5
        [[loads]]
        kind = "axles"
        offsets = [0.0, 3.0, 11.0, 14.0]
        forces = 170e3
        masses = 1800.0
        speed = 60.0
        entry_time = 2.0
        [[loads]]
        kind = "vehicle"
        count = 2
        spacing = 20.0
        speed = 60.0
        entry_time = 3.0
        bodies = [
            {name = "body", mass = 30e3, inertia = 1e6},
            {name = "frame", mass = 4e3, inertia = 1e4},
        ]
        springs = [
            {first = "body", second = "frame", position = -2.0, stiffness = 1e6, damping = 2e4},
            {first = "body", second = "frame", position = 2.0, stiffness = 1e6, damping = 2e4},
        ]
        axles = [
            {body = "frame", position = 2.0, mass = 900.0, suspension_stiffness = 2e6},
            {body = "frame", position = -2.0, mass = 900.0, suspension_stiffness = 2e6},
        ]
        [run]
        duration = 4.0
        """,
    "footbridge": """
        [beam]
        length = 30.0
        flexural_rigidity = 1.8e9
        mass_per_length = 1200.0
        damping_ratio = 0.005
        [[sensors]]
        position = 15.0
        quantity = "acceleration"
        [[loads]]
        kind = "pedestrian"
        pace = 2.0
        speed = 1.5
        [[loads]]
        kind = "varying-force"
        force = 0.0
        frequencies = [2.0]
        amplitudes = [300.0]
        phases = [0.0]
        position = 10.0
        [run]
        duration = 22.0
        """,
    "rig": """
        [beam]
        length = 0.6
        flexural_rigidity = 11.68
        mass_per_length = 0.535
        damping_ratio = 0.03
        [[actuators]]
        kind = "patch"
        start = 0.25
        end = 0.35
        d33 = 4e-10
        modulus = 30e9
        electrode_spacing = 0.5e-3
        beam_height = 3e-3
        patch_height = 0.3e-3
        patch_width = 0.028
        correction = 0.8
        amplifier_gain = 200.0
        limits = [-2.5, 7.5]
        [[actuators]]
        kind = "shaker"
        position = 0.5
        stiffness = 3500.0
        damping = 80.0
        limits = [-4.0, 4.0]
        [[actuators]]
        kind = "point"
        position = 0.2
        limits = [-5.0, 5.0]
        [[sensors]]
        position = 0.3
        noise = 1e-5
        resolution = 1e-6
        delay = 0.001
        [[sensors]]
        position = 0.2
        quantity = "strain"
        fibre_distance = 1.5e-3
        noise = 1e-6
        [[sensors]]
        position = 0.2
        quantity = "stress"
        section_modulus = 7.5e-8
        [[loads]]
        kind = "mass"
        mass = 0.5
        speed = 0.6
        [controller]
        kind = "output-feedback"
        gains = [[2e3, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
        period = 0.005
        delay = 0.001
        [run]
        duration = 1.2
        """,
    "rail": """
        [beam]
        length = 60.0
        flexural_rigidity = 6.4e6
        mass_per_length = 60.0
        foundation_stiffness = 40e6
        damping_ratio = 0.1
        modes = 40
        [[sensors]]
        position = 30.0
        [[loads]]
        kind = "force"
        force = 100e3
        speed = 50.0
        [run]
        duration = 1.3
        """,
    "damped": """
        [beam]
        length = 25.0
        flexural_rigidity = 30e9
        mass_per_length = 15e3
        damping_ratio = 0.015
        axial_force = -5e6
        [[supports]]
        position = 10.0
        stiffness = 2e9
        rotational_stiffness = 1e8
        damping = 1e6
        mass = 2e3
        [[absorbers]]
        position = 18.0
        mass = 3000.0
        frequency = 11.5
        damping_ratio = 0.08
        max_stroke = 0.02
        [[actuators]]
        kind = "point"
        position = 5.0
        limits = [-2e4, 2e4]
        [[sensors]]
        position = 5.0
        quantity = "velocity"
        [[loads]]
        kind = "mass"
        mass = 30e3
        speed = 25.0
        [controller]
        kind = "feedback"
        gains = [2e5]
        period = 0.01
        resolution = 20.0
        [run]
        duration = 2.0
        """,
    "coil": """
        [beam]
        length = 1.5
        flexural_rigidity = 60.0
        mass_per_length = 1.2
        damping_ratio = 0.01
        [[actuators]]
        kind = "electrodynamic"
        position = 0.6
        resistance = 3.0
        inductance = 1e-3
        force_constant = 8.0
        mass = 0.05
        stiffness = 200.0
        damping = 1.0
        back_emf = 8.0
        limits = [-5.0, 5.0]
        [[actuators]]
        kind = "patch"
        start = 0.8
        end = 0.9
        moment_per_volt = 2e-3
        amplifier_gain = 100.0
        limits = [-4.0, 12.0]
        rate_limit = 2e3
        [[actuators]]
        kind = "spring"
        position = 1.0
        stiffness = 300.0
        damping = 0.5
        [[sensors]]
        position = 0.6
        [[sensors]]
        position = 0.85
        [[loads]]
        kind = "mass"
        mass = 0.3
        speed = 1.5
        [controller]
        kind = "pd"
        gains = [100.0, 80.0]
        rate_gains = [5.0, 5.0]
        lag = 0.002
        period = 0.002
        resolution = 0.005
        [run]
        duration = 1.5
        """,
}

# The case, the entry that is wrong, its value, the address that is named, and the likely unit.
STANDING = {"position": 12.5, "mass": 2e3, "damping": 500.0}
TUNED = {"position": 12.5, "mass": 2e3, "stiffness": 1e6}
TABLE = {"kind": "mass", "mass": 30e3, "positions": [0.0, 25.0]}
ROLLED = [[2e3, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
PPF = {"kind": "ppf", "gains": [-300.0, -300.0], "damping_ratio": 0.5, "period": 0.002}
BUMP = {"kind": "bump", "start": 1e3, "end": 2e3, "height": 0.03}
HERTZ = {"kind": "unilateral", "hertz_stiffness": 9e10}  # N/m^1.5, of a wheel on a rail
MISTAKES = [
    # Frequencies in rad/s, stroke, foundation, waves
    ("damped", "absorbers.0.frequency", 11.5 * 2 * math.pi, "", "11.5 Hz"),
    ("bridge", "absorbers.0", STANDING | {"frequency": 21.9}, ".frequency", "3.49 Hz"),
    ("coil", "controller", PPF | {"frequency": 4.9 * 2 * math.pi}, ".frequency", "not in rad/s"),
    ("damped", "absorbers.0.max_stroke", 20.0, "", "in m, not in mm"),
    ("bridge", "contact", HERTZ | {"hertz_stiffness": 90e3}, ".hertz_stiffness", "N/m^1.5, not"),
    (
        "bridge",
        "contact",
        {"kind": "unilateral", "stiffness": 1e3},
        ".stiffness",
        "in N/m, not in MN",
    ),
    ("rail", "beam.foundation_stiffness", 40e3, "", "in N/m^2, not in kN/m^2"),
    ("bridge", "beam.foundation_stiffness", 20e3, "", "in N/m^2, not in kN/m^2"),
    ("cars", "profile.wavelength", 4000.0, "", "in m, not in mm"),
    (
        "cars",
        "profile",
        {"kind": "sine", "wavelength": 50.0, "amplitude": 5e-5},
        ".wavelength",
        "m",
    ),
    ("cars", "profile", BUMP, ".start", "in m, not in mm"),
    # Dampers, masses and springs on supports and actuators
    ("damped", "beam.axial_force", -5e3, "", "in N, not in kN"),
    ("damped", "supports.0.rotational_stiffness", 1e5, "", "in N m/rad"),
    ("damped", "supports.0.damping", 1e10, "", "in N s/m"),
    ("damped", "supports.0.mass", 2e6, "", "in kg"),
    ("rig", "actuators.1.force_per_volt", 4.6e-3, "", "in N/V"),
    ("rig", "actuators.1.stiffness", 3.5, "", "not in kN/m or N/mm"),
    ("rig", "actuators.1.damping", 80e3, "", "in N s/m"),
    ("rig", "actuators.0.amplifier_gain", 46.0, "", "46 dB are a factor of 200"),
    ("rig", "actuators.2.limits", [-5e-3, 5e-3], "", "in N"),
    ("coil", "actuators.0.force_constant", 8e-3, "", "in N/A"),
    ("coil", "actuators.0.inductance", 1.0, "", "in H, not in mH"),
    ("coil", "actuators.0.back_emf", 8e3, "", "in V s/m"),
    ("coil", "actuators.0.mass", 50.0, "", "in kg, not in g"),
    ("coil", "actuators.1.amplifier_gain", 40.0, "", "40 dB are a factor of 100"),
    ("coil", "actuators.1.rate_limit", 2.0, "", "in V/s, not in V/ms"),
    ("coil", "actuators.2.stiffness", 0.3, "", "in N/m, not in kN/m"),
    # Controllers: effect of gains, rounding, lags
    ("rig", "controller.gains", (1e-3 * np.array(ROLLED)).tolist(), "", "not in mm"),
    ("rig", "controller.gains", (1e6 * np.array(ROLLED)).tolist(), "", "command in its unit"),
    ("damped", "controller.gains", [200.0], "", "command in its unit"),
    ("damped", "controller.gains", [2e11], "", "command in its unit"),
    ("coil", "controller.gains", [0.1, 0.08], "", "command in its unit"),
    ("coil", "controller.rate_gains", [5e-3, 5e-3], "", "command in its unit"),
    ("coil", "controller.rate_gains", [5e4, 5e4], "", "command in its unit"),
    ("coil", "controller.lag", 2.0, "", "in s, not in ms"),
    ("coil", "controller.resolution", 5.0, "", "in V, not in mV"),
    ("damped", "controller.resolution", 2e4, "", "in N"),
    ("coil", "controller", PPF | {"frequency": 5.6, "damping_ratio": 50.0}, ".damping_ratio", "50"),
    ("coil", "controller.jitter", 1.2, "", "in s, not in ms"),
    ("coil", "controller.period", 2e-6, "", "in s"),
    # Vehicles, forces, travel
    ("railway", "loads.2.bodies.0.inertia", 1e3, "", "in kg m^2, not in t m^2"),
    ("railway", "loads.2.axles.0.mass", 0.9, "", "in kg, not in t"),
    ("railway", "loads.1.forces", 170e3 / 9.81, "loads.1.masses", "forces in N"),
    ("cars", "loads.0.entry_time", -5e3, "", "in s, not in ms"),
    ("footbridge", "loads.1.amplitudes", [0.3], "", "in N, not in kN"),
    ("bridge", "run.sample_rate", 1e6, "", "in Hz"),
    ("rig", "sensors.2.section_modulus", 7.5e-11, "", "in m^3"),
    # Absorbers, foundations and forces; the absorber is tuned at 3.55 Hz by 1e6 N/m
    ("bridge", "absorbers.0", STANDING | {"stiffness": 1e3}, ".stiffness", "not in kN/m"),
    ("bridge", "absorbers.0", {**STANDING, "mass": 2e6, "frequency": 3.5}, ".mass", "in kg"),
    ("bridge", "absorbers.0", STANDING | {"mass": 2.0, "frequency": 3.5}, ".mass", "kg, not in t"),
    ("bridge", "absorbers.0", TUNED | {"damping": 9.0}, ".damping", "in N s/m, not in kN s/m"),
    ("bridge", "absorbers.0", TUNED | {"damping_ratio": 10.0}, ".damping_ratio", "a fraction of"),
    ("bridge", "supports", [{"position": 12.5, "stiffness": 500.0}], ".0.stiffness", "N/m, not in"),
    ("bridge", "beam.foundation_stiffness", 20.0, "", "in N/m^2, not in kN/m^2"),
    ("footbridge", "loads.1.frequencies", [800.0], "", "in Hz, not in rad/s"),
    ("bridge", "loads.0", TABLE | {"times": [0.0, 1000.0]}, "", "loads.0.times in s, not in ms"),
    # Stiffness, mass and damping of the beam
    ("bridge", "beam.flexural_rigidity", 30e6, "", "in N m^2, not in kN m^2"),
    ("bridge", "beam.flexural_rigidity", 30e3, "", "in N m^2, not in kN m^2"),
    ("bridge", "beam.flexural_rigidity", 30.0, "", "or GN m^2"),
    ("bridge", "beam.flexural_rigidity", 30e15, "", "in N m^2"),
    ("rig", "beam.flexural_rigidity", 11.68e-3, "", "in N m^2, not in kN m^2"),
    ("rig", "beam.flexural_rigidity", 11.68e6, "", "in N m^2"),
    ("bridge", "beam.mass_per_length", 15.0, "loads.0.mass", "mass_per_length in kg/m, not in t"),
    ("rig", "beam.mass_per_length", 535.0, "beam.flexural_rigidity", "mass_per_length in kg/m"),
    ("bridge", "beam.length", 25e3, "beam.flexural_rigidity", "beam.length in m, not in mm"),
    ("section", "beam.youngs_modulus", 210.0, "", "in Pa, not in GPa"),
    ("section", "beam.youngs_modulus", 210e3, "", "not in GPa or MPa"),
    ("section", "beam.youngs_modulus", 210e12, "", "in Pa"),
    ("section", "beam.density", 7.85, "", "in kg/m^3, not in t/m^3 or g/cm^3"),
    ("section", "beam.density", 77e3, "", "not a weight in N/m^3"),
    ("section", "beam.height", 12.0, "", "in m, not in mm"),
    ("section", "beam.width", 60.0, "", "in m, not in mm"),
    ("section", "beam.height", 1.2e-5, "", "in m, and is beam.length in m, not in mm"),
    ("bridge", "beam.damping_ratio", 1.5, "", "0.01 for one per cent"),
    ("bridge", "beam.damping_ratio", 0.3, "", "0.01 for one per cent"),
    ("bridge", "beam.shear_stiffness", 2e3, "", "in N, not in kN"),
    ("bridge", "beam.rotary_inertia", 5e6, "", "in kg m"),
    # Supports
    ("bridge", "supports.0", {"position": 12.5, "settlement": 20.0}, ".settlement", "not in mm"),
    ("bridge", "supports.0", {"position": 24.99}, ".position", "are positions in m"),
    ("bridge", "beam.ends", "free-free", "", "add [[supports]]"),
    ("bridge", "beam.ends", "free-pinned", "", "add [[supports]]"),
    ("bridge", "beam.hinges", [{"position": 10.0}], "", "leave a hinge out"),
    # Weight and travel of loads
    ("bridge", "loads.0.mass", 30.0, "", "in kg, not in t"),
    ("bridge", "loads.0.mass", 30e3 * 9.81, "", "kg, not its weight in N"),
    ("bridge", "loads.0.mass", 30e6, "", "kg"),
    ("rig", "loads.0.mass", 500.0, "", "loads in kg"),
    ("rig", "loads.0.mass", 0.5 * 9.81, "", "loads in kg"),
    ("section", "loads.0.force", 0.015, "", "forces in N, not in kN"),
    ("section", "loads.0.force", 15e3, "", "forces in N"),
    ("bridge", "loads.0.speed", 250.0, "", "in m/s, not in km/h"),
    ("cars", "loads.0.speed", 80.0, "", "in m/s, not in km/h"),
    ("section", "loads.0.speed", 200.0, "", "in m/s, not in km/h"),
    ("bridge", "loads.0.entry_time", 500.0, "loads.0", "loads.0.entry_time in s, not in ms"),
    ("bridge", "loads.0.start_position", -30e3, "", "in m, not in mm"),
    ("bridge", "loads.0.deceleration", 15.0, "", "in m/s^2"),
    ("bridge", "loads.0.deceleration", 16.0, "", "less than 12.5 m/s^2 let it leave"),
    ("bridge", "run.duration", 0.5, "loads.0", "lengthen run.duration"),
    ("bridge", "run.duration", 2000.0, "", "in s, not in ms"),
    ("bridge", "run.gravity", 9810.0, "", "in m/s^2, 9.81 on earth, not in mm/s^2"),
    ("bridge", "run.sample_rate", 0.001, "", "or 1000 Hz if it is the time step in s"),
    ("bridge", "run.sample_rate", 5.0, "", "give more than 7.11 Hz, or is it in kHz?"),
    ("railway", "run.sample_rate", 40.0, "", "give more than 64 Hz"),
    ("bridge", "sensors", [], "", "[[sensors]]"),
    # Vehicles
    ("cars", "loads.0.suspension_stiffness", 400.0, "", "in N/m, not in kN/m"),
    ("cars", "loads.0.tyre_stiffness", 1750.0, "", "in N/m, not in kN/m"),
    ("cars", "loads.0.suspension_damping", 10.0, "", "in N s/m, not in kN s/m"),
    ("cars", "loads.0.suspension_damping", 1e7, "", "in N s/m"),
    ("cars", "loads.0.suspension_stiffness", 1.75e7, "", "swapped with loads.0.tyre_stiffness"),
    ("cars", "loads.0.tyre_damping", 1e5, "loads.0.suspension_damping", "loads.0.tyre_damping"),
    ("cars", "loads.0.axle_mass", 18e3, "", "swapped with loads.0.body_mass"),
    ("cars", "loads.0.axle_mass", 0.6, "", "in kg, not in t"),
    ("cars", "loads.0.body_mass", 17e3 * 9.81, "", "in kg, not its weight in N"),
    ("cars", "loads.1.suspension_stiffness.1", 1000.0, "", "in N/m, not in kN/m"),
    ("cars", "loads.1.tyre_stiffness.0", 1750.0, "", "in N/m, not in kN/m"),
    ("cars", "loads.1.suspension_damping.0", 10.0, "", "in N s/m, not in kN s/m"),
    ("cars", "loads.1.tyre_damping.1", 1.0, "", "in N s/m, not in kN s/m"),
    ("cars", "loads.1.suspension_stiffness", [4e6, 1e7], "", "swapped"),
    ("cars", "loads.1.axle_masses", [7e3, 11e3], "", "swapped with loads.1.body_mass"),
    ("cars", "loads.1.body_inertia", 95.0, "", "in kg m^2, not in t m^2"),
    ("cars", "loads.1.axle_positions", [2400.0, -2400.0], "", "in m, not in mm"),
    ("cars", "loads.2.stiffness", 1600.0, "", "in N/m, not in kN/m"),
    ("cars", "loads.2.damping", 20.0, "", "in N s/m, not in kN s/m"),
    ("cars", "loads.2.mass", 17e3 * 9.81, "", "kg, not its weight in N"),
    ("railway", "loads.0.primary_stiffness", 2400.0, "", "in N/m, not in kN/m"),
    ("railway", "loads.0.secondary_stiffness", 860.0, "", "in N/m, not in kN/m"),
    ("railway", "loads.0.primary_damping", 8.0, "", "in N s/m, not in kN s/m"),
    ("railway", "loads.0.secondary_stiffness", 2.4e7, "", "loads.0.primary_stiffness"),
    ("railway", "loads.0.bogie_mass", 40e3, "", "swapped with loads.0.body_mass"),
    ("railway", "loads.0.bogie_inertia", 1.4, "", "in kg m^2, not in t m^2"),
    ("railway", "loads.0.bogie_distance", 19e3, "", "in m, not in mm"),
    ("railway", "loads.1.offsets", [0.0, 3000.0, 11e3, 14e3], "", "in m, not in mm"),
    ("railway", "loads.2.spacing", 20e3, "", "in m, not in mm"),
    ("railway", "loads.1.forces", 170.0, "loads.1.masses", "in N, not in kN"),
    ("railway", "loads.1.forces", 17e6, "", "in N"),
    ("railway", "loads.1.masses", 1800 * 9.81 * 3, "", "in kg, the unsprung part"),
    ("railway", "loads.2.springs.0.stiffness", 1e3, "", "in N/m, not in kN/m"),
    ("railway", "loads.2.springs.1.damping", 10.0, "", "in N s/m, not in kN s/m"),
    ("railway", "loads.2.axles.0.suspension_stiffness", 2e3, "", "in N/m, not in kN/m"),
    # People and machines
    ("footbridge", "loads.0.weight", 75.0, "", "in N, not in kg"),
    ("footbridge", "loads.0.weight", 75e3, "", "one person in N"),
    ("footbridge", "loads.1", dict(kind="mass", mass=750.0, speed=1.4), ".mass", "750 N are 76 kg"),
    ("footbridge", "loads.0.pace", 12.6, "", "in Hz, not in rad/s"),
    ("footbridge", "loads.0.speed", 25.0, "", "in m/s, not in km/h"),
    ("footbridge", "loads.0.factors", [40.0, 10.0], "loads.0.factors.0", "40 per cent"),
    ("footbridge", "loads.1.phases", [90.0], "loads.1.phases.0", "in rad, not in degrees"),
    # Surface
    ("cars", "profile.amplitude", 2.0, "", "in m, not in mm"),
    ("cars", "profile.amplitude", 0.5, "", "in m, not in mm"),
    ("cars", "profile.wavelength", 40e3, "", "in m, not in mm"),
    ("cars", "profile.phase", 90.0, "", "in rad, not in degrees"),
    ("cars", "profile", dict(kind="bump", start=1.0, end=2.0, height=30.0), ".height", "in mm"),
    (
        "cars",
        "profile",
        {"kind": "table", "positions": [-9.0, 5.0, 45.0], "point_heights": [0.0, 5.0, 0.0]},
        ".point_heights",
        "in m, not in mm",
    ),
    # Track of layers
    ("track", "track.sleeper_spacing", 600.0, "", "in m, not in mm"),
    ("track", "track.sleeper_mass", 0.251, "", "in kg, not in t"),
    (
        "track",
        "track.rail_mass",
        0.1213,
        "track.sleeper_mass",
        "track.rail_mass in kg/m, not in t/m",
    ),
    ("track", "track.pad_stiffness", 65e3, "", "in N/m, not in kN/m"),
    ("track", "track.ballast_stiffness", 137.75, "", "in N/m, not in kN/m or MN/m"),
    ("track", "track.pad_damping", 75.0, "", "in N s/m, not in kN s/m"),
    ("track", "track.ballast_damping", 58.8, "", "in N s/m, not in kN s/m"),
    # Actuators
    ("rig", "actuators.0.d33", 400.0, "", "in m/V, not in pm/V"),
    ("rig", "actuators.0.modulus", 30.0, "", "in Pa, not in GPa"),
    ("rig", "actuators.0.electrode_spacing", 0.5, "", "in m, not in mm"),
    ("rig", "actuators.0.patch_width", 28.0, "", "in m, not in mm"),
    ("rig", "actuators.0.patch_height", 0.3, "", "in m, not in mm"),
    ("rig", "actuators.0.beam_height", 3.0, "", "in m, not in mm"),
    ("rig", "actuators.0.correction", 80.0, "", "0.8 for 80 per cent"),
    ("rig", "actuators.0.limits", [1.0, 5.0], "", "smallest and the largest command"),
    ("rig", "actuators.1.limits", [-5.0, -1.0], "", "smallest and the largest command"),
    ("rig", "actuators.0.added_mass", 500.0, "", "in kg/m"),
    ("rig", "actuators.0.added_rigidity", 2e3, "", "in N m^2"),
    ("rig", "actuators.1.force_per_volt", 4.6e3, "", "in N/V"),
    ("rig", "actuators.1.bandwidth", 10.0, "", "in 1/s, 2 pi times the frequency in Hz"),
    ("rig", "actuators.1.position", 0.0, "", "Move it into a span"),
    ("rig", "actuators.2.position", 0.6, "", "Move it into a span"),
    ("rig", "actuators.2.limits", [-5e3, 5e3], "", "in N"),
    # Sensors
    ("rig", "sensors.0.noise", 0.01, "", "in m, not in mm"),
    ("rig", "sensors.0.resolution", 0.01, "", "in m, not in mm"),
    ("rig", "sensors.0.delay", 2.0, "", "in s, not in ms"),
    ("rig", "sensors.0.delay", 1.0, "", "in s, not in ms"),
    ("rig", "sensors.1.fibre_distance", 1.5, "", "in m, not in mm"),
    ("rig", "sensors.1.noise", 1.0, "", "in m/m, not in 1e-6"),
    ("rig", "sensors.0.filter", {"cutoff": 0.05}, ".cutoff", "in Hz, not in kHz"),
    ("rig", "sensors.2.section_modulus", 75.0, "", "in m^3, not in cm^3 or mm^3"),
    ("rig", "sensors.0.offset", 3.0, "", "in m, not in mm"),
    # Controller
    ("rig", "controller.period", 0.05, "", "in s, not in ms"),
    ("rig", "controller.delay", 1.5, "", "in s, not in ms"),
    ("rig", "controller.delay", 0.5, "", "in s, not in ms"),
    (
        "rig",
        "controller",
        {
            "kind": "lqr",
            "state_weight": [1e4, 1e4, 1e4, 1.0, 1.0, 1.0, 0.0],
            "command_weight": [1e-3, 1e-3, 1e-3],
            "period": 0.002,
            "estimator": {
                "kind": "kalman",
                "process_noise": 0.02,
                "measurement_noise": [0.01, 1e-6, 1e3],
            },
        },
        ".estimator.measurement_noise.0",
        "in m, not in mm",
    ),
]


@pytest.mark.parametrize("base", BASES)
def test_cases_to_begin_with_look_right(base):
    assert jb.check(parsed(BASES[base])).warnings == ()


@pytest.mark.parametrize(
    ("base", "entry", "value", "named", "unit"),
    MISTAKES,
    ids=[f"{base}-{entry}-{i}" for i, (base, entry, *_) in enumerate(MISTAKES)],
)
def test_mistakes_are_named_with_their_unit(base, entry, value, named, unit):
    """One sentence names the entry, or what follows from it, and how to mend it."""
    case = changed(parsed(BASES[base]), entry, value)
    address = named if named and not named.startswith(".") else entry + named
    found = jb.check(case).warnings
    assert any(one.startswith(f"{address}: ") and unit in one for one in found), (found, address)
    assert len(found) <= 2, found  # one mistake, told once


REFUSED = [
    ("bridge", "sensors.0.position", 12500.0, "in m, not in mm"),
    ("bridge", "supports.0", {"position": 12500.0}, "in m, not in mm"),
    ("rig", "actuators.1.position", 300.0, "in m, not in mm"),
    ("rig", "actuators.0.start", 250.0, "in m, not in mm"),
    ("rig", "actuators.0.start", 0.36, "must lie to the right"),
    ("rig", "actuators.1.limits", [4.0, -4.0], "must be above the entry before it"),
    ("bridge", "loads.0.speed", 0.0, "must not be 0"),
    ("bridge", "beam.damping_ratio", -0.01, "must not be negative"),
    ("bridge", "loads.0.mass", -30e3, "must not be negative"),
    ("bridge", "beam.length", 0.0, "must be positive"),
    ("bridge", "loads.0.start_position", 5.0, "give a negative one"),
    ("rig", "controller.period", 10.0, "must not exceed the run's duration"),
    ("cars", "loads.1.axle_positions", [-2.4, 2.4], "list the axles front first"),
    ("railway", "loads.1.offsets", [3.0, 6.0, 14.0, 17.0], "must begin with 0"),
    ("railway", "loads.2.spacing", 0.2, "must exceed the wheelbase"),
    ("railway", "loads.0.wheelset_distance", 25.0, "distance between bogie centres"),
    ("footbridge", "loads.0.pace", 0.5, "must exceed"),
]


@pytest.mark.parametrize(("base", "entry", "value", "words"), REFUSED)
def test_what_makes_no_sense_is_refused(base, entry, value, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        jb.check(changed(parsed(BASES[base]), entry, value))


def changed(case: jb.Case, entry: str, value) -> jb.Case:
    """The case with another value, list or table at an entry."""
    content, (*path, last) = case_to_dict(case), entry.split(".")
    content.setdefault(path[0] if path else last, [])
    node = content
    for key in path:
        node = node[int(key)] if isinstance(node, list) else node[key]
    if isinstance(node, list) and int(last) == len(node):
        node.append(value)
    elif isinstance(node, list):
        node[int(last)] = value
    else:
        node[last] = value
    return case_from_dict(content)


def test_absorbers_and_foundations_of_use_look_right():
    absorber = jb.Absorber(12.5, mass=2e3, stiffness=1e6, damping=3e3)
    free_of_ground = jb.Absorber(12.5, ground_inertance=2e3, stiffness=1e6, damping=3e3)
    for case in (
        bridge(absorbers=[absorber, free_of_ground]),
        bridge(beam={"foundation_stiffness": 5e6}),
        bridge(beam={"foundation_stiffness": 5e7}),
    ):
        assert jb.check(case).warnings == ()


def test_a_spring_between_wheel_and_rail_looks_right():
    assert jb.check(changed(parsed(BASES["bridge"]), "contact", HERTZ)).warnings == ()


def test_an_eccentricity_in_millimetres_is_noticed():
    box = {"torsional_rigidity": 2e10, "polar_inertia": 4e4}
    assert jb.check(bridge(box, load={"eccentricity": -2.0})).warnings == ()
    (sentence,) = jb.check(bridge(box, load={"eccentricity": -2e3})).warnings
    assert sentence.startswith("loads.0.eccentricity: ") and "in m, not in mm" in sentence


def test_soft_springs_beside_each_other_do_not_clamp():
    springs = [jb.Support(position=x, stiffness=1e7) for x in (10.0, 10.01)]
    assert jb.check(bridge(supports=springs)).warnings == ()


def test_beams_that_are_not_held_and_cases_without_loads():
    free = jb.Case(jb.Beam(**BRIDGE | {"ends": "free-free"}), sensors=[jb.Sensor(position=1.0)])
    found = jb.check(free)
    assert (found.deflection, found.own_deflection, found.mass_ratio) == (None, None, None)
    first = 4.730040744862704**2 / (2 * math.pi) / 25.0**2 * math.sqrt(30e9 / 15e3)
    assert found.first_frequency == pytest.approx(first, rel=1e-6)
    assert found.warnings == ()


def test_a_filter_of_a_beam_that_no_load_leaves_looks_right():
    """Its cutoff is judged by the crossings of loads, of which there are none."""
    sensors = [jb.Sensor(position=12.5, filter=jb.Filter(20.0))]
    load = jb.VaryingForce(force=3e5, frequencies=[2.0], amplitudes=[1e4], position=12.5)
    case = dataclasses.replace(bridge(sensors=sensors), loads=(load,))
    assert jb.check(case).warnings == ()


def test_a_run_without_a_load_on_the_beam_is_not_praised():
    record = jb.simulate(bridge(load={"entry_time": 10.0}, run={"duration": 4.0}))
    assert record.verdict.startswith("no load is on the beam during the run")
    assert np.all(record.deflection == 0)


def test_runs_after_a_right_one_of_like_numbers_are_judged_too():
    """Crossings of 1.5 s, in runs of 1.9 s and of 1.2 s, which peaks may miss."""
    load = jb.MovingForce(force=1e5, speed=20.0)
    right, cut = (
        jb.Case(jb.Beam(30.0, 3e10, 1e4), loads=[load], run=jb.Run(end, 50.0)) for end in (1.9, 1.2)
    )
    jb.simulate(right)
    with pytest.warns(PlausibilityWarning, match="it has not left the beam by the end of the run"):
        jb.simulate(cut)


IN_KILONEWTONS = {"flexural_rigidity": 30e6}


@pytest.mark.parametrize("name", ["modes", "simulate", "sweep", "assess", "load_case"])
def test_functions_warn_before_they_work(name, tmp_path):
    """Each sentence once, at the address, of whatever the function uses."""
    case = bridge(beam=IN_KILONEWTONS)
    jb.save_case(case, tmp_path / "case.toml")
    work = {
        "modes": lambda: jb.modes(case),
        "simulate": lambda: jb.simulate(case),
        "sweep": lambda: jb.sweep(case, {"loads.0.speed": [20.0, 25.0]}, progress=False),
        "assess": lambda: jb.assess(case, "160 km/h", dynamic=False),
        "load_case": lambda: jb.load_case(tmp_path / "case.toml"),
    }
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("default")
        work[name]()
    said = [str(one.message) for one in shown if one.category is PlausibilityWarning]
    assert len(said) == len(set(said)) > 0
    assert said[0].startswith("beam.flexural_rigidity: the beam sags by")


def test_fits_and_tuning_warn_before_they_work(monkeypatch):
    import tuning

    case = bridge(beam=IN_KILONEWTONS, controller=jb.Feedback(gains=[1.0], period=0.01))
    case = jb.Case(**vars(case) | {"actuators": (jb.PointForce(10.0, limits=(-1e3, 1e3)),)})
    log = tuning.Log(np.arange(5.0), np.ones((5, 1)), ("w",), ("deflection",), ("m",), "log", (0,))
    loads = tuning.LoadCases(({"loads.0.mass": 2e4},), ({"loads.0.mass": 3e4},))
    with warnings.catch_warnings():
        warnings.simplefilter("error", PlausibilityWarning)
        with pytest.raises(PlausibilityWarning, match="not in kN m"):
            tuning.identify(case, [log], "beam.flexural_rigidity")
        with pytest.raises(PlausibilityWarning, match="not in kN m"):
            tuning.tune(case, {"controller.gains.0": (0.0, 1.0)}, loads, progress=False)


def test_a_sweep_is_judged_at_its_ends():
    case = bridge()
    with pytest.warns(PlausibilityWarning, match=r"loads.0.speed: 200 m/s is 720 km/h"):
        jb.sweep(case, {"loads.0.speed": [20.0, 200.0]}, progress=False)


def test_a_sweep_is_not_judged_by_a_part_that_suits_other_runs():
    """A point force of 46 N bends too far beside the lightest mass, not beside the heaviest."""
    beam = jb.Beam(0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    case = jb.Case(
        beam,
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.5, speed=2.0)],
        actuators=[jb.PointForce(0.3, limits=(-46.0, 46.0))],
        run=jb.Run(0.5),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", PlausibilityWarning)
        jb.sweep(case, {"loads.0.mass": [0.05, 0.5]}, progress=False)
    with pytest.warns(PlausibilityWarning, match="actuators.0.* times as far as its loads do"):
        jb.sweep(
            with_settings(case, {"loads.0.mass": 0.02}),
            {"loads.*.mass": [0.01, 0.03]},
            progress=False,
        )


def test_traced_numbers_are_not_judged():
    """Under jit, vmap and grad nothing fails; concrete numbers under grad are judged."""
    case = bridge(beam=IN_KILONEWTONS)

    def first(rigidity):
        beam = dataclasses.replace(case.beam, flexural_rigidity=rigidity)
        return jb.modes(jb.Case(beam), layout=mesh_layout(case)).frequencies[0]

    with warnings.catch_warnings():
        warnings.simplefilter("error", PlausibilityWarning)
        assert jax.jit(first)(30e6) > 0
        assert jax.vmap(first)(np.array([30e6, 31e6])).shape == (2,)
    with pytest.warns(PlausibilityWarning, match="not in kN m"):
        jax.grad(first)(30e6)


def test_hundreds_of_modes_are_judged_by_the_first():
    found = jb.check(bridge(beam={"modes": 300}))
    assert found.warnings == ()
    assert found.deflection == pytest.approx(30e3 * 9.81 * 25.0**3 / 48 / 30e9, rel=1e-5)
