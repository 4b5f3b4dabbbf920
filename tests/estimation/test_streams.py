"""Kalman filters under several overlapping loads, against Gaussian conditioning."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.estimation.kalman import Kalman
from tests.estimation.test_kalman import (
    CASE,
    FORCES,
    NOISE,
    OFFSET,
    PERIOD,
    filter_readings,
    signals,
)
from tests.loop_as_oracle import parts_of
from tests.oracles.sampled_plant import SampledPlant, conditioned

SAMPLES, MASSES, DEVIATION = 8, np.array([0.4, 0.3, 0.2]), np.array([2.0, 1.0, 0.5])
# Two on the beam from the start, and one that enters at the fifth sample.
LOADS = [
    jb.MovingMass(mass=MASSES[0], speed=0.5, entry_time=-0.8),
    jb.MovingForce(mass=MASSES[1], speed=0.8, entry_time=-0.4),
    jb.MovingMass(mass=MASSES[2], speed=0.5, entry_time=4 * PERIOD),
]
STREAM = dataclasses.replace(CASE, loads=tuple(LOADS))


class StreamPlant(SampledPlant):
    """Plant under several loads: a column for each weight, by the mass matrix."""

    def matrices(self, t):
        A, B, C, D = super().matrices(t)
        span, n = self.plant.span, self.plant.span.modes
        on = [x.entry_time <= t < x.time_at(span.length) for x in self.loads]
        shapes = [span.shapes(x.motion(t, span.length, False)[0]) for x in self.loads]
        massive = [
            x.kind == "mass" and is_on_beam for x, is_on_beam in zip(self.loads, on, strict=True)
        ]
        masses = [x.mass * has_mass for x, has_mass in zip(self.loads, massive, strict=True)]
        mass = np.eye(n) + sum(m * np.outer(s, s) for m, s in zip(masses, shapes, strict=True))
        for i, (shape, is_on_beam) in enumerate(zip(shapes, on, strict=True), self.inner):
            A[:, i], C[:, i] = 0.0, 0.0
            A[n : 2 * n, i] = -np.linalg.solve(mass, shape) * is_on_beam
            C[2, i] = self.plant.rows[2] @ A[n : 2 * n, i]  # the accelerometer
        return A, B, C, D


@pytest.mark.parametrize("loads", ["known", "estimated"])
def test_estimates_by_gaussian_conditioning(loads):
    """The weight of a load before its entry keeps its prior."""
    deviation = DEVIATION if loads == "estimated" else None
    commands, readings = signals(SAMPLES)
    kalman = Kalman(FORCES, loads=loads, weight_deviation=deviation)
    filter_state, (estimate, _) = filter_readings(kalman, STREAM, commands, readings)
    span, oracle_loads, actuators, sensors = parts_of(STREAM)
    plant = StreamPlant(span, oracle_loads, actuators, sensors)
    intensity = np.diag([0.0, 0.0, *FORCES, *[0.0] * 4])
    times = PERIOD * np.arange(SAMPLES)
    steps = [plant.step(t, PERIOD, 0.0, intensity) for t in times]
    rows = [plant.matrices(t)[2:] for t in times]
    mean, covariance = np.zeros(8), np.zeros((8, 8))
    mean[5:] = MASSES * 9.81
    if loads == "estimated":
        covariance[5:, 5:] = np.diag(DEVIATION**2)
    state, covariance = conditioned(
        (mean, covariance), steps, rows, np.diag(NOISE**2), commands, readings - OFFSET
    )
    scale = np.sqrt(np.diag(covariance)) + 1e-6 * np.abs(state)
    assert_allclose(filter_state.x / scale, state / scale, rtol=0, atol=1e-3)
    if loads == "estimated":
        outer = scale * scale[:, None]
        assert_allclose(filter_state.covariance / outer, covariance / outer, rtol=0, atol=1e-3)
        assert_allclose(estimate.weights[-1], state[5:], rtol=1e-3)
        assert estimate.weights[3, 2] == 0  # off the beam
        assert_allclose(filter_state.x[5:8], state[5:], rtol=1e-3)
