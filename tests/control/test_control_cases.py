"""Controllers in case files and on the command line, and the errors of their settings."""

import dataclasses
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.validation import check_case
from jaxbeam.cli import main
from jaxbeam.control.design_model import DesignModel
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from tests.control.test_controllers import HELD
from tests.loop_as_oracle import expected

ACTUATOR, SENSOR = HELD.actuators[0], HELD.sensors[0]
SAMPLED = "needs a controller that samples: give controller.period"
ERRORS = [
    ({"actuators": ()}, "controller has nothing to command: add an actuator that takes commands"),
    ({"controller": jb.Feedback([1.0, 2.0])}, "controller.gains must list one gain for each of 1"),
    ({"sensors": ()}, "controller.gains has 1 entries, but there are only 0 sensors"),
    (
        {"controller": jb.Feedback([1.0], higher_gains=[[1.0, 2.0]])},
        "controller.higher_gains must have in each row a gain for each of 1 actuators, not 2",
    ),
    (
        {"controller": jb.Feedback([1.0], higher_gains=[1.0])},
        "controller.higher_gains must be a list of lists of numbers",
    ),
    (
        {"controller": jb.Feedback([1.0], period=0.5), "sensors": (jb.Sensor(0.3),)},
        "controller.period must not exceed the run's duration, 0.3 s; it is 0.5 s",
    ),
    ({"controller": jb.Feedback([1.0], period=0.0)}, "controller.period must be positive"),
    ({"controller": jb.Feedback([1.0], power=0)}, "controller.power must be a whole number, 1 or"),
    (
        {"controller": jb.Feedback([1.0], period=2e-3, delay=-1e-3)},
        "controller.delay must not be negative; it is -0.001 s",
    ),
    ({"controller": jb.Feedback([1.0], delay=1e-3)}, f"controller.delay {SAMPLED}"),
    ({"controller": jb.Feedback([1.0], resolution=0.1)}, f"controller.resolution {SAMPLED}"),
    ({"controller": jb.Feedback([1.0])}, f"sensors.0.filter, which is digital, {SAMPLED}"),
    (
        {"controller": jb.Feedback([1.0]), "sensors": (jb.Sensor(0.3, delay=1e-3),)},
        f"sensors.0.delay {SAMPLED}",
    ),
    (
        {"controller": jb.Feedback([1.0]), "sensors": (jb.Sensor(0.3, noise=1e-5),)},
        f"sensors.0.noise {SAMPLED}",
    ),
    (
        {"controller": jb.Feedback([1.0]), "sensors": (jb.Sensor(0.3, "acceleration"),)},
        f"the acceleration of sensors.0 {SAMPLED}",
    ),
    (
        {
            "controller": jb.Feedback([1.0]),
            "sensors": (jb.Sensor(0.3),),
            "actuators": (jb.Patch(0.2, 0.3, 8e-4, rate_limit=3.0),),
        },
        f"the rate limit of actuators.0 {SAMPLED}",
    ),
    (
        {"controller": jb.Feedback([1.0], period=0.01)},
        "sensors.0.filter.cutoff must be below half the sampling frequency, 50 Hz; it is 60 Hz",
    ),
    (
        {
            "sensors": (
                jb.Sensor(0.3, "acceleration", filter=jb.Filter(9.0, realisation="analogue")),
            )
        },
        "sensors.0.filter cannot be analogue on an acceleration that a controller uses",
    ),
    (
        {"actuators": (dataclasses.replace(ACTUATOR, limits=jnp.array([1.0, -1.0])),)},
        "actuators.0.limits.1 must be above the entry before it; -1 V follows 1 V",
    ),
    (
        {"controller": jb.StateFeedback([[1.0, 2.0]])},
        "controller.gain must have a row for each actuator, a column for each state: (1, 5)",
    ),
    (
        {"controller": jb.Prescribed([1.0], amplitudes=[[1.0]])},
        "controller.amplitudes and frequencies belong together; give both or neither",
    ),
    (
        {"controller": jb.Prescribed([1.0], amplitudes=[[1.0]], frequencies=[1.0, 2.0])},
        "controller.amplitudes must have a column for each of the frequencies",
    ),
    (
        {"controller": jb.Prescribed([1.0], phases=[[1.0]])},
        "controller.phases have no effect without amplitudes and frequencies",
    ),
    (
        {"controller": jb.Prescribed([1.0], times=[0.0, 1.0], values=[[1.0, 2.0, 3.0]])},
        "controller.values must have a column for each of the times",
    ),
    (
        {"controller": jb.Prescribed([1.0], times=[0.0, 0.0], values=[[1.0, 2.0]])},
        "controller.times.1 must be above the entry before it; 0 s follows 0 s",
    ),
    (
        {"controller": jb.Prescribed([1.0, 2.0])},
        "controller.offsets must have an entry for each of 1 actuators",
    ),
    ({"controller": jb.Feedback([np.nan])}, "controller.gains.0 must be a finite number"),
    ({"controller": "feedback"}, "controller holds 'feedback'; it takes objects of type"),
]


