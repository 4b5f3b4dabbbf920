"""Amplification by moving masses and moving forces: Figs 2.23 to 2.27.

Amplification is the largest dynamic over the largest static deflection at a midspan, free vibration
after the exit included. The maps mark where the contact force becomes negative: the mass would have
to pull on the beam to stay on it.

Figures of moving masses and forces: histories, amplification over speed, and maps.
"""

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

import jaxbeam as jb
from experiments.thesis.cases import (
    as_moving_force,
    critical_speed,
    one_span,
    two_spans,
    with_duration,
    with_modes,
    with_sensors,
)
from experiments.thesis.chapter2 import published
from experiments.thesis.chapter2.shaker import beams_of_rig_a
from experiments.thesis.verdicts import LITERAL, Experiment, ExperimentResult, Finding, make_finding
from jaxbeam.model.plausibility.check import PlausibilityWarning
from jaxbeam.model.statics import static_peak
from jaxbeam.plot.style import GREY, INK, SHADE, colour, set_title, unit_scale, use_style
from jaxbeam.simulation.simulate import ContactLossWarning

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


MASSES = np.append(np.linspace(0.05, 0.6, 18), [0.26, 0.261, 0.5])  # kg; the last as printed
# Speeds over the critical speed, of one span and of two.
ONE_SPAN_RATIOS = np.append(np.geomspace(0.05, 0.2, 9)[:-1], np.linspace(0.2, 1.2, 21))
TWO_SPAN_RATIOS = np.append(np.geomspace(0.05, 0.2, 9)[:-1], np.linspace(0.2, 2.0, 37))
DURATION = 1.0  # s: the slowest crossing, and free vibration after all others
TOLERANCE = 1e-4  # relative, of peaks
SAMPLE_RATE = 5000.0  # Hz
# Hz, s: each sample of a run whose contact is lost takes a step of its own.
LIFTING_RATE, LIFTING_DURATION = 2000.0, 0.3
# Mass (kg, None for a force), speed ratio and sensor, of Figs 2.25 and 2.27.
ONE_SPAN_POINTS = (None, 0.7, 0), (0.26, 0.5, 0), (0.5, 0.75, 0)
TWO_SPAN_POINTS = (0.261, 0.45, 0), (0.261, 0.45, 1), (0.261, 1.75, 1)
YANG_RATIOS = np.linspace(0.2, 0.9, 15)
ONE_MODE = "a moving force on one mode"
WHILE_LOADED = "while the load is on the beam"
# The shaker of section 2.3 without current is a spring: m, N/m.
SHAKER_POSITION, SHAKER_STIFFNESS = 0.5, 12000.0
AFTER_EXIT = "in free vibration after the exit"
FEWER_LOSSES = "no damping, 10 modes"
LIFTS = "the mass lifts off"
ON_SHAKER_SPRING = (
    f"on the spring of the shaker, {SHAKER_STIFFNESS:g} N/m, in ratios to its own critical speed"
)
DAMPING = 0.03  # damping ratio of all other rigs
SINE_FREQUENCIES, SINE_AMPLITUDES = (2.0, 4.0), (0.0, 1.0, 2.0)  # Hz, V, of Fig. 2.22


class AmplificationSweep(NamedTuple):
    """Amplification of a sweep over masses (kg) and speeds over the critical speed.

    `amplification` is (mass, speed, sensor). `contact_force_ratio` (mass, speed) is the lowest
    contact force over the weight, negative where the mass would have to pull.
    """

    masses: np.ndarray
    speed_ratios: np.ndarray
    amplification: np.ndarray
    contact_force_ratio: np.ndarray


