"""Feedback with gains scheduled over the mass of the load."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedback import ScheduledFeedback
from jaxbeam.control.load_identification import identified_load
from tests.loop_as_oracle import span_of

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

    mass = identified_load(record, identification).mass
    assert np.sum((commands(mass) < 7.5) & (commands(mass) > 0.1)) >= 3
    assert_allclose(record.command[after, 0], commands(mass), rtol=1e-10, atol=1e-12)
    without_commands = eqx.tree_at(lambda r: r.command, record, jnp.zeros_like(record.command))
    assert abs(identified_load(without_commands, identification).mass / mass - 1) > 0.02


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
