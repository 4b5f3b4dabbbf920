"""Logs of different kinds in one fit: a crossing without control, and a patch that excites."""

import dataclasses

import numpy as np
import pytest
import scipy.signal

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.tuning.finite_element_rigs import NOISE, RATE, Plant, patch, plant
from tuning import Log, identify
from tuning.logs.pairing import pad_cases


@pytest.fixture(scope="module")
def rig() -> Plant:
    """A beam of finite elements with a patch; accelerations need all modes of the plant."""
    sensors = [(0.2,), (0.35, "acceleration")]
    beam = plant(1, 13.211, 0.812, [patch(0.2575, 0.32)], [], {}, sensors, 4, "pinned-pinned")
    return dataclasses.replace(beam, modes=4)


def crossing_and_shaking(rig: Plant) -> list[Log]:
    """The deflection while a mass crosses, and the acceleration while the patch is driven."""
    noise = np.random.default_rng(0)
    times = np.arange(round(0.5 * RATE)) / RATE
    crossing = rig.readings(times, np.zeros((times.size, 1)))[:, :1]
    crossing = crossing + NOISE["deflection"] * noise.normal(size=crossing.shape)
    voltage = 2.0 * scipy.signal.chirp(times, 2.0, times[-1], 30.0)[:, None]
    shaken = rig.readings(times, voltage, loaded=False)[:, 1:]
    shaken = shaken + NOISE["acceleration"] * noise.normal(size=shaken.shape)
    return [
        Log(times, crossing, ("w",), ("deflection",), ("m",), "crossing", sensors=(0,)),
        Log(
            times,
            np.column_stack([shaken, voltage]),
            ("a", "u"),
            ("acceleration", "voltage"),
            ("m/s^2", "V"),
            "shaking",
            loads=(),
            sensors=(1, None),
            actuators=(None, 0),
        ),
    ]


def test_one_rig_fitted_to_both_logs(rig):
    start = {address: 1.06 * value for address, value in rig.truth.items()}
    fit = identify(replace(rig.case, start), crossing_and_shaking(rig), list(start))
    assert np.all(np.isfinite(fit.errors))
    deviations = (fit.values - list(rig.truth.values())) / fit.errors
    assert np.all(np.abs(deviations) < 3), dict(zip(rig.truth, deviations, strict=True))
    # Either log alone determines rigidity and correction of the patch less well.
    assert np.all(fit.errors / fit.values < [0.01, 0.03, 0.2, 0.03])


def test_cases_are_padded_without_effect(rig):
    times = np.linspace(0.0, 0.5, 6)
    table = jb.MovingMass(mass=0.3, times=[0.1, 0.4], positions=[0.0, 0.6])
    both = dataclasses.replace(rig.case, loads=(*rig.case.loads, table))
    driven = jb.Prescribed(np.zeros(1), times=times, values=np.ones((1, 6)))
    empty = dataclasses.replace(rig.case, loads=(), controller=driven)
    crossed, shaken = pad_cases([both, empty], [times, times])
    assert crossed.loads == both.loads and not np.any(crossed.controller.values)
    assert np.all(shaken.controller.values == 1.0)
    first, second = shaken.loads
    assert first.entry_time == 1.0 and float(second.times[0]) == 1.0
    assert float(second.times[1] - second.times[0]) == pytest.approx(0.3)
