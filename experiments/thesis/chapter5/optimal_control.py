"""Optimal control of one span with a shaker, by several interpretations: Tables 5.1 to 5.4.

Deflection under the load, and the number of modes that it needs: Figs 5.10 and 5.11.
"""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import one_span, with_duration, with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.chapter5.observer import observed_regulator
from experiments.thesis.chapter5.regulator_limits import (
    draw_poles,
    frozen_pole_findings,
    growth_remark,
    sampling_findings,
)
from experiments.thesis.chapter5.regulators import (
    COMMAND_WEIGHT,
    FIRST_MODE,
    FULL_SHAKER,
    INTERPRETATIONS,
    LAWS,
    MASSES,
    NO_CONTROL,
    OTHER_WEIGHT,
    REFITTED_SHAKER,
    SENSOR,
    SPEEDS,
    STATE_WEIGHTS,
    WEAK_SHAKER,
    RegulatorRuns,
    electromechanical_shakers,
    interpreted_rigs,
    time_varying_loops,
)
from experiments.thesis.report import plot_commands, plot_deflections
from experiments.thesis.verdicts import LITERAL, Experiment, ExperimentResult, Finding, make_finding
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.plot.style import COLOURS, colour, set_title, use_style

MODE_COUNTS = (1, 2, 3, 6)


def mode_truncation(load_rig) -> Finding:
    """Shortfall (%) of the largest deflection under the load with fewer modes, bare beam."""
    case = jb.replace(one_span(load_rig), {"loads.0.mass": 0.261, "loads.0.speed": 0.55})
    case = with_duration(case, case.beam.length / case.loads[0].speed)
    largest = {
        modes: largest_deflection_under_load(jb.simulate(with_modes(case, modes)))[1]
        for modes in MODE_COUNTS
    }

    def shortfall(few: int, many: int) -> float:
        return 100 * (1 - largest[few] / largest[many])

    return make_finding(
        published.MODE_TRUNCATION,
        shortfall(2, 3),
        {"two modes against six": shortfall(2, 6)},
        null=("one mode against three", shortfall(1, 3)),
    )


def deepest_position(uncontrolled: Mapping[str, jb.Record]) -> Finding:
    """Position (m) of the load at its largest deflection without control, by interpretation."""
    positions = {name: largest_deflection_under_load(one)[0] for name, one in uncontrolled.items()}
    others = {tuple(name.split("; ")): at for name, at in positions.items() if name != LITERAL}
    null = ("static deflection on the shaker of 12000 N/m", _static_position(uncontrolled))
    return make_finding(published.DEEPEST_POSITION, positions[LITERAL], others, null=null)


def _static_position(records: Mapping[str, jb.Record]) -> float:
    """Position (m) of a weight that sinks most, on the beam of the first record."""
    case = next(iter(records.values())).case
    model = modal_model(case, mesh_layout(case))
    positions = np.linspace(0.0, float(case.beam.length), 1201)
    shapes = np.asarray(model.modes.shapes(positions, 0))
    sinking = np.sum(shapes.T * np.linalg.solve(np.asarray(model.stiffness()), shapes.T), axis=0)
    return float(positions[np.argmax(sinking)])


def largest_deflection_under_load(record: jb.Record) -> tuple[float, float]:
    """Position (m) of the first load where the beam under it is lowest, and the deflection (m)."""
    case, times = record.case, np.asarray(record.times)
    positions = float(case.loads[0].speed) * times
    on_beam = positions < float(case.beam.length)
    shapes = np.asarray(record.modes.shapes(positions[on_beam], 0))
    deflection = np.sum(shapes * np.asarray(record.coordinates)[on_beam], axis=1)
    lowest = np.argmin(deflection)
    return float(positions[on_beam][lowest]), float(-deflection[lowest])


SAMPLE_RATE = 200.0  # Hz
Plants = Mapping[str, tuple[jb.Case, jb.Shaker]]  # designs and shakers by reading

UNBOUNDED = (
    f"By the {FULL_SHAKER}, 0.509 kg at 0.3 m/s under the augmented regulator grow without bound,"
    " from rounding on: that peak (Table 5.3) differs by points with the number of steps"
)
UNDAMPED_DESIGN = "R = 3e-4, 2.5 N/V, 80 N s/m in the plant only"  # for stability alone


