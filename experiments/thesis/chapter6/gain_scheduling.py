"""Gains of one span scheduled over the mass of the load: Fig. 6.7, by statics and by optimisation.

The thesis switches the linear gain where the cubic law becomes the better one. By statics that is
k(m) = 2 w^2, with w the deflection in mm; simulations add the effect of filter and crossing. The
gains that leave the lowest peak are several times higher.

Gains of displacement feedback as functions of the mass of the load: Fig. 6.7 of the thesis.

From statics, linear gains equivalent to a power law; by optimisation, gains of the lowest peak of a
crossing, with filters, delays and limits.

Oscillation of cubic feedback through a low-pass filter, and its gain margin: Fig. 6.4.
"""

import dataclasses
import itertools
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

import jaxbeam as jb
from experiments.thesis.cases import (
    GAIN,
    MASSES,
    reduction,
    simulate_changes,
    static_extremes,
    with_duration,
)
from experiments.thesis.chapter6 import published
from experiments.thesis.report import plot_deflections
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.analysis.stability import stability_margin
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.control.feedback import Feedback, ScheduledFeedback
from jaxbeam.model.deflection_lines import influence_line, static_deflection_per_command
from jaxbeam.plot.style import colour, set_title, use_style
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning, simulate

SPEED, MASS = 0.28, 0.509  # m/s, kg
CUTOFFS = 10.0, 5.0  # Hz
# s, the period of the oscillation: the mean over it is the quasi-static deflection by the load
AVERAGING_PERIOD = 0.1
# mm from crest to trough, by which the supports yield: called visible in the thesis
VISIBLE_AMPLITUDE = 0.1
SAMPLE_RATE = 500.0  # Hz


def oscillation_findings(
    case: jb.Case, answers: Mapping[tuple[str, ...], Mapping[str, float]]
) -> tuple[list[Finding], Figure]:
    """Findings on the oscillation of the loop under a slow, heavy load (yes or no, Hz); Fig. 6.4.

    `case` is rig B under the cubic law; the cutoff of the filter is varied, for all `answers`, of
    which the last has the damping of the figure.
    """
    case = with_duration(case, float(case.beam.length) / SPEED, SAMPLE_RATE)
    load = {"loads.0.mass": MASS, "loads.0.speed": SPEED}
    changes = [
        load | {"sensors.0.filter.cutoff": cutoff} | change
        for change in answers.values()
        for cutoff in CUTOFFS
    ]
    records = simulate_changes(case, changes)
    shape = len(answers), len(CUTOFFS)
    sizes, frequencies = np.transpose([_oscillation(one) for one in records]).reshape(2, *shape)
    oscillates = dict(zip(answers, (sizes > VISIBLE_AMPLITUDE).astype(float), strict=True))
    frequency = dict(zip(answers, frequencies[:, 0], strict=True))
    first, second = sizes[-1]
    findings = [
        make_finding(
            published.OSCILLATES,
            oscillates.pop(()),
            oscillates,
            null=("no control", 0.0),
            remark=f"by {', '.join(list(answers)[-1])} the oscillations are {first:.2f} and"
            f" {second:.2f} mm from crest to trough",
        ),
        make_finding(
            published.OSCILLATION_FREQUENCY,
            frequency.pop(()),
            frequency,
            null=("no control, the mass at rest at midspan", _loaded_frequency(case)),
        ),
    ]
    return findings, _draw_oscillation(records[-len(CUTOFFS) :])


