"""A vehicle on a controlled beam against the equations of both, integrated by scipy."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from tests.oracles.modal_equations import Span

BODY, AXLE, SUSPENSION, DAMPER, TYRE, WALL = 0.2, 0.05, 60.0, 0.4, 900.0, 0.5
LENGTH, SPEED, PLACE, SENSOR, GAIN, G, END = 0.6, 1.5, 0.22, 0.3, 900.0, 9.81, 0.5
SPAN = Span(LENGTH, 11.68, 0.535, 2, 0.03)


def change(t: float, z: np.ndarray, command: float | None) -> np.ndarray:
    """Rates of modes, body and axle (coordinates, then rates) under a command, or its law (None).

    Heights are upwards, from where springs are not strained on a level road.
    """
    (q, (body, axle)), (p, (body_rate, axle_rate)) = np.split(z[:4], 2), np.split(z[4:], 2)
    x = SPEED * t
    on_beam = x <= LENGTH
    shape, slope = SPAN.shapes(x) * on_beam, SPAN.shapes(x, 1) * on_beam
    force = TYRE * (shape @ q - axle) + WALL * (shape @ p + SPEED * slope @ q - axle_rate)
    spring = SUSPENSION * (axle - body) + DAMPER * (axle_rate - body_rate)
    own = -GAIN * SPAN.shapes(SENSOR) @ q if command is None else command
    pushed = -(SPAN.frequencies**2) * q - SPAN.damping @ p - shape * force
    pushed = pushed + SPAN.shapes(PLACE) * own
    return np.concatenate([z[4:], pushed, [spring / BODY - G, (force - spring) / AXLE - G]])


def deflections(times: np.ndarray, period: float | None) -> np.ndarray:
    """Deflections at the sensor (m) at some times (s) before the end, of a sampled law or none."""
    axle = -(BODY + AXLE) * G / TYRE
    z, command, found = np.zeros(8), None, []
    z[2:4] = axle - BODY * G / SUSPENSION, axle  # at rest on the road
    samples = np.array([0.0]) if period is None else np.arange(0.0, END, period)
    edges = np.append(np.unique(np.append(samples, LENGTH / SPEED)), END)
    for start, end in itertools.pairwise(edges):
        if period is not None and start in samples:
            command = -GAIN * SPAN.shapes(SENSOR) @ z[:2]
        inside = times[(times >= start - 1e-12) & (times < end - 1e-12)]
        at = np.append(np.maximum(inside, start), end)
        run = solve_ivp(
            change, (start, end), z, "DOP853", at, args=(command,), rtol=1e-11, atol=1e-13
        )
        z, found = run.y[:, -1], [*found, run.y[:2, :-1]]
    return SPAN.shapes(SENSOR) @ np.concatenate(found, axis=1)


@pytest.mark.parametrize("period", [None, 0.01], ids=["continuous law", "sampled law"])
def test_a_vehicle_on_a_beam_under_feedback(period):
    car = jb.QuarterCar(BODY, AXLE, SUSPENSION, DAMPER, TYRE, WALL, speed=SPEED)
    case = jb.Case(
        jb.Beam(LENGTH, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(PLACE)],
        sensors=[jb.Sensor(SENSOR)],
        loads=[car],
        controller=jb.Feedback([GAIN], period=period),
        run=jb.Run(END, 400.0),
    )
    record = jb.simulate(case, tolerance=1e-9)
    expected = deflections(np.asarray(record.times)[:-1], period)
    found = np.asarray(record.deflection)[:-1, 0]
    assert_allclose(found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
