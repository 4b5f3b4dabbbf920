"""Feedback with gains scheduled over the mass of the load, and derivation of such gains."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.derived_gains import (
    BestGain,
    best_gains,
    equivalent_gains,
    scheduled_controller,
)
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.scheduled_feedback import ScheduledFeedback
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from tests.analysis.test_compare import critical_gain
from tests.loop_as_oracle import expected, span_of

PATCH = jb.Patch(
    0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0, limits=[-2.5, 7.5]
)
MASSES, GAINS = [0.2, 0.3, 0.6], [[1000.0, 4000.0, 2000.0]]


def beam_case(controller=None, mass=0.45, **run) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=2),
        actuators=[PATCH],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=mass, speed=2.0, entry_time=0.05)],
        controller=controller,
        run=jb.Run(**({"duration": 0.4, "sample_rate": 100.0} | run)),
    )


def law(**settings) -> ScheduledFeedback:
    return ScheduledFeedback(MASSES, GAINS, **({"period": 0.01} | settings))


# The law


def gains_at(controller, case, mass):
    """Gains (actuator,) of the law for a mass (kg)."""
    return controller.law(jb.state_space(case)).gains_at(jnp.asarray(mass))


def test_gains_by_interpolation_and_in_steps():
    two = ScheduledFeedback([0.2, 0.4], [[1.0, 3.0], [8.0, 4.0]], power=3)
    stepped = dataclasses.replace(two, between="stepped")
    for mass, line, steps in (
        (0.1, [1.0, 8.0], [1.0, 8.0]),
        (0.25, [1.5, 7.0], [1.0, 8.0]),
        (0.4, [3.0, 4.0], [3.0, 4.0]),
        (0.9, [3.0, 4.0], [3.0, 4.0]),
    ):
        assert_allclose(gains_at(two, beam_case(), mass), line, rtol=1e-14)
        assert_allclose(gains_at(stepped, beam_case(), mass), steps, rtol=1e-14)
    readings = jnp.array([-2.0, 0.5])
    law = two.law(jb.state_space(beam_case(mass=0.25)))
    measurement = Measurement(readings, jnp.zeros(0), jnp.zeros(2))
    command = law.step(law.initial_state(), measurement, 0.0).command
    assert_allclose(command, [1.5 * 8.0, -7.0 * 0.125], rtol=1e-14)


@pytest.fixture(scope="module")
def record():
    """Run with load identification from gates; sensors and gates have no error."""
    identification = jb.LoadIdentification(gates=[-0.1, -0.05], until=0.3)
    return jb.simulate(beam_case(law(load_identification=identification), mass=0.4))


def test_gain_before_and_after_the_mass_is_identified(record):
    """First for the lightest mass, then for that fitted to static deflections of two modes."""
    times, readings = np.asarray(record.times), np.asarray(record.measured)[:, 0]
    commands = np.append(0.0, np.asarray(record.command)[:-1, 0])  # before each sample
    span, share = span_of(record.case), (times - 0.05) * 2.0 / 0.6
    compliance = span.shapes(0.3) / span.frequencies**2
    force = 8.292e-4 * 0.32 * 200.0 * (span.shapes(0.2575, 1) - span.shapes(0.3425, 1))
    used = (share > 0) & (share < 0.3 - 1e-9)
    line = np.array([-compliance @ span.shapes(0.6 * x) for x in share[used]])
    deflection = readings[used] - (compliance @ force) * commands[used]
    mass = line @ deflection / (line @ line) / 9.81
    assert_allclose(mass, 0.4, rtol=0.15)
    gains = np.where(share < 0.3 - 1e-9, 1000.0, np.interp(mass, MASSES, GAINS[0]))
    expected_command = np.clip(-gains * readings, -2.5, 7.5)
    assert np.ptp(expected_command) > 0.5
    # Influence lines are interpolated between 201 positions: to (pi / 200)^2 / 8 of their size.
    assert_allclose(record.command[:, 0], expected_command, rtol=4e-5, atol=1e-12)


def test_mass_from_a_record_is_that_of_the_loop(record):
    """Compared by the gains of the law; without the commands of the record it differs."""
    identification = record.case.controller.load_identification
    times, readings = np.asarray(record.times), np.asarray(record.measured)[:, 0]
    after = (times - 0.05) * 2.0 / 0.6 > 0.3 + 1e-9

    def commands(mass):
        gains = np.interp(mass, MASSES, GAINS[0])
        return np.clip(-gains * readings[after], -2.5, 7.5)

    mass = jb.identified_load(record, identification).mass
    assert np.sum((commands(mass) < 7.5) & (commands(mass) > 0.1)) >= 3
    assert_allclose(record.command[after, 0], commands(mass), rtol=1e-10, atol=1e-12)
    without_commands = eqx.tree_at(lambda r: r.command, record, jnp.zeros_like(record.command))
    assert abs(jb.identified_load(without_commands, identification).mass / mass - 1) > 0.02


def test_case_file_keeps_the_controller():
    case = beam_case(
        law(between="stepped", load_identification=jb.LoadIdentification(gates=[-0.1, -0.05]))
    )
    check_case(case)
    assert case_to_dict(case)["controller"]["kind"] == "feedback-scheduled"
    assert eqx.tree_equal(case, case_from_dict(case_to_dict(case)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"loads": ()}, "kind needs a single load, with a mass"),
        (
            {
                "controller": law(
                    period=None, load_identification=jb.LoadIdentification(threshold=1e-4)
                )
            },
            "period",
        ),
        ({"controller": ScheduledFeedback([0.2], GAINS)}, "a gain for each of 1 masses, not 3"),
        ({"controller": ScheduledFeedback(MASSES, GAINS * 2)}, "for each of 1 actuators, not 2"),
        ({"controller": ScheduledFeedback([], [[]])}, "masses must list at least one"),
        (
            {"controller": law(load_identification=jb.LoadIdentification(threshold=1e-4))},
            "load_identification.threshold needs two sensors",
        ),
    ],
)
def test_errors_of_settings(change, words):
    with pytest.raises(ValueError, match=words):
        check_case(dataclasses.replace(beam_case(law()), **change))


# Derivation of gains


def test_printed_gains_follow_from_statics():
    """Fig. 6.7: 2 V/mm up to 0.345 kg, 3 up to 0.45, then 3.6, in place of 2 V/mm^3.

    The static deflection of a pinned beam is g L^3 / (48 E I) per kilogram; w = 1 mm, where k w = 2
    w^3 at k = 2, and w = 1.2247 mm at k = 3 give the masses, with the lift of a patch at midspan.
    """
    case = jb.replace(beam_case(), {"actuators.0.correction": 0.502})
    deflection_per_mass = 9.81 * 0.6**3 / (48 * 13.211)
    # A moment between 0.2575 m and its mirror image: w(L/2) is the integral of x M / (E I) from
    # the support to the middle.
    lift = 200.0 * 0.502 * 8.292e-4 * (0.3**2 - 0.2575**2) / 2 / 13.211
    masses = [(w + lift * 2e9 * w**3) / deflection_per_mass for w in (1e-3, np.sqrt(1.5) * 1e-3)]
    assert_allclose(masses, [0.344, 0.4486], atol=1e-3)
    assert_allclose(equivalent_gains(case, masses, 2e9), [[2000.0, 3000.0]], rtol=1e-6)
    assert_allclose(equivalent_gains(case, [0.509], 2e9), [[3596.0]], rtol=2e-3)


@pytest.fixture(scope="module")
def loop():
    return beam_case(jb.Feedback([1000.0], period=0.01))


def test_best_gain_has_the_lowest_peak_by_the_oracle(loop):
    """The peak at the samples, by scipy, is higher with a seventh less gain and with more."""
    light, heavy = best_gains(loop, [0.05, 0.2], 1e5)
    times = np.asarray(jb.simulate(loop).times)

    def peak(gain, mass):
        changed = jb.replace(loop, {"loads.0.mass": mass, "controller.gains.0": gain})
        return np.max(np.abs(expected(changed, times).deflection))

    for found in (light, heavy):
        lowest = peak(found.gain, found.mass)
        assert_allclose(found.peak, lowest, rtol=0.02)  # between samples it is a little higher
        assert found.peak < 0.95 * found.uncontrolled
        for other in (0.85, 1.18):
            assert peak(other * found.gain, found.mass) > lowest
    made = scheduled_controller(loop, [light, heavy], "stepped")
    assert_allclose(gains_at(made, loop, 0.1), [light.gain], rtol=1e-12)
    check_case(dataclasses.replace(loop, controller=made))


def test_best_gain_with_a_margin(loop):
    """Against the critical gain with the mass at rest, by scipy."""
    case = jb.replace(loop, {"loads.0.mass": 0.509})
    (found,) = best_gains(case, [0.509], 1e4, margin=2.0)
    critical = min(critical_gain(case, x) for x in np.linspace(0, 0.6, 13))
    assert found.gain <= critical / 2 * (1 + 1e-6)
    with pytest.raises(ValueError, match="the gain margin is below 1e"):
        best_gains(case, [0.509], 1e4, margin=1e6)


def test_other_controllers_are_refused():
    with pytest.raises(ValueError, match="kind 'feedback' with one power"):
        best_gains(beam_case(law()), [0.2], 1.0)
    with pytest.raises(ValueError, match="only 0 sensors for 1 actuators"):
        equivalent_gains(dataclasses.replace(beam_case(), sensors=()), [0.2], 1.0)
    with pytest.raises(ValueError, match="masses must increase"):
        scheduled_controller(
            beam_case(law()), [BestGain(mass, 1.0, 1.0, 1.0) for mass in (0.2, 0.1)]
        )
