"""Runs without control: each public function is a case."""

import jaxbeam as jb
from experiments.validation.same_results.arrays import Arrays, named, of_record
from experiments.validation.same_results.parts import BEAM, MASS, MIDSPAN, RUN, read


def bare_mass() -> Arrays:
    """A mass on one span, then so fast that it loses contact; sensors of most quantities."""
    sensors = """
[[sensors]]
position = 0.15
noise = 1e-6
resolution = 1e-6
[[sensors]]
position = 0.3
quantity = "velocity"
filter = { cutoff = 40.0, order = 3 }
[[sensors]]
position = 0.45
quantity = "strain"
fibre_distance = 0.0015
[[sensors]]
position = 0.3
quantity = "acceleration"
delay = 0.004
"""
    slow = read(BEAM, sensors, MASS, RUN)
    fast = jb.replace(slow, {"loads.0.mass": 1.5, "loads.0.speed": 9.0})
    return named(slow=of_record(jb.simulate(slow)), fast=of_record(jb.simulate(fast)))


def several_loads() -> Arrays:
    """Masses and a braking force, from both ends, on two spans with a damped elastic support."""
    structure = """
[beam]
length = 1.2
width = 0.1
height = 0.00283
youngs_modulus = 6.5e10
density = 2800.0
rayleigh_damping = [1.0, 2e-5]
ends = "clamped-pinned"
modes = 6
[[supports]]
position = 0.6
stiffness = 2.0e5
damping = 30.0
rotational_stiffness = 5.0
[[sensors]]
position = 0.3
[[sensors]]
position = 0.9
quantity = "slope"
"""
    loads = """
[[loads]]
kind = "force"
mass = 0.3
speed = 1.8
entry_time = 0.2
deceleration = 0.4
[[loads]]
kind = "mass"
mass = 0.2
speed = -1.5
entry_time = 0.3
"""
    run = "[run]\nduration = 1.4\nsample_rate = 200.0\n"
    return of_record(jb.simulate(read(structure, MASS, loads, run)))


def table_of_positions() -> Arrays:
    """A mass that follows a table of positions, there and back, over a free end and a spring."""
    structure = """
[beam]
length = 0.6
flexural_rigidity = 11.68
mass_per_length = 0.535
damping_ratio = [0.03, 0.02, 0.025, 0.02]
ends = "clamped-free"
modes = 4
[[actuators]]
kind = "spring"
position = 0.55
stiffness = 4000.0
damping = 2.0
[[loads]]
kind = "mass"
mass = 0.25
times = [0.05, 0.2, 0.35, 0.45, 0.7]
positions = [0.0, 0.2, 0.41, 0.4, 0.05]
"""
    return of_record(jb.simulate(read(structure, MIDSPAN, RUN)))
