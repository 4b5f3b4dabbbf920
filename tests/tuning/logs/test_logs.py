"""Logs read from text written by the tests, with known values.

Readings that a logger repeats, and zeros in their place, are told from the sensor's own.
"""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxbeam as jb
from jaxbeam.case.loads.base import MovingMass
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.case.validation import check_case
from tests.oracles.planted_structures import Structure, random_structure, response
from tests.tuning.small_rig import rig
from tuning import Log, ModalSettings, identify_modes, read_log
from tuning.fit.dataset import case_of_log, check_loads, pad_cases
from tuning.logs import find_faults, mask
from tuning.logs.quality import samples_held, sensor_readings, unread
from tuning.logs.units import UNITS, unit
from tuning.modal.decay.stretches import excited_samples

EXPECTED = [[1.5e-3, -2e-3], [2.5e-3, 0.0], [3.5e-3, 1e-3]]
FORMATS = {
    "comma": "time [s],d1 [mm],d2 [mm]\n0,1.5,-2\n0.1,2.5,0\n0.2,3.5,1\n",
    "semicolon, decimal comma": "time (s);d1 (mm);d2 (mm)\n0;1,5;-2\n0,1;2,5;0\n0,2;3,5;1\n",
    "semicolon, decimal point": "time (s);d1 (mm);d2 (mm)\n0;1.5;-2\n0.1;2.5;0\n0.2;3.5;1\n",
    "tab": "time [ms]\td1 [mm]\td2 [µm]\n0\t1.5\t-2e3\n100\t2.5\t0\n200\t3.5\t1000\n",
    "comments and blank lines": "# rig\n\ntime [s],d1 [mm],d2 [m]\n0,1.5,-2e-3\n\n0.1,2.5,0\n"
    "0.2,3.5,1e-3\n",
    "trailing separators": "time [s],d1 [mm],d2 [mm],\n0,1.5,-2,\n0.1,2.5,0,\n0.2,3.5,1,\n",
    "quotes": '"time [s]","d1 [mm]","d2 [mm]"\n"0","1.5","-2"\n0.1,2.5,0\n0.2,3.5,1\n',
    "time elsewhere": "d1 [mm],t [s],d2 [mm]\n1.5,0,-2\n2.5,0.1,0\n3.5,0.2,1\n",
    "time by unit": "clock [s],d1 [mm],d2 [mm]\n0,1.5,-2\n0.1,2.5,0\n0.2,3.5,1\n",
}


def write(folder, text, name="run.csv", encoding="utf-8"):
    path = folder / name
    path.write_text(text, encoding=encoding)
    return path