def _oscillation(record: jb.Record) -> tuple[float, float]:
    """Oscillation at midspan while loaded: crest to trough (mm) and frequency (Hz)."""
    history = 1e3 * np.asarray(record.deflection)[:, 0]
    width = round(AVERAGING_PERIOD * SAMPLE_RATE)
    mean = np.convolve(history, np.ones(width) / width, "valid")
    oscillation = history[width // 2 :][: mean.size] - mean
    count = 16 * oscillation.size  # zeros interpolate the spectrum
    spectrum = np.abs(np.fft.rfft(oscillation * np.hanning(oscillation.size), count))
    windows = np.lib.stride_tricks.sliding_window_view(oscillation, width)
    frequency = np.fft.rfftfreq(count, 1 / SAMPLE_RATE)[np.argmax(spectrum)]
    return float(np.max(np.ptp(windows, axis=1))), float(frequency)


def _loaded_frequency(case: jb.Case) -> float:
    """First frequency (Hz) of the beam with the mass at rest at the first sensor."""
    shape = np.asarray(jb.modes(case).shapes(np.atleast_1d(case.sensors[0].position), 0))[0]
    inertia = np.eye(shape.size) + MASS * np.outer(shape, shape)
    values = np.linalg.eigvals(np.linalg.solve(inertia, np.diag(jb.modes(case).stiffness)))
    return float(np.sqrt(values.real.min())) / (2 * np.pi)


def gain_margin(case: jb.Case, correction: float) -> float:
    """The gain (V/m at the patch) at which static feedback has a pole at zero, by c_p."""
    amplifier = float(case.actuators[0].amplifier_gain)
    case = jb.replace(case, {"actuators.0.correction": correction})
    return amplifier / float(static_deflection_per_command(case, case.sensors[0].position)[0])


def fitted_correction(case: jb.Case) -> float:
    """The factor c_p for which the printed gain margin is that of static feedback."""
    return gain_margin(case, 1.0) / published.GAIN_MARGIN.numbers[0]


@use_style
def _draw_oscillation(records) -> Figure:
    """Fig. 6.4: the deflection with either filter."""
    figure = Figure(figsize=(7.2, 3.0))
    axes = figure.subplots()
    labels = [f"filter of {cutoff:g} Hz" for cutoff in CUTOFFS]
    plot_deflections(axes, dict(zip(labels, records, strict=True)))
    last = float(records[-1].times[-1])
    axes.set(xlabel="time (s)", ylabel="deflection at 0.3 m (mm)", xlim=(0, last))
    axes.legend(loc="lower left")
    set_title(figure, "One span, cubic law, 0.509 kg at 0.28 m/s, damping 0.01 (Fig. 6.4)")
    return figure


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
    case: Case, masses: ArrayLike, gain: float
) -> Float[np.ndarray, "actuator mass"]:
    """Linear gains with the same largest static deflections as a cubic law, for masses in kg.

    Each loop alone, with the load at the position of the largest deflection: the deflection w under
    u = -gain w^3 satisfies s m = w + h gain w^3, with s the deflection per kilogram and h that per
    unit of command, and the gain is k = gain w^2, in commands per m. Speed, filters, limits and
    other loops are left out.

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
            return w + unit_response * gain * w**3 - uncontrolled

        return gain * scipy.optimize.brentq(residual, 0.0, uncontrolled, xtol=1e-15) ** 2

    rows = zip(static_deflections, per_command, strict=True)
    return np.array(
        [[equivalent_gain(each * mass, unit) for mass in masses] for each, unit in rows]
    )


def best_gains(case: Case, masses: ArrayLike, max_gain: float) -> list[BestGain]:
    """Gain up to `max_gain` with the lowest peak of the run, for each mass (kg) of the first load.

    The case has a controller of kind "feedback", whose loops all have the same gain, in its units
    and with its power. TRIAL_GAINS gains are tried, then the best is refined between its
    neighbours.

    Raises ValueError for another controller, or an invalid case.
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
        gain, peak = _minimise_peak(lambda g, m=mass: _peak(_case_with(case, g, m), plan), max_gain)
        best.append(
            BestGain(
                mass,
                gain,
                peak,
                _peak(_case_with(uncontrolled_case, None, mass), uncontrolled_plan),
            )
        )
    return best


def scheduled_controller(case: Case, best: list[BestGain]) -> ScheduledFeedback:
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


HIGHER_GAINS = (3.0, 4.5)  # V/mm, of the scheduled linear law
BY_STATICS = "Fig. 6.7 by statics"
MAX_GAIN = 24.0  # V/mm, the largest gain tried
MASS_GRID = np.linspace(0.2, 0.6, 81)  # kg
RIGIDITY_ROUNDING = 0.0005  # N m^2: half a digit of 13.211


