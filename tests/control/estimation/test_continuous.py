"""Estimators in continuous time, in closed loops: explicit equations by scipy's DOP853.

The beam has a mode more than the design, which has another mass and entry time of the load.
"""

import dataclasses

import control
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.estimation.inversion import Inversion
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.estimation.observer import Observer
from jaxbeam.control.state_controller import DesignModel
from tests.loop_as_oracle import parts_of
from tests.oracles.sampled_plant import SampledPlant

WEIGHTS, COMMAND_WEIGHT = [3e4, 3e4, 1.0, 1.0, 0.0], 0.01
FORCE, INTENSITY, DEVIATION = 0.02, 1e-13, 2.0
MASS, SPEED, ENTRY, END = 0.4, 3.0, 0.02, 0.27
DESIGN = {"mass": 0.3, "entry_time": 0.03}
TIMES = np.linspace(0.0, END, 55)
ESTIMATORS = {
    "time-invariant": Kalman(FORCE, measurement_intensity=INTENSITY),
    "known": Kalman(FORCE, measurement_intensity=INTENSITY, loads="known", points=80),
    "estimated": Kalman(
        FORCE,
        measurement_intensity=INTENSITY,
        loads="estimated",
        weight_deviation=DEVIATION,
        points=80,
    ),
}


def loop(estimator, modes=3):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=modes),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(0.17, offset=1e-5), jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=MASS, speed=SPEED, entry_time=ENTRY)],
        controller=jb.LQR(
            WEIGHTS, [COMMAND_WEIGHT], design=DesignModel(modes=2, **DESIGN), estimator=estimator
        ),
        run=jb.Run(END),
    )


def steady_gain(A, C):
    """Gain of the time-invariant filter by scipy, in scaled states and readings.

    In those units scipy is accurate to 1e-14, in SI units to 1e-6.
    """
    scale = np.concatenate([1 / np.sqrt(-np.diag(A[2:, :2])), np.ones(3)])
    scaled, rows = A * scale / scale[:, None], C * scale / np.sqrt(INTENSITY)
    noise = np.diag([0.0, 0.0, FORCE, FORCE, 0.0])
    P = scipy.linalg.solve_continuous_are(scaled.T, rows.T, noise, np.eye(2))
    return scale[:, None] * P @ rows.T / np.sqrt(INTENSITY)


class ExplicitLoop:
    """x' = A x + B u, X' = F X + G u + L (C x - H X), u = -K X, L = P H' / R and P' by Riccati."""

    def __init__(self, name):
        self.name, case = name, loop(ESTIMATORS[name])
        span, loads, *parts = parts_of(case)
        self.truth, self.span = SampledPlant(span, loads, *parts), span
        design_span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, 2, 0.01)
        unloaded, moving = SampledPlant(design_span, [], *parts), name in ("known", "estimated")
        design_load = dataclasses.replace(loads[0], mass=DESIGN["mass"], entry_time=ENTRY + 0.01)
        self.model = SampledPlant(design_span, [design_load], *parts) if moving else unloaded
        A, B, C, _ = unloaded.matrices(0.0)
        self.gain = control.lqr(A, B, np.diag(WEIGHTS), COMMAND_WEIGHT * np.eye(1))[0]
        size, self.moving = self.model.size, moving
        self.intensity = np.diag([0.0, 0.0, FORCE, FORCE, *[0.0] * (size - 4)])
        variance = DEVIATION**2 if name == "estimated" else 0.0
        self.initial_covariance = np.diag([0.0] * 5 + [variance] * moving)
        self.initial_estimate = np.array([0.0] * 5 + [9.81 * DESIGN["mass"]] * moving)
        self.filter_gain = np.zeros((size, 2))
        if name == "time-invariant":
            self.filter_gain = steady_gain(A, C)

    def rate(self, t, y):
        n, m = self.truth.size, self.model.size
        (A, B, C, _), (F, G, H, _) = self.truth.matrices(t), self.model.matrices(t)
        x, X, L, change = y[:n], y[n : n + m], self.filter_gain, np.zeros(0)
        if self.moving:
            P = y[n + m :].reshape(m, m)
            L = P @ H.T / INTENSITY
            change = (F @ P + P @ F.T - L @ H @ P + self.intensity).ravel()
        u = -self.gain @ X[:5]
        return np.concatenate([A @ x + B @ u, F @ X + G @ u + L @ (C @ x - H @ X), change])

    def solve(self):
        """Deflections (time, sensor) and commands (time, actuator) at `TIMES`."""
        start = np.zeros(self.truth.size)
        start[-1] = 9.81 * MASS
        y = np.concatenate(
            [start, self.initial_estimate, self.initial_covariance.ravel() if self.moving else []]
        )
        events = [0.0, ENTRY, ENTRY + 0.01, ENTRY + 0.2, ENTRY + 0.21, END]
        found = {}
        for early, late in zip(events[:-1], events[1:], strict=True):
            inside = TIMES[(early - 1e-12 <= TIMES) & (late - 1e-12 > TIMES)]
            times = np.append(np.maximum(inside, early), late - 1e-12)
            part = solve_ivp(
                self.rate, (early, late - 1e-12), y, "DOP853", times, rtol=1e-9, atol=1e-14
            )
            found |= dict(zip(inside, part.y.T, strict=False))
            y = part.y[:, -1]
        found[TIMES[-1]] = y
        states = np.array([found[t] for t in TIMES])
        n = self.truth.size
        rows = np.array([self.span.shapes(x) for x in (0.17, 0.25)])
        return states[:, :3] @ rows.T, -states[:, n : n + 5] @ self.gain.T


