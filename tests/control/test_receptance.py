"""Receptance method: assigned and kept poles, delays, measured receptances, the law in a run.

Numbers are of an independent implementation with twelve modes, closed form and collocation with
Newton's method (reference cases 8a and 8b).
"""

import dataclasses

import jax
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.bound.least_integral import least_integral
from jaxbeam.case.validation import check_case
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.export.gains import export_gains
from tests.export.cases import CASES, rig as passive_rig

POLES = [-12.80978306539895 + 127.45573222133082j, -30.743479356957476 + 511.46818666380324j]
OPEN = -5.12391323 + 512.365702j
DELAYED = [  # rightmost poles with a delay of 2 ms
    -11.4324129 + 2045.32143j,
    -11.6694041 + 1151.94998j,
    *POLES,
    -42.458841 + 3202.44632j,
    -48.7868116 + 4610.57694j,
    -66.897472 + 6277.06237j,
    -74.173829 + 8192.70464j,
    -105.32362 + 10368.929j,
    -1591.26759,
    -1952.99314 + 3608.74548j,
]


def rig(**beam):
    settings = {"flexural_rigidity": 11.68, "mass_per_length": 0.535, "damping_ratio": 0.01}
    return jb.Case(
        jb.Beam(**(settings | {"length": 0.6, "modes": 12} | beam)),
        actuators=[jb.PointForce(position=0.21)],
        sensors=[jb.Sensor(position=0.18), jb.Sensor(position=0.39)],
    )


def distance(poles, wanted):
    return np.abs(poles - wanted).min() / abs(wanted)


def test_gains_and_poles_without_delay():
    law = jb.receptance_method.receptance_feedback(rig(), POLES)
    np.testing.assert_allclose(law.velocity, [-8.26397382, 2.84712574], rtol=1e-8)
    np.testing.assert_allclose(law.displacement, [-122.11846, 127.651937], rtol=1e-8)
    poles = jb.receptance_method.closed_loop_poles(rig(), law)
    assert max(distance(poles, pole) for pole in POLES) < 1e-12
    assert distance(poles, -10.0696685 + 1152.89103j) < 1e-8
    for change, largest in {0.0005: -10.2286024, 0.001: -8.99594596, 0.002: -7.48508961}.items():
        poles = jb.receptance_method.closed_loop_poles(rig(), law, delay=change, count=8)
        assert poles[0].real == pytest.approx(largest, rel=1e-8)


def test_gains_and_poles_with_delay():
    law = jb.receptance_method.receptance_feedback(rig(), POLES, delay=0.002)
    np.testing.assert_allclose(law.velocity, [-4.5088598, 0.225099223], rtol=1e-8)
    np.testing.assert_allclose(law.displacement, [2442.80154, -2063.53204], rtol=1e-8)
    poles = jb.receptance_method.closed_loop_poles(rig(), law)
    assert max(distance(poles, pole) for pole in DELAYED) < 1e-8
    assert max(distance(poles, pole) for pole in POLES) < 1e-12


@pytest.mark.parametrize("delay", [0.0, 0.002])
def test_kept_poles_stay(delay):
    law = jb.receptance_method.receptance_feedback(rig(), POLES[:1], keep=[1], delay=delay)
    poles = jb.receptance_method.closed_loop_poles(rig(), law)
    assert distance(poles, POLES[0]) < 1e-12
    assert distance(poles, OPEN) < 1e-8


def test_gains_from_measured_receptances():
    frequencies = np.linspace(1.0, 900.0, 1500)
    measured = jb.receptance_method.receptances(rig(), 2j * np.pi * frequencies)
    fitted = jb.receptance_method.fit_receptances(frequencies, measured)
    law = jb.receptance_method.receptance_gains(fitted(POLES), POLES)
    poles = jb.receptance_method.closed_loop_poles(rig(), law)
    assert max(distance(poles, pole) for pole in POLES) < 1e-8
    noise = 1 + 1e-4 * np.random.default_rng(1).standard_normal(measured.shape)
    fitted = jb.receptance_method.fit_receptances(frequencies, measured * noise, tolerance=1e-3)
    law = jb.receptance_method.receptance_gains(fitted(POLES), POLES)
    poles = jb.receptance_method.closed_loop_poles(rig(), law)
    assert max(distance(poles, pole) for pole in POLES) < 1e-2