def run(load_rig) -> ExperimentResult:
    """Peaks under the three regulators in percent of no control, by every interpretation."""
    rig = load_rig("A")
    rig = with_duration(rig, float(rig.beam.length) / min(SPEEDS) + 0.3, SAMPLE_RATE)
    rigs = interpreted_rigs(rig)
    plants = {name: (case, case.actuators[0]) for name, case in rigs.items()}
    plants |= {name: (rig, shaker) for name, shaker in electromechanical_shakers(rig).items()}
    runs = RegulatorRuns(rig)
    peaks = {
        name: {
            kind: np.array([[runs.peak(name, *plant, kind, v, m) for m in MASSES] for v in SPEEDS])
            for kind in (NO_CONTROL, *LAWS)
        }
        for name, plant in plants.items()
    }
    ratios = {
        kind: {name: 100 * one[kind] / one[NO_CONTROL] for name, one in peaks.items()}
        for kind in LAWS
    }
    tables = (
        ("time-invariant", (published.INVARIANT_SLOW, published.INVARIANT_FAST)),
        ("time-varying", (published.VARYING_SLOW, published.VARYING_FAST)),
        ("augmented", (published.AUGMENTED_SLOW, published.AUGMENTED_FAST)),
    )
    table_findings = tuple(
        _finding(
            numbers,
            {name: by_speed[i] for name, by_speed in ratios[kind].items()},
            100.0,
            fitted={OTHER_WEIGHT: "0.509kg"} if numbers is published.VARYING_FAST else None,
        )
        for kind, both_speeds in tables
        for i, numbers in enumerate(both_speeds)
    )
    reductions = {
        name: [100 - ratios[kind][name][-1, -1] for kind in ("time-varying", "augmented")]
        for name in plants
    }
    uncontrolled = {name: runs.records[name, NO_CONTROL, SPEEDS[0], MASSES[-1]] for name in plants}
    gains = sampling_findings(rig, STATE_WEIGHTS)
    observed, observer_figures, observer_remark = observed_regulator(
        rig, STATE_WEIGHTS, COMMAND_WEIGHT
    )
    loops = {name: time_varying_loops(case, INTERPRETATIONS[name]) for name, case in rigs.items()}
    weak = INTERPRETATIONS[WEAK_SHAKER]._replace(command_weight=3e-4)
    undamped = time_varying_loops(rigs[WEAK_SHAKER], weak, damping=0.0)
    findings = (
        *table_findings,
        _finding(published.SUMMARY_OPTIMAL, reductions, 0.0),
        _partial_feedback_finding(runs, plants, peaks, ratios["time-varying"]),
        _gain_scheduling_finding(runs, plants),
        deepest_position(uncontrolled),
        mode_truncation(load_rig),
        *gains,
        observed,
        *frozen_pole_findings(loops),
    )
    drawn = {
        kind: runs.records[REFITTED_SHAKER, kind, SPEEDS[1], MASSES[-1]]
        for kind in (NO_CONTROL, *LAWS)
    }
    figures = {
        "deflections": _draw(drawn),
        "readings": _draw_interpretations(tables, ratios),
        "poles": draw_poles(undamped, UNDAMPED_DESIGN),
        **observer_figures,
    }
    remarks = (
        _rms_difference_remark(table_findings, plants),
        UNBOUNDED,
        growth_remark({LITERAL: loops[LITERAL], UNDAMPED_DESIGN: undamped}),
        observer_remark,
    )
    return ExperimentResult(findings, figures, remarks)


def _finding(
    numbers, values, uncontrolled: float, fitted: Mapping[str, str] | None = None, remark=""
) -> Finding:
    """A finding from values by interpretation, beside the value without control."""
    others = {tuple(name.split("; ")): one for name, one in values.items() if name != LITERAL}
    return make_finding(
        numbers,
        values[LITERAL],
        others,
        null=(NO_CONTROL, uncontrolled),
        fitted=fitted,
        remark=remark,
    )


