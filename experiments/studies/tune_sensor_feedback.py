"""Tune the tables of `experiments.studies.sensor_feedback` by gradients.

    python -m experiments.studies.tune_sensor_feedback B    # or C

writes controllers/sensor_feedback/B.toml. On each patch rig one table of commands over the
deflection under the load (internal-model control) serves all masses and speeds. The closed loop of
the bench is differentiated as a whole: noise, a filter of tenth order, sampling, delay, rounding
and limits. The table follows the gradient of the worst shortfall from the least achievable peak.

On two spans the filters pass more of the beam's vibration. There every load also crosses beams that
are 10 % stiffer and softer than the design model, the largest real part of poles along the
crossings is bounded, 10 ms more delay included, and the notches are free too. An interrupted search
is resumed.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.held_out import EXTRA_DELAY, MASSES, PERIOD, RIGIDITY, training_loads
from experiments.studies.tune_feedforward import COMMAND_LIMITS, COMMAND_RESOLUTION, MODES
from experiments.thesis.cases import with_modes
from jaxbeam import rigs

FOLDER = Path(__file__).parent / "controllers" / "sensor_feedback"
DELAY = 0.02  # s
NOISE_DEVIATION = 4e-6  # m: about the largest of section 5.1 of the thesis, (0.135e-10 m^2)^0.5
CUTOFF, ORDER = {"B": 10.0, "C": 20.0}, 10  # Hz: the filters of sections 6.1 and 6.2
# The filter of 20 Hz passes the lowest modes, between 15.5 and 18.5 Hz with a light load near the
# entry and a beam that is 10 % off, and near 27 Hz: there the notches start.
NOTCHES = {"B": None, "C": [16.2, 18.4, 27.0]}  # Hz
NOTCH_BOUNDS = (10.0, 35.0)  # Hz
READING_BREAKPOINTS = {  # m: the table is flat where a heavy load has lowered the frequencies
    "B": 1e-3 * np.array([-1.2, -0.8, -0.55, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4]),
    "C": 1e-3 * np.array([-0.4, -0.3, -0.2, -0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.3]),
}
SPEEDS = np.linspace(0.3, 1.0, 8)  # m/s
INITIAL_TABLE = {"B": (0.45e-3, 7.2, 0.0), "C": (0.25e-3, 7.2, -1.8)}  # m, V below, V above
RIGIDITY_TOLERANCE = 0.1  # relative: the plant may be so much stiffer or softer than the design
RIGIDITY_FACTORS = (1.0, 1.0 - RIGIDITY_TOLERANCE, 1.0 + RIGIDITY_TOLERANCE)
# Poles along crossings: largest real part (1/s), speed of the loads (m/s), number of positions, and
# distance (m) from the table's breakpoint at rest, on either side of which the slope differs.
MAX_REAL_PART, CROSSING_SPEED, CROSSING_POSITIONS, READING_OFFSET = -0.3, 0.6, 10, 1e-5
STEPS, SAMPLE_RATE = 120, {"B": 200.0, "C": 100.0}  # -, Hz


def with_noise_and_filters(rig: str, case: jb.Case, seed: int = 0) -> jb.Case:
    """The case with the noise and the filters of the bench at all sensors."""
    sensor_filter = jb.Filter(CUTOFF[rig], order=ORDER)
    sensors = [
        dataclasses.replace(sensor, filter=sensor_filter, noise=np.asarray(NOISE_DEVIATION))
        for sensor in case.sensors
    ]
    run = dataclasses.replace(case.run, seed=seed)
    return dataclasses.replace(case, sensors=tuple(sensors), run=run)


def initial_law(rig: str) -> jb.InternalModel:
    """The law that tuning starts from on rig B or C: a table that is steep, then flat."""
    saturation_reading, below, above = INITIAL_TABLE[rig]
    readings = READING_BREAKPOINTS[rig]
    row = np.interp(readings, [-saturation_reading, 0.0, saturation_reading], [below, 0.0, above])
    actuators = len(rigs.load(rig).actuators)
    return jb.InternalModel(
        readings=readings,
        values=[row] * actuators,
        notches=NOTCHES[rig],
        period=PERIOD,
        delay=DELAY,
        resolution=COMMAND_RESOLUTION,
    )


def plant_changes(rig: str) -> list[dict[str, float]]:
    """Changes of the plant in training: other rigidities on rig C, none on rig B."""
    if rig == "B":
        return [{}]
    rigidity = float(rigs.load(rig).beam.flexural_rigidity)
    return [{RIGIDITY: factor * rigidity} for factor in RIGIDITY_FACTORS]


def shifted_tables(readings: np.ndarray) -> list[dict[str, float]]:
    """Changes that shift a table by READING_OFFSET to either side, so that rest is on one slope."""
    return [
        {f"controller.readings.{k}": x + offset for k, x in enumerate(readings)}
        for offset in (-READING_OFFSET, READING_OFFSET)
    ]


def stability_constraint(law: jb.InternalModel) -> tuning.StabilityConstraint:
    """Bound on the real parts of poles along crossings, with either slope of the table at rest.

    The loads are slow: fast ones of half the beam's mass move poles to the right without control.
    """
    masses = (*MASSES, sum(MASSES) / 2)
    loads = tuning.full_grid({"loads.0.mass": masses, "loads.0.speed": [CROSSING_SPEED]})
    tables = shifted_tables(np.asarray(law.readings))
    return tuning.StabilityConstraint(
        max_real_part=MAX_REAL_PART,
        extra_delay=EXTRA_DELAY,
        parameter_tolerance={RIGIDITY: RIGIDITY_TOLERANCE},
        instants=CROSSING_POSITIONS,
        crossings=tuple(load | table for load in loads for table in tables),
    )


def free_parameters(rig: str, actuators: int) -> dict[str, tuple[float, float]]:
    """Free values of the table and notches, with their bounds.

    Without a load the command is zero. On one span commands for upward deflections are zero too:
    there the beam is deflected upwards only when it vibrates.
    """
    breakpoints = [
        k for k, x in enumerate(READING_BREAKPOINTS[rig]) if x < 0 or (x > 0 and actuators > 1)
    ]
    values = {
        f"controller.values.{a}.{k}": COMMAND_LIMITS for a in range(actuators) for k in breakpoints
    }
    notches = {f"controller.notches.{k}": NOTCH_BOUNDS for k in range(len(NOTCHES[rig] or ()))}
    return values | notches


def tune_law(
    rig: str, checkpoint: Path | None = None, steps: int = STEPS, progress: bool = True
) -> tuning.TuningResult:
    """Tune the table for the worst of all training loads on rig B or C.

    With a `checkpoint` file an interrupted search is resumed.
    """
    case = with_modes(with_noise_and_filters(rig, rigs.load(rig)), MODES)
    slowest = float(case.beam.length) / min(SPEEDS)
    law = initial_law(rig)
    case = dataclasses.replace(
        case,
        controller=law,
        run=jb.Run(duration=slowest + 0.15, sample_rate=SAMPLE_RATE[rig]),
    )
    return tuning.tune(
        case,
        free_parameters(rig, len(case.actuators)),
        tuning.LoadCases(training_loads(SPEEDS, plant_changes(rig))),
        tuning.Objective({"shortfall": 1.0}),
        stable=stability_constraint(law) if rig == "C" else None,
        steps=steps,
        checkpoint=checkpoint,
        resume=True,
        progress=progress,
    )


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:]:
        file = FOLDER / f"{name}.search.npz"
        result = tune_law(name, file)
        print(result)
        jb.save_case(result.case, FOLDER / f"{name}.toml", overwrite=True)
        file.unlink()
