"""Gains of one span scheduled over the mass of the load: Fig. 6.7, by statics and by optimisation.

The thesis switches the linear gain where the cubic law becomes the better one. By statics that is
k(m) = 2 w^2, with w the deflection in mm; simulations add the effect of filter and crossing. The
gains that leave the lowest peak are several times higher.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import reduction
from experiments.thesis.chapter6 import published
from experiments.thesis.chapter6.derived_gains import (
    BestGain,
    best_gains,
    equivalent_gains,
    scheduled_controller,
)
from experiments.thesis.chapter6.filter_oscillation import gain_margin
from experiments.thesis.chapter6.patch_rigs import (
    GAIN,
    MASSES,
    simulate_changes,
    static_extremes,
)
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.analysis.margins import stability_margin
from jaxbeam.control.feedback import ScheduledFeedback
from jaxbeam.plot.style import colour, set_title, use_style

HIGHER_GAINS = (3.0, 4.5)  # V/mm, of the scheduled linear law
MAX_GAIN = 24.0  # V/mm, the largest gain tried
MASS_GRID = np.linspace(0.2, 0.6, 81)  # kg


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
    """The same by the static deflection without control: k = 2 w^2, w in mm."""
    deflection = 1e3 * float(static_extremes(case)[0][0])  # mm/kg
    masses = np.sqrt(np.array([GAIN, HIGHER_GAINS[0]]) / GAIN) / deflection
    return float(masses[0]), float(masses[1]), GAIN * (deflection * heaviest) ** 2


def schedule_findings(case: jb.Case, corrections, switches, equal_gains) -> list[Finding]:
    """The scheduled gains of Fig. 6.7 and the gain margin, by c_p, by crossings and by statics.

    The last of `corrections` is fitted to the margin. `switches` (kg) and `equal_gains` (V/mm) are
    those of crossings, by c_p.
    """
    by_statics = f"c_p {corrections[-1]:.3g}, by statics"
    light, middle, last = static_schedule(case, MASSES[-1], corrections[-1])
    null_light, null_middle, null_last = uncontrolled_schedule(case, MASSES[-1])
    names = [f"c_p {correction:.3g}, by crossings" for correction in corrections]
    margins = [gain_margin(case, correction) for correction in corrections]
    fitted = {names[-1]: "margin", by_statics: "margin"}
    rows = (
        (published.SWITCHING_MASSES, switches, [light, middle], [null_light, null_middle]),
        (published.EQUIVALENT_LINEAR_GAIN, equal_gains, last, null_last),
        (published.GAIN_MARGIN, margins, margins[-1], np.nan),
    )
    return [
        make_finding(
            numbers,
            values[0],
            dict(zip(names[1:], values[1:], strict=True)) | {by_statics: static},
            null=("static, without control", null),
            fitted=fitted if numbers is published.GAIN_MARGIN else None,
        )
        for numbers, values, static, null in rows
    ]


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
