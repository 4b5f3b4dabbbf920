"""Forces of a shaker under inner loops, from those of its voltage by the algebra of feedback."""

import numpy as np
from numpy.testing import assert_allclose

import jaxbeam as jb
from experiments.studies.shaker_drives import LOOPS, drive
from experiments.thesis.cases import data_physics_v4
from jaxbeam import rigs


def test_force_under_a_force_loop():
    """F / f = H C / (1 + H C), H the force per voltage of eq. (2.34), C the law of the loop."""
    frequencies, beam = np.array([2.0, 20.0, 27.0, 90.0]), rigs.load("A").beam
    pair = [("actuators.0", "actuators.0.transmitted_force")]

    def force(shaker):
        case = jb.Case(beam, actuators=[shaker])
        return np.asarray(jb.frequency_response(case, frequencies, pair).values)[:, 0]

    bandwidth, s = 2e3, 2j * np.pi * frequencies
    open_loop = force(data_physics_v4()) * bandwidth / 4.2 * (5e-5 + 0.82 / s)
    coil = (0.5, 0.82, 5e-5, 4.2, 4.2, 0.02, 9700.0, 0.55)
    closed = force(jb.Electrodynamic(*coil, inner_loop=jb.ForceLoop(bandwidth=bandwidth)))
    assert_allclose(closed, open_loop / (1 + open_loop), rtol=1e-9)


def test_what_the_page_says():
    by_voltage, by_current, _, by_force, _ = (drive(loop) for loop in LOOPS.values())
    assert 9 < by_voltage.precise_to < 10 and by_force.precise_to == 100
    assert_allclose([by_voltage.damping, by_force.damping], [0.089, 0.033], atol=5e-4)
    assert by_current.largest > 3 * by_voltage.largest
    assert by_current.damping < by_voltage.damping
