"""Springs among the actuators: laws, tables of commands and exports leave them out."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.bound.least_integral import least_integral
from jaxbeam.case.validation import check_case
from jaxbeam.control.design_model import DesignModel
from jaxbeam.files.export.designed import export_gains
from tests.c_code.cases import CASES, rig

SLACK = jb.SpringDamper(0.35)  # neither stiff nor damped: nothing may change
# All kinds of settings with a number for each actuator, and of estimators.
KINDS = [
    *("output-feedback", "ppf", "prescribed", "feedforward", "internal-model", "sliding-mode"),
    *("state", "lqr-observer", "dlqr-kalman", "lqr-inversion", "mpc", "gpc", "gpc-adaptive"),
    *("h-infinity", "mpc-dual-mode", "mpc-scenario-worst", "kalman-extended", "moving-horizon"),
    *("compensation-kalman", "feedback-scheduled", "internal-model-scheduled"),
]


def with_actuator(case: jb.Case, actuator, place: int) -> jb.Case:
    actuators = list(case.actuators)
    actuators.insert(place, actuator)
    return dataclasses.replace(case, actuators=tuple(actuators))


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_a_slack_spring_changes_no_command(kind):
    case = CASES[kind]
    found = np.asarray(jb.simulate(with_actuator(case, SLACK, 0)).command)
    commands = np.asarray(jb.simulate(case).command)
    assert np.all(found[:, 0] == 0)
    assert_allclose(found[:, 1:], commands, rtol=0, atol=1e-9 * np.abs(commands).max())


@pytest.mark.parametrize("force_per_volt", [None, 3.0])
def test_a_spring_enters_the_design(force_per_volt):
    """Of an LQR on the modal equations w'' + D w' + (diag(omega^2) + k psi psi^T) w = psi u."""
    spring, force = jb.SpringDamper(0.35, stiffness=300.0, damping=2.0), jb.PointForce(0.2)
    shaker = jb.Shaker(0.2, force_per_volt=2.0, bandwidth=1e3)
    actuator = force if force_per_volt is None else shaker
    design = None if force_per_volt is None else DesignModel(force_per_volt=force_per_volt)
    states = 4 if force_per_volt is None else 5
    law = jb.LQR([1e4, 1e2, 1.0, 0.1, 0.0][:states], [1e-2], period=None, design=design)
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[spring, actuator],
        controller=law,
    )
    check_case(case)
    orders = np.arange(1, 3)
    omega = (orders * np.pi / 0.6) ** 2 * np.sqrt(11.68 / 0.535)

    def shapes(x):
        return np.sqrt(2 / (0.535 * 0.6)) * np.sin(orders * np.pi * x / 0.6)

    port, acting = shapes(0.35), shapes(0.2)
    K = np.diag(omega**2) + 300.0 * np.outer(port, port)
    D = np.diag(2 * 0.03 * omega) + 2.0 * np.outer(port, port)
    A, B = np.zeros((states, states)), np.zeros((states, 1))
    A[:2, 2:4], A[2:4, :2], A[2:4, 2:4] = np.eye(2), -K, -D
    if force_per_volt is None:
        B[2:4, 0] = acting
    else:
        A[2:4, 4], A[4, 4], B[4] = force_per_volt * acting, -1e3, 1e3
    Q, R = np.diag([1e4, 1e2, 1.0, 0.1, 0.0][:states]), np.array([[1e-2]])
    P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    gain = law.law(jb.state_space(case)).law.law.gain
    assert_allclose(gain, B.T @ P / 1e-2, rtol=1e-7, atol=1e-8 * np.abs(P).max())


def test_gains_are_exported_for_driven_actuators():
    case = with_actuator(CASES["lqr-observer"], jb.SpringDamper(0.35, stiffness=50.0), 1)
    gains = export_gains(case)
    assert [name for name, _ in gains.commands] == ["command_0", "command_2"]
    assert gains.table.shape[-2:] == (2, 5)


def test_optimal_commands_run_beside_a_spring():
    """The open-loop optimum has a command for the force alone, and its run attains the bound."""
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=1),
        actuators=[jb.SpringDamper(0.4, stiffness=100.0), jb.PointForce(0.3, limits=(-2.0, 2.0))],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingForce(force=4.0, speed=4.0)],
        run=jb.Run(0.15),
    )
    best = jb.bound(case, period=0.015)
    run = jb.simulate(dataclasses.replace(case, controller=best.controller()))
    assert_allclose(np.max(run.peak_deflection), best.peak, rtol=2e-3)
    assert best.peak < 0.9 * best.uncontrolled
    least = least_integral(case, period=0.015)
    run = jb.simulate(dataclasses.replace(case, controller=least.controller()))
    assert_allclose(least.of_record(run), least.integral, rtol=5e-3)


def test_only_springs_leave_nothing_to_command():
    case = rig(jb.Feedback([], period=0.005), actuators=[SLACK])
    with pytest.raises(ValueError, match="add an actuator that takes commands"):
        check_case(case)
