"""Position-scheduled feedforward on the patch rigs, tuned by gradients; held-out performance.

One table of commands over the position of the load (`jaxbeam.control.feedforward`) serves all
masses and speeds. It is tuned by `experiments.studies.tune_feedforward` and compared, on held-out
loads, with the cubic feedback of chapter 6 and the least achievable peak:

- bench: 20 ms of delay, compensated by an equal lead; then also 10 ms more, which are not
  compensated, or a beam that is 10 % stiffer or softer than the design model;
- a trapezium drawn by hand on the same gates, on the same bench.

Commands are sampled every 10 ms in steps of 10 mV (2 V at the patch); loads enter between sampling
instants.

Mass and speed are unknown beforehand: the speed is measured by two gates on the ramp, as in the
thesis, the mass not at all. No reading of the beam is fed back, so that noise and filters of its
sensors have no effect and the loop cannot become unstable.

Laws drawn by hand on the patch rigs, the reference for tuned laws.

A trapezium of four numbers on the same gates as the tuned table, and a table over the deflection
that goes to the limits where the tuning of the sensors-only law starts to be flat. No number of
them was fitted to any run.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.studies import tune_sensor_feedback
from experiments.studies.held_out import (
    CUBIC_CUTOFFS,
    CUBIC_FEEDBACK,
    EXTRA_DELAY,
    EXTRA_DELAY_LAW,
    HeldOutStudy,
    draw,
    held_out_loads,
    held_out_study,
    with_held_out_duration,
)
from experiments.studies.tune_feedforward import COMMAND_LIMITS, FOLDER, initial_law
from experiments.thesis.cases import with_feedback
from experiments.thesis.verdicts import Experiment, ExperimentResult

LOW, HIGH = COMMAND_LIMITS
TRAPEZIA = {  # shares of the beam, V: from limit to limit, with ramps drawn by hand
    "B": [([0.0, 0.2, 0.9, 1.0], [0.0, HIGH, HIGH, 0.0])],
    "C": [
        ([0.0, 0.1, 0.38, 0.55, 0.75, 1.0], [0.0, HIGH, HIGH, LOW, LOW, 0.0]),
        ([0.0, 0.1, 0.38, 0.55, 0.9, 1.0], [0.0, LOW, LOW, HIGH, HIGH, 0.0]),
    ],
}
HAND_SET, HAND_DRAWN = "hand-set trapezium", "hand-drawn, sensors only"


def trapezium(rig: str) -> jb.Feedforward:
    """The law drawn by hand on the gates, with the lead of the law that tuning starts from."""
    tables = TRAPEZIA[rig]
    shares = np.unique(np.concatenate([shares for shares, _ in tables]))
    values = np.array([np.interp(shares, *table) for table in tables])
    return dataclasses.replace(initial_law(rig), shares=shares, values=values)


def drawn_table(rig: str) -> jb.InternalModel:
    """The law drawn by hand over the sensors' readings: straight to the limits, then flat."""
    law = tune_sensor_feedback.initial_law(rig)
    flat_from, _, above = tune_sensor_feedback.INITIAL_TABLE[rig]  # m, -, V
    ends = [HIGH, 0.0, LOW if above else 0.0]  # one span is not pressed down by its patch
    row = np.interp(np.asarray(law.readings), [-flat_from, 0.0, flat_from], ends)
    return dataclasses.replace(law, values=np.array([row] * law.values.shape[0]))


DELAY = 0.02  # s
BENCH = "tuned, bench"
DRAWN_LAWS = (CUBIC_FEEDBACK, HAND_SET, BENCH, EXTRA_DELAY_LAW)


def run(load_rig) -> ExperimentResult:
    """Shares of the achievable reduction on rigs B and C, for held-out loads."""
    studies = [run_study(rig, load_rig(rig)) for rig in ("B", "C")]
    remarks = [line for one in studies for line in one.remarks((CUBIC_FEEDBACK, HAND_SET, BENCH))]
    title = "One tuned table of commands for all loads, held-out loads"
    return ExperimentResult((), {"shares": draw(studies, DRAWN_LAWS, title)}, tuple(remarks))


def run_study(rig: str, case: jb.Case) -> HeldOutStudy:
    """Run all laws on the held-out loads of a rig."""
    case, loads = with_held_out_duration(rig, case), held_out_loads(rig)
    law = jb.load_case(FOLDER / f"{rig}.toml").controller
    controlled_cases = {
        CUBIC_FEEDBACK: with_feedback(case, 3, CUBIC_CUTOFFS[rig]),
        HAND_SET: dataclasses.replace(case, controller=with_bench_delay(trapezium(rig))),
        BENCH: dataclasses.replace(case, controller=with_bench_delay(law)),
        EXTRA_DELAY_LAW: dataclasses.replace(case, controller=with_bench_delay(law, EXTRA_DELAY)),
    }
    return held_out_study(controlled_cases, loads, BENCH)


def with_bench_delay(law: jb.Feedforward, extra_delay: float = 0.0) -> jb.Feedforward:
    """The law with the delay of the bench, compensated by an equal lead.

    `extra_delay` (s) is not compensated.
    """
    return dataclasses.replace(law, lead=law.lead + DELAY, delay=np.asarray(DELAY + extra_delay))


EXPERIMENT = Experiment(
    "tuned",
    "beyond Table 8.1: controllers tuned by gradients",
    "One table of commands, tuned for all masses and speeds, comes close to the least achievable"
    " peak.",
    run,
)
