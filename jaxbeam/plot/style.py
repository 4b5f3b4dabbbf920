"""Shared style of all figures: colours, fonts, unit prefixes, labels that do not overlap."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from cycler import cycler
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, SubFigure

from jaxbeam.case.display import UnitScale as UnitScale, unit_scale as unit_scale
from jaxbeam.case.fields import refuses_traced

INK, GREY, FAINT, SHADE = "#22282e", "#6b747c", "#dfe3e6", "#eef2f5"
# Okabe and Ito's colours, distinct with any kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
ALARM = COLOURS[1]
LIMIT = "#b00020"
LIMIT_STYLE = {"color": LIMIT, "linewidth": 1.2, "linestyle": ":"}
F = TypeVar("F", bound=Callable)

STYLES = "-", "--", ":"  # of curves whose colours are used up
LABEL_HEIGHT = 0.17  # inches, of a line of text
LOAD_COLOURS = (INK, "#A6611A", "#7B3294", "#7A868F")  # distinct from COLOURS too

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


def use_style(draw: F) -> F:
    """Function that draws in the style of all figures, and refuses traced numbers."""
    return rc_context(STYLE)(refuses_traced("a figure")(draw))


"""Decorator of functions that draw: the style holds inside them only."""


Size = tuple[int | float, int | float]  # width and height in inches


def axis_label(words: str, unit: str) -> str:
    """Label of an axis: words, and the unit in brackets if there is one."""
    return f"{words} ({unit})" if unit else words


def colour(index: int) -> str:
    """Colour of a sensor or channel by its number; colours repeat after six."""
    return COLOURS[index % len(COLOURS)]


def curve_style(index: int) -> dict[str, str]:
    """Colour and line style of a curve among many, distinct up to eighteen."""
    return {"color": colour(index), "linestyle": STYLES[index // len(COLOURS) % len(STYLES)]}


def load_colour(index: int) -> str:
    """Colour of a load or actuator by its number; colours repeat after four."""
    return LOAD_COLOURS[index % len(LOAD_COLOURS)]


def tinted(tint, strength: float) -> tuple[float, float, float]:
    """Mixture of a colour and white: 1 is the colour, 0 is white."""
    return tuple(1 - strength * (1 - channel) for channel in to_rgb(tint))  # type: ignore[return]


def format_number(value: float, count: int = 3) -> str:
    """Number rounded to `count` significant digits, zeros at its end kept, with a minus sign."""
    return f"{value:#.{count}g}".rstrip(".").replace("-", "\N{MINUS SIGN}")


def command_drawstyle(controller) -> str:
    """Matplotlib's drawstyle for commands: steps if sampled and held, lines if continuous."""
    return "default" if controller.period is None else "steps-post"


def label_height(axes: Axes, words: str, unit: str) -> None:
    """Label the vertical axis: words and unit, in two lines and smaller letters on low axes."""
    figure = axes.get_figure(root=True)
    points = 72 * axes.get_window_extent().height / (figure.dpi if figure else 72)
    text, size = axis_label(words, unit), 9.0
    if 0.55 * size * len(text) > points and unit:
        text = f"{words}\n({unit})"
    longest = max(map(len, text.split("\n")))
    axes.set_ylabel(text, fontsize=min(size, max(6.0, points / (0.55 * longest))))


def drawing_area(ax: Axes | None, size: Size) -> Figure | SubFigure:
    """New figure of some size (inches), or the subfigure that takes the place of `ax`.

    Raises ValueError if the axes have no place in a grid.
    """
    if ax is None:
        return Figure(figsize=size)
    place, figure = ax.get_subplotspec(), ax.get_figure()
    if place is None or figure is None:
        raise ValueError(
            "ax has no place in a grid, which the panels could divide: make it with subplots"
        )
    ax.remove()
    return figure.add_subfigure(place)


@use_style
def page(size: Size) -> Axes:
    """Axes that fill a figure of some size (inches), for `ax` of a function that draws."""
    return Figure(figsize=size).subplots()


def single_axes(ax: Axes | None, size: Size) -> tuple[Figure | SubFigure, Axes]:
    """Figure and axes of a figure of one panel: those given, or new ones of some size (inches).

    Raises ValueError for axes without a figure.
    """
    if ax is None:
        figure = Figure(figsize=size)
        return figure, figure.subplots()
    figure = ax.get_figure()
    if figure is None:
        raise ValueError("ax belongs to no figure: make it with subplots")
    return figure, ax


