"""Random case files, logs and command lines: each is accepted or ends in one error message."""

import contextlib
import io
import tomllib

import pytest
import tomli_w
from hypothesis import example, given, settings, strategies as st

from jaxbeam.cli import main
from jaxbeam.files.case_file import case_from_dict, case_to_dict, load_case
from tests import mutations
from tests.cli.example import CASE as SMALL
from tests.files.test_case_file import FULL
from tests.fuzzing import examples
from tests.tuning.logs import test_readers as readers
from tuning import read_logs

# A case with every table and many optional keys.
CASE = tomllib.loads(FULL) | {
    "beam": {
        "length": 0.6,
        "width": 0.1,
        "height": 0.003,
        "youngs_modulus": 6.5e10,
        "density": 2800.0,
        "damping_ratio": [0.03, 0.02],
        "ends": "pinned-clamped",
        "modes": 2,
    },
    "supports": [{"position": 0.25}, {"position": 0.4, "stiffness": 2e6, "damping": 1.0}],
    "sensors": [
        {
            "position": 0.15,
            "noise": 1e-5,
            "filter": {"cutoff": 10.0, "order": 4},
            "sampling_period": 0.01,
            "delay": 0.01,
        },
        {"position": 0.3, "quantity": "strain", "fibre_distance": 0.001},
    ],
    "controller": {"kind": "feedback", "gains": [1.0, 1.0], "period": 0.01, "delay": 0.001},
}


def assert_one_sentence(error: Exception, start: str) -> None:
    message = str(error)
    assert message.startswith(start) and "\n" not in message and len(message) < 700, message


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@settings(max_examples=examples(300))
@given(mutations.trees(CASE))
@example({"beam": CASE["beam"] | {"length": 10**400}})
def test_random_case_file_is_read_or_refused(folder, tree):
    path = folder / "case.toml"
    path.write_text(tomli_w.dumps(tree), encoding="utf-8")
    try:
        case = load_case(path)
    except ValueError as error:
        assert_one_sentence(error, f"{path}: ")
    else:
        content = case_to_dict(case)
        assert case_to_dict(case_from_dict(content)) == content


@settings(max_examples=examples(100))
@given(mutations.contents(tomli_w.dumps(CASE).encode()))
@example(b"title = " + b"[" * 100_000)
@example(b"modes = " + b"1" * 5000)
def test_damaged_case_file_is_refused(folder, content):
    path = folder / "case.toml"
    path.write_bytes(content)
    with contextlib.suppress(ValueError):
        load_case(path)


ROWS = "".join(
    f"{t:.4f};{a:.5f};{b:.5f}\n"
    for t, a, b in zip(readers.TIMES, readers.D1, readers.D2, strict=True)
)
SEGMENT = (
    "Channels;2\nDate;2020/01/01\nTime;12:00:0{}.5\nY_Unit_Label;mm;mm\nX0;0.0\nDelta_X;0.002\n"
    "***End_of_Header***;\nX_Value;d1;d2;Comment\n"
)
LVM = (
    "LabVIEW Measurement;\nSeparator;Tab\nDecimal_Separator;.\nX_Columns;One\n"
    f"***End_of_Header***;\n\n{SEGMENT.format(0)}{ROWS}{SEGMENT.format(3)}{ROWS}"
)
TEXTS = {
    "points.csv": "# a comment\ntime [s],d1 [mm],d2 [mm]\n" + ROWS.replace(";", ","),
    "commas.csv": "time (s);d1 [mm];d2 (mm)\n" + ROWS.replace(".", ","),
    "run.lvm": LVM.replace(";", "\t"),
}


@pytest.mark.filterwarnings("ignore::tuning.logs.log.LogWarning")
@pytest.mark.parametrize("name", [*TEXTS, *readers.FORMATS])
def test_damaged_log_is_read_or_refused(folder, name, capfd):
    path = folder / name
    if name in TEXTS:
        path.write_text(TEXTS[name])
    else:
        readers.FORMATS[name](path)
    read_logs(path)

    @settings(max_examples=examples(100))
    @given(mutations.contents(path.read_bytes()), st.sampled_from(["mask", "refuse"]))
    def check(content, missing):
        path.write_bytes(content)
        try:
            read_logs(path, missing=missing)
        except ValueError as error:
            assert_one_sentence(error, str(path))

    check()
    assert capfd.readouterr().err == "", "libraries print nothing"


