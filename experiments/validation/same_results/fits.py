"""Fits to logs and responses, designs of experiments, tuning: each public function is a case."""

import dataclasses

import numpy as np

import jaxbeam as jb
import tuning
from experiments.validation.same_results.arrays import REPOSITORY, Arrays, of_json
from experiments.validation.same_results.parts import (
    BEAM,
    MASS,
    MIDSPAN,
    PATCH,
    PATCH_BEAM,
    RUN,
    SHAKER,
    argument,
    first_of,
    read,
)


def fit_to_logs() -> Arrays:
    """Three parameters of a model with four modes, fitted to the logs in jaxbeam/demo."""
    folder = REPOSITORY / "jaxbeam" / "demo"
    true = ((0.509, 0.541, 0.104), (0.371, 1.224, 0.097), (0.113, 2.46, 0.103))
    logs = []
    for i, (mass, speed, entry) in enumerate(true, 1):
        load = jb.MovingMass(mass=mass, speed=speed, entry_time=entry)
        log = tuning.read_log(folder / f"log_{i}.csv")
        logs.append(dataclasses.replace(log, loads=(load,)))
    free = {
        "beam.flexural_rigidity": (8.0, 16.0),
        "beam.damping_ratio": None,
        "actuators.0.stiffness": None,
    }
    rig = (folder / "rig.toml").read_text(encoding="utf-8").replace("modes = 12", "modes = 4")
    fit = tuning.identify(read(rig), logs, free)
    arrays = of_json(fit.to_dict())
    return arrays | {"fitted": np.asarray(fit.fitted), "residuals": np.asarray(fit.residuals)}


def fit_to_frequency_responses() -> Arrays:
    """Rigidity and damping from responses of the matrices of a slightly stiffer beam."""
    start = read(BEAM, SHAKER, MIDSPAN, RUN)
    true = jb.replace(start, {"beam.flexural_rigidity": 12.3, "beam.damping_ratio": 0.025})
    plant = jb.state_space(true).unloaded
    A, B, C, D = (np.asarray(getattr(plant, name)) for name in "ABCD")
    frequencies = np.geomspace(5.0, 300.0, 60)
    turns = 2j * np.pi * frequencies[:, None, None] * np.eye(A.shape[0])
    values = (C @ np.linalg.solve(turns - A, B[None]) + D)[:, :, 0]
    measured = tuning.Responses(frequencies, values, (("actuators.0", "sensors.0"),))
    fit = tuning.identify_responses(
        start, measured, ["beam.flexural_rigidity", "beam.damping_ratio"]
    )
    # The fit is exact: misfit and intervals are rounding errors, not compared.
    numbers = of_json(fit.to_dict()["numbers"])
    values = {name: array for name, array in numbers.items() if name.endswith("value")}
    fitted = np.asarray(fit.fitted)
    return values | {"fitted.real": fitted.real, "fitted.imag": fitted.imag}


def weighed_loads() -> Arrays:
    """Mass, speed and entry time of a load from a log of deflections with noise."""
    sensors = (
        "[[sensors]]\nposition = 0.2\nnoise = 5e-6\n[[sensors]]\nposition = 0.4\nnoise = 5e-6\n"
    )
    case = read(BEAM, sensors, MASS, RUN)
    record = jb.simulate(case)
    quantities = ("deflection",) * 2
    log = tuning.Log(
        np.asarray(record.times), np.asarray(record.measured), ("d0", "d1"), quantities, ("m", "m")
    )
    largest_number = {argument(tuning.weigh, "max_count", "max_loads", "most"): 1}
    return of_json(tuning.weigh(case, log, (0.6, 2.5), **largest_number).to_dict())


def designed_experiment() -> Arrays:
    """Sensor position and load speed with the least uncertainty of rigidity and damping."""
    design = first_of(tuning, "design_experiment", "sharpen")
    start = read(BEAM, MIDSPAN, MASS, "[run]\nduration = 0.7\nsample_rate = 100.0\n")
    over = {"sensors.0.position": (0.1, 0.5), "loads.0.speed": (1.0, 2.0)}
    free = ["beam.flexural_rigidity", "beam.damping_ratio"]
    return of_json(design(start, free, over).to_dict())


def tuned_gain() -> Arrays:
    """Some steps of a tuning by gradients, with bounds, a held-out run, and a bound on poles."""
    smooth = """
[[sensors]]
position = 0.3
filter = { cutoff = 20.0, order = 2, realisation = "analogue" }
[controller]
kind = "feedback"
gains = [2000.0]
period = 0.01
"""
    load = MASS.replace("1.2", "1.5").replace("0.05", "0.0")
    run = "[run]\nduration = 0.6\nsample_rate = 200.0\n"
    start = read(PATCH_BEAM.replace("modes = 3", "modes = 2"), PATCH, smooth, load, run)
    grid = first_of(tuning, "full_grid", "grid")
    training = grid({"loads.0.mass": [0.3, 0.5], "loads.0.speed": [1.5]})
    held_out = grid({"loads.0.mass": [0.4], "loads.0.speed": [1.2]})
    constraint = first_of(tuning, "StabilityConstraint", "Stable")
    options = {
        argument(constraint, "parameter_tolerance", "spread"): {"beam.flexural_rigidity": 0.1},
        argument(constraint, "instants", "places"): 3,
    }
    tuned = tuning.tune(
        start,
        {"controller.gains.0": (500.0, 40000.0)},
        tuning.LoadCases(training, held_out),
        tuning.Objective({"peak": 1.0, "effort": 0.1}),
        stable=constraint(0.0, **options),
        steps=4,
        progress=False,
    )
    return of_json(tuned.to_dict()) | {"history": np.asarray(tuned.history)}


def modes_of_a_decay() -> Arrays:
    """Modes identified from a synthetic decay: two damped cosines on noise and a slow drift."""
    random = np.random.default_rng(1)
    times = np.arange(1200) / 100.0
    since = np.maximum(times - 2.0, 0.0)
    values = np.zeros((times.size, 2))
    for frequency, damping, shape in ((5.0, 0.01, (1.0, 0.8)), (12.0, 0.008, (0.5, -0.6))):
        omega = 2 * np.pi * frequency
        root = omega * (-damping + 1j * np.sqrt(1 - damping**2))
        values += np.outer(np.exp(root * since).real, shape)
    values[times < 2.0] = 1.5 * random.normal(size=(int(np.sum(times < 2.0)), 2))
    values += 0.1 * np.sin(0.3 * times)[:, None] + 0.05 * random.normal(size=values.shape)
    log = tuning.Log(times, values, ("a0", "a1"), ("acceleration",) * 2, ("m/s^2",) * 2)
    fit = tuning.identify_modes(log, band=(1.0, 20.0))
    arrays = of_json(fit.to_dict()) | {"measured": fit.measured}
    return arrays if fit.fitted is None else arrays | {"fitted": fit.fitted}
