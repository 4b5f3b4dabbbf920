"""Errors of the sensors' quantities in a run: of time steps, of peaks, of the modes left out."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import QUANTITIES, TWIST, Sensor, quantity_of
from jaxbeam.model.elements import is_uniform
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.output_rows import band_weights, place_of, sensor_history, sensor_row
from jaxbeam.model.static_correction import Motion, corrected_history, is_supported
from jaxbeam.runtime.arrays import Array, stop_gradient, xp
from jaxbeam.simulation.integrator.discrete_model import PEAK_NODES
from jaxbeam.simulation.integrator.peaks import Peaks, RunningPeaks
from jaxbeam.simulation.integrator.step_size import UNSAMPLED, StepTrial, trial_positions
from jaxbeam.simulation.section_forces import motion_at


class Extremes(NamedTuple):
    """Smallest and largest value of the quantity of each sensor, in its unit, and times (s).

    The beam starts at rest, so that zero is among the values.
    """

    smallest: Float[Array, " sensor"]
    smallest_time: Float[Array, " sensor"]
    largest: Float[Array, " sensor"]
    largest_time: Float[Array, " sensor"]


def monitored_sensors(case: Case) -> tuple[Sensor, ...]:
    """Deflections at all sensors, then the other quantities of those that measure others.

    Then the deflections at the absorbers, twice: of strokes and of forces.
    """
    others = (sensor for sensor in case.sensors if sensor.quantity != "deflection")
    places = (Sensor(one.position, eccentricity=one.eccentricity) for one in case.sensors)
    hung = [Sensor(one.position) for one in case.absorbers]
    return *places, *others, *hung, *hung


def own_outputs(sensors: Sequence[Sensor]) -> Int[np.ndarray, " sensor"]:
    """Index of each sensor's own quantity among the quantities of `monitored_sensors`."""
    others = np.array([sensor.quantity != "deflection" for sensor in sensors], int)
    return np.where(others, len(sensors) + np.cumsum(others) - 1, np.arange(len(sensors)))


def sensor_extremes(sensors: Sequence[Sensor], peaks: Peaks) -> tuple[Extremes, Peaks]:
    """Extremes at the sensors, and peaks of the absolute deflection there.

    `peaks` are those of `monitored_sensors` in one run: the largest of each, then the largest of
    its negative.
    """
    up, down = xp.split(peaks.peak_deflection, 2)
    up_time, down_time = xp.split(peaks.peak_time, 2)
    index, every = own_outputs(sensors), slice(0, len(sensors))
    if np.array_equal(index, np.arange(len(sensors))):
        index = every  # a slice, for which programs are smaller
    smallest = 0.0 - down[index]  # of a beam at rest 0, not -0
    extremes = Extremes(smallest, down_time[index], up[index], up_time[index])
    is_up = up[every] >= down[every]
    deflection = xp.where(is_up, up[every], down[every])
    time = xp.where(is_up, up_time[every], down_time[every])
    return extremes, peaks._replace(peak_deflection=deflection, peak_time=time)


def absorber_peaks(case: Case, heights: Float[Array, " output"]) -> dict[str, Array]:
    """Largest absolute strokes (m) and forces (N) of the absorbers of a case.

    `heights` are the peaks of `monitored_sensors`, upwards, then downwards.
    """
    count, (up, down) = len(case.absorbers), xp.split(heights, 2)
    stroke, force = xp.split(xp.maximum(up, down)[up.shape[0] - 2 * count :], 2)
    return {"peak_stroke": stroke, "peak_absorber_force": force}


LEFT_OUT = 3  # highest modes whose dynamic part estimates that of all modes beyond
ROUNDING = 1e-12  # of the motion along the beam, below which that of a point is zero
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
        former, better = (sensor_history(case, model.modes, m, sensor) for m in (coarse, fine))
        change = UNSAMPLED * xp.max(xp.abs(better - former))
        errors.append(_ratio(change, xp.max(xp.abs(better))))
    return xp.array(errors).reshape(-1)


