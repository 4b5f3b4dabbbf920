"""Schedules: everything due happens at its own time, and memories are long enough for it."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose

from jaxbeam.integrator.events import merged, sampled, stacked

MILLI = 1e-3


@given(
    period=st.integers(1, 40),
    delay=st.integers(0, 90),
    clock=st.integers(1, 40),
    late=st.integers(0, 90),
    spacing=st.integers(1, 50),
)
def test_commands_and_readings_come_when_they_are_due(period, delay, clock, late, spacing):
    """Followed edge by edge with plain lists, in whole milliseconds."""
    end = 200 // spacing * spacing
    samples = MILLI * np.arange(0, end + 1, spacing)
    ticks, clocks = MILLI * np.arange(0, end + 1, period), MILLI * np.arange(0, end + 1, clock)
    knot = np.array([0.0777])
    found = merged(samples, ticks, MILLI * delay, [clocks], [MILLI * late], knot)
    times = np.asarray(found.times)
    assert np.all(np.diff(times) > 0) and times[0] == 0 and times[-1] == samples[-1]
    assert_allclose(times[np.asarray(found.samples)], samples, rtol=0, atol=0)
    assert (samples[-1] >= 0.0777) == np.any(np.abs(times - 0.0777) < 1e-12)
    gaps = np.asarray(found.lengths)[np.asarray(found.gaps)]
    assert_allclose(gaps, np.diff(times), rtol=0, atol=1e-10)

    made, seen = [], [("rest", -1)] * (found.newest + 1)
    for edge, time in enumerate(times):
        now = time / MILLI
        number = int(found.reads[edge, 0])
        if number >= 0:
            assert_allclose(number * clock - late, now, atol=1e-6)
            seen.insert(0, ("read", number))
        if found.tick[edge] >= 0:
            assert_allclose(int(found.tick[edge]) * period, now, atol=1e-6)
            made.insert(0, int(found.tick[edge]))
        arrived = int(np.floor(now / clock + 1e-6))
        expected = ("read", arrived) if arrived * clock - late >= 0 else ("rest", -1)
        assert found.age[edge, 0] <= found.newest
        assert seen[int(found.age[edge, 0])] == expected
        begins = int(found.apply[edge])
        if begins >= 0:
            assert begins <= found.waiting
            assert_allclose(made[begins] * period + delay, now, atol=1e-6)
    assert np.sum(np.asarray(found.tick) >= 0) == ticks.size
    assert np.sum(np.asarray(found.apply) >= 0) == np.sum(
        ticks + MILLI * delay <= end * MILLI + 1e-9
    )


def test_schedules_of_one_shape_are_stacked():
    two = [sampled(jnp.linspace(0, end, 5), even) for end, even in ((1.0, True), (2.0, False))]
    whole = stacked(two)
    assert whole.times.shape == (2, 5) and whole.lengths.shape == (2, 4)
    with pytest.raises(ValueError, match="differ in the number of their edges"):
        stacked([two[0], sampled(jnp.linspace(0, 1, 4), True)])
