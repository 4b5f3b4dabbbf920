"""Thumbnails of the landing page: size, films, high pictures."""

import numpy as np
import pytest
from PIL import Image

from tests.modules import ROOT


def test_a_film_is_shown_by_its_middle_frame_and_a_high_picture_by_its_top(tmp_path):
    pytest.importorskip("sphinx")
    from docs._ext import thumbnails

    frames = [Image.new("RGB", (64, 16), color) for color in ("red", "lime", "blue")]
    frames[0].save(tmp_path / "film.gif", save_all=True, append_images=frames[1:])
    small = thumbnails.thumbnail(tmp_path / "film.gif")
    assert small.size == thumbnails.SIZE
    assert small.getpixel((160, 120)) == (0, 255, 0)
    assert small.getpixel((160, 5)) == (255, 255, 255)  # wide pictures are in the middle
    high = Image.fromarray(np.repeat([[[0] * 3], [[255] * 3]], 50, axis=0).astype(np.uint8))
    high.resize((20, 100)).save(tmp_path / "high.png")
    assert thumbnails.thumbnail(tmp_path / "high.png").getpixel((160, 230)) == (0, 0, 0)


def test_all_pictures_of_the_gallery_have_sections_of_their_own():
    """Twenty, in the order of their numbers."""
    text = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    titles = [line for line in text.splitlines() if line.startswith("## ")]
    assert [title.split(".")[0] for title in titles] == [f"## {n}" for n in range(1, 21)]
