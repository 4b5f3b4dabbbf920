"""Parts of the labelled dataset of a record: variables, coordinates, attributes."""

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.model.modes import Modes
from jaxbeam.simulation.labels import wheel_labels
from jaxbeam.simulation.result_variables import (
    ACTING_COMMAND,
    MODE_FIELDS,
    MODE_VARIABLES,
    OF_ABSORBERS,
    ROTATION_SERIES,
    VARIABLES,
    sensor_coordinates,
)


def dataset_parts(
    case: Case, modes: Modes, times, bodies: Sequence[str], value: Callable[[str], Any]
) -> tuple[dict, dict, dict]:
    """Variables, coordinates and attributes of the dataset of a record.

    `bodies` are names of degrees of freedom of vehicles; `value` returns what the record has under
    the name of a variable or attribute.
    """
    variables = {
        name: (dims, np.asarray(value(name)), {"units": unit, "long_name": words})
        for name, (dims, unit, words) in VARIABLES.items()
    }
    supports, reactions = np.asarray(value("support_positions")), np.asarray(value("reactions"))
    if supports.size:
        labels = {"units": "N", "long_name": "reaction of the support, positive upwards"}
        variables["reaction"] = (("time", "support"), reactions, labels)
    if case.absorbers:
        variables |= {
            name: (dims, np.asarray(value(name)), {"units": unit, "long_name": words})
            for name, (dims, unit, words) in OF_ABSORBERS.items()
        }
    # Modes of repeated frequencies are not unique, so they are stored.
    variables |= {
        f"mode_{name}": (
            dims,
            np.asarray(getattr(modes, MODE_FIELDS.get(name, name))),
            {"units": unit, "long_name": words},
        )
        for name, (dims, unit, words) in MODE_VARIABLES.items()
    }
    if modes.rotation_series is not None:
        dims, unit, words = ROTATION_SERIES
        labels = {"units": unit, "long_name": words}
        variables["mode_rotation_series"] = (dims, np.asarray(modes.rotation_series), labels)
    if (acting := value("acting_command")) is not None:
        dims, unit, words = ACTING_COMMAND
        labels = {"units": unit, "long_name": words}
        variables["acting_command"] = (dims, np.asarray(acting), labels)
    coordinates = {
        "time": ("time", np.asarray(times), {"units": "s"}),
        **sensor_coordinates(case),
        "load": ("load", wheel_labels(case)),
        "body": ("body", np.array(bodies, dtype=str)),
        **({"support": ("support", supports, {"units": "m"})} if supports.size else {}),
        "frequency": ("mode", np.asarray(modes.frequencies), {"units": "Hz"}),
    }
    attributes = {
        "title": case.title,
        "case": json.dumps(case_to_dict(case)),
        "error_estimate": float(value("error_estimate")),
        **({} if value("result") is None else {"result": int(value("result"))}),
        "steps": value("steps"),
        "verdict": value("verdict"),
    }
    return variables, coordinates, attributes
