"""Faults put into a clean log are found at their samples, and nowhere else."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from tests.tuning.small_rig import rig
from tuning import Log
from tuning.logs import find_faults, mask
from tuning.logs.pairing import case_of_log, check_loads, pad_cases

TIMES = np.arange(600) / 500
CLEAN = np.column_stack([np.sin(12 * TIMES) * np.exp(-TIMES), np.cos(20 * TIMES)])


def log_of(values=None, times=TIMES, noise=1e-3):
    values = CLEAN if values is None else values
    values = values + noise * np.random.default_rng(0).normal(size=values.shape)
    return Log(times, values, ("a", "b"), ("deflection",) * 2, ("m",) * 2, "run.csv")


def changed(samples, to, log=None):
    """The log with samples of its first channel set to something."""
    log = log or log_of()
    values = np.array(log.values)
    values[samples, 0] = to
    return dataclasses.replace(log, values=values)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.05])
def test_a_clean_log_has_no_faults(noise):
    assert find_faults(log_of(noise=noise)) == []
    steps = np.where(TIMES > 0.5, CLEAN.T, 0.0).T  # a sudden onset is no fault
    assert [f.kind for f in find_faults(log_of(steps, noise=1e-3))] == []
    coarse = np.round(CLEAN / 0.05) * 0.05
    assert find_faults(log_of(coarse, noise=0.0)) == []


def test_spikes():
    (fault,) = find_faults(changed([100, 300], [3.0, -2.0]))
    assert (fault.kind, fault.channel) == ("spikes", "a")
    assert np.flatnonzero(fault.samples).tolist() == [100, 300]
    assert str(fault) == "run.csv: a has spikes (2 samples), first at t = 0.2 s"


def test_ringing_after_an_impact_is_no_spike():
    """Faster than cubics, as a roller on a footbridge, but longer than a single sample."""
    after = np.maximum(TIMES - 0.4, 0.0)
    ringing = np.exp(-5 * after) * np.sin(2 * np.pi * 90 * after)
    assert find_faults(log_of(np.column_stack([ringing, ringing]))) == []


def test_clipped_readings():
    log = log_of()
    values = np.array(log.values)
    values[:, 1] = np.clip(values[:, 1], -0.7, 0.9)
    (fault,) = find_faults(dataclasses.replace(log, values=values))
    assert (fault.kind, fault.channel) == ("saturation", "b")
    clipped = (log.values[:, 1] > 0.9) | (log.values[:, 1] < -0.7)
    assert np.mean(fault.samples[clipped]) > 0.7 and not np.any(fault.samples[~clipped])


def test_a_stuck_channel():
    (fault,) = find_faults(changed(slice(400, 500), 0.123))
    assert fault.kind == "stuck" and np.flatnonzero(fault.samples).tolist() == [*range(400, 500)]


def test_gaps_and_a_drifting_clock():
    indices = np.r_[:200, 230:600]
    (gap,) = find_faults(log_of(CLEAN[indices], TIMES[indices]))
    assert gap.message == "run.csv: about 30 samples are missing after t = 0.398 s"
    drifting_times = TIMES + 0.004 * (TIMES / 1.2) * (1 - TIMES / 1.2) * 4
    (drift,) = find_faults(log_of(times=drifting_times))
    assert "the clock drifts: midway the times are 2 steps" in drift.message
    assert find_faults(log_of(times=np.round(TIMES, 3))) == []


def test_masking_is_on_request_and_noted():
    log = changed(100, 3.0, changed(slice(400, 500), 0.123))
    masked = mask(log, ["spikes"])
    assert np.flatnonzero(~masked.valid[:, 0]).tolist() == [100] and masked.valid[:, 1].all()
    assert masked.notes == ("1 samples of a are left out (spikes)",)
    np.testing.assert_array_equal(masked.values, log.values)
    assert [fault.kind for fault in find_faults(masked)] == ["stuck"]
    assert np.sum(~mask(masked, ["stuck"]).valid) == 101
    with pytest.raises(
        ValueError, match="'gaps' cannot be masked; dropouts, spikes, saturation, stuck can"
    ):
        mask(log, ["gaps"])


# Logs matched with cases: loads that must have crossed, or stay on the beam.

SHAKEN_TIMES = np.linspace(0.0, 0.5, 51)
LOG = Log(SHAKEN_TIMES, np.zeros((51, 1)), ("w",), ("deflection",), ("m",), "run.csv")


def case_with(load) -> jb.Case:
    """The small rig without its controller, crossed by a load."""
    return dataclasses.replace(rig(), controller=None, loads=(load,))


def test_a_load_that_stops_on_the_beam_need_not_leave_it():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5, deceleration=5.0)))


def test_a_load_that_leaves_the_beam_must_do_so_within_the_log():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5)))
    with pytest.raises(ValueError, match="before the first load has crossed at 0.6 s"):
        check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.0)))


@pytest.fixture
def shaken_beside_a_spring() -> tuple[jb.Case, Log]:
    """A spring before the patch, and a log of the patch's voltage."""
    rig = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
        actuators=[
            jb.SpringDamper(0.5, stiffness=3000.0, damping=5.0),
            jb.Patch(0.2, 0.3, 0.15, limits=(-3.0, 3.0)),
        ],
        sensors=[jb.Sensor(0.3)],
    )
    times = np.arange(5) * 0.01
    values = np.stack([np.zeros(5), [0.0, 1.0, 2.0, 1.0, 0.5]], axis=1)
    columns = ("w", "u"), ("deflection", "voltage"), ("m", "V"), "shaking"
    return rig, Log(times, values, *columns, loads=(), sensors=(0, None), actuators=(None, 1))


def test_springs_take_no_logged_command(shaken_beside_a_spring):
    rig, log = shaken_beside_a_spring
    times = np.arange(7) * 0.01
    shaken = case_of_log(rig, log, times)
    check_case(shaken)
    np.testing.assert_array_equal(shaken.controller.values, [[0.0, 1.0, 2.0, 1.0, 0.5, 0.5, 0.5]])
    idle, _ = pad_cases([rig, shaken], [times, times])
    check_case(idle)
    assert np.all(idle.controller.values == np.zeros((1, 7)))
    # As a shaker of that suspension with zero volts: the same deflections.
    shaker = jb.Shaker(0.5, stiffness=3000.0, damping=5.0)
    other = dataclasses.replace(rig, actuators=(shaker, rig.actuators[1]))
    run, expected = (jb.simulate(case_of_log(c, log, log.times)) for c in (rig, other))
    np.testing.assert_allclose(
        run.deflection, expected.deflection, rtol=0, atol=1e-12 * np.abs(expected.deflection).max()
    )


def test_a_command_to_a_spring_is_refused(shaken_beside_a_spring):
    rig, log = shaken_beside_a_spring
    wrong = dataclasses.replace(log, actuators=(None, 0))
    with pytest.raises(ValueError, match="u is the command to actuators.0, a spring, which takes"):
        case_of_log(rig, wrong, log.times)
