"""Run-up of vehicles on rough roads: decay by hand, peaks that do not depend on the start."""

import dataclasses

import numpy as np
import pytest
import scipy

import jaxbeam as jb
from jaxbeam.analysis.critical_speeds import decay_rates, run_up, with_run_up
from jaxbeam.cli.commands.sweep import _with_run_up

CAR = jb.QuarterCar(
    speed=20.0,
    body_mass=17000.0,
    axle_mass=600.0,
    suspension_stiffness=4e5,
    suspension_damping=1e4,
    tyre_stiffness=1.75e6,
)
CASE = jb.Case(
    jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.02, modes=3),
    sensors=[jb.Sensor(10.0)],
    loads=[CAR],
    profile=jb.profiles.ISO8608Profile("C", seed=2),
    run=jb.Run(1.5, sample_rate=200.0),
)


def test_decay_of_a_quarter_car_by_its_matrices():
    m, c = np.diag([17000.0, 600.0]), 1e4 * np.array([[1, -1], [-1, 1]])
    k = np.array([[4e5, -4e5], [-4e5, 4e5 + 1.75e6]])
    inverse = np.linalg.inv(m)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ k, -inverse @ c]])
    rate = -scipy.linalg.eigvals(A).real.max()
    assert decay_rates(CASE) == [pytest.approx(rate, rel=1e-9)]
    assert run_up(CASE, 0.02)[0] == pytest.approx(20.0 * np.log(50.0) / rate, rel=1e-9)
    assert run_up(CASE, 0.02, [10.0, -30.0])[0] == pytest.approx(1.5 * run_up(CASE, 0.02)[0])


@pytest.mark.parametrize("speed", [20.0, -20.0])
def test_peaks_do_not_depend_on_the_start(speed):
    """Half a per mille of the motion left changes no peak by a per mille; at the end it does."""
    case = dataclasses.replace(CASE, loads=[dataclasses.replace(CAR, speed=speed)])
    far, farther = (with_run_up(case, share) for share in (5e-4, 1e-5))
    peaks = [float(jb.simulate(one).peak_deflection[0]) for one in (case, far, farther)]
    assert peaks[1] == pytest.approx(peaks[2], rel=1e-3)
    assert abs(peaks[0] / peaks[2] - 1) > 1e-3
    assert float(far.run.duration) > 1.5 + run_up(case, 5e-4)[0] / 20.0


def test_speeds_of_a_sweep():
    """The fastest one decides on the distance, the slowest on the duration."""
    found = _with_run_up(CASE, {"loads.0.speed": ["36 km/h", "90 km/h"], "profile.seed": [1]})
    start = 10.0 + run_up(CASE, speeds=[25.0])[0]
    assert found.loads[0].start_position == pytest.approx(-start)
    assert found.profile.switch_on == pytest.approx([-start, 10.0 - start])
    assert float(found.run.duration) == pytest.approx(1.5 + start / 10.0)


def test_loads_that_need_none_and_refusals():
    force = dataclasses.replace(CASE, loads=[jb.MovingForce(force=1e3, speed=20.0)])
    assert with_run_up(force) is force
    stiff = dataclasses.replace(CAR, suspension_damping=0.0)
    with pytest.raises(ValueError, match=r"loads\.0 never forgets how it started"):
        with_run_up(dataclasses.replace(CASE, loads=[stiff]))
    both = [CAR, dataclasses.replace(CAR, speed=-20.0)]
    with pytest.raises(ValueError, match="enter at both ends"):
        with_run_up(dataclasses.replace(CASE, loads=both))
    with pytest.raises(ValueError, match="share lies between"):
        run_up(CASE, 1.0)
