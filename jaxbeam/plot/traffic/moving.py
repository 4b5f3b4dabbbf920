"""Moving pictures of crossings, and their files."""

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from jaxbeam.case.fields import concrete
from jaxbeam.plot.schematic import LOAD_MARKER, surface_height
from jaxbeam.plot.style import COLOURS, GREY, INK
from jaxbeam.plot.traffic.drawing import vehicle_art
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
