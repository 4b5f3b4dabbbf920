"""Files that release 0.1.0 wrote are read by this one, and hold the same numbers.

`tests/data/release_0_1_0` was written by the commands of commit 3019fe3: `simulate case.toml`,
`sweep case.toml` over mass and speed, `identify rig.toml log_1.csv` for the flexural rigidity, and
`export` of `regulator.toml` (gains, filter and estimator) and of `table.toml` (`--points 6`).
Its fit was written anew by release 0.2.0, in `release_0_2_0`.

Answers of cases of all kinds are those of version 0.2.0.
"""

import dataclasses
import json
import pathlib
import shutil
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.cli import main
from jaxbeam.control.estimation.sampled_plant import SampleTiming
from jaxbeam.export import export_gains, read_gains
from jaxbeam.export.gains import ARRAYS
from jaxbeam.files.case_file import KindChangeWarning, with_settings
from jaxbeam.simulation.stored_record import read_record
from tests.export.cases import CASES as LOOPS, rig
from tests.test_known_and_traced import CASES as OPEN, CONTROLLED, LAWS, MASSES
from tuning import load_fit, read_logs

# Cases of all kinds whose answers of version 0.2.0 are kept in `tests/data/release_0_2_0.json`.
#
# `python -m tests.simulation.release_cases` prints the answers of this version.

# Their answers are those at a tolerance of 1e-12: 0.2.0 chose steps by another error of peaks
# between them, too small for the mass on a ramp (1.2e-8 in its peak), too large for the half car.
OTHER_STEPS = ("a mass on a ramp", "a half car")
# Of these filters 0.2.0 took a whole period in one step, up to 8e-6 off.
LONG_STEPS = tuple(
    f"law: {name}"
    for name in (
        "loads known by the filter",
        "weights estimated, fed forward",
        "prediction with masses",
    )
)
LATER = ("eccentric masses",)  # what 0.2.0 had not
SAMPLES = 3  # of each history that is kept
LOOP_NAMES = (
    "feedback",
    "spring",
    "feedback-cubic",
    "output-feedback",
    "pd",
    "lead",
    "ppf",
    "prescribed",
)
ROAD = jb.Beam(25.0, 5e9, 2e3, damping_ratio=0.01, modes=4)


def _road(*loads, **parts):
    sensors = [jb.Sensor(12.5), jb.Sensor(8.0, "acceleration")]
    settings = {"sensors": sensors, "run": jb.Run(1.2, 50.0)} | parts
    return jb.Case(ROAD, loads=loads, **settings)


def _quarter(speed=30.0, **others):
    return jb.QuarterCar(2e3, 200.0, 2e5, 5e3, 1e6, speed=speed, **others)


CASES = {
    **{f"open: {name}": case for name, case in OPEN.items() if name not in LATER},
    **{
        f"law: {name}": dataclasses.replace(CONTROLLED, controller=law)
        for name, law in LAWS.items()
    },
    **{f"loop: {name}": LOOPS[name] for name in LOOP_NAMES},
    "a quarter car": _road(_quarter()),
    "a quarter car on a bump": _road(_quarter(), profile=jb.profiles.BumpProfile(8.0, 9.0, 0.01)),
    "a quarter car on waves": _road(_quarter(), profile=jb.profiles.SineProfile(4.0, 2e-3)),
    "a quarter car on a random road": _road(
        _quarter(), profile=jb.profiles.ISO8608Profile("B", seed=3)
    ),
    "a mass on a ramp": _road(
        jb.MovingMass(mass=500.0, speed=20.0), profile=jb.profiles.RampProfile(5.0, 9.0, 0.02)
    ),
    "an oscillator that brakes": _road(
        jb.Oscillator(2e3, 2e5, 3e3, 50.0, speed=30.0, deceleration=4.0)
    ),
    "two vehicles meet": _road(_quarter(), _quarter(-25.0, entry_time=0.1)),
    "a walking force": _road(jb.Pedestrian(pace=1.9, speed=20.0)),
    "a beam with a hinge": jb.Case(
        jb.Beam(25.0, 5e9, 2e3, 0.01, modes=4, hinges=[jb.Hinge(10.0)]),
        supports=[jb.Support(12.0)],
        sensors=[jb.Sensor(6.0)],
        loads=[jb.MovingMass(mass=300.0, speed=20.0)],
        run=jb.Run(1.4, 50.0),
    ),
    "many modes": dataclasses.replace(
        MASSES, beam=dataclasses.replace(MASSES.beam, modes=28, damping_ratio=0.01)
    ),
    "axles with masses": _road(
        jb.Axles(offsets=[0.0, 3.0, 9.0], forces=[1e4] * 3, masses=[0.0, 300.0, 200.0], speed=30.0)
    ),
    "a half car": _road(
        jb.vehicles.HalfCar(
            3e3,
            4e3,
            [1.5, -1.5],
            [200.0] * 2,
            [1e5] * 2,
            [4e3] * 2,
            [1e6] * 2,
            [0.0] * 2,
            speed=30.0,
        )
    ),
    "a varying force": _road(
        jb.VaryingForce(force=1e4, frequencies=[6.0], amplitudes=[3e3], speed=30.0)
    ),
    "a law in continuous time": rig(jb.Feedback([2e3, 1e3])),
    "prescribed in continuous time": rig(
        jb.Prescribed([0.1, 0.2], times=[0.0, 0.1, 0.3], values=[[0.0, 1.0, -1.0], [2.0, 0.0, 1.0]])
    ),
    "a mass that stops": _road(jb.MovingMass(mass=500.0, speed=25.0, deceleration=20.0)),
    "a load within the run": _road(jb.MovingForce(force=1e4, speed=30.0, entry_time=0.4)),
}