def test_poles_with_the_dynamics_of_a_shaker():
    shaker = jb.Electrodynamic(
        position=0.21, force_constant=5.0, resistance=4.0, inductance=1e-3, stiffness=200.0,
        damping=1.0, mass=0.02,
    )  # fmt: skip
    case = jb.Case(rig().beam, actuators=[shaker], sensors=rig().sensors)
    law = jb.receptance_method.receptance_feedback(case, POLES, delay=1e-3)
    assert (
        max(distance(jb.receptance_method.closed_loop_poles(case, law), pole) for pole in POLES)
        < 1e-11
    )


def test_gradients_of_the_gains():
    def gain(rigidity):
        return jb.receptance_method.receptance_feedback(
            rig(flexural_rigidity=rigidity, modes=4), POLES
        ).velocity[0]

    step = 1e-4
    difference = (gain(11.68 + step) - gain(11.68 - step)) / (2 * step)
    assert jax.grad(gain)(11.68) == pytest.approx(difference, rel=1e-6)


def test_law_damps_a_run():
    """Free vibration of the two modes decays as the poles say, in a simulated run."""
    free = rig(modes=2)
    sensors = [*free.sensors, *(jb.Sensor(s.position, quantity="velocity") for s in free.sensors)]
    case = jb.Case(
        free.beam,
        actuators=free.actuators,
        sensors=sensors,
        loads=[jb.MovingForce(force=1.0, speed=60.0)],
        run=jb.Run(duration=0.3, sample_rate=2000.0),
    )
    law = jb.receptance_method.receptance_feedback(free, POLES)
    controlled = jb.Case(
        case.beam, (), case.actuators, case.sensors, case.loads, law.controller(case), case.run
    )
    record = jb.simulate(controlled)
    late = record.times > 0.1  # the second mode has decayed to e^-3 of the first
    t, w = record.times[late], record.at(0.3, "deflection")[late]
    basis = [np.exp(p * t) for p in POLES]
    basis = np.stack([part for b in basis for part in (b.real, b.imag)], axis=1)
    rest = w - basis @ np.linalg.lstsq(basis, w)[0]
    assert np.abs(rest).max() < 1e-6 * np.abs(w).max()


def test_output_feedback_is_feedback_of_the_opposite_sign():
    case = jb.Case(
        rig(modes=3).beam,
        actuators=rig().actuators,
        sensors=rig().sensors[:1],
        loads=[jb.MovingMass(mass=0.1, speed=2.0)],
        controller=jb.Feedback(gains=[300.0], period=0.001),
        run=jb.Run(duration=0.3),
    )
    opposite = jb.OutputFeedback(gains=[[-300.0]], period=0.001)
    other = jb.Case(case.beam, (), case.actuators, case.sensors, case.loads, opposite, case.run)
    np.testing.assert_array_equal(jb.simulate(other).coordinates, jb.simulate(case).coordinates)


def test_refusals():
    with pytest.raises(ValueError, match="8 real conditions for poles exceed the 4 gains"):
        jb.receptance_method.receptance_feedback(rig(), [*POLES, -40 + 1100j, -50 + 2000j])
    with pytest.raises(ValueError, match="there is no actuator 1; the case has 1"):
        jb.receptance_method.receptance_feedback(rig(), POLES, actuator=1)
    with pytest.raises(ValueError, match="keep must list modes from 0 to 11"):
        jb.receptance_method.receptance_feedback(rig(), POLES[:1], keep=[12])
    with pytest.raises(ValueError, match="2 sensors of deflection, then 2 of velocity"):
        jb.receptance_method.receptance_feedback(rig(), POLES).controller(rig())
    with pytest.raises(ValueError, match="frequencies must be .frequency,. and values"):
        jb.receptance_method.fit_receptances([1.0, 2.0], np.zeros((3, 1)))
    with pytest.raises(ValueError, match="conditions contradict each other"):
        twice = jb.Case(rig().beam, actuators=rig().actuators, sensors=[jb.Sensor(0.18)] * 2)
        jb.receptance_method.receptance_feedback(twice, POLES)
    controller = jb.OutputFeedback(gains=[[1.0]])
    case = jb.Case(rig().beam, (), rig().actuators, rig().sensors, (), controller)
    with pytest.raises(ValueError, match="row for each of 1 actuators, with a gain for each of 2"):
        jb.simulate(case)


# Springs among the actuators: laws, tables of commands and exports leave them out.

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
    case = passive_rig(jb.Feedback([], period=0.005), actuators=[SLACK])
    with pytest.raises(ValueError, match="add an actuator that takes commands"):
        check_case(case)
