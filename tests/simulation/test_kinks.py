"""Rigid wheels over kinks: hinges, supports and steps of beams with shear, ends of ramps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.actuators.base import PointForce
from jaxbeam.case.case import replace
from jaxbeam.case.loads.vehicles import Oscillator
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.simulate import simulate_readings
from tests.differences import central, plan_of
from tests.oracles.kinked_path import PiecewiseShapes, Wheel, crossing

pytestmark = pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
UNIT = {"length": 1.0, "flexural_rigidity": 1.0, "mass_per_length": 1.0}
HINGED = jb.Beam(**UNIT, modes=3, ends="clamped-pinned", hinges=[jb.Hinge(0.4, 0.5)])
SHEARED = jb.Beam(**UNIT, modes=4, shear_stiffness=60.0, rotary_inertia=0.002)
GRAVITY = 9.81


def level(x):
    return 0.0, 0.0, 0.0


def ramp(x):
    """From 0.2 m to 0.5 m, 0.03 m high."""
    inside = 0.2 < x < 0.5
    return 0.1 * np.clip(x - 0.2, 0.0, 0.3), 0.1 * inside, 0.0


def constant(speed, start=0.0):
    return lambda t: (start + speed * t, speed, 0.0)


def braking(t):
    return 0.9 * t - 0.2 * t**2, 0.9 - 0.4 * t, -0.4


def arrival(x):
    """Time at which the braking load arrives."""
    return (0.9 - np.sqrt(0.81 - 0.8 * x)) / 0.4


def mass(m, **motion):
    return jb.MovingMass(mass=m, **motion)


SPRUNG = {"mass": 0.3, "stiffness": 40.0, "damping": 2.0, "wheel_mass": 0.2}
# Beam, profile, loads, supports; wheels, and times of entry, exit, and passages over kinks.
CASES = {
    "hinge": (
        (HINGED, None, [mass(0.4, speed=0.7)], []),
        (level, [Wheel(constant(0.7), 0.4, 0.4 * GRAVITY)], [0.4 / 0.7, 1 / 0.7]),
    ),
    "leftwards, two masses": (
        (HINGED, None, [mass(0.4, speed=-0.7), mass(0.3, speed=0.8, entry_time=0.1)], []),
        (
            level,
            [
                Wheel(constant(-0.7, 1.0), 0.4, 0.4 * GRAVITY),
                Wheel(constant(0.8, -0.08), 0.3, 0.3 * GRAVITY),
            ],
            [0.1, 0.6, 0.6 / 0.7, 1.35, 1 / 0.7],
        ),
    ),
    "more masses than modes": (
        (
            dataclasses.replace(HINGED, modes=1),
            None,
            [mass(0.4, speed=-0.7), mass(0.3, speed=0.8, entry_time=0.1)],
            [],
        ),
        (
            level,
            [
                Wheel(constant(-0.7, 1.0), 0.4, 0.4 * GRAVITY),
                Wheel(constant(0.8, -0.08), 0.3, 0.3 * GRAVITY),
            ],
            [0.1, 0.6, 0.6 / 0.7, 1.35, 1 / 0.7],
        ),
    ),
    "braking": (
        (HINGED, None, [mass(0.4, speed=0.9, deceleration=0.4)], []),
        (level, [Wheel(braking, 0.4, 0.4 * GRAVITY)], [arrival(0.4), arrival(1.0)]),
    ),
    "vehicle": (
        (HINGED, None, [Oscillator(**SPRUNG, speed=0.7)], []),
        (
            level,
            [Wheel(constant(0.7), 0.2, 0.5 * GRAVITY, 0.3, 40.0, 2.0)],
            [0.4 / 0.7, 1 / 0.7],
        ),
    ),
    "ramp": (
        (
            jb.Beam(**UNIT, modes=3),
            jb.profiles.RampProfile(start=0.2, end=0.5, height=0.03),
            [mass(0.4, speed=0.7)],
            [],
        ),
        (ramp, [Wheel(constant(0.7), 0.4, 0.4 * GRAVITY)], [0.2 / 0.7, 0.5 / 0.7, 1 / 0.7]),
    ),
    "ramp over a hinge": (
        (
            HINGED,
            jb.profiles.RampProfile(start=0.2, end=0.5, height=0.03),
            [Oscillator(**SPRUNG, speed=0.7)],
            [],
        ),
        (
            ramp,
            [Wheel(constant(0.7), 0.2, 0.5 * GRAVITY, 0.3, 40.0, 2.0)],
            [0.2 / 0.7, 0.4 / 0.7, 0.5 / 0.7, 1 / 0.7],
        ),
    ),
    "two spans with shear": (
        (SHEARED, None, [mass(0.4, speed=0.7)], [jb.Support(0.6)]),
        (level, [Wheel(constant(0.7), 0.4, 0.4 * GRAVITY)], [0.6 / 0.7, 1 / 0.7]),
    ),
    "step of the shear stiffness": (
        (
            jb.Beam(
                length=1.0,
                modes=3,
                segments=[
                    jb.Segment(0.3, 1.0, 1.0, shear_stiffness=20.0),
                    jb.Segment(None, 1.0, 1.0, shear_stiffness=80.0),
                ],
            ),
            None,
            [mass(0.4, speed=0.7)],
            [jb.Support(0.55, stiffness=200.0)],
        ),
        (
            level,
            [Wheel(constant(0.7), 0.4, 0.4 * GRAVITY)],
            [0.3 / 0.7, 0.55 / 0.7, 1 / 0.7],
        ),
    ),
}
TIMES = np.linspace(0, 1.4, 24)


def described(name):
    (beam, profile, loads, supports), wheels = CASES[name]
    case = jb.Case(
        beam,
        supports=supports,
        loads=loads,
        profile=profile,
        run=jb.Run(1 / 0.7, gravity=GRAVITY),
        sensors=[jb.Sensor(0.47)],
    )
    return case, *wheels


def oracle(case, profile, wheels, events, impulses=None):
    modes = jb.modes(case)
    shapes = PiecewiseShapes(modes.nodes, modes.shapes)
    frequencies = modes.angular_frequencies
    return crossing(frequencies, shapes, profile, wheels, events, TIMES, (0.0, 1.0), impulses)


@pytest.mark.parametrize("name", CASES)
def test_balance_of_momentum(name):
    """Against scipy's integration of the modal equations, with momentum kept over each kink."""
    case, *described_wheels = described(name)
    impulses = []
    expected = oracle(case, *described_wheels, impulses)
    record = jb.simulate(case, times=TIMES, tolerance=1e-9)
    rows = record.modes.shapes(0.47)
    found, velocity = record.at(0.47, "deflection"), record.at(0.47, "velocity")
    count = case.beam.modes
    deflection, rates = rows @ expected[:count], rows @ expected[count:]
    assert_allclose(found, deflection, rtol=0, atol=2e-7 * np.abs(deflection).max())
    assert_allclose(velocity, rates, rtol=0, atol=2e-6 * np.abs(rates).max())
    largest = max((np.abs(rows @ jump).max() for jump in impulses), default=0.0)
    if supports_take_all(case):
        assert largest == 0
    else:  # without its impulses the result would be another
        assert largest > 1e-2 * np.abs(rates).max()


