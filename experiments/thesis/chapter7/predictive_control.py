"""Model predictive control of one and two spans with patches: section 7.3, Figs 7.1 to 7.9.

What no controller whatever can do within the limits of the patches is a linear program (see
`jaxbeam.control.bound`); it is asked for each half of a crossing.
"""

import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.chapter7 import published
from experiments.thesis.verdicts import Experiment, ExperimentResult, Finding, make_finding
from jaxbeam.analysis.bound.input_influence import input_influence
from jaxbeam.analysis.bound.linear_program import least_peak
from jaxbeam.control.design_model import DesignModel
from jaxbeam.plot.style import GREY, colour, set_title, use_style
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes

PERIOD, SPEED = 0.01, 1.0  # s, m/s
LOW_MOVE_WEIGHT, HIGH_MOVE_WEIGHT = 1e-11, 1e-6  # r_w
TOLERANCE = 1e-4
CURVE_RESOLUTION = 0.02  # of a limit: as near as that, a curve seems to have reached it
PRINTED_SECTIONS = (
    (12.277, 0.7924),
    (13.211, 0.812),
    (12.11, 0.5411),
)  # printed for beams with patches
DAMPING_RATIOS = (0.01, 0.03)


def with_crossing(case: jb.Case) -> jb.Case:
    """A patch rig crossed at 1 m/s, with 0.2 s of what follows."""
    duration = np.asarray(float(case.beam.length) / SPEED + 0.2)
    case = dataclasses.replace(case, run=dataclasses.replace(case.run, duration=duration))
    return jb.replace(case, {"loads.0.speed": SPEED})


def simulate_mpc(
    case: jb.Case,
    horizon: int,
    control_horizon: int,
    weight: float = LOW_MOVE_WEIGHT,
    modes: int | None = None,
) -> jb.Record:
    """A run under predictive control of the deflections at the sensors, sampled at its ticks.

    The controller's model has fewer `modes` than the case, if that is given.
    """
    design = None if modes is None else DesignModel(modes=modes)
    law = jb.MPC(
        horizon=horizon, moves=control_horizon, move_weight=weight, period=PERIOD, design=design
    )
    case = dataclasses.replace(case, controller=law)
    times = np.arange(round(float(case.run.duration) / PERIOD) + 1) * PERIOD
    # Enough steps for the fastest mode to turn by a radian or two in each.
    plan = IntegrationPlan(
        static_shapes(case), 2 * case.beam.modes, 0, False, 0.0, loop_schedule(case, times)
    )
    return jb.simulate(case, jnp.asarray(times), plan)


def run(load_rig) -> ExperimentResult:
    """Reductions and instants of saturation on rigs B and C, beside what is possible."""
    one, one_records = _one_span(with_crossing(load_rig("B")))
    two, two_records = _two_spans(with_crossing(load_rig("C")))
    figures = {
        "one-span": _draw(one_records, "One span, 0.509 kg at 1 m/s (Figs 7.1, 7.2)"),
        "two-spans": _draw(two_records, "Two spans, 0.509 kg at 1 m/s (Figs 7.5 to 7.7)"),
    }
    return ExperimentResult((*one, *two), figures)


def _one_span(case):
    eight = dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=8))
    reductions, records = [], {}
    for one in (case, eight):
        free, strong = jb.simulate(one, tolerance=TOLERANCE), simulate_mpc(one, 6, 4)
        reductions.append(100 * (1 - float(strong.peak_deflection[0] / free.peak_deflection[0])))
        if one is case:
            weak = simulate_mpc(one, 6, 4, HIGH_MOVE_WEIGHT)
            records = {"no control": free, "r_w 1e-11": strong, "r_w 1e-6": weak}
    both = [records[f"r_w {weight}"] for weight in ("1e-11", "1e-6")]
    exact, from_curve = (
        [_saturation_time(one, 0, 7.5, near) for one in both] for near in (1e-6, CURVE_RESOLUTION)
    )
    one_move = simulate_mpc(case, 6, 1)
    findings = (
        make_finding(published.ONE_MOVE_PEAKS, _peak_times(one_move)),
        make_finding(published.ONE_SPAN_REDUCTION, reductions[0], {"8 modes": reductions[1]}),
        make_finding(
            published.ONE_SPAN_SATURATION,
            exact,
            {f"as a curve shows it, to {CURVE_RESOLUTION:.0%}": from_curve},
        ),
    )
    return findings, records


def _two_spans(case):
    free = jb.simulate(case, tolerance=TOLERANCE)
    short, long = simulate_mpc(case, 4, 3), simulate_mpc(case, 6, 4)
    reductions = {
        word: 100 * (1 - _peaks_by_half(run) / _peaks_by_half(free))
        for word, run in (("s", short), ("l", long))
    }
    attainable = _attainable_in_second_half(case)
    printed_reduction = published.SECOND_HALF_REDUCTION.numbers.min()
    findings = (
        make_finding(
            published.TWO_SPAN_REDUCTION,
            reductions["s"][[0, 0, 1], [0, 1, 1]],
            inconsistency=_irreproducible_reductions(case),
        ),
        make_finding(
            published.SECOND_HALF_REDUCTION,
            [reductions["s"][1, 0], reductions["l"][1, 0]],
            inconsistency=f"no commands within the limits of the patches, whatever the controller, take"
            f" more than {attainable:.1f} % off there"
            if attainable < printed_reduction
            else "",
        ),
        _reduced_model_finding(case),
        make_finding(
            published.TWO_SPAN_SATURATION,
            [_saturation_time(short, 0, 7.5), _saturation_time(short, 1, -2.5)],
        ),
    )
    return findings, {"no control": free, "Np 4, Nc 3": short, "Np 6, Nc 4": long}


