"""Laws of rig B outside what they were tuned for: loads, plant, gates and filters.

The tuned table of commands and the hand-set trapezium on the same gates, the tuned law from
sensors alone and the one drawn by hand, all on the bench (20 ms of delay; noise and filters for
those that read the sensors). Each change stands alone, and shares are those of the reduction that
is attainable on the changed plant and load (linear program, full knowledge).
"""

import dataclasses
import warnings
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.studies.held_out import HELD_OUT_ENTRY_TIME, with_rigidity
from experiments.studies.sensor_feedback import (
    HAND_DRAWN,
    SENSORS_ONLY,
    bench_case,
    drawn_table,
    with_cutoff,
)
from experiments.studies.tuned_feedforward import (
    BENCH,
    FOLDER,
    HAND_SET,
    trapezium,
    with_bench_delay,
)
from experiments.thesis.cases import plan_with_steps, with_duration
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.plot.style import colour, set_title, use_style
from jaxbeam.simulation.simulate import ContactLossWarning

RIG, MASS, SPEED = "B", 0.42, 0.55  # kg, m/s: a held-out load
HEADWAY, DECELERATION = 0.4, 0.2  # s; m/s^2: the load leaves with less than half of its speed
GATE_ERROR, OTHER_CUTOFF = 0.1, 20.0  # fraction of the distance between the gates; Hz
CONFIRMATION = 2e-5  # m: five times the noise of a sensor
TOLERANCE = 1e-4
AS_TUNED = "as tuned for"
CONFIRMED = f"{BENCH}, confirmed by a sensor"
LOADS = {
    AS_TUNED: {},
    "0.1 kg": {"loads.0.mass": 0.1},
    "0.15 kg": {"loads.0.mass": 0.15},
    "0.7 kg": {"loads.0.mass": 0.7},
    "2 m/s": {"loads.0.speed": 2.0},
    "slows from 0.55 to 0.25 m/s": {"loads.0.deceleration": DECELERATION},
}
RIGIDITY_FACTORS = {
    "20 % softer": 0.8,
    "10 % softer": 0.9,
    "10 % stiffer": 1.1,
    "20 % stiffer": 1.2,
}
TWO_MASSES, GATES_NEAR, GATES_FAR = "two masses", "gates 10 % nearer", "gates 10 % farther"
OTHER_FILTER = "filter of the other rig"


def run(load_rig) -> ExperimentResult:
    """Shares of the attainable reduction under each change, and the lift by gates that misfire."""
    shares = {name: shares_of(by_law) for name, by_law in changed_cases(load_rig(RIG)).items()}
    remarks = [f"{MASS:g} kg at {SPEED:g} m/s; shares of what is attainable with each change"]
    for change, by_law in shares.items():
        text = ", ".join(f"{law} {share:.1%}" for law, share in by_law.items())
        remarks.append(f"{change}: {text}")
    remarks += false_alarm_remarks(load_rig(RIG))
    return ExperimentResult((), {"shares": _draw(shares)}, tuple(remarks))


def laws(case: jb.Case) -> dict[str, jb.Case]:
    """The rig on the bench under each law."""
    stored = jb.load_case(FOLDER / f"{RIG}.toml").controller
    sensed = dataclasses.replace(bench_case(RIG, case), run=case.run)
    return {
        HAND_SET: dataclasses.replace(case, controller=with_bench_delay(trapezium(RIG))),
        BENCH: dataclasses.replace(case, controller=with_bench_delay(stored)),
        CONFIRMED: dataclasses.replace(
            case,
            controller=dataclasses.replace(
                with_bench_delay(stored), confirmation=np.asarray(CONFIRMATION)
            ),
        ),
        HAND_DRAWN: dataclasses.replace(sensed, controller=drawn_table(RIG)),
        SENSORS_ONLY: sensed,
    }


def standard_case(case: jb.Case) -> jb.Case:
    """The rig with the held-out load, and a time for the slowest change."""
    case = with_duration(case, 2.0, 200.0)
    load = {"mass": MASS, "speed": SPEED, "entry_time": HELD_OUT_ENTRY_TIME}
    return jb.replace(case, {f"loads.0.{name}": value for name, value in load.items()})


