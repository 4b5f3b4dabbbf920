"""One controller for all loads beside one tuned for each load: the cost of an unknown load.

    python -m experiments.studies.tuned_per_load

On rig B, for each held-out load, the laws of `experiments.studies.tuned_feedforward` (timed by
gates, no delay) and `experiments.studies.sensor_feedback` (sensors only, as on the bench) are tuned
further for that load alone, from their tables by the same gradients. Shares of the achievable
reduction, by one table for all loads and by its own: 97.7 to 99.7 % and 99.8 to 100 % by gates,
94.8 to 97.8 % and 99.8 to 100 % from sensors alone. An unknown load costs 2 % of the achievable
reduction by gates, 5 % from sensors alone.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies import tune_feedforward, tune_sensor_feedback
from experiments.studies.held_out import (
    HELD_OUT_SPEEDS,
    held_out_loads,
    load_label,
    with_held_out_duration,
)
from experiments.studies.tune_feedforward import COMMAND_LIMITS, MODES
from experiments.studies.tune_sensor_feedback import with_noise_and_filters
from experiments.thesis.cases import with_modes
from jaxbeam import rigs

RIG, STEPS = "B", 60
SPEEDS = HELD_OUT_SPEEDS[RIG][::2]  # m/s: the slowest and the fastest
LOADS = [load for load in held_out_loads(RIG) if load["loads.0.speed"] in SPEEDS]


def tuning_problems() -> dict[str, tuple[jb.Case, dict]]:
    """The rig under each law that is tuned for all loads, and the free values of its table."""
    case = with_modes(with_held_out_duration(RIG, rigs.load(RIG)), MODES)
    gate_law = jb.load_case(tune_feedforward.FOLDER / f"{RIG}.toml").controller
    sensor_law = jb.load_case(tune_sensor_feedback.FOLDER / f"{RIG}.toml").controller
    active_breakpoints = np.flatnonzero(np.asarray(sensor_law.readings) < 0)
    return {
        "timed by gates": (
            dataclasses.replace(case, controller=gate_law),
            {f"controller.values.0.{k}": COMMAND_LIMITS for k in range(gate_law.values.shape[1])},
        ),
        "sensors only": (
            dataclasses.replace(with_noise_and_filters(RIG, case, 1), controller=sensor_law),
            {f"controller.values.0.{k}": COMMAND_LIMITS for k in active_breakpoints},
        ),
    }


def shares_for_load(case: jb.Case, free: dict, load: dict[str, float]) -> tuple[float, float]:
    """Shares of the achievable reduction by the law for all loads, and by one for this load."""
    result = tuning.tune(
        case,
        free,
        tuning.LoadCases((load,)),
        tuning.Objective({"shortfall": 1.0}),
        steps=STEPS,
        progress=False,
    )
    training = result.run_sets[0]
    before, after = (
        training.attained_shares(peaks)[0]
        for peaks in (training.peaks_before, training.peaks_after)
    )
    return float(before), float(after)


def main() -> None:
    """Print a line for each law and load."""
    for name, (case, free) in tuning_problems().items():
        for load in LOADS:
            general, own = shares_for_load(case, free, load)
            label = load_label(load, " at")
            print(f"{name}, {label}: {general:.1%} for all, {own:.1%} for this load", flush=True)


if __name__ == "__main__":
    main()
