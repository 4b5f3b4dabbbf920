"""Figures of modes, poles and frequency responses."""

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import LogFormatter, MultipleLocator, NullFormatter

from jaxbeam.analysis.linearised_loop import LinearisedLoop
from jaxbeam.analysis.stability import FrozenPoles, Growth, loop_gain
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.along_beam import positions_along
from jaxbeam.model.frequency_responses import FrequencyResponse
from jaxbeam.model.modes import Modes, modes as find_modes
from jaxbeam.plot.drawing import draw_supports
from jaxbeam.plot.style import (
    ALARM,
    FAINT,
    GREY,
    INK,
    annotate,
    colour,
    drawing_area,
    format_number,
    set_title,
    single_axes,
    unit_scale,
    use_style,
)

FEW_MODES = 10


@use_style
def plot_modes(
    case: Case,
    modes: Modes | None = None,
    *,
    ax: Axes | None = None,
    title: str | None = None,
) -> Figure | SubFigure:
    """Mode shapes of a case, one above the other, with frequencies (Hz) and damping ratios.

    Shapes are scaled to the same height. `modes` are computed from the case, and the title is
    its own, if left out. They are drawn on `ax` if it is given.
    """
    modes = find_modes(case) if modes is None else modes
    length = float(concrete(case.beam.length))
    x = np.asarray(positions_along(case, 401))
    shapes = np.asarray(modes.shapes(jnp.asarray(x)))
    shapes = 0.36 * shapes / np.max(np.abs(shapes), axis=0)
    count = shapes.shape[1]
    height = 0.8 if count <= FEW_MODES else 0.45  # inches, of a mode
    figure, axes = single_axes(ax, (7, 1.1 + height * count))
    for i, (frequency, ratio) in enumerate(
        zip(modes.frequencies, modes.damping_ratios, strict=True)
    ):
        shape = shapes[:, i] - i
        axes.plot([0, length], [-i, -i], color=GREY, linewidth=0.8, zorder=1)
        axes.fill_between(x, -i, shape, color=colour(0), alpha=0.12, linewidth=0)
        axes.plot(x, shape, color=colour(0), linewidth=1.8)
        draw_supports(axes, case, y=-i, size=17)
        annotate(
            axes,
            f"{_frequency_text(float(frequency))}\ndamping {100 * float(ratio):.3g} %",
            (1.0, -i),
            (12, 0),
            xycoords=axes.get_yaxis_transform(),
            va="center",
            color=INK,
        )
    axes.set(xlabel="position (m)", ylabel="mode", xlim=(0, length), ylim=(0.6 - count, 0.55))
    axes.set_yticks(-np.arange(count), [str(i + 1) for i in range(count)])
    axes.tick_params(axis="y", length=0, pad=10)
    axes.spines["left"].set_visible(False)
    axes.grid(False, axis="y")
    axes.grid(True, axis="x", color=FAINT)
    set_title(figure, title, case.title, ax)
    return figure


def _frequency_text(frequency: float) -> str:
    factor, unit = unit_scale(frequency, "Hz")
    return f"{format_number(frequency / factor, 4)} {unit}"


# Branches with decay rates above this, relative to the largest frequency, are left out.
MAX_DECAY_RATIO = 3.0


@use_style
def plot_poles(
    poles_along_crossing: FrozenPoles,
    growth: Growth | None = None,
    title: str = "",
    *,
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Poles with frozen loads in the complex plane, and their largest real part over time.

    Dots mark the start of the crossing, shading instability of the frozen loop. With `growth`, the
    growth of deviations since the start is drawn below. The figure takes the place of `ax`.
    """
    rows = 2 if growth is None else 3
    figure = drawing_area(ax, (8.0, 4.6))
    plane, *right = figure.subplot_mosaic([["plane", str(i)] for i in range(rows - 1)]).values()
    poles = poles_along_crossing.poles
    largest_frequency = np.abs(poles.imag).max() or np.abs(poles.real).max()
    for i, branch in enumerate(poles.T):
        if (
            branch.imag.max() < -1e-9 * largest_frequency
            or branch.real.max() < -MAX_DECAY_RATIO * largest_frequency
        ):
            continue
        plane.plot(branch.real, branch.imag, color=colour(i))
        plane.plot(branch.real[0], branch.imag[0], "o", color=colour(i), markersize=4)
    plane.axvline(0, color=INK, linewidth=0.8)
    plane.axvspan(
        0, max(plane.get_xlim()[1], 0.02 * largest_frequency), color=ALARM, alpha=0.08, linewidth=0
    )
    plane.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)", title="frozen poles")
    real_part_axes = right[0]
    real_part_axes.plot(
        poles_along_crossing.times, poles_along_crossing.largest_real_part, color=INK
    )
    real_part_axes.axhline(0, color=ALARM, linewidth=0.8)
    real_part_axes.fill_between(
        poles_along_crossing.times,
        0,
        np.maximum(poles_along_crossing.largest_real_part, 0),
        color=ALARM,
        alpha=0.2,
        linewidth=0,
    )
    real_part_axes.set(
        title="largest real part (1/s)",
        xlim=(poles_along_crossing.times[0], poles_along_crossing.times[-1]),
    )
    if growth is not None:
        growth_axes = right[1]
        real_part_axes.tick_params(labelbottom=False)
        growth_axes.semilogy(growth.times, np.maximum(growth.factor, 1e-4), color=colour(0))
        growth_axes.axhline(1, color=GREY, linewidth=0.8, linestyle=":")
        growth_axes.set(
            title="growth of deviations since the start", xlim=real_part_axes.get_xlim()
        )
    right[-1].set_xlabel("time (s)")
    set_title(figure, title, "")
    return figure


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
