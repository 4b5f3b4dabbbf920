"""Model predictive control of one and two spans with patches: section 7.3, Figs 7.1 to 7.9.

The least peak that any controller can leave within the limits of the patches is found by a linear
program (`jaxbeam.analysis.bound`), here for the second half of a crossing.
"""

import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import reduction, with_duration, with_modes
from experiments.thesis.chapter7 import published
from experiments.thesis.report import plot_commands, plot_deflections
from experiments.thesis.verdicts import Experiment, ExperimentResult, Finding, make_finding
from jaxbeam.analysis.bound.bound import input_influence, least_peak
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.plot.style import GREY, set_title, use_style
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes

PERIOD, SPEED = 0.01, 1.0  # s, m/s
LOW_MOVE_WEIGHT, HIGH_MOVE_WEIGHT = 1e-11, 1e-6  # r_w
TOLERANCE = 1e-4  # relative, of peaks
CURVE_RESOLUTION = 0.02  # of a limit: a drawn curve within it seems to reach the limit; fitted
# Rigidity (N m^2) and mass per length (kg/m) as printed for beams with patches.
PRINTED_SECTIONS = ((12.277, 0.7924), (13.211, 0.812), (12.11, 0.5411))
DAMPING_RATIOS = (0.01, 0.03)
OTHER_SPEEDS = (0.3, 0.55, 0.8, 1.2, 1.5)  # m/s
AT_ONCE = "full voltage from the first sample on", PERIOD
PRINTED_REDUCTIONS = (0, 0, 1), (0, 1, 1)  # halves of the crossing, and sensors, in Fig. 7.5


def with_crossing(case: jb.Case) -> jb.Case:
    """A patch rig crossed at 1 m/s, with 0.2 s of free vibration."""
    case = with_duration(case, float(case.beam.length) / SPEED + 0.2)
    return jb.replace(case, {"loads.0.speed": SPEED})


def simulate_mpc(
    case: jb.Case,
    horizon: int,
    control_horizon: int,
    move_weight: float = LOW_MOVE_WEIGHT,
    modes: int | None = None,
) -> jb.Record:
    """Record under predictive control of the deflections at the sensors, at its sampling instants.

    `modes` is the number of modes of the controller's model, that of the case if left out.
    """
    design = None if modes is None else DesignModel(modes=modes)
    law = jb.MPC(
        horizon=horizon,
        moves=control_horizon,
        move_weight=move_weight,
        period=PERIOD,
        design=design,
    )
    case = dataclasses.replace(case, controller=law)
    times = np.arange(round(float(case.run.duration) / PERIOD) + 1) * PERIOD
    # So many steps that the phase of the fastest mode advances by a radian or two in each.
    plan = IntegrationPlan(
        static_shapes(case), 2 * case.beam.modes, 0, False, 0.0, loop_schedule(case, times)
    )
    return jb.simulate(case, jnp.asarray(times), plan)


def run(load_rig) -> ExperimentResult:
    """Reductions and instants of saturation on rigs B and C, beside the least achievable peak."""
    one, one_records = _one_span(with_crossing(load_rig("B")))
    two, two_records = _two_spans(with_crossing(load_rig("C")))
    figures = {
        "one-span": _draw(one_records, "One span, 0.509 kg at 1 m/s (Figs 7.1, 7.2)"),
        "two-spans": _draw(two_records, "Two spans, 0.509 kg at 1 m/s (Figs 7.5 to 7.7)"),
    }
    return ExperimentResult((*one, *two), figures)


