"""Peaks of runs end after the last exit where nothing can raise them; late peaks are found."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.integrator import integrate

# Frequencies have no common period: modes that hardly decay come together long after the exit.
BEAM = jb.Beam(25.0, 30e9, 15e3, damping_ratio=2e-5, modes=4)
CASE = jb.Case(
    BEAM,
    supports=[jb.Support(8.0, stiffness=3e8)],
    sensors=[jb.Sensor(17.0), jb.Sensor(11.0, "acceleration")],
    loads=[jb.MovingMass(mass=2e3, speed=300.0)],
    run=jb.Run(3.0, sample_rate=50.0),
)
RIGIDITIES = [30e9, 33e9]


def test_late_peaks_are_those_of_whole_runs():
    found = jb.sweep(CASE, {"beam.flexural_rigidity": RIGIDITIES}, progress=False)
    for i, rigidity in enumerate(RIGIDITIES):
        record = jb.simulate(jb.replace(CASE, {"beam.flexural_rigidity": rigidity}))
        largest = np.maximum(record.largest, -record.smallest)
        times = np.where(largest > record.largest, record.smallest_time, record.largest_time)
        peaks = found.peak_deflection.values[i, 0], found.peak_acceleration.values[i, 1]
        assert peaks == pytest.approx(largest, rel=1e-7)
        assert found.peak_time.values[i] == pytest.approx(times, abs=1e-6)
        assert (times > 5 * 25.0 / 300.0).any()


def test_steps_end_after_the_exit_where_nothing_can_come(monkeypatch):
    """A slow load has its peak on the beam; free vibration of 500 crossings is not integrated."""
    ends, chunk_of = [], integrate._chunk_function

    def recorded(*arguments, **options):
        chunk, steps = chunk_of(*arguments, **options)

        def one(*state):
            found = chunk(*state)
            ends.append(float(found[3]))
            return found

        return one, steps

    monkeypatch.setattr(integrate, "_chunk_function", recorded)
    slow = jb.MovingMass(mass=2e3, speed=25.0)
    case = dataclasses.replace(
        CASE,
        beam=dataclasses.replace(BEAM, damping_ratio=0.01),
        loads=[slow],
        run=jb.Run(500.0, sample_rate=1.0),
    )
    jb.sweep(case, {"beam.flexural_rigidity": RIGIDITIES}, progress=False)
    assert 1.0 <= max(ends) < 5.0
