"""Animation of a run: beam with loads and actuators, readings and commands so far."""

import os

import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.along_beam import positions_along
from jaxbeam.plot.schematic import (
    ACTUATOR_MARKER,
    actuator_positions,
    draw_supports,
)
from jaxbeam.plot.style import (
    COLOURS,
    GREY,
    INK,
    UnitScale,
    axis_label,
    colour,
    command_drawstyle,
    load_colour,
    set_title,
    unit_scale,
    use_style,
)
from jaxbeam.plot.traffic.crossings import shade_crossings
from jaxbeam.plot.traffic.moving import Traffic, check_film, write_film
from jaxbeam.simulation.record import Record


@use_style
def animate(
    record: Record,
    path: str | os.PathLike,
    *,
    frames: int = 120,
    rate: int | float = 24,
    title: str | None = None,
    size: tuple[float, float] | None = None,
    dpi: float | int = 90,
    overwrite: bool = False,
) -> None:
    """Write a GIF or MP4 of the beam, its deflection enlarged, and the loads that cross it.

    Vehicles are boxes on springs, as far above the surface as their bodies move, on the same scale
    unless the profile is rough; it is the line on the beam and beside it. Actuators hang below the
    beam, patches are drawn on it, sensors are dots; the thin line is the envelope of the downward
    deflection. Below is what the sensors measure so far, and the commands if there is a controller.
    The whole run takes `frames` frames, `rate` of them a second; a clock shows its time (s). The
    title is that of the case if left out, `size` is in inches. Raises FileExistsError if the file
    exists and `overwrite` is not set, ValueError for a run that diverges, for another ending than
    .gif and .mp4, and for .mp4 without the program ffmpeg, which writes it.
    """
    check_film(path)
    if not overwrite and os.path.exists(path):
        raise FileExistsError(f"{path} exists; choose another name, or overwrite it")
    if np.isfinite(float(concrete(record.diverged_time))):
        raise ValueError(f"there is nothing to show: {record.verdict}")
    controlled = record.case.controller is not None
    quantities = list(dict.fromkeys(sensor.quantity for sensor in record.case.sensors))
    stage = 3.0 if record.loads.on_ground.any() else 2.2
    heights = [stage] + [1.3] * (len(quantities) + controlled)
    figure = Figure(figsize=size or (6.4, 0.8 + sum(heights)), dpi=dpi)
    canvas = FigureCanvasAgg(figure)
    top, *below = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    updates = [_beam_axes(top, record)]
    values = np.asarray(record.sensor_values)
    for axes, quantity in zip(below, quantities, strict=False):
        own = [i for i, sensor in enumerate(record.case.sensors) if sensor.quantity == quantity]
        scale = unit_scale(values[:, own], QUANTITIES[quantity].unit)
        tints = [colour(i) for i in own]
        updates.append(_history_axes(axes, record, values[:, own], quantity, scale, tints))
    if controlled:
        commands, unit = np.asarray(record.command), record.case.actuators[0].command_unit
        tints = [load_colour(i) for i in range(commands.shape[1])]
        style, scale = command_drawstyle(record.case.controller), UnitScale(1.0, unit)
        updates.append(_history_axes(below[-1], record, commands, "command", scale, tints, style))
    for axes in below[:-1]:
        axes.tick_params(labelbottom=False)
    if below:
        below[-1].set_xlabel("time (s)")
    set_title(figure, title, record.case.title)

    images = []
    for frame in np.linspace(0, record.times.shape[0] - 1, frames).round().astype(int):
        for update in updates:
            update(frame)
        canvas.draw()
        if not images:
            figure.set_layout_engine("none")  # keep the layout of the first frame
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    write_film(path, images, rate)


def _beam_axes(axes, record):
    """Draw the beam; returns a function that draws it at a sample."""
    case = record.case
    x = np.asarray(positions_along(case, 201))
    sensor_positions = np.array([float(concrete(sensor.position)) for sensor in case.sensors])
    beam = np.asarray(record.at(jnp.asarray(x)))
    factor, unit = unit_scale(beam, "m")
    beam = beam / factor
    traffic = Traffic(record, x, beam, factor)
    lowest_deflection = np.minimum.accumulate(beam)
    acting_at = [actuator_positions(actuator) for actuator in case.actuators]
    point_actuators = np.array([positions[0] for positions in acting_at if len(positions) == 1])
    patches = [
        np.linspace(positions[0], positions[1], 20)
        for positions in acting_at
        if len(positions) == 2
    ]

    draw_supports(axes, case)
    axes.axhline(0, color=GREY, linewidth=0.7, linestyle=":")
    (line,) = axes.plot([], [], color=INK, linewidth=3, zorder=2)
    (lowest,) = axes.plot([], [], color=COLOURS[5], linewidth=1, zorder=1.8)
    glyph = {"marker": ACTUATOR_MARKER, "linestyle": "", "markersize": 22, "zorder": 1.9}
    look = {"markerfacecolor": "white", "markeredgecolor": GREY}
    (actuator_markers,) = axes.plot([], [], clip_on=False, **glyph, **look)
    patch_lines = [axes.plot([], [], color=COLOURS[4], linewidth=6, zorder=2.5)[0] for _ in patches]
    sensor_colours = [colour(i) for i in range(sensor_positions.size)]
    sensor_markers = axes.scatter(
        sensor_positions, 0 * sensor_positions, color=sensor_colours, edgecolor="white", zorder=4
    )
    actuator_markers.set_in_layout(False)  # no points yet in the first frame
    clock = axes.text(1, 1, "", transform=axes.transAxes, ha="right", va="top", family="monospace")
    update_traffic = traffic.draw(axes)
    axes.set(xlabel="position (m)", ylabel=f"deflection ({unit})")

    def update(frame):
        def height(positions):
            return np.interp(positions, x, beam[frame])

        line.set_data(x, beam[frame])
        lowest.set_data(x, lowest_deflection[frame])
        actuator_markers.set_data(point_actuators, height(point_actuators))
        for patch, span in zip(patch_lines, patches, strict=True):
            patch.set_data(span, height(span))
        sensor_markers.set_offsets(np.column_stack([sensor_positions, height(sensor_positions)]))
        update_traffic(frame)
        clock.set_text(f"t = {float(record.times[frame]):.3f} s")

    return update


def _history_axes(
    axes, record, values, words: str, scale: UnitScale, tints: list[str], style: str = "default"
):
    """Axes of values over time, a line a column; returns a function that draws them to a sample."""
    times, values = np.asarray(record.times), values / scale.factor
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.7)
    lines = [axes.plot([], [], color=tint, drawstyle=style)[0] for tint in tints]
    low, high = np.min(values), np.max(values)
    margin = 0.08 * ((high - low) or 1.0)
    axes.set(ylim=(low - margin, high + margin), ylabel=axis_label(words, scale.unit))

    def draw(frame):
        for line, column in zip(lines, values.T, strict=True):
            line.set_data(times[: frame + 1], column[: frame + 1])

    return draw
