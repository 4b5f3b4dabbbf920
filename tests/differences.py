"""Derivatives by central differences, independent of automatic differentiation."""

import contextlib
import dataclasses
import os

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.oracles.crossing import Load


def central(function, point, step: float = 1e-3, order: int = 6) -> np.ndarray:
    """Jacobian of a function of a vector, (result..., entry), by central differences.

    The step is absolute. The error is step^order, plus rounding divided by the step.
    """
    weights = {2: (1 / 2,), 4: (2 / 3, -1 / 12), 6: (3 / 4, -3 / 20, 1 / 60)}[order]
    point, columns = np.asarray(point, float), []
    for i in range(point.size):
        unit = step * np.eye(point.size)[i]
        columns.append(
            sum(
                w * (np.asarray(function(point + n * unit)) - function(point - n * unit)) / step
                for n, w in enumerate(weights, 1)
            )
        )
    return np.stack(columns, axis=-1)


# Runs with the loads of an oracle and prescribed time steps.


def load_of(load: Load):
    """Load of a case from that of an oracle."""
    kind = {"mass": jb.MovingMass, "force": jb.MovingForce}[load.kind]
    return kind(
        mass=load.mass,
        speed=load.speed,
        entry_time=load.entry_time,
        deceleration=load.deceleration,
    )


def plan_of(
    case: jb.Case, substeps: int = 12, even: bool = True, max_loads: int | None = None
) -> IntegrationPlan:
    """Integration plan with a given number of steps between samples, without a trial run."""
    shapes = static_shapes(case)
    shapes = dataclasses.replace(shapes, max_loads=max_loads or shapes.max_loads)
    return IntegrationPlan(shapes, substeps, lead_samples=0, equally_spaced=even, error=0.0)


def assert_close(found, expected, tolerance: float) -> None:
    """Agreement relative to the largest expected value."""
    expected = np.asarray(expected)
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))


# Compiling with optimisations, for programs whose run time in a test outweighs compiling.

NO_OPTIMISATION = "--xla_backend_optimization_level=0"  # set in `conftest`


@contextlib.contextmanager
def well_compiled():
    """Context in which the library's programs are compiled with the optimisations it asks for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"].replace(NO_OPTIMISATION, ""))
        yield
