"""H-infinity control in the loop: its worst gain, found from readings and commands, and errors."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.h_infinity import minimax_law

SIZES = {"output_size": 2e-4, "command_size": 4.0, "force_size": 4.0, "noise_size": 1e-5}
LAW = jb.HInfinity(**SIZES, period=0.002)


def beam_case(law=LAW, **changes) -> jb.Case:
    parts = {
        "actuators": [jb.PointForce(0.25)],
        "sensors": [jb.Sensor(0.3)],
        "loads": [jb.MovingForce(force=4.0, speed=3.0)],
        "run": jb.Run(0.3, 500.0),
    }
    beam = jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2)
    return jb.Case(beam, controller=law, **(parts | changes))


@pytest.mark.parametrize("settings", [{}, {"delay": 0.0013}, {"corner": 20.0}], ids=str)
def test_gain_of_a_random_course_is_below_the_level(settings):
    """Two readings; energies over 400 samples of the sampled beam under the law."""
    noise = np.array([1e-5, 1e-2])
    law = jb.HInfinity([2e-4, 1.0], 4.0, 4.0, noise, period=0.002, **settings)
    plant = jb.state_space(beam_case(law, sensors=[jb.Sensor(0.3), jb.Sensor(0.2, "velocity")]))
    designed, level = law.design_law(plant), 1.05 * law.least_attenuation(plant)
    random, game = np.random.default_rng(4), law.game(plant)
    state, memory, command = np.zeros(len(game.A)), designed.initial_state(), np.zeros(1)
    energy_in = energy_out = 0.0
    for _ in range(400):
        force, error = random.normal(size=2), random.normal(size=2)
        readings = (game.C @ state + error) * noise
        step = designed.step(memory, Measurement(readings, np.zeros(4), command), 0.0)
        memory, command = step.state, step.command
        energy_out += state @ game.Q @ state + (command[0] / 4.0) ** 2
        energy_in += force @ force + error @ error
        state = game.A @ state + game.B @ command + game.E @ force
    assert 0.05 * level**2 * energy_in < energy_out < level**2 * energy_in


def test_closed_loop_of_python_control():
    """Poles are those of the design: the beam under the law, with what the law has in memory."""
    case = beam_case()
    plant = jb.state_space(case)
    game = LAW.game(plant)
    law = minimax_law(game, 1.05 * LAW.least_attenuation(plant))
    A, B, C = game[:3]
    states = np.block(
        [[A + B @ law.D @ C, B @ law.K], [law.G @ C + B @ law.D @ C, law.F + B @ law.K]]
    )
    found = jb.to_control(case).closed.poles()
    for pole in np.linalg.eigvals(states):
        assert np.min(np.abs(found - pole)) < 1e-8
    assert np.max(np.abs(found)) < 1


def test_game_is_the_sampled_beam():
    """Response to a held force at its place, from sine modes integrated exactly."""
    law = jb.HInfinity(**SIZES, period=0.002, positions=[0.2])
    game = law.game(jb.state_space(beam_case(law)))
    wave = np.arange(1, 3) * np.pi / 0.6
    omega, ratio = wave**2 * np.sqrt(12.0 / 0.5), 0.02
    damped = omega * np.sqrt(1 - ratio**2)
    decay = np.exp(-ratio * omega * 0.002)
    swing = np.cos(damped * 0.002) + ratio * omega / damped * np.sin(damped * 0.002)
    rise = (1 - decay * swing) / omega**2
    gain = 2 / (0.5 * 0.6) * np.sin(wave * 0.2) * np.sin(wave * 0.3)
    assert_allclose(game.C @ game.E, [[4.0 / 1e-5 * gain @ rise]], rtol=1e-9)


def test_loop_against_the_law_step_by_step():
    """Commands of a run are those of the law from its readings, limits included."""
    case = beam_case(actuators=[jb.PointForce(0.25, limits=[-0.5, 1.0])])
    record = jb.simulate(case)
    law = LAW.design_law(jb.state_space(case))
    memory, command, found = law.initial_state(), np.zeros(1), []
    for reading in np.asarray(record.controller_readings):
        step = law.step(memory, Measurement(reading, np.zeros(4), command), 0.0)
        memory, command = step.state, np.clip(step.command, -0.5, 1.0)
        found.append(command)
    assert_allclose(found, record.command, atol=1e-9)
    assert np.max(found) == 1.0


def test_forces_are_rejected_and_vibration_dies():
    free, held = jb.simulate(beam_case(None)), jb.simulate(beam_case())
    assert held.peak_deflection[0] < 0.5 * free.peak_deflection[0]
    late = np.asarray(held.times) > 0.26
    assert np.std(held.deflection[late]) < 0.1 * np.std(free.deflection[late])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"period": None}, "period must be given: kind 'h-infinity' acts at samples"),
        ({"delay": 0.002}, "delay must be less than the period"),
        ({"output_size": [1e-4, 1e-4]}, "output_size must be one number or 1, not 2"),
        ({"positions": [0.7]}, "controller.positions must lie on the beam"),
        ({"positions": [0.1, 0.2], "force_size": [1.0]}, "force_size must be one number or 2"),
        ({"noise_size": 0.0}, "controller.noise_size must be positive"),
    ],
)
def test_errors(settings, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(beam_case(jb.HInfinity(**SIZES | {"period": 0.002} | settings)))


def test_a_level_out_of_reach_names_the_least():
    case = beam_case(dataclasses.replace(LAW, attenuation=np.asarray(0.1)))
    least = LAW.least_attenuation(jb.state_space(case))
    with pytest.raises(ValueError, match=f"no law has a worst gain below {float(least):.6g}"):
        jb.simulate(case)


def test_accelerations_are_refused():
    case = beam_case(sensors=[jb.Sensor(0.3, "acceleration")])
    with pytest.raises(ValueError, match=re.escape("sensors.0 measures acceleration")):
        check_case(case)
