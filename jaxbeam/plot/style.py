"""What all pictures have in common: colours, type, units with prefixes, labels that keep apart."""

from typing import NamedTuple

import numpy as np
import scipy
from cycler import cycler
from jaxtyping import Float
from matplotlib import rc_context

INK, GREY, FAINT, SHADE = "#22282e", "#6b747c", "#dfe3e6", "#eef2f5"
# Okabe and Ito's colours, which can be told apart with any kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
ALARM = COLOURS[1]
LOAD_COLOURS = (INK, "#A6611A", "#7B3294", "#7A868F")  # as far from those as from each other

STYLE = {
    "figure.dpi": 150,
    "figure.titlesize": 11,
    "figure.titleweight": "bold",
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "text.color": INK,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
}

use_style = rc_context(STYLE)
"""Decorator: what the function draws has the style; nothing outside of it changes."""


class UnitScale(NamedTuple):
    """Values divided by `factor` are in `unit`."""

    factor: float
    unit: str


_PREFIXES = ((1e6, 1e6, "M"), (1e3, 1e3, "k"), (0.1, 1.0, ""), (1e-4, 1e-3, "m"), (1e-7, 1e-6, "µ"))


def unit_scale(values, unit: str) -> UnitScale:
    """The prefix with which values in an SI unit read best: 0.0014 m as 1.4 mm.

    A number without unit ("1") gets a power of ten instead.
    """
    sizes = np.abs(np.asarray(values, float))
    largest = np.max(sizes[np.isfinite(sizes)], initial=0.0)
    fitting = ((factor, prefix) for least, factor, prefix in _PREFIXES if largest >= least)
    factor, prefix = next(fitting, (1e-9, "n")) if largest else (1.0, "")
    if unit in ("", "1"):
        return UnitScale(factor, "" if factor == 1 else f"$10^{{{np.log10(factor):.0f}}}$")
    return UnitScale(factor, prefix + unit.replace("^2", "²"))


def colour(index: int) -> str:
    """Colour of a sensor or channel by its number; they repeat after six."""
    return COLOURS[index % len(COLOURS)]


def load_colour(index: int) -> str:
    """Colour of a load by its number; they repeat after four."""
    return LOAD_COLOURS[index % len(LOAD_COLOURS)]


def format_number(value: float, count: int = 3) -> str:
    """A number rounded to so many digits, zeros at its end kept, with a proper minus sign."""
    return f"{value:#.{count}g}".rstrip(".").replace("-", "\N{MINUS SIGN}")


def set_title(figure, title: str) -> None:
    """Write a title over a figure, at the left."""
    if title:
        figure.suptitle(title, x=0.01, ha="left")


def separate_labels(positions, gap: float) -> Float[np.ndarray, " label"]:
    """Places at least `gap` apart, in the order of those wanted and as near to them as can be."""
    positions = np.asarray(positions, float)
    order = np.argsort(positions, kind="stable")
    steps = gap * np.arange(positions.size)
    separated = np.empty_like(positions)
    # The gaps taken away, "at least a gap apart" means "not falling": a monotone regression.
    separated[order] = scipy.optimize.isotonic_regression(positions[order] - steps).x + steps
    return separated


def margin_labels(axes, heights, labels, colours) -> None:
    """Write labels in the right margin, each beside its height (data units) if there is room."""
    low, high = axes.get_ylim()
    inches = axes.get_figure().get_figheight() * axes.get_position().height
    label_heights = separate_labels(heights, 0.17 * (high - low) / inches)
    for place, label, tint in zip(label_heights, labels, colours, strict=True):
        axes.annotate(
            label,
            (1.0, place),
            xycoords=axes.get_yaxis_transform(),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            color=tint,
            annotation_clip=False,
        )
