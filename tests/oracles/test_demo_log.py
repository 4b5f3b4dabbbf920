"""The committed demo logs are those that the finite-element model makes."""

import numpy as np
import pytest

from tests.oracles import make_demo_log
from tests.oracles.make_demo_log import DEMO, NOISE, SAMPLING, measure, truth


@pytest.mark.parametrize("name", SAMPLING)
def test_a_demo_log_is_small_and_has_units(name):
    path = DEMO / f"{name}.csv"
    assert path.stat().st_size < 60_000
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "time [s],d1 [mm],d2 [mm],d3 [mm]"


def test_making_the_demo_logs_again_gives_the_committed_numbers():
    for name, table in make_demo_log.make().items():
        committed = np.loadtxt(DEMO / f"{name}.csv", delimiter=",", skiprows=1)
        # Printed digits, and a little for another platform's last bits.
        np.testing.assert_allclose(table, committed, rtol=0, atol=0.51e-4)


def test_the_nominal_number_of_modes_is_enough_for_the_noise():
    """The error of the modes that the model neglects is far below the noise of a reading."""
    rig, logs = truth()
    few, many = (
        measure(rig, logs["log_2"]["loads"], *SAMPLING["log_2"], modes=modes)
        for modes in (rig["beam"]["modes"], make_demo_log.MODES)
    )
    assert np.abs(few - many).max() < 0.2 * NOISE