@pytest.mark.parametrize("text", FORMATS.values(), ids=FORMATS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_separated_values(tmp_path, text, encoding):
    log = read_log(write(tmp_path, text, encoding=encoding))
    assert log.names == ("d1", "d2")
    assert log.quantities == ("deflection", "deflection")
    np.testing.assert_allclose(log.times, [0, 0.1, 0.2], rtol=1e-15)
    np.testing.assert_allclose(log.values, EXPECTED, rtol=1e-14)
    assert log.sample_rate == pytest.approx(10)


def test_declared_columns_and_units(tmp_path):
    path = write(tmp_path, "stamp,a,b\n0,1,2\n1,3,4\n2,5,6\n")
    log = read_log(path, columns=["b", "a"], units={"stamp": "ms", "a": "g", "b": "um/m"},
                   time="stamp")  # fmt: skip
    assert (log.names, log.units) == (("b", "a"), ("um/m", "g"))
    assert log.quantities == ("strain", "acceleration")
    np.testing.assert_allclose(log.values[:, 0], [2e-6, 4e-6, 6e-6])
    np.testing.assert_allclose(log.values[:, 1], [9.80665, 29.41995, 49.03325])
    np.testing.assert_allclose(log.times, [0, 1e-3, 2e-3])


def test_one_unit_for_all_channels(tmp_path):
    log = read_log(write(tmp_path, "t [s],a,b\n0,1,2\n1,3,4\n"), units="mm")
    np.testing.assert_allclose(log.values, [[1e-3, 2e-3], [3e-3, 4e-3]])


def unchecked_log(times, values) -> Log:
    """A log past the check of its types, which only tests have."""
    log = object.__new__(Log)
    given = {"names": ("w",), "quantities": ("deflection",), "units": ("m",)}
    for name, value in ({"times": times, "values": values} | given).items():
        object.__setattr__(log, name, value)
    log.__post_init__()
    return log


def test_shapes_of_samples_are_said_and_lists_taken():
    """They were errors of NumPy and of lists."""
    assert unchecked_log([0.0, 0.1], [[0.0], [1.0]]).values.shape == (2, 1)
    message = r"times must be \(time,\) and values \(time, channel\), not of the shapes"
    for times, values in (([0.0, 0.1], [0.0, 1.0]), ([0.0], [[0.0], [1.0]])):
        with pytest.raises(ValueError, match=message):
            unchecked_log(times, values)


def test_a_log_prints_its_channels_not_its_samples(tmp_path):
    log = read_log(write(tmp_path, FORMATS["comma"]))
    log = dataclasses.replace(log, sensors=(1, None), actuators=(None, 0))
    first, *channels = repr(log).splitlines()
    assert first.endswith("run.csv: 3 samples in 0.2 s")
    expected = ["  d1: deflection in mm, sensor 1", "  d2: deflection in mm, actuator 0"]
    assert channels == expected


def test_a_log_cannot_be_changed(tmp_path):
    log = read_log(write(tmp_path, FORMATS["comma"]))
    with pytest.raises(ValueError, match="read-only"):
        log.values[0, 0] = 1.0
    with pytest.raises(AttributeError):
        log.names = ("x", "y")


def test_file_beside_the_log(tmp_path):
    path = write(tmp_path, "t,left,right,room\n0,1,2,20\n100,3,4,20\n")
    write(
        tmp_path,
        '[columns]\nt = "ms"\nright = { unit = "mm", sensor = 1, position = 0.4 }\nleft = "mm"\n'
        "[[loads]]\nkind = 'mass'\nmass = 0.5\nspeed = 0.55\n"
        '[[loads]]\nkind = "force"\nforce = 3\nspeed = -1\nentry_time = 0.2\n',
        "run.toml",
    )
    log = read_log(path)
    assert log.names == ("right", "left")
    assert log.sensors == (1, None)
    assert log.positions == (0.4, None)
    np.testing.assert_allclose(log.values, [[2e-3, 1e-3], [4e-3, 3e-3]])
    assert isinstance(log.loads[0], MovingMass)
    assert float(log.loads[1].entry_time) == 0.2
    assert read_log(path, columns=["left"], units={"left": "m"}).values[0, 0] == 1.0


def test_case_file_with_the_name_of_the_log(tmp_path):
    write(tmp_path, "[beam]\nlength = 1.0\n", "run.toml")
    assert read_log(write(tmp_path, FORMATS["comma"])).loads is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colums = 1", "unknown key colums; did you mean 'columns'"),
        ("[columns]\nd1 = {units = 'mm'}", "unknown key columns.d1.units; did you mean 'unit'"),
        ("[columns]\nd1 = {sensor = 0.5}", "columns.d1.sensor must be a whole number"),
        ("[columns]\nd1 = 3", "columns.d1: give a unit"),
        ("[columns]\nd3 = 'mm'", "no column 'd3'; did you mean 'd1'|no column 'd3'"),
        ("[[loads]]\nkind = 'mass'\nmas = 1", "loads.0 has no key 'mas'; .*'mass'"),
        ("[[loads]]\nkind = 'tram'", "loads.0.kind cannot be 'tram'"),
        ("[[loads]]\nkind = 'mass'\nspeed = 1", "run.toml: loads.0.mass"),
        ("[columns", "run.toml: "),
    ],
)
def test_mistakes_beside_the_log(tmp_path, text, message):
    write(tmp_path, text, "run.toml")
    with pytest.raises(ValueError, match=message):
        read_log(write(tmp_path, FORMATS["comma"]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "run.csv: the log is empty"),
        ("# only a comment\n", "the log is empty"),
        ("t [s],d [mm]\n", "the log is empty: there are column names but no rows"),
        ("t [s],d [mm]\n0,1\n1," + 50 * "x", f"line 3, column 'd': '{37 * 'x'}...' is no number"),
        ("# a comment\ntime [s],", "the log is empty: it has no row of numbers"),
        ("***End_of_Header***\t\nt", "the log is empty: it has no row of numbers"),
        ("t [s],d [mm]\n0,1\n", "at least two samples"),
        ("0,1\n1,2\n", "line 1: the file has no headings"),
        ("t [s],d [mm]\n0,1\n1,x\n", "line 3, column 'd': 'x' is no number"),
        (
            "t [s],d [mm]\n0,1\n1,\n",
            "line 3, column 'd': the cell is empty",
        ),
        ("t [s],d [mm]\n0,1\n\n1,nan\n", "line 4, column 'd': the cell is empty"),
        ("t [s],d [mm]\n0,1\n1,inf\n", "line 3, column 'd': inf is not finite"),
        ("t [s],d [mm]\n0,1\n1,2,3\n", "line 3: 3 cells for 2 columns"),
        ("t [s],d [mm]\n0,1\n1,2\n1,3\n", "line 4: time 1 s is repeated"),
        ("t [s],d [mm]\n0,1\n2,2\n1,3\n", "line 4: time 1 s comes after 2 s"),
        ("t [s],d [parsec]\n0,1\n1,2\n", "column 'd': unknown unit 'parsec'"),
        ("t,d [mm]\n0,1\n1,2\n", r"column 't': no unit found; write it in the heading, t \[s\]"),
        ("t [s],d\n0,1\n1,2\n", r"column 'd': no unit found; write it in the heading, d \[mm\]"),
        ("t [mm],d [mm]\n0,1\n1,2\n", "the column of times, 't', has the unit 'mm'"),
        ("a [mm],d [mm]\n0,1\n1,2\n", "no column is called time"),
        ("t [s],,d [mm]\n0,1,1\n1,2,2\n", "column 2 has no name"),
        ("t [s];d [mm]\n0;1,5\n1;2.5\n", "lines 2 and 3: numbers have both decimal commas"),
        ("t [s]\n0\n1\n", "no column besides the time"),
    ],
)
def test_mistakes(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read_log(write(tmp_path, text))


def test_mistaken_arguments(tmp_path):
    path = write(tmp_path, "time [s],left [mm]\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="no column 'lefft'; did you mean 'left'"):
        read_log(path, columns=["lefft"])
    with pytest.raises(ValueError, match="no column 'lef'; did you mean 'left'"):
        read_log(path, units={"lef": "mm"})
    with pytest.raises(ValueError, match="no column 'tiem'; did you mean 'time'"):
        read_log(path, time="tiem")
    with pytest.raises(ValueError, match="there is no such log"):
        read_log(tmp_path / "nothing.csv")
    with pytest.raises(ValueError, match="unknown kind of log '.xls'"):
        read_log(write(tmp_path, "x", "run.xls"))


def make(times):
    values = np.zeros((len(times), 1))
    return Log(np.asarray(times, float), values, ("a",), ("deflection",), ("m",))


def test_sample_rate_follows_from_the_times():
    rounded = np.round(np.arange(2000) / 2048, 4)  # half the last printed digit: 0.1 of a step
    assert make(rounded).sample_rate == pytest.approx(2048, rel=1e-3)
    uneven = make(np.r_[0, 1, 2, 3, 5, 6])
    assert uneven.duration == 6
    with pytest.raises(ValueError, match="not sampled evenly .at t = 3 s"):
        _ = uneven.sample_rate


def test_inconsistent_times_and_names_are_refused():
    with pytest.raises(ValueError, match="sample 2: time 0.5 s comes after 1 s"):
        make([0, 1, 0.5])
    with pytest.raises(ValueError, match="2 names for 1 channels"):
        Log(np.arange(3.0), np.zeros((3, 1)), ("a", "b"), ("deflection",), ("m",))


def test_numbers_too_large_for_their_unit_are_missing_samples(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(
        "t [s],a [g]\n" + "".join(f"{t / 100},{1e308 if t == 7 else t}\n" for t in range(20))
    )
    assert "1 missing samples of a are left out" in read_log(path, missing="mask").notes
    with pytest.raises(ValueError, match="line 9, column 'a'"):
        read_log(path)


def test_long_names_and_units_are_refused_in_a_sentence(tmp_path):
    """Found by fuzzing: a damaged length of a text makes it a name or unit of a thousand bytes."""
    path = tmp_path / "run.csv"
    for what, heading in (("name", "a" * 500 + " [mm]"), ("unit", f"a [{'m' * 500}]")):
        path.write_text(f"t [s],{heading}\n" + "".join(f"{t},0\n" for t in range(20)))
        with pytest.raises(ValueError, match=f"the {what} of column 2 has 500 characters") as error:
            read_log(path)
        assert len(str(error.value)) < 300


# Units against their definitions.


@pytest.mark.parametrize(
    ("text", "si", "factor", "quantity"),
    [
        ("mm", "m", 1e-3, "deflection"),
        ("µm", "m", 1e-6, "deflection"),
        ("in", "m", 0.0254, "deflection"),
        ("g", "m/s^2", 9.80665, "acceleration"),
        ("mg", "m/s^2", 9.80665e-3, "acceleration"),
        ("m/s²", "m/s^2", 1.0, "acceleration"),
        ("cm/s²", "m/s^2", 0.01, "acceleration"),
        ("Gal", "m/s^2", 0.01, "acceleration"),
        ("ft/s^2", "m/s^2", 0.3048, "acceleration"),
        ("um/s", "m/s", 1e-6, "velocity"),
        ("m/s2", "m/s^2", 1.0, "acceleration"),
        ("deg", "rad", math.pi / 180, "slope"),
        ("°", "rad", math.pi / 180, "slope"),
        ("µε", "1", 1e-6, "strain"),
        ("kN", "N", 1e3, "force"),
        ("kips", "N", 1e3 * 0.45359237 * 9.80665, "force"),
        ("mils", "m", 2.54e-5, "deflection"),
        ("m/sec²", "m/s^2", 1.0, "acceleration"),
        (" ms ", "s", 1e-3, "time"),
    ],
)
def test_unit(text, si, factor, quantity):
    assert unit(text) == (si, pytest.approx(factor, rel=1e-15), quantity)


def test_quantities_are_those_of_sensors():
    """The SI unit of each quantity in a log is that of the sensor."""
    for entry in UNITS.values():
        if entry.quantity in QUANTITIES:
            assert entry.si == QUANTITIES[entry.quantity].unit
    assert {entry.si for entry in UNITS.values()} >= {entry.unit for entry in QUANTITIES.values()}


@pytest.mark.parametrize("text", ["milimeter", "G", "kn", "furlong", ""])
def test_unknown_unit(text):
    with pytest.raises(ValueError, match="unknown unit"):
        unit(text)


# Faults put into a clean log are found at their samples, and nowhere else.

TIMES = np.arange(600) / 500
CLEAN = np.column_stack([np.sin(12 * TIMES) * np.exp(-TIMES), np.cos(20 * TIMES)])


def log_of(values=None, times=TIMES, noise=1e-3):
    values = CLEAN if values is None else values
    values = values + noise * np.random.default_rng(0).normal(size=values.shape)
    return Log(times, values, ("a", "b"), ("deflection",) * 2, ("m",) * 2, "run.csv")


def changed(samples, to, log=None):
    """The log with samples of its first channel set to something."""
    log = log or log_of()
    values = np.array(log.values)
    values[samples, 0] = to
    return dataclasses.replace(log, values=values)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.05])
def test_a_clean_log_has_no_faults(noise):
    assert find_faults(log_of(noise=noise)) == []
    steps = np.where(TIMES > 0.5, CLEAN.T, 0.0).T  # a sudden onset is no fault
    assert [f.kind for f in find_faults(log_of(steps, noise=1e-3))] == []
    coarse = np.round(CLEAN / 0.05) * 0.05
    assert find_faults(log_of(coarse, noise=0.0)) == []


def test_spikes():
    (fault,) = find_faults(changed([100, 300], [3.0, -2.0]))
    assert (fault.kind, fault.channel) == ("spikes", "a")
    assert np.flatnonzero(fault.samples).tolist() == [100, 300]
    assert str(fault) == "run.csv: a has spikes (2 samples), first at t = 0.2 s"


def test_ringing_after_an_impact_is_no_spike():
    """Faster than cubics, as a roller on a footbridge, but longer than a single sample."""
    after = np.maximum(TIMES - 0.4, 0.0)
    ringing = np.exp(-5 * after) * np.sin(2 * np.pi * 90 * after)
    assert find_faults(log_of(np.column_stack([ringing, ringing]))) == []


def test_clipped_readings():
    log = log_of()
    values = np.array(log.values)
    values[:, 1] = np.clip(values[:, 1], -0.7, 0.9)
    (fault,) = find_faults(dataclasses.replace(log, values=values))
    assert (fault.kind, fault.channel) == ("saturation", "b")
    clipped = (log.values[:, 1] > 0.9) | (log.values[:, 1] < -0.7)
    assert np.mean(fault.samples[clipped]) > 0.7 and not np.any(fault.samples[~clipped])


def test_a_stuck_channel():
    (fault,) = find_faults(changed(slice(400, 500), 0.123))
    assert fault.kind == "stuck" and np.flatnonzero(fault.samples).tolist() == [*range(400, 500)]


def test_gaps_and_a_drifting_clock():
    indices = np.r_[:200, 230:600]
    (gap,) = find_faults(log_of(CLEAN[indices], TIMES[indices]))
    assert gap.message == "run.csv: about 30 samples are missing after t = 0.398 s"
    drifting_times = TIMES + 0.004 * (TIMES / 1.2) * (1 - TIMES / 1.2) * 4
    (drift,) = find_faults(log_of(times=drifting_times))
    assert "the clock drifts: midway the times are 2 steps" in drift.message
    assert find_faults(log_of(times=np.round(TIMES, 3))) == []


def test_masking_is_on_request_and_noted():
    log = changed(100, 3.0, changed(slice(400, 500), 0.123))
    masked = mask(log, ["spikes"])
    assert np.flatnonzero(~masked.valid[:, 0]).tolist() == [100] and masked.valid[:, 1].all()
    assert masked.notes == ("1 sample of a left out (spikes)",)
    np.testing.assert_array_equal(masked.values, log.values)
    assert [fault.kind for fault in find_faults(masked)] == ["stuck"]
    assert np.sum(~mask(masked, ["stuck"]).valid) == 101
    with pytest.raises(
        ValueError, match="'gaps' cannot be masked; dropouts, spikes, saturation, stuck can"
    ):
        mask(log, ["gaps"])


# Logs matched with cases: loads that must have crossed, or stay on the beam.

SHAKEN_TIMES = np.linspace(0.0, 0.5, 51)
LOG = Log(SHAKEN_TIMES, np.zeros((51, 1)), ("w",), ("deflection",), ("m",), "run.csv")


def case_with(load) -> jb.Case:
    """The small rig without its controller, crossed by a load."""
    return dataclasses.replace(rig(), controller=None, loads=(load,))


def test_a_load_that_stops_on_the_beam_need_not_leave_it():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5, deceleration=5.0)))


