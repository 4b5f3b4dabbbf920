"""Compiling with optimisations, for programs whose run time in a test outweighs compiling."""

import contextlib
import os

import pytest

NO_OPTIMISATION = "--xla_backend_optimization_level=0"  # set in `conftest`


@contextlib.contextmanager
def well_compiled():
    """Context in which the library's programs are compiled with the optimisations it asks for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"].replace(NO_OPTIMISATION, ""))
        yield
