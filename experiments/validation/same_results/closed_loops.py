"""Runs under control: each public function is a case."""

import numpy as np

import jaxbeam as jb
from experiments.validation.same_results.arrays import Arrays, named, of_record
from experiments.validation.same_results.parts import (
    BEAM,
    MASS,
    MIDSPAN,
    PATCH,
    PATCH_BEAM,
    RUN,
    SHAKER,
    TWO_SPANS,
    first_of,
    read,
    word,
)


def sampled_feedback_of_a_shaker() -> Arrays:
    """Sampled feedback with delay, resolution, noise and filter; a shaker with a coil beside it."""
    parts = """
[[actuators]]
kind = "electrodynamic"
position = 0.25
resistance = 3.0
inductance = 2e-3
force_constant = 5.0
mass = 0.02
stiffness = 900.0
damping = 1.0
[[sensors]]
position = 0.5
noise = 1e-6
filter = { cutoff = 60.0, order = 2 }
[[sensors]]
position = 0.25
delay = 0.002
[controller]
kind = "feedback"
gains = [300.0, 150.0]
period = 0.004
delay = 0.006
resolution = 0.01
"""
    return of_record(jb.simulate(read(BEAM, SHAKER, parts, MASS, RUN)))


def regulator_behind_a_kalman_filter() -> Arrays:
    """A patch under LQR with another design model; the filter estimates the load too."""
    law = """
[[sensors]]
position = 0.13
[controller]
kind = "lqr"
state_weight = [1e3, 1e2, 1e1, 1e-1, 1e-2, 1e-3]
command_weight = [1e-6]
period = 0.004
delay = 0.002
design = { correction = 0.3 }
[controller.estimator]
kind = "kalman"
process_noise = 0.02
measurement_noise = 1e-5
loads = "estimated"
weight_deviation = 2.0
"""
    return of_record(jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, law, RUN)))


def regulator_over_the_crossing() -> Arrays:
    """A continuous finite-horizon regulator with feedforward of the load, and its filter."""
    beam = BEAM.replace("modes = 3", "modes = 2")
    law = """
[[sensors]]
position = 0.45
[controller]
kind = "lqr-augmented"
state_weight = [1e3, 1e2, 0.1, 0.01, 0.0]
command_weight = [9e-5]
coordinates = "sine"
points = 210
after = "fade"
fade_time = 0.1
[controller.estimator]
kind = "kalman"
process_noise = 0.02
measurement_intensity = 1e-12
loads = "known"
"""
    return of_record(jb.simulate(read(beam, SHAKER, MIDSPAN, law, MASS, RUN)))


def predictive_control() -> Arrays:
    """MPC within limits: with known loads along their path and a soft limit, and without loads."""
    law = """
[controller]
kind = "mpc"
horizon = 6
moves = 3
move_weight = 1e-11
loads = "known"
prediction = "time-varying"
soft_limit = [3e-4]
period = 0.01
delay = 0.005
"""
    plain = """
[controller]
kind = "mpc"
horizon = 8
moves = 3
move_weight = 1e-11
laguerre_pole = 0.4
terminal = "riccati"
solver = "hildreth"
period = 0.01
"""
    return named(
        known=of_record(jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, law, RUN))),
        ignored=of_record(jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, plain, RUN))),
    )


def feedforward_by_position() -> Arrays:
    """Commands tabulated over the positions of two loads that pass gates."""
    law = f"""
[[loads]]
kind = "mass"
mass = 0.3
speed = 0.9
entry_time = 0.25
[controller]
kind = "{word("feedforward", "passage")}"
gates = [-0.04, -0.02]
shares = [0.0, 0.2, 0.7, 1.0]
values = [[0.5, 6.0, 4.0, 1.0]]
lead = 0.02
period = 0.01
delay = 0.02
resolution = 0.01
"""
    return of_record(jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, law, RUN)))


def internal_model_control() -> Arrays:
    """Commands over readings without their own effect, behind a filter and notches."""
    law = f"""
[[sensors]]
position = 0.3
noise = 4e-6
filter = {{ cutoff = 20.0, order = 4 }}
[controller]
kind = "{word("internal-model", "relief")}"
readings = [-4e-4, -1e-4, 0.0, 2e-4]
values = [[7.0, 3.0, 0.0, -2.0]]
compensation = 0.9
notches = [19.0]
notch_damping = 0.4
period = 0.01
delay = 0.02
"""
    return of_record(jb.simulate(read(PATCH_BEAM, PATCH, MASS, law, RUN)))


def load_identification() -> Arrays:
    """Gains scheduled over the mass that gates, or deflections alone, identify."""
    settings = word("load_identification", "recognition")
    arrays: Arrays = {}
    kinds = {"gates": "gates = [-0.04, -0.02], until = 0.3", "threshold": "threshold = 2e-5"}
    for name, kind in kinds.items():
        law = f"""
[[sensors]]
position = 0.15
[controller]
kind = "feedback-scheduled"
masses = [0.1, 0.4, 0.8]
gains = [[4000.0, 3000.0, 2000.0]]
period = 0.004
{settings} = {{ {kind} }}
"""
        # With a sample at every sampling instant, so that the identification can be repeated.
        record = jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, law, RUN))
        controller = record.case.controller
        identification = first_of(controller, "load_identification", "recognition")
        identify = first_of(jb, "identified_load", "recognised")
        arrays |= named(**{name: of_record(record)})
        arrays[f"{name}.identified"] = np.array(tuple(identify(record, identification)))
    return arrays


def positive_position_feedback() -> Arrays:
    """Sampled positive position feedback, and a continuous PD with a lag."""
    ppf = """
[controller]
kind = "ppf"
gains = [4000.0]
frequency = 17.0
damping_ratio = 0.3
period = 0.004
"""
    rate = """
[controller]
kind = "pd"
gains = [2000.0]
rate_gains = [30.0]
lag = [0.004]
"""
    return named(
        ppf=of_record(jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, ppf, RUN))),
        pd=of_record(jb.simulate(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, rate, RUN))),
    )


def law_at_every_instant() -> Arrays:
    """A continuous polynomial of the deflection, behind an analogue filter, on two spans."""
    second = PATCH.replace("0.2575", "0.8575").replace("0.3425", "0.9425")
    law = """
[[sensors]]
position = 0.3
filter = { cutoff = 30.0, order = 3, realisation = "analogue" }
[[sensors]]
position = 0.9
[controller]
kind = "feedback"
gains = [500.0, 400.0]
higher_gains = [[2.0e9, 1.0e9]]
"""
    run = "[run]\nduration = 1.2\nsample_rate = 200.0\n"
    return of_record(jb.simulate(read(TWO_SPANS, PATCH, second, MASS, law, run)))