def test_a_load_that_leaves_the_beam_must_do_so_within_the_log():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5)))
    with pytest.raises(ValueError, match="before the first load has crossed at 0.6 s"):
        check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.0)))


@pytest.fixture
def shaken_beside_a_spring() -> tuple[jb.Case, Log]:
    """A spring before the patch, and a log of the patch's voltage."""
    rig = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
        actuators=[
            jb.SpringDamper(0.5, stiffness=3000.0, damping=5.0),
            jb.Patch(0.2, 0.3, 0.15, limits=(-3.0, 3.0)),
        ],
        sensors=[jb.Sensor(0.3)],
    )
    times = np.arange(5) * 0.01
    values = np.stack([np.zeros(5), [0.0, 1.0, 2.0, 1.0, 0.5]], axis=1)
    columns = ("w", "u"), ("deflection", "voltage"), ("m", "V"), "shaking"
    return rig, Log(times, values, *columns, loads=(), sensors=(0, None), actuators=(None, 1))


def test_springs_take_no_logged_command(shaken_beside_a_spring):
    rig, log = shaken_beside_a_spring
    times = np.arange(7) * 0.01
    shaken = case_of_log(rig, log, times)
    check_case(shaken)
    np.testing.assert_array_equal(shaken.controller.values, [[0.0, 1.0, 2.0, 1.0, 0.5, 0.5, 0.5]])
    idle, _ = pad_cases([rig, shaken], [times, times])
    check_case(idle)
    assert np.all(idle.controller.values == np.zeros((1, 7)))
    # As a shaker of that suspension with zero volts: the same deflections.
    shaker = jb.Shaker(0.5, stiffness=3000.0, damping=5.0)
    other = dataclasses.replace(rig, actuators=(shaker, rig.actuators[1]))
    run, expected = (jb.simulate(case_of_log(c, log, log.times)) for c in (rig, other))
    np.testing.assert_allclose(
        run.deflection, expected.deflection, rtol=0, atol=1e-12 * np.abs(expected.deflection).max()
    )