def interpolation_errors(
    model: ModalModel, running_peaks: RunningPeaks
) -> Float[Array, "output batch"]:
    """Errors of the peaks of each output, in its unit: those of polynomials through samples.

    Of cos(z s + c) on [-1, 1], the Chebyshev coefficients are Bessel functions of their order at z:
    the first two that the polynomial leaves out follow from its last two, with the largest z, that
    of the highest mode. Twice the sum of all that are left out is 0.7 to 1.4 times the largest
    error of an interpolant; it is doubled, as modes may cancel in the last two.
    """
    points = 2 * np.array(PEAK_NODES) - 1
    count = len(points)
    last = np.linalg.inv(np.polynomial.chebyshev.chebvander(points, count - 1))[-2:]
    size = xp.sum(xp.abs(xp.tensordot(last, running_peaks.samples, axes=1)), axis=0)
    highest = xp.max(xp.abs(xp.diagonal(model.stiffness())))
    z_square = highest * (running_peaks.step_length / 2) ** 2
    ratio = z_square / (4 * (count - 1) * count) / xp.maximum(1 - z_square / 80, 0.25)
    ratio = xp.minimum(ratio, 0.5)
    return stop_gradient(4 * size * ratio / (1 - ratio))


def peak_errors(
    case: Case,
    model: ModalModel,
    running_peaks: RunningPeaks,
    of_halves: RunningPeaks | None,
    heights: Float[Array, " output"],
    motion: Motion,
) -> tuple[Float[Array, ""], Float[Array, " sensor"]]:
    """Errors of the interpolated peaks of a run, of `monitored_sensors` up and down.

    Of the deflection, relative to its largest value along the beam, and of what each sensor
    measures, relative to its largest. `heights` are the refined peaks. Errors are the changes of
    these as the steps that hold them are taken as two halves: such a step has the errors of its
    polynomials and of its contact forces. They are twice that where a step holds a whole period of
    the highest mode, so that halves may have nearly half its error. They are `interpolation_errors`
    where there are none, in traced runs whose plan has no errors of peaks, and in long controlled
    ones.
    """
    count, own = len(case.sensors), own_outputs(case.sensors)
    if not count:
        return xp.zeros(()), xp.zeros(0)
    if of_halves is None:
        absolute = interpolation_errors(model, running_peaks)[:, 0]
    else:
        # Peaks in steps of no length, as an impulse acts there, are not between steps.
        change = xp.abs(of_halves.refined_peak()[0][:, 0] - heights)
        lengths = running_peaks.step_length[:, 0]
        phases = xp.sqrt(xp.max(xp.abs(xp.diagonal(model.stiffness())))) * lengths
        change = xp.where(phases > 2 * np.pi, UNSAMPLED, 1.0) * change
        absolute = xp.where(lengths > 0, change, 0.0)
    absolute = xp.max(xp.stack(xp.split(absolute, 2)), 0)
    up, down = xp.split(heights, 2)
    largest = stop_gradient(xp.maximum(up, down))
    rows = model.modes.shapes(trial_positions(case))
    along = xp.max(xp.abs(stop_gradient(motion.coordinates) @ rows.T))
    along = xp.maximum(along, xp.max(largest[:count]))
    return _ratio(xp.max(absolute[:count]), along), _ratio(absolute[own], largest[own])


@np.errstate(all="ignore")  # of extreme numbers
def truncation_errors(case: Case, modes: Modes, motion: Motion) -> Float[Array, " sensor"]:
    """Estimated truncation error of the quantity of each sensor, relative to its largest value.

    See `truncation_changes`. Zero where the motion is nothing but rounding, as at supports.
    """
    shapes, sizes = modes.shapes(trial_positions(case)), []
    for sensor in case.sensors:
        quantity = QUANTITIES[sensor.quantity]
        size = xp.max(xp.abs(sensor_history(case, modes, motion, sensor)))
        if quantity.x_derivative == 0 and not quantity.of_twist:
            along = xp.max(xp.abs(motion[quantity.time_derivative] @ shapes.T))
            size = xp.where(size > ROUNDING * along, size, 0.0)
        sizes.append(size)
    largest = xp.array(sizes).reshape(-1)
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
            change = corrected_history(case, modes, motion, place_of(case, sensor), order)
            if sensor.eccentricity is not None:
                twist = corrected_history(case, modes, motion, sensor.position, TWIST)
                change = change + sensor.eccentricity * twist
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
    row = sensor_row(modes.fields, case, sensor, place_of(case, sensor))
    row = row * band_weights(modes, sensor.mode_band)
    amplitudes = tuple(part[:, highest] for part in motion[:3])
    if quantity.bends and is_supported(case, modes.layout):
        _, rates, accelerations = amplitudes
        dynamic = -(accelerations + modes.damping[highest] * rates) / modes.stiffness[highest]
        return dynamic @ row[highest]
    return amplitudes[quantity.time_derivative] @ row[highest]


def _ratio(change, largest):
    """Ratio of a change to the largest value; zero where that is zero."""
    return xp.where(largest == 0, 0.0, change / xp.where(largest == 0, 1.0, largest))
