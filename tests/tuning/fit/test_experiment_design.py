"""The best position of a sensor, against modal equations and differences on a grid."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from tests.oracles import modal_equations
from tests.oracles.loads import Load
from tuning.fit.experiment_design import design_experiment

SPAN = modal_equations.Span(0.6, 11.68, 0.535, modes=2, damping_ratio=0.03)
CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03,
            modes=2),
    sensors=[jb.Sensor(0.12)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.02)],
    run=jb.Run(duration=0.4, sample_rate=200.0),
)  # fmt: skip
FREE = ["beam.flexural_rigidity", "beam.mass_per_length"]


def errors_by_differences(positions, noise):
    """Standard errors of rigidity and mass per length, by position of one sensor."""
    times = np.arange(81) / 200.0

    def respond(**changes):
        span = dataclasses.replace(SPAN, **changes)
        return modal_equations.respond(span, [Load(0.5, 2.0, 0.02)], positions, times).deflection

    step = 1e-4
    slopes = np.stack([
        (respond(**{name: value * (1 + step)}) - respond(**{name: value * (1 - step)}))
        / (2 * step * value)
        for name, value in (("flexural_rigidity", 11.68), ("mass_per_length", 0.535))
    ], axis=-1)  # fmt: skip
    information = np.einsum("tpi,tpj->pij", slopes, slopes) / noise**2
    return np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))


def test_the_best_sensor_position_for_the_mass():
    bounds = (0.05, 0.55)
    design = design_experiment(
        CASE, FREE, {"sensors.0.position": bounds}, target=FREE[1], noise=2e-5
    )
    positions = np.linspace(*bounds, 101)
    grid = errors_by_differences(positions, 2e-5)
    np.testing.assert_allclose(
        design.errors_before, errors_by_differences(np.array([0.12]), 2e-5)[0], rtol=1e-3
    )
    best = int(np.argmin(grid[:, 1]))
    assert design.after[0] == pytest.approx(positions[best], abs=0.005)
    assert design.errors_after[1] == pytest.approx(grid[best, 1], rel=2e-3)
    assert design.errors_after[1] < design.errors_before[1]
    near = errors_by_differences(np.array([0.1195, 0.1205]), 2e-5)[:, 1]
    assert design.error_sensitivities[1, 0] == pytest.approx(
        np.diff(np.log(near))[0] / 1e-3, rel=0.02
    )
    assert str(design).startswith("sensors.0.position: 0.12 -> ")
    assert float(design.case.sensors[0].position) == design.after[0]


@pytest.mark.parametrize(
    "given, words",
    [
        ({"over": {}}, "name at least one number to choose"),
        ({"target": "beam.length"}, "the target beam.length is not free"),
        ({"over": {FREE[0]: (5.0, 20.0)}}, "cannot be both fitted and chosen"),
        ({"over": {"loads.0.speed": (3.0, 4.0)}}, "loads.0.speed is 2, outside its bounds"),
        ({"over": {"loads.0.sped": (3.0, 4.0)}}, "did you mean 'loads.0.speed'"),
    ],
)
def test_faulty_designs(given, words):
    with pytest.raises(ValueError, match=words):
        design_experiment(
            **{"case": CASE, "free": FREE, "over": {"loads.0.speed": (1.0, 4.0)}} | given
        )
