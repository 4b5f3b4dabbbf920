"""How the laws of `experiments.studies.sensor_feedback` are found, which know nothing but what their sensors read.

    python -m experiments.studies.tune_sensor_feedback B      # or C; writes experiments/studies/controllers/sensor_feedback/B.toml

On each patch rig one table of commands over the deflection under the load (kind "relief") serves
all masses and speeds. All of the bench is in the loop that is differentiated: noise, a filter of
tenth order, sampling, delay, rounding and limits. The knots follow the gradient of the worst
shortfall behind the bound.

On two spans, where the filters let more of the beam's ringing through, every load also crosses
beams that are 10 % stiffer and softer than the law believes, and poles along the crossings are
kept to the left, 10 ms more delay included; the notches are free, too. A search that was stopped
goes on.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.tune_feedforward import (
    COMMAND_LIMITS,
    COMMAND_RESOLUTION,
    MASSES,
    MODES,
    PERIOD,
)
from jaxbeam import rigs

FOLDER = Path(__file__).parent / "controllers" / "sensor_feedback"
DELAY = 0.02  # s
NOISE_DEVIATION = 4e-6  # m: about the largest of section 5.1 of the thesis, (0.135e-10 m^2)^0.5
CUTOFF, ORDER = {"B": 10.0, "C": 20.0}, 10  # Hz: the filters of sections 6.1 and 6.2
# The filter of 20 Hz passes the lowest modes, between 15.5 and 18.5 Hz with a light load on the way
# in and a beam that is 10 % off, and near 27 Hz: there the search for notches starts.
NOTCHES = {"B": None, "C": [16.2, 18.4, 27.0]}  # Hz
READING_BREAKPOINTS = {  # m: flat where a load has gone far enough to lower the frequencies
    "B": 1e-3 * np.array([-1.2, -0.8, -0.55, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4]),
    "C": 1e-3 * np.array([-0.4, -0.3, -0.2, -0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.3]),
}
SPEEDS = np.linspace(0.3, 1.0, 8)  # m/s
ENTRY = 0.05  # s
INITIAL_TABLE = {"B": (0.45e-3, 7.2, 0.0), "C": (0.25e-3, 7.2, -1.8)}  # m, V below, V above
RIGIDITY = "beam.flexural_rigidity"
RIGIDITY_TOLERANCE = 0.1  # share by which the beam may be stiffer or softer than believed
RIGIDITY_FACTORS = (1.0, 1.0 - RIGIDITY_TOLERANCE, 1.0 + RIGIDITY_TOLERANCE)
NOTCH_BOUNDS = (10.0, 35.0)  # Hz: where notches may go
# For poles along crossings: the largest real part (1/s), delay on top (s), speed of the loads
# (m/s), places along each, and how far beside the bend at rest (m) a table is looked at.
MAX_REAL_PART, EXTRA_DELAY, CROSSING_SPEED, CROSSING_POSITIONS, READING_OFFSET = (
    -0.3,
    0.01,
    0.6,
    10,
    1e-5,
)
STEPS, SAMPLE_RATE = 120, {"B": 200.0, "C": 100.0}  # Hz


def with_noise_and_filters(rig: str, case: jb.Case, seed: int = 0) -> jb.Case:
    """The rig as on the bench: noise and filters at all sensors."""
    sensor_filter = jb.Filter(CUTOFF[rig], order=ORDER)
    filtered_sensors = [
        dataclasses.replace(s, filter=sensor_filter, noise=np.asarray(NOISE_DEVIATION))
        for s in case.sensors
    ]
    run = dataclasses.replace(case.run, seed=seed)
    return dataclasses.replace(case, sensors=tuple(filtered_sensors), run=run)


def initial_law(rig: str) -> jb.Relief:
    """The law that the search starts from on rig B or C: steep, then flat."""
    saturation_reading, below, above = INITIAL_TABLE[rig]
    readings = READING_BREAKPOINTS[rig]
    row = np.interp(readings, [-saturation_reading, 0.0, saturation_reading], [below, 0.0, above])
    actuators = len(rigs.load(rig).actuators)
    return jb.Relief(
        readings=readings,
        values=[row] * actuators,
        notches=NOTCHES[rig],
        period=PERIOD,
        delay=DELAY,
        resolution=COMMAND_RESOLUTION,
    )


def training_loads(rig: str = "B") -> tuple[dict[str, float], ...]:
    """The lightest and the heaviest load at all speeds, entering at ticks and between them.

    On rig C also on beams that are stiffer or softer.
    """
    rigidity = float(rigs.load(rig).beam.flexural_rigidity)
    plants = [{RIGIDITY: factor * rigidity} for factor in RIGIDITY_FACTORS] if rig == "C" else [{}]
    return tuple(
        {
            "loads.0.mass": mass,
            "loads.0.speed": float(speed),
            "loads.0.entry_time": ENTRY + PERIOD * ((2 * i + j) % 4) / 4,
        }
        | plant
        for i, speed in enumerate(SPEEDS)
        for j, mass in enumerate(MASSES)
        for plant in plants
    )


def stability_constraint(law: jb.Relief) -> tuning.StabilityConstraint:
    """Where poles may lie along crossings, for a table that bends where no load is: on both sides.

    The loads are slow: fast ones of half the beam's mass move poles to the right by themselves.
    """
    breakpoints = np.asarray(law.readings)
    shifted_tables = [
        {f"controller.readings.{k}": x + side for k, x in enumerate(breakpoints)}
        for side in (-READING_OFFSET, READING_OFFSET)
    ]
    loads = tuning.full_grid(
        {"loads.0.mass": (*MASSES, sum(MASSES) / 2), "loads.0.speed": [CROSSING_SPEED]}
    )
    return tuning.StabilityConstraint(
        max_real_part=MAX_REAL_PART,
        extra_delay=EXTRA_DELAY,
        parameter_tolerance={RIGIDITY: RIGIDITY_TOLERANCE},
        instants=CROSSING_POSITIONS,
        crossings=tuple(load | side for load in loads for side in shifted_tables),
    )


def tune_law(
    rig: str, file: Path | None = None, steps: int = STEPS, progress: bool = True
) -> tuning.TuningResult:
    """Tune the table for the worst of all loads on rig B or C; a file keeps the search."""
    case = with_noise_and_filters(rig, rigs.load(rig))
    slowest = float(case.beam.length) / min(SPEEDS)
    law, with_stability = initial_law(rig), rig == "C"
    case = dataclasses.replace(
        case,
        beam=dataclasses.replace(case.beam, modes=MODES),
        controller=law,
        run=jb.Run(duration=slowest + 0.15, sample_rate=SAMPLE_RATE[rig]),
    )
    actuators = len(case.actuators)
    # Without a load there is no command; upwards the beam of one span goes only when it rings.
    active_breakpoints = [
        k for k, x in enumerate(READING_BREAKPOINTS[rig]) if x < 0 or (x > 0 and actuators > 1)
    ]
    free = {
        f"controller.values.{a}.{k}": COMMAND_LIMITS
        for a in range(actuators)
        for k in active_breakpoints
    }
    notches = {f"controller.notches.{k}": NOTCH_BOUNDS for k in range(len(NOTCHES[rig] or ()))}
    return tuning.tune(
        case,
        free | notches,
        tuning.LoadCases(training_loads(rig)),
        tuning.Objective({"shortfall": 1.0}),
        stable=stability_constraint(law) if with_stability else None,
        steps=steps,
        checkpoint=file,
        resume=True,
        progress=progress,
    )


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:]:
        kept = FOLDER / f"{name}.search.npz"
        found = tune_law(name, kept)
        print(found)
        jb.save_case(found.case, FOLDER / f"{name}.toml", overwrite=True)
        kept.unlink()
