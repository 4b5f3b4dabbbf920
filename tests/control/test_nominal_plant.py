"""Laws designed for a nominal plant and used on another one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.validation import check_case
from jaxbeam.control.design_model import DesignModel
from jaxbeam.files.case_file import case_to_dict

WEIGHTS = {"state_weight": [1e4, 1.0, 0.0], "command_weight": [1.0]}
SHAKER = jb.Shaker(0.3, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)


def beam_case(controller, rigidity=13.2, actuator=SHAKER):
    return jb.Case(
        jb.Beam(0.6, rigidity, 0.81, 0.03, modes=1),
        actuators=[actuator],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.3, speed=1.5)],
        controller=controller,
        run=jb.Run(0.2, sample_rate=100.0),
    )


def with_nominal(controller, case):
    return dataclasses.replace(controller, nominal_plant=jb.state_space(case))


def test_gain_is_that_for_the_nominal_plant():
    controller = jb.LQR(**WEIGHTS, period=0.01)
    case = beam_case(controller)
    other = beam_case(with_nominal(controller, case), rigidity=9.0)
    gain = controller.law(jb.state_space(case)).law.gain
    found = other.controller.law(jb.state_space(other)).law.gain
    assert_allclose(found, gain, rtol=1e-12)
    for_itself = controller.law(jb.state_space(other)).law.gain
    assert np.max(np.abs(found / for_itself - 1)) > 0.01
    fixed = beam_case(jb.StateFeedback(gain=np.asarray(gain), period=0.01), rigidity=9.0)
    commands = jb.simulate(other).command
    assert_allclose(commands, jb.simulate(fixed).command, rtol=1e-9, atol=1e-12)


def test_settings_are_validated_for_the_nominal_plant():
    """The design model names a parameter that only the shaker of the nominal plant has."""
    controller = jb.LQR(**WEIGHTS, design=DesignModel(force_per_volt=4.0))
    coil = jb.Electrodynamic(0.3, 3.0, 2e-3, 5.0, mass=0.02, stiffness=900.0, damping=1.0)
    with pytest.raises(ValueError, match=r"controller\.design\.force_per_volt has no effect"):
        check_case(beam_case(controller, actuator=coil))
    check_case(beam_case(with_nominal(controller, beam_case(controller)), actuator=coil))


def test_nominal_plant_is_no_key_of_case_files():
    controller = jb.LQR(**WEIGHTS)
    case = beam_case(with_nominal(controller, beam_case(controller)))
    with pytest.raises(ValueError, match="controller.nominal_plant is no key of a case file"):
        case_to_dict(case)


def test_derivatives_by_settings_of_the_design():
    """Forward mode through the design for the nominal plant, against a difference."""
    controller = jb.LQR(**WEIGHTS, period=0.01)
    nominal = beam_case(controller)

    def gain(weight):
        changed = jb.replace(nominal, {"controller.command_weight.0": weight})
        law = with_nominal(changed.controller, nominal).law(jb.state_space(nominal))
        return jnp.sum(law.law.gain)

    slope = jax.jacfwd(gain)(1.0)
    difference = (gain(1.001) - gain(0.999)) / 2e-3
    assert_allclose(slope, difference, rtol=1e-4)


class Silent(AbstractController):
    """A controller whose law has neither interface."""

    def design_law(self, plant):
        return None


@pytest.mark.parametrize(
    ("period", "message"),
    [(None, "AbstractContinuousLaw: give a period"), (0.01, "AbstractSampledLaw: leave")],
)
def test_laws_without_the_interface_are_refused(period, message):
    period = None if period is None else jnp.asarray(period)
    with pytest.raises(TypeError, match=f"the law of a Silent is a NoneType, no {message}"):
        jb.simulate(beam_case(Silent(period=period)))
