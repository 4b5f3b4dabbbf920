"""Gains of displacement feedback as functions of the mass of the load: Fig. 6.7 of the thesis.

From statics, linear gains equivalent to a power law; by optimisation, gains of the lowest peak of
a crossing, with filters, delays and limits.
"""

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.analysis.margins import stability_margin
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.control.feedback import Feedback, ScheduledFeedback
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.model.deflection_lines import influence_line, static_deflection_per_command
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning, simulate

LOAD_POSITIONS = 201  # positions of the load at which the static deflection is evaluated
TRIAL_GAINS = 8  # in a geometric sequence down from the largest
MIN_GAIN_RATIO = 1 / 64  # smallest / largest trial gain
GAIN_TOLERANCE = 1e-3  # relative, of the best gain
RUN_TOLERANCE = 1e-5  # of the simulations


class BestGain(NamedTuple):
    """Best gain for a mass (kg), its peak deflection (m), and the peak without control (m)."""

    mass: float
    gain: float
    peak: float
    uncontrolled: float


def equivalent_gains(
    case: Case, masses: ArrayLike, gain: float, power: int = 3
) -> Float[np.ndarray, "actuator mass"]:
    """Linear gains with the same largest static deflections as a power law, for masses in kg.

    Each loop alone, with the load at the position of the largest deflection: the deflection w under
    u = -gain w |w|^(power - 1) satisfies s m = w + h gain w^power, with s the deflection per
    kilogram and h that per unit of command, and the gain is k = gain w^(power - 1), in commands per
    m. Speed, filters, limits and other loops are left out.

    Raises ValueError for an invalid case or one with fewer sensors than actuators.
    """
    actuators, masses = len(case.driven), np.asarray(masses, float)
    if len(case.sensors) < actuators:
        raise ValueError(
            f"only {len(case.sensors)} sensors for {actuators} actuators: add one for each actuator"
        )
    sensor_positions = np.asarray(case.sensor_positions)[:actuators]
    load_positions = np.linspace(0, float(case.beam.length), LOAD_POSITIONS)
    static_deflections = float(case.run.gravity) * -np.asarray(
        influence_line(case, sensor_positions, load_positions)
    ).min(axis=0)
    per_command = np.diagonal(np.asarray(static_deflection_per_command(case, sensor_positions)))

    def equivalent_gain(uncontrolled, unit_response):
        def residual(w):
            return w + unit_response * gain * w**power - uncontrolled

        return gain * scipy.optimize.brentq(residual, 0.0, uncontrolled, xtol=1e-15) ** (power - 1)

    rows = zip(static_deflections, per_command, strict=True)
    return np.array(
        [[equivalent_gain(each * mass, unit) for mass in masses] for each, unit in rows]
    )


def best_gains(
    case: Case, masses: ArrayLike, max_gain: float, margin: float | None = None
) -> list[BestGain]:
    """Gain up to `max_gain` with the lowest peak of the run, for each mass (kg) of the first load.

    The case has a controller of kind "feedback", whose loops all have the same gain, in its units
    and with its power. TRIAL_GAINS gains are tried, then the best is refined between its
    neighbours. With a `margin`, only gains with at least this gain margin under stationary loads
    count (see `stability_margin`).

    Raises ValueError for another controller, an invalid case, or if no gain has the margin.
    """
    controller = case.controller
    if type(controller) is not Feedback or controller.higher_gains is not None:
        raise ValueError("best gains need a controller of kind 'feedback' with one power")
    masses = [float(mass) for mass in np.atleast_1d(np.asarray(masses, float))]
    uncontrolled_case = dataclasses.replace(case, controller=None)
    plan = integration_plan(_case_with(case, max_gain, max(masses)), None, RUN_TOLERANCE)
    uncontrolled_plan = integration_plan(
        _case_with(uncontrolled_case, None, max(masses)), None, RUN_TOLERANCE
    )
    best = []
    for mass in masses:
        largest = (
            max_gain if margin is None else _largest_gain_with_margin(case, mass, max_gain, margin)
        )
        gain, peak = _minimise_peak(lambda g, m=mass: _peak(_case_with(case, g, m), plan), largest)
        best.append(
            BestGain(
                mass,
                gain,
                peak,
                _peak(_case_with(uncontrolled_case, None, mass), uncontrolled_plan),
            )
        )
    return best


def scheduled_controller(
    case: Case,
    best: list[BestGain],
    between: str = "interpolated",
    load_identification: LoadIdentification | None = None,
) -> ScheduledFeedback:
    """Scheduled controller with the gains of `best_gains`; other settings as those of the case.

    Raises ValueError if masses do not increase.
    """
    masses = [each.mass for each in best]
    if np.any(np.diff(masses) <= 0):
        raise ValueError("masses must increase")
    controller = case.controller
    return ScheduledFeedback(
        masses=masses,
        gains=[[each.gain for each in best]] * len(case.driven),
        power=controller.power,
        between=between,
        load_identification=load_identification,
        period=controller.period,
        delay=controller.delay,
        resolution=controller.resolution,
    )


def _case_with(case: Case, gain: float | None, mass: float) -> Case:
    """Case with a mass (kg) of the first load, and a gain in all loops unless it is None."""
    change = {"loads.0.mass": mass}
    if gain is not None:
        change["controller.gains"] = np.full(len(case.driven), gain)
    return replace(case, change)


def _peak(case: Case, plan) -> float:
    """Largest deflection (m) at the sensors; infinite if the loop diverges."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # of gains that are not chosen
        peak = float(np.max(concrete(simulate(case, plan=plan).peak_deflection)))
    return peak if np.isfinite(peak) else np.inf


def _minimise_peak(peak, max_gain: float) -> tuple[float, float]:
    """Gain up to `max_gain` with the lowest peak, and the peak."""
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
    """Largest gain up to `max_gain` with a gain margin, to GAIN_TOLERANCE."""

    def lacks_margin(gain):
        return not stability_margin(_case_with(case, gain, mass)).gain >= margin

    if not lacks_margin(max_gain):
        return max_gain
    low, high = MIN_GAIN_RATIO * max_gain, max_gain
    if lacks_margin(low):
        raise ValueError(
            f"with a mass of {mass:g} kg the gain margin is below {margin:g} even for a gain of"
            f" {low:g}; lower the margin or the largest gain"
        )
    while high / low > 1 + GAIN_TOLERANCE:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if lacks_margin(middle) else (middle, high)
    return float(low)