@pytest.mark.parametrize("name", ["time-invariant", "estimated", "known"])
def test_loops_with_a_filter_in_continuous_time(name):
    deflection, command = ExplicitLoop(name).solve()
    record = jb.simulate(loop(ESTIMATORS[name]), jnp.asarray(TIMES))
    for found, true in ((record.deflection, deflection), (record.command, command)):
        assert_allclose(found, true, rtol=0, atol=1e-6 * np.max(np.abs(true)))


def unloaded_design(case):
    """A, B and C of the design plant without its load, and the gain of the regulator."""
    span, _, *parts = parts_of(case)
    design_span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, 2, 0.01)
    A, B, C, _ = SampledPlant(design_span, [], *parts).matrices(0.0)
    return A, B, C, control.lqr(A, B, np.diag(WEIGHTS), COMMAND_WEIGHT * np.eye(1))[0]


def test_poles_of_a_loop_with_a_kalman_filter():
    """Those of [[A, -B K], [L C, F - G K - L H]], on a beam with more modes than the design."""
    case = loop(ESTIMATORS["time-invariant"])
    F, G, H, K = unloaded_design(case)
    span, _, *parts = parts_of(case)
    A, B, C, _ = SampledPlant(span, [], *parts).matrices(0.0)
    L = steady_gain(F, H)
    closed_matrix = np.block([[A, -B @ K], [L @ C, F - G @ K - L @ H]])
    found = np.asarray(linearised_loop(case, -1.0).poles())
    expected = np.linalg.eigvals(closed_matrix)
    assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-6)


def test_poles_of_a_loop_with_an_observer():
    """Those of the regulator, and one and a half times those of the beam (Luenberger)."""
    case = loop(Observer(speed=1.5), modes=2)
    A, B, _, K = unloaded_design(case)
    observer_poles = (
        1.5 * np.linalg.eigvals(A[:4, :4]),
        [-400.0],
    )  # the last of the shaker, uncorrected
    expected = np.concatenate([np.linalg.eigvals(A - B @ K), *observer_poles])
    found = np.asarray(linearised_loop(case, -1.0).poles())
    assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-6)


@pytest.mark.parametrize(
    ("estimator", "period", "message"),
    [
        (Kalman(FORCE), None, "measurement_intensity must be given without a controller.period"),
        (ESTIMATORS["known"], 1e-3, "measurement_intensity must be given without"),
        (Kalman(FORCE, 1e-5, measurement_intensity=1e-13), None, "measurement_noise is that of"),
        (Kalman(FORCE, measurement_intensity=[1e-13] * 3), None, "one number or 2, not 3"),
        (dataclasses.replace(ESTIMATORS["known"], points=3), None, "points must be at least"),
        (Inversion(), None, "period must be given: this estimator acts at samples only"),
    ],
)
def test_errors_of_settings(estimator, period, message):
    case = loop(estimator)
    period = None if period is None else jnp.asarray(period)
    law = dataclasses.replace(case.controller, period=period)
    with pytest.raises(ValueError, match=message):
        check_case(dataclasses.replace(case, controller=law))


@pytest.mark.parametrize("name", ["time-invariant", "known"])
def test_readings_that_are_those_of_the_estimate_do_not_change_its_motion(name):
    """Accelerations answer to the command of a force at once: phi u - 2 zeta w q' - w^2 q."""
    sensors = jb.Sensor(0.17, offset=1e-5), jb.Sensor(0.25, "acceleration")
    case = dataclasses.replace(
        loop(ESTIMATORS[name], 2), actuators=(jb.PointForce(0.4),), sensors=sensors
    )
    plant = jb.state_space(case)
    filter = ESTIMATORS[name].continuous_filter(plant)
    q, rates, command = np.array([1e-3, -2e-4]), np.array([0.02, 0.05]), np.array([0.7])
    state = np.append([*q, *rates], np.zeros(filter.initial.size - 4)) - filter.initial
    state[4:] = 0.0
    w = (np.arange(1, 3) * np.pi / 0.6) ** 2 * (11.68 / 0.535) ** 0.5
    shapes = plant.modal_model.modes.shapes(np.array([0.17, 0.25, 0.4]))
    accelerations = command * shapes[2] - 0.02 * w * rates - w**2 * q
    readings = np.array([shapes[0] @ q + 1e-5, shapes[1] @ accelerations])
    found = filter.rates(state, Measurement(readings, np.zeros(1), command), command, 0.0)
    assert_allclose(found[:4], [*rates, *accelerations], rtol=1e-7)
