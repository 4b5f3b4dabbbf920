"""Gains of displacement feedback over the mass of the load, derived: Fig. 6.7 of the thesis.

By statics, a linear gain that answers a mass as a power law does; by optimisation, the gain that
leaves the lowest peak of a whole crossing, filters, delays and limits included.
"""

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.analysis.crossing_margin import stability_margin
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.control.scheduled_feedback import ScheduledFeedback
from jaxbeam.model.statics import influence_line, static_deflection_per_command
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning, simulate

LOAD_POSITIONS = 201  # of the load, at which the static deflection is looked for
TRIAL_GAINS = 8  # gains from the largest one down, by equal factors
MIN_GAIN_RATIO = 1 / 64  # the smallest of them, of the largest
GAIN_TOLERANCE = 1e-3  # how exactly the best gain is found, relative
RUN_TOLERANCE = 1e-5  # of the runs


class BestGain(NamedTuple):
    """What `best_gains` finds for a mass (kg): gain, peak (m), and the peak without control."""

    mass: float
    gain: float
    peak: float
    uncontrolled: float


def equivalent_gains(
    case: Case, masses: ArrayLike, gain: float, power: int = 3
) -> Float[np.ndarray, "actuator mass"]:
    """Linear gains with which each mass sinks each sensor as far as under a power law.

    Statically, with the load where it sinks the sensor most, each loop alone: the deflection w that
    a mass m leaves under u = -gain w |w|^(power - 1) obeys s m = w + h gain w^power, with s the
    deflection per kilogram and h the lift per unit of command, and k = gain w^(power - 1). Speed,
    filters, limits and the other loops play no part. Masses are in kg, gains in a command per m.

    Raises ValueError for a faulty case and one with fewer sensors than actuators.
    """
    actuators, masses = len(case.actuators), np.asarray(masses, float)
    if len(case.sensors) < actuators:
        raise ValueError(
            f"there are only {len(case.sensors)} sensors for {actuators} actuators; add some"
        )
    sensor_positions = np.asarray(case.sensor_positions)[:actuators]
    load_positions = np.linspace(0, float(case.beam.length), LOAD_POSITIONS)
    static_deflections = float(case.run.gravity) * -np.asarray(
        influence_line(case, sensor_positions, load_positions)
    ).min(axis=0)
    static_lifts = np.diagonal(np.asarray(static_deflection_per_command(case, sensor_positions)))

    def equivalent_gain(free, lift):
        def residual(w):
            return w + lift * gain * w**power - free

        return gain * scipy.optimize.brentq(residual, 0.0, free, xtol=1e-15) ** (power - 1)

    rows = zip(static_deflections, static_lifts, strict=True)
    return np.array(
        [[equivalent_gain(each * mass, lift) for mass in masses] for each, lift in rows]
    )


def best_gains(
    case: Case, masses: ArrayLike, max_gain: float, margin: float | None = None
) -> list[BestGain]:
    """For each mass (kg) the gain, up to `max_gain`, that leaves the lowest peak of the run.

    The case has a controller of kind "feedback"; all its loops are given the same gain, in its own
    units, and its power. Gains from `max_gain` down to a 64th are tried, then the best is sought
    between its neighbours. With a `margin` only gains count with which the loop bears that much
    more with the loads parked anywhere on the way (see `stability_margin`); without, also those of
    loops that would be unstable if the load stayed, but not within the crossing.

    Raises ValueError for another controller, a faulty case, and if no gain that is tried has the
    margin.
    """
    controller = case.controller
    if type(controller) is not Feedback or controller.higher_gains is not None:
        raise ValueError("gains are derived for a controller of kind 'feedback' with one power")
    masses = [float(mass) for mass in np.atleast_1d(np.asarray(masses, float))]
    uncontrolled_case = dataclasses.replace(case, controller=None)
    plan = integration_plan(_case_with(case, max_gain, max(masses)), None, RUN_TOLERANCE)
    uncontrolled_plan = integration_plan(
        _case_with(uncontrolled_case, None, max(masses)), None, RUN_TOLERANCE
    )
    found = []
    for mass in masses:
        largest = (
            max_gain if margin is None else _largest_gain_with_margin(case, mass, max_gain, margin)
        )
        gain, peak = _minimise_peak(lambda g, m=mass: _peak(_case_with(case, g, m), plan), largest)
        found.append(
            BestGain(
                mass,
                gain,
                peak,
                _peak(_case_with(uncontrolled_case, None, mass), uncontrolled_plan),
            )
        )
    return found


def scheduled_controller(
    case: Case,
    best: list[BestGain],
    between: str = "interpolated",
    load_identification: LoadIdentification | None = None,
) -> ScheduledFeedback:
    """The controller with the gains that `best_gains` found for a case, all else as in its own.

    Raises ValueError if masses do not increase.
    """
    masses = [each.mass for each in best]
    if np.any(np.diff(masses) <= 0):
        raise ValueError("masses must increase")
    controller = case.controller
    return ScheduledFeedback(
        masses=masses,
        gains=[[each.gain for each in best]] * len(case.actuators),
        power=controller.power,
        between=between,
        load_identification=load_identification,
        period=controller.period,
        delay=controller.delay,
        resolution=controller.resolution,
    )


def _case_with(case: Case, gain: float | None, mass: float) -> Case:
    """The case with this gain in every loop, if there are loops, and this mass."""
    change = {"loads.0.mass": mass}
    if gain is not None:
        change["controller.gains"] = np.full(len(case.actuators), gain)
    return replace(case, change)


def _peak(case: Case, plan) -> float:
    """The largest deflection (m) at the sensors; infinite where the loop diverges."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # a gain to be left aside may cause it
        peak = float(np.max(concrete(simulate(case, plan=plan).peak_deflection)))
    return peak if np.isfinite(peak) else np.inf


def _minimise_peak(peak, max_gain: float) -> tuple[float, float]:
    """Where a function of the gain is lowest up to a top, and its value there."""
    gains = max_gain * np.geomspace(MIN_GAIN_RATIO, 1, TRIAL_GAINS)
    tried = [peak(gain) for gain in gains]
    best = int(np.argmin(tried))
    ends = np.log(gains[[max(best - 1, 0), min(best + 1, TRIAL_GAINS - 1)]])
    refined = scipy.optimize.minimize_scalar(
        lambda x: peak(np.exp(x)),
        bounds=tuple(ends),
        method="bounded",
        options={"xatol": GAIN_TOLERANCE},
    )
    if refined.fun < tried[best]:
        return float(np.exp(refined.x)), float(refined.fun)
    return float(gains[best]), tried[best]


def _largest_gain_with_margin(case: Case, mass: float, max_gain: float, margin: float) -> float:
    """The largest gain up to `max_gain` with a margin, to EXACT."""

    def lacks_margin(gain):
        return not stability_margin(_case_with(case, gain, mass)).gain >= margin

    if not lacks_margin(max_gain):
        return max_gain
    low, high = MIN_GAIN_RATIO * max_gain, max_gain
    if lacks_margin(low):
        raise ValueError(
            f"a mass of {mass:g} kg leaves a gain margin below {margin:g} even with a gain of"
            f" {low:g}; ask for less, or lower the largest gain"
        )
    while high / low > 1 + GAIN_TOLERANCE:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if lacks_margin(middle) else (middle, high)
    return float(low)
