"""Which cases couple their modes: integrations of those that do not take a block for each."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.integrator.step_size import static_shapes
from jaxbeam.simulation.integration_plan import integration_plan

BEAM = jb.Beam(1.2, 12.0, 0.5, damping_ratio=0.02, modes=4)
LOADS = [jb.MovingMass(mass=0.2, speed=3.0)]
CASE = jb.Case(BEAM, [jb.Support(0.5)], sensors=[jb.Sensor(0.3)], loads=LOADS, run=jb.Run(0.5))


def with_support(**parts) -> jb.Case:
    return dataclasses.replace(CASE, supports=(jb.Support(0.5, **parts),))


@pytest.mark.parametrize(
    ("parts", "coupled"),
    [
        ({}, False),
        ({"stiffness": 4e3}, False),
        ({"stiffness": 4e3, "mass": 0.1, "rotational_stiffness": 2.0}, False),
        ({"damping": 0.0}, False),  # of a rigid support, which does not move
        ({"stiffness": 4e3, "damping": 5.0}, True),
        ({"stiffness": 4e3, "damping": 0.0}, True),  # it has derivatives
    ],
)
def test_dampers_couple_the_modes(parts, coupled):
    assert static_shapes(with_support(**parts)).coupled == coupled


@pytest.mark.parametrize("parts", [{}, {"stiffness": 4e3}])
def test_runs_are_the_same_with_one_block_and_with_many(parts):
    case = with_support(**parts)
    plan = integration_plan(case)
    coupled = dataclasses.replace(plan, shapes=dataclasses.replace(plan.shapes, coupled=True))
    found, expected = (jb.simulate(case, plan=one) for one in (plan, coupled))
    scale = np.abs(expected.deflection).max()
    assert_allclose(found.deflection, expected.deflection, rtol=0, atol=1e-10 * scale)


def test_a_damper_that_is_left_out_has_no_address():
    with pytest.raises(ValueError, match="'supports.0.damping', as it is left out there: give"):
        jb.replace(CASE, {"supports.0.damping": 1.0})


def test_a_damper_of_a_rigid_support_is_refused():
    with pytest.raises(ValueError, match=r"supports.0.damping would have no effect.*rigid"):
        jb.simulate(with_support(damping=3.0))