def test_a_command_to_a_spring_is_refused(shaken_beside_a_spring):
    rig, log = shaken_beside_a_spring
    wrong = dataclasses.replace(log, actuators=(None, 0))
    with pytest.raises(ValueError, match="u is the command to actuators.0, a spring, which takes"):
        case_of_log(rig, wrong, log.times)


SMOOTH = np.sin(12 * TIMES) * np.exp(-TIMES)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(2.0, 9.0), st.sampled_from([0.0, 1e-3]))
def test_held_readings_are_counted(seed, hold, resolution):
    """A sensor at a rate of its own, asked at the rate of the logger."""
    random = np.random.default_rng(seed)
    readings = random.normal(size=400)
    if resolution:
        readings = np.round(readings / resolution) * resolution
    asked = np.arange(int(390 * hold)) + random.uniform()
    held = samples_held(readings[(asked / hold).astype(int)])
    assert held == pytest.approx(hold, rel=0.02)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 0.3), st.floats(0.0, 0.02))
def test_coarse_readings_are_not_held(seed, resolution, noise):
    values = SMOOTH + noise * np.random.default_rng(seed).normal(size=SMOOTH.size)
    assert samples_held(np.round(values / resolution) * resolution) == 1.0


def test_switches_are_not_held():
    random = np.random.default_rng(0)
    switched = np.repeat(random.integers(0, 9, 200), random.integers(1, 40, 200))
    assert samples_held(1.0 * switched) == 1.0
    assert samples_held(np.zeros(600)) == 1.0 and samples_held(np.repeat(SMOOTH[:9], 4)) == 1.0