def _partial_feedback_finding(runs: RegulatorRuns, plants: Plants, peaks, time_varying) -> Finding:
    """Reductions (%) with the first state fed back, and with the printed ones."""
    reductions = {}
    for name, plant in plants.items():
        uncontrolled = peaks[name][NO_CONTROL][1, 0]
        run = {"speed": SPEEDS[1], "mass": MASSES[0], "feedback": FIRST_MODE}
        reductions[name] = [
            100 - 100 * runs.peak(name, *plant, kind, **run) / uncontrolled
            for kind in ("time-invariant", "time-varying")
        ]
        reductions[name].append(100 - float(time_varying[name][-1, 0]))
    return _finding(published.PARTIAL_FEEDBACK, reductions, 0.0)


def _gain_scheduling_finding(runs: RegulatorRuns, plants: Plants) -> Finding:
    """Further reduction (points) for the heaviest mass by the gain designed for it.

    The other gain is designed for the lightest mass.
    """
    kind, slow, (lightest, *_, heaviest) = "time-varying", SPEEDS[0], MASSES
    further_reductions = {}
    for name, plant in plants.items():
        uncontrolled = runs.peak(name, *plant, NO_CONTROL, slow, heaviest)
        other, own = (
            runs.peak(name, *plant, kind, slow, heaviest, design_mass=mass)
            for mass in (lightest, heaviest)
        )
        further_reductions[name] = [100 * (other - own) / uncontrolled]
    remark = (
        "Table 5.1, where each mass has its own gain, differs by"
        f" {np.ptp(published.VARYING_SLOW.numbers):.1f} points between the masses"
    )
    return _finding(published.GAIN_SCHEDULING, further_reductions, 0.0, remark=remark)


def _rms_difference_remark(findings, interpretations) -> str:
    """Root mean square of the differences from all eighteen numbers of Tables 5.1 to 5.4."""
    sizes = []
    for name in interpretations:
        differences = np.concatenate(
            [
                one.values(frozenset() if name == LITERAL else frozenset(name.split("; ")))
                - one.published.numbers
                for one in findings
            ]
        )
        sizes.append(f"{name}: {np.sqrt(np.mean(differences**2)):.1f}")
    return "Root mean square of the differences over Tables 5.1 to 5.4, in points: " + "; ".join(
        sizes
    )


@use_style
def _draw(records: dict[str, jb.Record]) -> Figure:
    """Figs 5.19 to 5.28: deflection and voltage under each law."""
    figure = Figure(figsize=(7.2, 4.6))
    above, below = figure.subplots(2, 1, sharex=True)
    plot_deflections(above, records, SENSOR)
    plot_commands(below, records)
    last = float(records[NO_CONTROL].times[-1])
    above.set(ylabel="deflection at 0.25 m (mm)")
    below.set(xlabel="time (s)", ylabel="voltage (V)", xlim=(0, last))
    above.legend(loc="lower right", ncols=2)
    set_title(figure, "0.509 kg at 0.55 m/s, full model of the shaker refitted (Fig. 5.28)")
    return figure


@use_style
def _draw_interpretations(tables, ratios) -> Figure:
    """Published peaks beside those of every interpretation."""
    figure = Figure(figsize=(7.2, 5.0))
    panels = figure.subplots(1, len(tables), sharey=True)
    for axes, (kind, both_speeds) in zip(panels, tables, strict=True):
        printed = np.concatenate([one.numbers for one in both_speeds])
        bars = np.arange(printed.size)
        for i, (name, values) in enumerate(ratios[kind].items()):
            marker = "od"[i // len(COLOURS)]  # colours repeat
            axes.plot(bars, np.ravel(values), marker, markersize=4, color=colour(i), label=name)
        axes.plot(bars, printed, "_", color="k", markersize=14, label="printed")
        axes.set_xticks(bars, [f"{mass:g}" for mass in 2 * MASSES], rotation=90)
        axes.set(title=kind, xlabel="mass (kg), at 0.3 and 0.55 m/s")
    # By one interpretation the response grows without bound; the table has its peak.
    panels[0].set(ylabel="peak (% of no control)", ylim=(0, 120))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=1)
    set_title(figure, "Optimal control by several interpretations (Tables 5.1 to 5.4)")
    return figure


EXPERIMENT = Experiment(
    "optimal-control",
    "section 5.1, Tables 5.1 to 5.4, Figs 5.4 to 5.11, 5.13 to 5.28",
    "Gains that vary along the crossing reduce the peak more than constant ones, and most if the"
    " regulator knows the load.",
    run,
)
