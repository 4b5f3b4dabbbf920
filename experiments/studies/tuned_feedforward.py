"""Position-scheduled feedforward on the patch rigs, tuned by gradients; held-out performance.

One table of commands over the position of the load (`jaxbeam.control.feedforward`) serves all
masses and speeds. It is tuned by gradients and compared, on held-out loads, with the cubic feedback
of chapter 6 and the least achievable peak:

- bench: 20 ms of delay, compensated by an equal lead; then also 10 ms more, which are not
  compensated, or a beam that is 10 % stiffer or softer than the design model;
- a trapezium drawn by hand on the same gates, on the same bench.

Commands are sampled every 10 ms in steps of 10 mV (2 V at the patch); loads enter between sampling
instants.

Mass and speed are unknown beforehand: the speed is measured by two gates on the ramp, as in the
thesis, the mass not at all. No reading of the beam is fed back, so that noise and filters of its
sensors have no effect and the loop cannot become unstable.

The trapezium drawn by hand, of four numbers on the same gates as the tuned table, is the reference
for the tuned law: no number of it was fitted to any run.

    python -m experiments.studies.tuned_feedforward B    # or C

tunes the table by gradients and writes controllers/feedforward/B.toml. It starts as a trapezium
within the limits of the patches; its values follow the gradient of the worst shortfall from the
least achievable peak. On the bench the same table is read earlier by the delay.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.held_out import (
    CUBIC_CUTOFFS,
    CUBIC_FEEDBACK,
    EXTRA_DELAY,
    EXTRA_DELAY_LAW,
    PERIOD,
    HeldOutStudy,
    draw,
    held_out_loads,
    held_out_study,
    training_loads,
    with_held_out_duration,
)
from experiments.thesis.cases import with_feedback, with_modes
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.case.library import rigs

FOLDER = Path(__file__).parent / "controllers" / "feedforward"
LEAD = 0.005  # s: half of the sampling period, the mean delay of a held command
GATES = (-0.2, -0.1)  # m: on the ramp before the beam, as the induction sensors of the thesis
COMMAND_LIMITS, COMMAND_RESOLUTION = (-2.5, 7.5), 0.01  # V
SPEEDS = {"B": np.linspace(0.3, 1.0, 12), "C": np.linspace(0.3, 1.0, 8)}  # m/s
INITIAL_TABLES = {  # V at fractions of the span
    "B": [([0.0, 0.2, 0.9, 1.0], [0.5, 6.8, 6.8, 0.0])],
    "C": [
        ([0.0, 0.1, 0.38, 0.55, 0.75, 1.0], [0.3, 6.8, 6.8, -1.8, -1.8, 0.0]),
        ([0.0, 0.1, 0.38, 0.55, 0.9, 1.0], [0.0, -1.8, -1.8, 6.8, 6.8, 0.0]),
    ],
}
BREAKPOINTS, STEPS = {"B": 31, "C": 41}, {"B": 250, "C": 140}
SAMPLE_RATE = {"B": 200.0, "C": 100.0}  # Hz: enough for a smooth peak
MODES = 3  # of the model in tuning; the studies use those of the rig


def initial_law(rig: str) -> jb.Feedforward:
    """The law that tuning starts from on rig B or C."""
    shares = np.linspace(0.0, 1.0, BREAKPOINTS[rig])
    return jb.Feedforward(
        gates=GATES,
        shares=shares,
        values=[np.interp(shares, *table) for table in INITIAL_TABLES[rig]],
        period=PERIOD,
        lead=LEAD,
        resolution=COMMAND_RESOLUTION,
    )


def tune_law(rig: str) -> tuning.TuningResult:
    """Tune the table and its lead for the worst of all training loads on rig B or C."""
    case = with_modes(rigs.load(rig), MODES)
    slowest = float(case.beam.length) / min(SPEEDS[rig])
    case = dataclasses.replace(
        case,
        controller=initial_law(rig),
        run=jb.Run(duration=slowest + 0.15, sample_rate=SAMPLE_RATE[rig]),
    )
    actuators, breakpoints = case.controller.values.shape
    free = {
        f"controller.values.{a}.{k}": COMMAND_LIMITS
        for a in range(actuators)
        for k in range(breakpoints)
    }
    return tuning.tune(
        case,
        free | {"controller.lead": (0.0, 0.1)},
        tuning.LoadCases(training_loads(SPEEDS[rig])),
        tuning.Objective({"shortfall": 1.0}),
        steps=STEPS[rig],
    )


LOW, HIGH = COMMAND_LIMITS
TRAPEZIA = {  # shares of the beam, V: from limit to limit, with ramps drawn by hand
    "B": [([0.0, 0.2, 0.9, 1.0], [0.0, HIGH, HIGH, 0.0])],
    "C": [
        ([0.0, 0.1, 0.38, 0.55, 0.75, 1.0], [0.0, HIGH, HIGH, LOW, LOW, 0.0]),
        ([0.0, 0.1, 0.38, 0.55, 0.9, 1.0], [0.0, LOW, LOW, HIGH, HIGH, 0.0]),
    ],
}
HAND_SET = "hand-set trapezium"


def trapezium(rig: str) -> jb.Feedforward:
    """The law drawn by hand on the gates, with the lead of the law that tuning starts from."""
    tables = TRAPEZIA[rig]
    shares = np.unique(np.concatenate([shares for shares, _ in tables]))
    values = np.array([np.interp(shares, *table) for table in tables])
    return dataclasses.replace(initial_law(rig), shares=shares, values=values)


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


if __name__ == "__main__":
    for name in sys.argv[1:]:
        result = tune_law(name)
        print(result)
        jb.save_case(result.case, FOLDER / f"{name}.toml", overwrite=True)