# Wrong counts that crash the process in the reader of scipy, or keep it busy for a minute.
@pytest.mark.parametrize(("offset", "byte"), [(145, 8), (163, 0x74), (160, 0xFF)])
def test_inconsistent_matlab_file_is_refused(folder, offset, byte):
    path = folder / "run.mat"
    readers.mat(path, ("",))
    content = bytearray(path.read_bytes())
    content[offset] = byte
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"run\.mat: the file is damaged or cut off: "):
        read_logs(path)


LINES = (
    "modes case.toml",
    "simulate case.toml",
    "sweep case.toml --over loads.0.speed=1,2",
    "frf case.toml",
    "stability case.toml",
    "tune case.toml --free loads.0.speed=1:2",
    "export case.toml",
    "identify case.toml log.csv --free beam.length=1:2",
    "weigh case.toml log.csv",
    "reproduce xyz",
)
INVALID_WORDS = """
    modes bad.toml none.toml folder --set --over --free -o --json --plot --resume --paired --pair
    --from -- --points beam.length=nan beam.length=1:2 loads.0.speed=1:2:1e300 beam=3 beam.=3
    =1 loads.-1.speed=2 loads.99999999999.speed=1 run.duration=1e300 beam.modes=10000000 nan
    loads.0.speed.0=1 1e400 out.nc out.zarr folder/out.nc xyz 0.3=nan force@nan:sensors.0
    beam.flexural_rigidity=inf:inf title=[1] beam.ends=\0 loads.0.speed=1:2:nan --scheduler
"""


@settings(max_examples=examples(150))
@given(
    st.sampled_from(LINES),
    st.lists(st.sampled_from(INVALID_WORDS.split()), min_size=1, max_size=3),
    st.data(),
)
def test_invalid_command_line_ends_in_one_error_message(folder, line, words, data):
    (folder / "folder").mkdir(exist_ok=True)
    (folder / "bad.toml").write_text("[beam\n")
    (folder / "case.toml").write_text(SMALL)
    (folder / "log.csv").write_text("time [s],d1 [mm]\n0,1\n0.1,2\n")
    arguments = line.split()
    for word in words:
        arguments.insert(data.draw(st.integers(1, len(arguments))), word)
    # Makes the few valid lines invalid too, which would take long to run.
    arguments += ["--set", "beam.length=-1"]
    stderr, stdout = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stderr(stderr),
        contextlib.redirect_stdout(stdout),
        pytest.raises(SystemExit) as ended,
    ):
        main(arguments)
    assert ended.value.code in (1, 2) and stdout.getvalue() == ""
    *notes, message = stderr.getvalue().splitlines()
    assert message.startswith("jaxbeam: ") and len(message) < 700
    assert all(note.startswith("jaxbeam: ") for note in notes) and len(notes) < 2


SETTINGS = (
    *("run.duration=1e300", "run.duration=1e-300", "run.sample_rate=1e12", "beam.modes=100000"),
    *("loads.0.mass=1e300", "loads.0.speed=1e300", "loads.0.speed=1e-300", "run.gravity=1e308"),
    *("beam.flexural_rigidity=1e300", "beam.flexural_rigidity=1e-300", "beam.length=1e300"),
    *("beam.mass_per_length=1e-300", "beam.damping_ratio=1e300", "loads.0.entry_time=1e300"),
)


def test_extreme_numbers_run_or_are_refused(folder, capsys):
    """Each ends within seconds, with a result or an error message."""
    (folder / "case.toml").write_text(SMALL)
    for setting in SETTINGS:
        with contextlib.chdir(folder), pytest.raises(SystemExit) as ended:
            main(["simulate", "case.toml", "--set", setting])
        printed = capsys.readouterr()
        if ended.value.code == 0:
            assert "deflection (m)" in printed.out
        else:
            *warned, error = printed.err.splitlines()
            assert error.startswith("jaxbeam: ")
            assert all(line.startswith("jaxbeam: warning: ") for line in warned)
