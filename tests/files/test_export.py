"""Files of gains: exact round trips, equal commands by the C header, and damaged files."""

import dataclasses
import importlib.util
import json
import shutil
import subprocess
import zlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
import scipy.io
import scipy.signal
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.cli import main
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.lqr import LQR
from jaxbeam.export import Gains, export_gains, read_gains, write_gains
from jaxbeam.model.modes import mesh_layout

RANDOM = np.random.default_rng(0)
SIGNALS = (tuple((f"q_{i}", "m kg^0.5") for i in range(4)), (("u_0", "V"), ("u_1", "N")))
FILTER = np.insert(scipy.signal.butter(3, 0.1, output="sos"), 0, 1.0, axis=1)
POINTS = np.sort(np.append(RANDOM.uniform(0, 1, 9), [0.0, 1.0]))


def random_gains(masses, speeds, decay_time=np.inf, interpolation="interpolated") -> Gains:
    """Gains of four states and two actuators at 11 shares."""
    masses, speeds = np.array(masses), np.array(speeds)
    grid = masses.size, speeds.size
    table = 1e3 * RANDOM.normal(size=(*grid, POINTS.size, 2, 4))
    rest = RANDOM.normal(size=(*grid, 2, 4))
    numbers = 2e-3, 0.6, decay_time, interpolation
    return Gains(masses, speeds, POINTS, table, rest, FILTER, *numbers, *SIGNALS)


TABLE = random_gains([0.0], [0.0])
FAMILY = random_gains([0.2, 0.3, 0.5], [1.0, 2.5], decay_time=0.07)
NEAREST = dataclasses.replace(FAMILY, interpolation="nearest")
CONSTANT = dataclasses.replace(
    TABLE,
    shares=np.zeros(1),
    table=TABLE.rest[:, :, None],
    filters=np.zeros((0, 7)),
    crossing_time=0.0,
)
# Estimator of five states, of which four are fed back; two commands, three readings.
ESTIMATED = dataclasses.replace(CONSTANT, estimator=RANDOM.normal(size=(8, 12)), reading_count=3)
ALL_GAINS = {
    "table": TABLE,
    "constant": CONSTANT,
    "family": FAMILY,
    "nearest": NEAREST,
    "estimated": ESTIMATED,
}
all_gains = pytest.mark.parametrize("gains", ALL_GAINS.values(), ids=ALL_GAINS)
SHARES = [-0.1, 0.0, 0.37, 0.5, float(POINTS[4]), 0.999, 1.0, 1.7]
SINCE = [0.0] * 7 + [0.11]
MASSES = [0.3, 0.1, 0.2, 0.24, 0.3, 0.44, 0.5, 0.8]
SPEEDS = [1.0, 2.0, 1.7, 0.5, 3.0, 2.5, 2.4, 1.1]
INPUTS = list(zip(SHARES, SINCE, MASSES, SPEEDS, strict=True))
STATES = RANDOM.normal(size=(len(SHARES), 4))
WEIGHTS = {"state_weight": [1e3, 1e2, 0.1, 0.01, 0.0], "command_weight": [9e-5], "period": 2e-3}
TDMS = pytest.mark.skipif(importlib.util.find_spec("nptdms") is None, reason="needs npTDMS")
COMPILER = shutil.which("gcc") or shutil.which("cc")


def assert_equal_gains(found, expected):
    for field in dataclasses.fields(Gains):
        assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


@all_gains
@pytest.mark.parametrize("ending", [".csv", ".mat", pytest.param(".tdms", marks=TDMS)])
def test_gains_of_a_file_give_the_same_commands(gains, ending, tmp_path):
    path = tmp_path / f"gains{ending}"
    write_gains(gains, path)
    stored = read_gains(path)
    assert_equal_gains(stored, gains)
    for inputs, state in zip(INPUTS, STATES, strict=True):
        assert_array_equal(stored.command(state, *inputs), gains.command(state, *inputs))
    with pytest.raises(FileExistsError, match="exists already"):
        write_gains(gains, path)


