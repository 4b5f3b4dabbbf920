"""Displacement feedback of one and two spans with patches: Tables 6.1 to 6.3, Figs 6.2 to 6.11.

u = -k w and u = -k w^3 with w in millimetres and k = 2, through a tenth-order low-pass filter; what
higher gains do: they pay with heavier masses (Fig. 6.7), until the loop is unstable (Fig. 6.10).
"""

import dataclasses
import warnings

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.chapter6 import published
from experiments.thesis.chapter6.filter_oscillation import gain_margin_finding, oscillation_findings
from experiments.thesis.chapter6.gain_scheduling import (
    HIGHER_GAINS,
    derived_schedules,
    static_schedule_remark,
    switching_masses,
)
from experiments.thesis.verdicts import Experiment, ExperimentResult, make_finding
from jaxbeam.plot.style import colour, set_title, use_style
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning

MASSES = (0.261, 0.322, 0.371, 0.509)  # kg
GAIN, PERIOD = 2.0, 0.002  # V per mm or mm^3; s, not printed
ONE_SPAN_CUTOFF, TWO_SPAN_CUTOFF = 10.0, 20.0  # Hz
CORRECTION_FACTORS = (
    0.32,
    0.39,
    0.5,
)  # c_p of 2.4.2, that of two spans, and one that fits Fig. 6.7
HEADWAYS = (0.3, 0.6, 0.9, 1.2, 1.5)  # s between two masses
EXTRA_DELAY, LOW_DAMPING_RATIO = (
    0.03,
    0.01,
)  # s and 1: what section 6.2 does not print, and would explain it
TOLERANCE = 1e-4


def with_feedback(
    case: jb.Case, power: int, cutoff: float, gain: float = GAIN, delay: float | None = None
) -> jb.Case:
    """A patch rig under the law of this power; without one for power 0."""
    if not power:
        return case
    filtered = jb.Filter(cutoff, order=10, realisation="analogue")
    sensors = tuple(dataclasses.replace(sensor, filter=filtered) for sensor in case.sensors)
    gains = [gain * 1e3**power] * len(case.actuators)
    law = jb.Feedback(gains=gains, power=power, period=PERIOD, delay=delay)
    return dataclasses.replace(case, sensors=sensors, controller=law)


def simulate_changes(case: jb.Case, changes) -> list[jb.Record]:
    """A case with several changes of its numbers, compiled once."""
    cases = [jb.replace(case, change) for change in changes]
    plan = integration_plan(cases[-1], None, TOLERANCE)
    with warnings.catch_warnings():
        # Under gains that are too high loads would have to pull; the numbers show it.
        warnings.simplefilter("ignore", ContactLossWarning)
        return [jb.simulate(one, plan=plan) for one in cases]


def run(load_rig) -> ExperimentResult:
    """Peaks without control and under both laws, on rigs B and C."""
    one, one_figures, remarks = _one_span(load_rig("B"))
    two, two_figures = _two_spans(load_rig("C"))
    return ExperimentResult((*two, *one), two_figures | one_figures, remarks)


def _reduction(uncontrolled, controlled):
    return 100 * (1 - np.asarray(controlled) / np.asarray(uncontrolled))


