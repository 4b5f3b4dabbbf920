"""Bode plots of frequency responses; Bode and Nyquist plots of loop gains."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import LogFormatter, MultipleLocator, NullFormatter

from jaxbeam.analysis.linearised_loop import LinearisedLoop
from jaxbeam.analysis.margins import loop_gain
from jaxbeam.model.frequency_response import FrequencyResponse
from jaxbeam.plot.style import ALARM, FAINT, GREY, colour, drawing_area, set_title, use_style

NYQUIST_RADIUS = 3.0  # of the part of the plane that is drawn, around the origin


@use_style
def plot_frequency_response(
    response: FrequencyResponse, *, ax: Axes | None = None, title: str | None = None
) -> Figure | SubFigure:
    """Magnitude and phase over frequency, a column a unit, a curve an input-output pair.

    A frequency of zero, which a logarithmic axis lacks, is left out. The figure takes the place of
    `ax`; its title is that of the response if left out.
    """
    positive = np.asarray(response.frequencies) > 0
    frequencies = np.asarray(response.frequencies)[positive]
    magnitude, phase = (np.asarray(x)[positive] for x in (response.magnitude, response.phase))
    units = list(dict.fromkeys(pair.unit for pair in response.pairs))
    figure = drawing_area(ax, (max(7.0, 1.0 + 4.2 * len(units)), 5.6))
    grid = figure.subplots(2, len(units), squeeze=False, sharex=True, height_ratios=[3, 2])
    for (top, bottom), unit in zip(grid.T, units, strict=True):
        chosen = [i for i, pair in enumerate(response.pairs) if pair.unit == unit]
        for number, i in enumerate(chosen):
            label = str(response.pairs[i]).replace("->", "\N{RIGHTWARDS ARROW}")
            top.loglog(frequencies, magnitude[:, i], color=colour(number), label=label)
            bottom.semilogx(frequencies, phase[:, i], color=colour(number))
        top.set_ylabel("magnitude" if unit == "1" else f"magnitude ({unit.replace('^2', '²')})")
        top.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2)
        # Powers of ten alone would leave an axis of less than a decade without numbers.
        least, most = top.get_ylim()
        within_a_decade = most < 20 * least
        top.yaxis.set_minor_formatter(
            LogFormatter(labelOnlyBase=False) if within_a_decade else NullFormatter()
        )
        top.grid(True, which="minor", color=FAINT, linewidth=0.3)
        low, high = np.min(phase[:, chosen]), np.max(phase[:, chosen])
        bottom.set_ylim(90 * np.floor(low / 90 - 0.1), 90 * np.ceil(high / 90 + 0.1))
        bottom.yaxis.set_major_locator(MultipleLocator(90))
        bottom.xaxis.set_major_formatter("{x:g}")
        bottom.set(xlabel="frequency (Hz)", ylabel="phase (°)")
        bottom.set_xlim(frequencies[0], frequencies[-1])
    set_title(figure, title, response.title)
    return figure


@use_style
def plot_loop_gain(
    loops: dict[str, LinearisedLoop],
    actuator: int = 0,
    title: str = "",
    *,
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Bode and Nyquist plots of loops broken at one command, by their names.

    Drawn is the transfer function -L from the command to the negative command that the law returns,
    so that the critical point is -1, as in textbooks, and the loop is that of negative feedback.
    The figure takes the place of `ax`.
    """
    figure = drawing_area(ax, (9.0, 4.6))
    axes = figure.subplot_mosaic([["magnitude", "plane"], ["phase", "plane"]])
    magnitude, phase, plane = axes["magnitude"], axes["phase"], axes["plane"]
    for i, (name, loop) in enumerate(loops.items()):
        omega, response = loop_gain(loop, actuator)
        curve, frequencies = -response(omega), omega / (2 * np.pi)
        magnitude.loglog(frequencies, np.abs(curve), color=colour(i), label=name)
        phase.semilogx(frequencies, np.degrees(np.unwrap(np.angle(curve))), color=colour(i))
        inside = np.where(np.abs(curve) < 2 * NYQUIST_RADIUS, curve, np.nan)
        plane.plot(inside.real, inside.imag, color=colour(i))
        plane.plot(inside.real, -inside.imag, color=colour(i), linewidth=0.6, linestyle=":")
    magnitude.axhline(1, color=GREY, linewidth=0.8, linestyle=":")
    phase.axhline(-180, color=GREY, linewidth=0.8, linestyle=":")
    circle = np.exp(1j * np.linspace(0, 2 * np.pi, 181))
    plane.plot(circle.real, circle.imag, color=GREY, linewidth=0.8, linestyle=":")
    plane.plot(-1, 0, "x", color=ALARM, markersize=8)
    plane.set(
        xlabel="real part", ylabel="imaginary part", aspect="equal",
        xlim=(-NYQUIST_RADIUS, NYQUIST_RADIUS), ylim=(-NYQUIST_RADIUS, NYQUIST_RADIUS),
    )  # fmt: skip
    magnitude.set_ylabel("loop gain")
    magnitude.tick_params(labelbottom=False)
    phase.set(xlabel="frequency (Hz)", ylabel="phase (°)")
    phase.sharex(magnitude)
    magnitude.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2)
    set_title(figure, title)
    return figure
