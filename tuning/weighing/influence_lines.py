"""Influence lines of the sensors of a bridge: of its model, or calibrated by known vehicles."""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.load_set import load_set
from tuning.logs.log import Log
from tuning.logs.pairing import sensor_readings
from tuning.weighing.dynamic_forces import UnitForce

MODEL_POINTS = 201
SMOOTHNESS = np.logspace(-8, 4, 49)  # tried weights of second differences


class InfluenceLines(NamedTuple):
    """Readings of sensors (SI unit per newton downwards) with a force at positions (m).

    >>> import numpy as np
    >>> import tuning
    >>> lines = tuning.InfluenceLines(
    ...     np.array([0.0, 5.0, 10.0]), np.array([[0.0], [-2e-8], [0.0]])
    ... )
    >>> print(lines.at(np.array([2.5])))
    [[-1.e-08]]
    """

    positions: Float[np.ndarray, " point"]
    values: Float[np.ndarray, "point sensor"]

    def at(self, x: Float[np.ndarray, "*force"]) -> Float[np.ndarray, "*force sensor"]:
        """Readings per newton with the force at x (m), zero off the beam."""
        lines = (np.interp(x, self.positions, line, 0.0, 0.0) for line in self.values.T)
        return np.stack(list(lines), axis=-1)


def model_influence_lines(case: Case) -> InfluenceLines:
    """Influence lines of a case at 201 points, linear in between.

    Those of moments and the like are corrected statically; those of deflections are sums of the
    modes of the case.

    Raises ValueError for a sensor of velocity or acceleration, and a beam that can move as a rigid
    body.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(jb.Beam(20.0, 8e9, 12e3), sensors=[jb.Sensor(10.0)])
    >>> lines = tuning.model_influence_lines(case)
    >>> print(f"{lines.at(np.array([10.0]))[0, 0]:.2e} m/N, {-(20**3) / 48 / 8e9:.2e} m/N")
    -2.08e-08 m/N, -2.08e-08 m/N
    """
    check_static(case)
    unit_force = UnitForce(case, 1.0)
    shares = np.linspace(0.0, 1.0, MODEL_POINTS)
    return InfluenceLines(
        shares * unit_force.length, unit_force.readings(unit_force.length, shares)
    )


def calibrate_influence_lines(case: Case, log: Log, points: int = 41) -> InfluenceLines:
    """Influence lines from the log of a vehicle of known wheel loads, speed and entry time.

    Ordinates at equally spaced points, linear in between and zero at both ends, are fitted by least
    squares with a weight on their second differences, found by generalised cross-validation (Golub,
    Heath and Wahba 1979), and an offset of the sensor. The vibration of the crossing stays in them:
    a slow run is better. Loads are those of the log, or else of the case.

    Raises ValueError if no load is known, for a sensor of velocity or acceleration, and for less
    than five points.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> beam, truck = jb.Beam(20.0, 8e9, 12e3, 0.02), jb.MovingForce(force=3e5, speed=2.0)
    >>> case = jb.Case(beam, sensors=[jb.Sensor(10.0)], loads=[truck], run=jb.Run(10.0, 20.0))
    >>> record = jb.simulate(case)
    >>> columns = ("w1",), ("deflection",), ("m",)
    >>> log = tuning.Log(record.times, record.deflection, *columns, sensors=(0,))
    >>> lines = tuning.calibrate_influence_lines(case, log)
    >>> print(f"{lines.at(np.array([10.0]))[0, 0]:.2g} m/N")
    -2.1e-08 m/N
    """
    check_static(case)
    if points < 5:
        raise ValueError(f"influence lines need at least 5 points, not {points}")
    loads = case.loads if log.loads is None else tuple(log.loads)
    if not loads:
        raise ValueError(
            f"{log.source}: no load is known; calibration needs a vehicle of known wheel loads, in"
            " the case or in the TOML file beside the log"
        )
    wheels = load_set(dataclasses.replace(case, loads=loads))
    readings, valid = sensor_readings(case, log)
    length = float(concrete(case.beam.length))
    positions = np.linspace(0.0, length, points)
    x = np.asarray(wheels.kinematics(log.times)[0]).T
    weights = np.asarray(wheels.weight)[:, 0]
    hats = np.eye(points)[:, 1:-1]
    matrix = sum(w * _interpolated(positions, hats, x[:, i]) for i, w in enumerate(weights))
    values = np.zeros((points, len(case.sensors)))
    for i in range(len(case.sensors)):
        rows = valid[:, i]
        values[1:-1, i] = _smooth_ordinates(matrix[rows], readings[rows, i])
    return InfluenceLines(positions, values)


def check_static(case: Case) -> None:
    """Raises ValueError, naming the sensor, for one whose influence line is zero, or for none."""
    if not case.sensors:
        raise ValueError("weighing needs a sensor on the beam; the case has none")
    for i, sensor in enumerate(case.sensors):
        if sensor.quantity in ("velocity", "acceleration"):
            raise ValueError(
                f"sensors.{i} measures {sensor.quantity}, which has no influence line; weigh axles"
                " by deflection, strain and the like"
            )


def _interpolated(positions, hats, x):
    return np.stack([np.interp(x, positions, hat, 0.0, 0.0) for hat in hats.T], axis=1)


def _smooth_ordinates(matrix, reading) -> Float[np.ndarray, " inner"]:
    """Ordinates that fit a reading, by penalised least squares with the weight of least GCV."""
    centred, target = matrix - matrix.mean(axis=0), reading - reading.mean()
    count = matrix.shape[1]
    second = np.diff(np.eye(count + 2), 2, axis=0)[:, 1:-1]
    penalty = second.T @ second
    normal, right = centred.T @ centred, centred.T @ target
    penalty = penalty * np.trace(normal) / np.trace(penalty)
    values, vectors = scipy.linalg.eigh(normal, penalty)
    values, projected = np.maximum(values, 0.0), vectors.T @ right

    def criterion(weight):
        shrunk = values / (values + weight)
        ordinates = vectors @ (projected / (values + weight))
        misfit = np.sum((target - centred @ ordinates) ** 2)
        return misfit / (len(target) - 1 - shrunk.sum()) ** 2

    best = min(SMOOTHNESS, key=criterion)
    return vectors @ (projected / (values + best))