def answers(name: str) -> dict[str, list]:
    """Peaks, contact, and samples of the histories of the run of a case; None for NaN."""
    exact = {"tolerance": 1e-12} if name in OTHER_STEPS else {}
    in_steps = SampleTiming.varying if name not in LONG_STEPS else lambda timing, plant: timing
    with mock.patch.object(SampleTiming, "varying", in_steps):
        record = jb.simulate(CASES[name], **exact)
    rows = np.linspace(0, record.times.size - 1, SAMPLES + 2).astype(int)[1:-1]
    parts = {
        "peaks": record.peak_deflection,
        "largest": record.largest,
        "contact": record.lowest_contact_force,
        "lost": record.contact_lost_time,
        "coordinates": record.coordinates[rows],
        "accelerations": record.accelerations[rows],
        "forces": record.contact_force[rows],
        "commands": record.command[rows],
        "bodies": record.body_displacement[rows],
    }
    return {name: _rounded(part) for name, part in parts.items() if np.size(part)}


def _rounded(part) -> list:
    """Numbers of an array to twelve digits, None for NaN."""
    return [None if np.isnan(x) else float(f"{x:.12g}") for x in np.ravel(part)]


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("ignore")
    found = {name: answers(name) for name in CASES}
    print(json.dumps(found))


FOLDER = Path(__file__).parents[1] / "data" / "release_0_1_0"
OVER = {"loads.0.mass": [0.2, 0.5, 0.8], "loads.0.speed": [1.0, 2.0]}


def test_a_record_holds_the_same_run():
    record = read_record(FOLDER / "record.nc")
    case = jb.replace(jb.load_case(FOLDER / "case.toml"), {"run.sample_rate": 50.0})
    again = jb.simulate(case)
    assert_allclose(record.deflection, again.deflection, rtol=1e-6, atol=1e-10)
    assert_allclose(record.command, again.command, rtol=1e-6, atol=1e-7)


def test_a_sweep_holds_the_same_peaks(tmp_path):
    case = jb.load_case(FOLDER / "case.toml")
    runs = xarray.open_zarr(FOLDER / "runs.zarr", consolidated=False).load()
    again = jb.sweep(case, OVER, progress=False)
    assert_allclose(runs.peak_deflection, again.peak_deflection, rtol=1e-6)
    store = tmp_path / "runs.zarr"
    shutil.copytree(FOLDER / "runs.zarr", store)
    with pytest.raises(ValueError, match="by another version: it cannot be resumed .* overwrite"):
        jb.sweep(case, OVER, store=store, resume=True, progress=False)


def test_a_fit_holds_its_parameters_logs_and_cases():
    fit = load_fit(FOLDER.with_name("release_0_2_0") / "fit.npz")
    (parameter,) = fit.parameters
    assert parameter.address == "beam.flexural_rigidity"
    assert_allclose(fit.values, 10.99979, atol=6e-4)  # as printed by that release
    assert jb.load_case(FOLDER / "fit.toml").beam.flexural_rigidity == fit.values[0]
    (log,) = read_logs(FOLDER / "log_1.csv")
    assert_allclose(fit.dataset.logs[0].values, log.values)


@pytest.mark.parametrize("ending", ["csv", "mat"])
def test_gains_hold_the_same_numbers(ending):
    gains = read_gains(FOLDER / f"regulator.{ending}")
    again = export_gains(jb.load_case(FOLDER / "regulator.toml"))
    assert (gains.period, gains.columns, gains.commands) == (0.002, again.columns, again.commands)
    for part in ARRAYS:
        expected = getattr(again, part)
        atol = 1e-6 * np.abs(expected).max(initial=0.0)
        assert_allclose(getattr(gains, part), expected, rtol=0, atol=atol, err_msg=part)


def test_a_table_of_gains_holds_the_numbers_of_its_file():
    gains = read_gains(FOLDER / "table.csv")  # which agree with its check values
    assert_allclose(gains.shares, np.linspace(0, 1, 6))
    expected = [85567.1939, 114808.3578, 436.6325, 210.4399]  # as printed in the file
    assert_allclose(gains.table[0, 0, 1, 0], expected, rtol=1e-6)


def test_former_kinds_are_named_with_their_present_word():
    with pytest.raises(ValueError, match="'passage'; it is called 'feedforward' now"):
        jb.load_case(FOLDER / "feedforward.toml")


# Other kinds by `--set`: what stays, what is left out, and what is said.

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


KEPT = json.loads((pathlib.Path(__file__).parents[1] / "data/release_0_2_0.json").read_text())
TOLERANCE = 1e-9  # relative to the largest entry of each array
bilateral = pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")


@bilateral
@pytest.mark.parametrize("name", CASES)
def test_answers_are_those_of_version_0_2_0(name):
    found = answers(name)
    assert found.keys() == KEPT[name].keys()
    for part, kept in KEPT[name].items():
        ours, theirs = np.array(found[part], float), np.array(kept, float)
        scale = np.max(np.abs(theirs), initial=0.0, where=np.isfinite(theirs))
        assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE * scale, err_msg=part)


@bilateral
@pytest.mark.parametrize("name", OTHER_STEPS)
def test_peaks_of_other_steps_differ_by_the_stated_error(name):
    record, kept = jb.simulate(CASES[name]), np.array(KEPT[name]["peaks"])
    stated = 1.5 * float(record.error_estimate) * kept.max()
    assert_allclose(record.peak_deflection, kept, rtol=0, atol=stated)
