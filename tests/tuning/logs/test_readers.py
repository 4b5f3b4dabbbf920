"""Logs in binary formats, written by other libraries: the same run is read from each."""

import gc
import gzip
import io
import os
import re
import warnings
import wave
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.io.wavfile
from scipy.signal import lfilter

from tuning import Log, read_log, read_logs
from tuning.logs import align_logs, find_faults, readers
from tuning.logs.log import LogWarning, even_records
from tuning.logs.readers.mdf import read_mdf

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


def mdf(path, groups=None):
    asammdf = pytest.importorskip("asammdf")
    file = asammdf.MDF(version="4.10")
    file.start_time = datetime(2026, 3, 29, 23, 59, 58, tzinfo=UTC)
    for times, channels in groups or [(TIMES, {"d1": D1, "d2": D2})]:
        signals = [asammdf.Signal(v, times, name=n, unit="mm") for n, v in channels.items()]
        file.append(signals)
    file.save(path, overwrite=True)


def test_traces_of_a_seismic_recorder(tmp_path):
    """Two parts of a trace with samples missing between them; a file that is cut off."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of modules that obspy imports
        obspy = pytest.importorskip("obspy")
        start = obspy.UTCDateTime(2026, 3, 29, 23, 59, 59, 500000)

        def trace(channel, samples, late):
            about = {"network": "XX", "station": "B1", "channel": channel, "sampling_rate": 200.0}
            return obspy.Trace(samples, about | {"starttime": start + late / 200})

        counts = np.round(1e5 * np.sin(np.arange(2000) / 10)).astype(np.int32)
        parts = trace("HNZ", counts[:900], 0), trace("HNZ", counts[1000:], 1000)
        stream = obspy.Stream([*parts, trace("HNE", 2 * counts, 0)])
        stream.write(tmp_path / "run.mseed", format="MSEED", reclen=512)
        stream[2:].write(tmp_path / "cut.mseed", format="MSEED", reclen=512)
    units = {"XX.B1.HNZ": "mm", "XX.B1.HNE": "mm"}
    with pytest.raises(ValueError, match=r"run.mseed, sample 900, column 'XX.B1.HNZ'"):
        read_log(tmp_path / "run.mseed", units=units)
    log = read_log(tmp_path / "run.mseed", units=units, missing="mask")
    assert log.start == "2026-03-29T23:59:59.500000" and log.sample_rate == pytest.approx(200.0)
    np.testing.assert_array_equal(np.flatnonzero(~log.valid[:, 0]), np.arange(900, 1000))
    kept = log.valid[:, 0]
    np.testing.assert_allclose(log.values[kept, 0], 1e-3 * counts[kept], rtol=1e-12)
    np.testing.assert_allclose(log.values[:, 1], 2e-3 * counts, rtol=1e-12)
    about = {"station": "B2", "channel": "HNZ", "sampling_rate": 100.0, "starttime": start}
    slow = obspy.Trace(counts[::2].copy(), about)
    obspy.Stream([*parts, slow]).write(tmp_path / "rates.mseed", format="MSEED")
    units = {"XX.B1.HNZ": "mm", "B2.HNZ": "mm"}
    with pytest.warns(LogWarning, match="interpolated to 200 Hz"):
        joined = read_log(tmp_path / "rates.mseed", units=units, missing="mask")
    np.testing.assert_array_equal(np.flatnonzero(~joined.valid[:, 0]), np.arange(900, 1000))
    np.testing.assert_allclose(joined.values[:, 1], 1e-3 * counts[:1999], atol=0.05)
    whole = (tmp_path / "cut.mseed").read_bytes()
    (tmp_path / "cut.mseed").write_bytes(whole[: len(whole) - 700])
    with pytest.warns(LogWarning, match="the file is cut off within a record"):
        read_log(tmp_path / "cut.mseed", units={"XX.B1.HNE": "mm"})
    (tmp_path / "no.mseed").write_bytes(b"hello" * 100)
    with pytest.raises(ValueError, match=r"no.mseed: the file is damaged or cut off"):
        read_log(tmp_path / "no.mseed")


def test_groups_of_a_measurement_file_are_joined_by_their_times(tmp_path):
    """Two groups, the slower 1 ms later; its sine is interpolated."""
    slow = 1e-3 + np.arange(40) / 100
    mdf(tmp_path / "run.mf4", [(TIMES, {"d1": D1}), (slow, {"d2": np.sin(5 * slow), "d1": slow})])
    said = (pytest.warns(LogWarning, match=words) for words in ("have in common", "interpolated"))
    with next(said), next(said):
        log = read_log(tmp_path / "run.mf4")
    assert log.names == ("d1", "d2", "d1 of group 1")
    times = TIMES[1:][TIMES[1:] < slow[-1]]
    np.testing.assert_allclose(log.times, times, atol=1e-12)
    np.testing.assert_allclose(log.values[:, 0], 1e-3 * np.sin(20 * times), rtol=1e-12)
    np.testing.assert_allclose(log.values[:, 1], 1e-3 * np.sin(5 * times), atol=1e-7)
    assert log.start == "2026-03-29T23:59:58.002+00:00"  # of the first time in common


def test_groups_of_a_measurement_file_with_uneven_times(tmp_path):
    """Messages late by up to 0.4 steps, and a silence of 0.1 s, beside an even group of 3 Hz.

    Cubic splines through samples at most h apart err by 5 (h w)^4 / 384 inside, at uneven steps and
    near ends by some times as much; beside the silence the spline bends across it.
    """
    rng, step, w = np.random.default_rng(3), 2e-3, 2 * np.pi * 3
    even = np.arange(1000) * step
    late = even + rng.uniform(0, 0.4, even.size) * step
    late[[0, -1]] = even[[0, -1]]
    spoken = late[(late < 0.8) | (late > 0.9)]
    groups = [(spoken, {"d1": np.sin(w * spoken)}), (even, {"d2": np.cos(w * even)})]
    mdf(tmp_path / "bus.mf4", groups)
    said = r"d1: uneven times, steps of 0.00\d+ to 0.1\d* s, interp", "from rates and starts"
    uneven, joined = (pytest.warns(LogWarning, match=words) for words in said)
    with uneven, joined:
        log = read_log(tmp_path / "bus.mf4", missing="mask")
    d1, d2 = log.values.T
    silent = ~log.valid[:, 0]
    assert 45 < silent.sum() < 52 and np.all(np.abs(log.times[silent] - 0.85) < 0.052)
    exact, far = 1e-3 * np.sin(w * log.times), np.abs(log.times - 0.85) > 0.05 + 10 * step
    bound = 1e-3 * 4 * 5 / 384 * (1.4 * step * w) ** 4
    np.testing.assert_allclose(d1[far], exact[far], atol=bound)
    np.testing.assert_allclose(d1[~silent], exact[~silent], atol=1e-4 * 1e-3)
    np.testing.assert_allclose(d2, 1e-3 * np.cos(w * log.times), atol=1e-7)


def test_a_channel_of_times_and_invalid_samples_of_a_measurement_file(tmp_path):
    """A channel named time is no clock; what is invalid keeps its place."""
    asammdf = pytest.importorskip("asammdf")
    uneven, file = np.append(TIMES[:-1], 1.0), asammdf.MDF(version="4.10")
    for name, values, at in (("d1", D1, 3), ("d2", D2, 7)):
        bits = np.arange(TIMES.size) == at
        signal = asammdf.Signal(values, uneven, name=name, unit="mm", invalidation_bits=bits)
        file.append([signal, asammdf.Signal(7 * D1, uneven, name="Time", unit="V")])
    file.save(tmp_path / "run.mf4", overwrite=True)
    table = read_mdf(tmp_path / "run.mf4")[""]
    assert table.names == ("time", "d1", "Time of group 0", "d2", "Time of group 1")
    exact = np.column_stack([uneven, D1, 7 * D1, D2, 7 * D1])
    exact[3, 1] = exact[7, 3] = np.nan
    np.testing.assert_array_equal(table.values, exact)


def test_a_measurement_file_that_is_cut_off(tmp_path, capfd):
    mdf(tmp_path / "run.mf4")
    assert read_log(tmp_path / "run.mf4").start == "2026-03-29T23:59:58.000+00:00"
    content = (tmp_path / "run.mf4").read_bytes()
    for size in (100, len(content) // 2, len(content) - 20):
        (tmp_path / "cut.mf4").write_bytes(content[:size])
        with pytest.raises(ValueError, match="cut.mf4: the file is damaged or cut off"):
            read_log(tmp_path / "cut.mf4")
    gc.collect()
    assert capfd.readouterr().err == ""


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


def npz(path):
    np.savez(path, **{"d1 [mm]": D1, "d2 [mm]": D2}, fs=1 / TIMES[1])


def npy(path):
    table = np.zeros(TIMES.size, [("time [s]", "f8"), ("d1 [mm]", "f8"), ("d2 [mm]", "f8")])
    for name, values in zip(table.dtype.names, (TIMES, D1, D2), strict=True):
        table[name] = values
    np.save(path, table)


def text(file):
    file.write("time [s]\td1 [mm]\td2 [mm]\n")
    for row in zip(TIMES.tolist(), D1.tolist(), D2.tolist(), strict=True):
        file.write("\t".join(map(repr, row)) + "\n")


def zipped(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("README.md", "Logger 7")
        written = io.StringIO()
        text(written)
        archive.writestr("log/run.asc", written.getvalue())


def gzipped(path):
    with gzip.open(path, "wt") as file:
        text(file)


FORMATS = {
    "run.npz": npz,
    "run.npy": npy,
    "run.zip": zipped,
    "run.csv.gz": gzipped,
    "run.xlsx": xlsx,
    "run.tdms": tdms,
    "run.mf4": mdf,
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


def test_text_of_two_bytes_a_letter(tmp_path):
    with open(tmp_path / "run.txt", "w", encoding="utf-16") as file:
        text(file)
    log = read_log(tmp_path / "run.txt")
    np.testing.assert_allclose(log.values, 1e-3 * np.column_stack([D1, D2]), rtol=1e-12)


@pytest.mark.parametrize("kind", ["<i2", "<i4", "<f4", "u1", "3 bytes"])
def test_sound_files_hold_shares_of_the_range(tmp_path, kind):
    path, signal = tmp_path / "run.wav", 0.9 * np.sin(0.3 * np.arange(400))
    size = {"<i2": 2**15, "<i4": 2**31, "<f4": 1.0, "u1": 2**7, "3 bytes": 2**23}[kind]
    samples = np.stack([signal, -0.5 * signal], axis=1) * size
    if kind == "3 bytes":
        with wave.open(str(path), "wb") as file:
            file.setparams((2, 3, 100, 0, "NONE", ""))
            whole = np.round(samples).astype("<i4")
            file.writeframes(whole.view("u1").reshape(400, 2, 4)[:, :, :3].tobytes())
    else:
        whole = samples + 128 if kind == "u1" else samples
        whole = whole if kind == "<f4" else np.round(whole)
        scipy.io.wavfile.write(path, 100, whole.astype(kind))
    with pytest.raises(ValueError, match="column 'channel 1': no unit found"):
        read_log(path)
    log = read_log(path, units="g")
    np.testing.assert_allclose(log.times, np.arange(400) / 100, atol=1e-12)
    expected, rounding = 9.80665 * np.stack([signal, -0.5 * signal], axis=1), 5.1 / size + 1e-8
    np.testing.assert_allclose(log.values, expected, atol=5e-6 if kind == "<f4" else rounding)


def test_runs_of_an_archive_and_what_is_no_log(tmp_path):
    path = tmp_path / "runs.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("a.csv", "b.csv"):
            archive.writestr(name, f"t [s],{name[0]} [mm]\n0,1\n1,2\n2,3\n")
    logs = read_logs(path)
    assert [log.source for log in logs] == [f"{path}:a.csv", f"{path}:b.csv"]
    assert read_log(path, run="b.csv").names == ("b",)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.csv", "t [s],a [mm]\n0,1\n1,x\n")
    with pytest.raises(ValueError, match=r"^\S+/runs.zip, a.csv, line 3, column 'a': 'x' is no"):
        read_log(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("README.md", "nothing")
    with pytest.raises(ValueError, match="runs.zip: there is no log in the archive: README.md"):
        read_log(path)
    with gzip.open(tmp_path / "run.gz", "wt") as file:
        file.write("t [s],a [mm]\n")
    with pytest.raises(ValueError, match="run.gz: the name should end like run.csv.gz, which"):
        read_log(tmp_path / "run.gz")
    (tmp_path / "cut.csv.gz").write_bytes((tmp_path / "run.gz").read_bytes()[:25])
    with pytest.raises(ValueError, match="cut.csv.gz: the file is damaged or cut off"):
        read_log(tmp_path / "cut.csv.gz")


@pytest.mark.parametrize("name", ["run.npy", "run.npz", "run.mat", "run.h5"])
def test_channels_that_stand_in_rows(tmp_path, name):
    table, path = np.stack([D1, D2]), tmp_path / name
    if name == "run.npy":
        np.save(path, table)
        log = read_log(path, columns="d1 [mm], d2 [mm]", rate=1 / TIMES[1])
    else:
        content = {"data": table, "fs": 1 / TIMES[1]}
        if name == "run.h5":
            with pytest.importorskip("h5py").File(path, "w") as file:
                for key, value in content.items():
                    file[key] = value
        else:
            (np.savez(path, **content) if name == "run.npz" else scipy.io.savemat(path, content))
        log = read_log(path, units="mm")
        assert log.names == ("data.0", "data.1")
    np.testing.assert_allclose(log.times, TIMES, atol=1e-12)
    np.testing.assert_allclose(log.values, 1e-3 * table.T, rtol=1e-12)


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
        ".tdms", ".mf4", ".mdf", ".mseed", ".miniseed", ".mat", ".h5", ".hdf5", ".nc", ".parquet",
        ".xlsx", ".uff", ".unv", ".npy", ".npz", ".wav", ".gz", ".zip",
    }  # fmt: skip
    assert set(suffixes) - binary == {".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm"}


# LabVIEW measurement files, written by the tests after the published format.

HEAD = """LabVIEW Measurement
Writer_Version{s}2
Reader_Version{s}2
Separator{s}{separator}
Decimal_Separator{s}{decimal}
Multi_Headings{s}{multi}
X_Columns{s}{clocks}
Time_Pref{s}Absolute
Date{s}2024/03/01
Time{s}23:59:59{decimal}5
***End_of_Header***
{s}
"""
SEGMENT = """Channels{s}2{s}{s}{s}
Samples{s}3{s}3{s}
Date{s}2024/03/01{s}2024/03/01{s}
Time{s}{start}{s}{start}{s}
Y_Unit_Label{s}g{s}mm{s}
X_Dimension{s}Time{s}Time{s}
X0{s}0{decimal}0{s}0{decimal}0{s}
Delta_X{s}0{decimal}001{s}0{decimal}001{s}
***End_of_Header***{s}{s}
"""
ROWS = {
    "One": "X_Value{s}a{s}b{s}Comment\n0{decimal}0000{s}1{decimal}5{s}2\n"
    "0{decimal}0012{s}2{decimal}5{s}3{s}a remark\n0{decimal}0024{s}3{decimal}5{s}4\n",
    "Multi": "X_Value{s}a{s}X_Value{s}b{s}Comment\n0{s}1{decimal}5{s}0{s}2\n"
    "0{decimal}0012{s}2{decimal}5{s}0{decimal}0012{s}3\n"
    "0{decimal}0024{s}3{decimal}5{s}0{decimal}0024{s}4\n",
    "No": "X_Value{s}a{s}b{s}Comment\n{s}1{decimal}5{s}2\n{s}2{decimal}5{s}3\n{s}3{decimal}5{s}4\n",
}


def lvm(clocks="One", separator="Comma", decimal=".", starts=("23:59:59.5",), multi="Yes"):
    """Text of a file with one segment for each start time."""
    fields = {
        "s": "," if separator == "Comma" else "\t",
        "separator": separator,
        "decimal": decimal,
        "clocks": clocks,
        "multi": multi,
    }
    text = HEAD.format(**fields)
    for start in starts:
        date, _, clock = start.rpartition(" ")
        segment = SEGMENT.format(start=clock.replace(".", decimal), **fields)
        text += segment.replace("2024/03/01", date or "2024/03/01")
        text += ROWS[clocks].format(**fields) + "\n"
    return text


def write(folder, text, name="run.lvm"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("clocks", ROWS)
@pytest.mark.parametrize(("separator", "decimal"), [("Comma", "."), ("Tab", "."), ("Tab", ",")])
@pytest.mark.parametrize("name", ["run.lvm", "run.txt"])
def test_layouts(tmp_path, clocks, separator, decimal, name):
    log = read_log(write(tmp_path, lvm(clocks, separator, decimal), name))
    step = 0.001 if clocks == "No" else 0.0012  # the printed Delta_X is used only without times
    assert (log.names, log.units) == (("a", "b"), ("g", "mm"))
    assert log.start == "2024-03-01T23:59:59.500000"
    np.testing.assert_allclose(log.times, [0, step, 2 * step], rtol=1e-14)
    np.testing.assert_allclose(log.values[:, 0] / 9.80665, [1.5, 2.5, 3.5], rtol=1e-14)
    np.testing.assert_allclose(log.values[:, 1], [2e-3, 3e-3, 4e-3], rtol=1e-14)


def test_segments_follow_their_start_times(tmp_path):
    """The second segment starts one second later, past midnight."""
    text = lvm(starts=("23:59:59.5", "2024/03/02 00:00:00.5"))
    with pytest.warns(LogWarning, match="times jump by 0.9976 s after t = 0.0024 s, line 37"):
        log = read_log(write(tmp_path, text))
    expected = [0, 0.0012, 0.0024, 1, 1.0012, 1.0024]
    np.testing.assert_allclose(log.times, expected, rtol=1e-12)
    with pytest.raises(ValueError, match="not sampled evenly"):
        _ = log.sample_rate


def test_segments_whose_times_continue(tmp_path):
    text = lvm(starts=("23:59:59.5", "23:59:59.5"))
    head, first, second = text.partition("Channels")[0], *text.split("Channels")[1:]
    for old, new in (("0.0024", "0.0060"), ("0.0012", "0.0048"), ("0.0000", "0.0036")):
        second = second.replace(old, new)
    log = read_log(write(tmp_path, f"{head}Channels{first}Channels{second}"))
    np.testing.assert_allclose(log.times, 0.0012 * np.arange(6), rtol=1e-12)


def test_special_blocks_are_passed_over(tmp_path):
    block = "***Start_Special***\nLimits,1,2\n***End_Special***\n"
    text = lvm().replace("Channels,2", f"{block}Channels,2")
    assert read_log(write(tmp_path, text)).values.shape == (3, 2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("***End_of_Header***", "", "the header has no end"),
        ("2.5", "2.5x", "line 24, column 'a': '2.5x' is no number"),
        ("2.5", "", "line 24, column 'a': the cell is empty"),
        ("0.0012", "0.0000", "line 24: time 0 s is repeated"),
        ("0.0012", "-1", "line 24: time -1 s comes after 0 s"),
        ("X_Value,a,b", "Zeit,a,b", "line 22: the column headings must be X_Value"),
        ("LabVIEW Measurement", "Something", "line 1: a LabVIEW measurement file starts with"),
    ],
)
def test_mistakes(tmp_path, old, new, message):
    text = lvm()
    assert old in text
    with pytest.raises(ValueError, match=message):
        read_log(write(tmp_path, text.replace(old, new)))


def test_columns_of_other_units_are_conditions(tmp_path):
    """Means of 1.5 and so on: a known unit of conditions is no cause to warn, a misspelt one is."""
    text = lvm()
    plain = read_log(write(tmp_path, text))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_log(write(tmp_path, text.replace("Y_Unit_Label,g,", "Y_Unit_Label,°C,")))
    assert found.names == ("b",) and not found.notes
    raw = plain.values[:, 0].mean() / 9.80665
    assert dict(found.conditions) == {"a (°C)": pytest.approx(raw, rel=1e-6)}
    for unit, said in (("parsec", ": unknown unit 'parsec'"), ("", ", having no unit")):
        with pytest.warns(LogWarning, match=f"column 'a' is no channel{said}"):
            read_log(write(tmp_path, text.replace("Y_Unit_Label,g,", f"Y_Unit_Label,{unit},")))
    with pytest.raises(ValueError, match="unknown unit '°C'"):
        read_log(
            write(tmp_path, text.replace("Y_Unit_Label,g,", "Y_Unit_Label,°C,")), columns="a,b"
        )


def test_a_key_without_a_value_counts_as_empty(tmp_path):
    text = lvm("No").replace("Separator,.", "Separator")
    assert "Decimal_Separator\n" in text
    assert len(read_log(write(tmp_path, text)).times) > 1
    with pytest.raises(ValueError, match="nor a Delta_X"):
        read_log(write(tmp_path, re.sub("Delta_X,.*", "Delta_X", text)))


def test_mistakes_between_segments(tmp_path):
    two = lvm(starts=("23:59:59.5", "23:59:59.5"))
    with pytest.raises(ValueError, match="starts before the one of line 23 ends"):
        read_log(write(tmp_path, two))
    head, _, second = two.rpartition("X_Value,a,b")
    with pytest.raises(ValueError, match="this segment has the channels a, c, the first one a, b"):
        read_log(write(tmp_path, f"{head}X_Value,a,c{second}"))
    with pytest.raises(ValueError, match="Time 'noon' do not tell when it started"):
        read_log(write(tmp_path, lvm(starts=("23:59:59.5", "noon"))))
    with pytest.raises(ValueError, match="the log is empty"):
        read_log(write(tmp_path, lvm().partition("0.0000")[0]))


def test_channels_with_their_own_times(tmp_path):
    text = lvm("Multi").replace("0.0012,3", "0.0013,3")
    with pytest.raises(ValueError, match="line 24: the channels have different times"):
        read_log(write(tmp_path, text))


# Logs of other loggers: headings of many kinds or none, universal files, several clocks, gaps.


TEXTS = {
    "preamble and units below": "Logger 7\nserial,1234,5\nt,a,b\ns,mm,[mm]\n0,1,2\n0.1,3,4\n",
    "spaces": "# comment\n t  a  b \n  s   mm  mm\n 0.0 1.0 2.0\n 0.1  3.0 4.0\n",
    "spaces, decimal comma": "t a b\ns mm mm\n0,0 1,0 2,0\n0,1 3,0 4,0\n",
    "comments within": "t [s];a [mm];b [mm]\n0,0;1,0;2,0\n% paused\n// again\n0,1;3,0;4,0\n",
    "several headings": "place;left;right\nt (s);a (mm);b (mm)\n0;1;2\n0,1;3;4\n",
    "merged headings": "bridge;;\nt [s];deflection [mm];\n;a;b\n0;1;2\n0,1;3;4\n",
    "merged headings, units below": "t,deflection,\n,a,b\ns,mm,mm\n0,1,2\n0.1,3,4\n",
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_headings_of_many_kinds(tmp_path, text):
    (tmp_path / "run.txt").write_text(text)
    log = read_log(tmp_path / "run.txt")
    assert log.names == ("a", "b") and log.units == ("mm", "mm")
    np.testing.assert_allclose(log.values, [[1e-3, 2e-3], [3e-3, 4e-3]])
    np.testing.assert_allclose(log.times, [0, 0.1])


def test_a_file_without_headings_is_read_with_named_columns(tmp_path):
    path = tmp_path / "node.csv"
    path.write_text("0.000,1.0,7\n0.001,2.0,7\n0.002,3.0,8\n")
    log = read_log(path, columns="time [s], a1 [g], -")
    assert log.names == ("a1",)
    np.testing.assert_allclose(log.values[:, 0], 9.80665 * np.arange(1, 4))
    with pytest.raises(ValueError, match="2 columns are named, but the file has 3; name all"):
        read_log(path, columns="time [s], a1 [g]")
    with pytest.raises(ValueError, match=r'columns="time \[s\], a1 \[g\], a2 \[g\]"'):
        read_log(path)
    path.write_text("1;2\n3;4\n5;6\n")
    log = read_log(path, columns=["a [mm]", "b [mm]"], rate=50.0)
    np.testing.assert_allclose(log.times, [0, 0.02, 0.04])
    with pytest.raises(ValueError, match="the log has a column of times, 'a'; leave the sampling"):
        read_log(path, columns="a [s], b [mm]", rate=50.0)
    with pytest.raises(ValueError, match="must be positive, not 0 Hz"):
        read_log(path, columns="a [mm], b [mm]", rate=0.0)


def test_units_are_given_with_the_names_of_columns(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t [s],a,b\n0,1,2\n1,3,4\n")
    assert read_log(path, columns="b [mm]").values[:, 0].tolist() == [2e-3, 4e-3]


def test_workbook_that_is_damaged(tmp_path):
    pytest.importorskip("openpyxl")
    path = tmp_path / "run.xlsx"
    path.write_bytes(b"PK\x03\x04 and nothing else")
    with pytest.raises(ValueError, match="run.xlsx: the file is damaged or cut off"):
        read_log(path)


def test_workbook_with_a_damaged_sheet_is_closed(tmp_path):
    path = tmp_path / "run.xlsx"
    xlsx(path)
    with zipfile.ZipFile(path) as book:
        parts = {name: book.read(name) for name in book.namelist()}
    with zipfile.ZipFile(path, "w") as book:  # not compressed
        for name, part in parts.items():
            book.writestr(name, part)
    path.write_bytes(path.read_bytes().replace(b"<v>0.002</v>", b"<v>0.003</v>"))
    with pytest.raises(ValueError, match="run.xlsx: the file is damaged .* Bad CRC-32") as refused:
        read_log(path)
    opened = map(os.path.realpath, Path("/proc/self/fd").glob("*"))
    assert str(path.resolve()) not in opened, refused.value


def node(times, seed, clock_offset=0.0, clock_rate=1.0, sign=1.0):
    """Log of a node whose clock has an offset and a rate, of one broadband response and noise."""
    random = np.random.default_rng(3)
    fine = np.arange(0, 60, 1e-3)
    response = sum(
        lfilter([1.0], [1, -2 * r.real, abs(r) ** 2], random.normal(size=fine.size)) * size
        for r, size in (
            (np.exp(1e-3 * 2 * np.pi * f * (-0.01 + 1j)), s) for f, s in ((3.0, 1.0), (11.0, 9.0))
        )
    )
    values = sign * np.interp(times, fine, response / response.std())
    values = values + 0.1 * np.random.default_rng(seed).normal(size=times.size)
    return Log(
        (times - clock_offset) * clock_rate, values[:, None], ("a",), ("acceleration",), ("g",),
        f"node{seed}.csv",
    )  # fmt: skip


def test_clocks_of_several_nodes_are_aligned():
    first = node(np.arange(0, 50, 0.01), 1)
    second = node(np.arange(2.003, 55, 0.01), 2, clock_offset=7.5, clock_rate=1 + 2e-4, sign=-1)
    log = align_logs([first, second])
    assert log.names == ("1.a", "2.a")
    assert np.corrcoef(log.values.T)[0, 1] < -0.95
    assert "clock aligned by correlation" in log.notes[-1]
    offset = float(log.notes[-1].split("): ")[1].split(" s")[0])
    rate = float(log.notes[-1].split("rate ")[1].split(" ppm")[0])
    assert offset == pytest.approx(7.5, abs=0.02) and rate == pytest.approx(-200, abs=40)


def test_logs_without_a_common_signal_are_not_aligned():
    random = np.random.default_rng(0)
    logs = [
        Log(np.arange(4000) / 100, random.normal(size=(4000, 1)), ("a",), ("acceleration",), ("g",))
        for _ in range(2)
    ]
    with pytest.raises(ValueError, match="no signal in common with the first log"):
        align_logs(logs)
    with pytest.raises(ValueError, match="needs two logs or more, not 1"):
        align_logs(logs[:1])


def test_records_between_gaps():
    times = np.delete(np.arange(1000) / 100, slice(300, 400))
    values = np.sin(5 * times)[:, None]
    log = Log(times, values, ("a",), ("acceleration",), ("g",))
    rate, records, notes = even_records(log)
    assert rate == pytest.approx(100)
    assert [len(record.values) for record in records] == [300, 600]
    assert records[1].start == 4.0 and "1 gap: 2 records are used" in notes[0]
    wandering = times[:300] + 0.005 * np.sin(times[:300])
    log = Log(wandering, np.sin(5 * wandering)[:, None], ("a",), ("acceleration",), ("g",))
    rate, (record,), notes = even_records(log)
    grid = record.start + np.arange(len(record.values)) / rate
    np.testing.assert_allclose(record.values[:, 0], np.sin(5 * grid), atol=1e-6)
    assert "interpolated" in notes[0]
    with pytest.raises(ValueError, match="no record has 64 samples"):
        even_records(Log(times[:40], values[:40], ("a",), ("acceleration",), ("g",)))


def test_gravity_and_offsets_are_reported():
    times = np.arange(500) / 100
    wave = 0.1 * np.sin(30 * times)
    values = np.column_stack([wave + 9.81, wave, wave - 51 * 9.81])
    log = Log(times, values, ("up", "level", "odd"), ("acceleration",) * 3, ("g",) * 3)
    faults = {(fault.kind, fault.channel) for fault in find_faults(log)}
    assert faults == {("gravity", "up"), ("offset", "odd")}
