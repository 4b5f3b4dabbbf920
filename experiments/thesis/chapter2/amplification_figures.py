"""Figures of moving masses and forces: histories, amplification over speed, and maps."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxbeam.plot.style import GREY, INK, SHADE, colour, set_title, unit_scale, use_style

LIFT_OFF_LABEL = "the mass would have to pull"


@use_style
def draw_histories(pairs) -> Figure:
    """Deflection histories by a moving mass and a moving force, one panel for each pair of runs.

    `pairs` maps a title to the records (mass, force).
    """
    figure = Figure(figsize=(7.2, 2.1 * len(pairs)))
    for axes, (title, runs) in zip(figure.subplots(len(pairs), 1), pairs.items(), strict=True):
        histories = [np.asarray(run.deflection)[:, 0] for run in runs]
        factor, unit = unit_scale(histories, "m")
        times = np.asarray(runs[0].times)
        for i, (history, word) in enumerate(zip(histories, ("mass", "force"), strict=True)):
            axes.plot(
                times, history / factor, ("-", "--")[i], color=colour(i), label=f"moving {word}"
            )
        case = runs[0].case
        exit_time = float(case.beam.length) / float(case.loads[0].speed)
        axes.axvline(exit_time, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(
            "exit",
            (exit_time, 0.97),
            xycoords=axes.get_xaxis_transform(),
            va="top",
            xytext=(3, 0),
            textcoords="offset points",
            color=GREY,
        )
        axes.set(title=title, ylabel=f"deflection ({unit})", xlim=(0, times[-1]))
    axes.set_xlabel("time (s)")
    figure.axes[0].legend(loc="lower right")
    set_title(figure, "Moving mass and moving force")
    return figure


@use_style
def draw_curves(force, mass, panels, title: str) -> Figure:
    """Amplification over the speed ratio, by a force and a mass.

    `force` and `mass` are sweeps of amplification; each of `panels` is a mass (kg), the number of a
    sensor, and a title.
    """
    figure, highest = Figure(figsize=(7.2, 3.2)), 0.0
    for axes, (panel_mass, sensor, panel_title) in zip(
        figure.subplots(1, len(panels), sharey=True), panels, strict=True
    ):
        i = int(np.argmin(np.abs(mass.masses - panel_mass)))
        axes.plot(
            force.speed_ratios,
            force.amplification[0, :, sensor],
            color=colour(0),
            label="moving force",
        )
        lifts_off = mass.contact_force_ratio[i] < 0
        curve = mass.amplification[i, :, sensor]
        axes.plot(mass.speed_ratios, curve, "--", color=colour(1), label="moving mass")
        axes.fill_between(
            mass.speed_ratios,
            0,
            1,
            where=lifts_off,
            transform=axes.get_xaxis_transform(),
            facecolor=SHADE,
            edgecolor=GREY,
            hatch="////",
            linewidth=0,
            alpha=0.6,
            label=LIFT_OFF_LABEL,
        )
        axes.set(
            title=panel_title, xlabel=r"speed ratio $v / v_{cr1}$", xlim=(0, mass.speed_ratios[-1])
        )
        highest = max(highest, curve.max())
    figure.axes[0].set_ylim(0, 1.05 * highest)
    figure.axes[0].set_ylabel("dynamic amplification")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, f"Amplification at midspan ({title})")
    return figure


@use_style
def draw_map(mass, panel_titles, title: str) -> Figure:
    """Amplification over mass and speed ratio, hatched where the mass would have to pull.

    `mass` is a sweep of amplification; there is one panel, with a title, for each sensor.
    """
    figure = Figure(figsize=(1.4 + 3.4 * len(panel_titles), 3.6))
    panels = figure.subplots(1, len(panel_titles), sharey=True, squeeze=False)[0]
    lifts_off = mass.contact_force_ratio < 0
    in_contact = np.where(lifts_off[..., None], np.nan, mass.amplification)
    highest = np.ceil(4 * np.nanmax(in_contact)) / 4
    fills, lines = np.arange(0.9, highest + 0.01, 0.05), np.arange(1, highest + 0.01, 0.25)
    for i, (axes, panel_title) in enumerate(zip(panels, panel_titles, strict=True)):
        axes.set_facecolor(SHADE)
        over = mass.speed_ratios, mass.masses
        # Drawn everywhere, so that colours reach the edge of the hatched cover.
        filled = axes.contourf(
            *over, mass.amplification[..., i], fills, cmap="YlGnBu", extend="both"
        )
        drawn = axes.contour(*over, in_contact[..., i], lines, colors=INK, linewidths=0.5)
        cover = axes.contourf(*over, np.where(lifts_off, 1.0, 0.0), [0.5, 1.5], colors=SHADE)
        cover.set(hatch="////", edgecolor=GREY, linewidth=0)
        axes.clabel(drawn, fontsize=7, fmt="%.4g")
        axes.set(title=panel_title, xlabel=r"speed ratio $v / v_{cr1}$", xscale="log")
        axes.set_xlim(mass.speed_ratios[0], mass.speed_ratios[-1])
        ticks = [tick for tick in (0.05, 0.1, 0.2, 0.5, 1, 2) if tick <= mass.speed_ratios[-1]]
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.grid(False)
    panels[0].set_ylabel("mass (kg)")
    bar = figure.colorbar(filled, ax=panels, label="dynamic amplification", pad=0.02)
    bar.outline.set_visible(False)
    key = Patch(facecolor=SHADE, edgecolor=GREY, hatch="////", linewidth=0, label=LIFT_OFF_LABEL)
    figure.legend(handles=[key], loc="outside lower center")
    set_title(figure, f"Amplification by a moving mass: {title}")
    return figure