def sweep_amplification(case: jb.Case, masses, ratios) -> AmplificationSweep:
    """Amplification at the sensors over masses (kg) and speeds over the critical speed."""
    masses, ratios = np.sort(masses), np.asarray(ratios)
    mass, speed = (
        part.ravel() for part in np.meshgrid(masses, critical_speed(case) * ratios, indexing="ij")
    )
    axes = {
        "loads.0.mass": mass,
        "loads.0.speed": speed,
        "run.duration": np.maximum(DURATION, float(case.beam.length) / speed),
    }
    results = jb.sweep(case, axes, paired=True, progress=False, tolerance=TOLERANCE)
    static = _static_deflections(case)
    peaks = results.peak_deflection.values.reshape(masses.size, ratios.size, static.size)
    contact = results.lowest_contact_force.values.reshape(masses.size, ratios.size)
    weights = masses[:, None] * float(case.run.gravity)
    return AmplificationSweep(
        masses, ratios, peaks / (static * masses[:, None, None]), contact / weights
    )


def _static_deflections(case: jb.Case) -> np.ndarray:
    """Largest static deflections at the sensors (m/kg)."""
    positions = np.array([float(sensor.position) for sensor in case.sensors])
    return np.asarray(static_peak(jb.replace(case, {"loads.0.mass": 1.0}), positions))


def amplification_at(case: jb.Case, mass: float, ratio: float) -> dict[str, np.ndarray]:
    """Amplification at each sensor, (sensor,), at one mass and speed, by the time it is of.

    Times are the whole run, while the load is on the beam, and after its exit; the last two are
    read from samples at `SAMPLE_RATE`.
    """
    speed = ratio * critical_speed(case)
    crossing = float(case.beam.length) / speed
    case = jb.replace(case, {"loads.0.mass": mass, "loads.0.speed": speed})
    lifts = case.contact is not None
    timing = (LIFTING_DURATION, LIFTING_RATE) if lifts else (DURATION, SAMPLE_RATE)
    case = with_duration(case, *timing)
    record = jb.simulate(case, tolerance=TOLERANCE)
    size, loaded = np.abs(np.asarray(record.deflection)), np.asarray(record.times) <= crossing
    peaks = {
        LITERAL: np.asarray(record.peak_deflection),
        WHILE_LOADED: size[loaded].max(axis=0),
        AFTER_EXIT: size[~loaded].max(axis=0),
    }
    return {name: peak / (mass * _static_deflections(case)) for name, peak in peaks.items()}


def _at_points(
    case: jb.Case, answers: tuple[str, ...], points
) -> dict[tuple[str, ...], np.ndarray]:
    """Amplification (point,) by the answers, which hold for the case, and by the time it is of.

    Points are a mass (kg), or None for a moving force, a speed ratio, and the number of a sensor.
    """
    found = [
        {
            name: values[sensor]
            for name, values in amplification_at(
                as_moving_force(case) if mass is None else case, mass or 1.0, ratio
            ).items()
        }
        for mass, ratio, sensor in points
    ]
    return {
        answers if name == LITERAL else (*answers, name): np.array([one[name] for one in found])
        for name in found[0]
    }


def run(load_rig) -> ExperimentResult:
    """Amplification of one and two spans by masses and by forces, with histories and maps."""
    one = with_sensors(one_span(load_rig), 0.3, duration=DURATION)
    two = with_sensors(two_spans(load_rig), 0.3, 0.9, duration=DURATION)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # the maps show lost contact
        warnings.simplefilter("ignore", PlausibilityWarning)  # high speeds are intended
        mass_one = sweep_amplification(one, MASSES, ONE_SPAN_RATIOS)
        mass_two = sweep_amplification(two, MASSES, TWO_SPAN_RATIOS)
        force_one = sweep_amplification(as_moving_force(one), [1.0], ONE_SPAN_RATIOS)
        force_two = sweep_amplification(as_moving_force(two), [1.0], TWO_SPAN_RATIOS)
        history, figures = _histories(load_rig)
        findings = (*history, _one_span_finding(one), *_two_span_findings(two))
    midspans = "first midspan", "second midspan"
    figures |= {
        "fig-2-25": draw_curves(
            force_one, mass_one, ((0.26, 0, "0.26 kg"), (0.5, 0, "0.5 kg")), "Fig. 2.25"
        ),
        "fig-2-27": draw_curves(
            force_two,
            mass_two,
            [(0.261, i, name) for i, name in enumerate(midspans)],
            "Fig. 2.27, 0.261 kg",
        ),
        "map-one-span": draw_map(mass_one, ("midspan",), "one span, 3 modes"),
        "map-two-spans": draw_map(mass_two, midspans, "two spans, 8 modes"),
    }
    return ExperimentResult(findings, figures)


