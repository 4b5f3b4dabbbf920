"""Moving pictures: crossings of loads, and a run with readings and commands so far; their files."""

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.along_beam import positions_along
from jaxbeam.plot.crossings import shade_crossings
from jaxbeam.plot.drawing import (
    ACTUATOR_MARKER,
    LOAD_MARKER,
    actuator_positions,
    draw_supports,
    surface_height,
    vehicle_art,
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
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.simulation.record import Record

WHEEL_SIZE, PLAIN_SIZE = 7.0, 10.0  # points, of wheels of vehicles and of other loads
AXES_HEIGHT = 175.0  # points, about that of the axes of a beam with vehicles
PROFILE_FRACTION = 0.2  # of the range of deflections, for the height of the profile
APPROACH = 0.15  # of the length of the beam, shown before and behind it where there are vehicles


class Traffic:
    """Loads of a record over its `beam`, deflections (time, x) at positions x in units of `factor`.

    Wheels of vehicles are seen before and behind the beam too, other loads on it only.
    """

    def __init__(self, record: Record, x, beam, factor: float):
        self._record, self._x, self._beam, self._factor = record, x, beam, factor
        self._loads = record.loads
        positions = np.asarray(concrete(self._loads.kinematics(record.times)[0])).T
        on_beam = np.isfinite(np.asarray(record.load_position))
        self._positions = np.where(on_beam | self._loads.on_ground, positions, np.nan)
        length = float(concrete(record.case.beam.length))
        self._ground = record.case.profile is not None or bool(self._loads.on_ground.any())
        margin = (APPROACH if self._ground else 0.02) * length
        self._xlim = -margin, length + margin
        self._wide = np.linspace(*self._xlim, 401)
        self._profile = surface_height(record.case, self._wide) / factor

    def _deflection(self, frame, positions):
        """Deflection at positions in units of the axis, zero off the beam."""
        return np.interp(positions, self._x, self._beam[frame], left=0.0, right=0.0)

    def _make_room(self, art, scale: float) -> float:
        """Draw springs as long as needed; returns their change of length in units of the axis."""
        frames = range(self._positions.shape[0])
        under = scale * surface_height(self._record.case, self._positions) / self._factor
        # Bodies follow the beam by the fraction that is not in their motion.
        under += scale * np.stack([self._deflection(i, self._positions[i]) for i in frames])
        motion, first, room = scale * self._motion(), 0, 0.0
        for one in art:
            own = motion[:, first : first + one.dofs]
            room = max(room, one.make_room(under[:, one.wheels], own))
            first += one.dofs
        return room

    def _motion(self):
        return np.asarray(self._record.body_displacement) / self._factor

    def draw(self, axes) -> Callable[[int], None]:
        """Set the limits of the axes and draw the loads; returns a function that moves them.

        If the profile is high against the deflections, heights r of the profile and u of the bodies
        are drawn k times as large: the surface at w + k r, bodies at k u + (1 - k) w.
        """
        case, loads = self._record.case, self._loads
        low, high = min(np.min(self._beam), 0.0), max(np.max(self._beam), 0.0)
        height_range = (high - low) or 1.0
        bottom, top, margin = low - 0.15 * height_range, high, 0.4 / 1.55
        if loads.on_ground.any():
            tallest = max(one.height for one in vehicle_art(axes, case, WHEEL_SIZE, 1.0))
            margin = min(0.7, (tallest * WHEEL_SIZE + 14.0) / AXES_HEIGHT)
        rough = np.max(np.abs(self._profile))
        scale = min(1.0, PROFILE_FRACTION * height_range / rough) if rough > 0 else 1.0
        motion, profile = scale * self._motion(), scale * self._profile
        bottom += min(0.0, np.min(profile))
        top += max(0.0, np.max(profile), np.max(self._heights(motion), initial=0.0) - high)
        # Twice: wheels, of a size in points, are higher in units of a longer axis.
        room = self._make_room(vehicle_art(axes, case, WHEEL_SIZE, 0.0), scale)
        top += room + (top + room - bottom) * margin / (1 - margin)
        art = vehicle_art(axes, case, WHEEL_SIZE, WHEEL_SIZE / AXES_HEIGHT * (top - bottom))
        self._make_room(art, scale)
        axes.set(xlim=self._xlim, ylim=(bottom, top))
        if scale < 1:
            words = f"profile and suspensions: scale x {scale:.2g}"
            words = words.replace(" x ", " \N{MULTIPLICATION SIGN} ")
            axes.text(0, 1, words, transform=axes.transAxes, va="top", color=GREY, fontsize=8)
        (plain,) = axes.plot([], [], linestyle="", marker=LOAD_MARKER, markersize=2 * PLAIN_SIZE)
        plain.set(color=COLOURS[5], markeredgecolor=INK, clip_on=False, zorder=3)
        (surface,) = axes.plot([], [], color=GREY, linewidth=0.9, zorder=2.3)
        for moving in (plain, surface):
            moving.set_in_layout(False)  # no points yet in the first frame

        def height(frame, positions):
            rough = scale * surface_height(case, positions) / self._factor
            return self._deflection(frame, positions) + rough

        def update(frame):
            here = self._positions[frame]
            on = here[~loads.on_ground]
            on = on[np.isfinite(on)]
            plain.set_data(on, height(frame, on))
            if self._ground:
                surface.set_data(self._wide, height(frame, self._wide))
            first = 0
            for one in art:
                wheels = here[one.wheels]
                u = motion[frame, first : first + one.dofs]
                one.update(
                    wheels,
                    height(frame, wheels),
                    u,
                    lambda x: (1 - scale) * self._deflection(frame, x),
                )
                first += one.dofs

        return update

    def _heights(self, motion):
        """Motions of the degrees of freedom that are heights, without rotations."""
        return motion[:, [not name.endswith(" pitch") for name in self._record.bodies]]


PALETTE_SIZE = 96  # colours of the GIF; few keep the file small
EVEN = "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"  # sides, as H.264 wants them


def check_film(path: str | os.PathLike) -> None:
    """Check that a film can be written to a file, before its frames are drawn.

    Raises ValueError for another ending than .gif and .mp4, and for .mp4 without ffmpeg.
    """
    suffix = Path(path).suffix
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: an animation is written to a file of .gif or .mp4")
    if suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise ValueError(
            f"{path}: .mp4 files need the program ffmpeg, which is not installed; write a .gif"
        )


def write_film(path: str | os.PathLike, frames: Sequence[Image.Image], rate: int | float) -> None:
    """Write frames, `rate` of them a second, to a .gif or .mp4 file (see `check_film`).

    Raises OSError if ffmpeg fails.
    """
    write = _write_mp4 if Path(path).suffix == ".mp4" else _write_gif
    with whole_file(path, overwrite=True) as partial:
        write(partial, frames, rate)


def _write_gif(path: Path, frames: Sequence[Image.Image], rate) -> None:
    # One palette for all frames, of the last and fullest: GIF stores only what changes.
    palette = frames[-1].quantize(PALETTE_SIZE)
    first, *others = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in frames)
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=round(1000 / rate),
        loop=0,
    )


def _write_mp4(path, frames: Sequence[Image.Image], rate) -> None:
    width, height = frames[0].size
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(rate)]
    target = ["-vf", EVEN, "-pix_fmt", "yuv420p", os.fspath(path)]
    line = ["ffmpeg", "-y", "-loglevel", "error", *source, "-i", "-", *target]
    content = b"".join(one.tobytes() for one in frames)
    ended = subprocess.run(line, input=content, capture_output=True)
    if ended.returncode:
        raise OSError(f"ffmpeg could not write {path}: {ended.stderr.decode(errors='replace')}")


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
