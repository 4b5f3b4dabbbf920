"""Sliding-mode control against the scalar equation of its surface, and errors of its settings."""

import numpy as np
import pytest
import scipy.integrate
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Estimate, Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, sample_times, static_shapes
from tests.loop_as_oracle import span_of

LENGTH, RATE, LAYER, PLACE = 0.6, 40.0, 0.01, 0.3
FORCE, SPEED, ENTRY = 4.0, 12.0, 0.004
PERIOD = 2e-4


def beam_case(law, modes=1, duration=0.06, **changes) -> jb.Case:
    parts = {
        "actuators": [jb.PointForce(0.25)],
        "sensors": [jb.Sensor(PLACE), jb.Sensor(PLACE, "velocity")],
        "loads": [jb.MovingForce(force=FORCE, speed=SPEED, entry_time=ENTRY)],
        "run": jb.Run(duration, 1 / PERIOD),
    }
    beam = jb.Beam(LENGTH, 2.0, 0.535, 0.03, modes=modes)
    return jb.Case(beam, controller=law, **(parts | changes))


def sliding(reaching_rate=20.0, **settings) -> jb.SlidingMode:
    return jb.SlidingMode(RATE, reaching_rate, LAYER, **({"period": PERIOD} | settings))


def disturbance(t):
    """Acceleration of the deflection at midspan by the force, in one mode (m/s^2)."""
    share = (t - ENTRY) * SPEED / LENGTH
    acting = (share >= 0) & (share <= 1)
    return -2 * FORCE / (0.535 * LENGTH) * np.sin(np.pi * share) * acting


def surface_by_its_equation(times, reaching_rate):
    """s(t) of s' = -reaching_rate sat(s / layer) + d(t), from rest."""

    def rate(t, s):
        return -reaching_rate * np.clip(s / LAYER, -1, 1) + disturbance(t)

    parts = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-12, "max_step": 1e-3}
    return scipy.integrate.solve_ivp(rate, (0, times[-1]), [0.0], t_eval=times, **parts).y[0]


@pytest.mark.parametrize("reaching_rate", [30.0, 20.0], ids=["rejected", "too strong"])
def test_surface_follows_its_scalar_equation(reaching_rate):
    """The force accelerates the beam by 24.9 m/s^2 at most: 30 keep s in the layer, 20 do not.

    Then s leaves the layer, and comes back at the predicted time, when the force is near the end.
    """
    case = beam_case(sliding(reaching_rate))
    times = np.asarray(sample_times(case))
    schedule = loop_schedule(case, times)
    plan = IntegrationPlan(static_shapes(case), 2, 0, False, 0.0, schedule)
    record = jb.simulate(case, times, plan)
    times, (w, rate) = np.asarray(record.times), np.asarray(record.measured).T
    found, expected = rate + RATE * w, surface_by_its_equation(times, reaching_rate)
    largest = np.abs(expected).max()
    # A command held for a period is late by half of it.
    assert_allclose(found, expected, atol=0.01 * max(largest, LAYER))
    strongest = 2 * FORCE / (0.535 * LENGTH)
    if reaching_rate > strongest:
        assert np.abs(found).max() < LAYER
        assert np.abs(w).max() < LAYER / RATE
    else:
        outside = np.abs(found) > LAYER
        reached = times[outside][-1]
        assert largest > 5 * LAYER and 0.04 < reached < ENTRY + LENGTH / SPEED
        assert_allclose(reached, times[np.abs(expected) > LAYER][-1], atol=2 * PERIOD)


def test_commands_against_modal_sums():
    """Two modes, two actuators, and of these a shaker, whose lag is left out of the design."""
    case = beam_case(
        sliding(positions=[0.2, 0.45]),
        modes=3,
        actuators=[jb.PointForce(0.2), jb.SpringDamper(0.1, 50.0), jb.Shaker(0.4, 30.0, 2.0)],
    )
    assert case.controller is not None
    law = case.controller.design_law(jb.state_space(case)).law
    span, places = span_of(case), np.array([0.2, 0.45])
    shapes = np.stack([span.shapes(x) for x in places])
    spring, shaker = span.shapes(0.1), span.shapes(0.4)
    stiffness = np.diag(span.frequencies**2) + 50.0 * np.outer(spring, spring)
    stiffness = stiffness + 30.0 * np.outer(shaker, shaker)
    damping = span.damping + 2.0 * np.outer(shaker, shaker)
    effect = shapes @ np.stack([span.shapes(0.2), 4.6 * shaker], axis=1)
    q, rates = np.array([3e-5, -1e-5, 2e-5]), np.array([1e-3, 2e-3, -1e-3])
    s = shapes @ (rates + RATE * q)
    own = shapes @ (RATE * rates - stiffness @ q - damping @ rates)
    commands = -np.linalg.solve(effect, own + 20.0 * np.clip(s / LAYER, -1, 1))
    estimate = Estimate(np.concatenate([q, rates, [0.3]]))
    rest = Measurement(np.zeros(2), np.zeros(7), np.zeros(3))
    found = law.step((), estimate, rest, np.zeros(())).command
    assert_allclose(found, commands, rtol=1e-9)  # of the actuators that take any


@pytest.mark.parametrize(
    ("settings", "changes", "message"),
    [
        ({"positions": [0.2, 0.3]}, {}, "positions must have an entry for each of 1 actuators"),
        ({"reaching_rate": [1.0, 2.0]}, {}, "reaching_rate must be one number or 1"),
        ({"reaching_rate": 300.0}, {}, "layer must be above reaching_rate times half the period"),
        ({}, {"sensors": []}, "positions must be given: there are 0 sensors for 1 actuators"),
        ({}, {"actuators": [jb.SpringDamper(0.2, 9.0)]}, "has nothing to command"),
    ],
)
def test_errors_of_settings(settings, changes, message):
    with pytest.raises(ValueError, match=f"^controller.{message}"):
        check_case(beam_case(sliding(**settings), **changes))


def test_positions_that_commands_do_not_move():
    """Two modes of opposite signs there: sin a sin x + sin 2a sin 2x = 0, in shares of pi."""
    place = LENGTH / np.pi * np.arccos(-1 / (4 * np.cos(np.pi * 0.25)))
    case = beam_case(sliding(positions=[place]), modes=2, actuators=[jb.PointForce(LENGTH / 4)])
    assert case.controller is not None
    with pytest.raises(ValueError, match="positions: no commands hold each of the deflections"):
        case.controller.law(jb.state_space(case))
