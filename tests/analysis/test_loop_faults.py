"""Laws under faults of their loops: what a fault is, who knows of it, and the command's table."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

import jaxbeam as jb
from jaxbeam.analysis.compare import FAULTS, FaultedPeak, compare_under_faults
from jaxbeam.cli import main
from jaxbeam.model.sensor_signals import sent_readings
from tests.case.test_actuators import LOOPS, PERIOD, by_its_equations, crossing, shaker

FORCE = 4.0  # N


def strip(**changes) -> jb.Case:
    """A strip of one mode whose commands are held for 10 ms, so that its bound is found at once."""
    parts = {
        "beam": jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=1),
        "actuators": [jb.PointForce(0.3, limits=[-FORCE, FORCE])],
        "sensors": [jb.Sensor(0.3)],
        "loads": [jb.MovingMass(mass=0.3, speed=1.5)],
        "run": jb.Run(0.5, sample_rate=200.0),
    }
    return jb.Case(**(parts | changes))


FEEDBACK = jb.Feedback(gains=[800.0], period=0.01)
CASE = strip(controller=FEEDBACK)
UNCONTROLLED = jb.simulate(strip())


def of_fault(name: str, case: jb.Case = CASE) -> dict[str, jb.Case]:
    return next(fault for fault in FAULTS if fault.name == name).variants(case, UNCONTROLLED)


def peak_of(case: jb.Case) -> float:
    return float(np.max(jb.simulate(case).peak_deflection))


WRONG_SIGN = dataclasses.replace(FEEDBACK, gains=[-400.0])
SOFT = tuple(fault for fault in FAULTS if fault.name == "E I -15 %")
OF_ONE_RUN = tuple(fault for fault in FAULTS if fault.name in ("none", "stuck"))


@pytest.fixture(scope="module")
def compared():
    laws = {"feedback": FEEDBACK, "wrong sign": WRONG_SIGN}
    return compare_under_faults(strip(), laws, faults=OF_ONE_RUN)


def test_a_stuck_sensor_leaves_feedback_without_effect(compared):
    stuck = compared[0]["feedback"]["stuck"]
    assert_allclose(stuck.peak, peak_of(strip()), rtol=1e-9)
    assert_allclose(stuck.share, 0.0, atol=1e-8)
    assert stuck.at == "sensor 0"


def test_a_stuck_sensor_reads_what_it_did_before_the_load():
    case = strip(controller=FEEDBACK, sensors=[jb.Sensor(0.3, offset=1e-4), jb.Sensor(0.2)])
    free = jb.simulate(dataclasses.replace(case, controller=None))
    stuck = next(fault for fault in FAULTS if fault.name == "stuck").variants(case, free)
    assert list(stuck) == ["sensor 0", "sensor 1"]
    readings = jb.simulate(dataclasses.replace(stuck["sensor 0"], controller=None)).measured
    assert_allclose(readings[:, 0], 1e-4, rtol=1e-6)
    assert np.ptp(readings[:, 1]) > 1e-4


def test_estimators_have_the_loops_they_are_made_for():
    """A Kalman filter, which needs the period of its law, of a sensor that is stuck: no command."""
    noisy = [jb.Sensor(0.3, noise=1e-9)]
    estimator = jb.Kalman(process_noise=1e-3)
    law = jb.LQR([1e6, 1.0], [1e-2], period=0.01, estimator=estimator)
    found, _ = compare_under_faults(strip(sensors=noisy), {"lqr": law}, faults=OF_ONE_RUN)
    assert found["lqr"]["none"].share > 0.01
    assert_allclose(found["lqr"]["stuck"].share, 0.0, atol=1e-3)


def test_less_rigidity_is_not_known_to_the_design():
    law = jb.LQR(state_weight=[1e6, 1.0], command_weight=[1.0], period=0.01)
    found, _ = compare_under_faults(strip(), {"lqr": law}, faults=SOFT)
    soft = strip(beam=dataclasses.replace(CASE.beam, flexural_rigidity=0.85 * 11.68))
    informed = peak_of(dataclasses.replace(soft, controller=law))
    nominal = dataclasses.replace(law, nominal_plant=jb.state_space(strip()))
    assert_allclose(
        found["lqr"]["E I -15 %"].peak, peak_of(dataclasses.replace(soft, controller=nominal))
    )
    assert abs(found["lqr"]["E I -15 %"].peak / informed - 1) > 1e-4
    assert_allclose(found["lqr"]["E I -15 %"].uncontrolled, peak_of(soft), rtol=1e-6)


@pytest.mark.parametrize("fraction", [0.01, 0.05])
def test_readings_are_lost_as_often_as_said(fraction):
    cases = of_fault(f"{100 * fraction:g} % lost")
    assert len({case.run.seed for case in cases.values()}) == 5
    for case in cases.values():
        assert [sensor.dropout for sensor in case.sensors] == [fraction]


def test_readings_and_commands_are_late_by_a_fifth_of_the_period():
    for case in of_fault("late").values():
        assert_allclose([case.sensors[0].jitter, case.controller.jitter], 0.002)


def test_faults_of_the_case_itself_stay_where_they_are_larger():
    worse = strip(controller=FEEDBACK, sensors=[jb.Sensor(0.3, dropout=0.2, jitter=0.005)])
    for case in (*of_fault("1 % lost", worse).values(), *of_fault("late", worse).values()):
        sensor = case.sensors[0]
        assert_allclose([sensor.dropout, sensor.jitter], [0.2, 0.005])


def test_converters_have_twelve_bits():
    case = of_fault("12 bits")[""]
    readings = np.abs(UNCONTROLLED.measured).max()
    assert_allclose(case.sensors[0].resolution, 4 * readings / 4096)
    assert_allclose(case.controller.resolution, 2 * FORCE / 4096)
    ranged = strip(controller=FEEDBACK, sensors=[jb.Sensor(0.3, range=[-1e-3, 3e-3])])
    assert_allclose(of_fault("12 bits", ranged)[""].sensors[0].resolution, 4e-3 / 4096)


def test_what_is_worse_than_no_control_is_named(compared):
    worst, least = compared
    assert worst["wrong sign"]["none"].is_worse_than_none
    assert not worst["feedback"]["none"].is_worse_than_none
    assert FaultedPeak(np.nan, 1e-3, np.nan, "").is_worse_than_none
    none = worst["feedback"]["none"]
    expected = (least.uncontrolled - peak_of(CASE)) / (least.uncontrolled - least.peak)
    assert_allclose(none.share, expected, rtol=1e-6)


def test_laws_in_continuous_time_lose_no_samples():
    law = jb.Feedback(gains=[500.0])
    sampled = tuple(fault for fault in FAULTS if fault.sampled)
    found, _ = compare_under_faults(strip(), {"continuous": law}, 0.01, sampled)
    assert found["continuous"] == dict.fromkeys(fault.name for fault in sampled)


def test_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxbeam.analysis.compare.compare_under_faults", _of_one_run)
    jb.save_case(strip(controller=FEEDBACK), tmp_path / "case.toml")
    law = "[controller]\nkind = 'feedback'\ngains = [-400.0]\nperiod = 0.01\n"
    (tmp_path / "wrong.toml").write_text(law)
    command = f"compare {tmp_path / 'case.toml'} --faults"
    assert _code(f"{command} --controllers {tmp_path / 'wrong.toml'}") == 0
    text = capsys.readouterr().out
    assert "wrong, none: 1.18 times the peak without control" in text
    assert _code(f"{command} --json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["faults"]["case"]["stuck"]["at"] == "sensor 0"
    assert _code(f"{command} --over loads.0.mass=0.1,0.2") == 2
    assert "leave out -o, --over and --cases" in capsys.readouterr().err


LOOP, LIMITS, GAIN, FINE = LOOPS["current"], [-0.2, 0.3], 1e3, 10  # FINE: times in each period
IN_INNER_LOOP = crossing(shaker(LOOP, limits=LIMITS), controller=jb.Feedback([GAIN], period=PERIOD))


def peak_by_scipy(readings=None, rigidity=11.68) -> float:
    """Peak of a run whose readings, at the samples, are `readings(k, w)` for the deflection w."""
    latest, periods = [0.0], round(float(IN_INNER_LOOP.run.duration) / PERIOD)

    def reading(k, deflection):
        if k % FINE == 0:
            latest[0] = deflection if readings is None else readings(k // FINE, deflection)
        return latest[0]

    times = np.arange(periods * FINE + 1) * PERIOD / FINE
    history, *_ = by_its_equations(LOOP, times, GAIN, LIMITS, True, reading, rigidity)
    curve = CubicSpline(times, history)
    return float(np.abs(curve(np.linspace(0.0, times[-1], 100 * times.size))).max())


@pytest.fixture(scope="module")
def within_limits():
    wanted = "none", "5 % lost", "stuck", "E I -15 %"
    faults = tuple(fault for fault in FAULTS if fault.name in wanted)
    return compare_under_faults(IN_INNER_LOOP, {"law": IN_INNER_LOOP.controller}, faults=faults)


def test_limits_of_a_voltage_have_no_shares(within_limits):
    (of_faults,), free = within_limits[0].values(), within_limits[1]
    assert all(np.isnan(one.share) for one in of_faults.values())
    uncontrolled = peak_by_scipy(lambda k, deflection: 0.0)
    assert_allclose(free.peak_deflection, uncontrolled, rtol=1e-5)
    for name in ("none", "5 % lost", "stuck"):
        assert_allclose(of_faults[name].uncontrolled, uncontrolled, rtol=1e-5)
    assert_allclose(of_faults["none"].reduction, 1 - peak_by_scipy() / uncontrolled, rtol=1e-3)


def test_faults_beside_limits_of_a_voltage(within_limits):
    (of_faults,) = within_limits[0].values()
    assert_allclose(of_faults["none"].peak, peak_by_scipy(), rtol=1e-5)
    assert_allclose(of_faults["stuck"].peak, peak_by_scipy(lambda k, w: 0.0), rtol=1e-5)
    assert_allclose(of_faults["E I -15 %"].peak, peak_by_scipy(None, 0.85 * 11.68), rtol=1e-5)
    sensor, peaks = jb.Sensor(0.3, dropout=0.05), []
    for seed in range(5):
        lost, _ = sent_readings(seed, 0, sensor, 20)
        held = [0.0]

        def latest(k, deflection, lost=lost, held=held):
            held[0] = held[0] if lost[k] else deflection
            return held[0]

        peaks.append(peak_by_scipy(latest))
    assert np.ptp(peaks) > 1e-3 * max(peaks)
    assert_allclose(of_faults["5 % lost"].peak, max(peaks), rtol=1e-5)
    assert of_faults["5 % lost"].at == f"seed {np.argmax(peaks)}"


def test_the_command_names_reductions_where_there_is_no_bound(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxbeam.analysis.compare.compare_under_faults", _of_one_run)
    jb.save_case(IN_INNER_LOOP, tmp_path / "case.toml")
    assert _code(f"compare {tmp_path / 'case.toml'} --faults") == 0
    text = capsys.readouterr().out
    assert "no least achievable peak, as actuators.0.limits bound the voltage" in text
    assert "reduction of the peak, at worst" in text
    reduction = 1 - peak_by_scipy() / peak_by_scipy(lambda k, w: 0.0)
    assert f"{reduction:.1%}" in text
    assert _code(f"compare {tmp_path / 'case.toml'} --faults --json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["least_peak"] is None
    assert found["faults"]["case"]["none"]["share"] is None


def _code(line: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    return ended.value.code


def _of_one_run(case, laws, period):
    return compare_under_faults(case, laws, period, OF_ONE_RUN)
