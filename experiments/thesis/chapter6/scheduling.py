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
from jaxbeam.analysis.crossing_margin import reserve
from jaxbeam.analysis.derived_gains import BestGain, best_gains, equivalent_gains, scheduled
from jaxbeam.control import ScheduledFeedback
from jaxbeam.plot.style import colour, name, styled

GAIN, STRONGER = 2.0, (3.0, 4.5)  # V/mm: of both laws, and linear ones as they may be scheduled
MOST = 24.0  # V/mm, the largest gain that is tried
LIKELY = 0.5  # c_p that fits Fig. 6.7
GRID = np.linspace(0.2, 0.6, 81)  # kg


def switched(
    masses: Sequence[float], peaks: np.ndarray, stronger: np.ndarray
) -> tuple[list[list[float]], list[list[float]]]:
    """Where the cubic law beats linear gains, and which of these is as good in the end; by c_p.

    `peaks` (m) are those without control, of the linear and of the cubic law, (law, c_p, mass), and
    `stronger` those with the stronger linear gains (gain, c_p, mass).
    """
    behind = np.concatenate([peaks[1:2], stronger]) - peaks[2]  # what linear lacks, in m
    each = range(behind.shape[1])
    switches = [[_zero(masses, behind[k, i]) for k in (0, 1)] for i in each]
    return switches, [[_zero((GAIN, *STRONGER), behind[:, i, -1])] for i in each]


def by_statics(case: jb.Case, heaviest: float) -> str:
    """The same from the static deflections alone, in words."""
    likely = jb.replace(case, {"actuators.0.correction": LIKELY})
    gains = equivalent_gains(likely, GRID, GAIN * 1e9)[0] / 1e3
    light, middle = np.interp([GAIN, STRONGER[0]], gains, GRID)
    last = np.interp(heaviest, GRID, gains)
    return (
        f"Fig. 6.7 by statics alone, c_p {LIKELY:g}: the cubic law beats the linear one from"
        f" {light:.3f} kg on, k = {STRONGER[0]:g} from {middle:.3f} kg on; with {heaviest:g} kg"
        f" {last:.2f} V/mm is as good."
    )


def derived(case: jb.Case, masses: Sequence[float], run_all: Callable) -> tuple[Figure, str]:
    """Gains by statics and by optimisation for a case under the linear law; what they achieve.

    `run_all` runs a case with several changes of its numbers.
    """
    statics = equivalent_gains(case, masses, GAIN * 1e9)
    best = best_gains(case, masses, MOST * 1e3)
    changes = [{"loads.0.mass": mass} for mass in masses]
    own = case.controller
    laws = {
        f"k = {GAIN:g}": own,
        "by statics": ScheduledFeedback(
            masses=masses, gains=statics, period=own.period, delay=own.delay
        ),
        "by optimisation": scheduled(case, best),
    }
    free = np.array([one.uncontrolled for one in best])
    less = {}
    for word, law in laws.items():
        runs = run_all(dataclasses.replace(case, controller=law), changes)
        peaks = np.array([float(run.peak_deflection[0]) for run in runs])
        less[word] = 100 * (1 - peaks / free)
    told = "; ".join(
        f"{one.mass:g} kg: {one.gain / 1e3:.1f} V/mm, {share:.1f} % off the peak"
        for one, share in zip(best, less["by optimisation"], strict=True)
    )
    numbers = ({"loads.0.mass": one.mass, "controller.gains.0": one.gain} for one in best)
    lost = sum(reserve(jb.replace(case, each)).unstable is not None for each in numbers)
    remark = (
        f"Gains by optimisation of the crossing, in the loop as a schedule k(m): {told}. If the"
        f" load stayed on the beam, {lost} of these {len(best)} loops would be unstable."
    )
    return _draw(masses, statics[0] / 1e3, best, less), remark


def _zero(places, values) -> float:
    """Where the polynomial through some values is zero between the first and last; or NaN."""
    through = np.polynomial.Polynomial.fit(places, values, len(places) - 1)
    roots = through.roots()
    inside = (abs(roots.imag) < 1e-9) & (roots.real > places[0]) & (roots.real < places[-1])
    return float(roots.real[inside][0]) if inside.any() else np.nan


@styled
def _draw(masses, statics, best: list[BestGain], less: dict[str, np.ndarray]) -> Figure:
    """Gains over the mass, and how far they reduce the peak."""
    figure = Figure(figsize=(7.2, 3.2))
    left, right = figure.subplots(1, 2)
    found = (None, statics, [one.gain / 1e3 for one in best])
    for i, ((word, shares), gains) in enumerate(zip(less.items(), found, strict=True)):
        drawn = np.full(len(masses), GAIN) if gains is None else gains
        left.plot(masses, drawn, "o-", color=colour(i), label=word)
        right.plot(masses, shares, "o-", color=colour(i))
    left.set(xlabel="mass (kg)", ylabel="linear gain (V/mm)", ylim=(0, None))
    right.set(xlabel="mass (kg)", ylabel="reduction of the peak (%)", ylim=(0, None))
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    name(figure, "One span, linear gains over the mass (Fig. 6.7)")
    return figure