@pytest.mark.parametrize(("changes", "message"), ERRORS)
def test_errors_of_controllers(changes, message):
    if isinstance(changes.get("controller"), jb.Prescribed):
        changes = {"sensors": (), **changes}
    case = dataclasses.replace(HELD, **changes)
    for function in (check_case, jb.simulate):
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            function(case)
        assert "\n" not in str(caught.value)


TABLES = [
    ({"kind": "feedbak", "gains": [1.0]}, "controller.kind cannot be 'feedbak'; did you mean"),
    ({"gains": [1.0]}, "controller.kind is missing; it may be feedback, "),
    ({"kind": "feedback", "gain": [1.0]}, "controller has no key 'gain'; did you mean 'gains'?"),
    ({"kind": "feedback"}, "controller.gains is missing; give the one gain for each actuator"),
    ({"kind": "feedback", "gains": 1.0}, "controller.gains must be a list of numbers, not 1.0"),
    (
        {"kind": "state", "gain": [[1.0, 2.0], [3.0]]},
        "controller.gain must be a list of lists of numbers, all equally long, not [[1.0, 2.0]",
    ),
    (
        {"kind": "feedback", "gains": [1.0], "period": "fast"},
        "controller.period must be one number, not 'fast'",
    ),
]


def test_too_long_period_is_refused():
    law = jb.Feedback([1.0], period=1e4)
    run = jb.Run(2e4, sample_rate=1e-4)
    case = dataclasses.replace(HELD, sensors=(jb.Sensor(0.3),), controller=law, run=run)
    with pytest.raises(RuntimeError, match="the interval of 10000 s between samples takes"):
        jb.simulate(case)


@pytest.mark.parametrize(("table", "message"), TABLES)
def test_errors_of_tables(table, message):
    content = case_to_dict(HELD) | {"controller": table}
    with pytest.raises(ValueError, match=re.escape(message)):
        case_from_dict(content)


def test_addresses_of_matrix_entries():
    law = jb.StateFeedback([[1.0, 2.0, 3.0, 4.0, 5.0]], period=1e-3)
    case = dataclasses.replace(HELD, controller=law)
    changed = jb.replace(case, {"controller.gain.0.3": 9.0})
    assert_array_equal(changed.controller.gain, [[1.0, 2.0, 3.0, 9.0, 5.0]])
    with pytest.raises(ValueError, match=r"no number at address 'controller.gain.0.5'"):
        jb.replace(case, {"controller.gain.0.5": 1.0})


def command_line(words: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words)
    return ended.value.code


def test_loop_on_the_command_line(tmp_path, capsys):
    path, output = tmp_path / "case.toml", tmp_path / "out.nc"
    jb.save_case(HELD, path)
    assert command_line(["simulate", str(path), "-o", str(output), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    record = jb.read_record(output)
    assert_allclose(printed["peak_deflection"], record.peak_deflection)
    assert_allclose(record.command, expected(HELD, record.times).command, rtol=0, atol=1e-8)
    assert command_line(["simulate", str(path)]) == 0
    table = capsys.readouterr().out
    assert "largest command" in table and "0.35" in table
    changed = ["--set", "controller.gains=[1,2]"]
    assert command_line(["simulate", str(path), *changed]) == 1
    assert "controller.gains must list one gain for each of 1" in capsys.readouterr().err


# Laws designed for a nominal plant and used on another one.

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
