"""The least peak under vehicles and varying forces: without commands that of the simulation."""

import dataclasses

import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb

BEAM = jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0, damping_ratio=0.01, modes=3)
LOADS = {
    "vehicle": jb.Oscillator(mass=0.2, stiffness=4e2, damping=2.0, wheel_mass=0.1, speed=2.0),
    "varying force": jb.VaryingForce(force=3.0, frequencies=[2.0], amplitudes=[0.5], speed=2.0),
}


def case_of(load, **parts) -> jb.Case:
    return jb.Case(
        BEAM,
        loads=[load],
        sensors=[jb.Sensor(1.0)],
        actuators=[jb.PointForce(1.0, limits=[-0.5, 0.5])],
        run=jb.Run(1.5, 200.0),
        **parts,
    )


@pytest.mark.parametrize("name", LOADS)
def test_the_uncontrolled_peak_is_that_of_the_simulation(name):
    case = case_of(LOADS[name])
    found = jb.bound(case, period=0.05, spacing=0.005)
    assert_allclose(found.uncontrolled, jb.simulate(case).peak_deflection[0], rtol=1e-6)
    assert 0.0 < found.peak < 0.9 * found.uncontrolled


def test_its_commands_attain_it_on_a_rough_surface():
    case = case_of(LOADS["vehicle"], profile=jb.profiles.SineProfile(2e-3, 0.5))
    found = jb.bound(case, period=0.05, spacing=0.005)
    level = jb.bound(dataclasses.replace(case, profile=None), period=0.05, spacing=0.005)
    assert abs(found.peak - level.peak) > 1e-3 * level.peak
    assert_allclose(found.uncontrolled, jb.simulate(case).peak_deflection[0], rtol=1e-6)
    controlled = jb.simulate(dataclasses.replace(case, controller=found.controller()))
    assert_allclose(controlled.peak_deflection[0], found.peak, rtol=2e-3)
    assert controlled.peak_deflection[0] > found.peak * (1 - 1e-5)


@pytest.mark.parametrize("settings", [{}, {"prediction": "time-varying"}])
def test_no_predictive_law_beats_it_on_a_rough_surface(settings):
    law = jb.MPC(horizon=10, moves=5, move_weight=1e-7, loads="known", period=0.05, **settings)
    case = case_of(LOADS["vehicle"], profile=jb.profiles.SineProfile(2e-3, 0.5), controller=law)
    found = jb.bound(case, spacing=0.005)
    record = jb.simulate(case)
    assert found.peak * (1 - 1e-5) < record.peak_deflection[0] < 0.9 * found.uncontrolled