def test_zeros_that_are_no_readings():
    gravity = 9.81 + 0.1 * SMOOTH
    gravity[[0, 300]] = 0.0
    assert np.flatnonzero(unread(gravity)).tolist() == [0, 300]
    for values in (SMOOTH, np.abs(SMOOTH), np.zeros(600), np.maximum(SMOOTH, 0), np.ones(600)):
        assert not unread(values).any()
    # Zero is a reading of a positive quantity that varies as much.
    assert not unread(np.r_[0.0, np.random.default_rng(0).uniform(1.0, 2.0, 99)]).any()
    log = Log(TIMES, gravity[:, None], ("a",), ("acceleration",), ("m/s^2",), "node.csv")
    assert str(find_faults(log)[1]) == (
        "node.csv: a reads 0, as if its sensor did not answer (2 samples), first at t = 0 s"
    )
    assert np.sum(~mask(log, ["dropouts"]).valid) == 2


def test_readings_of_a_log_without_such_faults_are_the_log():
    log = Log(TIMES, SMOOTH[:, None], ("a",), ("acceleration",), ("m/s^2",))
    assert sensor_readings(log) is log


def test_samples_left_out_are_interpolated():
    values = SMOOTH.copy()
    values[100] = 5.0
    log = mask(Log(TIMES, values[:, None], ("a",), ("acceleration",), ("m/s^2",)), ["spikes"])
    np.testing.assert_allclose(sensor_readings(log).values[:, 0], SMOOTH, atol=1e-3)


