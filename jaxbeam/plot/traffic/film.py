"""Frames of an animation as a GIF, or as an MP4 by ffmpeg."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from jaxbeam.runtime.whole_file import whole_file

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
    with whole_file(path, overwrite=True) as beside:
        write(beside, frames, rate)


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