@all_gains
def test_gains_are_interpolated(gains):
    """As by numpy and scipy; no command before the entry, the decaying gain after the exit."""
    method = "nearest" if gains.interpolation == "nearest" else "linear"
    grid, points = gains.rest.shape[:2], gains.shares.size
    along = np.moveaxis(gains.table, 2, -1).reshape(-1, points)
    for (share, since, mass, speed), state in zip(INPUTS, STATES, strict=True):
        members = np.array([np.interp(share, gains.shares, one) for one in along])
        if share >= 1 and points > 1:
            members = gains.rest.ravel() * np.exp(-since / gains.decay_time)
        members = members.reshape(gains.rest.shape)
        gain = members[0, 0]
        if grid != (1, 1):
            axes = gains.masses, gains.speeds
            clipped = np.clip([mass, speed], [g[0] for g in axes], [g[-1] for g in axes])
            (gain,) = scipy.interpolate.interpn(axes, members, clipped, method)
        expected = -gain @ state if share >= 0 else np.zeros(2)
        found = gains.command(state, share, since, mass, speed)
        assert_allclose(found, expected, rtol=1e-11, atol=1e-10)


def test_files_are_readable_by_other_programs(tmp_path):
    write_gains(TABLE, tmp_path / "gains.mat")
    content = scipy.io.loadmat(tmp_path / "gains.mat")
    assert_array_equal(content["table"], TABLE.table)
    assert content["rest"].shape == (1, 1, 2, 4)
    assert content["period"].item() == 2e-3
    write_gains(TABLE, tmp_path / "gains.csv")
    first, heading, *rows = (tmp_path / "gains.csv").read_text().splitlines()
    header = json.loads(first[2:])
    assert header["period_s"] == 2e-3 and header["columns"][0] == ["q_0", "m kg^0.5"]
    assert heading.split(",")[4] == "K u_0/q_0 [V/(m kg^0.5)]"
    numbers = [float(x) for row in rows if row.startswith("gain") for x in row.split(",")[3:]]
    shares, table = np.array(numbers).reshape(11, 9)[:, 0], np.array(numbers).reshape(11, 9)[:, 1:]
    parts = [[2e-3, 0.6, np.inf, 0.0, 0.0], shares, table, TABLE.rest, TABLE.filters]
    content_bytes = np.concatenate([np.ravel(part) for part in parts]).astype("<f8").tobytes()
    assert header["crc32"] == zlib.crc32(content_bytes)


@pytest.mark.parametrize("ending", [".csv", ".mat"])
def test_changed_numbers_are_refused(ending, tmp_path):
    path = tmp_path / f"gains{ending}"
    write_gains(TABLE, path)
    number = TABLE.table[0, 0, 3, 1, 2]
    if ending == ".csv":
        path.write_text(path.read_text().replace(repr(float(number)), repr(float(number) + 1e-9)))
    else:
        content = scipy.io.loadmat(path)
        content["table"][0, 0, 3, 1, 2] += 1e-9
        scipy.io.savemat(path, {k: v for k, v in content.items() if not k.startswith("__")})
    with pytest.raises(ValueError, match="contradict the check values"):
        read_gains(path)


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
@all_gains
def test_c_header_gives_the_same_commands(gains, tmp_path):
    write_gains(gains, tmp_path / "gains.h")
    calls = "".join(
        f"{{ double z[] = {{{', '.join(map(repr, state.tolist()))}}};\n"
        f"jaxbeam_command({mass!r}, {speed!r}, {share!r}, {since!r}, z, u);\n"
        'printf("%a %a\\n", u[0], u[1]); }\n'
        for (share, since, mass, speed), state in zip(INPUTS, STATES, strict=True)
    )
    (tmp_path / "run.c").write_text(
        '#include <stdio.h>\n#include "gains.h"\n'
        f"int main(void) {{ double u[JAXBEAM_ACTUATORS];\n{calls}"
        'printf("%a %a\\n", jaxbeam_test_command[0], jaxbeam_test_command[1]); return 0; }\n'
    )
    build = [COMPILER, "-std=c99", "-O2", "-ffp-contract=off", "-o", "run", "run.c", "-lm"]
    subprocess.run(build, cwd=tmp_path, check=True)
    printed = subprocess.run(
        [tmp_path / "run"], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    found = [[float.fromhex(word) for word in line.split()] for line in printed]
    expected = [gains.command(z, *inputs) for inputs, z in zip(INPUTS, STATES, strict=True)]
    assert_array_equal(found, [*expected, gains.test_command])


def shaker_case(controller):
    """Beam with a shaker, two sensors, of which one has a filter, and a crossing mass."""
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.Shaker(0.25, 2000.0, 5.0)],
        sensors=[jb.Sensor(0.2), jb.Sensor(0.45, filter=jb.Filter(60.0, 3))],
        loads=[jb.MovingMass(mass=0.4, speed=1.0)],
        controller=controller,
    )


