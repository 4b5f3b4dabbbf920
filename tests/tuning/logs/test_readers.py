"""Logs in binary formats, written by other libraries: the same run is read from each."""

import warnings

import numpy as np
import pytest
import scipy.io

from tuning import read_log, read_logs
from tuning.logs import readers
from tuning.logs.log import LogWarning

TIMES = np.arange(40) / 500
D1, D2 = np.sin(20 * TIMES), np.cos(30 * TIMES) - 1  # mm


def tdms(path, runs=("",), step=0.002, extra=None):
    nptdms = pytest.importorskip("nptdms")
    channels = []
    for i, run in enumerate(runs):
        properties = {"wf_increment": step, "wf_start_offset": 0.0, "unit_string": "mm"}
        channels.append(nptdms.ChannelObject(run or "log", "d1", D1 + i, properties))
        channels.append(
            nptdms.ChannelObject(run or "log", "d2", D2 + i, properties | (extra or {}))
        )
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)


def hdf5(path, runs=("",), units="mm"):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for i, run in enumerate(runs):
            group = file.create_group(run) if run else file
            group["time"], group["d1"], group["d2"] = TIMES, D1 + i, D2 + i
            group["time"].attrs["units"] = "s"
            group["calibration"] = np.arange(3.0)
            for name in ("d1", "d2"):
                group[name].attrs["units"] = units