def _reduced_model_finding(case: jb.Case) -> Finding:
    """A controller that knows 3 modes, on a beam that has 12."""
    twelve = dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=12))
    free, reduced_model = (
        jb.simulate(twelve, tolerance=TOLERANCE),
        simulate_mpc(twelve, 2, 1, modes=3),
    )
    less = [
        100 * (1 - b / a)
        for a, b in zip(free.peak_deflection, reduced_model.peak_deflection, strict=True)
    ]
    label = f"less by {less[0]:.1f} and {less[1]:.1f} %"
    works = np.array([float(value > 0) for value in less])
    return make_finding(published.REDUCED_MODEL, works, {label: works})


def _peak_times(record: jb.Record) -> np.ndarray:
    """When (s) the first and the last upward peak of the deflection are, the load on the beam."""
    history = np.asarray(record.deflection)[:, 0]
    middle = history[1:-1]
    peaks = 1 + np.flatnonzero((middle > history[:-2]) & (middle > history[2:]))
    times = np.asarray(record.times)[peaks]
    return times[times < float(record.case.beam.length) / SPEED][[0, -1]]


def _irreproducible_reductions(case: jb.Case) -> str:
    """Which of the reductions no beam gives that is printed somewhere, if so."""
    found = []
    for (rigidity, density), ratio in itertools.product(PRINTED_SECTIONS, DAMPING_RATIOS):
        beam = {"beam.flexural_rigidity": rigidity, "beam.mass_per_length": density}
        one = jb.replace(case, beam | {"beam.damping_ratio": ratio})
        free, less = jb.simulate(one, tolerance=TOLERANCE), simulate_mpc(one, 4, 3)
        found.append(100 * (1 - _peaks_by_half(less) / _peaks_by_half(free))[[0, 0, 1], [0, 1, 1]])
    low, high = np.min(found, axis=0), np.max(found, axis=0)
    printed = published.TWO_SPAN_REDUCTION
    out = (printed.numbers < low - printed.allowed_error) | (
        printed.numbers > high + printed.allowed_error
    )
    ranges = [
        f"{label} {a:.1f} to {b:.1f} %"
        for label, a, b, far in zip(printed.value_labels, low, high, out, strict=True)
        if far
    ]
    message = f"with any rigidity, mass and damping that is printed: {'; '.join(ranges)}"
    return message if ranges else ""


def _saturation_time(record: jb.Record, actuator: int, limit: float, near: float = 1e-6) -> float:
    """When a command is first at a limit (V), to a share of that, in s; NaN if never."""
    there = np.abs(np.asarray(record.command)[:, actuator] - limit) < near * abs(limit)
    return float(record.times[np.argmax(there)]) if there.any() else np.nan


def _peaks_by_half(record: jb.Record) -> np.ndarray:
    """Largest deflections (m) in the first and second half of the crossing (half, sensor)."""
    middle = float(record.case.beam.length) / SPEED / 2
    times = np.asarray(record.times)
    sizes = np.abs(np.asarray(record.deflection))
    second = (times >= middle) & (times <= 2 * middle)
    return np.array([sizes[times < middle].max(axis=0), sizes[second].max(axis=0)])


def _attainable_in_second_half(case: jb.Case) -> float:
    """The largest reduction (%) at the first sensor in the second half that is possible at all."""
    position = np.array([float(case.sensors[0].position)])
    influence = input_influence(case, position, PERIOD, PERIOD / 2)
    crossing = float(case.beam.length) / SPEED
    second = (influence.times >= crossing / 2) & (influence.times <= crossing)
    influence = eqx.tree_at(
        lambda r: (r.instants, r.free, r.response),
        influence,
        (influence.times[second], influence.unforced[second], influence.response[second]),
    )
    low, high = np.array([actuator.command_limits() for actuator in case.actuators]).T
    peak, _, _ = least_peak(influence, low, high, np.full(low.shape, np.inf))
    free = np.abs(influence.free @ influence.rows.T).max()
    return 100 * (1 - peak / free)


@use_style
def _draw(records: dict[str, jb.Record], title: str) -> Figure:
    """Deflections at the sensors and voltages at the amplifier's input."""
    case = next(iter(records.values())).case
    sensors, actuators = len(case.sensors), len(case.actuators)
    figure = Figure(figsize=(7.2, 0.8 + 1.7 * (sensors + actuators)))
    panels = figure.subplots(sensors + actuators, 1, sharex=True)
    for i, (word, record) in enumerate(records.items()):
        times = np.asarray(record.times)
        for axes, history in zip(panels, np.asarray(record.deflection).T, strict=False):
            axes.plot(times, 1e3 * history, color=colour(i), label=word)
        if record.case.controller is not None:
            for axes, sent in zip(panels[sensors:], np.asarray(record.command).T, strict=True):
                axes.plot(times, sent, color=colour(i), drawstyle="steps-post")
    for axes, sensor in zip(panels, case.sensors, strict=False):
        axes.set(title=f"at {float(sensor.position):g} m", ylabel="deflection (mm)")
    for j, axes in enumerate(panels[sensors:]):
        axes.set(title=f"command to patch {j + 1}", ylabel="voltage (V)")
        for limit in np.asarray(case.actuators[j].command_limits()):
            axes.axhline(limit, color=GREY, linewidth=0.8, linestyle=":")
    panels[-1].set(xlabel="time (s)", xlim=(0, times[-1]))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, title)
    return figure


EXPERIMENT = Experiment(
    "predictive-control",
    "section 7.3, Figs 7.1 to 7.9, Table 8.1",
    "Predictive control uses the whole voltage of the patches: more than a fifth off the peak of"
    " one span, more than a quarter off that of two.",
    run,
)
