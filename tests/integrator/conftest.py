"""The C integrator, compiled once for the tests of a process."""

import pytest

from jaxbeam.integrator import native_peaks


@pytest.fixture(scope="session")
def native_cache(tmp_path_factory):
    """A cache folder with the compiled C integrator."""
    folder = str(tmp_path_factory.mktemp("cache"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", folder)
        native_peaks.LIBRARY.build()
    return folder
