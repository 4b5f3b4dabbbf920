"""Pictures of moving masses and forces: histories, amplification over speed, and maps."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxbeam.plot.style import GREY, INK, SHADE, colour, name, scale, styled

LOST = "the mass would have to pull"


@styled
def draw_histories(pairs) -> Figure:
    """Deflections by a moving mass and a moving force, one panel for each (mass, force) of runs."""
    figure = Figure(figsize=(7.2, 2.1 * len(pairs)))
    for axes, (title, runs) in zip(figure.subplots(len(pairs), 1), pairs.items(), strict=True):
        histories = [np.asarray(run.deflection)[:, 0] for run in runs]
        factor, unit = scale(histories, "m")
        times = np.asarray(runs[0].times)
        for i, (history, word) in enumerate(zip(histories, ("mass", "force"), strict=True)):
            axes.plot(
                times, history / factor, ("-", "--")[i], color=colour(i), label=f"moving {word}"
            )
        case = runs[0].case
        leaves = float(case.beam.length) / float(case.loads[0].speed)
        axes.axvline(leaves, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(
            "exit",
            (leaves, 0.97),
            xycoords=axes.get_xaxis_transform(),
            va="top",
            xytext=(3, 0),
            textcoords="offset points",
            color=GREY,
        )
        axes.set(title=title, ylabel=f"deflection ({unit})", xlim=(0, times[-1]))
    axes.set_xlabel("time (s)")
    figure.axes[0].legend(loc="lower right")
    name(figure, "Moving mass and moving force")
    return figure


@styled
def draw_curves(force, mass, panels, title: str) -> Figure:
    """Amplification over the speed ratio: `panels` are (mass in kg, place, words)."""
    figure, highest = Figure(figsize=(7.2, 3.2)), 0.0
    for axes, (kilograms, place, words) in zip(
        figure.subplots(1, len(panels), sharey=True), panels, strict=True
    ):
        i = int(np.argmin(np.abs(mass.masses - kilograms)))
        axes.plot(
            force.ratios, force.amplification[0, :, place], color=colour(0), label="moving force"
        )
        pulls = mass.contact[i] < 0
        curve = mass.amplification[i, :, place]
        axes.plot(mass.ratios, curve, "--", color=colour(1), label="moving mass")
        axes.fill_between(
            mass.ratios,
            0,
            1,
            where=pulls,
            transform=axes.get_xaxis_transform(),
            facecolor=SHADE,
            edgecolor=GREY,
            hatch="////",
            linewidth=0,
            alpha=0.6,
            label=LOST,
        )
        axes.set(title=words, xlabel=r"speed ratio $v / v_{cr1}$", xlim=(0, mass.ratios[-1]))
        highest = max(highest, curve.max())
    figure.axes[0].set_ylim(0, 1.05 * highest)
    figure.axes[0].set_ylabel("dynamic amplification")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    name(figure, f"Amplification at midspan ({title})")
    return figure


@styled
def draw_map(mass, words, title: str) -> Figure:
    """Amplification over mass and speed ratio; hatched where a mass would have to pull."""
    figure = Figure(figsize=(1.4 + 3.4 * len(words), 3.6))
    panels = figure.subplots(1, len(words), sharey=True, squeeze=False)[0]
    lost = mass.contact < 0
    kept = np.where(lost[..., None], np.nan, mass.amplification)
    highest = np.ceil(4 * np.nanmax(kept)) / 4
    fills, lines = np.arange(0.9, highest + 0.01, 0.05), np.arange(1, highest + 0.01, 0.25)
    for i, (axes, place) in enumerate(zip(panels, words, strict=True)):
        axes.set_facecolor(SHADE)
        over = mass.ratios, mass.masses
        # All of it, so that colours reach the edge of what is then covered.
        filled = axes.contourf(
            *over, mass.amplification[..., i], fills, cmap="YlGnBu", extend="both"
        )
        drawn = axes.contour(*over, kept[..., i], lines, colors=INK, linewidths=0.5)
        cover = axes.contourf(*over, np.where(lost, 1.0, 0.0), [0.5, 1.5], colors=SHADE)
        cover.set(hatch="////", edgecolor=GREY, linewidth=0)
        axes.clabel(drawn, fontsize=7, fmt="%.4g")
        axes.set(title=place, xlabel=r"speed ratio $v / v_{cr1}$", xscale="log")
        axes.set_xlim(mass.ratios[0], mass.ratios[-1])
        ticks = [tick for tick in (0.05, 0.1, 0.2, 0.5, 1, 2) if tick <= mass.ratios[-1]]
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.grid(False)
    panels[0].set_ylabel("mass (kg)")
    bar = figure.colorbar(filled, ax=panels, label="dynamic amplification", pad=0.02)
    bar.outline.set_visible(False)
    key = Patch(facecolor=SHADE, edgecolor=GREY, hatch="////", linewidth=0, label=LOST)
    figure.legend(handles=[key], loc="outside lower center")
    name(figure, f"Amplification by a moving mass: {title}")
    return figure