def supports_take_all(case):
    return any(support.stiffness is None for support in case.supports)


def hinge_with(modes, stiffness=0.0):
    return jb.Case(
        jb.Beam(**UNIT, modes=modes, ends="clamped-pinned", hinges=[jb.Hinge(0.4, stiffness)]),
        loads=[mass(0.4, speed=0.7)],
        run=jb.Run(1 / 0.7),
        sensors=[jb.Sensor(0.47)],
    )


def test_convergence_in_the_number_of_modes():
    """The impulse over a hinge falls like 1 / n; deflections converge."""
    impulses, deflections = [], []
    at = 0.4 / 0.7
    times = np.array([0.0, at - 1e-7, at + 1e-7, 0.9])
    counts = (3, 6, 12)
    for n in counts:
        record = jb.simulate(hinge_with(n), times=times, tolerance=1e-5)
        jump = np.diff(np.asarray(record.rates)[1:3], axis=0)[0]
        shape = np.asarray(jb.modes(hinge_with(n)).shapes(0.4))
        impulses.append(np.abs(jump).max() / np.abs(shape[np.argmax(np.abs(jump))]))
        deflections.append(record.at(0.47, "deflection")[-1])
    products = np.array(impulses) * counts
    assert_allclose(products, products[-1], rtol=0.3)
    changes = np.abs(np.diff(deflections)) / np.abs(deflections[-1])
    assert changes[1] < changes[0] / 2 and changes[1] < 2e-3


VARIED = ("beam.hinges.0.position", "beam.hinges.0.rotational_stiffness", "loads.0.speed")
VARIED = (*VARIED, "loads.0.mass", "profile.height", "profile.start")


def test_gradients():
    """Known and traced runs agree; derivatives are differences, at times other than of passages."""
    case = dataclasses.replace(described("ramp over a hinge")[0], loads=[mass(0.4, speed=0.7)])
    times = np.linspace(0.0, 1.2, 4)
    plan, point = plan_of(case, 20), np.array([0.4, 0.5, 0.7, 0.4, 0.03, 0.2])

    def misfit(values):
        varied = replace(case, dict(zip(VARIED, values, strict=True)))
        return xp.sum(xp.cos(xp.arange(4.0))[:, None] * simulate_readings(varied, times, plan))

    found = jax.jit(jax.value_and_grad(misfit))(jnp.asarray(point))
    assert_allclose(found[0], misfit(point), rtol=1e-11)
    assert_allclose(found[1], central(misfit, point), rtol=1e-6)


