"""Cases to draw, and what is read from figures: texts and curves."""

import dataclasses

import numpy as np
from matplotlib.text import Text

import jaxbeam as jb

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.15), jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.1)],
    run=jb.Run(duration=0.5, sample_rate=400.0),
    title="one ball",
)
MANY = dataclasses.replace(
    CASE,
    supports=[jb.Support(0.4, stiffness=1e4), jb.Support(0.5)],
    actuators=[jb.Patch(0.1, 0.2, 1e-3), jb.Shaker(0.3)],
    loads=[
        jb.MovingMass(mass=3.0, speed=6.0),
        jb.MovingForce(force=2.0, speed=-1.0, entry_time=0.2, deceleration=1.0),
        jb.MovingMass(mass=1.0, speed=1.0, entry_time=9.0),
    ],
)


def words(figure) -> str:
    """Visible texts of a figure, a line each."""
    figure.draw_without_rendering()
    texts = figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible())
    return "\n".join(text.get_text() for text in texts)


def data(line) -> np.ndarray:
    """Coordinates of the points of a curve, (2, point)."""
    return np.asarray(line.get_xydata(), float).T


def lines_of(axes, size: int):
    """Curves of an axes with `size` points."""
    return [line for line in axes.lines if np.size(data(line)[0]) == size]
