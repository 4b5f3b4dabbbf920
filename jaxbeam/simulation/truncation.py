"""What the modes that a run leaves out change of what its sensors measure."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.layout import is_uniform
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.output_rows import sensor_history
from jaxbeam.model.static_correction import Motion, corrected_history
from jaxbeam.runtime.arrays import Array, xp

LEFT_OUT = 3  # highest modes whose dynamic part estimates that of all modes beyond
MAX_SAMPLES = 400  # of a record from which the errors are estimated


@np.errstate(all="ignore")  # of extreme numbers
def truncation_errors(case: Case, modes: Modes, motion: Motion) -> Float[Array, " sensor"]:
    """Estimated truncation error of the quantity of each sensor, relative to its largest value.

    From the samples of a run. Of a deflection or rotation, the largest part that the static
    correction would add. Of others, the largest change with the dynamic part of the three highest
    modes left out, which exceeds that of all higher modes where their contributions fall;
    accelerations under point forces do not converge, and their modes are a convention. NaN for
    those of a case with one mode, and for slopes of a beam that is not uniform.
    """
    errors = []
    fewer = _with_fewer_modes(case, modes, motion)
    for sensor in case.sensors:
        full = sensor_history(case, modes, motion, sensor)
        quantity = QUANTITIES[sensor.quantity]
        if quantity.of_axis and not is_uniform(case):
            other = full * xp.nan
        elif quantity.time_derivative == 0 and not quantity.bends:
            other = corrected_history(case, modes, motion, sensor.position, quantity.x_derivative)
        else:
            other = full * xp.nan if fewer is None else sensor_history(*fewer, sensor)
        largest = xp.max(xp.abs(full))
        change = xp.max(xp.abs(full - other))
        errors.append(xp.where(largest > 0, change / xp.where(largest > 0, largest, 1.0), 0.0))
    return xp.array(errors).reshape(-1)


def _with_fewer_modes(
    case: Case, modes: Modes, motion: Motion
) -> tuple[Case, Modes, Motion] | None:
    """A run without its highest modes; None with one mode."""
    count = case.beam.modes
    kept = count - min(LEFT_OUT, count - 1)
    if kept == count:
        return None
    beam = dataclasses.replace(case.beam, modes=kept, damping_ratio=_of_lowest(case.beam, kept))
    amplitudes = {name: getattr(motion, name)[:, :kept] for name in Motion._fields[:3]}
    fewer = motion._replace(**amplitudes)
    return dataclasses.replace(case, beam=beam), modes.lowest(kept), fewer


def _of_lowest(beam, count: int):
    """Damping ratios of the lowest modes: one for all, or a list."""
    ratio = beam.damping_ratio
    return ratio[:count] if np.ndim(ratio) else ratio
