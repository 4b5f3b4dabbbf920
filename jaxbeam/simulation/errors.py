"""Errors of what the sensors of a run measure: of its time steps, and of the modes left out."""

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import QUANTITIES, quantity_of
from jaxbeam.case.sensors import Sensor
from jaxbeam.integrator.step_size import UNSAMPLED, StepTrial
from jaxbeam.model.layout import is_uniform
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.mode_band import band_weights
from jaxbeam.model.sensing.output_rows import beside, modal_row, sensor_history
from jaxbeam.model.static_correction import Motion, corrected_history, is_supported
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

    Twice the largest change of the quantity as the steps of a trial are halved, under the same
    commands: it is larger at other times. NaN for a run that diverges.
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
        change = UNSAMPLED * xp.max(xp.abs(better - known))
        errors.append(_ratio(change, xp.max(xp.abs(better))))
    return xp.array(errors).reshape(-1)


@np.errstate(all="ignore")  # of extreme numbers
def truncation_errors(case: Case, modes: Modes, motion: Motion) -> Float[Array, " sensor"]:
    """Estimated truncation error of the quantity of each sensor, relative to its largest value.

    See `truncation_changes`.
    """
    values = (sensor_history(case, modes, motion, sensor) for sensor in case.sensors)
    largest = xp.array([xp.max(xp.abs(one)) for one in values]).reshape(-1)
    return _ratio(truncation_changes(case, modes, motion), largest)


@np.errstate(all="ignore")  # of extreme numbers
def truncation_changes(case: Case, modes: Modes, motion: Motion) -> Float[Array, " sensor"]:
    """Estimated truncation error of the quantity of each sensor, in its unit.

    From the samples of a run. Of a deflection or rotation, the largest part that the static
    correction would add. Of others, the largest part of the three highest modes, which exceeds that
    of all higher modes where their contributions fall: of what is statically corrected, their
    dynamic part, -(q'' + damping q') / stiffness. Accelerations under point forces do not converge,
    and their modes are a convention. NaN for those of a case with one mode, and for slopes of a
    beam that is not uniform.
    """
    changes = []
    for sensor in case.sensors:
        quantity = QUANTITIES[sensor.quantity]
        if quantity.of_axis and not is_uniform(case):
            change = xp.nan
        elif quantity.time_derivative == 0 and not quantity.bends:
            order = quantity.x_derivative
            change = corrected_history(case, modes, motion, sensor.position, order)
            change = change - sensor_history(case, modes, motion, sensor)
        elif case.beam.modes == 1:
            change = xp.nan
        else:
            change = _highest_modes(case, modes, motion, sensor)
        changes.append(xp.max(xp.abs(change)))
    return xp.array(changes).reshape(-1)


def _highest_modes(
    case: Case, modes: Modes, motion: Motion, sensor: Sensor
) -> Float[Array, " time"]:
    """Part of the LEFT_OUT highest modes, or of all but one, in what a sensor measures."""
    quantity = quantity_of(sensor.quantity, sensor.fibre_distance, sensor.section_modulus)
    highest = np.s_[max(1, case.beam.modes - LEFT_OUT) :]
    parameters = sensor.quantity, sensor.fibre_distance, sensor.section_modulus
    x = beside(case, sensor.position) if quantity.bends else sensor.position
    row = modal_row(modes.fields, case, x, *parameters) * band_weights(modes, sensor.mode_band)
    amplitudes = tuple(part[:, highest] for part in motion[:3])
    if quantity.bends and is_supported(case, modes.layout):
        _, rates, accelerations = amplitudes
        dynamic = -(accelerations + modes.damping[highest] * rates) / modes.stiffness[highest]
        return dynamic @ row[highest]
    return amplitudes[quantity.time_derivative] @ row[highest]


def _ratio(change, largest):
    """Change relative to the largest value; zero where that is."""
    return xp.where(largest == 0, 0.0, change / xp.where(largest == 0, 1.0, largest))
