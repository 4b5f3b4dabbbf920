"""Bode plots of frequency responses."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import LogFormatter, MultipleLocator, NullFormatter

from jaxbeam.model.frequency_response import FrequencyResponse
from jaxbeam.plot.style import FAINT, colour, drawing_area, set_title, use_style


@use_style
def plot_frequency_response(
    response: FrequencyResponse, *, ax: Axes | None = None, title: str | None = None
) -> Figure | SubFigure:
    """Magnitude and phase over frequency, a column a unit, a curve an input-output pair.

    A frequency of zero, which a logarithmic axis lacks, is left out. The figure takes the place of
    `ax`; its title is that of the response if left out.
    """
    positive = np.asarray(response.frequencies) > 0
    frequencies = np.asarray(response.frequencies)[positive]
    magnitude, phase = (np.asarray(x)[positive] for x in (response.magnitude, response.phase))
    units = list(dict.fromkeys(pair.unit for pair in response.pairs))
    figure = drawing_area(ax, (max(7.0, 1.0 + 4.2 * len(units)), 5.6))
    grid = figure.subplots(2, len(units), squeeze=False, sharex=True, height_ratios=[3, 2])
    for (top, bottom), unit in zip(grid.T, units, strict=True):
        chosen = [i for i, pair in enumerate(response.pairs) if pair.unit == unit]
        for number, i in enumerate(chosen):
            label = str(response.pairs[i]).replace("->", "\N{RIGHTWARDS ARROW}")
            top.loglog(frequencies, magnitude[:, i], color=colour(number), label=label)
            bottom.semilogx(frequencies, phase[:, i], color=colour(number))
        top.set_ylabel("magnitude" if unit == "1" else f"magnitude ({unit.replace('^2', '²')})")
        top.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2)
        # Powers of ten alone would leave an axis of less than a decade without numbers.
        least, most = top.get_ylim()
        within_a_decade = most < 20 * least
        top.yaxis.set_minor_formatter(
            LogFormatter(labelOnlyBase=False) if within_a_decade else NullFormatter()
        )
        top.grid(True, which="minor", color=FAINT, linewidth=0.3)
        low, high = np.min(phase[:, chosen]), np.max(phase[:, chosen])
        bottom.set_ylim(90 * np.floor(low / 90 - 0.1), 90 * np.ceil(high / 90 + 0.1))
        bottom.yaxis.set_major_locator(MultipleLocator(90))
        bottom.xaxis.set_major_formatter("{x:g}")
        bottom.set(xlabel="frequency (Hz)", ylabel="phase (°)")
        bottom.set_xlim(frequencies[0], frequencies[-1])
    set_title(figure, title, response.title)
    return figure
