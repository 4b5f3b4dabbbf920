"""Figure of an assessment: effects of trains over speed, with limit lines."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.analysis.assessment.assessment import Assessment
from jaxbeam.plot.style import COLOURS, colour, drawing_area, set_title, use_style

LIMIT = "#b00020"
STYLES = "-", ":", "-."  # of curves whose colours are used up
HEADROOM = 1.3  # of the axes over the largest value, for the name of the limit
WIDTH, HEIGHT, LEGEND = 9.0, 2.3, 1.3  # inches, of the figure, a row of axes, the legend


@use_style
def plot_assessment(
    found: Assessment, *, ax: Axes | None = None, title: str | None = None
) -> Figure | SubFigure:
    """Deck acceleration, and each kind of effect over that of LM71 with its factors, over speed.

    A curve for each train, the largest of all its sections; limits are dashed. They take the place
    of `ax`, if it is given. The title is that of the bridge if left out.

    Raises ValueError for an assessment without a dynamic analysis, and as `drawing_area` does.
    """
    effects = found.effects
    if effects is None:
        raise ValueError(
            "the assessment has no effects over speed: ask for the dynamic analysis (dynamic=True)"
        )
    kinds = list(dict.fromkeys(effects.quantities))
    rows = -(-len(kinds) // 2)
    figure = drawing_area(ax, (WIDTH, LEGEND + HEIGHT * rows))
    axes = np.ravel(figure.subplots(rows, 2, sharex=True, squeeze=False))
    limits = np.array(effects.limits)
    for one, kind in zip(axes, kinds, strict=False):
        own = np.array(effects.quantities) == kind
        scale = np.ones(own.sum()) if kind == "acceleration" else limits[own]
        limit = limits[own].max() if kind == "acceleration" else 1.0
        for number, curve in enumerate(effects.curves):
            values = (curve.values[:, own] / scale).max(axis=1)
            style = STYLES[number // len(COLOURS) % len(STYLES)]
            one.plot(3.6 * curve.speeds, values, style, color=colour(number), label=curve.train)
        text = f"limit {limit:g} m/s²" if kind == "acceleration" else "LM71 with factors"
        line = one.axhline(limit, color=LIMIT, linestyle="--", linewidth=1.0, label=text)
        words = "deck acceleration (m/s²)" if kind == "acceleration" else f"{kind} / LM71"
        one.set_ylabel(words)
        one.set_ylim(bottom=0, top=HEADROOM * max(limit, one.get_ylim()[1]))
        one.legend(handles=[line], loc="upper left", fontsize=8)
    for one in axes[len(kinds) :]:
        one.set_visible(False)
    for one in axes[max(0, len(kinds) - 2) : len(kinds)]:
        one.set_xlabel("speed (km/h)")
        one.tick_params(labelbottom=True)
    handles = axes[0].get_lines()[:-1]
    labels = [curve.train for curve in effects.curves]
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(labels), 5), fontsize=8
    )
    set_title(figure, title, found.title)
    return figure
