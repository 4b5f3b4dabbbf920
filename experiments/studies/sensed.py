"""Laws on the patch rigs that know nothing but what their sensors read, beside what is possible.

One table of commands over the deflection under the load (`jaxbeam.control.internal_model`) for all masses
and speeds, tuned by gradients on the bench (`experiments.studies.sensed_search`): noise of 4 um, filters
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
from experiments.studies.sensed_search import BESIDE, CUTOFF, DELAY, FOLDER, on_bench
from experiments.studies.tuned import (
    CUBIC,
    CUTOFFS,
    ENTRY,
    LATE,
    MASSES,
    MORE_DELAY,
    RIGIDITY,
    SPEEDS,
    STIFFER,
    Study,
    draw,
    peaks,
    told,
)
from experiments.studies.tuned_search import MODES, PERIOD
from experiments.thesis.chapter6.feedback import controlled
from experiments.thesis.verdicts import Experiment, Outcome
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.case import known_case
from jaxbeam.model.modes import lay_out
from tuning.control.fixed_design import believing
from tuning.control.load_cases import apply
from tuning.control.run_set import make_bench

SENSED = "tuned, sensors only"
LAWS = (CUBIC, SENSED, LATE)
SEED = 1  # of the noise; tuned with another
PLACES = 24  # along each crossing, for the margin
SLOWER = 0.015  # s: the longest sampling period of the bench


def run(load) -> Outcome:
    """Shares of the attainable reduction on rigs B and C, and margins, for loads held out."""
    studies = {rig: study(rig, load(rig)) for rig in ("B", "C")}
    remarks = []
    for rig, one in studies.items():
        remarks += told(one, (CUBIC, SENSED))
        held, free = margin(rig, load(rig))
        remarks.append(
            f"largest real part of frozen poles, {1e3 * MORE_DELAY:g} ms later and the beam 10 %"
            f" off: {held:.2f} 1/s; {free:.2f} 1/s without control"
        )
    title = "One table over the sensors' readings for all loads, proven on loads held out"
    return Outcome((), {"shares": draw(list(studies.values()), LAWS, title)}, tuple(remarks))


def prepared(rig: str, case: jb.Case) -> tuple[jb.Case, tuple[dict[str, float], ...]]:
    """The rig on the bench under the tuned law, and the loads held out."""
    duration = float(case.beam.length) / min(SPEEDS[rig]) + ENTRY + 0.1
    case = dataclasses.replace(case, run=jb.Run(duration=duration, sample_rate=200.0))
    law = jb.load_case(FOLDER / f"{rig}.toml").controller
    loads = tuning.grid(
        {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS[rig], "loads.0.entry_time": [ENTRY]}
    )
    return dataclasses.replace(on_bench(rig, case, SEED), controller=law), loads


def study(rig: str, case: jb.Case) -> Study:
    """Run all laws on the held-out loads of a rig."""
    real, loads = prepared(rig, case)
    law = real.controller
    later = dataclasses.replace(law, delay=np.asarray(DELAY + MORE_DELAY))
    hand = dataclasses.replace(case, run=real.run)
    best = make_bench(real, loads, bounds=True)
    benches = {
        CUBIC: make_bench(controlled(hand, 3, CUTOFFS[rig]), loads),
        SENSED: best,
        LATE: make_bench(dataclasses.replace(real, controller=later), loads),
    }
    for word, (period, cutoff) in corners(rig).items():
        slow = dataclasses.replace(law, period=np.asarray(period))
        other = dataclasses.replace(filtered(real, cutoff), controller=slow)
        benches[word] = make_bench(other, loads)
    # Of other beams the law believes that they are as those of the case.
    for word, factor in STIFFER.items():
        changed = {RIGIDITY: factor * float(case.beam.flexural_rigidity)}
        benches[word] = make_bench(real, [run | changed for run in loads])
    records = {name: bench.records({}) for name, bench in benches.items()}
    return Study(
        title=case.title,
        loads=loads,
        attainable=1 - best.free["least"] / best.free["peak"],
        reductions={
            name: 1 - peaks(found) / benches[name].free["peak"] for name, found in records.items()
        },
        records={name: found[-1] for name, found in records.items()},
    )


def corners(rig: str) -> dict[str, tuple[float, float]]:
    """Sampling periods (s) and cutoffs (Hz) that the law was not tuned for, by name."""
    own = CUTOFF[rig]
    (other,) = set(CUTOFF.values()) - {own}
    pairs = [(SLOWER, own), (PERIOD, other), (SLOWER, other)]
    return {f"{1e3 * period:g} ms, {cutoff:g} Hz": (period, cutoff) for period, cutoff in pairs}


def filtered(case: jb.Case, cutoff: float) -> jb.Case:
    """The case with another cutoff (Hz) of the filters of all its sensors."""
    addresses = [f"sensors.{i}.filter.cutoff" for i in range(len(case.sensors))]
    return jb.replace(case, dict.fromkeys(addresses, cutoff))


def margin(rig: str, case: jb.Case) -> tuple[float, float]:
    """Largest real part (1/s) of frozen poles over all loads, late and off; and without control.

    On the modes that the law was tuned on: those above, from 70 Hz on, hardly pass the filters.
    """
    real, loads = prepared(rig, case)
    real = dataclasses.replace(real, beam=dataclasses.replace(real.beam, modes=MODES))
    law = real.controller
    sides = [dataclasses.replace(law, readings=law.readings + s * BESIDE) for s in (-1, 1)]
    laws = [
        dataclasses.replace(one, delay=np.asarray(DELAY + more))
        for one in sides
        for more in (0.0, MORE_DELAY)
    ]
    idle = [dataclasses.replace(law, values=0 * law.values)]
    held, free = (max(rightmost(real, one, run) for one in some for run in loads)
                  for some in (laws, idle))  # fmt: skip
    return held, free


def rightmost(real: jb.Case, law: jb.Relief, run: dict[str, float]) -> float:
    """The largest real part (1/s) along one crossing, on beams as the law believes and others."""
    case = apply(dataclasses.replace(real, controller=law), run)
    span = float(case.beam.length) / run["loads.0.speed"]
    times = run["loads.0.entry_time"] + span * np.linspace(-0.02, 0.98, PLACES)
    believed = {RIGIDITY: float(case.beam.flexural_rigidity)}
    found = []
    for factor in (1.0, *STIFFER.values()):
        off = jb.replace(case, {RIGIDITY: factor * believed[RIGIDITY]})
        off = believing(off, believed, lay_out(known_case(off)))
        found.append(frozen_poles(off, times).largest.max())
    return float(max(found))


EXPERIMENT = Experiment(
    "sensed",
    "beyond Table 8.1: sensors alone, as on the bench",
    "A table over what the sensors read, tuned for all masses and speeds, comes near what is"
    " possible.",
    run,
)