def set_title(
    figure: Figure | SubFigure, title: str | None, default: str = "", ax: Axes | None = None
) -> None:
    """Set the title of a figure, flush left, or of the axes given; none if it is empty."""
    title = default if title is None else title
    if not title:
        return
    if ax is not None and ax.get_figure() is not None:
        ax.set_title(title, loc="left", fontweight="bold")
    else:
        figure.suptitle(title, x=0.01, ha="left")


def text_fraction(axes: Axes, characters: int, size: float = 9.0) -> float:
    """Approximate width of a text of a font size (points), as a fraction of the axes."""
    figure = axes.get_figure(root=True)
    width = 72 * axes.get_window_extent().width / (figure.dpi if figure else 72)
    return 0.55 * size * characters / width


def annotate(axes, text: str, point, offset, **options) -> None:
    """Text at an offset (points) from a point of the axes; options are those of matplotlib."""
    axes.annotate(text, point, xytext=offset, textcoords="offset points", **options)


def separate_labels(
    positions, gap: float, limits: tuple[float, float] = (-np.inf, np.inf)
) -> Float[np.ndarray, " label"]:
    """Positions at least `gap` apart, order kept, nearest to the wanted ones in least squares.

    They are moved to within the limits if they fit there.
    """
    positions = np.asarray(positions, float)
    order = np.argsort(positions, kind="stable")
    steps = gap * np.arange(positions.size)
    separated = np.empty_like(positions)
    # With the gaps subtracted, positions must not decrease: isotonic regression.
    fitted = _isotonic_regression(positions[order] - steps)
    low, high = limits[0] + gap / 2, limits[1] - gap / 2 - gap * (positions.size - 1)
    separated[order] = np.maximum(np.minimum(fitted, high), low) + steps
    return separated


def _isotonic_regression(values):
    """Nondecreasing values nearest to given ones in least squares: x_k = max_i min_j mean(i to j).

    i <= k <= j (Robertson, Wright and Dykstra 1988, eq 1.4.6); scipy.optimize has it too, but
    takes as long to import as to draw a figure.
    """
    sums, numbers = np.append(0.0, np.cumsum(values)), np.arange(values.size)
    count = numbers + 1 - numbers[:, None]
    means = np.where(count > 0, (sums[1:] - sums[:-1, None]) / np.maximum(count, 1), np.inf)
    least = np.minimum.accumulate(means[:, ::-1], axis=1)[:, ::-1]
    return np.max(np.where(count > 0, least, -np.inf), axis=0, initial=-np.inf)


def margin_labels(axes, heights, labels, colours) -> None:
    """Write labels in the right margin, each beside its height (data units) if there is room.

    Of more labels than fit those farthest from zero are written, with the number of the others.
    """
    low, high = axes.get_ylim()
    inches = axes.get_window_extent().height / axes.get_figure(root=True).dpi
    room = max(2, int(inches / LABEL_HEIGHT))
    entries = list(zip(heights, labels, colours, strict=True))
    if len(entries) > room:
        entries.sort(key=lambda entry: -abs(entry[0]))
        others = f"and {len(entries) - room + 1} more"
        entries = [*entries[: room - 1], (low, others, GREY)]
    gap = LABEL_HEIGHT * (high - low) / inches
    label_heights = separate_labels([entry[0] for entry in entries], gap, (low, high))
    beside = axes.get_yaxis_transform()
    for height, (own, label, tint) in zip(label_heights, entries, strict=True):
        look = {"va": "center", "color": tint, "annotation_clip": False}
        if abs(height - own) > gap / 2:  # a line from where it belongs
            shift = 72 * inches * (height - own) / (high - low)
            look["arrowprops"] = {"arrowstyle": "-", "color": tint, "linewidth": 0.6}
            annotate(axes, label, (1.0, own), (18, shift), xycoords=beside, **look)
        else:
            annotate(axes, label, (1.0, height), (5, 0), xycoords=beside, **look)


def limit_words(limit: float, unit: str) -> str:
    """Name of a limit."""
    return f"limit {format_number(limit)} {unit}".rstrip()


def draw_limits(axes, limits, colours, unit: str = "") -> None:
    """Draw limits of commands as dotted lines, with their values in the right margin."""
    for limit, tint in zip(limits, colours, strict=True):
        axes.axhline(limit, color=tint, linewidth=0.9, linestyle=":")
    margin_labels(axes, limits, [limit_words(limit, unit) for limit in limits], colours)
