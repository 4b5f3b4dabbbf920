"""Share by which the modes that a case leaves out change what its sensors measure."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.sensing.output_rows import quantity_history
from jaxbeam.model.static_correction import Motion, corrected_history
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.simulation.record import Record

LEFT_OUT = 2  # highest modes whose dynamic part estimates that of all modes beyond


def truncation_errors(record: Record) -> Float[Array, " sensor"]:
    """Estimated truncation error of the quantity of each sensor, relative to its largest value.

    From the samples of a record. Of a deflection or rotation, the largest part that the static
    correction would add. Of others, the largest change with the dynamic part of the two highest
    modes left out, which is more than that of all higher modes where their contributions fall;
    accelerations under point forces do not converge, and their modes are a convention. NaN for
    those of a case with one mode, and of a beam that can move as a rigid body.
    """
    errors = []
    for sensor in record.case.sensors:
        full = _history(record, sensor)
        quantity = QUANTITIES[sensor.quantity]
        if quantity.time_derivative == 0 and not quantity.bends:
            parts = record.case, record.modes, record.motion, sensor.position
            other = corrected_history(*parts, quantity.x_derivative)
        else:
            fewer = _with_fewer_modes(record)
            other = full * xp.nan if fewer is None else _history(fewer, sensor)
        largest = xp.max(xp.abs(full))
        change = xp.max(xp.abs(full - other))
        errors.append(xp.where(largest > 0, change / xp.where(largest > 0, largest, 1.0), 0.0))
    return xp.array(errors).reshape(-1)


def _history(record: Record, sensor: Sensor):
    channel = sensor.position, sensor.quantity, sensor.fibre_distance, sensor.section_modulus
    return quantity_history(record.case, record.modes, record.motion, *channel)


def _with_fewer_modes(record: Record) -> Record | None:
    """The record without its highest modes; None with one mode."""
    case, count = record.case, record.case.beam.modes
    kept = count - min(LEFT_OUT, count - 1)
    if kept == count:
        return None
    beam = dataclasses.replace(case.beam, modes=kept, damping_ratio=_of_lowest(case.beam, kept))
    amplitudes = {name: getattr(record, name)[:, :kept] for name in Motion._fields[:3]}
    return dataclasses.replace(
        record,
        case=dataclasses.replace(case, beam=beam),
        modes=record.modes.lowest(kept),
        **amplitudes,
    )


def _of_lowest(beam, count: int):
    """Damping ratios of the lowest modes: one for all, or a list."""
    ratio = beam.damping_ratio
    return ratio[:count] if np.ndim(ratio) else ratio
