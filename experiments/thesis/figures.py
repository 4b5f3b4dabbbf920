"""Curves that figures of several experiments share: deflections and commands of named records."""

from collections.abc import Mapping, Sequence

import numpy as np

import jaxbeam as jb
from jaxbeam.plot.style import colour


def plot_deflections(
    axes, records: Mapping[str, jb.Record], sensor: int = 0, colours: Sequence[str] | None = None
) -> None:
    """Draw the deflection (mm) at one sensor over time (s), a labelled curve for each record.

    `colours` has one for each record; those of the style if left out.
    """
    for i, (name, record) in enumerate(records.items()):
        history = 1e3 * np.asarray(record.deflection)[:, sensor]
        line_colour = colour(i) if colours is None else colours[i]
        axes.plot(record.times, history, color=line_colour, label=name)


def plot_commands(
    axes,
    records: Mapping[str, jb.Record],
    actuators: Sequence[int] = (0,),
    gains: Sequence[float] | None = None,
    held: bool = False,
    colours: Sequence[str] | None = None,
) -> None:
    """Draw commands (V) to some actuators over time (s), in the colour of each record.

    Records without a controller are left out; the second command is dashed. `gains` has a factor
    for each command. `held` draws steps, for commands that are held between samples.
    """
    drawstyle = "steps-post" if held else "default"
    for i, record in enumerate(records.values()):
        if record.case.controller is None:
            continue
        line_colour = colour(i) if colours is None else colours[i]
        commands = np.asarray(record.command)[:, list(actuators)]
        if gains is not None:
            commands = commands * np.asarray(gains)
        for command, dashes in zip(commands.T, ("-", "--"), strict=False):
            axes.plot(record.times, command, dashes, color=line_colour, drawstyle=drawstyle)