def _two_spans(case: jb.Case):
    changes = [{"loads.0.mass": mass} for mass in MASSES]
    found = [
        simulate_changes(with_feedback(case, power, TWO_SPAN_CUTOFF), changes)
        for power in (0, 1, 3)
    ]
    down, up = (
        np.array(
            [[1e3 * np.max(sign * np.asarray(r.deflection), axis=0) for r in row] for row in found]
        )
        for sign in (-1, 1)
    )
    (free, linear, cubic), rise = np.moveaxis(down, 2, 1), up[..., 1]
    amplifier = float(case.actuators[0].amplifier_gain)
    volts = [amplifier * float(found[2][i].command[:, j].max()) for i, j in ((0, 0), (3, 1))]
    two_mass_reductions = _two_masses(case)
    lowest, highest = min(two_mass_reductions), max(two_mass_reductions)
    inside = lowest <= published.TWO_MASSES.numbers[0] <= highest
    table = (
        (published.FREE_S1, free[0]),
        (published.CUBIC_S1, cubic[0]),
        (published.CUBIC_REDUCTION_S1, _reduction(free, cubic)[0]),
        (published.LINEAR_S1, linear[0]),
        (published.LINEAR_REDUCTION_S1, _reduction(free, linear)[0]),
        (published.FREE_S3, free[1]),
        (published.FREE_S3_COMPUTED, free[1]),
        (published.CUBIC_S3, cubic[1]),
        (published.CUBIC_REDUCTION_S3, _reduction(free, cubic)[1]),
        (published.LINEAR_S3, linear[1]),
        (published.LINEAR_REDUCTION_S3, _reduction(free, linear)[1]),
        (published.FREE_UP, rise[0]),
        (published.CUBIC_UP, rise[2]),
        (published.CUBIC_REDUCTION_UP, _reduction(rise[0], rise[2])),
        (published.FEEDBACK_VOLTAGE, volts),
        (published.SUMMARY_TWO, [_reduction(free, law)[0, -1] for law in (linear, cubic)]),
    )
    findings = [make_finding(printed, ours) for printed, ours in table]
    findings.append(
        make_finding(
            published.TWO_MASSES,
            np.nan,
            inconsistency=f"the gap between the masses is not printed; gaps of {HEADWAYS[0]:g} to"
            f" {HEADWAYS[-1]:g} s give {lowest:.1f} to {highest:.1f} %"
            if inside
            else "",
        )
    )
    variants = {
        f"{damped} {late}".strip(): (delay, damping)
        for late, delay in (("", None), (f"{1e3 * EXTRA_DELAY:g} ms later", EXTRA_DELAY))
        for damped, damping in (
            ("zeta 0.03", 0.03),
            (f"zeta {LOW_DAMPING_RATIO:g}", LOW_DAMPING_RATIO),
        )
    }
    lightest = {word: _lightest_unstable(case, *numbers) for word, numbers in variants.items()}
    printed, *others = lightest.items()
    findings.append(make_finding(published.UNSTABLE_MASS, printed[1], dict(others)))
    heaviest = {word: row[-1] for word, row in zip(LAWS, found, strict=True)}
    return findings, {"two-spans": _draw(heaviest, "Two spans, 0.509 kg (Figs 6.8, 6.9)")}


LAWS = ("no control", "linear", "cubic")


def _lightest_unstable(case: jb.Case, delay: float | None, damping: float) -> float:
    """The lightest of the masses (kg) with which the cubic law of k = 3 is unstable, or NaN.

    Unstable is a loop whose commands grow until the actuators' limits hold them.
    """
    changes = [{"loads.0.mass": mass, "beam.damping_ratio": damping} for mass in MASSES]
    records = simulate_changes(with_feedback(case, 3, TWO_SPAN_CUTOFF, 3.0, delay), changes)
    saturated = [bool(np.any(record.saturated)) for record in records]
    return MASSES[saturated.index(True)] if any(saturated) else np.nan


def _two_masses(case: jb.Case) -> list[float]:
    """Reductions (%) at the second midspan for two masses, by the gap between them."""
    first = case.loads[0]
    loads = [
        dataclasses.replace(first, mass=np.asarray(mass), entry_time=np.asarray(0.0))
        for mass in MASSES[2:]
    ]
    longer = dataclasses.replace(case.run, duration=case.run.duration + HEADWAYS[-1])
    both = dataclasses.replace(case, loads=tuple(loads), run=longer)
    changes = [{"loads.1.entry_time": gap} for gap in HEADWAYS]
    free, cubic = (
        [
            -np.min(run.deflection[:, 1])
            for run in simulate_changes(with_feedback(both, power, TWO_SPAN_CUTOFF), changes)
        ]
        for power in (0, 3)
    )
    return list(_reduction(free, cubic))


