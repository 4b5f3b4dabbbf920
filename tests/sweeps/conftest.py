"""The C integrator is compiled before the sweeps of the tests."""

import pytest

from jaxbeam.integrator import native_peaks


@pytest.fixture(scope="session", autouse=True)
def c_integrator():
    """Without it small sweeps run in NumPy until another test process has compiled it.

    Their last bits would then differ within a test that compares them.
    """
    with native_peaks.LIBRARY.built_meanwhile():
        pass