def _one_span(case):
    """Findings and records of rig B."""
    three, eight = (
        {
            "no control": jb.simulate(one, tolerance=TOLERANCE),
            "r_w 1e-11": simulate_mpc(one, 6, 4),
            "r_w 1e-6": simulate_mpc(one, 6, 4, HIGH_MOVE_WEIGHT),
        }
        for one in (case, with_modes(case, 8))
    )
    as_drawn, more_modes = f"as a curve shows it, to {CURVE_RESOLUTION:.0%}", "8 modes"
    saturation = {
        (*answers, *drawn): [
            _saturation_time(one, 0, 7.5, share) for one in list(runs.values())[1:]
        ]
        for answers, runs in (((), three), ((more_modes,), eight))
        for drawn, share in (((), 1e-6), ((as_drawn,), CURVE_RESOLUTION))
    }
    reductions = [
        float(
            reduction(runs["no control"].peak_deflection[0], runs["r_w 1e-11"].peak_deflection[0])
        )
        for runs in (three, eight)
    ]
    one_move = [simulate_mpc(one, 6, 1) for one in (case, with_modes(case, 8))]
    uncontrolled = jb.simulate(case, one_move[0].times, tolerance=TOLERANCE)
    peak_times = [_peak_times(one) for one in one_move]
    findings = (
        make_finding(
            published.ONE_MOVE_PEAKS,
            peak_times[0],
            {more_modes: peak_times[1]},
            null=("no control", _peak_times(uncontrolled)),
        ),
        make_finding(
            published.ONE_SPAN_REDUCTION,
            reductions[0],
            {more_modes: reductions[1]},
            null=("no control", 0.0),
        ),
        make_finding(
            published.ONE_SPAN_SATURATION,
            saturation.pop(()),
            saturation,
            null=AT_ONCE,
            fitted={as_drawn: "r_w=1e-6"},
        ),
    )
    return findings, three


def _two_spans(case):
    """Findings and records of rig C."""
    free = jb.simulate(case, tolerance=TOLERANCE)
    short, long = simulate_mpc(case, 4, 3), simulate_mpc(case, 6, 4)
    by_short, by_long = (
        reduction(_peaks_by_half(free), _peaks_by_half(one)) for one in (short, long)
    )
    no_control = "no control", 0.0
    findings = (
        make_finding(published.TWO_SPAN_REDUCTION, by_short[PRINTED_REDUCTIONS], null=no_control),
        make_finding(
            published.SECOND_HALF_REDUCTION,
            [by_short[1, 0], by_long[1, 0]],
            null=no_control,
            impossible={"": _unattainable_reductions(case)},
        ),
        _reduced_model_finding(case),
        make_finding(
            published.TWO_SPAN_SATURATION,
            [_saturation_time(short, 0, 7.5), _saturation_time(short, 1, -2.5)],
            null=AT_ONCE,
        ),
    )
    return findings, {"no control": free, "Np 4, Nc 3": short, "Np 6, Nc 4": long}


def _reduced_model_finding(case: jb.Case) -> Finding:
    """Finding on the peaks of a beam with 12 modes under a controller designed on 3 modes."""
    twelve = with_modes(case, 12)
    free = jb.simulate(twelve, tolerance=TOLERANCE)
    controlled = simulate_mpc(twelve, 2, 1, modes=3)
    reductions = reduction(free.peak_deflection, controlled.peak_deflection)
    return make_finding(
        published.REDUCED_MODEL,
        (reductions > 0).astype(float),
        null=("no control", 0.0),
        remark=f"the reductions are {reductions[0]:.1f} and {reductions[1]:.1f} %",
    )


def _peak_times(record: jb.Record) -> np.ndarray:
    """Times (s) of the first and last upward peak of the deflection while loaded, (2,), or NaN."""
    history = np.asarray(record.deflection)[:, 0]
    inner = history[1:-1]
    peaks = 1 + np.flatnonzero((inner > history[:-2]) & (inner > history[2:]))
    times = np.asarray(record.times)[peaks]
    loaded = times[times < float(record.case.beam.length) / SPEED]
    return loaded[[0, -1]] if loaded.size else np.full(2, np.nan)