def hdf5_by_rate(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = 500.0
        file["d1 [mm]"], file["d2 [mm]"] = D1, D2


def mat(path, runs=("",)):
    def run(i):
        names = {"time": "s", "d1": "mm", "d2": "mm"}
        return {"time": TIMES, "d1": D1 + i, "d2": D2 + i, "gain": 3.0, "units": names}

    scipy.io.savemat(path, run(0) if runs == ("",) else {r: run(i) for i, r in enumerate(runs)})


def netcdf(path):
    with scipy.io.netcdf_file(path, "w") as file:
        file.createDimension("time", TIMES.size)
        for name, values, unit in (("time", TIMES, "s"), ("d1", D1, "mm"), ("d2", D2, "mm")):
            variable = file.createVariable(name, "d", ("time",))
            variable[:], variable.units = values, unit


def parquet(path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet as files

    stamps = np.datetime64("2024-03-01T12:00:00") + (1e6 * TIMES).round().astype("timedelta64[us]")
    fields = [
        pyarrow.field("time", pyarrow.timestamp("us")),
        pyarrow.field("d1 [mm]", pyarrow.float64()),
        pyarrow.field("d2", pyarrow.float64(), metadata={"unit": "mm"}),
    ]
    columns = [pyarrow.array(values) for values in (stamps, D1, D2)]
    files.write_table(pyarrow.table(columns, schema=pyarrow.schema(fields)), path)


def xlsx(path, runs=("",)):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for i, run in enumerate(runs):
        sheet = book.active if i == 0 else book.create_sheet()
        sheet.title = run or "log"
        for row in (["Logger 7"], [], ["time", "d1", "d2"], ["s", "mm", "[mm]"]):
            sheet.append(row)
        for row in np.column_stack([TIMES, D1 + i, D2 + i]).tolist():
            sheet.append(row)
    book.create_sheet("remarks").append(["nothing to report"])
    book.save(path)


FORMATS = {
    "run.xlsx": xlsx,
    "run.tdms": tdms,
    "run.h5": hdf5,
    "rate.h5": hdf5_by_rate,
    "run.mat": mat,
    "run.nc": netcdf,
    "run.parquet": parquet,
}


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_run_is_read_from_every_format(tmp_path, name):
    FORMATS[name](tmp_path / name)
    log = read_log(tmp_path / name)
    assert log.names == ("d1", "d2") and log.units == ("mm", "mm")
    np.testing.assert_allclose(log.times, TIMES, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(log.values, 1e-3 * np.column_stack([D1, D2]), rtol=1e-12)


@pytest.mark.parametrize("name", ["run.tdms", "run.h5", "run.mat"])
def test_several_runs_in_a_file(tmp_path, name):
    path = tmp_path / name
    FORMATS[name](path, ("slow", "fast"))
    path.with_suffix(".toml").write_text(
        "[[loads]]\nkind = 'mass'\nmass = 0.5\nspeed = 1.0\n"
        "[[runs.fast.loads]]\nkind = 'mass'\nmass = 0.5\nspeed = 2.0\n"
    )
    logs = {log.source.rsplit(":", 1)[1]: log for log in read_logs(path)}
    assert set(logs) == {"slow", "fast"}
    assert {run: float(log.loads[0].speed) for run, log in logs.items()} == {"slow": 1, "fast": 2}
    np.testing.assert_allclose(logs["fast"].values, logs["slow"].values + 1e-3, atol=1e-12)
    assert read_log(path, run="fast").source == f"{path}:fast"
    with pytest.raises(ValueError, match="it holds 2 runs, .*'fast'.*name one, or use read_logs"):
        read_log(path)
    with pytest.raises(ValueError, match="it has no run 'fats'; it has "):
        read_log(path, run="fats")
    path.with_suffix(".toml").write_text("[runs.quick]\n")
    with pytest.raises(ValueError, match="run.toml: runs.quick is no run of run."):
        read_logs(path)


def test_rows_that_name_their_run(tmp_path):
    path = tmp_path / "runs.csv"
    path.write_text("run,t [s],d [mm]\n1,0,1\n1,1,2\n2,0,3\n2,1,4\n2,2,5\n")
    first, second = read_logs(path)
    assert first.source.endswith(":1") and first.names == ("d",)
    np.testing.assert_allclose(second.values[:, 0], [3e-3, 4e-3, 5e-3])


def test_arrays_left_out_are_noted(tmp_path):
    hdf5(tmp_path / "run.h5")
    assert read_log(tmp_path / "run.h5").notes == (
        "left out, not being 40 samples long: calibration (3)",
    )


def test_missing_samples_are_masked_only_on_request(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t [s],a [mm],b [mm]\n0,1,5\n1,,6\n2,3,nan\n3,4,9\n")
    with pytest.raises(ValueError, match="line 3, column 'a': the cell is empty"):
        read_log(path)
    log = read_log(path, missing="mask")
    np.testing.assert_allclose(log.values[:, 0], [1e-3, 2e-3, 3e-3, 4e-3])  # interpolated
    assert log.valid.T.tolist() == [[True, False, True, True], [True, True, False, True]]
    assert log.notes[0] == "1 missing samples of a are left out"
    with pytest.raises(ValueError, match='can be "refuse"d or "mask"ed'):
        read_log(path, missing="fill")


def test_transducers_with_a_sensitivity(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t [s],a [V],d [mV]\n0,1,2\n1,2,4\n")
    description = path.with_suffix(".toml")
    description.write_text(
        '[columns]\na = {sensitivity = "100 mV/g"}\nd = {sensitivity = "-0.5 V/mm"}\n'
    )
    log = read_log(path)
    assert log.quantities == ("acceleration", "deflection")
    np.testing.assert_allclose(log.values, [[98.0665, -4e-6], [196.133, -8e-6]])
    description.write_text('[columns]\na = {sensitivity = "100 g"}\n')
    with pytest.raises(ValueError, match="column 'a': the sensitivity '100 g' should be like"):
        read_log(path)
    description.write_text('[columns]\na = {sensitivity = "3 N/mm"}\n')
    with pytest.raises(ValueError, match="is for force, but the column is voltage"):
        read_log(path)


@pytest.mark.parametrize("name", FORMATS)
def test_a_truncated_file_is_refused_with_one_message(tmp_path, name):
    whole, cut = tmp_path / name, tmp_path / f"cut_{name}"
    FORMATS[name](whole)
    data = whole.read_bytes()
    for share in (0.2, 0.6, 0.97):
        cut.write_bytes(data[: int(share * len(data))])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LogWarning)
                log = read_log(cut)
        except ValueError as error:
            assert str(error).startswith(str(cut)) and "\n" not in str(error)
        else:  # samples that can be read are right, and missing ones are noted
            count = log.times.size
            np.testing.assert_allclose(log.times, TIMES[:count], atol=1e-12)
            assert count == TIMES.size or "breaks off" in "".join(log.notes)


@pytest.mark.parametrize("suffix", [".tdms", ".mat", ".h5", ".nc", ".parquet"])
def test_a_file_whose_content_is_not_that_of_its_suffix(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    path.write_text("t [s],d [mm]\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="whatever it is called: it is text"):
        read_log(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="the log is empty"):
        read_log(path)


def test_the_format_is_decided_by_content(tmp_path):
    mat(tmp_path / "run.csv")
    assert read_log(tmp_path / "run.csv").names == ("d1", "d2")
    (tmp_path / "noise.csv").write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match="this is no text but a binary file"):
        read_log(tmp_path / "noise.csv")


def test_files_without_numbers(tmp_path):
    scipy.io.savemat(tmp_path / "words.mat", {"about": "nothing"})
    with pytest.raises(ValueError, match="no list of numbers in it; tables and timetables"):
        read_log(tmp_path / "words.mat")


def test_formats_are_found_in_the_modules_of_the_readers():
    suffixes = [suffix for log_format in readers.FORMATS for suffix in log_format.suffixes]
    assert len(set(suffixes)) == len(suffixes)
    binary = {suffix for f in readers.FORMATS if not f.is_text for suffix in f.suffixes}
    assert binary == {
        ".tdms", ".mat", ".h5", ".hdf5", ".nc", ".parquet", ".xlsx", ".uff", ".unv"
    }  # fmt: skip
    assert set(suffixes) - binary == {".csv", ".tsv", ".txt", ".dat", ".lvm"}
