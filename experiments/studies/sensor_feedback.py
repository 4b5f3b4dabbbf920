"""Static output feedback through a table on the patch rigs, from sensors alone; held-out loads.

One table of commands over the deflection under the load (`jaxbeam.control.internal_model`)
serves all masses and speeds. It is tuned by `experiments.studies.tune_sensor_feedback` on the
bench: noise of 4 um, filters of tenth order at 10 Hz (one span) and 20 Hz (two), a command every 10
ms in steps of 10 mV, 20 ms late. There are no gates, and neither mass nor speed is given. It is
compared with the least achievable peak on loads, entries and noise that it was not tuned on; then
also 10 ms later, on a beam that is 10 % stiffer or softer than its design model, with a command
every 15 ms, and with the filter of the other rig. A table drawn by hand stands beside it.

Its stability: the largest real part of the frozen poles along all these crossings, 10 ms later and
with the beam as designed for, stiffer and softer, beside that of the beams without control.
The table has a kink at zero; poles are computed with either slope.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.studies.held_out import (
    CUBIC_CUTOFFS,
    CUBIC_FEEDBACK,
    EXTRA_DELAY,
    EXTRA_DELAY_LAW,
    PERIOD,
    RIGIDITY,
    RIGIDITY_ERRORS,
    HeldOutStudy,
    draw,
    held_out_loads,
    held_out_study,
    with_held_out_duration,
)
from experiments.studies.tune_feedforward import MODES
from experiments.studies.tune_sensor_feedback import (
    CUTOFF,
    DELAY,
    FOLDER,
    READING_OFFSET,
    with_noise_and_filters,
)
from experiments.studies.tuned_feedforward import HAND_DRAWN, drawn_table
from experiments.thesis.cases import with_feedback, with_modes
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.case import concrete_case
from jaxbeam.model.modes import mesh_layout
from tuning.control.load_cases import run_case
from tuning.control.objective import with_fixed_design

SENSORS_ONLY = "tuned, sensors only"
DRAWN_LAWS = (CUBIC_FEEDBACK, HAND_DRAWN, SENSORS_ONLY, EXTRA_DELAY_LAW)
SEED = 1  # of the noise; tuned with another
CROSSING_POSITIONS = 12  # positions of the load at which poles are computed
LONG_PERIOD = 0.015  # s: the longest sampling period of the bench


def run(load_rig) -> ExperimentResult:
    """Shares of the achievable reduction on rigs B and C, and poles, for held-out loads."""
    studies, remarks = [], []
    for rig in ("B", "C"):
        study = run_study(rig, load_rig(rig))
        studies.append(study)
        remarks += study.remarks((CUBIC_FEEDBACK, HAND_DRAWN, SENSORS_ONLY))
        controlled, uncontrolled = worst_real_parts(rig, load_rig(rig))
        remarks.append(
            f"largest real part of frozen poles, {1e3 * EXTRA_DELAY:g} ms later and the beam 10 %"
            f" off: {controlled:.2f} 1/s; {uncontrolled:.2f} 1/s without control"
        )
    title = "One table over the sensors' readings for all loads, held-out loads"
    return ExperimentResult((), {"shares": draw(studies, DRAWN_LAWS, title)}, tuple(remarks))


def bench_case(rig: str, case: jb.Case) -> jb.Case:
    """The rig on the bench under the tuned law."""
    law = jb.load_case(FOLDER / f"{rig}.toml").controller
    case = with_noise_and_filters(rig, with_held_out_duration(rig, case), SEED)
    return dataclasses.replace(case, controller=law)


def run_study(rig: str, case: jb.Case) -> HeldOutStudy:
    """Run all laws on the held-out loads of a rig."""
    bench, loads = bench_case(rig, case), held_out_loads(rig)
    law = bench.controller
    delayed_law = dataclasses.replace(law, delay=np.asarray(DELAY + EXTRA_DELAY))
    feedback_case = with_feedback(dataclasses.replace(case, run=bench.run), 3, CUBIC_CUTOFFS[rig])
    slower = {
        name: dataclasses.replace(
            with_cutoff(bench, cutoff),
            controller=dataclasses.replace(law, period=np.asarray(period)),
        )
        for name, (period, cutoff) in untuned_conditions(rig).items()
    }
    controlled_cases = {
        CUBIC_FEEDBACK: feedback_case,
        HAND_DRAWN: dataclasses.replace(bench, controller=drawn_table(rig)),
        SENSORS_ONLY: bench,
        EXTRA_DELAY_LAW: dataclasses.replace(bench, controller=delayed_law),
        **slower,
    }
    return held_out_study(controlled_cases, loads, SENSORS_ONLY)


def untuned_conditions(rig: str) -> dict[str, tuple[float, float]]:
    """Sampling periods (s) and cutoffs (Hz) that the law was not tuned for, by name."""
    own = CUTOFF[rig]
    (other,) = set(CUTOFF.values()) - {own}
    pairs = [(LONG_PERIOD, own), (PERIOD, other)]
    return {f"{1e3 * period:g} ms, {cutoff:g} Hz": (period, cutoff) for period, cutoff in pairs}


def with_cutoff(case: jb.Case, cutoff: float) -> jb.Case:
    """The case with another cutoff (Hz) of the filters of all its sensors."""
    addresses = [f"sensors.{i}.filter.cutoff" for i in range(len(case.sensors))]
    return jb.replace(case, dict.fromkeys(addresses, cutoff))


def worst_real_parts(rig: str, case: jb.Case) -> tuple[float, float]:
    """Largest real part (1/s) of frozen poles over all held-out loads, and without control.

    With more delay, on beams as designed for, stiffer and softer, with the modes that the law was
    tuned on: the filters hardly pass those above, from 70 Hz on.
    """
    bench, loads = with_modes(bench_case(rig, case), MODES), held_out_loads(rig)
    law = bench.controller
    laws = [
        dataclasses.replace(
            law, readings=law.readings + offset, delay=np.asarray(DELAY + EXTRA_DELAY)
        )
        for offset in (-READING_OFFSET, READING_OFFSET)
    ]
    zero_table = dataclasses.replace(law, values=0 * law.values)

    def worst(laws) -> float:
        return max(largest_real_part(bench, law, load) for law in laws for load in loads)

    return worst(laws), worst([zero_table])


def largest_real_part(bench: jb.Case, law: jb.InternalModel, load: dict[str, float]) -> float:
    """Largest real part (1/s) along one crossing, on beams as designed for, stiffer and softer."""
    case = run_case(dataclasses.replace(bench, controller=law), load)
    span = float(case.beam.length) / load["loads.0.speed"]
    times = load["loads.0.entry_time"] + span * np.linspace(-0.02, 0.98, CROSSING_POSITIONS)
    design = {RIGIDITY: float(case.beam.flexural_rigidity)}
    real_parts = []
    for factor in (1.0, *RIGIDITY_ERRORS.values()):
        plant = jb.replace(case, {RIGIDITY: factor * design[RIGIDITY]})
        plant = with_fixed_design(plant, design, mesh_layout(concrete_case(plant)))
        real_parts.append(frozen_poles(plant, times).largest_real_part.max())
    return float(max(real_parts))


EXPERIMENT = Experiment(
    "sensed",
    "beyond Table 8.1: sensors alone, as on the bench",
    "A table over the sensors' readings, tuned for all masses and speeds, comes near the least"
    " achievable peak.",
    run,
)
