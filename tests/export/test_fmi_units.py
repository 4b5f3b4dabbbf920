"""Units for co-simulation: steps of beam and controller against `simulate`, alone and by FMPy."""

import dataclasses
import re
import zipfile

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.cli.app import app
from jaxbeam.export.fmi import BeamSteps, ControllerSteps, write_fmu

# The light mass loses contact; the bilateral model goes on in both.
pytestmark = pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
PERIOD = 0.005


def rig(controller=None, **changes) -> jb.Case:
    """Beam with a shaker; a mass, and a quarter car that enters between samples."""
    parts = {
        "actuators": [jb.Shaker(0.25, stiffness=300.0, bandwidth=900.0, limits=[-1.5, 1.5])],
        "sensors": [jb.Sensor(0.3, filter=jb.Filter(60.0, 2)), jb.Sensor(0.2, "velocity")],
        "loads": [
            jb.MovingMass(mass=0.05, speed=6.0, entry_time=0.0123),
            jb.QuarterCar(0.05, 0.02, 60.0, 0.6, 400.0, 0.1, speed=5.0),
        ],
        "run": jb.Run(0.15, 1 / PERIOD),
    }
    beam = jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2)
    return jb.Case(beam, controller=controller, **(parts | changes))


FEEDBACK = jb.Feedback([1500.0], period=PERIOD)
ESTIMATED = jb.LQR(
    [1e4, 1e3, 1.0, 1.0, 0.0], [1e-3], period=PERIOD, estimator=jb.Kalman(0.02, 1e-5)
)
CASES = {
    "no delay": rig(FEEDBACK),
    "half a period": rig(dataclasses.replace(FEEDBACK, delay=np.asarray(PERIOD / 2))),
    "two periods": rig(dataclasses.replace(FEEDBACK, delay=np.asarray(2 * PERIOD))),
    "Kalman filter": rig(ESTIMATED),
    "profile": rig(FEEDBACK, profile=jb.profiles.SineProfile(2e-4, 0.2)),
}


def stepped_together(case: jb.Case, step=PERIOD / 2):
    """Commands and readings of both parts at the samples of the run; the controller goes first."""
    beam, law = BeamSteps(case), ControllerSteps(case)
    commands, readings = [], []
    for k in range(round(0.15 / step)):
        command = law.step(k * step, beam.readings)
        if k % 2 == 0:
            commands.append(command)
            readings.append(beam.readings)
        beam.step(step, command)
    return np.array(commands), np.array(readings)


@pytest.mark.parametrize("name", CASES)
def test_steps_together_are_the_simulated_loop(name):
    case = CASES[name]
    record = jb.simulate(case)
    commands, readings = stepped_together(case)
    assert_allclose(commands, record.command[:-1], atol=1e-6 * np.max(np.abs(record.command)))
    for i, history in enumerate((record.at(0.3), record.at(0.2, "velocity"))):
        size = np.max(np.abs(history))
        assert_allclose(readings[:, i], np.asarray(history)[:-1], atol=1e-6 * size)


def test_steps_of_any_length():
    """A command held over one long step is that over many short ones."""
    long, short = BeamSteps(rig()), BeamSteps(rig())
    long.step(0.09, [1.0])
    for _ in range(9):
        short.step(0.01, [1.0])
    assert_allclose(long.readings, short.readings, rtol=1e-7)


@pytest.mark.parametrize(
    ("part", "case", "message"),
    [
        (ControllerSteps, rig(), "the exported controller needs a period"),
        (
            ControllerSteps,
            rig(dataclasses.replace(ESTIMATED, estimator=None)),
            "uses the true state",
        ),
        (
            ControllerSteps,
            rig(FEEDBACK, sensors=[jb.Sensor(0.3, delay=0.01)]),
            "sensors.0 has a delay of its own",
        ),
        (
            BeamSteps,
            rig(actuators=[jb.Patch(0.2, 0.3, 1e-3, creep=jb.actuators.Creep([1.0], [0.1]))]),
            "actuators.0 has a hysteresis or creep",
        ),
    ],
)
def test_what_is_refused(part, case, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        part(case)


def test_a_sample_passed_over_is_an_error():
    law = ControllerSteps(CASES["no delay"])
    law.step(0.0, np.zeros(2))
    with pytest.raises(ValueError, match=re.escape("the sample at 0.005 s was passed over")):
        law.step(0.007, np.zeros(2))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("a b.fmu",), "a b.fmu cannot be the name of a unit"),
        (("unit.fmu", "bridge"), "part may be beam or controller, not 'bridge'"),
    ],
)
def test_names(arguments, message, tmp_path):
    name, *part = arguments
    with pytest.raises(ValueError, match=re.escape(message)):
        write_fmu(rig(), tmp_path / name, *part)


def test_units_hold_the_case(tmp_path):
    pytest.importorskip("pythonfmu3")
    path = write_fmu(rig(), tmp_path / "rig.fmu")
    with zipfile.ZipFile(path) as archive:
        (tmp_path / "case.toml").write_bytes(archive.read("resources/case.toml"))
        description = archive.read("modelDescription.xml").decode()
    assert jb.load_case(tmp_path / "case.toml").loads[0].entry_time == 0.0123
    assert 'fmiVersion="3.0"' in description and "command_0" in description
    with pytest.raises(FileExistsError, match="exists already"):
        write_fmu(rig(), path)


def test_loop_of_both_units_by_fmpy(tmp_path):
    """As co-simulation by FMPy, with the command line's files, against `simulate`."""
    fmpy = pytest.importorskip("fmpy")
    pytest.importorskip("pythonfmu3")
    slave = pytest.importorskip("fmpy.fmi3").FMU3Slave

    case = CASES["no delay"]
    jb.save_case(case, tmp_path / "case.toml")
    units = {}
    for part in ("controller", "beam"):
        path = tmp_path / f"{part}.fmu"
        app([str(part) for part in ("export", tmp_path / "case.toml", "-o", path, "--part", part)])
        description = fmpy.read_model_description(str(path), validate=True)
        folder = fmpy.extract(str(path), str(tmp_path / part))
        names = {variable.name: variable.valueReference for variable in description.modelVariables}
        unit = slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=part,
        )
        unit.instantiate()
        unit.enterInitializationMode(startTime=0.0)
        unit.exitInitializationMode()
        units[part] = unit, names
    (law, of_law), (beam, of_beam) = units["controller"], units["beam"]
    sensors = ["sensor_0", "sensor_1"]
    readings, found = [0.0, 0.0], []
    for k in range(30):
        law.setFloat64([of_law[name] for name in sensors], readings)
        law.doStep(k * PERIOD, PERIOD)
        (command,) = law.getFloat64([of_law["command_0"]])
        beam.setFloat64([of_beam["command_0"]], [command])
        beam.doStep(k * PERIOD, PERIOD)
        readings = beam.getFloat64([of_beam[name] for name in sensors])
        found.append([command, readings[0]])
    for unit, _ in units.values():
        unit.terminate()
        unit.freeInstance()
    record = jb.simulate(case)
    found = np.array(found)
    assert_allclose(found[:, 0], record.command[:-1, 0], atol=1e-6 * np.max(np.abs(record.command)))
    deflection = np.asarray(record.at(0.3))
    assert_allclose(found[:, 1], deflection[1:], atol=1e-6 * np.max(np.abs(deflection)))
