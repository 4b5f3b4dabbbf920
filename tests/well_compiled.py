"""Programs that run so long in a test that they repay to be compiled as well as for users."""

import contextlib
import os

import pytest

ROUGHLY = "--xla_backend_optimization_level=0"  # of `conftest`


@contextlib.contextmanager
def well_compiled():
    """The library's own programs that are compiled within get the optimisations it asks for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"].replace(ROUGHLY, ""))
        yield
