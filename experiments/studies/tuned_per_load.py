"""One controller for all loads beside one that is tuned for each: what not knowing the load costs.

    python -m experiments.studies.tuned_per_load

On rig B, for loads on which the laws of `experiments.studies.tuned_feedforward` (clocked by gates, no delay) and
`experiments.studies.sensor_feedback` (sensors only, as on the bench) were not tuned, each is tuned on for that load
alone, by the same gradients from the same tables. Shares of the attainable reduction, one table for
all loads and then its own: 97.7 to 99.7 % and 99.8 to 100 % by gates, 94.8 to 97.8 % and 99.8 to
100 % from sensors alone. So not knowing the load costs 2 % of what is possible, or 5 %.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies import tune_feedforward, tune_sensor_feedback
from experiments.studies.tune_feedforward import COMMAND_LIMITS, MODES
from experiments.studies.tune_sensor_feedback import with_noise_and_filters
from experiments.studies.tuned_feedforward import ENTRY_TIME
from jaxbeam import rigs

HELD_OUT_LOADS = tuning.full_grid(
    {
        "loads.0.mass": [0.322, 0.42],
        "loads.0.speed": [0.35, 0.95],
        "loads.0.entry_time": [ENTRY_TIME],
    }
)
RIG, STEPS = "B", 60


def tuning_problems() -> dict[str, tuple[jb.Case, dict]]:
    """By name a rig under the law for all loads, and what is free in its table."""
    case = rigs.load(RIG)
    slowest = float(case.beam.length) / 0.35 + ENTRY_TIME + 0.1
    beam = dataclasses.replace(case.beam, modes=MODES)
    case = dataclasses.replace(case, beam=beam, run=jb.Run(slowest, 200.0))
    gate_law = jb.load_case(tune_feedforward.FOLDER / f"{RIG}.toml").controller
    sensor_law = jb.load_case(tune_sensor_feedback.FOLDER / f"{RIG}.toml").controller
    active_breakpoints = np.flatnonzero(np.asarray(sensor_law.readings) < 0)
    return {
        "clocked by gates": (
            dataclasses.replace(case, controller=gate_law),
            {f"controller.values.0.{k}": COMMAND_LIMITS for k in range(gate_law.values.shape[1])},
        ),
        "sensors only": (
            dataclasses.replace(with_noise_and_filters(RIG, case, 1), controller=sensor_law),
            {f"controller.values.0.{k}": COMMAND_LIMITS for k in active_breakpoints},
        ),
    }


def general_and_own_shares(
    case: jb.Case, free: dict, load: dict[str, float]
) -> tuple[float, float]:
    """Shares of the attainable reduction: of the law for all loads, and of one for this load."""
    found = tuning.tune(
        case,
        free,
        tuning.LoadCases((load,)),
        tuning.Objective({"shortfall": 1.0}),
        steps=STEPS,
        progress=False,
    )
    outcome = found.run_sets[0]
    return float(outcome.attained_shares(outcome.peaks_before)[0]), float(
        outcome.attained_shares(outcome.peaks_after)[0]
    )


def main() -> None:
    """Print a line for each law and load."""
    for name, (case, free) in tuning_problems().items():
        for load in HELD_OUT_LOADS:
            one, own = general_and_own_shares(case, free, load)
            words = f"{load['loads.0.mass']:g} kg at {load['loads.0.speed']:g} m/s"
            print(f"{name}, {words}: {one:.1%} for all, {own:.1%} for this load", flush=True)


if __name__ == "__main__":
    main()
