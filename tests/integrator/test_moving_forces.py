"""Forces in closed form: against the integrator, and the equation of a particular solution."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.integrator.forces.system import force_system, particular_solution
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.sensing.linear_outputs import linear_outputs
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.numerics.piecewise import piecewise_chebyshev
from jaxbeam.sweeps.force_runner import force_runner
from jaxbeam.sweeps.specification import sweep_specification

BEAM = jb.Beam(12.0, 4e8, 2000.0, 0.02, modes=3)
QUANTITIES = ("deflection", "velocity", "acceleration", "slope", "moment", "shear")
ROW = jb.Axles(speed=25.0, offsets=[0.0, 2.5, 7.0, 9.5, 21.0], forces=[1e5, 1e5, 9e4, 9e4, 1.2e5])
BACK = jb.Axles(speed=-18.0, offsets=[0.0, 3.0, 6.0], forces=[7e4] * 3, entry_time=0.2)
TWO_SPANS = jb.Case(
    BEAM,
    supports=[jb.Support(5.0, stiffness=2e7, damping=3e4)],
    sensors=[jb.Sensor(8.0, quantity) for quantity in QUANTITIES],
    loads=[ROW, BACK],
    run=jb.Run(2.0),
)
TIMOSHENKO = dataclasses.replace(
    TWO_SPANS,
    beam=dataclasses.replace(BEAM, shear_stiffness=1e8),
    supports=(),
    loads=[dataclasses.replace(ROW, start_position=-4.0), BACK],
)


def runner_of(case, over):
    plan = sweep_specification(case, over, False, False, 1e-8, "double")
    return force_runner(case, plan.batches(), 1e-8)


@pytest.mark.parametrize("case", [TWO_SPANS, TIMOSHENKO], ids=["two spans", "Timoshenko"])
def test_peaks_equal_those_of_the_integrator(case):
    runner = runner_of(case, {"loads.0.speed": [25.0]})
    phases, error = runner.choose_step_sizes()
    found = {name: values[0, 0] for name, values in runner.compute_block(0, phases).items()}
    record = jb.simulate(case, tolerance=1e-9)
    largest = np.maximum(np.abs(record.smallest), record.largest)
    for i, quantity in enumerate(QUANTITIES):
        assert_allclose(found["peak_deflection"][i], largest[i], rtol=1e-8, err_msg=quantity)
    assert error < 1e-8
    assert_allclose(found["lowest_contact_force"], [1e5, 1e5, 9e4, 9e4, 1.2e5, 7e4, 7e4, 7e4])
    assert np.isnan(found["contact_lost_time"]).all()


@pytest.mark.parametrize("speed", [5.0, 60.0, -300.0])
def test_particular_solutions_satisfy_their_equation(speed):
    model = modal_model(TWO_SPANS)
    outputs = linear_outputs(model, sensor_rows(model, TWO_SPANS, TWO_SPANS.sensors), None)
    system = force_system(model, outputs, np.zeros(0))
    solution = particular_solution(system, speed)
    x = np.linspace(0.1, 11.9, 40)
    parts = np.concatenate([solution.real, solution.imag], axis=-1)
    p, slope = (
        whole[:, : system.poles.size] + 1j * whole[:, system.poles.size :]
        for whole in piecewise_chebyshev(system.nodes, parts, x, (0, 1))
    )
    forces = np.concatenate([system.forces.real, system.forces.imag], axis=-1)
    b = piecewise_chebyshev(system.nodes, forces, x, (0,))[0]
    b = b[:, : system.poles.size] + 1j * b[:, system.poles.size :]
    residual = speed * slope - system.poles * p - b
    assert np.abs(residual).max() < 1e-9 * np.abs(b).max()


def test_other_sweeps_are_integrated():
    speeds = {"loads.0.speed": [20.0, 25.0]}
    assert runner_of(TWO_SPANS, speeds) is not None
    assert runner_of(TWO_SPANS, {"beam.length": [12.0, 13.0]}) is None
    braking = dataclasses.replace(TWO_SPANS, loads=[ROW, dataclasses.replace(BACK, deceleration=1)])
    heavy = dataclasses.replace(ROW, masses=[10.0] * 5)
    free = dataclasses.replace(BEAM, ends="free-free")
    for case in (
        braking,
        dataclasses.replace(TWO_SPANS, loads=[heavy, BACK]),
        dataclasses.replace(TWO_SPANS, loads=[ROW]),  # fewer wheels
        dataclasses.replace(TWO_SPANS, beam=free, supports=(), sensors=TWO_SPANS.sensors[:3]),
    ):
        assert runner_of(case, speeds) is None