def changed_cases(case: jb.Case) -> dict[str, dict[str, jb.Case]]:
    """The rig under each law, by change and law."""
    by_law = laws(standard_case(case))
    changed = {
        name: {law: jb.replace(one, change) for law, one in by_law.items()}
        for name, change in LOADS.items()
    }
    changed[TWO_MASSES] = {law: _with_second_mass(one) for law, one in by_law.items()}
    for name, factor in RIGIDITY_FACTORS.items():
        changed[name] = {law: with_rigidity(one, factor) for law, one in by_law.items()}
    by_gates = {law: by_law[law] for law in (HAND_SET, BENCH, CONFIRMED)}
    for name, error in ((GATES_NEAR, -GATE_ERROR), (GATES_FAR, GATE_ERROR)):
        changed[name] = {law: with_gate_error(one, error) for law, one in by_gates.items()}
    changed[OTHER_FILTER] = {
        law: with_cutoff(by_law[law], OTHER_CUTOFF) for law in (HAND_DRAWN, SENSORS_ONLY)
    }
    return changed


def _with_second_mass(case: jb.Case) -> jb.Case:
    (first,) = case.loads
    second = dataclasses.replace(first, entry_time=first.entry_time + HEADWAY)
    return dataclasses.replace(case, loads=(first, second))


def with_gate_error(case: jb.Case, error: float) -> jb.Case:
    """Case with a first gate that is misplaced by a fraction of the distance between both.

    The law takes the load for faster by that fraction, and its position for
    x_2 + (x - x_2) (1 + error), x_2 the second gate: as if its table was stretched about that gate.
    """
    law, length = case.controller, float(case.beam.length)
    gate = float(law.gates[1])
    shares = ((np.asarray(law.shares) * length - gate) / (1 + error) + gate) / length
    return dataclasses.replace(case, controller=dataclasses.replace(law, shares=shares))


def shares_of(by_law: Mapping[str, jb.Case]) -> dict[str, float]:
    """Shares of the attainable reduction of the peak, by law; the plant and the load are alike."""
    bound = None
    shares = {}
    for name, case in by_law.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ContactLossWarning)
            bound = bound or jb.bound(case)
            shares[name] = float(bound.share(jb.simulate(case, plan=plan_with_steps(case, 1))))
    return shares


def false_alarm_remarks(case: jb.Case) -> list[str]:
    """Lift of the beam by gates that fire without a load, with and without confirmation."""
    by_law = laws(jb.replace(standard_case(case), {"loads.0.mass": 0.0}))
    lift = {
        name: 1e3 * float(np.max(jb.simulate(by_law[name], tolerance=TOLERANCE).deflection))
        for name in (HAND_SET, BENCH, CONFIRMED)
    }
    return [
        "gates that fire without a load lift the beam by: "
        + ", ".join(f"{name} {height:.2f} mm" for name, height in lift.items())
    ]


@use_style
def _draw(shares: Mapping[str, Mapping[str, float]]) -> Figure:
    """Shares of the attainable reduction, a row for each change; worse than no control at zero."""
    figure = Figure(figsize=(7.2, 5.2))
    axes = figure.subplots()
    names = list(shares[AS_TUNED])
    for i, name in enumerate(names):
        rows = [row for row, by_law in enumerate(shares.values()) if name in by_law]
        values = [100 * max(by_law[name], 0) for by_law in shares.values() if name in by_law]
        axes.plot(values, rows, "o", color=colour(i), label=name)
    axes.set_yticks(range(len(shares)), list(shares))
    axes.invert_yaxis()
    axes.set(xlabel="share of the attainable reduction (%)", xlim=(-2, 102))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    set_title(figure, f"Rig {RIG}: laws outside what they were tuned for")
    return figure


EXPERIMENT = Experiment(
    "fragile",
    "beyond Table 8.1: the tuned laws outside what they were tuned for",
    "Tuned laws stand two masses, changing speeds and errors of ten percent; a load of 0.1 kg or of"
    " 2 m/s costs them a third of the attainable or more, and the filter of another rig all of it.",
    run,
)
