"""Histories of a record as columns of a table, with quantity, sensor and unit in their heads."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbeam.simulation.labels import wheel_labels

if TYPE_CHECKING:
    from jaxbeam.case.case import Case


def record_columns(
    case: "Case", times, sensor_values, contact_force, command
) -> dict[str, Float[np.ndarray, " time"]]:
    """Columns by head: time, what each sensor measures, contact forces of wheels, commands.

    `sensor_values` (time, sensor) and `command` (time, actuator) are in the units of their sensors
    and actuators, `contact_force` (time, load) in N.
    """
    columns = {"time (s)": np.asarray(times)}
    for i, sensor in enumerate(case.sensors):
        head = f"{sensor.name or f'sensor {i}'} {sensor.quantity}{_in_brackets(sensor.unit)}"
        head = f"sensor {i} {head}" if head in columns else head  # of equal names
        columns[head] = sensor_values[:, i]
    for i, label in enumerate(wheel_labels(case)):
        columns[f"load {label} contact force (N)"] = contact_force[:, i]
    for i, actuator in enumerate(case.actuators):
        columns[f"actuator {i} command{_in_brackets(actuator.command_unit)}"] = command[:, i]
    return {head: np.asarray(column) for head, column in columns.items()}


def _in_brackets(unit: str) -> str:
    return "" if unit == "1" else f" ({unit})"