@pytest.fixture(scope="module")
def sampled():
    case = shaker_case(LQR(**WEIGHTS, delay=1e-3, sampling="exact"))
    return case, export_gains(case)


def test_command_line_exports_the_designed_gains(sampled, tmp_path, capsys):
    case, gains = sampled
    jb.save_case(case, tmp_path / "case.toml")
    path = tmp_path / "gains.csv"
    with pytest.raises(SystemExit) as ended:
        main(["export", str(tmp_path / "case.toml"), "-o", str(path), "--json"])
    assert ended.value.code == 0
    assert json.loads(capsys.readouterr().out)["crc32"] == gains.checksum
    assert_equal_gains(read_gains(path), gains)
    assert gains.columns[-1] == ("last_command_0", "V") and gains.commands == (("command_0", "V"),)
    assert_array_equal(gains.filters[:, 0], [1.0, 1.0])
    sections = scipy.signal.butter(3, 60.0, fs=500.0, output="sos")
    _, expected = scipy.signal.freqz_sos(sections, [10.0, 60.0], fs=500.0)
    _, found = scipy.signal.freqz_sos(gains.filters[:, 1:], [10.0, 60.0], fs=500.0)
    assert_allclose(found, expected, rtol=1e-9)


def test_table_has_the_gains_of_the_design():
    case = shaker_case(LQR(**WEIGHTS, points=210, after="hold", horizon="crossing"))
    gains, layout = export_gains(case, 51), mesh_layout(case)

    @eqx.filter_jit
    def designed(case):
        table = case.controller.gain_table(jb.state_space(case, layout=layout))
        return jnp.stack([table(jnp.asarray(share)) for share in (0.0, 0.5, 0.98, 1.0)])

    found = gains.table[0, 0, [0, 25, 49, 50]]
    assert_allclose(found, designed(case), rtol=1e-9, atol=1e-9 * np.max(np.abs(found)))
    assert gains.crossing_time == pytest.approx(0.6)


@pytest.mark.parametrize("between", ["interpolated", "nearest"])
def test_gain_family_gives_the_commands_of_the_controller(between, tmp_path):
    """Between masses of the grid, along the crossing, and during the decay after it."""
    end = {"terminal_weight": [1e3, 1e2, 0.1, 0.01, 1e-3], "after": "fade", "fade_time": 0.05}
    family = {"masses": [0.2, 0.4], "between": between, "augmented": "loads"}
    controller = LQR(**WEIGHTS, **end, **family, points=210, horizon="crossing", schedule="load")
    case = jb.replace(shaker_case(controller), {"loads.0.mass": 0.25})
    write_gains(export_gains(case, 11), tmp_path / "gains.csv")
    gains, layout = read_gains(tmp_path / "gains.csv"), mesh_layout(case)
    shares = np.array([-0.1, 0.2, 0.5, 1.0 + 1e-9, 1.5])
    states = RANDOM.normal(size=(shares.size, 5)) * [1e-3, 1e-4, 0.03, 0.01, 0.2]

    @eqx.filter_jit
    def commands(case, states, times):
        law = case.controller.law(jb.state_space(case, layout=layout))

        def command(state, t):
            measurement = Measurement(jnp.zeros(2), state, jnp.zeros(1))
            return law.step(law.initial_state(), measurement, t).command

        return jax.vmap(command)(states, times)

    expected = commands(case, jnp.asarray(states), jnp.asarray(0.6 * shares))
    weight = 0.25 * 9.81
    for state, share, command in zip(states, shares, expected, strict=True):
        since = max(0.0, 0.6 * (share - 1))
        found = gains.command(np.append(state, weight), share, since, 0.25, 1.0)
        assert_allclose(found, command, rtol=1e-9)
    assert gains.columns[-1] == ("load_0", "N")
    assert gains.crossing_time == pytest.approx(0.6) and gains.decay_time == 0.05


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (Feedback([1.0], period=1e-3), "controller.kind cannot be exported"),
        (jb.StateFeedback([[0.0] * 5]), "controller.period is missing"),
        (
            jb.LQR(**WEIGHTS, estimator=jb.Kalman(0.02, 1e-5, loads="known")),
            "controller.estimator cannot be exported: its gain must not change",
        ),
        (jb.LQR(**WEIGHTS, estimator=jb.Inversion()), "controller.estimator cannot be exported"),
    ],
)
def test_controllers_that_cannot_be_exported(controller, message):
    case = dataclasses.replace(shaker_case(controller), sensors=(jb.Sensor(0.2),))
    with pytest.raises(ValueError, match=message):
        export_gains(case)


