"""Variables of records and sweeps in datasets: dimensions, unit and meaning, by name."""

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import sensor_labels

VARIABLES = {
    "deflection": (("time", "sensor"), "m", "deflection at the sensor"),
    "velocity": (("time", "sensor"), "m/s", "velocity at the sensor"),
    "acceleration": (("time", "sensor"), "m/s^2", "acceleration at the sensor"),
    "measured": (("time", "sensor"), "SI unit of its quantity", "reading of the sensor"),
    "coordinates": (("time", "mode"), "m kg^0.5", "modal coordinate"),
    "rates": (("time", "mode"), "m kg^0.5/s", "rate of the modal coordinate"),
    "accelerations": (("time", "mode"), "m kg^0.5/s^2", "acceleration of the modal coordinate"),
    "load_position": (("time", "load"), "m", "position of the wheel"),
    "contact_force": (("time", "load"), "N", "contact force, positive under compression"),
    "command": (("time", "actuator"), "unit of a command", "command to the actuator"),
    "failures": (("time",), "1", "steps of the controller without a solution so far"),
    "smallest": (("sensor",), "SI unit of its quantity", "smallest value of its quantity"),
    "smallest_time": (("sensor",), "s", "time of the smallest value"),
    "largest": (("sensor",), "SI unit of its quantity", "largest value of its quantity"),
    "largest_time": (("sensor",), "s", "time of the largest value"),
    "peak_deflection": (("sensor",), "m", "largest absolute deflection at the sensor"),
    "peak_time": (("sensor",), "s", "time of the largest absolute deflection at the sensor"),
    "step_errors": (("sensor",), "1", "estimated error of the time steps, of the largest value"),
    "lowest_contact_force": (("load",), "N", "smallest contact force"),
    "contact_lost_time": (("load",), "s", "time of the first negative contact force"),
    "contact_lost_position": (("load",), "m", "position of the first negative contact force"),
    "body_displacement": (("time", "body"), "m or rad", "displacement from static equilibrium"),
    "body_velocity": (("time", "body"), "m/s or rad/s", "velocity of the body"),
    "body_acceleration": (("time", "body"), "m/s^2 or rad/s^2", "acceleration of the body"),
}
OF_ABSORBERS = {
    "stroke": (("time", "absorber"), "m", "motion of the absorber's body relative to the beam"),
    "absorber_force": (("time", "absorber"), "N", "force on the beam, positive downwards"),
    "absorber_energy": (("time", "absorber"), "J", "energy dissipated so far"),
}
# Where an actuator has a hysteresis or creep.
ACTING_COMMAND = (("time", "actuator"), "unit of a command", "command that acts on the beam")
# Variables of a run in a sweep; the dimensions of the sweep come first.
SWEEP_VARIABLES = VARIABLES | {
    "controller_failures": ((), "1", "steps at which the controller found no solution")
}

# Variables of the modes in records, with names that begin with mode_.
MODE_VARIABLES = {
    "stiffness": (("mode",), "1/s^2", "stiffness of the mode"),
    "damping": (("mode",), "1/s", "damping of the mode"),
    "coupling": (("mode", "other_mode"), "1/s^2", "stiffness between repeated modes"),
    "damping_coupling": (("mode", "other_mode"), "1/s", "damping between repeated modes"),
    "nodes": (("node",), "m", "ends of the segments of the mode shapes"),
    "series": (("segment", "degree", "mode"), "kg^-0.5", "Chebyshev series of the mode shapes"),
    "unit": ((), "1/s^2", "flexural rigidity / (mass per length x length^4)"),
}
# Of the modes of a beam that is flexible in shear too.
ROTATION_SERIES = (
    ("segment", "degree", "mode"),
    "m^-1 kg^-0.5",
    "Chebyshev series of the rotations of the modes",
)
# Fields of `Modes` by their names in files, where they differ.
MODE_FIELDS = {"unit": "stiffness_unit"}


def sensor_coordinates(case: Case) -> dict[str, tuple]:
    """Coordinates of datasets along their sensors: labels, quantities and their units."""
    sensors = case.sensors
    return {
        "sensor": ("sensor", np.array(sensor_labels(sensors), str)),
        "quantity": ("sensor", np.array([s.quantity for s in sensors], str)),
        "unit": ("sensor", np.array([s.unit for s in sensors], str)),
    }
