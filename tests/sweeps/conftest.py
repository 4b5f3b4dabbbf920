"""The C integrator for the test files that ask for it; the others sweep without."""

import pytest

from jaxbeam.integrator import native_peaks


@pytest.fixture(scope="module")
def c_integrator(tmp_path_factory):
    """The C integrator in a cache folder of a test file, all of whose sweeps may then use it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        native_peaks.LIBRARY.build()
        yield
