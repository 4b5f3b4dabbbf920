"""Peaks that dampers attain against all sequences of rates in a modal equation written here."""

import dataclasses
import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

import jaxbeam as jb
from jaxbeam.analysis.bound.dampers import damper_peak
from jaxbeam.analysis.compare import compare

L, EI, MASS, DAMPING, FORCE, SPEED = 20.0, 6e9, 9e3, 0.01, 3e5, 40.0
DAMPER, SENSOR, LEAST, MOST = 8.0, 11.0, 2e4, 9e5  # m, N s/m
PERIOD, HOLDS, PARTS = 0.1, 6, 20
CASE = jb.Case(
    jb.Beam(L, EI, MASS, damping_ratio=DAMPING, modes=1),
    actuators=[jb.PointForce(DAMPER)],
    sensors=[jb.Sensor(DAMPER, "velocity"), jb.Sensor(SENSOR)],
    loads=[jb.MovingForce(force=FORCE, speed=SPEED)],
    controller=jb.SemiActive(LEAST, MOST, desired=jb.Feedback([5e6]), period=PERIOD),
    run=jb.Run(HOLDS * PERIOD, sample_rate=PARTS / PERIOD),
)


def transitions():
    """Matrices of the mode over a part of a hold, on and off the beam: q, q', sin, cos, force."""
    omega, turn = (np.pi / L) ** 2 * np.sqrt(EI / MASS), np.pi * SPEED / L
    modal_mass = MASS * L / 2
    found = []
    for load in (-FORCE / modal_mass, 0.0):
        A = np.zeros((5, 5))
        A[0, 1], A[1, 0], A[1, 1] = 1.0, -(omega**2), -2 * DAMPING * omega
        A[1, 2], A[1, 4] = load, np.sin(np.pi * DAMPER / L) / modal_mass
        A[2, 3], A[3, 2] = turn, -turn
        found.append(expm(A * PERIOD / PARTS))
    return found


def runs(damper_force):
    """Deflections at the sensor (sample, run); the force is a function of hold and velocity."""
    on_beam, off_beam = transitions()
    shapes = np.sin(np.pi * np.array([DAMPER, SENSOR]) / L)
    state = np.array([0.0, 0.0, 0.0, 1.0, 0.0])[:, None]
    deflection = []
    for k in range(HOLDS):
        force = damper_force(k, shapes[0] * state[1])
        state = np.concatenate(
            [np.broadcast_to(state[:4], (4, force.size)), np.atleast_2d(force)], axis=0
        )
        for part in range(PARTS):
            crossing = SPEED * (k + part / PARTS) * PERIOD < L * (1 - 1e-9)
            state = (on_beam if crossing else off_beam) @ state
            deflection.append(shapes[1] * state[0])
    return np.array(deflection)


def test_no_sequence_of_rates_has_a_smaller_peak():
    found = damper_peak(CASE, positions=[SENSOR])
    rates = np.array(list(itertools.product(np.geomspace(LEAST, MOST, 6), repeat=HOLDS)))
    everything = np.abs(runs(lambda k, velocity: -rates[:, k] * velocity)).max(axis=0)
    assert found.peak <= everything.min() * (1 + 1e-9)
    assert found.peak > 0.9 * everything.min()  # rates between those of the table gain little

    velocities = []

    def given(k, velocity):
        velocities.append(float(velocity[0]))
        return found.forces[k]

    assert_allclose(np.abs(runs(given)).max(), found.peak, rtol=1e-6)
    ratio = -found.forces[1:, 0] / np.array(velocities[1:])  # at rest there is no force
    assert np.all((ratio > LEAST * (1 - 1e-5)) & (ratio < MOST * (1 + 1e-5)))
    without = np.abs(runs(lambda k, velocity: np.zeros(1))).max()
    assert_allclose(found.uncontrolled, without, rtol=1e-6)


def test_a_comparison_says_what_the_dampers_attain():
    free = dataclasses.replace(CASE, controller=None)
    laws = {
        "clipped": CASE.controller,
        "constant": dataclasses.replace(CASE.controller, min_damping=MOST),
    }
    found = compare(free, laws)
    clipped = found.damper_peaks["clipped"]
    assert found.bound.peak < clipped.peak < found.metrics["clipped"].peak
    assert clipped.peak <= found.damper_peaks["constant"].peak * (1 + 1e-9)
    assert f"clipped: {clipped.verdict}; the law achieves " in " ".join(found.remarks)
    without_effect = dataclasses.replace(CASE.controller, min_damping=0.0, max_damping=0.0)
    none = compare(free, {"none": without_effect})
    assert none.damper_summary("none") == none.damper_peaks["none"].verdict
    assert none.damper_peaks["none"].peak == none.damper_peaks["none"].uncontrolled
    # A damper of one rate has one run.
    constant = found.damper_peaks["constant"]
    assert_allclose(constant.peak, found.metrics["constant"].peak, rtol=1e-3)


def test_a_comparison_says_why_no_peak_of_dampers_is_found():
    """It left them out without a word. At 1 cm/s the smallest rate takes a thousand times 8 N."""
    weak = [jb.PointForce(DAMPER, limits=[-8.0, 8.0])]
    case = dataclasses.replace(CASE, controller=None, actuators=weak)
    stiff = dataclasses.replace(CASE.controller, min_damping=8e5)
    found = compare(case, {"stiff": stiff})
    assert found.damper_peaks["stiff"].endswith("raise the limits, or lower min_damping")
    assert "stiff: no peak that its dampers attain: no forces" in " ".join(found.remarks)


def test_long_runs_have_longer_holds_and_other_laws_are_refused():
    law = dataclasses.replace(CASE.controller, period=0.002)
    found = damper_peak(dataclasses.replace(CASE, controller=law))
    assert found.times.size <= 200 and found.period == pytest.approx(0.004)
    with pytest.raises(ValueError, match="controller must be of kind semi-active"):
        damper_peak(dataclasses.replace(CASE, controller=jb.Feedback([1.0])))