def switching_masses(
    masses: Sequence[float], peaks: np.ndarray, higher_gain_peaks: np.ndarray
) -> tuple[list[list[float]], list[list[float]]]:
    """Masses (kg) from which the cubic law beats linear gains, and gains equal to it; by c_p.

    `peaks` (m) are those without control, of the linear and of the cubic law, (law, c_p, mass), and
    `higher_gain_peaks` those of the higher linear gains (gain, c_p, mass). The equal gains (V/mm)
    are those for the heaviest mass.
    """
    # Peaks of the linear laws above those of the cubic law, (gain, c_p, mass) in m.
    excess = np.concatenate([peaks[1:2], higher_gain_peaks]) - peaks[2]
    corrections = range(excess.shape[1])
    switches = [[_interpolated_root(masses, excess[k, i]) for k in (0, 1)] for i in corrections]
    equal = [[_interpolated_root((GAIN, *HIGHER_GAINS), excess[:, i, -1])] for i in corrections]
    return switches, equal


def static_schedule(case: jb.Case, heaviest: float, correction: float) -> tuple[float, ...]:
    """Switching masses (kg) and the equal gain (V/mm) from static deflections alone, for a c_p."""
    case = jb.replace(case, {"actuators.0.correction": correction})
    gains = equivalent_gains(case, MASS_GRID, GAIN * 1e9)[0] / 1e3
    light, middle = np.interp([GAIN, HIGHER_GAINS[0]], gains, MASS_GRID)
    return float(light), float(middle), float(np.interp(heaviest, MASS_GRID, gains))


def uncontrolled_schedule(case: jb.Case, heaviest: float) -> tuple[float, ...]:
    """Switching masses (kg) and equal gain (V/mm) by k = 2 w^2, w in mm without control."""
    deflection = 1e3 * float(static_extremes(case)[0][0])  # mm/kg
    masses = np.sqrt(np.array([GAIN, HIGHER_GAINS[0]]) / GAIN) / deflection
    return float(masses[0]), float(masses[1]), GAIN * (deflection * heaviest) ** 2


def _rounding_remark(case: jb.Case) -> str:
    """Sentence on the error of the first mass by statics, by rounding of E I and gain margin.

    `case` is rig B.
    """
    margin, mass = published.GAIN_MARGIN, published.SWITCHING_MASSES
    rigidity, half = float(case.beam.bending_stiffness), float(mass.allowed_error[0]) / 2
    share = float(margin.allowed_error[0] / 2 / margin.numbers[0])
    found = []
    for stiffer, larger in itertools.product((-1, 1), repeat=2):
        beam = jb.replace(case, {"beam.flexural_rigidity": rigidity + stiffer * RIGIDITY_ROUNDING})
        correction = fitted_correction(beam) / (1 + larger * share)
        found.append(static_schedule(beam, MASSES[-1], correction)[0])
    return (
        f"by statics, the rounding of E I and of the gain margin leaves {min(found):.5f} to"
        f" {max(found):.5f} kg, that of the print {mass.numbers[0] - half:g} to"
        f" {mass.numbers[0] + half:g} kg"
    )


def schedule_findings(
    case: jb.Case,
    answers: Mapping[tuple[str, ...], Mapping[str, float]],
    switches,
    equal_gains,
    fitted: str,
) -> list[Finding]:
    """Findings on the gains of Fig. 6.7 and the gain margin, by `answers`, crossings and statics.

    The answer `fitted` is c_p by the margin. `switches` (kg) and `equal_gains` (V/mm) are those of
    crossings, by answer.
    """
    null_light, null_middle, null_last = uncontrolled_schedule(case, MASSES[-1])
    corrections = [change["actuators.0.correction"] for change in answers.values()]
    statics = [static_schedule(case, MASSES[-1], one) for one in corrections]
    margins = [gain_margin(case, correction) for correction in corrections]
    rows = (
        (
            published.SWITCHING_MASSES,
            switches,
            [one[:2] for one in statics],
            [null_light, null_middle],
        ),
        (published.EQUIVALENT_LINEAR_GAIN, equal_gains, [one[2] for one in statics], null_last),
        (published.GAIN_MARGIN, margins, margins, np.nan),
    )
    remarks = {published.SWITCHING_MASSES: _rounding_remark(case)}
    findings = []
    for numbers, by_crossings, by_statics, null in rows:
        values = dict(zip(answers, by_crossings, strict=True))
        if numbers is not published.GAIN_MARGIN:
            keys = [(*one, BY_STATICS) for one in answers]
            values |= dict(zip(keys, by_statics, strict=True))
        findings.append(
            make_finding(
                numbers,
                values.pop(()),
                values,
                null=("static, without control", null),
                fitted={fitted: "margin"} if numbers is published.GAIN_MARGIN else None,
                remark=remarks.get(numbers, ""),
            )
        )
    return findings


