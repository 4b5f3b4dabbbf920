"""Errors of what the sensors of a run measure: of its time steps, and of the modes left out."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.integrator.step_size import StepTrial
from jaxbeam.model.layout import is_uniform
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.output_rows import sensor_history
from jaxbeam.model.static_correction import Motion, corrected_history
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.simulation.motion.at_samples import motion_at

LEFT_OUT = 3  # highest modes whose dynamic part estimates that of all modes beyond
MAX_SAMPLES = 400  # of a run from which the errors are estimated


def chosen_samples(count: int) -> Int[np.ndarray, " sample"]:
    """Indices of at most MAX_SAMPLES of some samples, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, MAX_SAMPLES).astype(int))


@np.errstate(all="ignore")  # of extreme numbers, and of runs that diverge
def step_errors(case: Case, model: ModalModel, trial: StepTrial) -> Float[Array, " sensor"]:
    """Estimated error of the time steps in the quantity of each sensor, relative to its largest.

    Largest change of the quantity as the steps of a trial are halved, under the same commands. NaN
    for a run that diverges.
    """
    chosen, loads = chosen_samples(trial.times.size), load_set(case, model.modes.layout)
    times = trial.times[chosen]
    coarse, fine = (
        motion_at(case, model, loads, times, states[chosen])[0]
        for states in (trial.coarse, trial.fine)
    )
    errors = []
    for sensor in case.sensors:
        known, better = (sensor_history(case, model.modes, m, sensor) for m in (coarse, fine))
        errors.append(_relative_change(better, known))
    return xp.array(errors).reshape(-1)


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
        errors.append(_relative_change(full, other))
    return xp.array(errors).reshape(-1)


def _relative_change(values, others):
    """Largest difference of others, relative to the largest value; zero where all are zero."""
    largest, change = xp.max(xp.abs(values)), xp.max(xp.abs(values - others))
    return xp.where(largest == 0, 0.0, change / xp.where(largest == 0, 1.0, largest))


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
