"""Words of former versions, which are refused by a sentence that names the present ones."""

from collections.abc import Collection, Mapping
from typing import Any

NAMES = {  # of the package jaxbeam
    "Passage": "Feedforward",
    "Recognition": "LoadIdentification",
    "Relief": "InternalModel",
    "recognised": "identified_load",
    "Lead": "PD(lag=1 / p, rate_gains=gains / z - gains / p)",
    "DiscreteLQR": "LQR(sampling='exact')",
    "IntegralLQR": "LQR(sampling='exact', integral_weight=...)",
    "StepLQR": "LQR(horizon='frozen')",
    "FiniteLQR": "LQR(horizon='crossing')",
    "AugmentedLQR": "LQR(horizon='crossing', augmented='loads')",
    "ScheduledLQR": "LQR(horizon='crossing', schedule='load')",
    "PositionLQR": "LQR(horizon='crossing', schedule='positions')",
    "planar": "vehicles",
}
MOVED = {  # names of the package, each with the module in which it is now
    "RideMeasures": "ride",
    "ride_measures": "ride",
    "sperling_index": "ride",
    "vibration_dose": "ride",
    "weighted_acceleration": "ride",
    "weighted_rms": "ride",
    "wheel_unloading": "ride",
    "ReceptanceFeedback": "receptance_method",
    "closed_loop_poles": "receptance_method",
    "fit_receptances": "receptance_method",
    "receptance_feedback": "receptance_method",
    "receptance_gains": "receptance_method",
    "receptances": "receptance_method",
    "accelerance": "frequency_responses",
    "mobility": "frequency_responses",
    "receptance": "frequency_responses",
    "VehicleAxle": "vehicles",
    "VehicleBody": "vehicles",
    "VehicleHinge": "vehicles",
    "VehicleSensor": "vehicles",
    "VehicleSpring": "vehicles",
    "BumpProfile": "profiles",
    "ISO8608Profile": "profiles",
    "RailProfile": "profiles",
    "RampProfile": "profiles",
    "SineProfile": "profiles",
    "SpectrumProfile": "profiles",
    "StepProfile": "profiles",
    "TableProfile": "profiles",
    "Envelope": "sections",
    "amplification": "sections",
    "characteristic_points": "sections",
    "HalfCar": "vehicles",
    "Wagon": "vehicles",
    "TrainLoad": "vehicles",
    "VehicleLoad": "vehicles",
    "Coach": "vehicles",
    "load_vehicle": "vehicles",
    "CurrentLoop": "actuators",
    "ForceLoop": "actuators",
    "Creep": "actuators",
    "Hysteresis": "actuators",
    "static_peak": "statics",
    "settlement_response": "statics",
    "static_deflection": "statics",
    "bending_moment": "sections",
    "shear_force": "sections",
    "corrected_deflection": "sections",
    "sampling_limit": "control.sampled_lqr",
    "rayleigh_coefficients": "case.beam",
    "least_integral": "analysis.bound.least_integral",
    "coil_history": "analysis.sections",
    "profile_from_file": "files.case_file",
    "identified_load": "control.load_identification",
    "Assessment": "analysis.assessment.assessment",
    "CodeCheck": "analysis.assessment.assessment",
    "Plausibility": "model.plausibility.facts",
    "sweep_columns": "files.tables",
}
WORDS = {  # kinds and keys of case files, parts of addresses
    "passage": "feedforward",
    "relief": "internal-model",
    "recognition": "load_identification",
    "places": "positions",
    "place_weight": "position_weight",
    "reach": "max_delay_periods",
}
KINDS = {  # that are options of another kind
    "lead": (
        "pd",
        "lag = 1 / p and rate_gains = gains / z - gains / p (zero z and pole p in rad/s)",
    ),
    "dlqr": ("lqr", 'sampling = "exact"'),
    "lqr-integral": ("lqr", 'sampling = "exact"'),
    "lqr-step": ("lqr", 'horizon = "frozen"'),
    "lqr-finite": ("lqr", 'horizon = "crossing"'),
    "lqr-augmented": ("lqr", 'horizon = "crossing" and augmented = "loads"'),
    "lqr-scheduled": ("lqr", 'horizon = "crossing" and schedule = "load"'),
    "lqr-position": ("lqr", 'horizon = "crossing" and schedule = "positions"'),
}
# Words of case files that attributes in Python cannot have, and those that they have; both stay.
FILE_KEYS = {"class": "road_class", "heights": "point_heights"}


def with_attribute_names(
    address: str, table: Mapping[str, Any], allowed: Collection[str]
) -> dict[str, Any]:
    """A table of a case file with its keys as they are called in Python.

    A word that is among the allowed keys is left alone. Raises ValueError if both words are there.
    """
    values = {}
    for key, value in table.items():
        new = key if key in allowed else FILE_KEYS.get(key, key)
        if new not in allowed:
            new = key
        if new != key and new in table:
            raise ValueError(f"{address}.{key} is called {new} in Python; leave one of them out")
        values[new] = value
    return values


def attribute_address(address: str) -> str:
    """An address in a case with the words of attributes in Python."""
    return ".".join(FILE_KEYS.get(name, name) for name in address.split("."))


def present_address(address: str) -> str:
    """An address with the present words in place of former ones."""
    return ".".join(WORDS.get(name, name) for name in address.split("."))
