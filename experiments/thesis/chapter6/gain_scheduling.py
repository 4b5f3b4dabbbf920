"""Gains of one span over the mass of the load: Fig. 6.7, where they come from, and better ones.

The thesis switches the linear gain where the cubic law becomes the better one. By statics that is
k(m) = 2 w^2, with w the deflection in mm; what filter and crossing add, runs show. The gains that
leave the lowest peak are several times higher.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam.analysis.crossing_margin import stability_margin
from jaxbeam.analysis.derived_gains import (
    BestGain,
    best_gains,
    equivalent_gains,
    scheduled_controller,
)
from jaxbeam.control import ScheduledFeedback
from jaxbeam.plot.style import colour, set_title, use_style

GAIN, HIGHER_GAINS = 2.0, (3.0, 4.5)  # V/mm: of both laws, and linear ones as they may be scheduled
MAX_GAIN = 24.0  # V/mm, the largest gain that is tried
LIKELY_CORRECTION = 0.5  # c_p that fits Fig. 6.7
MASS_GRID = np.linspace(0.2, 0.6, 81)  # kg


def switching_masses(
    masses: Sequence[float], peaks: np.ndarray, higher_gain_peaks: np.ndarray
) -> tuple[list[list[float]], list[list[float]]]:
    """Where the cubic law beats linear gains, and which of these is as good in the end; by c_p.

    `peaks` (m) are those without control, of the linear and of the cubic law, (law, c_p, mass), and
    `higher_gain_peaks` those with the stronger linear gains (gain, c_p, mass).
    """
    peak_differences = (
        np.concatenate([peaks[1:2], higher_gain_peaks]) - peaks[2]
    )  # what linear lacks, in m
    each = range(peak_differences.shape[1])
    switches = [[_interpolated_root(masses, peak_differences[k, i]) for k in (0, 1)] for i in each]
    return switches, [
        [_interpolated_root((GAIN, *HIGHER_GAINS), peak_differences[:, i, -1])] for i in each
    ]


def static_schedule_remark(case: jb.Case, heaviest: float) -> str:
    """The same from the static deflections alone, in words."""
    likely = jb.replace(case, {"actuators.0.correction": LIKELY_CORRECTION})
    gains = equivalent_gains(likely, MASS_GRID, GAIN * 1e9)[0] / 1e3
    light, middle = np.interp([GAIN, HIGHER_GAINS[0]], gains, MASS_GRID)
    last = np.interp(heaviest, MASS_GRID, gains)
    return (
        f"Fig. 6.7 by statics alone, c_p {LIKELY_CORRECTION:g}: the cubic law beats the linear one from"
        f" {light:.3f} kg on, k = {HIGHER_GAINS[0]:g} from {middle:.3f} kg on; with {heaviest:g} kg"
        f" {last:.2f} V/mm is as good."
    )


def derived_schedules(
    case: jb.Case, masses: Sequence[float], simulate_changes: Callable
) -> tuple[Figure, str]:
    """Gains by statics and by optimisation for a case under the linear law; what they achieve.

    `simulate_changes` runs a case with several changes of its numbers.
    """
    statics = equivalent_gains(case, masses, GAIN * 1e9)
    best = best_gains(case, masses, MAX_GAIN * 1e3)
    changes = [{"loads.0.mass": mass} for mass in masses]
    own = case.controller
    laws = {
        f"k = {GAIN:g}": own,
        "by statics": ScheduledFeedback(
            masses=masses, gains=statics, period=own.period, delay=own.delay
        ),
        "by optimisation": scheduled_controller(case, best),
    }
    uncontrolled = np.array([one.uncontrolled for one in best])
    reductions = {}
    for word, law in laws.items():
        runs = simulate_changes(dataclasses.replace(case, controller=law), changes)
        peaks = np.array([float(run.peak_deflection[0]) for run in runs])
        reductions[word] = 100 * (1 - peaks / uncontrolled)
    gains_text = "; ".join(
        f"{one.mass:g} kg: {one.gain / 1e3:.1f} V/mm, {share:.1f} % off the peak"
        for one, share in zip(best, reductions["by optimisation"], strict=True)
    )
    numbers = ({"loads.0.mass": one.mass, "controller.gains.0": one.gain} for one in best)
    unstable_count = sum(
        stability_margin(jb.replace(case, each)).unstable is not None for each in numbers
    )
    remark = (
        f"Gains by optimisation of the crossing, in the loop as a schedule k(m): {gains_text}. If the"
        f" load stayed on the beam, {unstable_count} of these {len(best)} loops would be unstable."
    )
    return _draw(masses, statics[0] / 1e3, best, reductions), remark


def _interpolated_root(abscissae, values) -> float:
    """Where the polynomial through some values is zero between the first and last; or NaN."""
    through = np.polynomial.Polynomial.fit(abscissae, values, len(abscissae) - 1)
    roots = through.roots()
    inside = (abs(roots.imag) < 1e-9) & (roots.real > abscissae[0]) & (roots.real < abscissae[-1])
    return float(roots.real[inside][0]) if inside.any() else np.nan


@use_style
def _draw(masses, statics, best: list[BestGain], reductions: dict[str, np.ndarray]) -> Figure:
    """Gains over the mass, and how far they reduce the peak."""
    figure = Figure(figsize=(7.2, 3.2))
    left, right = figure.subplots(1, 2)
    gain_curves = (None, statics, [one.gain / 1e3 for one in best])
    for i, ((word, shares), gains) in enumerate(zip(reductions.items(), gain_curves, strict=True)):
        drawn = np.full(len(masses), GAIN) if gains is None else gains
        left.plot(masses, drawn, "o-", color=colour(i), label=word)
        right.plot(masses, shares, "o-", color=colour(i))
    left.set(xlabel="mass (kg)", ylabel="linear gain (V/mm)", ylim=(0, None))
    right.set(xlabel="mass (kg)", ylabel="reduction of the peak (%)", ylim=(0, None))
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, "One span, linear gains over the mass (Fig. 6.7)")
    return figure