def _one_span_finding(one: jb.Case) -> Finding:
    """Finding on Fig. 2.25, by the beam, the spring of the shaker, and the time of the peak."""
    values = {}
    spring = jb.Support(SHAKER_POSITION, stiffness=SHAKER_STIFFNESS)
    for name, beam in beams_of_rig_a(one.beam).items():
        answers = () if name == LITERAL else (name,)
        bare = dataclasses.replace(one, beam=beam)
        values |= _at_points(bare, answers, ONE_SPAN_POINTS)
        on_spring = dataclasses.replace(bare, supports=(spring,))
        values |= _at_points(on_spring, (*answers, ON_SHAKER_SPRING), ONE_SPAN_POINTS)
    null = _one_mode(one, ONE_SPAN_POINTS)
    return make_finding(
        published.ONE_SPAN_AMPLIFICATION, values.pop(()), values, null=(ONE_MODE, null)
    )


def _two_span_findings(two: jb.Case) -> tuple[Finding, Finding]:
    """Amplification of a moving force after Yang, and Fig. 2.27."""
    undamped = jb.replace(two, {"beam.damping_ratio": 0.0})
    force = as_moving_force(undamped)
    yang = [amplification_at(force, 1.0, ratio) for ratio in YANG_RATIOS]
    largest = {name: np.max([each[name] for each in yang], axis=0) for name in yang[0]}
    one_mode = sweep_amplification(with_modes(force, 1), [1.0], YANG_RATIOS)
    of_force = make_finding(
        published.YANG_AMPLIFICATION,
        largest.pop(LITERAL),
        largest,
        null=(ONE_MODE, one_mode.amplification[0].max(axis=0)),
    )
    values = {}
    for answers, case in (((), two), ((FEWER_LOSSES,), with_modes(undamped, 10))):
        values |= _at_points(case, answers, TWO_SPAN_POINTS)
        lifting = dataclasses.replace(case, contact=jb.UnilateralContact())
        values |= _at_points(lifting, (*answers, LIFTS), TWO_SPAN_POINTS)
    finer = _at_points(with_modes(two, 16), (), TWO_SPAN_POINTS)[()]
    of_mass = make_finding(
        published.TWO_SPAN_AMPLIFICATION,
        values.pop(()),
        values,
        null=(ONE_MODE, _one_mode(two, TWO_SPAN_POINTS)),
        remark="held to the beam, the mass would have to pull with many times its weight; with 16"
        f" modes instead of 8 the amplification is then {', '.join(f'{x:.2f}' for x in finer)}",
    )
    return of_force, of_mass


def _one_mode(case: jb.Case, points) -> np.ndarray:
    """Amplification by a moving force of one mode, (point,)."""
    forces = [(None, ratio, sensor) for _, ratio, sensor in points]
    return _at_points(with_modes(case, 1), (), forces)[()]