def test_unknown_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"gains are written to .csv, .mat, .tdms, .h"):
        write_gains(TABLE, tmp_path / "gains.txt")
    with pytest.raises(ValueError, match=r"gains are read from .csv, .mat, .tdms"):
        read_gains(tmp_path / "gains.h")
    (tmp_path / "other.csv").write_text("time [s]\n1.0\n")
    with pytest.raises(ValueError, match="not a file of gains"):
        read_gains(tmp_path / "other.csv")


# Exported estimators: the C header and a file that is read estimate as in a simulation.


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_c_header_gives_the_same_estimate(tmp_path):
    write_gains(ESTIMATED, tmp_path / "gains.h")
    (tmp_path / "run.c").write_text(
        '#include <stdio.h>\n#include "gains.h"\nint main(void) {\n'
        "double x[] = {1.0, 1.0/2, 1.0/3, 1.0/4, 1.0/5}, u[] = {1.0, 1.0/2};\n"
        "double y[] = {1.0, 1.0/2, 1.0/3}; int i; jaxbeam_estimate(x, u, u, y);\n"
        'for (i = 0; i < JAXBEAM_ESTIMATED; i++) printf("%a\\n", x[i]); return 0; }\n'
    )
    build = [COMPILER, "-std=c99", "-O2", "-ffp-contract=off", "-o", "run", "run.c"]
    subprocess.run(build, cwd=tmp_path, check=True)
    printed = subprocess.run(
        [tmp_path / "run"], capture_output=True, text=True, check=True
    ).stdout.split()
    assert_array_equal([float.fromhex(word) for word in printed], ESTIMATED.test_estimate)
    A, B, late, L = np.split(ESTIMATED.estimator[:5], [5, 7, 9], axis=1)
    C, _, D, offset = np.split(ESTIMATED.estimator[5:], [5, 7, 9], axis=1)
    x, u, y = (1 / np.arange(1.0, n + 1) for n in (5, 2, 3))
    prior = A @ x + (B + late) @ u
    expected = prior + L @ (y - C @ prior - D @ u - offset[:, 0])
    assert_allclose(ESTIMATED.test_estimate, expected, rtol=1e-12)


@pytest.mark.parametrize("estimator", [jb.Kalman(0.02, 1e-5), jb.Observer(speed=2.0)])
def test_exported_estimator_gives_the_commands_of_a_simulation(estimator, tmp_path):
    """From the readings of a run alone, with a digital filter and a delay in the loop."""
    law = jb.LQR(**WEIGHTS, delay=1e-3, estimator=estimator)
    case = shaker_case(law)
    if isinstance(estimator, jb.Kalman):
        delayed = dataclasses.replace(case.sensors[0], delay=jnp.asarray(1e-3))
        case = dataclasses.replace(case, sensors=(delayed, case.sensors[1]))
    write_gains(export_gains(case), tmp_path / "gains.csv")
    gains = read_gains(tmp_path / "gains.csv")
    times = 2e-3 * jnp.arange(60)
    record = jb.simulate(case, times)
    # A command begins half a period after its sample, so it acts at the next sample.
    commands, state = [np.zeros(1), np.zeros(1)], np.zeros(gains.estimator_size)
    for reading in np.asarray(record.measured):
        state = gains.estimate(state, commands[-2], commands[-1], reading)
        commands.append(gains.command(state[: len(gains.columns)]))
    found = np.array(commands[1:-1])[:, 0]
    size = np.max(np.abs(record.command))
    assert size > 0
    assert_allclose(found, record.command[:, 0], rtol=0, atol=1e-9 * size)