def test_kink_of_a_settled_beam():
    """The part between a hinge and a settled end turns as a rigid body: the surface is a ramp."""
    beam = jb.Beam(**UNIT, modes=3, ends="clamped-free", hinges=[jb.Hinge(0.4)])
    common = {"loads": [mass(0.4, speed=0.7)], "run": jb.Run(1 / 0.7), "sensors": [jb.Sensor(0.47)]}
    settled = jb.Case(beam, supports=[jb.Support(1.0, settlement=0.06)], **common)
    ramp = jb.profiles.RampProfile(start=0.4, end=1.0, height=-0.06)
    expected = jb.simulate(jb.Case(beam, supports=[jb.Support(1.0)], profile=ramp, **common), TIMES)
    found = jb.simulate(settled, TIMES)
    scale = np.abs(expected.deflection).max()
    assert_allclose(found.deflection, expected.deflection, atol=1e-9 * scale)
    assert_allclose(found.contact_force, expected.contact_force, atol=1e-6)


@pytest.mark.parametrize(
    ("period", "tolerance"),
    [(4e-3, 4e-3), (None, 1e-5)],
    ids=["sampled", "continuous"],
)
def test_loops(period, tolerance):
    """Feedback of velocity to a force is a damper; at samples nearly so."""
    case = described("hinge")[0]
    place, gain = 0.6, 0.5
    case = dataclasses.replace(case, sensors=[jb.Sensor(place, "velocity")])
    damper = dataclasses.replace(case, actuators=[jb.SpringDamper(place, 0.0, gain)])
    law = jb.Feedback([gain], period=period)
    loop = dataclasses.replace(case, actuators=[PointForce(place)], controller=law)
    found, expected = (
        jb.simulate(one, TIMES, tolerance=1e-5).coordinates for one in (loop, damper)
    )
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize(
    "motion",
    [
        {"times": [0.0, 0.5, 1.0], "positions": [0.0, 0.2, 0.4]},
        {"times": [0.1, 0.5, 1.0], "positions": [0.4, 0.2, 0.1]},
        {"speed": 0.4, "deceleration": 0.2},
    ],
    ids=["to a kink", "leftwards from a kink", "braking to a kink"],
)
def test_start_and_stop_at_a_kink(motion):
    """A wheel that does not pass the kink takes no impulse, as one just short of it."""
    case = dataclasses.replace(hinge_with(3), loads=[mass(0.4, **motion)], run=jb.Run(1.4))
    short = replace(case, {"beam.hinges.0.position": 0.4 + side(motion) * 1e-6})
    records = [jb.simulate(one, TIMES) for one in (case, short)]
    found, expected = (record.coordinates for record in records)
    assert_allclose(found, expected, rtol=0, atol=2e-4 * np.abs(expected).max())


def side(motion):
    """1 where the load stays to the left of the kink, -1 where to its right."""
    places = motion.get("positions", [0.0])
    return 1.0 if min(places) < 0.4 else -1.0


def test_errors_of_close_samples_are_stated():
    """A passage over a hinge is a step of no length, which has no error."""
    case = jb.Case(HINGED, loads=[mass(0.4, speed=0.7)], sensors=[jb.Sensor(0.5)], run=jb.Run(1.5))
    record, rare = (jb.simulate(replace(case, {"run.sample_rate": rate})) for rate in (1000, 20))
    assert 0 < record.error_estimate < 1e-7
    assert_allclose(record.peak_deflection, rare.peak_deflection, rtol=1e-7)


@pytest.mark.parametrize("hinge", [0.4, 0.35])
def test_a_run_that_ends_at_a_kink_ends_behind_it(hinge):
    """Momentum: (1 + m s s^T) q' there is what the finite forces of the last instant left of it."""
    end = hinge / 0.7
    beam = dataclasses.replace(HINGED, hinges=[jb.Hinge(hinge, 0.5)])
    case = jb.Case(beam, loads=[mass(0.4, speed=0.7)], run=jb.Run(end))
    record = jb.simulate(case, np.array([end - 1e-9, end]))
    (before, after), q = record.motion.rates, record.coordinates[-1]
    left, right = (record.modes.shapes(hinge + side * 1e-9, 1) for side in (-1, 1))
    shape = record.modes.shapes(hinge)
    impulse = 0.4 * shape * (shape @ (before - after) + 0.7 * (left - right) @ q)
    assert_allclose(after - before, impulse, rtol=0, atol=1e-6 * np.abs(before).max())
    assert np.abs(after - before).max() > 1e-2 * np.abs(before).max()