def _histories(load_rig):
    """Histories of a moving mass and of a moving force: Figs 2.23, 2.24 and 2.26."""
    rig_d = load_rig("D")
    ratio, between, mass, force = _free_vibration(rig_d)
    damped_ratio, damped_between, _, _ = _free_vibration(
        jb.replace(rig_d, {"beam.damping_ratio": DAMPING})
    )
    damped = f"damping ratio {DAMPING:g}, as for all rigs of the thesis"

    shaker_case = with_sensors(load_rig("A"), 0.25, duration=1.0)
    shaker_case = jb.replace(shaker_case, {"loads.0.mass": 0.509, "loads.0.speed": 0.9})
    peak_differences = [_peak_difference(shaker_case, volts) for volts in SINE_AMPLITUDES]
    by_beam = {
        name: _peak_difference(dataclasses.replace(shaker_case, beam=beam), 0.0)
        for name, beam in list(beams_of_rig_a(shaker_case.beam).items())[1:]
    }
    fast = with_sensors(two_spans(load_rig), 0.75, duration=0.8)
    fast = jb.replace(fast, {"loads.0.mass": 0.261, "loads.0.speed": 3.0})
    pairs = {
        "rig D, midspan (Fig. 2.23)": (mass, force),
        "two spans at 0.75 m, 0.261 kg at 3 m/s (Fig. 2.26)": (
            jb.simulate(fast),
            jb.simulate(as_moving_force(fast)),
        ),
    }
    findings = (
        make_finding(
            published.FREE_AMPLITUDE_RATIO,
            ratio,
            {damped: damped_ratio},
            null=("no inertia of the load", 1.0),
        ),
        make_finding(
            published.FREE_PHASE_DIFFERENCE,
            between,
            {damped: damped_between},
            null=("no inertia of the load", 0.0),
        ),
        make_finding(
            published.FORCE_MASS_DIFFERENCE,
            peak_differences[0],
            by_beam,
            null=("no inertia of the load", 0.0),
            remark=_unknown_voltage(peak_differences),
        ),
    )
    return findings, {"histories": draw_histories(pairs)}


def _free_vibration(case: jb.Case):
    """Free vibration after the exit, by a moving force and by a moving mass.

    Returns the ratio of amplitudes (force over mass), the phase between them (degree), and the
    records of the mass and of the force.
    """
    mass, force = (jb.simulate(one) for one in (case, as_moving_force(case)))
    after = np.asarray(mass.times) > float(case.beam.length / case.loads[0].speed)
    free = [np.abs(np.asarray(run.deflection)[after]).max() for run in (force, mass)]
    omega = 2 * np.pi * float(mass.modes.frequencies[0])
    phases = [
        np.angle(float(run.coordinates[-1, 0]) - 1j * float(run.rates[-1, 0]) / omega)
        for run in (force, mass)
    ]
    between = np.degrees(np.abs(np.angle(np.exp(1j * (phases[0] - phases[1])))))
    return free[0] / free[1], between, mass, force


def _peak_difference(case: jb.Case, volts: float) -> float:
    """Difference (mm) of the peaks of a mass and of a force while the shaker is driven by sines."""
    prescribed = jb.Prescribed(
        offsets=[0.0], amplitudes=[[volts, volts]], frequencies=SINE_FREQUENCIES
    )
    driven = dataclasses.replace(case, controller=prescribed)
    peaks = [
        float(jb.simulate(one).peak_deflection[0]) for one in (driven, as_moving_force(driven))
    ]
    return 1e3 * abs(peaks[0] - peaks[1])


def _unknown_voltage(peak_differences) -> str:
    """Sentence on the voltage, not printed, that the difference of Fig. 2.24 needs; or empty."""
    if not peak_differences[0] < published.FORCE_MASS_DIFFERENCE.numbers[0] < max(peak_differences):
        return ""
    return (
        f"the voltage is not printed, and the inertia of the mass acts on what the shaker moves:"
        f" sines of {SINE_FREQUENCIES[0]:g} and {SINE_FREQUENCIES[1]:g} Hz (Fig. 2.22) of 0 to"
        f" {SINE_AMPLITUDES[-1]:g} V each make the difference {peak_differences[0]:.3f} to"
        f" {max(peak_differences):.3f} mm"
    )


EXPERIMENT = Experiment(
    "amplification",
    "Figs 2.23 to 2.27",
    "Beyond a tenth of the critical speed a moving mass deflects the beam more than a moving force,"
    " and the more, the heavier it is.",
    run,
)
