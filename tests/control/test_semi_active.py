"""Semi-active dampers against switched modal equations in scipy, and energy that they take."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.analysis.compare import compare

L, EI, MASS, DAMPING, FORCE, SPEED = 20.0, 6e9, 9e3, 0.01, 3e5, 30.0
DAMPER, LEAST, MOST = 8.0, 2e4, 6e5
ACTIVE, ACTIVE_GAIN = 13.0, 4e6  # m, N/m
CASE = jb.Case(
    jb.Beam(L, EI, MASS, damping_ratio=DAMPING, modes=2),
    actuators=[jb.PointForce(DAMPER)],
    sensors=[jb.Sensor(DAMPER), jb.Sensor(DAMPER, "velocity")],
    loads=[jb.MovingForce(force=FORCE, speed=SPEED)],
    run=jb.Run(1.2, sample_rate=500.0),
)
GAIN = 6e6  # N/m, of the desired force against the deflection


def semi_active(**settings):
    desired = settings.pop("desired", jb.Feedback([GAIN]))
    return jb.SemiActive(LEAST, MOST, desired, **settings)


def modal_solution(damper_force, times, active_force=lambda deflection: 0.0):
    """Times, and deflections at the damper from q_j'' + 2 zeta w q_j' + w^2 q_j = f_j / (m L / 2).

    An `active_force` of the deflection at another place, ACTIVE, acts there.
    The integration ends, and starts again, wherever deflection or velocity there is zero.
    """
    number = np.arange(1, 3)
    omega = (number * np.pi / L) ** 2 * np.sqrt(EI / MASS)
    at, other = (np.sin(number * np.pi * place / L) for place in (DAMPER, ACTIVE))

    def motion(state):
        return at @ state[:2], at @ state[2:]

    def rates(t, state):
        x = SPEED * t
        load = -FORCE * np.sin(number * np.pi * x / L) * (x <= L)
        load = load + other * active_force(other @ state[:2])
        push = (load + at * damper_force(*motion(state))) / (MASS * L / 2)
        return [*state[2:], *(push - 2 * DAMPING * omega * state[2:] - omega**2 * state[:2])]

    events = [lambda t, state, k=k: motion(state)[k] for k in (0, 1)]
    for event in events:
        event.terminal = True
    found, state, start, end = [], np.zeros(4), 0.0, float(times[-1])
    options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-13, "events": events}
    while start < end:
        stop = L / SPEED if start < L / SPEED else end
        piece = solve_ivp(rates, (start, stop), state, dense_output=True, **options)
        reached = piece.t[-1]
        if reached - start < 1e-9:  # an event at the start of a piece: step over it
            reached = min(start + 1e-7, stop)
            state = state + 1e-7 * np.array(rates(start, state))
        else:
            inside = times[(times >= start) & (times < reached)]
            found += [(t, motion(piece.sol(t))[0]) for t in inside]
            state = piece.y[:, -1]
        start = reached
    return np.array(found).T


@pytest.mark.parametrize("beside", ["nothing", "active force", "spring"])
@pytest.mark.parametrize(("rates", "tolerance"), [("clipped", 2e-6), ("on-off", 2e-4)])
def test_switching_damper_against_scipy(rates, tolerance, beside):
    """Alone, and beside an active force against the deflection elsewhere, or a spring there."""

    def force(deflection, velocity):
        desired = -GAIN * deflection
        if rates == "on-off":
            return -(MOST if desired * velocity < 0 else LEAST) * velocity
        return np.clip(desired, *sorted((-LEAST * velocity, -MOST * velocity)))

    case, law = CASE, semi_active(rates=rates)
    gain = 0.0 if beside == "nothing" else ACTIVE_GAIN
    if beside == "spring":
        spring = jb.SpringDamper(ACTIVE, stiffness=gain)
        case = dataclasses.replace(CASE, actuators=[spring, *CASE.actuators])
    if beside == "active force":
        case = dataclasses.replace(
            CASE,
            actuators=[jb.PointForce(DAMPER), jb.PointForce(ACTIVE)],
            sensors=[*CASE.sensors, jb.Sensor(ACTIVE)],
        )
        rows = [[-GAIN, 0.0, 0.0], [0.0, 0.0, -gain]]
        law = semi_active(desired=jb.OutputFeedback(rows), rates=rates, active=1)
    record = jb.simulate(dataclasses.replace(case, controller=law), tolerance=1e-4)
    times, expected = modal_solution(force, record.times, lambda deflection: -gain * deflection)
    assert times.size > record.times.size - 20  # those at which a piece starts are left out
    deflection = np.asarray(record.deflection[np.isin(record.times, times), 0])
    assert_allclose(deflection, expected, atol=tolerance * np.abs(expected).max())


def test_least_peak_bounds_passive_semi_active_and_active():
    """One comparison has all three; no rate and no force has less than the least peak of forces."""
    velocity = [[0.0, -MOST]]
    laws = {
        "passive": jb.OutputFeedback(velocity, period=0.01),
        "semi-active": semi_active(desired=jb.OutputFeedback([[-GAIN, -MOST]]), period=0.01),
        "active": jb.OutputFeedback([[-GAIN, -MOST]], period=0.01),
    }
    limited = dataclasses.replace(CASE, actuators=[jb.PointForce(DAMPER, limits=(-2e5, 2e5))])
    found = compare(limited, laws)
    peaks = [found.metrics[name].peak for name in laws]
    assert found.bound.peak <= min(peaks) and max(peaks) < found.uncontrolled.peak_deflection[0]


@pytest.mark.parametrize(
    ("law", "sensors", "message"),
    [
        (jb.SemiActive(1.0, 2.0), None, "controller.desired is missing"),
        (semi_active(desired=jb.Feedback([1.0], period=0.1)), None, "desired.period is that of"),
        (jb.SemiActive(2.0, 1.0, jb.Feedback([1.0])), None, "max_damping must be at least min"),
        (semi_active(active=1), None, "active must leave a damper of the 1 actuators"),
        (semi_active(), [jb.Sensor(DAMPER)], "a sensor of velocity at each damper"),
        (semi_active(), [jb.Sensor(3.0, "velocity")], r"sensors.0 is at 3 m, actuators.0 at 8 m"),
        (semi_active(desired=jb.Feedback([1.0, 2.0])), None, r"desired\.gains must list one gain"),
    ],
)
def test_wrong_settings_are_told(law, sensors, message):
    case = dataclasses.replace(CASE, controller=law, sensors=sensors or CASE.sensors)
    with pytest.raises(ValueError, match=message):
        jb.simulate(case)