def _one_span(case: jb.Case):
    changes = [
        {"loads.0.mass": mass, "actuators.0.correction": share}
        for share in CORRECTION_FACTORS
        for mass in MASSES
    ]
    found = [
        simulate_changes(with_feedback(case, power, ONE_SPAN_CUTOFF), changes)
        for power in (0, 1, 3)
    ]
    peaks = [[float(r.peak_deflection[0]) for r in row] for row in found]
    shape = len(CORRECTION_FACTORS), len(MASSES)
    linear, cubic = (_reduction(peaks[0], row).reshape(shape) for row in peaks[1:])
    higher_gain_peaks = []
    for gain in HIGHER_GAINS:
        higher = [change | {"controller.gains.0": gain * 1e3} for change in changes]
        records = simulate_changes(with_feedback(case, 1, ONE_SPAN_CUTOFF), higher)
        higher_gain_peaks.append(np.reshape([float(r.peak_deflection[0]) for r in records], shape))
    switches, last = switching_masses(
        MASSES, np.reshape(peaks, (3, *shape)), np.array(higher_gain_peaks)
    )
    schedule, remark = derived_schedules(
        with_feedback(case, 1, ONE_SPAN_CUTOFF), MASSES, simulate_changes
    )
    correction_labels = [f"c_p {share:g}" for share in CORRECTION_FACTORS]

    def by_correction(printed, values):
        return make_finding(
            printed, values[0], dict(zip(correction_labels[1:], values[1:], strict=True))
        )

    findings = [
        by_correction(published.ONE_SPAN_LINEAR, [[v.min(), v.max()] for v in linear]),
        by_correction(published.ONE_SPAN_CUBIC, [[v.min(), v.max()] for v in cubic]),
        by_correction(
            published.SUMMARY_ONE, [[a[-1], b[-1]] for a, b in zip(linear, cubic, strict=True)]
        ),
        by_correction(published.SWITCHING_MASSES, switches),
        by_correction(published.EQUIVALENT_LINEAR_GAIN, last),
        by_correction(
            published.LIGHTEST_MASS_REDUCTION,
            [[a[0], b[0]] for a, b in zip(linear, cubic, strict=True)],
        ),
        make_finding(published.FREE_VIBRATION_FREQUENCY, jb.modes(case).frequencies[0]),
        gain_margin_finding(case, CORRECTION_FACTORS),
    ]
    oscillating, oscillation = oscillation_findings(
        with_feedback(case, 3, ONE_SPAN_CUTOFF), simulate_changes
    )
    findings += oscillating
    heaviest = {word: row[len(MASSES) - 1] for word, row in zip(LAWS, found, strict=True)}
    return (
        findings,
        {
            "one-span": _draw(heaviest, "One span, 0.509 kg (Figs 6.3, 6.5)"),
            "filters": oscillation,
            "reductions": _draw_reductions(linear[0], cubic[0]),
            "schedule": schedule,
        },
        (static_schedule_remark(case, MASSES[-1]), remark),
    )


@use_style
def _draw(records: dict[str, jb.Record], title: str) -> Figure:
    """Deflections at the sensors, and voltages at the patches, under each law."""
    case = records["cubic"].case
    count = len(case.actuators)
    figure = Figure(figsize=(7.2, 1.0 + 2.0 * (count + 1)))
    panels = figure.subplots(count + 1, 1, sharex=True)
    for i, (word, record) in enumerate(records.items()):
        times = np.asarray(record.times)
        for axes, history in zip(panels, np.asarray(record.deflection).T, strict=False):
            axes.plot(times, 1e3 * history, color=colour(i), label=word)
        if record.case.controller is not None:
            for j, command in enumerate(np.asarray(record.command).T):
                volts = float(case.actuators[j].amplifier_gain) * command
                panels[-1].plot(times, volts, ("-", "--")[j], color=colour(i))
    for axes, sensor in zip(panels, case.sensors, strict=False):
        axes.set(title=f"at {float(sensor.position):g} m", ylabel="deflection (mm)")
    sides = ", second patch dashed" if count > 1 else ""
    panels[-1].set(
        title=f"at the patch{'es' if count > 1 else ''}{sides}",
        xlabel="time (s)",
        ylabel="voltage (V)",
        xlim=(0, times[-1]),
    )
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, title)
    return figure


@use_style
def _draw_reductions(linear, cubic) -> Figure:
    """Fig. 6.6: reductions over the mass."""
    figure = Figure(figsize=(4.6, 3.0))
    axes = figure.subplots()
    bar_positions = np.arange(len(MASSES))
    for i, (values, word) in enumerate(((linear, "linear"), (cubic, "cubic"))):
        axes.bar(bar_positions + 0.36 * (i - 0.5), values, 0.34, color=colour(i), label=word)
    axes.set_xticks(bar_positions, [f"{mass:g}" for mass in MASSES])
    axes.grid(False, axis="x")
    axes.set(xlabel="mass (kg)", ylabel="reduction of the peak (%)")
    axes.legend(loc="upper left")
    set_title(figure, "One span, c_p 0.32 (Fig. 6.6)")
    return figure


EXPERIMENT = Experiment(
    "feedback",
    "Tables 6.1 to 6.3, Figs 6.2 to 6.11",
    "Linear feedback of the deflection takes a tenth off every peak, cubic feedback more the"
    " heavier the mass.",
    run,
)