def test_one_channel_that_is_not_held_keeps_the_rate():
    both = np.stack([np.repeat(np.random.default_rng(0).normal(size=150), 4), SMOOTH], axis=1)
    log = Log(TIMES, both, ("a", "b"), ("acceleration",) * 2, ("m/s^2",) * 2)
    assert sensor_readings(log) is log
    assert [str(fault) for fault in find_faults(log)] == ["log: a holds each reading for 4 samples"]


FREQUENCIES, DAMPING = np.array([12.0, 17.5, 26.0]), np.array([0.01, 0.008, 0.006])


def after_an_impact(frequencies, damping, rate, duration):
    """Accelerations (m/s^2) of a structure after one impact, with noise, and its random numbers."""
    whole, random = random_structure(1), np.random.default_rng(0)
    planted = Structure(frequencies, damping, whole.shapes[:3, :1], whole.inputs[:3])
    forces = np.zeros((int(duration * rate), 4))
    forces[16:19, 0] = [1.0, 2.0, 1.0]
    clean = np.gradient(response(planted, forces, rate), 1 / rate, axis=0)
    return 0.3 * clean / clean.std() + 0.005 * random.normal(size=clean.shape), random


def test_steps_of_held_readings_look_like_impacts_and_readings_do_not():
    clean, _ = after_an_impact(FREQUENCIES, DAMPING, 1600.0, 4.0)
    asked = np.arange(int(4 * 7200) - 8) / 7200
    held = np.round(clean[(asked * 1600).astype(int)] - 9.81, 3)
    log = Log(asked, held, ("a",), ("acceleration",), ("m/s^2",))
    excited_late = []
    for one in (log, sensor_readings(log)):
        values = one.values - one.values.mean(axis=0)
        marks = excited_samples(values, one.sample_rate, 1 / FREQUENCIES[0])
        excited_late.append(bool(marks[one.times > 0.1].any()))
    assert excited_late == [True, False]