def derived_schedules(case: jb.Case, masses: Sequence[float]) -> tuple[Figure, str]:
    """Scheduled gains by statics and by optimisation, and the peaks under them.

    `case` is rig B under the linear law; masses are in kg. Returns a figure and a sentence.
    """
    statics = equivalent_gains(case, masses, GAIN * 1e9)
    best = best_gains(case, masses, MAX_GAIN * 1e3)
    changes = [{"loads.0.mass": mass} for mass in masses]
    linear = case.controller
    laws = {
        f"k = {GAIN:g}": linear,
        "by statics": ScheduledFeedback(
            masses=masses, gains=statics, period=linear.period, delay=linear.delay
        ),
        "by optimisation": scheduled_controller(case, best),
    }
    uncontrolled = np.array([one.uncontrolled for one in best])
    reductions = {}
    for name, law in laws.items():
        records = simulate_changes(dataclasses.replace(case, controller=law), changes)
        peaks = [float(record.peak_deflection[0]) for record in records]
        reductions[name] = reduction(uncontrolled, peaks)
    gains_text = "; ".join(
        f"{one.mass:g} kg: {one.gain / 1e3:.1f} V/mm, peak reduced by {share:.1f} %"
        for one, share in zip(best, reductions["by optimisation"], strict=True)
    )
    numbers = ({"loads.0.mass": one.mass, "controller.gains.0": one.gain} for one in best)
    unstable_count = sum(
        stability_margin(jb.replace(case, each)).unstable is not None for each in numbers
    )
    remark = (
        "Gains by optimisation of the crossing, in the loop as a schedule k(m):"
        f" {gains_text}. If the load stayed on the beam, {unstable_count} of these {len(best)}"
        " loops would be unstable."
    )
    return _draw(masses, statics[0] / 1e3, best, reductions), remark


def _interpolated_root(abscissae, values) -> float:
    """Root of the interpolating polynomial between the first and last abscissa; NaN without one."""
    roots = np.polynomial.Polynomial.fit(abscissae, values, len(abscissae) - 1).roots()
    inside = (abs(roots.imag) < 1e-9) & (roots.real > abscissae[0]) & (roots.real < abscissae[-1])
    return float(roots.real[inside][0]) if inside.any() else np.nan


@use_style
def _draw(masses, statics, best: list[BestGain], reductions: dict[str, np.ndarray]) -> Figure:
    """Scheduled gains over the mass, and the reductions of the peak."""
    figure = Figure(figsize=(7.2, 3.2))
    left, right = figure.subplots(1, 2)
    gain_curves = (None, statics, [one.gain / 1e3 for one in best])
    for i, ((name, values), gains) in enumerate(zip(reductions.items(), gain_curves, strict=True)):
        drawn = np.full(len(masses), GAIN) if gains is None else gains
        left.plot(masses, drawn, "o-", color=colour(i), label=name)
        right.plot(masses, values, "o-", color=colour(i))
    left.set(xlabel="mass (kg)", ylabel="linear gain (V/mm)", ylim=(0, None))
    right.set(xlabel="mass (kg)", ylabel="reduction of the peak (%)", ylim=(0, None))
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, "One span, linear gains over the mass (Fig. 6.7)")
    return figure
