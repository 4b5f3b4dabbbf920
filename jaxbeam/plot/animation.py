"""A run as a moving picture."""

import os

import jax.numpy as jnp
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

from jaxbeam.fields import known
from jaxbeam.plot.schematic import BALL, draw_supports
from jaxbeam.plot.style import COLOURS, GREY, INK, colour, name, scale, styled
from jaxbeam.record import Record


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

    The run is shown in so many `frames`, `rate` of them a second, whatever it took; a clock tells
    the time. Raises FileExistsError if the file exists and `overwrite` is not set.
    """
    if not overwrite and os.path.exists(path):
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    length = float(known(record.case.beam.length))
    x = np.linspace(0, length, 201)
    where = np.array([float(known(sensor.position)) for sensor in record.case.sensors])
    loads = np.asarray(record.load_position)
    chosen = np.linspace(0, record.times.shape[0] - 1, frames).round().astype(int)
    beam = np.asarray(record.at(jnp.asarray(x)))
    factor, unit = scale(beam, "m")
    beam = beam / factor

    figure = Figure(figsize=(7, 2.9), dpi=110)
    axes = figure.subplots()
    draw_supports(axes, record.case)
    axes.axhline(0, color=GREY, linewidth=0.7, linestyle=":")
    (line,) = axes.plot(x, beam[0], color=INK, linewidth=3, zorder=2)
    dots = axes.scatter(
        where, 0 * where, color=[colour(i) for i in range(where.size)], edgecolor="white", zorder=4
    )
    (balls,) = axes.plot([], [], linestyle="", marker=BALL, markersize=22, color=COLOURS[4])
    clock = axes.text(1, 1, "", transform=axes.transAxes, ha="right", va="top", family="monospace")
    reach = 1.1 * np.max(np.abs(beam)) or 1.0
    axes.set(xlim=(0, length), ylim=(-reach, reach), xlabel="position (m)")
    axes.set_ylabel(f"deflection ({unit})")
    name(figure, record.case.title)
    writer = PillowWriter(fps=rate)
    with writer.saving(figure, os.fspath(path), dpi=figure.dpi):
        for frame in chosen:
            line.set_ydata(beam[frame])
            dots.set_offsets(np.column_stack([where, np.interp(where, x, beam[frame])]))
            balls.set_data(loads[frame], np.interp(loads[frame], x, beam[frame]))
            clock.set_text(f"t = {float(record.times[frame]):.3f} s")
            writer.grab_frame()
