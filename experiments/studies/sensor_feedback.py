"""Laws on the patch rigs that know nothing but what their sensors read, beside what is possible.

One table of commands over the deflection under the load (`jaxbeam.control.internal_model`) for all masses
and speeds, tuned by gradients on the bench (`experiments.studies.tune_sensor_feedback`): noise of 4 um, filters
of tenth order at 10 Hz (one span) and 20 Hz (two), a command every 10 ms in steps of 10 mV, 20 ms
late. No gate, no mass and no speed is told. It is proven on loads, entries and noise that it was
not tuned on; then also 10 ms later, on a beam that is 10 % stiffer or softer than it believes, and
as it is at the other corners of the bench: a command every 15 ms, and the filter of the other rig.

Its margin: the largest real part of the frozen poles along all these crossings, with 10 ms more
delay and the beam as believed, stiffer and softer, beside that of the beams without control. At
rest without a load the table bends; both of its sides are looked at.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.tune_feedforward import MODES, PERIOD
from experiments.studies.tune_sensor_feedback import (
    CUTOFF,
    DELAY,
    FOLDER,
    READING_OFFSET,
    with_noise_and_filters,
)
from experiments.studies.tuned_feedforward import (
    CUBIC_FEEDBACK,
    CUTOFFS,
    ENTRY_TIME,
    EXTRA_DELAY,
    EXTRA_DELAY_LAW,
    MASSES,
    RIGIDITY,
    RIGIDITY_ERRORS,
    SPEEDS,
    HeldOutStudy,
    draw,
    peaks,
    study_remarks,
)
from experiments.thesis.chapter6.feedback import with_feedback
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.case import known_case
from jaxbeam.model.modes import lay_out
from tuning.control.fixed_design import with_fixed_design
from tuning.control.load_cases import run_case
from tuning.control.run_set import make_run_set

SENSORS_ONLY = "tuned, sensors only"
LAWS = (CUBIC_FEEDBACK, SENSORS_ONLY, EXTRA_DELAY_LAW)
SEED = 1  # of the noise; tuned with another
MARGIN_POSITIONS = 24  # along each crossing, for the margin
LONG_PERIOD = 0.015  # s: the longest sampling period of the bench


def run(load_rig) -> ExperimentResult:
    """Shares of the attainable reduction on rigs B and C, and margins, for loads held out."""
    studies = {rig: run_study(rig, load_rig(rig)) for rig in ("B", "C")}
    remarks = []
    for rig, one in studies.items():
        remarks += study_remarks(one, (CUBIC_FEEDBACK, SENSORS_ONLY))
        controlled_pole, uncontrolled_pole = worst_real_parts(rig, load_rig(rig))
        remarks.append(
            f"largest real part of frozen poles, {1e3 * EXTRA_DELAY:g} ms later and the beam 10 %"
            f" off: {controlled_pole:.2f} 1/s; {uncontrolled_pole:.2f} 1/s without control"
        )
    title = "One table over the sensors' readings for all loads, proven on loads held out"
    return ExperimentResult(
        (), {"shares": draw(list(studies.values()), LAWS, title)}, tuple(remarks)
    )


def bench_case(rig: str, case: jb.Case) -> tuple[jb.Case, tuple[dict[str, float], ...]]:
    """The rig on the bench under the tuned law, and the loads held out."""
    duration = float(case.beam.length) / min(SPEEDS[rig]) + ENTRY_TIME + 0.1
    case = dataclasses.replace(case, run=jb.Run(duration=duration, sample_rate=200.0))
    law = jb.load_case(FOLDER / f"{rig}.toml").controller
    loads = tuning.full_grid(
        {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS[rig], "loads.0.entry_time": [ENTRY_TIME]}
    )
    return dataclasses.replace(with_noise_and_filters(rig, case, SEED), controller=law), loads


def run_study(rig: str, case: jb.Case) -> HeldOutStudy:
    """Run all laws on the held-out loads of a rig."""
    real, loads = bench_case(rig, case)
    law = real.controller
    delayed_law = dataclasses.replace(law, delay=np.asarray(DELAY + EXTRA_DELAY))
    feedback_case = dataclasses.replace(case, run=real.run)
    best = make_run_set(real, loads, least_peaks=True)
    run_sets = {
        CUBIC_FEEDBACK: make_run_set(with_feedback(feedback_case, 3, CUTOFFS[rig]), loads),
        SENSORS_ONLY: best,
        EXTRA_DELAY_LAW: make_run_set(dataclasses.replace(real, controller=delayed_law), loads),
    }
    for word, (period, cutoff) in untuned_conditions(rig).items():
        slow = dataclasses.replace(law, period=np.asarray(period))
        other = dataclasses.replace(with_cutoff(real, cutoff), controller=slow)
        run_sets[word] = make_run_set(other, loads)
    # Of other beams the law believes that they are as those of the case.
    for word, factor in RIGIDITY_ERRORS.items():
        changed = {RIGIDITY: factor * float(case.beam.flexural_rigidity)}
        run_sets[word] = make_run_set(real, [run | changed for run in loads])
    records = {name: bench.records({}) for name, bench in run_sets.items()}
    return HeldOutStudy(
        title=case.title,
        loads=loads,
        attainable=1 - best.uncontrolled["least"] / best.uncontrolled["peak"],
        reductions={
            name: 1 - peaks(found) / run_sets[name].uncontrolled["peak"]
            for name, found in records.items()
        },
        records={name: found[-1] for name, found in records.items()},
    )


def untuned_conditions(rig: str) -> dict[str, tuple[float, float]]:
    """Sampling periods (s) and cutoffs (Hz) that the law was not tuned for, by name."""
    own = CUTOFF[rig]
    (other,) = set(CUTOFF.values()) - {own}
    pairs = [(LONG_PERIOD, own), (PERIOD, other), (LONG_PERIOD, other)]
    return {f"{1e3 * period:g} ms, {cutoff:g} Hz": (period, cutoff) for period, cutoff in pairs}


def with_cutoff(case: jb.Case, cutoff: float) -> jb.Case:
    """The case with another cutoff (Hz) of the filters of all its sensors."""
    addresses = [f"sensors.{i}.filter.cutoff" for i in range(len(case.sensors))]
    return jb.replace(case, dict.fromkeys(addresses, cutoff))


def worst_real_parts(rig: str, case: jb.Case) -> tuple[float, float]:
    """Largest real part (1/s) of frozen poles over all loads, late and off; and without control.

    On the modes that the law was tuned on: those above, from 70 Hz on, hardly pass the filters.
    """
    real, loads = bench_case(rig, case)
    real = dataclasses.replace(real, beam=dataclasses.replace(real.beam, modes=MODES))
    law = real.controller
    shifted_tables = [
        dataclasses.replace(law, readings=law.readings + s * READING_OFFSET) for s in (-1, 1)
    ]
    laws = [
        dataclasses.replace(one, delay=np.asarray(DELAY + more))
        for one in shifted_tables
        for more in (0.0, EXTRA_DELAY)
    ]
    zero_table = [dataclasses.replace(law, values=0 * law.values)]
    controlled_pole, uncontrolled_pole = (max(largest_real_part(real, one, run) for one in some for run in loads)
                  for some in (laws, zero_table))  # fmt: skip
    return controlled_pole, uncontrolled_pole


def largest_real_part(real: jb.Case, law: jb.Relief, run: dict[str, float]) -> float:
    """The largest real part (1/s) along one crossing, on beams as the law believes and others."""
    case = run_case(dataclasses.replace(real, controller=law), run)
    span = float(case.beam.length) / run["loads.0.speed"]
    times = run["loads.0.entry_time"] + span * np.linspace(-0.02, 0.98, MARGIN_POSITIONS)
    design_numbers = {RIGIDITY: float(case.beam.flexural_rigidity)}
    found = []
    for factor in (1.0, *RIGIDITY_ERRORS.values()):
        other_beam = jb.replace(case, {RIGIDITY: factor * design_numbers[RIGIDITY]})
        other_beam = with_fixed_design(other_beam, design_numbers, lay_out(known_case(other_beam)))
        found.append(frozen_poles(other_beam, times).largest_real_part.max())
    return float(max(found))


EXPERIMENT = Experiment(
    "sensed",
    "beyond Table 8.1: sensors alone, as on the bench",
    "A table over what the sensors read, tuned for all masses and speeds, comes near what is"
    " possible.",
    run,
)