def test_modes_of_a_hammer_test_from_a_node_that_repeats_readings():
    """As a wireless node writes: gravity, a zero first, readings held, a pause before the impact.

    The modes are those of the same test without these faults, and the truth.
    """
    rate, frequencies, damping = 1600.0, FREQUENCIES, DAMPING
    clean, random = after_an_impact(frequencies, damping, rate, 6.0)
    asked = np.arange(int(6 * 7200) - 8) / 7200 + 1e-4
    held = np.round(clean[(asked * rate).astype(int), 0] - 9.81, 3)
    held[0] = 0.0
    rest = np.round(0.005 * random.normal(size=1800) - 9.81, 3)[(asked[:8000] * rate).astype(int)]
    rest[0] = 0.0
    times = np.r_[np.arange(rest.size) / 7200, rest.size / 7200 + 0.016 + asked]
    columns = ("a",), ("acceleration",), ("m/s^2",)
    log = Log(times, np.r_[rest, held][:, None], *columns)
    fit = identify_modes(log)
    notes = " ".join(fit.notes)
    assert "a reads 0 in 2 samples" in notes and "held for 4.5 samples" in notes
    assert fit.kind == "free decay"
    direct = identify_modes(Log(np.arange(len(clean)) / rate, clean, *columns))
    for one in (fit, direct):
        np.testing.assert_allclose(one.frequencies, frequencies, rtol=2e-3)
        np.testing.assert_allclose(one.damping_ratios, damping, rtol=0.1)
    raw = str(identify_modes(log, settings=ModalSettings(as_logged=True)))
    assert "holds each reading" in raw and "reads 0" in raw and "decimated" not in raw
