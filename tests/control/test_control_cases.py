"""Controllers in case files and on the command line, and the errors of their settings."""

import dataclasses
import json
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.cli import main
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


CONTROLLERS = [
    HELD.controller,
    jb.Feedback([1.0], 3, resolution=0.1, period=0.01),
    jb.Feedback([1.0], higher_gains=[[2.0], [3.0]], period=0.01),
    jb.StateFeedback([[1.0, 2.0, 3.0, 4.0, 5.0]], period=1e-3, delay=2e-3),
    jb.Prescribed(
        [0.1],
        amplitudes=[[1.0, 2.0]],
        frequencies=[3.0, 4.0],
        phases=[[0.0, 1.0]],
        times=[0.0, 1.0, 1.5],
        values=[[1.0, -1.0, 0.5]],
    ),
]


@pytest.mark.parametrize("controller", CONTROLLERS, ids=lambda c: type(c).__name__)
def test_case_file_keeps_the_controller(controller, tmp_path):
    sensor = jb.Sensor(0.25)
    case = dataclasses.replace(HELD, controller=controller, sensors=(sensor,))
    jb.save_case(case, tmp_path / "case.toml")
    assert eqx.tree_equal(jb.load_case(tmp_path / "case.toml"), case)


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
