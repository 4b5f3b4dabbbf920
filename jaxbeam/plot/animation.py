"""A run as a moving picture: the beam with its loads and actuators, and what happened so far."""

import os

import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxbeam.case.fields import known
from jaxbeam.plot.record import shade
from jaxbeam.plot.schematic import BALL, DEVICE, draw_supports
from jaxbeam.plot.style import (
    COLOURS,
    GREY,
    INK,
    colour,
    load_colour,
    name,
    scale,
    styled,
)
from jaxbeam.simulation.record import Record

TINTS = 96  # colours of the GIF: few, so that it stays small


@styled
def animate(
    record: Record,
    path: str | os.PathLike,
    *,
    frames: int = 120,
    rate: int | float = 24,
    overwrite: bool = False,
) -> None:
    """Write a GIF of the beam (deflection enlarged) with the loads that cross it.

    Actuators hang below the beam, or are drawn on it if bonded, the thin line is how low the beam
    has been; sensors are dots, and below are their deflections so far, and the commands if there
    is a controller. The run is shown in so many `frames`, `rate` of them a second, whatever it
    took; a clock tells the time. Raises FileExistsError if the file exists and `overwrite` is not
    set, and ValueError for a loop that diverges.
    """
    if not overwrite and os.path.exists(path):
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    if np.isfinite(float(known(record.diverged_time))):
        raise ValueError(f"there is nothing to show: {record.verdict}")
    commanded = record.case.controller is not None
    heights = [2.2] + [1.3] * (bool(record.case.sensors) + commanded)
    figure = Figure(figsize=(6.4, 0.8 + sum(heights)), dpi=90)
    canvas = FigureCanvasAgg(figure)
    top, *below = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    moves = [_beam(top, record)]
    if record.case.sensors:
        moves.append(_history(below[0], record, np.asarray(record.deflection), "deflection"))
    if commanded:
        moves.append(_history(below[-1], record, np.asarray(record.command), "command"))
    for axes in below[:-1]:
        axes.tick_params(labelbottom=False)
    if below:
        below[-1].set_xlabel("time (s)")
    name(figure, record.case.title)

    images = []
    for frame in np.linspace(0, record.times.shape[0] - 1, frames).round().astype(int):
        for move in moves:
            move(frame)
        canvas.draw()
        if not images:
            figure.set_layout_engine("none")  # found once; a moving layout would tremble
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # One palette for all, from the fullest picture: what stays the same is stored once.
    palette = images[-1].quantize(TINTS)
    first, *others = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in images)
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=round(1000 / rate),
        loop=0,
    )


def _beam(axes, record):
    """Draw the rig; return what moves it to a sample."""
    case = record.case
    length = float(known(case.beam.length))
    x = np.linspace(0, length, 201)
    where = np.array([float(known(sensor.position)) for sensor in case.sensors])
    loads = np.asarray(record.load_position)
    beam = np.asarray(record.at(jnp.asarray(x)))
    factor, unit = scale(beam, "m")
    beam = beam / factor
    so_far = np.minimum.accumulate(beam)
    strokes = [[float(known(p)) for p, _, _ in actuator.stroke()] for actuator in case.actuators]
    spots = np.array([places[0] for places in strokes if len(places) == 1])
    spans = [np.linspace(places[0], places[1], 20) for places in strokes if len(places) == 2]

    draw_supports(axes, case)
    axes.axhline(0, color=GREY, linewidth=0.7, linestyle=":")
    (line,) = axes.plot([], [], color=INK, linewidth=3, zorder=2)
    (lowest,) = axes.plot([], [], color=COLOURS[5], linewidth=1, zorder=1.8)
    glyph = {"marker": DEVICE, "linestyle": "", "markersize": 22, "zorder": 1.9}
    look = {"markerfacecolor": "white", "markeredgecolor": GREY}
    (devices,) = axes.plot([], [], clip_on=False, **glyph, **look)
    bonded = [axes.plot([], [], color=COLOURS[4], linewidth=6, zorder=2.5)[0] for _ in spans]
    tints = [colour(i) for i in range(where.size)]
    dots = axes.scatter(where, 0 * where, color=tints, edgecolor="white", zorder=4)
    (balls,) = axes.plot([], [], linestyle="", marker=BALL, markersize=20, color=COLOURS[5])
    balls.set(markeredgecolor=INK, clip_on=False, zorder=3)
    for moving in (devices, balls):
        moving.set_in_layout(False)  # what is not there yet has no place
    clock = axes.text(1, 1, "", transform=axes.transAxes, ha="right", va="top", family="monospace")
    low, high = min(beam.min(), 0.0), max(beam.max(), 0.0)
    room = (high - low) or 1.0
    axes.set(xlim=(-0.02 * length, 1.02 * length), ylim=(low - 0.15 * room, high + 0.4 * room))
    axes.set(xlabel="position (m)", ylabel=f"deflection ({unit})")

    def move(frame):
        def height(places):
            return np.interp(places, x, beam[frame])

        line.set_data(x, beam[frame])
        lowest.set_data(x, so_far[frame])
        devices.set_data(spots, height(spots))
        for patch, span in zip(bonded, spans, strict=True):
            patch.set_data(span, height(span))
        dots.set_offsets(np.column_stack([where, height(where)]))
        on = loads[frame][np.isfinite(loads[frame])]
        balls.set_data(on, height(on))
        clock.set_text(f"t = {float(record.times[frame]):.3f} s")

    return move


def _history(axes, record, values, what):
    """Prepare axes for the columns of some values over time; return what draws them so far."""
    times = np.asarray(record.times)
    unit, factor, tint, style = "", 1.0, load_colour, "default"
    if what == "deflection":
        (factor, unit), tint = scale(values, "m"), colour
    else:
        actuator = record.case.actuators[0]
        unit = type(actuator).__dataclass_fields__["limits"].metadata["unit"]
        if record.case.controller.period is not None:
            style = "steps-post"
    values = values / factor
    shade(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.7)
    lines = [axes.plot([], [], color=tint(i), drawstyle=style)[0] for i in range(values.shape[1])]
    low, high = np.min(values), np.max(values)
    room = 0.08 * ((high - low) or 1.0)
    axes.set(ylim=(low - room, high + room), ylabel=f"{what} ({unit})")

    def draw(frame):
        for line, column in zip(lines, values.T, strict=True):
            line.set_data(times[: frame + 1], column[: frame + 1])

    return draw