def _unattainable_reductions(case: jb.Case) -> str:
    """Proof that no controller attains the printed reductions of the second half; or empty.

    The stated limits and patches, on beams of every printed rigidity, density and damping ratio,
    and at all speeds of the experiments.
    """
    attainable = []
    beams = [(*one, SPEED) for one in itertools.product(PRINTED_SECTIONS, DAMPING_RATIOS)]
    beams += [(PRINTED_SECTIONS[0], DAMPING_RATIOS[1], speed) for speed in OTHER_SPEEDS]
    for (rigidity, density), ratio, speed in beams:
        beam = {"beam.flexural_rigidity": rigidity, "beam.mass_per_length": density}
        at_speed = {"beam.damping_ratio": ratio, "loads.0.speed": speed}
        changed = with_duration(case, float(case.beam.length) / speed + 0.2)
        attainable.append(_attainable_in_second_half(jb.replace(changed, beam | at_speed)))
    if max(attainable) >= published.SECOND_HALF_REDUCTION.numbers.min():
        return ""
    return (
        "no commands within the limits of the patches, whatever the controller, reduce the peak"
        f" by more than {max(attainable):.1f} % there, on any beam whose rigidity, density and"
        f" damping are printed, nor at {min(OTHER_SPEEDS):g} to {max(OTHER_SPEEDS):g} m/s on the"
        " beam of the rig (a linear program, which knows the load)"
    )


def _saturation_time(
    record: jb.Record, actuator: int, limit: float, tolerance: float = 1e-6
) -> float:
    """First time (s) at which a command is at a limit (V), to a relative tolerance; or NaN."""
    command = np.asarray(record.command)[:, actuator]
    at_limit = np.abs(command - limit) < tolerance * abs(limit)
    return float(record.times[np.argmax(at_limit)]) if at_limit.any() else np.nan


def _peaks_by_half(record: jb.Record) -> np.ndarray:
    """Largest deflections (m) in the first and second half of the crossing (half, sensor)."""
    middle = float(record.case.beam.length) / SPEED / 2
    times = np.asarray(record.times)
    sizes = np.abs(np.asarray(record.deflection))
    second = (times >= middle) & (times <= 2 * middle)
    return np.array([sizes[times < middle].max(axis=0), sizes[second].max(axis=0)])


def _attainable_in_second_half(case: jb.Case) -> float:
    """Largest achievable reduction (%) at the first sensor in the second half of the crossing."""
    position = np.array([float(case.sensors[0].position)])
    influence = input_influence(case, position, PERIOD, PERIOD / 2)
    crossing = float(case.beam.length / case.loads[0].speed)
    second = (influence.times >= crossing / 2) & (influence.times <= crossing)
    influence = eqx.tree_at(
        lambda i: (i.times, i.unforced, i.response),
        influence,
        (influence.times[second], influence.unforced[second], influence.response[second]),
    )
    low, high = np.array([actuator.command_limits() for actuator in case.actuators]).T
    peak, _, _ = least_peak(influence, low, high, np.full(low.shape, np.inf))
    uncontrolled = np.abs(influence.unforced @ influence.deflection_rows.T).max()
    return float(reduction(uncontrolled, peak))


@use_style
def _draw(records: dict[str, jb.Record], title: str) -> Figure:
    """Deflections at the sensors, and command voltages with their limits (dotted)."""
    case = next(iter(records.values())).case
    sensors, actuators = len(case.sensors), len(case.actuators)
    figure = Figure(figsize=(7.2, 0.8 + 1.7 * (sensors + actuators)))
    panels = figure.subplots(sensors + actuators, 1, sharex=True)
    for i, sensor in enumerate(case.sensors):
        plot_deflections(panels[i], records, i)
        panels[i].set(title=f"at {float(sensor.position):g} m", ylabel="deflection (mm)")
    for j, axes in enumerate(panels[sensors:]):
        plot_commands(axes, records, [j], held=True)
        axes.set(title=f"command to patch {j + 1}", ylabel="voltage (V)")
        for limit in np.asarray(case.actuators[j].command_limits()):
            axes.axhline(limit, color=GREY, linewidth=0.8, linestyle=":")
    last = max(float(record.times[-1]) for record in records.values())
    panels[-1].set(xlabel="time (s)", xlim=(0, last))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, title)
    return figure


EXPERIMENT = Experiment(
    "predictive-control",
    "section 7.3, Figs 7.1 to 7.9, Table 8.1",
    "Predictive control uses the whole voltage of the patches: it reduces the peak of one span by"
    " more than a fifth, that of two by more than a quarter.",
    run,
)
