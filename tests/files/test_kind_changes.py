"""Other kinds by `--set`: what stays, what is left out, and what is said."""

import pytest

import jaxbeam as jb
from jaxbeam.cli import main
from jaxbeam.files.case_file import KindChangeWarning, with_settings

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
    actuators=[jb.Shaker(0.22, 3500.0, 80.0, limits=[-10.0, 10.0])],
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.3, speed=1.0)],
    controller=jb.Feedback([100.0], power=3, period=0.005),
    run=jb.Run(0.7, 200.0),
)


def test_entries_of_both_kinds_stay():
    with pytest.warns(KindChangeWarning, match=r"loads.0 is of kind 'force' now.* keeps mass, sp"):
        force = with_settings(CASE, {"loads.0.kind": "force"}).loads[0]
    assert isinstance(force, jb.MovingForce) and force.mass == 0.3 and force.speed == 1.0


def test_limits_in_another_unit_are_left_out():
    with pytest.warns(KindChangeWarning, match="stiffness, damping.*limits.* are left out"):
        case = with_settings(CASE, {"actuators.0.kind": "point"})
    assert case.actuators[0].limits is None and case.actuators[0].position == 0.22


def test_entries_of_the_new_kind_are_set_in_any_order():
    weights = {
        "controller.state_weight": [1e6, 1e6, 1.0, 1.0, 0.0],
        "controller.command_weight": [1.0],
    }
    with pytest.warns(KindChangeWarning, match="gains, power of 'feedback' are left out"):
        law = with_settings(CASE, weights | {"controller.kind": "lqr"}).controller
    assert isinstance(law, jb.LQR) and law.period == 0.005
    with (
        pytest.warns(KindChangeWarning),
        pytest.raises(ValueError, match="controller.state_weight is missing"),
    ):
        with_settings(CASE, {"controller.kind": "lqr"})


def test_a_controller_is_added():
    settings = {"controller.kind": "feedback", "controller.gains": [5.0]}
    without = jb.Case(CASE.beam, actuators=CASE.actuators, sensors=CASE.sensors)
    assert with_settings(without, settings).controller.gains == 5.0


@pytest.mark.filterwarnings("default")
def test_warnings_are_of_what_is_run(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = {"state_weight": [1e9] * 4, "command_weight": [1e-4], "period": 0.05}
    slow = jb.Case(
        CASE.beam,
        actuators=[jb.PointForce(0.22)],
        sensors=CASE.sensors,
        controller=jb.LQR(**weights),
    )
    jb.save_case(slow, "case.toml")
    for change, warned in (("beam.modes=2", True), ("controller.period=0.0005", False)):
        with pytest.raises(SystemExit) as ended:
            main(["modes", "case.toml", "--set", change])
        assert ended.value.code == 0
        assert ("warning" in capsys.readouterr().err) == warned


def test_a_spring_to_ground_takes_no_gain_and_no_sensor():
    """A shaker without command is the same spring; a gain of zero and a sensor are its dummies."""
    spring, shaker = jb.SpringDamper(0.2, 3000.0, 20.0), jb.Shaker(0.2, 3000.0, 20.0)
    parts = {"loads": CASE.loads, "run": CASE.run}
    force = jb.PointForce(0.35)
    law = {"period": 0.005, "delay": 0.002}
    alone = jb.Case(
        CASE.beam, actuators=[spring, force], sensors=[jb.Sensor(0.3)],
        controller=jb.Feedback([900.0], **law), **parts,
    )  # fmt: skip
    full = jb.Case(
        CASE.beam, actuators=[shaker, force], sensors=[jb.Sensor(0.1), jb.Sensor(0.3)],
        controller=jb.Feedback([0.0, 900.0], **law), **parts,
    )  # fmt: skip
    found, expected = jb.simulate(alone), jb.simulate(full)
    assert found.deflection[:, 0] == pytest.approx(expected.deflection[:, 1], abs=1e-12)
    assert not found.command[:, 0].any() and found.command[:, 1].any()
